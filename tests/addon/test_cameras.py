"""A view taken from a Blender camera sees what Blender sees."""

import json
import math

import bpy
import mathutils
import numpy as np
import pytest
from bpy_extras.object_utils import world_to_camera_view

from .conftest import linked


def _linked(name, data=None, **values):
    return _set(bpy.data.objects.get(name) or linked(name, data), values)


def _camera(name="camera", **values):
    return _linked(name, bpy.data.cameras.new(name), **values)


def _set(target, values):
    for name, value in values.items():
        setattr(target, name, value)
    return target


def _view(addon, obj):
    return addon.cameras.view_from_camera(obj)


def test_any_lens_frame_and_placement_agrees_with_blender(addon):
    """Moved, turned, scaled, mirrored, also below an evenly scaled parent with an inverse."""
    random = np.random.default_rng(0)

    def between(least, most, count=None):
        return random.uniform(least, most, count)

    def placement(**scale):
        return {"location": between(-5, 5, 3), "rotation_euler": between(-5, 5, 3), **scale}

    camera, render = _camera(), bpy.context.scene.render
    camera.matrix_parent_inverse = mathutils.Matrix.Translation((1.0, 2.0, 3.0))
    for number in range(60):
        fit = ("AUTO", "HORIZONTAL", "VERTICAL")[number % 3]
        _set(camera.data, {"lens": between(8, 200), "sensor_fit": fit})
        _set(camera.data, {"sensor_width": between(10, 60), "sensor_height": between(8, 50)})
        _set(camera.data, {"shift_x": between(-0.6, 0.6), "shift_y": between(-0.6, 0.6)})
        for axis in "xy":
            setattr(render, f"resolution_{axis}", int(between(10, 4000)))
            setattr(render, f"pixel_aspect_{axis}", between(1, 4))
        _set(camera, placement(scale=between(0.2, 4, 3) * random.choice([-1, 1], 3)))
        even = placement(scale=between(0.2, 4, 1).repeat(3))
        camera.parent = _linked("parent", **even) if number % 2 else None
        bpy.context.view_layer.update()

        rigid = camera.matrix_world.normalized()
        local = between((-1, -1, -20), (1, 1, -0.5), (8, 3))
        points = [rigid @ mathutils.Vector(point) for point in local]
        expected = [world_to_camera_view(bpy.context.scene, camera, point) for point in points]
        view = _view(addon, camera)
        x, y, z = view.rotation @ (np.array(points, np.float64) - view.center).T
        across, down = view.fx * x / z + view.cx, view.fy * y / z + view.cy
        got = np.stack([across / view.width, 1 - down / view.height, z], axis=-1)  # from below
        assert np.allclose(got, np.array(expected), rtol=2e-5, atol=2e-4)


def test_clip_distances_and_a_share_of_the_render_size_count(addon):
    """Half of 241 x 161 px is rounded down, as by Blender."""
    camera = _camera()
    _set(camera.data, {"clip_start": 0.5, "clip_end": 8.0})
    half = {"resolution_x": 241, "resolution_y": 161, "resolution_percentage": 50}
    _set(bpy.context.scene.render, half)
    view = _view(addon, camera)
    assert (view.near, view.far, view.width, view.height) == (0.5, 8.0, 120, 80)


def test_constraints_and_drivers_are_followed_unless_the_camera_is_disabled(addon):
    """Blender does not evaluate a disabled one: placed by a parent it is clear, constrained not."""
    camera, target = _camera(), _linked("target", location=(3.0, 0.0, 0.0))
    camera.constraints.new("COPY_LOCATION").target = target
    camera.data.driver_add("lens").driver.expression = "85.0"
    view = _view(addon, camera)
    assert view.center.tolist() == [3.0, 0.0, 0.0]
    assert math.isclose(view.fx, 85 / 36 * 240)

    disabled = _camera("disabled", location=(1.0, 2.0, 3.0), hide_viewport=True, parent=target)
    assert _view(addon, disabled).center.tolist() == [4.0, 2.0, 3.0]
    disabled.constraints.new("COPY_LOCATION")
    with pytest.raises(addon.core.RefineError, match="disabled in viewports"):
        _view(addon, disabled)


