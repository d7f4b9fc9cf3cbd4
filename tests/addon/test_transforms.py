"""Transforms that splats follow as a whole, and what is noticed of Blender's own tools."""

import bpy
import mathutils
import numpy as np
import pytest

from tests.e2e.inside.clouds import as_blender_imports
from tests.e2e.inside.extension import select
from tests.strategies import ply_of

from .conftest import linked

COUNT = 9_939
TURN = mathutils.Euler((0.4, -0.7, 1.1)).to_quaternion()
NOWHERE = mathutils.Matrix()
SOMEWHERE = mathutils.Matrix.LocRotScale((1.0, -2.0, 0.5), TURN, (1.5, 1.5, 1.5))
ELSEWHERE = mathutils.Matrix.LocRotScale(
    (-0.3, 0.2, 0.1), mathutils.Euler((-1.0, 0.2, 0.3)), (-0.7, 0.7, 0.7)
)


@pytest.fixture
def imported(addon, quarter_file):
    """Import every fourth splat of the room: 9,939."""
    bpy.ops.refine.import_ply(filepath=str(quarter_file))
    return bpy.context.object


@pytest.fixture
def stand(addon):
    """Return a function that tells how splats stand in the world, or in the frame of a matrix."""

    def stand(*objects, within=NOWHERE, rows=slice(None)):
        bpy.context.view_layer.update()
        group = [addon.mesh.layout.check(obj) for obj in objects]
        splats = addon.objects.splat_group.gather(group, whole=True)
        back = np.linalg.inv(np.array(within, np.float64))
        splats = addon.core.affine.transformed(splats, back)
        shapes = addon.viewport.arrays.pack(splats).covariances
        return [a[rows] for a in (splats.means, shapes, splats.sh_dc, splats.sh_rest)]

    return stand


def assert_alike(got, expected):
    """Compare what `stand` tells, within the roundings of float32 matrices."""
    for one, other in zip(got, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4)


def told_of(addon, obj):
    """Return what the panel says that others did to an object's splats."""
    drift = addon.mesh.drift.of(obj)
    return drift.sentences if drift else []


def set_places(obj, places):
    """Move the vertices alone, as Blender's tools do."""
    obj.data.attributes["position"].data.foreach_set("vector", np.float32(places).ravel())
    obj.data.update()
    bpy.context.view_layer.update()


@pytest.mark.parametrize("kind", ["MESH", "POINTCLOUD"])
def test_apply_of_blender_is_named_and_mended_by_one_click(addon, quarter_file, stand, kind):
    """Turned, scaled by 1.5 and moved, then Ctrl+A; an export does not write the notes."""
    if kind == "MESH":
        bpy.ops.refine.import_ply(filepath=str(quarter_file))
    else:
        cloud = as_blender_imports(addon.core.read_ply(quarter_file).rows)
        addon.mesh.drift.stamp(cloud.data)
    obj = bpy.context.object
    assert told_of(addon, obj) == []
    names = {column.name for column in addon.mesh.layout.check(obj).layout.columns}
    assert not any(name.startswith("refine") for name in names)
    obj.matrix_world = SOMEWHERE
    before = stand(obj, within=SOMEWHERE)
    bpy.ops.object.transform_apply()

    (sentence,) = told_of(addon, obj)
    assert "9,939 splats were transformed without their sizes, rotations and colours" in sentence
    assert np.abs(stand(obj, within=SOMEWHERE)[1] - before[1]).max() > 0.01
    assert bpy.ops.refine.mend() == {"FINISHED"}
    assert_alike(stand(obj, within=SOMEWHERE), before)
    assert told_of(addon, obj) == []


