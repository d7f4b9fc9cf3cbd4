"""Guard rails: what each camera's picture loses, warnings beside Apply, a ring and a turn."""

import bpy
import mathutils
import numpy as np
import pytest

from .conftest import ROOM, read


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
def imported(few_file):
    """Return a function that imports splats and their cameras, each upright or not."""

    def imported(*, splats, cameras):
        bpy.ops.refine.import_ply(filepath=str(few_file), upright=splats)
        bpy.ops.refine.import_cameras(filepath=str(ROOM / "cameras.json"), upright=cameras)
        bpy.context.scene.refine.method = "closed-form"
        return bpy.context.object

    return imported


def told(warnings, words):
    return any(words in text for text in warnings)


def cameras(addon):
    """Return what the panel lists of each camera of the active object, by its name."""
    obj, ui = bpy.context.object, addon.ui
    plan = ui.plans.stored(obj, bpy.context.scene.refine)
    listed = ui.camera_operators.cameras(addon.mesh.scores.record(obj.data), plan["views"])
    return {name: (seen, psnr) for _, _, psnr, seen, name in listed}


def test_the_list_tells_how_close_each_picture_stays(addon, room, room_cameras):
    """What the curve says of each view that scored, at the budget of the moment; lowest first.
    Eight of the 72 views score; of the others nothing is known. A larger share brings all down,
    and by merging each gains what all of them gain on average. The closed form tells nothing."""
    settings = bpy.context.scene.refine
    bpy.ops.refine.score()
    assert {psnr for _, psnr in cameras(addon).values()} == {np.inf}
    settings.method, settings.views, settings.percent = "occlusion", 8, 30.0
    bpy.ops.refine.score()
    few = cameras(addon)
    curve = addon.mesh.scores.stored_scores([addon.mesh.layout.check(room)]).quality
    settings.percent = 80.0
    many = cameras(addon)
    settings.method = "merge"
    merged = cameras(addon)
    told = [name for name, (_, psnr) in few.items() if psnr < np.inf]
    gains = [merged[name][1] - many[name][1] for name in told]

    assert len(few) == len(room_cameras.objects) == 72
    assert told == list(few)[:8]
    expected = curve.of_views(int(0.3 * 39755) / 39755)
    assert [few[name][1] for name in told] == sorted(expected.values())
    assert all(many[name][1] < few[name][1] for name in told)
    assert np.ptp(gains) < 1e-3
    assert min(gains) > 3.0


@pytest.mark.parametrize(
    ("splats", "cameras", "turn_back"), [(True, False, False), (False, True, True)]
)
def test_one_upright_import_beside_one_that_is_not_is_told_and_put_right(
    addon, imported, warned, capfd, splats, cameras, turn_back
):
    """Known from the imports, before anything is scored; the command notes it too.
    A turn drops scores, price and warning; then the scores are those of imports that are alike."""
    obj, core = imported(splats=splats, cameras=cameras), addon.core
    settings = bpy.context.scene.refine
    assert "do not share an up axis" in capfd.readouterr().out
    assert addon.cameras.known_turn(bpy.context, obj) == (-1 if turn_back else 1)
    assert addon.mesh.scores.record(obj.data) is None
    first = warned()
    wrong = read(addon, obj, "refine_score")
    record = addon.mesh.scores.record(obj.data)
    turned = addon.core.quality.alignment.Alignment.from_facts(record["alignment"]).turn
    views = addon.cameras.CameraChoice.of_scene(bpy.context.scene).views(bpy.context, obj)
    report = addon.objects.splat_group.prune_object(
        obj.name, views, core.Budget(ratio=0.5), core.ClosedForm(), dry_run=True
    )
    bpy.ops.refine.turn_cameras(quarters=-1 if turn_back else 1)
    assert addon.mesh.scores.record(obj.data) is addon.ui.plans.stored(obj, settings) is None
    left = {"refine_score", "refine_rank", "refine_remove", "refine_scored"}
    assert not left & set(obj.data.attributes.keys())
    assert not bpy.ops.refine.apply.poll()
    assert addon.cameras.known_turn(bpy.context, obj) == 0
    second = warned()
    right = read(addon, obj, "refine_score")
    bpy.ops.wm.read_homefile(use_empty=True)
    alike = imported(splats=splats, cameras=splats)

    assert not told(warned() + second, "up axis")
    assert turned == (-1 if turn_back else 1)
    assert told(first, "imported upright")
    assert told(report["notes"], "do not share an up axis")
    assert np.allclose(right, read(addon, alike, "refine_score"), rtol=2e-3)
    assert not np.allclose(wrong, right, rtol=0.1)


