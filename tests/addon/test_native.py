"""Blender's own splats: point clouds with activated values, as Blender 5.3 imports 3DGS files."""

import bpy
import mathutils
import numpy as np
import pytest

from tests.e2e.inside.clouds import FOUR, as_blender_imports, point_cloud, store
from tests.strategies import ply_of

from .conftest import export, keep_mask, read

COUNT = 9_939


def assert_alike(core, got, expected, tolerance=1e-6):
    """Compare activated values: scales and opacities relative to their size."""

    def unit(splats):
        q = core.splats.unit_quaternions(splats.quaternions)
        return q * np.sign(q[np.arange(len(q)), np.abs(q).argmax(axis=1)])[:, None]

    for value in (
        lambda splats: core.splats.scales(splats.log_scales),
        lambda splats: core.splats.opacity(splats.opacity_logits),
    ):
        np.testing.assert_allclose(value(got), value(expected), rtol=tolerance)
    np.testing.assert_allclose(unit(got), unit(expected), rtol=0, atol=tolerance)
    for name in ("means", "sh_dc", "sh_rest"):
        pair = [getattr(splats, name) for splats in (got, expected)]
        np.testing.assert_allclose(*pair, rtol=0, atol=tolerance if tolerance > 1e-6 else 0)


@pytest.fixture
def file(addon, quarter_file):
    return addon.core.read_ply(quarter_file)


@pytest.fixture
def cloud(file, empty_scene):
    """Return every fourth splat of the room as Blender 5.3 would have imported them."""
    return as_blender_imports(file.rows, "room")


@pytest.fixture
def exported(addon, tmp_path):
    """Return a function that reads what an export of an object writes."""

    def exported(obj, **options):
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.ply"
        export(addon, addon.mesh.layout.check(obj), path, **options)
        return addon.core.read_ply(path)

    return exported


def contents(addon, obj):
    """Return all that an object's data holds, to the bit, and where the object stands."""
    names = [a.name for a in obj.data.attributes if a.name[0] != "."]
    facts = {name: read(addon, obj, name).tobytes() for name in names}
    facts |= {key: str(value) for key, value in obj.data.items()}
    return facts | {"matrix": [list(row) for row in obj.matrix_world], "type": obj.type}


def test_an_import_of_blenders_exports_the_splats_of_the_file(addon, core, file, cloud, exported):
    """Blender's float32 formulas are off by a few roundings of 6e-8; what it copies is equal."""
    got, expected = exported(cloud), file.splats()
    assert_alike(core, got.splats(), expected)
    assert got.size() == addon.mesh.layout.layout_of(cloud).file_bytes(len(expected))

    turn = mathutils.Quaternion((1.0, 2.0, 3.0), 0.8)
    cloud.matrix_world = mathutils.Matrix.LocRotScale((1.0, 2.0, 3.0), turn, (2.0, 2.0, 2.0))
    bpy.context.view_layer.update()
    moved = core.affine.transformed(expected, np.array(cloud.matrix_world, np.float64))
    assert_alike(core, exported(cloud, apply_transform=True).splats(), moved, 5e-6)
    assert np.abs(moved.sh_rest - expected.sh_rest).max() > 0.1


@pytest.mark.parametrize("degree", [0, 1, 3, 4])
def test_extreme_values_come_back(addon, core, make_splats, tmp_path, exported, degree):
    """Opacities next to 0 and 1, scales from 1e-37 to 1e37; ``sh_10`` comes after ``sh_9``."""
    columns = make_splats(count=400, degree=degree)
    ramp = np.linspace(-85.0, 85.0, 400).astype(np.float32)
    columns |= {"opacity": ramp, "scale_0": ramp, "scale_1": -ramp}
    columns["rot_1"] *= np.float32(1e6)
    (tmp_path / "in.ply").write_bytes(ply_of(columns))
    file = core.read_ply(tmp_path / "in.ply")
    obj = as_blender_imports(file.rows)
    checked = addon.mesh.layout.check(obj)
    splats = addon.mesh.attributes.splats_from_object(checked)
    values = core.formats.ply_columns.values_by_name(splats)
    addon.mesh.attributes.write_columns(obj.data, checked.layout, values)
    assert addon.mesh.layout.sh_degree(obj.data) == degree
    assert_alike(core, exported(obj).splats(), file.splats())


