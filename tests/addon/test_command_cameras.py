"""Which cameras decide when the command prunes an object: those of the panel, or those it names."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import bpy
import pytest

ROOM = Path(__file__).parents[1] / "data/room_small"

CLOSED = ["--method", "closed-form"]


@pytest.fixture
def animated(room, room_cameras, tmp_path):
    """Bind three cameras to markers and turn the room, which has a collection of five as well.

    All 72 are visible; the first is active, the second is selected.
    """
    scene = bpy.context.scene
    few = bpy.data.collections.new("few")
    scene.collection.children.link(few)
    cameras = list(room_cameras.objects)
    for camera in cameras[10:15]:
        few.objects.link(camera)
    for frame, camera in ((1, cameras[0]), (11, cameras[20]), (21, cameras[40])):
        scene.timeline_markers.new(camera.name, frame=frame).camera = camera
    for frame, angle in ((1, 0.0), (21, math.radians(40.0))):
        room.rotation_euler.z = angle
        room.keyframe_insert("rotation_euler", frame=frame)
    scene.camera = cameras[0]
    cameras[1].select_set(True)
    settings = scene.refine
    scene.frame_start, scene.frame_end = 1, 21
    settings.frame_step = 5
    scene.frame_set(1)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    return few


def pruned_by_panel(folder):
    """Save the scene; return what Score, Apply and Export make of it; open it as it was saved."""
    made = folder / "panel.ply"
    bpy.ops.wm.save_mainfile()
    assert bpy.ops.refine.score() == {"FINISHED"}
    assert bpy.ops.refine.apply() == {"FINISHED"}
    assert bpy.ops.refine.export_ply(filepath=str(made)) == {"FINISHED"}
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    bpy.context.view_layer.objects.active = None  # the command goes by the name alone
    return made.read_bytes()


def pruned(addon, folder, *options):
    """Return the file that `prune --object room` makes, and what the report says of the cameras."""
    out, told = folder / "out.ply", folder / "report.json"
    words = ["prune", "--object", "room", "-o", str(out), "--report", str(told), "--overwrite"]
    assert addon.command.main([*words, *CLOSED, *options], scene=True) == 0
    return out.read_bytes(), json.loads(told.read_text())["results"][0]["cameras"]


CHOICES = {
    "COLLECTION": (
        ["--source", "collection:few"],
        {"source": "collection", "collection": "few", "words": "those in collection 'few'"},
    ),
    "FRAMES": (
        ["--source", "frames:1:21:5"],
        {
            "source": "frames",
            "frames": {"first": 1, "last": 21, "step": 5},
            "words": "the active one at frames 1 to 21, every 5",
        },
    ),
    "ACTIVE": (["--source", "active"], {"source": "active", "words": "the active one"}),
    "SELECTED": (["--source", "selected"], {"source": "selected", "words": "the selected ones"}),
    "VISIBLE": (["--source", "visible"], {"source": "visible", "words": "all visible ones"}),
}


@pytest.mark.parametrize("source", CHOICES)
def test_panel_and_command_keep_the_same_set_of_a_saved_scene(addon, animated, tmp_path, capsys,
                                                              source):  # fmt: skip
    """To the byte, by the saved choice and by the same one as an option; another one differs."""
    options, facts = CHOICES[source]
    other = "VISIBLE" if source != "VISIBLE" else "COLLECTION"
    settings = bpy.context.scene.refine
    settings.source, settings.collection = source, animated
    by_panel = pruned_by_panel(tmp_path)
    saved, saved_facts = pruned(addon, tmp_path)
    bpy.context.scene.refine.source = other
    given, given_facts = pruned(addon, tmp_path, *options)
    changed, _ = pruned(addon, tmp_path)

    assert saved == by_panel
    assert given == by_panel
    assert changed != by_panel
    words = facts["words"]
    assert saved_facts == facts | {"words": f"{words}, as chosen in the panel"}
    assert given_facts == facts | {"words": f"{words}, as the command line says"}
    said = capsys.readouterr().out
    assert f"\n  cameras: {words}, as chosen in the panel\n" in said
    assert f"\n  cameras: {words}, as the command line says\n" in said


def test_an_object_is_scored_as_its_file_is(addon, room, room_cameras, tmp_path, capsys):
    """By the collection that holds the cameras of the file: equal bytes, and nothing is changed."""
    assert bpy.context.scene.refine.collection == room_cameras
    source, cameras = ROOM / "point_cloud.ply", ROOM / "cameras.json"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    attributes = sorted(room.data.attributes.keys())
    told = tmp_path / "report.json"
    by_object = ["score", "--object", "room", "-o", str(tmp_path / "object.ply"), *CLOSED]
    by_file = ["score", str(source), "--cameras", str(cameras), "-o", str(tmp_path / "file.ply")]

    assert addon.command.main([*by_object, "--report", str(told)], scene=True) == 0
    assert addon.command.main([*by_file, *CLOSED]) == 0
    assert (tmp_path / "object.ply").read_bytes() == (tmp_path / "file.ply").read_bytes()
    assert sorted(room.data.attributes.keys()) == attributes
    words = "those in collection 'cameras', as chosen in the panel"
    assert f"\n  cameras: {words}\n" in capsys.readouterr().out
    entry = json.loads(told.read_text())["results"][0]
    assert entry["files"]["input"] == f"{bpy.data.filepath}#room"
    assert entry["cameras"]["words"] == words


def test_an_object_is_scored_by_the_cameras_that_are_named(addon, animated, tmp_path):
    """By another choice it scores otherwise; an output that exists is refused."""
    outputs = [tmp_path / f"{name}.ply" for name in ("five", "one")]
    for output, source in zip(outputs, (f"collection:{animated.name}", "active"), strict=True):
        words = ["score", "--object", "room", "-o", str(output), "--source", source, *CLOSED]
        assert addon.command.main(words, scene=True) == 0
        assert addon.command.main(words, scene=True) == 1

    assert outputs[0].read_bytes() != outputs[1].read_bytes()


def test_frames_without_a_range_are_those_of_the_panel(addon, animated, tmp_path):
    """`frames` is `frames:1:21:5` there; `frames:1:21` is another range."""
    short, facts = pruned(addon, tmp_path, "--source", "frames")
    same, _ = pruned(addon, tmp_path, "--source", "frames:1:21:5")
    other, other_facts = pruned(addon, tmp_path, "--source", "frames:1:21")

    assert facts["frames"] == {"first": 1, "last": 21, "step": 5}
    assert short == same
    assert other != same
    assert other_facts["words"] == "the active one at frames 1 to 21, as the command line says"


def test_the_other_settings_of_the_panel_do_not_count(addon, animated, tmp_path):
    """Method, views and budget are the command's: half of the splats, by closed form."""
    settings = bpy.context.scene.refine
    settings.source, settings.collection = "COLLECTION", animated
    before, _ = pruned(addon, tmp_path)
    settings.method, settings.views, settings.budget, settings.keep = "occlusion", 2, "keep", 7

    assert pruned(addon, tmp_path)[0] == before


