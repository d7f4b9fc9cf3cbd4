"""Which cameras decide when the command prunes an object: those of the panel, or those it names."""

import json
import math
import re

import bpy
import pytest

from .conftest import ROOM, linked

CAMERAS = ROOM / "cameras.json"
CLOSED = ["--method", "closed-form"]
PRUNE = ["prune", "--object", "room"]


@pytest.fixture
def animated(quarter, room_cameras, tmp_path):
    """Turn the room; markers bind three cameras, one is active, one selected, five collected."""
    scene = bpy.context.scene
    few = bpy.data.collections.new("few")
    scene.collection.children.link(few)
    cameras = list(room_cameras.objects)
    for camera in cameras[10:15]:
        few.objects.link(camera)
    for frame, camera in ((1, cameras[0]), (11, cameras[20]), (21, cameras[40])):
        scene.timeline_markers.new(camera.name, frame=frame).camera = camera
    for frame, angle in ((1, 0.0), (21, math.radians(40.0))):
        quarter.rotation_euler.z = angle
        quarter.keyframe_insert("rotation_euler", frame=frame)
    scene.camera = cameras[0]
    cameras[1].select_set(True)
    scene.frame_start, scene.frame_end, scene.refine.frame_step = 1, 21, 5
    scene.frame_set(1)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    return few


def pruned(addon, folder, *options):
    """Return the file that `prune --object room` makes, and what the report says of the cameras."""
    out, told = folder / "out.ply", folder / "report.json"
    words = [*PRUNE, "-o", str(out), "--report", str(told), "--overwrite"]
    assert addon.command.main([*words, *CLOSED, *options], scene=True) == 0
    return out.read_bytes(), json.loads(told.read_text())["results"][0]["cameras"]


SHOT = (
    {"frames": {"first": 1, "last": 21, "step": 5}},
    "the active one at frames 1 to 21, every 5",
)
CHOICES = {
    "collection:few": ({"collection": "few"}, "those in collection 'few'"),
    "frames:1:21:5": SHOT,
    "frames": SHOT,  # of the panel's range
    "active": ({}, "the active one"),
    "selected": ({}, "the selected ones"),
    "visible": ({}, "all visible ones"),
}


@pytest.mark.parametrize("option", CHOICES)
def test_panel_and_command_keep_the_same_set_of_a_saved_scene(addon, animated, tmp_path, option):
    """To the byte, by the choice saved or given; method and budget are the command's."""
    (facts, words), source = CHOICES[option], option.split(":")[0]
    settings, made = bpy.context.scene.refine, tmp_path / "panel.ply"
    settings.source, settings.collection = source.upper(), animated
    bpy.ops.wm.save_mainfile()
    for name, values in (("score", {}), ("apply", {}), ("export_ply", {"filepath": str(made)})):
        assert getattr(bpy.ops.refine, name)(**values) == {"FINISHED"}
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    bpy.context.view_layer.objects.active = None  # the command goes by the name alone
    settings = bpy.context.scene.refine
    settings.method, settings.views, settings.budget, settings.keep = "occlusion", 2, "keep", 7
    saved, saved_facts = pruned(addon, tmp_path)
    settings.source = "COLLECTION" if source == "visible" else "VISIBLE"
    given, given_facts = pruned(addon, tmp_path, "--source", option)
    assert saved == given == made.read_bytes()
    assert pruned(addon, tmp_path)[0] != saved
    facts = {"source": source, **facts}
    assert saved_facts == {**facts, "words": f"{words}, as chosen in the panel"}
    assert given_facts == {**facts, "words": f"{words}, as the command line says"}


