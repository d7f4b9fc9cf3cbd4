"""Transforms that splats follow as a whole, and what is noticed of Blender's own tools."""

from __future__ import annotations

from dataclasses import replace

import bpy
import mathutils
import numpy as np
import pytest

from benchmarks.renderer.rasterizer import render
from tests.e2e.inside.clouds import as_blender_imports
from tests.strategies import ply_of

TURN = mathutils.Euler((0.4, -0.7, 1.1)).to_matrix().to_4x4()
NOWHERE = mathutils.Matrix()
SOMEWHERE = mathutils.Matrix.LocRotScale((1.0, -2.0, 0.5), TURN.to_quaternion(), (1.5, 1.5, 1.5))
ELSEWHERE = mathutils.Matrix.LocRotScale(
    (-0.3, 0.2, 0.1), mathutils.Euler((-1.0, 0.2, 0.3)), (-0.7, 0.7, 0.7)
)


@pytest.fixture
def view(room_views):
    """Return one view of the room, a third as large."""
    camera = list(room_views)[11]
    small = {name: getattr(camera, name) / 3 for name in ("fx", "fy", "cx", "cy")}
    return replace(camera, **small, width=camera.width // 3, height=camera.height // 3)


@pytest.fixture
def imported(addon, quarter_file):
    """Import every fourth splat of the room: 9,939."""
    bpy.ops.refine.import_ply(filepath=str(quarter_file))
    return bpy.context.object


@pytest.fixture
def seen(addon, view):
    """Return a function that draws all splats of the scene as they stand in the world."""

    def seen(within=NOWHERE):
        bpy.context.view_layer.update()
        check, objects = addon.mesh.layout.check, addon.objects
        parts = [
            addon.core.affine.transformed(
                objects.splat_group.gather([check(obj)], whole=True),
                np.linalg.inv(np.array(within, np.float64)),
            )
            for obj in bpy.context.scene.objects
            if addon.mesh.layout.looks_like_splats(obj)
        ]
        return render(addon.core.splats.joined(parts), view).clip(0.0, 1.0)

    return seen


def psnr(one, other):
    """Return how alike two pictures are, in dB; 99 where they are the same."""
    error = np.mean((one - other) ** 2)
    return float(-10.0 * np.log10(error)) if error > 1e-9 else 99.0


def told_of(addon, obj):
    """Return what the panel says that others did to an object's splats."""
    drift = addon.ui.transforms.of(obj)
    return drift.told if drift else []


def select(*objects):
    bpy.ops.object.select_all(action="DESELECT")
    for obj in objects:
        obj.select_set(True)
    bpy.context.view_layer.objects.active = objects[0]


def in_edit_mode(obj, which, turn):
    """Select some vertices and turn them about the cursor, as R does in edit mode."""
    obj.data.vertices.foreach_set("select", which)
    select(obj)
    bpy.ops.object.mode_set(mode="EDIT")
    turn()
    bpy.ops.object.mode_set(mode="OBJECT")


def test_an_import_notes_where_its_splats_are_and_finds_nothing(addon, imported):
    """Nothing was done to them; an export does not write the notes."""
    assert addon.mesh.drift.is_stamped(imported.data)
    assert addon.mesh.drift.found(imported.data) is None
    names = {column.name for column in addon.mesh.layout.check(imported).layout.columns}
    assert not any(name.startswith("refine") for name in names)


def test_apply_of_blender_is_named_and_mended_by_one_click(addon, imported, seen):
    """Turned, scaled by 1.5 and moved, then Ctrl+A: a blur, and after the click as before."""
    imported.matrix_world = SOMEWHERE
    before = seen(SOMEWHERE)
    bpy.ops.object.transform_apply()
    assert psnr(seen(SOMEWHERE), before) < 30.0

    (sentence,) = told_of(addon, imported)
    assert "9,939 splats were transformed without their sizes, rotations and colours" in sentence
    assert bpy.ops.refine.mend() == {"FINISHED"}

    assert psnr(seen(SOMEWHERE), before) > 60.0
    assert told_of(addon, imported) == []


@pytest.mark.parametrize("location", [True, False])
def test_bake_transform_keeps_what_is_seen_and_where_children_are(addon, imported, seen, location):
    """Turned, scaled and moved below a parent that is, too; a mirror makes it harder."""
    parent = bpy.data.objects.new("parent", None)
    child = bpy.data.objects.new("child", None)
    for obj in (parent, child):
        bpy.context.scene.collection.objects.link(obj)
    parent.matrix_world = ELSEWHERE
    imported.parent, child.parent = parent, imported
    imported.matrix_basis = SOMEWHERE
    child.location = (1.0, 2.0, 3.0)
    within = ELSEWHERE @ SOMEWHERE
    before = seen(within)
    place = child.matrix_world.copy()

    assert bpy.ops.refine.bake_transform(location=location) == {"FINISHED"}

    expected = mathutils.Matrix() if location else mathutils.Matrix.Translation((1.0, -2.0, 0.5))
    np.testing.assert_allclose(imported.matrix_basis, expected, atol=1e-6)
    np.testing.assert_allclose(child.matrix_world, place, atol=1e-5)
    assert psnr(seen(within), before) > 60.0
    assert addon.mesh.drift.found(imported.data) is None


def test_an_uneven_scale_is_baked_as_near_as_harmonics_come(addon, imported, seen, view):
    """Shapes as M covariance M'; colours are those that the 3D view draws, in M's frame."""
    imported.scale = (1.0, 1.2, 1.0)
    checked = addon.mesh.layout.check(imported)
    shapes = addon.objects.splat_group.gather([checked])
    arrays = addon.viewport.arrays
    packed = arrays.pack(addon.mesh.attributes.splats_from_object(checked))
    colors = arrays.colors(packed, arrays.Eye(None, view.center / [1.0, 1.2, 1.0], True))
    dc = np.zeros((len(shapes), 3))
    dc[packed.vertices] = (colors[:, :3] - 0.5) / addon.core.splats.SH_C0
    drawn = replace(shapes, sh_dc=dc, sh_rest=np.zeros((len(shapes), 0, 3)))
    before = render(drawn, view).clip(0.0, 1.0)

    assert addon.objects.splat_group.export_notes(checked) == []
    notes = addon.objects.splat_group.export_notes(checked, apply_transform=True)
    (note,) = addon.objects.transforms.bake([checked])

    assert notes == [note]
    assert note.endswith("became the nearest")
    assert psnr(seen(), before) > 48.0
    got = addon.objects.splat_group.gather([addon.mesh.layout.check(imported)])
    np.testing.assert_allclose(got.means, shapes.means, rtol=1e-6)
    covariances = [arrays.pack(splats).covariances for splats in (got, shapes)]
    np.testing.assert_allclose(*covariances, rtol=1e-4, atol=2e-7)


def test_scores_hold_when_a_transform_is_baked(addon, imported, room_cameras):
    """The splats are where they were; the panel asks for no new scores."""
    imported.matrix_world = SOMEWHERE
    bpy.context.view_layer.update()
    select(imported)
    bpy.ops.refine.score()

    bpy.ops.refine.bake_transform()

    bpy.context.view_layer.update()
    assert addon.ui.plans.stale(bpy.context, imported) == []


@pytest.mark.parametrize("what", ["shared", "animated", "shape keys"])
def test_a_bake_that_is_refused_changes_nothing(imported, unchanged, what):
    """Another user of the data would move; an animation would move the splats on."""
    imported.matrix_world = SOMEWHERE
    if what == "shared":
        bpy.context.scene.collection.objects.link(imported.copy())
    elif what == "animated":
        imported.keyframe_insert("location")
    else:
        imported.shape_key_add()
    bpy.context.view_layer.update()
    unchanged.start()

    with pytest.raises(RuntimeError, match=r"share their data|is animated|has shape keys"):
        bpy.ops.refine.bake_transform()

    unchanged()


def parted(imported):
    """Return a copy of an object, with data of its own."""
    half = imported.copy()
    half.data = imported.data.copy()
    bpy.context.scene.collection.objects.link(half)
    return half


def file_of(addon, make_splats, path, count, degree, **more):
    """Write random splats with further properties."""
    columns = make_splats(count, degree=degree, seed=count) | more
    path.write_bytes(ply_of(columns, comments=[f"of {path.name}"]))
    bpy.ops.refine.import_ply(filepath=str(path))
    return bpy.context.object, addon.core.read_ply(path)


@pytest.mark.parametrize("degrees", [(3, 3), (1, 3), (3, 1)])
def test_join_of_blender_is_named_and_mended(addon, make_splats, tmp_path, degrees):
    """Ctrl+J of turned objects: harmonics of another degree are sorted out as well."""
    one, two = (
        file_of(addon, make_splats, tmp_path / f"{count}.ply", count, degree)[0]
        for count, degree in zip((300, 200), degrees, strict=True)
    )
    one.matrix_world, two.matrix_world = SOMEWHERE, ELSEWHERE
    bpy.context.view_layer.update()
    gather, check = addon.objects.splat_group.gather, addon.mesh.layout.check
    expected = gather([check(one), check(two)], whole=True)
    select(one, two)
    bpy.ops.object.join()
    told = told_of(addon, one)

    assert bpy.ops.refine.mend() == {"FINISHED"}

    assert "200 splats were joined without their sizes, rotations and colours" in told[0]
    assert ("another SH degree" in " ".join(told)) == (degrees[0] != degrees[1])
    got = gather([check(one)], whole=True)
    np.testing.assert_allclose(got.means, expected.means, rtol=1e-4, atol=1e-5)
    pack = addon.viewport.arrays.pack
    np.testing.assert_allclose(
        pack(got).covariances, pack(expected).covariances, rtol=1e-3, atol=1e-5
    )
    np.testing.assert_allclose(got.sh_rest, expected.sh_rest, atol=1e-4)
    assert told_of(addon, one) == []


def test_a_turn_in_edit_mode_is_mended_and_a_move_is_not_mentioned(addon, imported, seen):
    """A third is turned about the cursor: sizes and rotations follow by the click alone."""
    which = np.arange(9939) % 3 == 0
    in_edit_mode(imported, which, lambda: bpy.ops.transform.translate(value=(0.5, 0.0, 0.0)))
    assert told_of(addon, imported) == []
    in_edit_mode(imported, which, lambda: bpy.ops.transform.translate(value=(-0.5, 0.0, 0.0)))
    splats = addon.objects.splat_group.gather([addon.mesh.layout.check(imported)], whole=True)
    turned = addon.core.affine.transformed(splats.take(which), np.array(SOMEWHERE))
    expected = addon.core.splats.joined([turned, splats.take(~which)])

    places = np.array(splats.means, np.float32)
    places[which] = turned.means
    imported.data.attributes["position"].data.foreach_set("vector", places.ravel())
    imported.data.update()
    told = told_of(addon, imported)
    bpy.ops.refine.mend()

    assert "3,313 splats were transformed" in told[0]
    got = addon.objects.splat_group.gather([addon.mesh.layout.check(imported)], whole=True)
    order = np.concatenate([np.flatnonzero(which), np.flatnonzero(~which)])
    for field in addon.core.splats.ARRAYS:
        np.testing.assert_allclose(
            np.abs(getattr(got, field)[order]), np.abs(getattr(expected, field)),
            rtol=1e-3, atol=1e-3,
        )  # fmt: skip
    assert seen().shape


def test_an_applied_mirror_is_mended(addon, imported, seen):
    """The mirrored half is that of an object that was mirrored as a whole, which is drawn so."""
    twin = parted(imported)
    twin.matrix_world = mathutils.Matrix.Diagonal((-1.0, 1.0, 1.0, 1.0))
    expected = seen()
    bpy.data.objects.remove(twin)
    modifier = imported.modifiers.new("Mirror", "MIRROR")
    modifier.use_mirror_merge = False
    select(imported)
    bpy.ops.object.modifier_apply(modifier="Mirror")
    (told,) = told_of(addon, imported)

    bpy.ops.refine.mend()

    assert "9,939 splats were mirrored" in told
    assert len(imported.data.vertices) == 2 * 9939
    assert psnr(seen(), expected) > 60.0


@pytest.mark.parametrize("turned", [False, True])
def test_a_mirror_that_merges_in_the_middle_of_the_scene_is_mended(addon, imported, seen, turned):
    """Blender's default *Merge* puts what is near the mirror into it; these splats stay."""
    middle = float(np.median(addon.mesh.attributes.read_attribute(imported.data, "position")[:, 0]))
    for vertex in imported.data.vertices:
        vertex.co.x -= middle
    addon.mesh.drift.stamp(imported.data)
    twin = parted(imported)
    twin.matrix_world = mathutils.Matrix.Diagonal((-1.0, 1.0, 1.0, 1.0))
    expected = seen()
    bpy.data.objects.remove(twin)
    modifier = imported.modifiers.new("Mirror", "MIRROR")
    modifier.merge_threshold = 0.005  # of .001, for a fourth of the splats
    if turned:  # a plane that is none of the axes' own
        modifier.mirror_object = bpy.data.objects.new("plane", None)
        modifier.mirror_object.rotation_euler = (0.0, 0.0, 1e-3)
        bpy.context.scene.collection.objects.link(modifier.mirror_object)
    select(imported)
    bpy.ops.object.modifier_apply(modifier="Mirror")
    merged = 2 * 9939 - len(imported.data.vertices)
    (told,) = told_of(addon, imported)

    assert bpy.ops.refine.mend() == {"FINISHED"}

    assert merged >= 6
    assert "splats were mirrored" in told
    assert psnr(seen(), expected) > 40.0
    assert told_of(addon, imported) == []


@pytest.mark.parametrize(("share", "said"), [(0.005, False), (0.5, True)])
def test_splats_that_are_bent_are_named_and_a_few_that_are_moved_are_not(
    addon, imported, share, said
):
    """No map explains them; the click takes them as they are."""
    places = addon.mesh.attributes.read_attribute(imported.data, "position")
    which = np.arange(len(places)) < share * len(places)
    places[which] += np.sin(7.0 * places[which][:, ::-1])
    imported.data.attributes["position"].data.foreach_set("vector", places.ravel())
    imported.data.update()
    before = addon.mesh.attributes.digest(addon.mesh.layout.check(imported))

    told = told_of(addon, imported)

    expected = [f"{which.sum():,} splats were moved each by itself"] if said else []
    assert [sentence.partition(", as by")[0] for sentence in told] == expected
    bpy.ops.refine.mend()
    assert told_of(addon, imported) == []
    assert addon.mesh.attributes.digest(addon.mesh.layout.check(imported)) == before


def test_splats_of_another_importer_are_noted_as_soon_as_they_are_seen(addon, room):
    """So what is done to them later is noticed; what only looks like splats is left alone."""
    other = bpy.data.meshes.new("other")
    other.vertices.add(3)
    for name in ("opacity", "f_dc_0"):
        other.attributes.new(name, "FLOAT", "POINT")
    bpy.context.scene.collection.objects.link(bpy.data.objects.new("other", other))
    assert not addon.mesh.drift.is_stamped(room.data)

    addon.ui.transforms._note()

    assert addon.mesh.drift.is_stamped(room.data)
    assert addon.mesh.drift.found(room.data) is None
    assert not addon.mesh.drift.is_stamped(other)


def test_who_turns_sizes_and_rotations_as_well_is_left_alone(addon, imported):
    """Another add-on that transforms all of a splat did it right; nothing is to be mended."""
    checked = addon.mesh.layout.check(imported)
    splats = addon.objects.splat_group.gather([checked], whole=True)
    turned = addon.core.affine.transformed(splats, np.array(SOMEWHERE))
    values = addon.core.formats.ply_columns.values_by_name(turned)
    columns = {name: column.astype(np.float32) for name, column in values.items()}
    addon.mesh.attributes.write_columns(checked, columns)

    assert told_of(addon, imported) == []


def test_merging_is_no_drift(addon, imported, room_cameras):
    """Splats move and grow together."""
    select(imported)
    bpy.context.scene.refine.method = "merge"
    bpy.ops.refine.score()
    bpy.ops.refine.apply()
    assert addon.mesh.drift.found(imported.data) is None


def test_a_point_cloud_is_mended(addon, quarter_file, seen):
    """Blender's own splats, turned, scaled and moved, then Ctrl+A."""
    cloud = as_blender_imports(addon.core.read_ply(quarter_file).rows)
    addon.mesh.drift.stamp(cloud.data)
    cloud.matrix_world = SOMEWHERE
    before = seen(SOMEWHERE)
    bpy.ops.object.transform_apply()

    assert bpy.ops.refine.mend() == {"FINISHED"}

    assert psnr(seen(SOMEWHERE), before) > 55.0
    assert told_of(addon, cloud) == []


def test_score_apply_and_export_say_what_was_done(
    addon,
    imported,
    room_cameras,
    room_views,
    tmp_path,
    capfd,
):
    """None of them is silent about splats that Ctrl+A ruined; nor is the command."""
    imported.matrix_world = SOMEWHERE
    bpy.context.view_layer.update()
    select(imported)
    bpy.ops.object.transform_apply()
    for operator, options in (
        (bpy.ops.refine.score, {}),
        (bpy.ops.refine.apply, {}),
        (bpy.ops.refine.export_ply, {"filepath": str(tmp_path / "out.ply")}),
    ):
        capfd.readouterr()
        assert operator(**options) == {"FINISHED"}
        said = capfd.readouterr()
        assert "splats were transformed without" in said.out + said.err
    core = addon.core
    report = addon.objects.splat_group.prune_object(
        imported.name, room_views, core.Budget(ratio=0.5), core.ClosedForm(), dry_run=True
    )

    assert "Mend Splats in the panel" in " ".join(report["notes"])


def test_vertices_that_are_no_splats_are_named(addon, imported):
    """A cube of 8 vertices in the room: nothing mends that but undo."""
    bpy.ops.mesh.primitive_cube_add()
    cube = bpy.context.object
    select(imported, cube)
    bpy.ops.object.join()

    (told,) = told_of(addon, imported)

    assert "8 vertices that are no splats" in told
    assert not addon.ui.transforms.of(imported).mendable
