"""What a newcomer does first: one import, cameras that fit, a turn that is put right, a look."""

from __future__ import annotations

import importlib
import os
import re
import shutil
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from .conftest import ROOM


@pytest.fixture
def capture(tmp_path, quarter_file):
    """Lay out a capture as training does; return its splats, two folders below the cameras."""
    place = tmp_path / "point_cloud" / "iteration_7"
    place.mkdir(parents=True)
    shutil.copy(quarter_file, place / "point_cloud.ply")
    shutil.copy(ROOM / "cameras.json", tmp_path)
    return place / "point_cloud.ply"


@pytest.fixture
def imported(capture):
    """Return a function that imports the capture and its cameras, each upright or not."""

    def imported(*, splats, cameras):
        bpy.ops.refine.import_ply(filepath=str(capture), upright=splats)
        obj = bpy.context.object
        bpy.ops.refine.import_cameras(
            filepath=str(capture.parents[2] / "cameras.json"), upright=cameras
        )
        bpy.context.view_layer.objects.active = obj
        bpy.context.scene.refine.method = "closed-form"
        return obj

    return imported


def cameras():
    """Return the cameras of the scene."""
    return [obj for obj in bpy.context.scene.objects if obj.type == "CAMERA"]


@pytest.mark.parametrize("upright", [False, True])
def test_one_import_brings_the_cameras_that_lie_above(addon, capture, upright):
    """The file's 72, which decide from now on and stand as the splats do: no turn is needed."""
    bpy.ops.refine.import_ply(
        filepath=str(capture), upright=upright, cameras=True, set_resolution=True
    )
    scene = bpy.context.scene

    assert len(cameras()) == 72
    assert scene.refine.source == "COLLECTION"
    assert scene.refine.collection.name == "Cameras"
    assert (scene.render.resolution_x, scene.render.resolution_y) == (240, 160)
    assert scene.camera.name == "000"
    assert bpy.context.object.name == "point_cloud"
    assert addon.cameras.known_turn(bpy.context, bpy.context.object) == 0


def test_scripts_get_no_cameras_unasked(capture):
    bpy.ops.refine.import_ply(filepath=str(capture))

    assert cameras() == []


def test_cameras_that_cannot_be_read_leave_the_splats(capture, capfd):
    """The error is told; the 9,939 splats are there."""
    (capture.parents[2] / "cameras.json").write_text("[]")

    assert bpy.ops.refine.import_ply(filepath=str(capture), cameras=True) == {"FINISHED"}

    assert len(bpy.context.object.data.vertices) == 9_939
    assert cameras() == []
    assert "the list of cameras is empty" in capfd.readouterr().out


@pytest.mark.parametrize(
    ("made", "found"),
    [
        (["cameras.json", "transforms.json"], "cameras.json"),
        (["transforms_train.json"], "transforms_train.json"),
        (["sparse/0/cameras.bin", "sparse/0/images.bin"], "sparse/0"),
        (["sparse/0/cameras.bin"], None),
    ],
)
def test_what_lies_beside_the_splats_is_found_by_its_name(addon, tmp_path, made, found):
    """JSON before COLMAP, of which a model needs cameras and images."""
    for name in made:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    place = tmp_path / "a" / "b" / "c"
    place.mkdir(parents=True)

    assert addon.ui.import_operators.cameras_beside(place) == (found and tmp_path / found)
    assert addon.ui.import_operators.cameras_beside(place / "d") is None


class _Layout:
    """Notes names and texts in the order in which they are drawn."""

    def __init__(self):
        self.drawn, self.enabled = [], True

    def column(self):
        return self

    def prop(self, _operator, name):
        self.drawn.append(name)

    def label(self, *, text, **_options):
        self.drawn.append(text)