def test_what_blender_can_store_and_no_file_says_is_stated(addon, cloud):
    """Opacities 0 and 1 have logits -104 and 18.02, a scale of 0 the logarithm -104, as float32."""
    addon.mesh.edit.delete_vertices(cloud, np.arange(COUNT) >= 4)
    store(cloud, "radiance:base", FOUR, np.float32([[0, 0, 0, a] for a in (0, 1, 0.5, np.nan)]))
    store(cloud, "scale", "FLOAT_VECTOR", np.float32([[0, 1, -1]] * 4))
    splats = addon.mesh.attributes.splats_from_object(addon.mesh.layout.check(cloud))
    logits = np.float32([-104.0, np.log(2.0**26 - 1.0), 0.0, np.nan])
    assert np.array_equal(splats.opacity_logits, logits, equal_nan=True)
    assert splats.log_scales.tolist() == [[-104.0, 0.0, 0.0]] * 4


def test_a_point_cloud_is_scored_like_the_file_it_exports_and_pruned(
    addon, core, cloud, room_cameras, room_views, exported
):
    """9939 - floor(.75 x 9939) = 2485 points of the highest rank stay, to the bit, and all else."""
    cloud.data["note"] = "mine"
    expected = core.score(exported(cloud).splats(), room_views, core.ClosedForm())
    bpy.ops.refine.score()
    got = addon.mesh.scores.stored_scores([addon.mesh.layout.check(cloud)])
    assert np.allclose(got.values, expected.values, rtol=1e-3)  # Blender's cameras are float32
    assert np.array_equal(got.seen, expected.seen)

    bpy.context.scene.refine.ratio = 0.75
    stay = np.sort(np.argsort(read(addon, cloud, "refine_rank"))[-2485:])
    before, bases = contents(addon, cloud), read(addon, cloud, "radiance:base")
    bpy.ops.refine.apply()
    after = contents(addon, cloud)
    assert after["radiance:base"] == bases[stay].tobytes()
    assert before.keys() - after.keys() <= {"refine_scores", "refine_remove"}  # as of a mesh
    assert (after["note"], after["matrix"]) == ("mine", before["matrix"])


def test_a_protected_splat_of_a_point_cloud_stays(addon, core, cloud, room_cameras):
    """By a boolean attribute, and by a float one where it is above 0; there are no groups."""
    bpy.ops.refine.score()
    ranks, budget = read(addon, cloud, "refine_rank"), core.Budget(ratio=0.5)
    mark = np.arange(COUNT) == np.argmin(ranks)
    assert not keep_mask(addon, cloud, budget)[mark]
    for name, kind, dtype in (("sure", "BOOLEAN", np.bool_), ("weight", "FLOAT", np.float32)):
        store(cloud, name, kind, mark.astype(dtype))
        assert keep_mask(addon, cloud, budget, name)[mark]
    store(cloud, "number", "INT", mark.astype(np.int32))
    with pytest.raises(core.RefineError, match=r"'number' is INT on POINT.*has no vertex groups"):
        keep_mask(addon, cloud, budget, "number")


@pytest.mark.usefixtures("room_cameras")
def test_merging_changes_what_others_are_merged_into(addon, cloud):
    """The rest is equal to the bit, though logarithms are taken and undone."""
    addon.mesh.edit.delete_vertices(cloud, np.arange(COUNT) % 3 != 0)
    settings = bpy.context.scene.refine
    settings.method, settings.ratio, settings.views = "merge", 0.6, 8
    store(cloud, "number", "INT", np.arange(3313, dtype=np.int32))
    bpy.ops.refine.score()
    names = ("position", "scale", "rotation", "radiance:base", "radiance:sh_0", "radiance:sh_14")
    before = {name: read(addon, cloud, name) for name in names}
    bpy.ops.refine.apply()
    rows = read(addon, cloud, "number")
    changed = np.zeros(len(rows), np.bool_)
    for name in names:
        changed |= (read(addon, cloud, name) != before[name][rows]).any(axis=1)
    assert len(rows) == 3313 - 3313 * 3 // 5
    assert 100 < np.count_nonzero(changed) < len(rows) - 100
    turns = read(addon, cloud, "rotation").astype(np.float64)
    assert np.abs(np.linalg.norm(turns, axis=1) - 1.0).max() < 3e-7