def test_animated_cameras_are_turned_with_their_motion(few, room_cameras):
    """What is keyed stays keyed, under a parent that turns: at both frames a quarter about X."""
    camera, scene = room_cameras.objects[0], bpy.context.scene
    for frame, x in ((1, 0.0), (9, 4.0)):
        camera.location = (x, 1.0, 2.0)
        camera.keyframe_insert("location", frame=frame)
    scene.camera, scene.refine.source = camera, "FRAMES"
    bpy.ops.refine.turn_cameras()

    for frame, x in ((1, 0.0), (9, 4.0)):
        scene.frame_set(frame)
        assert (camera.matrix_world.translation - mathutils.Vector((x, 2.0, -1.0))).length < 1e-5
    assert tuple(few.location) == (0.0, 0.0, 0.0)


def test_cameras_that_cannot_turn_are_named_and_none_is_turned(few, room_cameras, unchanged):
    """Parented to the splats they would take those along; a constraint has the last word."""
    first, second = list(room_cameras.objects)[3:5]

    def is_refused(words):
        bpy.context.view_layer.update()
        unchanged.start()
        with pytest.raises(RuntimeError, match=words):
            bpy.ops.refine.turn_cameras()
        unchanged()

    second.parent = few
    is_refused(f"'{second.name}' turns with the splats")
    second.parent = None
    first.constraints.new("TRACK_TO")
    is_refused(f"'{first.name}': has constraints")
    bpy.context.scene.refine.collection = None
    is_refused("no cameras")


def test_a_ring_sees_all_and_joins_the_collection_that_decides(addon, few, room_cameras, warned):
    """One camera decides; with the ring 17 do, and each of the ring sees nine tenths at least."""
    assert warned() == []
    for camera in list(room_cameras.objects)[1:]:
        room_cameras.objects.unlink(camera)
    of_one = warned()
    unseen, goes = (read(addon, few, f"refine_{name}") for name in ("seen", "remove"))
    goes = goes[unseen == 0].mean()
    few.location = (30.0, 0.0, 5.0)
    room_cameras.objects[0].location.x += 30.0
    bpy.context.view_layer.update()
    bpy.ops.refine.add_ring()
    found = warned()
    seen = {name: seen for name, (seen, _) in cameras(addon).items()}

    assert told(of_one, "Few cameras decide: add others")
    share = np.mean(unseen == 0)
    assert of_one[1] == f"{share:.0%} of the splats lie in no view; {goes:.0%} of these go"
    assert bpy.context.scene.refine.collection == room_cameras
    assert len(room_cameras.all_objects) == len(seen) == 17
    ring = bpy.data.collections["Ring of Cameras"].objects
    assert min(seen[camera.name] for camera in ring) > 0.9 * 3976
    assert not told(found, "Few cameras decide")
    assert not told(found, "in no view")
    places = np.full((3976, 3), np.inf, np.float32)
    addon.mesh.attributes.write_attribute(few.data, "position", "FLOAT_VECTOR", places)
    with pytest.raises(RuntimeError, match="has no splat at a finite place"):
        bpy.ops.refine.add_ring()


@pytest.mark.parametrize("source", ["ACTIVE", "FRAMES", "VISIBLE"])
def test_a_ring_decides_with_the_camera_that_did(room_cameras, few, source):
    """Those of a shot are no more asked."""
    scene, camera = bpy.context.scene, room_cameras.objects[0]
    scene.camera, scene.refine.source = camera, source
    bpy.ops.refine.add_ring(count=3)
    settings, ring = scene.refine, set(bpy.data.collections["Ring of Cameras"].objects)

    assert settings.source == ("VISIBLE" if source == "VISIBLE" else "COLLECTION")
    if source != "VISIBLE":
        chosen = set(settings.collection.all_objects)
        assert chosen == (ring if source == "FRAMES" else {camera, *ring})