@pytest.mark.parametrize("browser", [False, True])
def test_the_dialogue_names_the_cameras_before_they_are_taken(addon, capture, browser):
    """Of the file that was dropped, or of the folder that the file browser shows."""
    cls = addon.ui.import_operators.REFINE_OT_import_ply
    params = SimpleNamespace(directory=os.fsencode(capture.parent))
    space = SimpleNamespace(type="FILE_BROWSER", params=params) if browser else None
    path = capture.parents[2] / "nowhere" / "a.ply" if browser else capture
    layout = _Layout()
    operator = SimpleNamespace(layout=layout, cameras=True, _paths=lambda: [path])

    cls.draw(operator, SimpleNamespace(space_data=space))

    assert layout.drawn == ["upright", "cameras", "../../cameras.json", "set_resolution"]


def test_camera_files_have_a_handler(addon):
    """So that they can be dropped on the view: every kind that the file browser shows."""
    module = addon.ui.import_operators
    operator = bpy.ops.refine.import_cameras.get_rna_type()
    shown = operator.properties["filter_glob"].default

    assert module.REFINE_FH_cameras in addon.registration.CLASSES
    assert module.REFINE_FH_cameras.bl_import_operator == "refine.import_cameras"
    assert module.REFINE_FH_cameras.bl_file_extensions == shown.replace("*", "")


def test_several_files_of_cameras_are_refused_but_those_of_one_model(addon, tmp_path):
    """Of a COLMAP model any files can be dropped together; of others all but one would be lost."""
    gather = addon.ui.import_operators.REFINE_OT_import_cameras.gather
    several = [None, None]
    model, other = (str(tmp_path / name) for name in ("images.bin", "a.json"))

    assert gather(SimpleNamespace(filepath=model, files=several), None)[1].name == "images.bin"
    with pytest.raises(addon.core.RefineError, match="got 2 files, expected one"):
        gather(SimpleNamespace(filepath=other, files=several), None)


@pytest.mark.parametrize("upright", [False, True])
def test_the_dialogue_of_the_cameras_follows_the_splats(addon, capture, upright):
    """The matrix of an object is float32: a quarter turn has 7.5e-8 for some of its zeros."""
    bpy.ops.refine.import_ply(filepath=str(capture), upright=upright)
    bpy.context.view_layer.update()
    bpy.context.view_layer.objects.active = None
    module = addon.ui.import_operators

    assert module._is_upright(module._imported_splats(bpy.context)) is upright


@pytest.mark.parametrize(
    ("change", "untouched"),
    [
        (lambda _scene: None, True),
        (lambda scene: setattr(scene.render, "resolution_percentage", 50), False),
        (lambda scene: setattr(scene.render, "resolution_x", 1000), False),
        (lambda _scene: bpy.ops.object.camera_add(), False),
        (lambda scene: scene.camera.keyframe_insert("location"), False),
    ],
    ids=["as it was", "percentage", "size", "another camera", "shot"],
)
def test_the_render_size_is_set_where_nobody_chose_one(addon, change, untouched):
    """Blender's own scene has one camera and 1920 x 1080."""
    bpy.ops.wm.read_homefile(use_factory_startup=True, load_ui=False)
    scene = bpy.context.scene
    change(scene)
    is_set = SimpleNamespace(is_property_set=lambda _name: False)
    operator = SimpleNamespace(properties=is_set, set_resolution=None)

    addon.ui.import_operators.suggest_resolution(operator, bpy.context)

    assert operator.set_resolution is untouched


@pytest.mark.parametrize(("splats", "turn"), [(True, 1), (False, -1)])
def test_a_mismatch_of_the_up_axis_is_told_at_import(addon, imported, capfd, splats, turn):
    """And in the panel, with the button that helps, before anything is scored."""
    obj = imported(splats=splats, cameras=not splats)

    assert "do not share an up axis" in capfd.readouterr().out
    assert addon.cameras.known_turn(bpy.context, obj) == turn
    assert addon.mesh.scores.record(obj.data) is None


def test_turning_the_cameras_drops_their_scores(addon, imported):
    """The old price and warning are gone at once, and *Apply* waits for new scores."""
    obj = imported(splats=True, cameras=False)
    bpy.ops.refine.score()
    assert addon.ui.plans.stored(obj, bpy.context.scene.refine) is not None

    bpy.ops.refine.turn_cameras()

    assert addon.mesh.scores.record(obj.data) is None
    assert addon.ui.plans.stored(obj, bpy.context.scene.refine) is None
    left = {"refine_score", "refine_rank", "refine_remove", "refine_scored"}
    assert not left & set(obj.data.attributes.keys())
    assert not bpy.ops.refine.apply.poll()
    assert addon.cameras.known_turn(bpy.context, obj) == 0


