"""What panel and command share, and what the world's frame does to scores and exports."""

from __future__ import annotations

import math
import threading
from pathlib import Path

import bpy
import mathutils
import numpy as np
import pytest

from tests.strategies import ply_of

from .conftest import export

ROOM = Path(__file__).parents[1] / "data" / "room_small"
PLY = ROOM / "point_cloud.ply"


@pytest.fixture
def scene_file(room, room_cameras, tmp_path):
    """Save the room and its cameras as a .blend."""
    path = tmp_path / "scene.blend"
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return path


def test_the_command_on_an_object_writes_what_it_writes_for_the_file(addon, scene_file, tmp_path):
    """`prune --object` with the scene's cameras, against `prune FILE --cameras`: equal bytes."""
    by_object = ["prune", "--object", "room", "-o", str(tmp_path / "object.ply"), "--quiet"]
    by_file = [
        *("prune", str(PLY), "-o", str(tmp_path / "file.ply"), "--quiet"),
        *("--cameras", str(ROOM / "cameras.json")),
    ]

    assert addon.command.main(by_object, scene=True) == 0
    assert addon.command.main(by_file) == 0
    assert (tmp_path / "object.ply").read_bytes() == (tmp_path / "file.ply").read_bytes()
    assert len(bpy.data.objects["room"].data.vertices) == 39755


def test_save_prunes_the_object_in_the_blend(addon, scene_file):
    """Half of 39755 go, 19878 stay, and are there when the file is opened again."""
    assert addon.command.main(["prune", "--object", "room", "--save", "--quiet"], scene=True) == 0
    bpy.ops.wm.open_mainfile(filepath=str(scene_file))
    mesh = bpy.data.objects["room"].data

    assert len(mesh.vertices) == 19878
    assert "refine_score" in mesh.attributes


def test_a_dry_run_changes_nothing(addon, scene_file, unchanged, tmp_path):
    """Nor does it write."""
    unchanged.start()
    report = addon.objects.splat_group.prune_object(
        "room",
        addon.cameras.CameraChoice("VISIBLE").views(bpy.context),
        addon.core.Budget(keep=1000),
        addon.core.ClosedForm(),
        dry_run=True,
        output=tmp_path / "out.ply",
    )

    assert report["splats"]["kept"] == 1000
    assert report["files"]["input_bytes"] == PLY.stat().st_size
    assert not (tmp_path / "out.ply").exists()
    unchanged()


@pytest.mark.parametrize("options", [{}, {"save": True}])
def test_an_object_that_is_not_there_is_named_with_those_that_are(addon, scene_file, options):
    """The message lists the splat objects of the scene."""
    views = addon.cameras.CameraChoice("VISIBLE").views(bpy.context)
    with pytest.raises(addon.core.RefineError, match=r"no object 'rooom'.*splat objects: room"):
        addon.objects.splat_group.prune_object(
            "rooom", views, addon.core.Budget(ratio=0.5), **options
        )


def test_saving_an_unsaved_scene_is_refused_before_the_work(addon, room, room_cameras):
    """There is no file to save to."""
    views = addon.cameras.CameraChoice("VISIBLE").views(bpy.context)
    with pytest.raises(addon.core.RefineError, match="not saved in a"):
        addon.objects.splat_group.prune_object(
            "room", views, addon.core.Budget(ratio=0.5), save=True
        )
    assert len(room.data.vertices) == 39755


def _ranked(addon, obj, score):
    score(obj, addon.cameras.CameraChoice("VISIBLE").views(bpy.context))
    return addon.mesh.attributes.read_attribute(obj.data, "refine_rank")


def test_moving_splats_and_cameras_together_keeps_the_rows(addon, room, room_cameras, score):
    """Both under one parent, moved, turned and scaled by 3: the default ranks by no unit.

    Blender's matrices are float32, so neighbours in rank may change places: at most a few rows in
    ten thousand change sides of the middle.
    """
    before = _ranked(addon, room, score) < 0.5
    parent = bpy.data.objects.new("parent", None)
    bpy.context.scene.collection.objects.link(parent)
    for obj in (room, *room_cameras.objects):
        obj.parent = parent
    for camera in room_cameras.objects:  # a frustum's clip distances do not scale with a parent
        camera.data.clip_start, camera.data.clip_end = 1e-4, 1e6
    parent.location, parent.rotation_euler = (3.0, -2.0, 5.0), (0.3, 1.0, -0.7)
    parent.scale = (3.0, 3.0, 3.0)
    bpy.context.view_layer.update()
    after = _ranked(addon, room, score) < 0.5

    assert np.count_nonzero(before != after) <= 4


def test_an_unevenly_scaled_object_is_scored_as_it_stands_in_the_world(addon, core, make_splats,
                                                                       tmp_path):  # fmt: skip
    """A scale of (1, 2, 1) on round splats of size s gives ellipsoids s, 2s, s at twice the y."""
    columns = make_splats(count=50)
    for axis in range(3):
        columns[f"scale_{axis}"][:] = -3.0
    (tmp_path / "in.ply").write_bytes(ply_of(columns))
    mesh = addon.mesh.attributes.mesh_from_file(core.read_ply(tmp_path / "in.ply"))
    obj = bpy.data.objects.new("stretched", mesh)
    obj.scale = (1.0, 2.0, 1.0)
    bpy.context.scene.collection.objects.link(obj)
    splats = addon.objects.splat_group.gather([addon.mesh.layout.check(obj)])

    assert np.allclose(splats.means[:, 1], 2 * columns["y"])
    assert np.allclose(
        np.sort(splats.log_scales, axis=1), [-3.0, -3.0, math.log(2) - 3.0], atol=1e-5
    )
    export(addon, addon.mesh.layout.check(obj), tmp_path / "out.ply", apply_transform=True)
    written = core.read_ply(tmp_path / "out.ply").splats()
    np.testing.assert_allclose(written.means, splats.means, rtol=1e-6)
    np.testing.assert_allclose(written.log_scales, splats.log_scales, atol=1e-6)