def test_cameras_without_perspective_or_with_shear_are_named_and_refused(addon):
    """A turned camera below an unevenly scaled parent has axes that are not at right angles."""
    camera = _camera("wide")
    for kind, word in (("ORTHO", "orthographic"), ("PANO", "panoramic")):
        camera.data.type = kind
        expected = f"'wide' is {word}, expected a perspective"
        with pytest.raises(addon.core.RefineError, match=expected):
            _view(addon, camera)

    parent = _linked("parent", scale=(1.0, 3.0, 1.0))
    camera = _camera("skewed", rotation_euler=(0.3, 0.4, 0.5), parent=parent)
    with pytest.raises(addon.core.RefineError, match="'skewed' is sheared"):
        _view(addon, camera)


def test_the_weight_is_a_custom_property(addon):
    """A number of at least 0, else 1; anything else is said by name."""
    camera = _camera()
    assert _view(addon, camera).weight == 1.0
    camera["refine_weight"] = 3
    assert _view(addon, camera).weight == 3.0
    for bad in ("2", -1.0, math.nan, math.inf, [1.0], True):
        camera["refine_weight"] = bad
        with pytest.raises(addon.core.RefineError, match=r"'camera'.*refine_weight is"):
            _view(addon, camera)


def test_each_source_gives_its_cameras(addon):
    """Active, selected, visible, and a collection with those below it, hidden ones too."""
    scene = bpy.context.scene
    first, second, third = (_camera(name) for name in ("first", "second", "third"))
    outer, inner = (bpy.data.collections.new(name) for name in ("outer", "inner"))
    scene.collection.children.link(outer)
    outer.children.link(inner)
    outer.objects.link(second)
    inner.objects.link(third)
    scene.camera = first
    for camera in (first, second, third):
        camera.select_set(camera is second)
    third.hide_set(True)
    for source, expected in (
        ("ACTIVE", ["first"]), ("SELECTED", ["second"]), ("VISIBLE", ["first", "second"]),
        ("COLLECTION", ["second", "third"]),
    ):  # fmt: skip
        views = addon.cameras.CameraChoice(source, outer).views(bpy.context)
        assert sorted(view.name for view in views) == expected


def _animate(obj, path, values, index=-1):
    for frame, value in values.items():
        if index < 0:
            setattr(obj, path, value)
        else:
            getattr(obj, path)[index] = value
        obj.keyframe_insert(path, index=index, frame=frame)


def test_a_shot_is_a_view_set_and_the_frame_is_put_back(addon):
    """X is 1 at frame 1 and 5 at frame 5; every second frame sees 1, 3 (eased, half way) and 5."""
    scene, shot = bpy.context.scene, addon.cameras.views_from_frames
    scene.camera = _camera()
    _animate(scene.camera, "location", {1: 1.0, 5: 5.0}, index=0)
    _animate(scene.camera.data, "lens", {1: 50.0, 5: 100.0})
    scene.frame_set(4, subframe=0.25)
    views = shot(bpy.context, range(1, 6, 2))
    assert [round(view.center[0], 5) for view in views] == [1.0, 3.0, 5.0]
    assert math.isclose(views[2].fx, 2 * views[0].fx)
    assert (scene.frame_current, scene.frame_subframe) == (4, 0.25)
    assert [view.name for view in views] == [f"camera, frame {frame}" for frame in (1, 3, 5)]
    with pytest.raises(addon.core.RefineError, match="starts at 5 and ends at 4"):
        shot(bpy.context, range(5, 5))


def test_cameras_bound_to_markers_take_over(addon):
    """At frame 1 and at frame 3; frame and active camera are put back, also after a failure."""
    scene, shot = bpy.context.scene, addon.cameras.views_from_frames
    first, second, other = (_camera(name) for name in ("first", "second", "other"))
    for frame, camera in ((1, first), (3, second)):
        scene.timeline_markers.new(camera.name, frame=frame).camera = camera
    scene.frame_set(2)
    scene.camera = other
    views = shot(bpy.context, range(1, 5))
    assert [view.name.split(",")[0] for view in views] == ["first", "first", "second", "second"]
    assert (scene.frame_current, scene.camera) == (2, other)
    second.data.type = "ORTHO"
    with pytest.raises(addon.core.RefineError, match="'second' is orthographic"):
        shot(bpy.context, range(1, 5))
    assert (scene.frame_current, scene.camera) == (2, other)


