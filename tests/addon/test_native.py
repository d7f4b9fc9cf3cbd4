"""Blender's own splats: point clouds with activated values, as Blender 5.3 imports 3DGS files."""

from __future__ import annotations

from pathlib import Path

import bpy
import mathutils
import numpy as np
import pytest

from tests.e2e.inside.clouds import FOUR, as_blender_imports, point_cloud, store
from tests.strategies import ply_of

from .conftest import export, keep_mask

ROOM = Path(__file__).parents[1] / "data" / "room_small"


def differences(core, got, expected):
    """Return the largest difference of each activated value, relative to its size."""
    splats = core.splats

    def unit(q):
        q = splats.unit_quaternions(q)
        return q * np.sign(q[np.arange(len(q)), np.abs(q).argmax(axis=1)])[:, None]

    def apart(a, b):
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        return np.abs(a - b).max(initial=0.0, where=b != a) if b.size else 0.0

    def relative(a, b):
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        return apart(a / b, np.ones_like(b))

    return {
        "means": apart(got.means, expected.means),
        "harmonics": apart(got.sh_rest, expected.sh_rest) + apart(got.sh_dc, expected.sh_dc),
        "scales": relative(splats.scales(got.log_scales), splats.scales(expected.log_scales)),
        "opacity": relative(
            splats.opacity(got.opacity_logits), splats.opacity(expected.opacity_logits)
        ),
        "rotation": apart(unit(got.quaternions), unit(expected.quaternions)),
    }


@pytest.fixture
def file(addon):
    """Return the small trained room's file."""
    return addon.core.read_ply(ROOM / "point_cloud.ply")


@pytest.fixture
def cloud(file, empty_scene):
    """Return the room as Blender 5.3 would have imported it."""
    return as_blender_imports(file.rows, "room")


def contents(addon, obj):
    """Return all that an object's data holds, to the bit, and where the object stands."""
    facts = {
        a.name: addon.mesh.attributes.read_attribute(obj.data, a.name).tobytes()
        for a in obj.data.attributes
        if a.name[0] != "."
    }
    facts |= {key: str(value) for key, value in obj.data.items()}
    return facts | {"matrix": [list(row) for row in obj.matrix_world], "type": obj.type}


def test_an_import_of_blenders_exports_the_splats_of_the_file(addon, core, file, cloud, tmp_path):
    """Blender's float32 formulas are off by a few roundings of 6e-8; what it copies is equal."""
    export(addon, addon.mesh.layout.check(cloud), tmp_path / "out.ply")
    found = differences(core, core.read_ply(tmp_path / "out.ply").splats(), file.splats())

    assert found["means"] == found["harmonics"] == 0.0
    assert max(found["scales"], found["opacity"], found["rotation"]) < 1e-6
    size = addon.mesh.layout.export_bytes(cloud)  # what the panel says
    assert (tmp_path / "out.ply").stat().st_size == size


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_harmonics_are_counted_by_numbers_not_by_letters(addon, make_splats, tmp_path, degree):
    """``sh_10`` comes after ``sh_9``: each channel has its coefficients where the file has them."""
    columns = make_splats(degree=degree)
    (tmp_path / "in.ply").write_bytes(ply_of(columns))
    rows = addon.core.read_ply(tmp_path / "in.ply").rows
    obj = as_blender_imports(rows)
    export(addon, addon.mesh.layout.check(obj), tmp_path / "out.ply")
    got = addon.core.read_ply(tmp_path / "out.ply").rows

    assert addon.mesh.layout.sh_degree(obj.data) == degree
    for name in rows.dtype.names:
        if name.startswith("f_"):
            assert np.array_equal(got[name], rows[name]), name


def test_what_blender_can_store_and_no_file_says_is_stated(addon, make_splats, tmp_path):
    """Opacities 0 and 1 have logits -104 and 18.02, a scale of 0 the logarithm -104, as float32.

    A negative scale is the same ellipsoid as a positive one; NaN stays.
    """
    (tmp_path / "in.ply").write_bytes(ply_of(make_splats(count=4)))
    obj = as_blender_imports(addon.core.read_ply(tmp_path / "in.ply").rows)
    store(obj, "radiance:base", FOUR, np.float32([[0, 0, 0, a] for a in (0, 1, 0.5, np.nan)]))
    store(obj, "scale", "FLOAT_VECTOR", np.float32([[0, 1, -1]] * 4))
    splats = addon.mesh.attributes.splats_from_object(addon.mesh.layout.check(obj))

    logits = [-104.0, np.float32(np.log(2.0**26 - 1.0)), 0.0, np.nan]
    assert np.array_equal(splats.opacity_logits, np.float32(logits), equal_nan=True)
    assert splats.log_scales.tolist() == [[-104.0, 0.0, 0.0]] * 4


