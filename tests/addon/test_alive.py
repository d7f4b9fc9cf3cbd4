"""While an operator works on a thread the window lives, and what it writes fits what is there."""

import threading
import time
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from tests.windows import event, started_in_a_window, until

from .conftest import linked, read


@pytest.fixture
def obj(few):
    settings = bpy.context.scene.refine
    settings.method, settings.views = "occlusion", 4
    return few


@pytest.fixture
def start(addon, obj):
    """Return a function that clicks an operator's button; by default it is *Score*."""

    def start(cls=None, **properties):
        return started_in_a_window(addon, cls or addon.ui.operators.REFINE_OT_score, **properties)

    yield start
    addon.ui.operator_bases.unregister()


@pytest.fixture
def gate(addon, monkeypatch):
    """Hold back scoring on the thread until `open`; or let it fail."""
    gate, score = SimpleNamespace(open=threading.Event(), error=None), addon.core.score

    def held(splats, views, method, *, progress, **options):
        if threading.current_thread().name == "refine":
            while not gate.open.wait(0.01):
                addon.core.execute.report(progress, 0.4, "looking")
            if gate.error:
                raise gate.error
        return score(splats, views, method, progress=progress, **options)

    monkeypatch.setattr(addon.ui.operators, "score", held)
    return gate


def noted(addon, obj):
    return addon.mesh.scores.record(obj.data)


def scores(addon, obj):
    return read(addon, obj, "refine_score").tobytes(), noted(addon, obj)


def test_only_one_operation_works_at_a_time(start, gate):
    """What stays and goes is not changed either, or marks came too late for what was read."""
    names = ["score", "apply", "levels", "find_floaters", "delete", "protect", "add_volume"]
    names += ["drop_volume", "export_ply", "import_ply", "import_cameras"]
    bpy.context.scene.refine.volumes.add()
    bpy.ops.refine.score()
    bpy.ops.refine.find_floaters()

    def polls():
        return {name for name in (*names, "render") if getattr(bpy.ops.refine, name).poll()}

    before = polls()
    operator, context, _ = start()
    during = polls()
    operator.modal(context, event("ESC"))
    until(operator, context)

    assert before == polls() == {*names, "render"}
    assert during == set()


@pytest.mark.parametrize("change", ["marks", "volume"])
def test_a_merge_is_refused_when_other_splats_must_stay_since(addon, obj, start, change):
    """By a mark from a script or a volume that moved: each deletes or keeps what it must not."""
    bpy.ops.refine.score()
    settings = bpy.context.scene.refine
    settings.method, settings.percent = "merge", 80.0
    volume = linked("volume")
    volume.empty_display_type, volume.location = "CUBE", (1000.0, 0.0, 0.0)
    item = settings.volumes.add()
    item.role, item.object = "PROTECT", volume
    bpy.context.view_layer.update()
    operator, context, said = start(addon.ui.operators.REFINE_OT_apply)
    if change == "marks":
        addon.mesh.edit.mark(obj, addon.mesh.edit.PROTECT, np.arange(3976) < 200)
    else:
        volume.location, volume.scale = (0.0, 0.0, 0.0), (100.0, 100.0, 100.0)

    assert until(operator, context) == {"CANCELLED"}
    assert "what must stay or go has changed meanwhile" in said[-1]
    assert len(obj.data.vertices) == 3976
    assert noted(addon, obj) is not None


def test_a_fault_on_the_thread_is_raised_and_locks_nothing(start, gate):
    """Blender prints what is raised; the buttons come back and the timer ends."""
    gate.error = ValueError("a fault")
    gate.open.set()
    operator, context, _ = start()
    with pytest.raises(ValueError, match="a fault"):
        until(operator, context)

    assert bpy.ops.refine.score.poll()
    assert context.timers == 0
    assert operator.modal(context, event("TIMER")) == {"CANCELLED"}


def test_scoring_on_the_thread_writes_what_scoring_at_once_writes_and_esc_nothing(
    start, gate, addon, obj
):
    """To the bit. The status bar says phase and share, .4 of 97 %; only sidebars are drawn."""
    bpy.ops.refine.score()
    (expected, plain), settings = scores(addon, obj), bpy.context.scene.refine
    settings.views = 8
    operator, context, said = start()
    until(operator, context, lambda: any("39%" in str(text) for text in context.said))
    operator.modal(context, event("ESC"))
    assert until(operator, context) == {"CANCELLED"}
    assert said == ["Scoring splats cancelled; nothing was changed"]
    assert scores(addon, obj) == (expected, plain)
    assert set(context.drawn) == {"VIEW_3D UI"}
    assert "Scoring splats (looking); Esc cancels: 39%" in context.said
    assert context.timers == 0

    gate.open.set()
    settings.views = 4
    del obj.data[addon.mesh.scores.RECORD]
    assert until(*start()[:2]) == {"FINISHED"}
    found, note = scores(addon, obj)
    assert found == expected
    assert note | {"seconds": plain["seconds"]} == plain


