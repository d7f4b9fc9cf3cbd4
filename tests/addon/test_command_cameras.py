"""Which cameras decide when the command prunes an object: those of the panel, or those it names."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import bpy
import pytest

CAMERAS = Path(__file__).parents[1] / "data/room_small/cameras.json"
CLOSED = ["--method", "closed-form"]
PRUNE = ["prune", "--object", "room"]


@pytest.fixture
def animated(quarter, room_cameras, tmp_path):
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
        quarter.rotation_euler.z = angle
        quarter.keyframe_insert("rotation_euler", frame=frame)
    scene.camera = cameras[0]
    cameras[1].select_set(True)
    scene.frame_start, scene.frame_end, scene.refine.frame_step = 1, 21, 5
    scene.frame_set(1)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    return few


def pruned_by_panel(folder):
    """Save the scene; return what Score, Apply and Export make of it; open it as it was saved."""
    made = folder / "panel.ply"
    bpy.ops.wm.save_mainfile()
    for operator, options in (
        ("score", {}),
        ("apply", {}),
        ("export_ply", {"filepath": str(made)}),
    ):
        assert getattr(bpy.ops.refine, operator)(**options) == {"FINISHED"}
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)
    bpy.context.view_layer.objects.active = None  # the command goes by the name alone
    return made.read_bytes()


def pruned(addon, folder, *options):
    """Return the file that `prune --object room` makes, and what the report says of the cameras."""
    out, told = folder / "out.ply", folder / "report.json"
    words = [*PRUNE, "-o", str(out), "--report", str(told), "--overwrite"]
    assert addon.command.main([*words, *CLOSED, *options], scene=True) == 0
    return out.read_bytes(), json.loads(told.read_text())["results"][0]["cameras"]


SHOT = {"frames": {"first": 1, "last": 21, "step": 5}}
CHOICES = {
    "collection:few": ({"collection": "few"}, "those in collection 'few'"),
    "frames:1:21:5": (SHOT, "the active one at frames 1 to 21, every 5"),
    "active": ({}, "the active one"),
    "selected": ({}, "the selected ones"),
    "visible": ({}, "all visible ones"),
}


@pytest.mark.parametrize("option", CHOICES)
def test_panel_and_command_keep_the_same_set_of_a_saved_scene(addon, animated, tmp_path, option):
    """To the byte, by the saved choice and by the same one as an option; another one differs."""
    (facts, words), source = CHOICES[option], option.split(":")[0]
    settings = bpy.context.scene.refine
    settings.source, settings.collection = source.upper(), animated
    by_panel = pruned_by_panel(tmp_path)
    saved, saved_facts = pruned(addon, tmp_path)
    bpy.context.scene.refine.source = "COLLECTION" if source == "visible" else "VISIBLE"
    given, given_facts = pruned(addon, tmp_path, "--source", option)

    assert saved == given == by_panel
    assert pruned(addon, tmp_path)[0] != by_panel
    facts = {"source": source, **facts}
    assert saved_facts == {**facts, "words": f"{words}, as chosen in the panel"}
    assert given_facts == {**facts, "words": f"{words}, as the command line says"}


def test_method_and_budget_of_the_panel_and_a_range_of_frames_do_not_count(
    addon, animated, tmp_path
):
    """Half of the splats go, by closed form; `frames` is `frames:1:21:5`, as in the panel."""
    settings = bpy.context.scene.refine
    settings.source, settings.collection = "COLLECTION", animated
    before, _ = pruned(addon, tmp_path)
    settings.method, settings.views, settings.budget, settings.keep = "occlusion", 2, "keep", 7
    assert pruned(addon, tmp_path)[0] == before

    short, facts = pruned(addon, tmp_path, "--source", "frames")
    assert facts["frames"] == SHOT["frames"]
    assert short == pruned(addon, tmp_path, "--source", "frames:1:21:5")[0]
    assert short != pruned(addon, tmp_path, "--source", "frames:1:21")[0]


def test_an_object_is_scored_as_its_file_is(addon, quarter, quarter_file, room_cameras, tmp_path):
    """By the collection that holds the cameras of the file: equal bytes, and nothing is changed."""
    assert bpy.context.scene.refine.collection == room_cameras
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    attributes = sorted(quarter.data.attributes.keys())
    told, out = tmp_path / "report.json", [tmp_path / f"{name}.ply" for name in ("a", "b")]
    by_object = ["score", "--object", "room", "-o", str(out[0]), *CLOSED, "--report", str(told)]
    by_file = ["score", str(quarter_file), "--cameras", str(CAMERAS), "-o", str(out[1]), *CLOSED]

    assert addon.command.main(by_object, scene=True) == 0
    assert addon.command.main(by_file) == 0
    assert out[0].read_bytes() == out[1].read_bytes()
    assert sorted(quarter.data.attributes.keys()) == attributes
    entry = json.loads(told.read_text())["results"][0]
    assert entry["files"]["input"] == f"{bpy.data.filepath}#room"
    assert entry["cameras"]["words"] == "those in collection 'cameras', as chosen in the panel"
    assert addon.command.main(by_object, scene=True) == 1  # the file exists


@pytest.mark.usefixtures("animated")
def test_cameras_that_are_named_score_objects_and_files(addon, quarter_file, tmp_path):
    """By one camera both score alike, and otherwise than by all; without a scene there is none."""
    made = []
    for choice in ("active", "visible"):
        for source in (["--object", "room"], [str(quarter_file)]):
            out = tmp_path / f"{len(made)}.ply"
            words = ["score", *source, "-o", str(out), "--source", choice, *CLOSED]
            assert addon.command.main(words, scene=True) == 0
            made.append(out.read_bytes())

    assert made[0] == made[1] != made[2] == made[3]
    words = ["score", str(quarter_file), "-o", "x.ply", "--source", "active"]
    assert addon.command.main(words) == 2


def test_cameras_of_a_file_go_before_those_of_the_panel(addon, animated, tmp_path, capsys):
    """An empty collection is chosen, and --cameras still works; with --source it is wrong usage."""
    settings = bpy.context.scene.refine
    settings.source, settings.collection = "COLLECTION", bpy.data.collections.new("empty")
    assert animated.objects

    facts = pruned(addon, tmp_path, "--cameras", str(CAMERAS))[1]
    assert facts == {"source": "file", "file": str(CAMERAS)}
    words = [*PRUNE, "--dry-run", "--source", "active", "--cameras", "c.json"]
    assert addon.command.main(words, scene=True) == 2
    assert "expected --cameras or --source, and not both" in capsys.readouterr().err


@pytest.mark.usefixtures("animated")
def test_a_choice_without_cameras_and_an_object_without_splats_are_refused(
    addon, tmp_path, capsys, unchanged
):
    """Code 1, one sentence; it stands in the report too, and the scene is as it was."""
    scene, told = bpy.context.scene, tmp_path / "report.json"
    scene.timeline_markers.clear()
    scene.camera, scene.refine.collection = None, None
    for name, data in (("empty", None), ("camera", bpy.data.cameras.new("camera"))):
        scene.collection.objects.link(bpy.data.objects.new(name, data))
    unchanged.start()
    for name, source, options, expected in (
        ("room", "ACTIVE", [], "room: no cameras: scene 'Scene' has no active camera"),
        ("room", "ACTIVE", ["--source", "frames:1:2"], "no active camera at frame 1"),
        ("room", "COLLECTION", [], "room: no cameras: choose the collection"),
        ("room", "COLLECTION", ["--source", "collection:fwe"],
         r"room: no collection 'fwe' in the open \.blend \(collections: cameras, few\)"),
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