def test_the_selected_splats_or_all_are_graded_in_both_kinds_of_objects(
    addon, core, cloud, quarter, exported
):
    """The others stay to the bit; of none selected all become black, which is -0.5 / C0."""
    harmonics, first = core.spherical_harmonics, np.arange(COUNT) < 100
    matrix = harmonics.grading(1.0, (1.0, 0.5, 0.25), 0.5)
    for obj in (cloud, quarter):
        bpy.context.view_layer.objects.active = obj
        before = exported(obj).splats()
        addon.mesh.selection.select(obj, first)
        bpy.ops.refine.grade(exposure=1.0, tint=(1.0, 0.5, 0.25), saturation=0.5)
        got, graded = (
            exported(obj).splats(),
            harmonics.recolored(before.sh_dc, before.sh_rest, matrix),
        )
        for name, new in zip(("sh_dc", "sh_rest"), graded, strict=True):
            np.testing.assert_array_equal(getattr(got, name)[first], new[first])
            np.testing.assert_array_equal(getattr(got, name)[~first], getattr(before, name)[~first])
        np.testing.assert_array_equal(got.opacity_logits, before.opacity_logits)

        addon.mesh.selection.select(obj, first & ~first)
        bpy.ops.refine.grade(tint=(0.0, 0.0, 0.0))
        black = exported(obj).splats()
        np.testing.assert_allclose(black.sh_dc, -0.5 / core.splats.SH_C0, rtol=1e-6)
        assert not black.sh_rest.any()


def test_point_clouds_that_are_no_splats_are_refused_in_a_sentence(addon, core):
    """Plain points; what an old Blender left of 5.3's; harmonics of no degree; a wrong type."""
    base, scale = ("radiance:base", FOUR, 4), ("scale", "FLOAT_VECTOR", 3)
    turn = ("rotation", "QUATERNION", 4)
    harmonics = [(f"radiance:sh_{index}", "FLOAT_VECTOR", 3) for index in range(4)]
    looks = addon.mesh.layout.looks_like_splats
    for attributes, sentence, alike in (
        ([], r"no attribute f_dc_0.*or Blender's own radiance:base, scale, rotation on", False),
        ([scale, turn], "no attribute radiance:base, which holds .*: Blender 5.0 and", False),
        (
            [base, scale, turn, *harmonics],
            "4 attributes radiance:sh_.*, expected 0, 3, 8, 15",
            True,
        ),
        ([base, scale], "'cloud': has no attribute rotation", None),
        ([base, scale, ("rotation", "FLOAT_VECTOR", 3)], "is FLOAT_VECTOR .*expected QUAT", None),
    ):
        obj = point_cloud(3)
        for name, kind, width in attributes:
            store(obj, name, kind, np.ones((3, width), np.float32))
        with pytest.raises(core.RefineError, match=sentence):
            addon.mesh.layout.check(obj)
        assert alike in (None, looks(obj))
        bpy.data.objects.remove(obj)


def test_points_with_the_names_of_a_file_are_splats(addon, quarter, quarter_file, exported):
    """What geometry nodes make of a splat mesh: a file's values on points, byte for byte."""
    obj = point_cloud(COUNT, "points")
    for attribute in quarter.data.attributes:
        if attribute.name[0] != ".":
            name, kind = attribute.name, attribute.data_type
            values = read(addon, quarter, name)
            addon.mesh.attributes.write_attribute(obj.data, name, kind, values)
    obj.data["refine_layout"] = quarter.data["refine_layout"]
    assert exported(obj).path.read_bytes() == quarter_file.read_bytes()