def test_a_point_cloud_is_scored_like_the_file_it_exports(addon, core, cloud, room_cameras,
                                                          room_views, tmp_path):  # fmt: skip
    """Logarithms and logits are rounded to float32 before scoring, as they are in the file."""
    export(addon, addon.mesh.layout.check(cloud), tmp_path / "out.ply")
    expected = core.score(
        core.read_ply(tmp_path / "out.ply").splats(), room_views, addon.core.ClosedForm()
    )
    bpy.ops.refine.score()
    got = addon.mesh.scores.stored_scores([addon.mesh.layout.check(cloud)])

    # Blender's cameras are float32.
    assert np.allclose(got.values, expected.values, rtol=1e-3)
    assert np.array_equal(got.seen, expected.seen)
    assert room_cameras.objects


def test_apply_deletes_points_and_leaves_all_else(addon, cloud, room_cameras):
    """39755 - floor(.75 x 39755) = 9939 points, those of the highest rank, to the bit."""
    cloud.location = (1.0, 2.0, 3.0)
    cloud.data["note"] = "mine"
    bpy.ops.refine.score()
    bpy.context.scene.refine.ratio = 0.75
    ranks = addon.mesh.attributes.read_attribute(cloud.data, "refine_rank")
    stay = np.sort(np.argsort(ranks)[-9939:])
    before = contents(addon, cloud)
    bases = addon.mesh.attributes.read_attribute(cloud.data, "radiance:base")
    bpy.ops.refine.apply()
    after = contents(addon, cloud)

    assert len(cloud.data.points) == 9939
    assert after["radiance:base"] == bases[stay].tobytes()
    gone = {"refine_scores", "refine_remove"}  # as of a mesh
    assert before.keys() - after.keys() <= gone
    assert after["note"] == "mine"
    assert tuple(cloud.location) == (1.0, 2.0, 3.0)


def test_a_protected_splat_of_a_point_cloud_stays(addon, core, cloud, room_cameras):
    """By a boolean attribute, and by a float one where it is above 0; there are no groups."""
    bpy.ops.refine.score()
    ranks = addon.mesh.attributes.read_attribute(cloud.data, "refine_rank")
    lowest = np.argmin(ranks)
    mark = np.arange(len(ranks)) == lowest
    store(cloud, "sure", "BOOLEAN", mark)
    store(cloud, "weight", "FLOAT", mark.astype(np.float32))
    store(cloud, "number", "INT", mark.astype(np.int32))
    budget = core.Budget(ratio=0.5)
    keep = [keep_mask(addon, cloud, budget, name) for name in ("", "sure", "weight")]

    assert [bool(mask[lowest]) for mask in keep] == [False, True, True]
    with pytest.raises(core.RefineError, match=r"'number' is INT on POINT.*has no vertex groups"):
        keep_mask(addon, cloud, budget, "number")


def test_merging_changes_what_others_are_merged_into(addon, cloud, room_cameras):
    """The rest is equal to the bit, though logarithms are taken and undone."""
    addon.mesh.edit.delete_vertices(cloud, np.arange(len(cloud.data.points)) % 10 != 0)
    settings = bpy.context.scene.refine
    settings.method, settings.ratio, settings.views = "merge", 0.6, 4
    store(cloud, "number", "INT", np.arange(len(cloud.data.points), dtype=np.int32))
    bpy.ops.refine.score()
    read = addon.mesh.attributes.read_attribute
    names = ("position", "scale", "rotation", "radiance:base", "radiance:sh_0", "radiance:sh_14")
    before = {name: read(cloud.data, name) for name in names}
    bpy.ops.refine.apply()
    rows = read(cloud.data, "number")
    changed = np.zeros(len(rows), np.bool_)
    for name in names:
        changed |= (read(cloud.data, name) != before[name][rows]).any(axis=1)

    assert len(rows) == 3976 - 3976 * 3 // 5
    assert 100 < np.count_nonzero(changed) < len(rows) - 100
    turns = read(cloud.data, "rotation").astype(np.float64)
    assert np.abs(np.linalg.norm(turns, axis=1) - 1.0).max() < 3e-7


