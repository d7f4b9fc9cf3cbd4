"""Nothing lost: undo and redo, save and reopen, long shots."""

from __future__ import annotations

import bpy
import numpy as np
import pytest


def contents(addon, obj) -> dict[str, bytes]:
    """Return every point attribute of an object, by its bytes."""
    return {
        a.name: addon.mesh.attributes.read_attribute(obj.data, a.name).tobytes()
        for a in obj.data.attributes
        if a.domain == "POINT" and not a.name.startswith(".")
    }


def test_apply_undo_redo_gives_bit_equal_attributes(addon, room, room_cameras):
    """The module pushes no undo steps by itself; the operators' own are pushed here."""
    name = room.name
    bpy.ops.ed.undo_push(message="start")
    bpy.ops.refine.score()
    bpy.ops.ed.undo_push(message="score")
    scored = contents(addon, bpy.data.objects[name])
    bpy.ops.refine.apply()
    bpy.ops.ed.undo_push(message="apply")
    applied = contents(addon, bpy.data.objects[name])

    bpy.ops.ed.undo()
    undone = contents(addon, bpy.data.objects[name])
    bpy.ops.ed.redo()
    redone = contents(addon, bpy.data.objects[name])

    assert undone == scored
    assert redone == applied


def test_a_saved_scene_keeps_scores_and_settings_and_can_be_applied(
    addon,
    room,
    room_cameras,
    tmp_path,
):
    """The plan is the same after reopening, and apply deletes what it says."""
    settings = bpy.context.scene.refine
    settings.ratio, settings.views, settings.method = 0.29, 32, "closed-form"
    bpy.ops.refine.score()
    name, before = room.name, contents(addon, room)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    room.data.clear_geometry()
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))

    settings, obj = bpy.context.scene.refine, bpy.data.objects[name]
    assert (round(settings.ratio, 6), settings.views) == (0.29, 32)
    assert contents(addon, obj) == before
    bpy.context.view_layer.objects.active = obj
    bpy.ops.refine.apply()
    assert len(obj.data.vertices) == 39755 - 11528  # floor(.29 * 39755)


def test_a_shot_of_a_thousand_frames_is_a_view_set(addon, room):
    """The camera moves by a frame's share each frame; 64 of them decide."""
    scene = bpy.context.scene
    camera = bpy.data.objects.new("shot", bpy.data.cameras.new("shot"))
    scene.collection.objects.link(camera)
    camera.rotation_euler = (np.pi / 2, 0, 0)
    for frame, x in ((1, -2.0), (1000, 2.0)):
        camera.location = (x, -3.0, 1.0)
        camera.keyframe_insert("location", frame=frame)
    scene.camera = camera
    scene.frame_start, scene.frame_end = 1, 1000
    settings = scene.refine
    settings.source, settings.frame_step = "FRAMES", 1
    settings.method = "closed-form"

    bpy.ops.refine.score()

    record = addon.mesh.scores.record(room.data)
    assert (record["views_used"], record["views_given"]) == (64, 1000)
    settings.source, settings.frame_step = "VISIBLE", 10


def test_an_object_of_another_scene_is_left_alone(addon, room, room_cameras):
    """The command prunes objects of the open scene; another scene's has another name there."""
    other = bpy.data.scenes.new("other")
    mesh = room.data.copy()
    elsewhere = bpy.data.objects.new("elsewhere", mesh)
    other.collection.objects.link(elsewhere)
    before = contents(addon, elsewhere)

    code = addon.command.main(
        ["prune", "--object", "elsewhere", "--dry-run", "--quiet", "--cameras",
         str(addon.core.__file__)], scene=True,
    )  # fmt: skip
    bpy.ops.refine.score()
    bpy.ops.refine.apply()

    assert code == 1
    assert contents(addon, elsewhere) == before


def test_splats_joined_after_scoring_are_never_deleted_unscored(addon, room, room_cameras):
    """Joining gives them a score of 0, the lowest: apply refuses instead."""
    bpy.ops.refine.score()
    copy = bpy.data.objects.new("more", room.data.copy())
    copy.data.attributes.remove(copy.data.attributes["refine_score"])
    bpy.context.collection.objects.link(copy)
    with bpy.context.temp_override(
        active_object=room, object=room, selected_editable_objects=[room, copy],
        selected_objects=[room, copy],
    ):  # fmt: skip
        bpy.ops.object.join()
    count = len(room.data.vertices)

    with pytest.raises(RuntimeError, match="scored with 39755 splats, has 79510 now"):
        bpy.ops.refine.apply()

    assert len(room.data.vertices) == count == 2 * 39755
