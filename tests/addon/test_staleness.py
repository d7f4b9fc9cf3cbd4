"""Scores that are older than a change are used, and said to be."""

from __future__ import annotations

import bpy
import pytest

from .conftest import keep_mask


def hints(addon, obj):
    """Return what the panel would say of an object's scores."""
    bpy.context.view_layer.update()
    return addon.ui.plans.stale(bpy.context, obj)


def test_what_changed_since_scoring_is_said_until_it_is_put_back(addon, quarter, room_cameras):
    """One of 72 cameras, a hundredth of a unit, any of the settings that the method looks at."""
    settings, render = bpy.context.scene.refine, bpy.context.scene.render
    camera, plain = room_cameras.objects[30], room_cameras.objects[0]
    parent = bpy.data.objects.new("parent", None)
    bpy.context.scene.collection.objects.link(parent)
    quarter.parent, camera.rotation_mode, camera["refine_weight"] = parent, "XYZ", 1.0
    del plain["refine_view"]  # now it is one that was made here, of the scene's render size
    bpy.context.view_layer.update()
    bpy.ops.refine.score()
    assert hints(addon, quarter) == []
    for owner, path, value, expected in (
        (quarter, "location.x", 0.01, "object moved"),
        (parent, "rotation_euler.z", 0.01, "object moved"),
        (camera, "location.x", camera.location.x + 0.01, "cameras changed"),
        (camera, "rotation_euler.x", camera.rotation_euler.x + 0.01, "cameras changed"),
        (camera, "data.lens", camera.data.lens + 1.0, "cameras changed"),
        (camera, "data.sensor_fit", "VERTICAL", "cameras changed"),
        (camera, '["refine_weight"]', 2.0, "cameras changed"),
        (render, "resolution_x", 1000, "cameras changed"),
        (settings, "source", "FRAMES", "cameras changed"),
        (settings, "method", "occlusion", "settings changed"),
        (settings, "views", 8, "settings changed"),
    ):
        before = owner.path_resolve(path)
        for given, said in ((value, [expected]), (before, [])):
            holder, _, name = path.rpartition(".")
            target = owner.path_resolve(holder) if holder else owner
            if path[0] == "[":
                target["refine_weight"] = given
            else:
                setattr(target, name, given)
            assert hints(addon, quarter) == said, (path, given)

    bpy.data.objects.remove(camera)
    assert hints(addon, quarter) == ["cameras changed"]


def test_what_does_not_decide_is_not_said(addon, quarter, room_cameras):
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
    visible = hints(addon, quarter)
    settings.source = "COLLECTION"
    room_cameras.objects[0].name = "renamed"

    assert visible == hints(addon, quarter) == []


def test_selecting_the_splats_is_no_other_choice_of_cameras(addon, quarter, room_cameras):
    """With none selected those meant are not known; with one, they are others."""
    bpy.context.scene.refine.source = "SELECTED"
    for camera in room_cameras.objects:
        camera.select_set(True)
    bpy.ops.refine.score()
    for camera in room_cameras.objects:
        camera.select_set(False)
    none = hints(addon, quarter)
    room_cameras.objects[0].select_set(True)

    assert none == []
    assert hints(addon, quarter) == ["cameras changed"]


def test_another_frame_of_a_scored_shot_is_no_change(addon, quarter):
    """The turntable turns, and the views were turned with it; another range is a change."""
    scene = bpy.context.scene
    scene.camera = bpy.data.objects.new("shot", bpy.data.cameras.new("shot"))
    scene.collection.objects.link(scene.camera)
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


def test_the_note_survives_saving(addon, quarter, room_cameras, tmp_path):
    """Matrices are made anew from location, rotation and scale when a file is opened."""
    quarter.rotation_euler = (0.1, 0.2, 0.3)
    bpy.ops.refine.score()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))

    assert hints(addon, bpy.data.objects["room"]) == []


@pytest.mark.usefixtures("room_cameras")
def test_scores_without_a_note_or_with_a_damaged_one_have_nothing_to_say(
    addon, quarter, room_views, score
):
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
@pytest.mark.parametrize("moved", [False, True])
def test_apply_goes_by_the_old_scores_and_says_so(addon, quarter, capfd, moved):
    """Blender prints what an operator reports when a script calls it."""
    bpy.ops.refine.score()
    keep = keep_mask(addon, quarter, addon.core.Budget(ratio=0.5))
    quarter.location.x = float(moved)
    capfd.readouterr()
    bpy.ops.refine.apply()

    assert len(quarter.data.vertices) == keep.sum()
    assert ("from before a change (object moved)" in capfd.readouterr().out) == moved