def test_what_compare_measured_stays_in_the_panel_while_the_plan_is_the_same(
    addon, quarter, room_cameras
):
    """Another share, or other scores, and it is no longer shown."""
    scene = bpy.context.scene
    scene.camera, measured = room_cameras.objects[24], addon.ui.operators.measured
    bpy.ops.refine.score()
    before = measured(quarter, scene.refine)
    bpy.ops.refine.compare()
    shown = measured(quarter, scene.refine)
    scene.refine.ratio = 0.7
    moved = measured(quarter, scene.refine)
    scene.refine.ratio = 0.5
    bpy.ops.refine.compare()
    scene.refine.views = 8
    bpy.ops.refine.score()

    assert re.fullmatch(rf"Measured in '{scene.camera.name}': \d\d\.\d dB", shown)
    assert before == moved == measured(quarter, scene.refine) == ""


def test_levels_do_not_stand_on_top_of_each_other(quarter, room_cameras):
    """They are hidden, in renders too; the original is shown, and stays active."""
    bpy.context.scene.refine.levels = "0.5, 0.25"

    bpy.ops.refine.levels()

    levels = bpy.data.collections["room levels"].objects
    assert [(obj.visible_get(), obj.hide_render) for obj in levels] == [(False, True)] * 2
    assert quarter.visible_get()
    assert bpy.context.object == quarter


def test_a_blend_that_blender_could_not_open_is_named(addon, tmp_path):
    """Blender goes on with an empty scene; words behind the command are its own."""
    check = importlib.import_module(f"{addon.__name__}.command.scene").opened
    refine_error = addon.core.RefineError
    words = ["blender", "-b", "gone.blend", "--command", "refine", "prune", "--object", "a"]

    with pytest.raises(refine_error, match=r"^gone\.blend: Blender could not open it"):
        check(words)
    check(["blender", "-b", "-c", "refine", "gone.blend"])
    check(["pytest"])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "is.blend"))
    check(words)


def test_what_is_shown_is_kept_with_a_scene_that_holds_splats(addon, quarter, monkeypatch):
    """Also that nothing is: it is shown again as it was, and an unknown word is ignored."""
    draw, shown = addon.viewport.draw, []
    monkeypatch.setattr(draw, "bpy", _in_window(bpy))
    monkeypatch.setattr(draw, "show", shown.append)
    scene = bpy.context.scene
    draw._opened()
    for mode in ("STAYS", "OFF"):
        monkeypatch.setattr(draw._state, "mode", mode)
        draw._saving()
        draw._opened()
    scene[draw.SHOWN] = "X-RAY"
    draw._opened()
    bpy.data.objects.remove(quarter)
    del scene[draw.SHOWN]
    draw._saving()

    assert shown == ["STAYS", "OFF"]
    assert draw.SHOWN not in scene


def _in_window(module):
    """Return Blender's module as it is in a window."""
    app = SimpleNamespace(background=False)
    return SimpleNamespace(app=app, data=module.data, context=module.context, types=module.types)


def test_the_chart_is_drawn_anew_after_undo(addon, quarter, room_cameras, monkeypatch):
    """Undo brings back marks and settings, but plan and chart are of the session."""
    bpy.ops.refine.score()
    waited = []
    monkeypatch.setattr(addon.ui.plans, "_wait", lambda *arguments: waited.append(arguments))
    window = SimpleNamespace(app=SimpleNamespace(background=False), context=bpy.context)
    monkeypatch.setattr(addon.ui.plans, "bpy", window)

    addon.ui.plans._undone()

    assert waited == [(bpy.context.scene, [quarter], addon.ui.plans.REST)]
    assert addon.ui.plans.stored(quarter, bpy.context.scene.refine) is None
    assert np.all([addon.ui.plans._undone in getattr(bpy.app.handlers, name)
                   for name in ("undo_post", "redo_post")])  # fmt: skip
