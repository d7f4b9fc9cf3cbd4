"""Guard rails: what each camera's picture loses, warnings beside Apply, and their remedies."""

from __future__ import annotations

import bpy
import mathutils
import numpy as np
import pytest

from tests.e2e.inside.clouds import as_cloud

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


def remedies(warnings):
    """Return the names of the operators that help."""
    return [warning.remedy for warning in warnings]


def test_the_list_tells_how_close_each_picture_stays(addon, room, room_cameras):
    """What the curve says of each view that scored, at the budget of the moment; most changes one.

    Eight of the 72 views score; of the others nothing is known. A larger share brings all down.
    """
    settings, manager = bpy.context.scene.refine, bpy.context.window_manager
    settings.method, settings.views, settings.percent = "occlusion", 8, 30.0
    bpy.ops.refine.score()
    few = {item.name: item.psnr for item in manager.refine_cameras}
    curve = addon.mesh.scores.stored_scores([addon.mesh.layout.check(room)]).quality
    settings.percent = 80.0
    many = {item.name: item.psnr for item in manager.refine_cameras}
    told = [name for name, psnr in few.items() if psnr >= 0.0]

    assert len(few) == len(room_cameras.objects) == 72
    assert len(told) == 8
    removed = int(0.3 * 39755) / 39755
    assert [few[name] for name in told] == pytest.approx(
        [curve.of_views(removed)[name] for name in told], abs=1e-4
    )
    assert all(many[name] < few[name] for name in told)
    assert manager.refine_changes_most == min(told, key=many.__getitem__)


def test_merging_changes_less(room, room_cameras):
    """Each picture gains what all of them gain on average: 39,755 splats are enough to foretell."""
    settings, manager = bpy.context.scene.refine, bpy.context.window_manager
    settings.method, settings.views, settings.percent = "occlusion", 4, 50.0
    bpy.ops.refine.score()
    deleted = {item.name: item.psnr for item in manager.refine_cameras}
    settings.method = "merge"
    gains = {i.name: i.psnr - deleted[i.name] for i in manager.refine_cameras if i.psnr >= 0.0}

    assert len(gains) == 4
    assert np.ptp(list(gains.values())) < 1e-3
    assert min(gains.values()) > 3.0


def test_nothing_is_told_of_pictures_without_an_estimate(room, room_cameras):
    """The closed form makes none."""
    bpy.ops.refine.score()
    manager = bpy.context.window_manager

    assert {item.psnr for item in manager.refine_cameras} == {-1.0}
    assert manager.refine_changes_most == ""


@pytest.mark.parametrize(
    ("splats", "cameras", "quarter"), [(True, False, "1"), (False, True, "-1")]
)
def test_one_upright_import_beside_one_that_is_not_is_told_and_put_right(
    addon, imported, warned, splats, cameras, quarter
):
    """Known from the imports; after the turn the scores are those of imports that are alike."""
    obj = imported(splats=splats, cameras=cameras)
    first = warned()
    wrong = read(addon, obj, "refine_score")
    turn = next(warning for warning in first if warning.remedy == "refine.turn_cameras")
    bpy.ops.refine.turn_cameras(**turn.options)
    second = warned()
    right = read(addon, obj, "refine_score")
    matrix = bpy.context.scene.refine.collection.objects[0].matrix_world.copy()
    bpy.ops.wm.read_homefile(use_empty=True)
    alike = imported(splats=splats, cameras=splats)
    bpy.ops.refine.score()

    assert turn.options == {"quarter": quarter}
    assert "imported upright" in turn.text
    assert "refine.turn_cameras" not in remedies(second)
    assert np.allclose(right, read(addon, alike, "refine_score"), rtol=2e-3)
    assert not np.allclose(wrong, right, rtol=0.1)
    other = bpy.context.scene.refine.collection.objects[0].matrix_world
    assert np.allclose(np.array(matrix), np.array(other), atol=1e-5)


def test_the_command_notes_what_the_panel_warns_of(addon, imported):
    """On an object of the scene, by the cameras that the panel chooses."""
    obj = imported(splats=True, cameras=False)
    views = addon.cameras.sets.CameraChoice.of_scene(bpy.context.scene).views(bpy.context, obj)
    report = addon.objects.operation.prune_object(
        obj.name, views, addon.core.Budget(ratio=0.5), addon.core.ClosedForm(), dry_run=True
    )

    assert [note for note in report["notes"] if "do not share an up axis" in note]