def test_an_export_with_the_transform_is_the_moved_splats(addon, core, room, tmp_path):
    """As `core.affine.transformed` has it; without a transform the bytes are the file's."""
    room.matrix_world = (
        mathutils.Matrix.Translation((1.0, 2.0, 3.0))
        @ mathutils.Matrix.Rotation(0.8, 4, (1.0, 2.0, 3.0))
        @ mathutils.Matrix.Scale(2.0, 4)
    )
    bpy.context.view_layer.update()
    export(addon, addon.mesh.layout.check(room), tmp_path / "moved.ply", apply_transform=True)
    export(addon, addon.mesh.layout.check(room), tmp_path / "kept.ply")
    file = core.read_ply(PLY)
    expected = core.affine.transformed(
        file.splats(), np.array(room.matrix_world, np.float64), rotate_sh=True
    )
    got = core.read_ply(tmp_path / "moved.ply").splats()

    assert (tmp_path / "kept.ply").read_bytes() == PLY.read_bytes()
    for name in ("means", "log_scales", "quaternions", "sh_dc", "opacity_logits"):
        assert np.array_equal(getattr(got, name), getattr(expected, name).astype(np.float32)), name
    # A product of matrices may round otherwise where they lie otherwise in memory.
    assert np.allclose(got.sh_rest, expected.sh_rest, rtol=1e-5, atol=1e-7)


def test_normals_turn_with_the_transform(addon, core, make_splats, tmp_path):
    """A quarter turn about z takes (1, 0, 0) to (0, 1, 0); a normal of zero stays zero."""
    columns = make_splats(count=2)
    for name, values in (("nx", (1, 0)), ("ny", (0, 0)), ("nz", (0, 0))):
        columns[name][:] = values
    (tmp_path / "in.ply").write_bytes(ply_of(columns))
    mesh = addon.mesh.attributes.mesh_from_file(core.read_ply(tmp_path / "in.ply"))
    obj = bpy.data.objects.new("turned", mesh)
    obj.rotation_euler.z = math.pi / 2
    bpy.context.scene.collection.objects.link(obj)
    export(addon, addon.mesh.layout.check(obj), tmp_path / "out.ply", apply_transform=True)
    rows = core.read_ply(tmp_path / "out.ply").rows

    assert [(row["nx"], row["ny"], row["nz"]) for row in rows] == [(0, 1, 0), (0, 0, 0)]


def test_scores_of_another_mesh_are_not_stored(addon, room, room_cameras):
    """Someone deleted a vertex while the scoring ran."""
    views = addon.cameras.CameraChoice("VISIBLE").views(bpy.context)
    scores = addon.core.score(
        addon.objects.splat_group.gather([addon.mesh.layout.check(room)]),
        views,
        addon.core.ClosedForm(),
    )
    keep = np.ones(39755, np.bool_)
    keep[7] = False
    addon.mesh.edit.delete_vertices(room, ~keep)

    with pytest.raises(addon.core.RefineError, match="39754 splats, was scored with 39755"):
        addon.mesh.scores.store(
            addon.mesh.layout.check(room),
            scores,
            addon.core.ClosedForm(),
        )


def test_the_worker_scores_like_the_plain_call_and_can_be_cancelled(addon, quarter, room_views):
    """The thread of the window: same scores; after `cancel` its result raises `Cancelled`."""
    core = addon.core
    splats = addon.objects.splat_group.gather([addon.mesh.layout.check(quarter)])
    worker = addon.ui.operator_bases.Worker(
        lambda progress: core.score(splats, room_views, progress=progress)
    )
    scores = worker.result()
    begun = threading.Event()

    def slow(progress):
        begun.set()
        return core.score(splats, room_views, progress=progress)

    cancelled = addon.ui.operator_bases.Worker(slow)
    begun.wait(60.0)
    cancelled.cancel()

    assert np.array_equal(scores.values, core.score(splats, room_views).values)
    assert worker.fraction > 0.5
    with pytest.raises(core.Cancelled):
        cancelled.result()


def test_a_pruned_object_is_imported_and_pruned_again(addon, room, room_cameras, tmp_path):
    """The header's count follows the mesh: what is exported after two prunes is a whole file."""
    for _ in range(2):
        bpy.ops.refine.score()
        bpy.ops.refine.apply()
    export(addon, addon.mesh.layout.check(room), tmp_path / "out.ply")

    assert len(addon.core.read_ply(tmp_path / "out.ply")) == 39755 - 19877 - 9939


def test_modifiers_that_could_move_splats_are_mentioned(addon, room):
    """What is scored and exported is the mesh itself; KIRI's drawing moves none."""
    room.modifiers.new("KIRI_3DGS_Render_GN", "NODES")
    quiet = addon.objects.splat_group.modifier_notes(room)
    room.modifiers.new("Wave", "WAVE")

    assert quiet == []
    assert "without its modifiers (Wave)" in addon.objects.splat_group.modifier_notes(room)[0]
