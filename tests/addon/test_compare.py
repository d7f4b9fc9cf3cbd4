"""*Compare*: the pictures are what the active camera sees of what Apply does."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

NAMES = ["Compare: before", "Compare: after", "Compare: difference"]


def pixels(name):
    """Return an image in 8 bits, (H, W, 3), the top row first."""
    image = bpy.data.images[name]
    width, height = image.size
    values = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(values)
    return np.rint(values.reshape(height, width, 4)[::-1, :, :3] * 255.0).astype(np.uint8)


@pytest.mark.parametrize("method", ["closed-form", pytest.param("merge", marks=pytest.mark.slow)])
def test_the_pictures_are_those_of_what_apply_leaves(addon, quarter, room_cameras, method):
    """Before: the splats as they are; after: once *Apply* was clicked; by the same camera."""
    scene = bpy.context.scene
    scene.camera = room_cameras.objects[24]
    scene.refine.ratio, scene.refine.method, scene.refine.views = 0.7, method, 16
    bpy.ops.refine.score()
    gather, check = addon.objects.splat_group.gather, addon.mesh.layout.check
    before = gather([check(quarter)], whole=True)

    assert bpy.ops.refine.compare() == {"FINISHED"}

    assert len(quarter.data.vertices) == 9_939
    bpy.ops.refine.apply()
    after = gather([check(quarter)], whole=True)
    assert len(after) == 9_939 - 6_957  # floor(.7 * 9939)
    views = addon.cameras.CameraChoice("ACTIVE").views(bpy.context, quarter)
    (expected,) = addon.core.pictures.compare(before, after, views)
    assert (expected.view.width, expected.view.height) == (240, 160)
    for name, wanted in zip(NAMES, ("before", "after", "difference"), strict=True):
        apart = np.abs(pixels(name).astype(int) - getattr(expected, wanted))
        assert apart.max() <= (8 if wanted == "difference" else 1)  # what is merged is float32 then


def test_a_second_comparison_replaces_the_first(room, room_cameras):
    """Three images, whatever their size was before."""
    scene = bpy.context.scene
    scene.camera = room_cameras.objects[0]
    bpy.ops.refine.score()
    bpy.ops.refine.compare()
    first = pixels(NAMES[2])
    scene.refine.ratio = 0.9

    bpy.ops.refine.compare()

    assert sorted(image.name for image in bpy.data.images) == sorted(NAMES)
    assert pixels(NAMES[2]).sum() > first.sum()
    assert len(room.data.vertices) == 39_755


def test_images_of_the_user_stay_whatever_they_are_called(room, room_cameras):
    """One of such a name is not replaced, by a second comparison neither."""
    bpy.context.scene.camera = room_cameras.objects[0]
    mine = bpy.data.images.new(NAMES[0], 4, 4)
    bpy.ops.refine.score()

    for _ in range(2):
        bpy.ops.refine.compare()

    assert bpy.data.images[NAMES[0]] == mine
    assert tuple(mine.size) == (4, 4)
    names = sorted(image.name for image in bpy.data.images)
    assert names == sorted([*NAMES, f"{NAMES[0]}.001"])


@pytest.mark.usefixtures("room", "room_cameras")
def test_without_an_active_camera_it_says_so():
    bpy.ops.refine.score()

    with pytest.raises(RuntimeError, match="has no active camera"):
        bpy.ops.refine.compare()

    assert not bpy.data.images


@pytest.mark.usefixtures("room", "room_cameras")
def test_it_waits_for_scores():
    assert not bpy.ops.refine.compare.poll()