@pytest.mark.parametrize("upright", [False, True])
def test_imports_that_are_alike_are_not_warned_of(imported, warned, upright):
    """Nor once both are moved together, nor by a shot that the cameras' file does not have."""
    obj = imported(splats=upright, cameras=upright)
    before = remedies(warned())
    motion = mathutils.Matrix.Translation((3.0, 4.0, 5.0)) @ mathutils.Matrix.Rotation(1.0, 4, "Z")
    for item in (obj, *bpy.context.scene.refine.collection.objects):
        item.matrix_world = motion @ item.matrix_world
    bpy.context.view_layer.update()
    after = remedies(warned())

    assert "refine.turn_cameras" not in before + after


def test_cameras_of_unknown_origin_are_measured(imported, warned):
    """Without their note, cameras that were not turned upright see coarse pictures."""
    imported(splats=True, cameras=False)
    settings = bpy.context.scene.refine
    for camera in settings.collection.objects:
        del camera["refine_view"]
    settings.method, settings.views = "occlusion", 12
    found = [warning for warning in warned() if warning.remedy == "refine.turn_cameras"]

    assert [warning.options for warning in found] == [{"quarter": "1"}]
    assert "times as fine" in found[0].text


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
    bpy.ops.refine.turn_cameras(quarter="1")

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
        bpy.ops.refine.turn_cameras(quarter="1")
    unchanged()
    second.parent = None
    first.constraints.new("TRACK_TO")
    bpy.context.view_layer.update()
    unchanged.start()
    with pytest.raises(RuntimeError, match=f"'{first.name}': has constraints"):
        bpy.ops.refine.turn_cameras(quarter="1")
    unchanged()
    bpy.context.scene.refine.collection = None
    with pytest.raises(RuntimeError, match="no cameras"):
        bpy.ops.refine.turn_cameras(quarter="1")


def ring():
    """Return the collection that was added last."""
    return bpy.data.collections["Ring of Cameras"]


def test_a_ring_sees_all_and_joins_the_collection_that_decides(room, room_cameras, warned):
    """One camera decides; with the ring 17 do, and each of the ring sees nine tenths at least."""
    for camera in list(room_cameras.objects)[1:]:
        room_cameras.objects.unlink(camera)
    assert "refine.add_ring" in remedies(warned())
    room.location = (30.0, 0.0, 5.0)
    room_cameras.objects[0].location.x += 30.0
    bpy.context.view_layer.update()
    bpy.ops.refine.add_ring()
    found = warned()
    seen = {item.name: item.seen for item in bpy.context.window_manager.refine_cameras}

    assert bpy.context.scene.refine.collection == room_cameras
    assert len(room_cameras.all_objects) == len(seen) == 17
    assert min(seen[camera.name] for camera in ring().objects) > 0.9 * 39755
    assert "refine.add_ring" not in remedies(found)
    assert "refine.keep_unseen" not in remedies(found)


@pytest.mark.usefixtures("room")
def test_views_between_join_the_cameras_that_decide(room_cameras):
    """Each stands halfway between two cameras, and the panel's limit leaves room for all."""
    settings = bpy.context.scene.refine
    settings.views = 64
    where = [np.array(camera.location) for camera in room_cameras.objects]
    bpy.ops.refine.add_between(count=10)

    added = bpy.data.collections["Views Between"].objects
    halves = [(one + other) / 2 for one in where for other in where]
    assert len(added) == 10
    assert len(room_cameras.all_objects) == 82
    assert settings.views == 74
    for camera in added:
        place = np.array(camera.location)
        assert min(np.abs(half - place).max() for half in halves) < 1e-5


@pytest.mark.usefixtures("room")
def test_where_nothing_is_between_no_camera_is_added(room_cameras, unchanged):
    """One camera has no neighbour; a shot has frames, not cameras."""
    for camera in list(room_cameras.objects)[1:]:
        room_cameras.objects.unlink(camera)
    bpy.context.view_layer.update()
    unchanged.start()
    with pytest.raises(RuntimeError, match="nothing is between them"):
        bpy.ops.refine.add_between()
    bpy.context.scene.refine.source = "FRAMES"
    with pytest.raises(RuntimeError, match="a shot decides"):
        bpy.ops.refine.add_between()
    bpy.context.scene.refine.source = "COLLECTION"
    unchanged()