@pytest.mark.parametrize(
    "change",
    [
        lambda obj: setattr(obj, "data", obj.data.copy()),
        lambda obj: setattr(obj.data.vertices[7].co, "x", 0.1),
        lambda obj: setattr(obj.data.attributes["opacity"].data[7], "value", 0.5),
        lambda obj: obj.data.vertices.add(1),
    ],
)
def test_a_result_for_splats_that_changed_is_refused(start, gate, addon, obj, change):
    """Of all objects that are written to; here the second is the one that changed."""
    other = linked("other", obj.data.copy())
    other.select_set(True)
    operator, context, said = start()
    change(other)
    gate.open.set()

    assert until(operator, context) == {"CANCELLED"}
    assert said == ["object 'other': its splats were changed meanwhile; start again"]
    assert noted(addon, obj) is None
    assert context.timers == 0
    assert addon.ui.operator_bases.now() is None


@pytest.mark.parametrize("how", ["removed", "out of the scene"])
def test_an_object_that_is_deleted_ends_the_work_at_once(start, gate, addon, obj, how):
    """With one sentence, while the thread is still held back; every button comes back."""
    operator, context, said = start()
    if how == "removed":
        bpy.data.objects.remove(obj)
    else:  # as Blender's own *Delete* does
        bpy.context.scene.collection.objects.unlink(obj)

    assert operator.modal(context, event("TIMER")) == {"CANCELLED"}
    assert said == ["object 'room': was deleted; scoring splats has ended"]
    assert context.timers == 0
    assert addon.ui.operator_bases.now() is None
    assert bpy.ops.refine.import_ply.poll()


def test_switching_the_extension_off_ends_the_work(start, gate, addon):
    """Its thread, too, which scoring held back would keep."""
    start()
    (thread,) = (thread for thread in threading.enumerate() if thread.name == "refine")
    addon.registration.unregister()
    addon.registration.register()
    thread.join(60.0)

    assert not thread.is_alive()
    assert addon.ui.operator_bases.now() is None


def test_a_renamed_object_gets_its_result_once_edit_mode_is_left(start, gate, addon, obj):
    """Attributes cannot be written there. Another object has its name by then, and stays."""
    operator, context, _ = start()
    obj.name = "other"
    decoy = linked("room", obj.data.copy())
    bpy.ops.object.mode_set(mode="EDIT")
    gate.open.set()
    until(operator, context, lambda: addon.ui.operator_bases.now().waits)
    waits = addon.ui.operator_bases.now().sentence
    bpy.ops.object.mode_set(mode="OBJECT")

    assert waits == "Scoring splats: go back to object mode for the result (Esc cancels)"
    assert until(operator, context) == {"FINISHED"}
    assert noted(addon, obj)["method"] == "occlusion"
    assert noted(addon, decoy) is None


@pytest.mark.parametrize("suffix", [".ply", ".sog"])
def test_files_are_written_and_read_on_the_thread_as_at_once(start, addon, tmp_path, suffix):
    """The same bytes, images of a SOG by Blender's library on the main thread included."""
    export, read = addon.ui.export_operators.REFINE_OT_export_ply, addon.ui.import_operators
    at_once, later = (tmp_path / f"{name}{suffix}" for name in ("now", "later"))
    bpy.ops.refine.export_ply(filepath=str(at_once))
    options = {"overwrite": False, "apply_transform": False, "spz_y_up": False}
    ended = until(*start(export, filepath=str(later), **options)[:2])
    options = {"files": [], "directory": "", "level": 0}
    options |= dict.fromkeys(("upright", "cameras", "spz_y_up"), False)
    operator, context, said = start(read.REFINE_OT_import_ply, filepath=str(later), **options)
    imported = until(operator, context)
    obj = bpy.context.view_layer.objects.active

    assert ended == imported == {"FINISHED"}
    assert later.read_bytes() == at_once.read_bytes()
    assert said[-1] == "Imported 3,976 splats from 1 file"
    assert (obj.name, len(obj.data.vertices)) == ("later", 3976)


def test_a_file_whose_writing_is_cancelled_is_none(start, addon, tmp_path, monkeypatch):
    """Packing does not listen, and is left behind; a second file is put in place."""
    begun, free = threading.Event(), threading.Event()
    form = addon.core.formats.by_name.SPLAT

    def write(stream, _splats):
        stream.write(b"half")
        begun.set()
        free.wait(600.0)

    held = form._replace(write=write)
    monkeypatch.setattr(addon.core.formats.registry, "format_named", lambda _path: held)
    export, out = addon.ui.export_operators.REFINE_OT_export_ply, tmp_path / "out.splat"
    options = {"filepath": str(out), "overwrite": False, "apply_transform": False}
    options |= {"spz_y_up": False}
    operator, context, _ = start(export, **options)
    assert begun.wait(60.0)
    operator.modal(context, event("ESC"))

    assert until(operator, context) == {"CANCELLED"}
    (thread,) = (thread for thread in threading.enumerate() if thread.name == "refine")
    free.set()
    thread.join()
    assert list(tmp_path.iterdir()) == []
    assert until(*start(export, **options)[:2]) == {"FINISHED"}
    assert out.read_bytes() == b"half"


def test_a_thread_gets_the_answer_or_the_error_of_the_main_thread(addon):
    """After longer than a wait for it, too."""

    def outcome(function):
        worker = addon.ui.operator_bases.Worker(lambda _progress: addon.main_thread.call(function))
        time.sleep(0.2)
        while worker.running():
            addon.main_thread.serve()
        return worker.result()

    assert outcome(lambda: 7) == 7
    with pytest.raises(ZeroDivisionError):
        outcome(lambda: 1 // 0)