@pytest.mark.usefixtures("room_cameras")
@pytest.mark.parametrize("location", [True, False])
def test_bake_transform_keeps_splats_children_and_scores(addon, imported, stand, location):
    """Turned, scaled and moved below a parent that is, too; a mirror makes it harder."""
    parent, child = linked("parent"), linked("child")
    parent.matrix_world = ELSEWHERE
    imported.parent, child.parent = parent, imported
    imported.matrix_basis = SOMEWHERE
    child.location = (1.0, 2.0, 3.0)
    before = stand(imported)
    place = child.matrix_world.copy()
    bpy.ops.refine.score()
    assert bpy.ops.refine.bake_transform(location=location) == {"FINISHED"}

    expected = NOWHERE if location else mathutils.Matrix.Translation((1.0, -2.0, 0.5))
    np.testing.assert_allclose(imported.matrix_basis, expected, atol=1e-6)
    np.testing.assert_allclose(child.matrix_world, place, atol=1e-5)
    assert_alike(stand(imported), before)
    assert told_of(addon, imported) == []
    assert addon.ui.plans.stale(imported) == []


def test_an_uneven_scale_is_baked_as_near_as_harmonics_come(addon, imported):
    """Shapes as M covariance M'; colours that hang on the direction are noted, as by an export."""
    imported.scale = (1.0, 1.2, 1.0)
    checked, group = addon.mesh.layout.check(imported), addon.objects.splat_group
    before = group.gather([checked])
    assert group.export_notes(checked) == []
    notes = group.export_notes(checked, apply_transform=True)
    (note,) = addon.objects.transforms.bake([checked])
    assert notes == [note]
    assert note.endswith("became the nearest")
    after = group.gather([checked])
    np.testing.assert_allclose(after.means, before.means, rtol=1e-6)
    shapes = [addon.viewport.arrays.pack(splats).covariances for splats in (after, before)]
    np.testing.assert_allclose(*shapes, rtol=1e-4, atol=2e-7)


@pytest.mark.parametrize("what", ["shares? (their|its) data", "is animated", "has shape keys"])
def test_a_bake_that_is_refused_changes_nothing(imported, unchanged, what):
    """Another user of the data would move; an animation would move the splats on."""
    imported.matrix_world = SOMEWHERE
    if "data" in what:
        linked("other", imported.data)
    elif what == "is animated":
        imported.keyframe_insert("location")
    else:
        imported.shape_key_add()
    bpy.context.view_layer.update()
    unchanged.start()
    with pytest.raises(RuntimeError, match=what):
        bpy.ops.refine.bake_transform()
    unchanged()


@pytest.mark.parametrize("degrees", [(3, 3), (1, 3), (3, 1)])
def test_join_of_blender_is_named_and_mended(addon, make_splats, tmp_path, stand, degrees):
    """Ctrl+J of turned objects: harmonics of another degree are sorted out as well."""
    path, objects = tmp_path / "in.ply", []
    for count, degree in zip((300, 200), degrees, strict=True):
        path.write_bytes(ply_of(make_splats(count, degree=degree, seed=count)))
        bpy.ops.refine.import_ply(filepath=str(path))
        objects.append(bpy.context.object)
    one, two = objects
    one.matrix_world, two.matrix_world = SOMEWHERE, ELSEWHERE
    expected = stand(one, two)
    select(one, two)
    bpy.ops.object.join()
    told = told_of(addon, one)
    assert bpy.ops.refine.mend() == {"FINISHED"}
    assert "200 splats were transformed without their sizes, rotations and colours" in told[0]
    assert ("another SH degree" in " ".join(told)) == (degrees[0] != degrees[1])
    assert_alike(stand(one), expected)
    assert told_of(addon, one) == []