def test_where_views_between_lose_more_they_are_offered(addon):
    """The plan's sentence says both, and the warning's button adds them."""
    plans = addon.ui.plans
    plan = {"splats": 100, "unseen": 0, "psnr_between": 36.2, "parted": True}

    found = plans.warnings(plan, {"views_used": 8, "cameras": []})

    assert remedies(found) == ["refine.add_between"]
    assert "about 36 dB" in found[0].text


def test_where_few_splats_lie_in_two_views_a_ring_is_offered(addon):
    """But not beside the warning that many lie in none, which says more."""
    plan = {"splats": 100, "unseen": 4, "little_seen": "21% of the splats lie in one view or none"}

    few, none = (
        addon.ui.plans.warnings(plan | {"unseen": unseen}, {"views_used": 8, "cameras": []})
        for unseen in (4, 5)
    )

    assert [warned.text for warned in few] == [plan["little_seen"]]
    assert remedies(few) == ["refine.add_ring"]
    assert "in no view" in none[0].text
    assert len(none) == 1


@pytest.mark.parametrize("size", [(1920, 1080), (600, 900)])
def test_a_ring_frames_wide_and_tall_pictures(room, size, warned):
    """The ball fits into the shorter side."""
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = size
    bpy.context.scene.refine.method = "closed-form"
    bpy.ops.refine.add_ring(count=5)
    warned()
    seen = [item.seen for item in bpy.context.window_manager.refine_cameras]

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


def test_cameras_that_see_nothing_or_all_from_afar_are_left_out(room, room_cameras, warned):
    """One looks from 860 m behind, one is beside all: both get weight 0 and are listed no more."""
    far, beside = list(room_cameras.objects)[:2]
    far.matrix_world = far.matrix_world @ mathutils.Matrix.Translation((0.0, 0.0, 860.0))
    beside.location.z += 1000.0
    bpy.context.view_layer.update()
    found = warned()
    texts = " ".join(warning.text for warning in found)
    marks = {item.name: (item.seen, item.far) for item in bpy.context.window_manager.refine_cameras}
    bpy.ops.refine.leave_out()
    again = warned()

    assert "1 camera sees the splats from so far away" in texts
    assert "No splat lies in the view of 1 camera" in texts
    assert remedies(found).count("refine.leave_out") == 2
    assert marks[far.name][0] > 30000
    assert marks[far.name][1]
    assert marks[beside.name] == (0, False)
    assert far["refine_weight"] == beside["refine_weight"] == 0.0
    assert "refine_weight" not in room_cameras.objects[5]
    assert len(bpy.context.window_manager.refine_cameras) == 70
    assert again == []


def test_the_last_camera_is_not_left_out(room, room_cameras, warned):
    """Where all are useless the remedy is a ring; nothing is left out of what was not scored."""
    with pytest.raises(RuntimeError, match="score first"):
        bpy.ops.refine.leave_out()
    for camera in list(room_cameras.objects)[1:]:
        room_cameras.objects.unlink(camera)
    camera = room_cameras.objects[0]
    camera.matrix_world = camera.matrix_world @ mathutils.Matrix.Translation((0.0, 0.0, 860.0))
    bpy.context.view_layer.update()

    assert "refine.leave_out" not in remedies(warned())
    with pytest.raises(RuntimeError, match="no camera would be left"):
        bpy.ops.refine.leave_out()
    assert "refine_weight" not in camera