def test_an_apply_that_fails_leaves_the_point_cloud_as_it_was(addon, cloud, room_cameras,
                                                              monkeypatch):  # fmt: skip
    """The copy that stood by takes its place, and its name."""
    bpy.ops.refine.score()
    before, name = contents(addon, cloud), cloud.data.name

    def refuse(*_arguments):
        raise addon.core.RefineError("refused")

    monkeypatch.setattr(addon.mesh.attributes, "write_rows", refuse)
    with pytest.raises(RuntimeError, match="refused"):
        bpy.ops.refine.apply()

    assert contents(addon, cloud) == before
    assert [data.name for data in bpy.data.pointclouds] == [name]
    assert room_cameras.objects


def test_undo_brings_points_back_and_a_saved_file_has_them(addon, cloud, room_cameras,
                                                           tmp_path):  # fmt: skip
    """Score, apply, undo: as scored; saved and opened again: the same bits."""
    assert room_cameras.objects
    bpy.ops.refine.score()
    bpy.ops.ed.undo_push(message="scored")
    scored = contents(addon, cloud)
    bpy.ops.refine.apply()
    bpy.ops.ed.undo_push(message="applied")
    bpy.ops.ed.undo()
    undone = contents(addon, bpy.data.objects["room"])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))

    assert undone == scored
    assert contents(addon, bpy.data.objects["room"]) == scored


def test_the_command_prunes_a_point_cloud(addon, cloud, room_cameras, tmp_path):
    """Half of 39755 go: 19878 rows of what an export gives, and as many points in the .blend."""
    assert room_cameras.objects
    export(addon, addon.mesh.layout.check(cloud), tmp_path / "all.ply")
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    words = ["prune", "--object", "room", "-o", str(tmp_path / "out.ply"), "--save", "--quiet"]
    words += ["--method", "occlusion"]

    assert addon.command.main(words, scene=True) == 0
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    every = {row.tobytes() for row in addon.core.read_ply(tmp_path / "all.ply").rows}
    kept = addon.core.read_ply(tmp_path / "out.ply").rows
    assert len(kept) == len(bpy.data.objects["room"].data.points) == 19878
    assert all(row.tobytes() in every for row in kept)


def test_every_format_takes_a_point_cloud(addon, core, cloud, tmp_path):
    """It writes what it writes of the PLY that the point cloud exports."""
    addon.mesh.edit.delete_vertices(cloud, np.arange(len(cloud.data.points)) >= 300)
    checked = addon.mesh.layout.check(cloud)
    for suffix in core.formats.registry.SUFFIXES:
        export(addon, checked, tmp_path / f"panel{suffix}")
        expected = tmp_path / f"core{suffix}"
        core.write_splats(expected, core.read_ply(tmp_path / "panel.ply"))

        assert (tmp_path / f"panel{suffix}").read_bytes() == expected.read_bytes()


def test_an_export_with_the_transform_turns_harmonics(addon, core, cloud, file, tmp_path):
    """As `core.affine.transformed` has it for the file's splats, within Blender's roundings."""
    cloud.matrix_world = (
        mathutils.Matrix.Translation((1.0, 2.0, 3.0))
        @ mathutils.Matrix.Rotation(0.8, 4, (1.0, 2.0, 3.0))
        @ mathutils.Matrix.Scale(2.0, 4)
    )
    bpy.context.view_layer.update()
    export(addon, addon.mesh.layout.check(cloud), tmp_path / "moved.ply", apply_transform=True)
    matrix = np.array(cloud.matrix_world, np.float64)
    expected = core.affine.transformed(file.splats(), matrix)
    found = differences(core, core.read_ply(tmp_path / "moved.ply").splats(), expected)

    assert max(found.values()) < 5e-6
    assert np.abs(expected.sh_rest - file.splats().sh_rest).max() > 0.1


def test_extreme_values_come_back_from_a_point_cloud(addon, core, make_splats, tmp_path):
    """Opacities next to 0 and 1, scales from 1e-37 to 1e37, quaternions of any length."""
    columns = make_splats(count=400)
    ramp = np.linspace(-85.0, 85.0, 400).astype(np.float32)
    columns |= {"opacity": ramp, "scale_0": ramp, "scale_1": -ramp}
    columns["rot_1"] *= np.float32(1e6)
    (tmp_path / "in.ply").write_bytes(ply_of(columns))
    source = core.read_ply(tmp_path / "in.ply")
    cloud = addon.mesh.layout.check(as_blender_imports(source.rows))
    splats = addon.mesh.attributes.splats_from_object(cloud)
    addon.mesh.attributes.write_columns(
        cloud, addon.core.formats.ply_columns.values_by_name(splats)
    )
    export(addon, cloud, tmp_path / "out.ply")
    found = differences(core, core.read_ply(tmp_path / "out.ply").splats(), source.splats())

    assert max(found.values()) < 1e-6


