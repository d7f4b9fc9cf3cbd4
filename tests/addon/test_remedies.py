"""Guard rails: what each camera's picture loses, warnings beside Apply, a ring and a turn."""

from __future__ import annotations

import bpy
import mathutils
import numpy as np
import pytest

from .conftest import ROOM


@pytest.fixture
def warned(addon):
    """Return a function that scores the active object and returns the warnings beside Apply."""

    def warned():
        bpy.ops.refine.score()
        obj, plans = bpy.context.object, addon.ui.plans
        plan = plans.stored(obj, bpy.context.scene.refine)
        return plans.warnings(plan, addon.mesh.scores.record(obj.data))

    return warned


@pytest.fixture
def imported():
    """Return a function that imports the room and its cameras, each upright or not."""

    def imported(*, splats, cameras):
        bpy.ops.refine.import_ply(filepath=str(ROOM / "point_cloud.ply"), upright=splats)
        bpy.ops.refine.import_cameras(filepath=str(ROOM / "cameras.json"), upright=cameras)
        bpy.context.scene.refine.method = "closed-form"
        return bpy.context.object

    return imported


def read(addon, obj, name):
    """Return a point attribute."""
    return addon.mesh.attributes.read_attribute(obj.data, name)


def turn(addon):
    """Return by how many quarters the cameras that scored the active object are to be turned."""
    record = addon.mesh.scores.record(bpy.context.object.data)
    return addon.core.quality.alignment.Alignment.from_facts(record["alignment"]).turn


def told(warnings, words):
    """Tell whether a warning has these words."""
    return any(words in text for text in warnings)


def cameras(addon):
    """Return what the panel lists of each camera of the active object, by its name."""
    obj, ui = bpy.context.object, addon.ui
    plan = ui.plans.stored(obj, bpy.context.scene.refine)
    listed = ui.camera_operators.cameras(addon.mesh.scores.record(obj.data), plan["views"])
    return {camera.name: camera for camera in listed}


def test_the_list_tells_how_close_each_picture_stays(addon, room, room_cameras):
    """What the curve says of each view that scored, at the budget of the moment; lowest first.

    Eight of the 72 views score; of the others nothing is known. A larger share brings all down.
    """
    settings = bpy.context.scene.refine
    settings.method, settings.views, settings.percent = "occlusion", 8, 30.0
    bpy.ops.refine.score()
    few = cameras(addon)
    curve = addon.mesh.scores.stored_scores([addon.mesh.layout.check(room)]).quality
    settings.percent = 80.0
    many = cameras(addon)
    told = [name for name, camera in few.items() if camera.psnr is not None]

    assert len(few) == len(room_cameras.objects) == 72
    assert told == list(few)[:8]
    expected = curve.of_views(int(0.3 * 39755) / 39755)
    assert [few[name].psnr for name in told] == sorted(expected.values())
    assert all(many[name].psnr < few[name].psnr for name in told)


def test_merging_changes_less(addon, room, room_cameras):
    """Each picture gains what all of them gain on average: 39,755 splats are enough to foretell."""
    settings = bpy.context.scene.refine
    settings.method, settings.views, settings.percent = "occlusion", 4, 50.0
    bpy.ops.refine.score()
    deleted = cameras(addon)
    settings.method = "merge"
    gains = [c.psnr - deleted[c.name].psnr for c in cameras(addon).values() if c.psnr is not None]

    assert len(gains) == 4
    assert np.ptp(gains) < 1e-3
    assert min(gains) > 3.0


def test_nothing_is_told_of_pictures_without_an_estimate(addon, room, room_cameras):
    """The closed form makes none."""
    bpy.ops.refine.score()

    assert {camera.psnr for camera in cameras(addon).values()} == {None}


@pytest.mark.parametrize(
    ("splats", "cameras", "turn_back"), [(True, False, False), (False, True, True)]
)
def test_one_upright_import_beside_one_that_is_not_is_told_and_put_right(
    addon, imported, warned, splats, cameras, turn_back
):
    """Known from the imports; after the turn the scores are those of imports that are alike."""
    obj = imported(splats=splats, cameras=cameras)
    first = warned()
    wrong = read(addon, obj, "refine_score")
    turned = turn(addon)
    bpy.ops.refine.turn_cameras(back=turn_back)
    second = warned()
    right = read(addon, obj, "refine_score")
    matrix = bpy.context.scene.refine.collection.objects[0].matrix_world.copy()
    bpy.ops.wm.read_homefile(use_empty=True)
    alike = imported(splats=splats, cameras=splats)
    bpy.ops.refine.score()

    assert turned == (-1 if turn_back else 1)
    assert told(first, "imported upright")
    assert not told(second, "up axis")
    assert np.allclose(right, read(addon, alike, "refine_score"), rtol=2e-3)
    assert not np.allclose(wrong, right, rtol=0.1)
    other = bpy.context.scene.refine.collection.objects[0].matrix_world
    assert np.allclose(np.array(matrix), np.array(other), atol=1e-5)