@pytest.mark.parametrize("native", [False, True])
def test_what_is_unseen_stays_with_what_was_protected(addon, room, room_cameras, warned, native):
    """A third of the splats were protected; then what no view sees is too, and less else goes."""
    for camera in list(room_cameras.objects)[1:]:
        room_cameras.objects.unlink(camera)
    marks = np.arange(39755) % 3 == 0
    addon.mesh.attributes.write_attribute(room.data, "mine", "BOOLEAN", marks)
    settings = bpy.context.scene.refine
    settings.protect, settings.percent = "mine", 10.0
    if native:
        as_cloud(addon, room)
    obj = bpy.context.object
    found = warned()
    unseen = read(addon, obj, "refine_seen") == 0
    before = read(addon, obj, "refine_remove")
    bpy.ops.refine.keep_unseen()
    gone = read(addon, obj, "refine_remove")
    plan = addon.ui.plans.stored(obj, settings)
    record = addon.mesh.scores.record(obj.data)
    after = [w for w in addon.ui.plans.warnings(plan, record) if "in no view" in w.text]

    assert obj.type == ("POINTCLOUD" if native else "MESH")
    assert "refine.keep_unseen" in remedies(found)
    assert unseen.mean() > 0.5
    assert (before & unseen).any()
    assert np.array_equal(read(addon, obj, addon.mesh.edit.PROTECT), unseen)
    assert not (gone & (unseen | marks)).any()
    assert gone.sum() == before.sum() == 3975
    assert after[0].remedy == ""
    assert "0% of these go" in after[0].text


def test_what_must_go_is_not_kept_and_pictures_are_without_it(addon, room, room_cameras):
    """A box forces some out: they lie in no view, and their share is none that the curve is of."""
    for camera in list(room_cameras.objects)[4:]:
        room_cameras.objects.unlink(camera)
    settings, manager = bpy.context.scene.refine, bpy.context.window_manager
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
    listed = {item.name: item.psnr for item in manager.refine_cameras if item.psnr >= 0.0}
    bpy.ops.refine.keep_unseen()

    assert 1000 < gone.sum() < 0.5 * len(gone)
    assert listed == pytest.approx({name: expected[name] for name in listed}, abs=0.02)
    assert len(listed) == 4
    kept = read(addon, room, addon.mesh.edit.PROTECT)
    assert kept.any()
    assert not (kept & gone).any()


def test_unseen_splats_are_known_of_scores_alone(room, unchanged):
    """Without scores there is nothing to keep."""
    unchanged.start()
    with pytest.raises(RuntimeError, match="score it first"):
        bpy.ops.refine.keep_unseen()
    unchanged()


def test_each_remedy_goes_with_one_undo(room, room_cameras):
    """The module pushes no undo steps by itself; a window does, for operators with UNDO."""
    names = room.name, room_cameras.objects[0].name
    bpy.context.view_layer.update()
    matrix = np.array(room_cameras.objects[0].matrix_world)
    bpy.ops.refine.score()
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.refine.keep_unseen()
    bpy.ops.refine.turn_cameras(quarter="1")
    bpy.ops.refine.add_ring()
    bpy.ops.ed.undo_push(message="after")
    bpy.ops.ed.undo()
    room, camera = (bpy.data.objects[name] for name in names)

    assert np.array_equal(np.array(camera.matrix_world), matrix)
    assert "refine_protect" not in room.data.attributes
    assert "Ring of Cameras" not in bpy.data.collections
    assert bpy.context.scene.refine.protect == ""
    for name in ("turn_cameras", "add_ring", "leave_out", "keep_unseen"):
        assert "UNDO" in getattr(bpy.types, f"REFINE_OT_{name}").bl_options


def test_buttons_go_once_the_cameras_have_changed(addon, room, room_cameras, monkeypatch):
    """A second click would turn twice: the warning stays, the button waits for new scores."""
    drawn = []
    panel = addon.ui.panel
    monkeypatch.setattr(panel.wrapped, "label", lambda *args, **_: drawn.append(args[2]))

    class Layout:
        """Notes buttons."""

        def panel(self, _name):
            """Return a part that is closed."""
            return self, None

        def label(self, **_options):
            """Draw nothing."""

        def operator(self, name, **_options):
            """Note a button."""
            drawn.append(name)
            return type("Button", (), {})()

    def draw():
        drawn.clear()
        panel._draw_plan(Layout(), bpy.context, addon.mesh.scores.record(room.data))
        return list(drawn)

    for camera in list(room_cameras.objects)[1:]:
        room_cameras.objects.unlink(camera)
    bpy.ops.refine.score()
    fresh = draw()
    bpy.ops.refine.add_ring()
    bpy.context.view_layer.update()
    stale = draw()

    assert {"refine.add_ring", "refine.keep_unseen"} <= set(fresh)
    assert not [text for text in stale if text.startswith("refine.")]
    assert any(text.startswith("One camera decides") for text in stale)