def test_an_object_is_scored_as_its_file_is(addon, animated, quarter, quarter_file, tmp_path):
    """By the cameras of the panel or named ones: equal bytes, and nothing is changed."""
    attributes, told = sorted(quarter.data.attributes.keys()), tmp_path / "report.json"
    of_file, made = ["score", str(quarter_file)], {}
    for choice, options in (
        ("panel", []), ("active", ["--source", "active"]), ("visible", ["--source", "visible"])
    ):  # fmt: skip
        out, expected = (tmp_path / f"{choice}{name}.ply" for name in ("", "-file"))
        words = ["score", "--object", "room", "-o", str(out), *options, *CLOSED]
        assert addon.command.main([*words, "--report", str(told), "--overwrite"], scene=True) == 0
        cameras = options or ["--cameras", str(CAMERAS)]
        words = [*of_file, "-o", str(expected), *cameras, *CLOSED]
        assert addon.command.main(words, scene=True) == 0
        made[choice] = out.read_bytes()
        assert made[choice] == expected.read_bytes()
        entry = json.loads(told.read_text())["results"][0]
        assert entry["files"]["input"] == f"{bpy.data.filepath}#room"
        assert addon.command.main(words, scene=True) == 1  # the file exists
    assert made["active"] != made["visible"] == made["panel"]
    assert sorted(quarter.data.attributes.keys()) == attributes
    words = [*of_file, "-o", str(tmp_path / "out.ply"), "--source", "active"]
    assert addon.command.main(words) == 2  # there is no scene


@pytest.mark.usefixtures("animated")
def test_cameras_of_a_file_go_before_those_of_the_panel(addon, tmp_path, capsys):
    """Which are none, and --cameras still works; with --source it is wrong usage."""
    bpy.context.scene.refine.collection = bpy.data.collections.new("empty")
    facts = pruned(addon, tmp_path, "--cameras", str(CAMERAS))[1]
    assert facts == {"source": "file", "file": str(CAMERAS)}
    words = [*PRUNE, "--dry-run", "--source", "active", "--cameras", "c.json"]
    assert addon.command.main(words, scene=True) == 2
    assert "expected --cameras or --source, not both" in capsys.readouterr().err


@pytest.mark.usefixtures("animated")
def test_what_is_refused_and_a_dry_run_change_nothing(addon, tmp_path, capsys, unchanged):
    """No cameras, no splats: code 1, one sentence, which stands in the report too."""
    scene, told = bpy.context.scene, tmp_path / "report.json"
    scene.timeline_markers.clear()
    scene.camera, scene.refine.collection = None, None
    for name, data in (("empty", None), ("camera", bpy.data.cameras.new("camera"))):
        linked(name, data)
    unchanged.start()
    for name, source, options, expected in (
        ("room", "ACTIVE", [], "room: no active camera at frame"),
        ("room", "ACTIVE", ["--source", "frames:1:2"], "no active camera at frame 1"),
        ("room", "COLLECTION", [], "room: no cameras: choose the collection"),
        ("room", "COLLECTION", ["--source", "collection:fwe"],
         r"room: no collection 'fwe' in the open \.blend \(collections: cameras, few\)"),
        ("rooom", "VISIBLE", [], "no object 'rooom'.*splat objects: room"),
        ("empty", "VISIBLE", [], "empty.* of type EMPTY"),
        ("camera", "VISIBLE", [], "camera.* of type CAMERA"),
        ("camera", "VISIBLE", ["--protect", "statue"], "statue"),
    ):  # fmt: skip
        scene.refine.source = source
        words = ["prune", "--object", name, "--dry-run", "--report", str(told), *CLOSED, *options]
        told.unlink(missing_ok=True)
        assert addon.command.main(words, scene=True) == 1
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        entry = json.loads(told.read_text())["results"][0]
        assert error == f"refine: error: {entry['error']}\n"
        assert re.search(expected, error)
        unchanged()

    words = [*PRUNE, "--dry-run", "-o", str(tmp_path / "out.ply"), *CLOSED]
    assert addon.command.main(words, scene=True) == 0
    assert not (tmp_path / "out.ply").exists()
    unchanged()