def test_cameras_of_a_file_go_before_those_of_the_panel(addon, animated, tmp_path):
    """An empty collection is chosen, and --cameras still works."""
    settings = bpy.context.scene.refine
    settings.source, settings.collection = "COLLECTION", bpy.data.collections.new("empty")
    views = [
        {
            "position": [0.0, 0.0, -3.0],
            "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
            "fx": 200.0,
            "fy": 200.0,
            "width": 240,
            "height": 160,
        }
    ]
    cameras = tmp_path / "cameras.json"
    cameras.write_text(json.dumps(views))
    assert animated.objects

    facts = pruned(addon, tmp_path, "--cameras", str(cameras))[1]

    assert facts == {"source": "file", "file": str(cameras)}


def _no_camera():
    scene = bpy.context.scene
    scene.timeline_markers.clear()
    scene.camera, scene.refine.source = None, "ACTIVE"


def _nothing_chosen():
    settings = bpy.context.scene.refine
    settings.source, settings.collection = "COLLECTION", None


REFUSED = {
    "no such collection": (
        lambda: None,
        ["--source", "collection:fwe"],
        r"room: no collection 'fwe' in the open \.blend \(collections: cameras, few\)",
    ),
    "no active camera": (_no_camera, [], "room: no cameras: scene 'Scene' has no active camera"),
    "no active camera at a frame": (
        _no_camera,
        ["--source", "frames:1:2"],
        "no active camera at frame 1",
    ),
    "no collection chosen": (_nothing_chosen, [], "room: no cameras: choose the collection"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_choice_without_cameras_is_refused(addon, animated, tmp_path, capsys, unchanged, case):
    """Code 1, one sentence; it stands in the report too, and the scene is as it was."""
    change, options, expected = REFUSED[case]
    change()
    told = tmp_path / "report.json"
    words = ["prune", "--object", "room", "--dry-run", "--report", str(told), *CLOSED, *options]
    unchanged.start()
    code = addon.command.main(words, scene=True)

    assert code == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    entry = json.loads(told.read_text())["results"][0]
    assert error == f"refine: error: {entry['error']}\n"
    assert re.search(expected, error)
    unchanged()


def test_two_choices_are_one_too_many(addon, animated, capsys):
    """Wrong usage, code 2."""
    words = ["prune", "--object", "room", "--dry-run", "--source", "active", "--cameras", "c.json"]

    assert addon.command.main(words, scene=True) == 2
    assert "expected --cameras or --source, and not both" in capsys.readouterr().err


def test_the_cameras_of_files_are_chosen_too(addon, animated, tmp_path):
    """By the active camera a file scores otherwise than by all visible ones."""
    source, out = str(ROOM / "point_cloud.ply"), [tmp_path / "all.ply", tmp_path / "one.ply"]

    for path, options in zip(out, ([], ["--source", "active"]), strict=True):
        words = ["score", source, "-o", str(path), *CLOSED, *options]
        assert addon.command.main(words, scene=True) == 0

    assert out[0].read_bytes() != out[1].read_bytes()
    assert addon.command.main(["score", source, "-o", "x.ply", "--source", "active"]) == 2


@pytest.mark.usefixtures("room_cameras")
@pytest.mark.parametrize("kind", ["EMPTY", "CAMERA", "protected CAMERA"])
def test_an_object_without_splats_is_refused_in_a_sentence(addon, tmp_path, kind):
    """It may have no data, or data without attributes."""
    obj = bpy.data.objects.new("Odd", None if kind == "EMPTY" else bpy.data.cameras.new("Odd"))
    bpy.context.scene.collection.objects.link(obj)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    told = tmp_path / "report.json"
    words = ["prune", "--object", "Odd", "--dry-run", *CLOSED, "--report", str(told)]
    if kind.startswith("protected"):
        words += ["--protect", "statue"]

    assert addon.command.main(words, scene=True) == 1
    error = json.loads(told.read_text())["results"][0]["error"]
    assert "Odd" in error or "statue" in error
    assert "Traceback" not in error