def test_a_turntable_is_seen_from_all_sides(addon, room):
    """A camera at (4, 0, 0) is, seen by an object turned by 90 degrees about z, at (0, -4, 0)."""
    scene = bpy.context.scene
    scene.camera = _camera(location=(4.0, 0.0, 0.0))
    _animate(room, "rotation_euler", {1: 0.0, 2: math.pi / 2}, index=2)
    scene.frame_set(1)
    views = addon.cameras.views_from_frames(bpy.context, range(1, 3), room)
    assert np.allclose(views[0].center, [4, 0, 0])
    assert np.allclose(views[1].center, [0, -4, 0], atol=1e-6)

    _animate(room, "scale", {1: (1.0,) * 3, 2: (2.0,) * 3})
    with pytest.raises(addon.core.RefineError, match="scale is animated"):
        addon.cameras.views_from_frames(bpy.context, range(1, 3), room)


def test_imported_cameras_give_back_the_views_of_their_file(addon, room_cameras, room_views):
    """To the last digit at any render size."""
    bpy.context.scene.render.resolution_x = 999
    views = addon.cameras.CameraChoice("COLLECTION", room_cameras).views(bpy.context)
    names = ("center", "fx", "fy", "cx", "cy", "width", "height", "weight", "near", "far")
    assert len(views) == 72
    for got, expected in zip(views, room_views, strict=True):
        np.testing.assert_allclose(got.rotation, expected.rotation, rtol=0.0, atol=1e-12)
        for name in names:
            np.testing.assert_array_equal(getattr(got, name), getattr(expected, name))


def test_an_imported_camera_that_was_moved_or_changed_is_taken_as_it_is(addon, room_cameras):
    """Only what was touched: pose, lens and clip distances; a damaged note is said by name."""
    moved, zoomed, clipped = room_cameras.objects[:3]
    moved.location.x += 1.0
    zoomed.data.lens *= 2.0
    clipped.data.clip_end = 5.0
    noted = [json.loads(camera["refine_view"]) for camera in (moved, zoomed)]
    one, two, three = (_view(addon, camera) for camera in (moved, zoomed, clipped))
    assert math.isclose(one.center[0], noted[0]["center"][0] + 1.0, rel_tol=1e-6)
    assert one.fx == noted[0]["fx"]
    assert math.isclose(two.fx, 2 * noted[1]["fx"], rel_tol=1e-6)
    assert (two.width, two.center.tolist()) == (240, noted[1]["center"])
    assert three.far == 5.0
    for text in ("", "{}", "[1]", "null"):
        moved["refine_view"] = text
        with pytest.raises(addon.core.RefineError, match="refine_view is damaged"):
            _view(addon, moved)


def test_any_view_becomes_a_camera_that_blender_frames_alike(addon):
    """Position, any rotation, mirrored or not, focal length, principal point off the centre."""
    core, random = addon.core, np.random.default_rng(0)
    for number in range(40):
        rotation = core.splats.rotation_matrices(random.normal(size=4))
        if number % 2:
            rotation = rotation * np.array([-1.0, 1.0, 1.0])
        center, focal = random.uniform(-5, 5, 3), random.uniform(50, 2000)
        cx, cy = random.uniform(0.2, 0.8, 2) * (240, 160)
        expected = core.View(rotation, center, focal, focal, cx, cy, 240, 160)
        camera = addon.cameras.camera_from_view(expected)
        bpy.context.scene.collection.objects.link(camera)
        del camera["refine_view"]
        got = _view(addon, camera)
        assert np.allclose(got.rotation, rotation, atol=2e-6)
        assert np.allclose(got.center, center, atol=1e-6)
        assert np.allclose([got.fx, got.fy], focal, rtol=1e-5)
        assert np.allclose([got.cx, got.cy], [cx, cy], atol=1e-3)