@pytest.mark.parametrize("merge", [False, True])
def test_an_applied_mirror_is_mended(addon, imported, stand, merge):
    """*Merge* moves what is near the mirror; all else is as an object mirrored as a whole."""
    places = addon.mesh.attributes.read_attribute(imported.data, "position")
    places[:, 0] -= np.median(places[:, 0])
    set_places(imported, places)
    addon.mesh.drift.stamp(imported.data)
    addon.mesh.attributes.write_attribute(imported.data, "row", "INT", np.arange(COUNT))
    twin = linked("twin", imported.data.copy())
    twin.scale.x = -1.0
    expected = stand(imported, twin)
    bpy.data.objects.remove(twin)
    modifier = imported.modifiers.new("Mirror", "MIRROR")
    modifier.use_mirror_merge, modifier.merge_threshold = merge, 0.005
    bpy.ops.object.modifier_apply(modifier="Mirror")
    merged = 2 * COUNT - len(imported.data.vertices)
    (told,) = told_of(addon, imported)
    assert bpy.ops.refine.mend() == {"FINISHED"}

    assert "splats were transformed" in told
    assert (merged >= 6) == merge
    assert told_of(addon, imported) == []
    rows = addon.mesh.attributes.read_attribute(imported.data, "row")
    rows[COUNT:] += COUNT
    apart = np.abs(expected[0][rows, 0]) > 0.006
    assert_alike(stand(imported, rows=apart), [array[rows[apart]] for array in expected])


def test_splats_that_are_bent_and_what_is_no_splat_are_named(addon, imported):
    """No map explains them, and the click takes them; a few, or a move of some, count as none."""
    checked = addon.mesh.layout.check(imported)
    places = addon.mesh.attributes.read_attribute(imported.data, "position")
    set_places(imported, places + (np.arange(COUNT) % 3 == 0)[:, None] * [0.5, 0.0, 0.0])
    assert told_of(addon, imported) == []
    for share, said in ((0.005, []), (0.5, ["4,970 splats were moved one by one"])):
        which = np.arange(COUNT) < share * COUNT
        set_places(imported, places + which[:, None] * np.sin(7.0 * places[:, ::-1]))
        before = addon.mesh.attributes.digest(checked)
        assert [told.partition(", as by")[0] for told in told_of(addon, imported)] == said
        bpy.ops.refine.mend()
        assert told_of(addon, imported) == []
        assert addon.mesh.attributes.digest(checked) == before

    bpy.ops.mesh.primitive_cube_add()
    select(imported, bpy.context.object)
    bpy.ops.object.join()
    (told,) = told_of(addon, imported)
    assert "8 vertices were joined that are no splats" in told
    assert not addon.mesh.drift.of(imported).mendable


def test_who_changes_all_of_a_splat_is_left_alone(addon, imported, room_cameras, capfd):
    """Merging, by which splats move and grow; another add-on that transforms sizes as well."""
    addon.mesh.edit.delete_vertices(imported, np.arange(COUNT) % 3 > 0)
    settings = bpy.context.scene.refine
    settings.method, settings.ratio, settings.views = "merge", 0.6, 8
    bpy.ops.refine.score()
    bpy.ops.refine.apply()
    assert "were merged" in capfd.readouterr().out
    assert told_of(addon, imported) == []
    checked = addon.mesh.layout.check(imported)
    splats = addon.objects.splat_group.gather([checked], whole=True)
    turned = addon.core.affine.transformed(splats, np.array(SOMEWHERE))
    values = addon.core.formats.ply_columns.values_by_name(turned)
    addon.mesh.attributes.write_columns(imported.data, checked.layout, values)
    assert told_of(addon, imported) == []


def test_score_apply_export_and_the_command_say_what_was_done(
    addon, imported, room_cameras, room_views, tmp_path, capfd
):
    """None of them is silent about splats that Ctrl+A ruined."""
    imported.matrix_world = SOMEWHERE
    select(imported)
    bpy.ops.object.transform_apply()
    for name, options in (
        ("score", {}), ("apply", {}), ("export_ply", {"filepath": str(tmp_path / "out.ply")})
    ):  # fmt: skip
        capfd.readouterr()
        assert getattr(bpy.ops.refine, name)(**options) == {"FINISHED"}
        said = capfd.readouterr()
        assert "splats were transformed without" in said.out + said.err
    core = addon.core
    report = addon.objects.splat_group.prune_object(
        imported.name, room_views, core.Budget(ratio=0.5), core.ClosedForm(), dry_run=True
    )
    assert "Mend Splats in the panel" in " ".join(report["notes"])