def test_the_command_notes_what_the_panel_warns_of(addon, imported):
    """On an object of the scene, by the cameras that the panel chooses."""
    obj = imported(splats=True, cameras=False)
    views = addon.cameras.CameraChoice.of_scene(bpy.context.scene).views(bpy.context, obj)
    report = addon.objects.splat_group.prune_object(
        obj.name, views, addon.core.Budget(ratio=0.5), addon.core.ClosedForm(), dry_run=True
    )

    assert [note for note in report["notes"] if "do not share an up axis" in note]


@pytest.mark.parametrize("upright", [False, True])
def test_imports_that_are_alike_are_not_warned_of(imported, warned, upright):
    """Nor once both are moved together, nor by a shot that the cameras' file does not have."""
    obj = imported(splats=upright, cameras=upright)
    before = warned()
    motion = mathutils.Matrix.Translation((3.0, 4.0, 5.0)) @ mathutils.Matrix.Rotation(1.0, 4, "Z")
    for item in (obj, *bpy.context.scene.refine.collection.objects):
        item.matrix_world = motion @ item.matrix_world
    bpy.context.view_layer.update()
    after = warned()

    assert not told(before + after, "up axis")


def test_cameras_of_unknown_origin_are_measured(addon, imported, warned):
    """Without their note, cameras that were not turned upright see coarse pictures."""
    imported(splats=True, cameras=False)
    settings = bpy.context.scene.refine
    for camera in settings.collection.objects:
        del camera["refine_view"]
    settings.method, settings.views = "occlusion", 12

    assert told(warned(), "times as fine")
    assert turn(addon) == 1


def test_animated_cameras_are_turned_with_their_motion(room, room_cameras):
    """What is keyed stays keyed, under a parent that turns: at both frames a quarter about X."""
    camera = room_cameras.objects[0]
    places = {}
    for frame, x in ((1, 0.0), (9, 4.0)):
        camera.location = (x, 1.0, 2.0)
        camera.keyframe_insert("location", frame=frame)
        places[frame] = mathutils.Vector((x, 2.0, -1.0))
    scene = bpy.context.scene
    scene.camera, scene.refine.source = camera, "FRAMES"
    bpy.ops.refine.turn_cameras()

    for frame, place in places.items():
        scene.frame_set(frame)
        assert (camera.matrix_world.translation - place).length < 1e-5
    assert tuple(room.location) == (0.0, 0.0, 0.0)


def test_cameras_that_cannot_turn_are_named_and_none_is_turned(room, room_cameras, unchanged):
    """Parented to the splats they would take those along; a constraint has the last word."""
    first, second = list(room_cameras.objects)[3:5]
    second.parent = room
    bpy.context.view_layer.update()
    unchanged.start()
    with pytest.raises(RuntimeError, match=f"'{second.name}' turns with the splats"):
        bpy.ops.refine.turn_cameras()
    unchanged()
    second.parent = None
    first.constraints.new("TRACK_TO")
    bpy.context.view_layer.update()
    unchanged.start()
    with pytest.raises(RuntimeError, match=f"'{first.name}': has constraints"):
        bpy.ops.refine.turn_cameras()
    unchanged()
    bpy.context.scene.refine.collection = None
    with pytest.raises(RuntimeError, match="no cameras"):
        bpy.ops.refine.turn_cameras()


def ring():
    """Return the collection that was added last."""
    return bpy.data.collections["Ring of Cameras"]


def test_a_ring_sees_all_and_joins_the_collection_that_decides(addon, room, room_cameras, warned):
    """One camera decides; with the ring 17 do, and each of the ring sees nine tenths at least."""
    for camera in list(room_cameras.objects)[1:]:
        room_cameras.objects.unlink(camera)
    assert told(warned(), "One camera decides")
    room.location = (30.0, 0.0, 5.0)
    room_cameras.objects[0].location.x += 30.0
    bpy.context.view_layer.update()
    bpy.ops.refine.add_ring()
    found = warned()
    seen = {camera.name: camera.seen for camera in cameras(addon).values()}

    assert bpy.context.scene.refine.collection == room_cameras
    assert len(room_cameras.all_objects) == len(seen) == 17
    assert min(seen[camera.name] for camera in ring().objects) > 0.9 * 39755
    assert not told(found, "One camera decides")
    assert not told(found, "in no view")


@pytest.fixture
def plan(addon):
    """Give a plan of 100 splats, of which half go: 50 dB in the views, 36 in between."""
    curve = addon.core.quality.curve.Quality(
        *np.array([[0.2, 0.5], [55.0, 50.0], [57.0, 52.0]]), between=np.array([41.0, 36.2])
    )
    little = "21% of the splats lie in one view or none"
    return {
        "splats": 100, "unseen": 0, "unseen_gone": 0, "little_seen": little, "share": 0.5,
        "quality": curve, "becomes": "delete",
    }  # fmt: skip


def test_where_views_between_lose_more_that_is_said(addon, plan):
    """And where few splats lie in two views, but not beside many in none, which says more."""
    of_all = {"views_used": 8, "cameras": []}
    few, none = (addon.ui.plans.warnings(plan | {"unseen": count}, of_all) for count in (4, 5))

    assert few == ["Views between these lose more: about 36 dB", plan["little_seen"]]
    assert none == [few[0], "5% of the splats lie in no view; 0% of these go"]


