"""Scores that are older than a change are used, and said to be."""

from __future__ import annotations

import bpy
import pytest

from .conftest import keep_mask


def hints(addon, obj):
    """Return what the panel would say of an object's scores."""
    bpy.context.view_layer.update()
    return addon.ui.plans.stale(bpy.context, obj)


def _move(room, _camera):
    room.location.x = 0.01


def _move_parent(room, _camera):
    room.parent = bpy.data.objects.new("parent", None)
    bpy.context.scene.collection.objects.link(room.parent)
    room.parent.rotation_euler.z = 0.01


def _move_camera(_room, camera):
    camera.location.x += 0.01


def _turn_camera(_room, camera):
    camera.rotation_mode = "XYZ"
    camera.rotation_euler.x += 0.01


def _zoom(_room, camera):
    camera.data.lens += 1.0


def _weigh(_room, camera):
    camera["refine_weight"] = 2.0


def _fit(_room, camera):
    camera.data.sensor_fit = "VERTICAL"


def _remove_camera(_room, camera):
    bpy.data.objects.remove(camera)


def _choose_others(_room, _camera):
    bpy.context.scene.refine.source = "FRAMES"


def _choose_method(_room, _camera):
    bpy.context.scene.refine.method = "occlusion"


def _choose_views(_room, _camera):
    bpy.context.scene.refine.views = 8


@pytest.mark.parametrize(
    ("change", "expected"),
    [(_move, "object moved"), (_move_parent, "object moved"), (_move_camera, "cameras changed"),
     (_turn_camera, "cameras changed"), (_zoom, "cameras changed"), (_weigh, "cameras changed"),
     (_fit, "cameras changed"), (_remove_camera, "cameras changed"),
     (_choose_others, "cameras changed"), (_choose_method, "settings changed"),
     (_choose_views, "settings changed")],
)  # fmt: skip
def test_what_changed_since_scoring_is_said(addon, room, room_cameras, change, expected):
    """One of 72 cameras, a hundredth of a unit, any of the settings that the method looks at."""
    bpy.ops.refine.score()
    before = hints(addon, room)
    change(room, room_cameras.objects[30])

    assert before == []
    assert hints(addon, room) == [expected]


def test_what_does_not_decide_is_not_said(addon, room, room_cameras):
    """Budgets, other objects, the way the cameras are chosen."""
    bpy.ops.refine.score()
    settings, scene = bpy.context.scene.refine, bpy.context.scene
    settings.ratio, settings.protect = 0.7, "x"
    scene.frame_current += 1
    scene.render.resolution_x = 1000  # imported cameras keep the size of their file
    other = bpy.data.objects.new("other", None)
    scene.collection.objects.link(other)
    other.location.x = 3.0
    settings.source = "VISIBLE"  # the same ones
    visible = hints(addon, room)
    settings.source = "COLLECTION"
    room_cameras.objects[0].name = "renamed"

    assert visible == hints(addon, room) == []


def test_what_is_put_back_is_forgotten(addon, room, room_cameras):
    """Moved there and back, and the render size of a camera made here."""
    scene = bpy.context.scene
    del room_cameras.objects[0]["refine_view"]
    bpy.ops.refine.score()
    found = []
    for x, width in ((1.0, 1000), (0.0, 240)):
        room.location.x, scene.render.resolution_x = x, width
        found.append(hints(addon, room))

    assert found == [["object moved", "cameras changed"], []]


def test_selecting_the_splats_is_no_other_choice_of_cameras(addon, room, room_cameras):
    """With none selected those meant are not known; with one, they are others."""
    bpy.context.scene.refine.source = "SELECTED"
    for camera in room_cameras.objects:
        camera.select_set(True)
    bpy.ops.refine.score()
    for camera in room_cameras.objects:
        camera.select_set(False)
    none = hints(addon, room)
    room_cameras.objects[0].select_set(True)

    assert none == []
    assert hints(addon, room) == ["cameras changed"]


def test_another_frame_of_a_scored_shot_is_no_change(addon, room):
    """The turntable turns, and the views were turned with it; another range is a change."""
    scene = bpy.context.scene
    scene.camera = bpy.data.objects.new("shot", bpy.data.cameras.new("shot"))
    scene.collection.objects.link(scene.camera)
    scene.camera.location = (0.0, 0.0, 3.0)
    for frame, angle in ((1, 0.0), (250, 6.0)):
        room.rotation_euler.z = angle
        room.keyframe_insert("rotation_euler", frame=frame)
    scene.refine.source = "FRAMES"
    bpy.ops.refine.score()
    scene.frame_set(100)
    turned = hints(addon, room)
    scene.refine.frame_step = 20

    assert turned == []
    assert hints(addon, room) == ["cameras changed"]


def test_the_note_survives_saving(addon, room, room_cameras, tmp_path):
    """Matrices are made anew from location, rotation and scale when a file is opened."""
    room.rotation_euler = (0.1, 0.2, 0.3)
    bpy.ops.refine.score()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))

    assert hints(addon, bpy.data.objects["room"]) == []


def test_scores_without_a_note_or_with_a_damaged_one_have_nothing_to_say(
    addon, room, room_cameras, room_views, score
):
    """Those of a script, and whatever else a custom property may hold."""
    score(room, room_views)
    room.location.x = 1.0
    found = [hints(addon, room)]
    bpy.ops.refine.score()
    room.location.x = 2.0
    found.append(hints(addon, room))
    for old, new in (('"matrix": ', '"other": '), ('"cameras": [', '"cameras": 3, "x": [')):
        record = room.data["refine_scores"]
        room.data["refine_scores"] = record.replace(old, new)
        found.append(hints(addon, room))
        room.data["refine_scores"] = record

    assert found == [[], ["object moved"], [], []]
    assert len(room_cameras.objects) == 72


@pytest.mark.parametrize("moved", [False, True])
def test_apply_goes_by_the_old_scores_and_says_so(addon, room, room_cameras, capfd, moved):
    """Blender prints what an operator reports when a script calls it."""
    bpy.ops.refine.score()
    keep = keep_mask(addon, room, addon.core.Budget(ratio=0.5))
    room.location.x = float(moved)
    capfd.readouterr()
    bpy.ops.refine.apply()

    assert len(room.data.vertices) == keep.sum()
    assert ("from before a change (object moved)" in capfd.readouterr().out) == moved