def test_point_clouds_that_are_no_splats_are_refused_in_a_sentence(addon, core):
    """Plain points; what an old Blender left of 5.3's; harmonics of no degree."""
    plain, left, odd = (point_cloud(3, name) for name in ("plain", "left", "odd"))
    for obj in (left, odd):
        store(obj, "scale", "FLOAT_VECTOR", np.ones((3, 3), np.float32))
        store(obj, "rotation", "QUATERNION", np.ones((3, 4), np.float32))
    store(odd, "radiance:base", FOUR, np.ones((3, 4), np.float32))
    for index in (0, 1, 2, 3):
        store(odd, f"radiance:sh_{index}", "FLOAT_VECTOR", np.ones((3, 3), np.float32))
    wrong = {
        plain: r"no attribute f_dc_0.*or Blender's own radiance:base, scale, rotation on its",
        left: "no attribute radiance:base, which holds colour and opacity: Blender 5.0 and",
        odd: "has 4 attributes radiance:sh_.*, expected 0, 3, 8, 15 or 24 of them",
    }
    for obj, sentence in wrong.items():
        with pytest.raises(core.RefineError, match=sentence):
            addon.mesh.layout.check(obj)
    assert [addon.mesh.layout.looks_like_splats(obj) for obj in wrong] == [False, False, True]


def test_a_missing_or_wrong_attribute_of_a_point_cloud_is_named(addon, core, cloud):
    """Name, type found, type expected."""
    cloud.data.attributes.remove(cloud.data.attributes["rotation"])
    with pytest.raises(core.RefineError, match="'room': has no attribute rotation"):
        addon.mesh.layout.check(cloud)

    store(cloud, "rotation", "FLOAT_VECTOR", np.ones((39755, 3), np.float32))
    with pytest.raises(core.RefineError, match="is FLOAT_VECTOR on POINT, expected QUATERNION on"):
        addon.mesh.layout.check(cloud)


def test_a_point_cloud_with_the_names_of_a_file_holds_splats(addon, room, tmp_path):
    """What geometry nodes make of a splat mesh: a file's values on points, byte for byte."""
    obj = point_cloud(len(room.data.vertices), "points")
    for attribute in room.data.attributes:
        if attribute.name[0] != ".":
            values = addon.mesh.attributes.read_attribute(room.data, attribute.name)
            addon.mesh.attributes.write_attribute(
                obj.data, attribute.name, attribute.data_type, values
            )
    obj.data["refine_layout"] = room.data["refine_layout"]
    checked = addon.mesh.layout.check(obj)
    export(addon, checked, tmp_path / "out.ply")

    assert (tmp_path / "out.ply").read_bytes() == (ROOM / "point_cloud.ply").read_bytes()


@pytest.mark.skipif(bpy.app.version < (5, 3), reason="Blender imports splats since 5.3")
def test_blenders_own_import_is_what_these_tests_build(addon, core, file, tmp_path):
    """Same attributes, types and values."""
    bpy.ops.wm.ply_import(filepath=str(ROOM / "point_cloud.ply"), forward_axis="Y", up_axis="Z")
    native, built = bpy.context.object, as_blender_imports(file.rows)
    export(addon, addon.mesh.layout.check(native), tmp_path / "out.ply")
    found = differences(core, core.read_ply(tmp_path / "out.ply").splats(), file.splats())
    kinds = [
        {a.name: (a.data_type, a.domain) for a in o.data.attributes if "radiance" in a.name}
        for o in (native, built)
    ]

    assert native.data.type == "GAUSSIAN_SPLAT"
    assert kinds[0] == kinds[1]
    assert max(found.values()) < 1e-6


@pytest.mark.parametrize("method", ["closed-form", "merge", "refit"])
def test_levels_of_detail_of_native_splats_are_native(addon, cloud, room_cameras, method):
    """Copies reduced by the same apply: points of .1 and .05 of 9,939, rounded up."""
    addon.mesh.edit.delete_vertices(cloud, np.arange(39755) % 4 != 0)
    settings = bpy.context.scene.refine
    settings.levels, settings.method, settings.views = "0.1, 0.05", method, 6

    assert bpy.ops.refine.levels() == {"FINISHED"}

    levels = [bpy.data.objects[f"room_lod{number}"] for number in (1, 2)]
    assert [level.type for level in levels] == ["POINTCLOUD", "POINTCLOUD"]
    assert [len(level.data.points) for level in levels] == [994, 497]
    assert len(cloud.data.points) == 9939
