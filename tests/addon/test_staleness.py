"""Scores that are older than a change are used, and said to be."""

import bpy
import pytest

from .conftest import keep_mask, linked


def hints(addon, obj):
    """Return what the panel would say of an object's scores."""
    bpy.context.view_layer.update()
    return addon.ui.plans.stale(obj)


def test_what_changed_since_scoring_is_said(addon, quarter, room_cameras, tmp_path):
    """One of 72 cameras, a hundredth of a unit, settings of the method; no budget, no name."""
    scene, settings = bpy.context.scene, bpy.context.scene.refine
    camera, plain = room_cameras.objects[30], room_cameras.objects[0]
    parent, other = linked("parent"), linked("other")
    quarter.parent, quarter.rotation_euler = parent, (0.1, 0.2, 0.3)
    camera.rotation_mode, camera["refine_weight"] = "XYZ", 1.0
    del plain["refine_view"]  # now it is one that was made here, of the scene's render size
    bpy.context.view_layer.update()
    bpy.ops.refine.score()
    assert hints(addon, quarter) == []
    moved, cameras, changed = ["object moved"], ["cameras changed"], ["settings changed"]
    for owner, name, value, expected in (
        (quarter.location, "x", 0.01, moved),
        (parent.rotation_euler, "z", 0.01, moved),
        (camera.location, "x", camera.location.x + 0.01, cameras),
        (camera.rotation_euler, "x", camera.rotation_euler.x + 0.01, cameras),
        (camera.data, "lens", camera.data.lens + 1.0, cameras),
        (camera.data, "sensor_fit", "VERTICAL", cameras),
        (scene.render, "resolution_x", 1000, cameras),
        (settings, "source", "FRAMES", cameras),
        (settings, "method", "occlusion", changed),
        (settings, "views", 8, changed),
        (settings, "model", "antialiased", ["Drawn As changed"]),
        (settings, "ratio", 0.7, []),
        (settings, "protect", "x", []),
        (settings, "source", "VISIBLE", []),
        (scene, "frame_current", 7, []),
        (other.location, "x", 3.0, []),
        (plain, "name", "renamed", []),
    ):
        before = getattr(owner, name)
        for given, said in ((value, expected), (before, [])):
            setattr(owner, name, given)
            assert hints(addon, quarter) == said, (name, given)

    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    room, camera = bpy.data.objects["room"], bpy.data.collections["cameras"].objects[30]
    assert hints(addon, room) == []
    camera["refine_weight"] = 2.0
    assert hints(addon, room) == cameras
    camera["refine_weight"] = 1.0
    bpy.data.objects.remove(camera)
    assert hints(addon, room) == cameras


def test_selecting_the_splats_is_no_other_choice_of_cameras(addon, quarter, room_cameras):
    """With none selected those meant are not known; with one, they are others."""
    cameras = room_cameras.objects
    bpy.context.scene.refine.source = "SELECTED"
    for selected, said in ((cameras, []), ([], []), (cameras[:1], ["cameras changed"])):
        for camera in cameras:
            camera.select_set(camera in list(selected))
        if len(selected) == len(cameras):
            bpy.ops.refine.score()
        assert hints(addon, quarter) == said


def test_another_frame_of_a_scored_shot_is_no_change(addon, quarter):
    """The turntable turns, and the views were turned with it; another range is a change."""
    scene = bpy.context.scene
    scene.camera = linked("shot", bpy.data.cameras.new("shot"))
    scene.camera.location = (0.0, 0.0, 3.0)
    for frame, angle in ((1, 0.0), (20, 0.5)):
        quarter.rotation_euler.z = angle
        quarter.keyframe_insert("rotation_euler", frame=frame)
    scene.frame_end, scene.refine.method, scene.refine.source = 20, "closed-form", "FRAMES"
    bpy.ops.refine.score()
    scene.frame_set(10)
    assert hints(addon, quarter) == []
    scene.refine.frame_step += 1
    assert hints(addon, quarter) == ["cameras changed"]


@pytest.mark.usefixtures("room_cameras")
def test_scores_without_a_whole_note_say_nothing(addon, quarter, room_views, score):
    """Those of a script, and whatever else a custom property may hold."""
    score(quarter, room_views)
    quarter.location.x = 1.0
    assert hints(addon, quarter) == []
    bpy.ops.refine.score()
    quarter.location.x = 2.0
    assert hints(addon, quarter) == ["object moved"]
    record = quarter.data["refine_scores"]
    for old, new in (('"matrix": ', '"other": '), ('"cameras": [', '"cameras": 3, "x": [')):
        quarter.data["refine_scores"] = record.replace(old, new)
        assert hints(addon, quarter) == []


@pytest.mark.usefixtures("room_cameras")
@pytest.mark.parametrize(("moved", "merging"), [(False, False), (True, False), (True, True)])
def test_apply_goes_by_the_old_scores_and_says_so(addon, quarter, capfd, moved, merging):
    """Blender prints what an operator reports when a script calls it. Merging scores anew."""
    if merging:  # deletes, too, of so few
        bpy.context.scene.refine.method, bpy.context.scene.refine.percent = "merge", 4.0
    bpy.ops.refine.score()
    keep = keep_mask(addon, quarter, addon.core.Budget(ratio=0.5))
    quarter.location.x = float(moved)
    capfd.readouterr()
    bpy.ops.refine.apply()
    said = capfd.readouterr().out
    words = ("from before a change (object moved)", "rows stay as they were")
    assert [each in said for each in words] == [moved and not merging, merging]
    assert merging or len(quarter.data.vertices) == keep.sum()