@pytest.mark.parametrize("size", [(1920, 1080), (600, 900)])
def test_a_ring_frames_wide_and_tall_pictures(addon, room, size, warned):
    """The ball fits into the shorter side."""
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = size
    bpy.context.scene.refine.method = "closed-form"
    bpy.ops.refine.add_ring(count=5)
    warned()
    seen = [camera.seen for camera in cameras(addon).values()]

    assert len(seen) == 5
    assert min(seen) > 0.9 * len(room.data.vertices)


@pytest.mark.parametrize("source", ["ACTIVE", "SELECTED", "FRAMES", "VISIBLE"])
def test_a_ring_decides_with_the_cameras_that_did(room, room_cameras, source):
    """Of a chosen camera and a ring of three, four decide."""
    scene, camera = bpy.context.scene, room_cameras.objects[0]
    for other in list(room_cameras.objects)[1:]:
        bpy.data.objects.remove(other)
    scene.camera = camera
    camera.select_set(True)
    scene.refine.source = source
    bpy.ops.refine.add_ring(count=3)
    cameras = {obj for obj in bpy.context.view_layer.objects if obj.type == "CAMERA"}

    assert len(cameras) == 4
    if source == "VISIBLE":
        assert scene.refine.source == "VISIBLE"
        return
    assert scene.refine.source == "COLLECTION"
    chosen = set(scene.refine.collection.all_objects)
    assert chosen == (cameras if source != "FRAMES" else set(ring().objects))
    assert room not in chosen


def test_a_ring_needs_a_splat_somewhere(addon, room, unchanged):
    """Nowhere but at infinity there is nothing to look at."""
    places = np.full((39755, 3), np.inf, np.float32)
    addon.mesh.attributes.write_attribute(room.data, "position", "FLOAT_VECTOR", places)
    unchanged.start()
    with pytest.raises(RuntimeError, match="has no splat at a finite place"):
        bpy.ops.refine.add_ring()
    unchanged()


def test_cameras_that_see_nothing_or_all_from_afar_are_said(addon, room, room_cameras, warned):
    """One looks from 860 m behind, one is beside all; with the weight 0 both decide no more."""
    far, beside = list(room_cameras.objects)[:2]
    far.matrix_world = far.matrix_world @ mathutils.Matrix.Translation((0.0, 0.0, 860.0))
    beside.location.z += 1000.0
    bpy.context.view_layer.update()
    found = warned()
    listed = cameras(addon)
    far["refine_weight"] = beside["refine_weight"] = 0.0
    again = warned()

    assert told(found, "1 camera sees the splats from so far away")
    assert told(found, "No splat lies in the view of 1 camera")
    assert list(listed)[:2] == [beside.name, far.name]
    assert listed[far.name].seen > 30000
    assert listed[far.name].far
    assert (listed[beside.name].seen, listed[beside.name].far) == (0, False)
    assert len(cameras(addon)) == 70
    assert again == []


def test_pictures_are_without_what_must_go(addon, room, room_cameras):
    """A box forces some out: their share is none that the curve is of."""
    for camera in list(room_cameras.objects)[4:]:
        room_cameras.objects.unlink(camera)
    settings = bpy.context.scene.refine
    settings.method, settings.percent = "occlusion", 60.0
    bpy.ops.refine.add_volume(shape="BOX", role="REMOVE")
    bpy.context.view_layer.objects.active = room
    bpy.context.view_layer.update()
    bpy.ops.refine.score()
    checked = addon.mesh.layout.check(room)
    gone = addon.objects.demands.Demands.of_scene(bpy.context.scene).forced(checked).removed
    curve = addon.mesh.scores.stored_scores([checked], gone).quality
    removed = np.count_nonzero(read(addon, room, "refine_remove"))
    share = (removed - gone.sum()) / (len(gone) - gone.sum())
    expected = curve.of_views(share)
    listed = {c.name: c.psnr for c in cameras(addon).values() if c.psnr is not None}

    assert 1000 < gone.sum() < 0.5 * len(gone)
    assert listed == pytest.approx({name: expected[name] for name in listed}, abs=0.02)
    assert len(listed) == 4


def test_each_remedy_goes_with_one_undo(room, room_cameras):
    """The module pushes no undo steps by itself; a window does, for operators with UNDO."""
    names = room.name, room_cameras.objects[0].name
    bpy.context.view_layer.update()
    matrix = np.array(room_cameras.objects[0].matrix_world)
    bpy.ops.refine.score()
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.refine.turn_cameras()
    bpy.ops.refine.add_ring()
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()
    camera = bpy.data.objects[names[1]]

    assert np.array_equal(np.array(camera.matrix_world), matrix)
    assert "Ring of Cameras" not in bpy.data.collections
    assert bpy.context.scene.refine.protect == ""
    for name in ("turn_cameras", "add_ring"):
        assert "UNDO" in getattr(bpy.types, f"REFINE_OT_{name}").bl_options
