"""While an operator works on a thread the window lives, and what it writes fits what is there."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from tests.windows import event, started_in_a_window, until, until_over


@pytest.fixture
def few(addon, room, room_cameras):
    """Every tenth splat of the room, to be scored by four views with what hides what."""
    addon.mesh.edit.delete_vertices(room, np.arange(len(room.data.vertices)) % 10 != 0)
    settings = bpy.context.scene.refine
    settings.method, settings.views = "occlusion", 4
    return room


@pytest.fixture
def start(addon, few):
    """Return a function that clicks an operator's button; by default it is *Score*."""

    def start(cls=None, **properties):
        return started_in_a_window(addon, cls or addon.ui.operators.REFINE_OT_score, **properties)

    yield start
    addon.ui.operator_bases._end()


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
    """Return the note of an object's scores."""
    return addon.mesh.scores.record(obj.data)


def values(obj, name="refine_score"):
    """Return a point attribute."""
    found = np.empty(len(obj.data.vertices), np.float32)
    obj.data.attributes[name].data.foreach_get("value", found)
    return found


def scored_by(obj, method):
    """Return what *Score* writes at once, by a method."""
    settings = bpy.context.scene.refine
    before, settings.method = settings.method, method
    bpy.ops.refine.score()
    settings.method = before
    return values(obj).copy()


@pytest.mark.parametrize(
    "kind", ["MOUSEMOVE", "MIDDLEMOUSE", "WHEELUPMOUSE", "TAB", "G", "SPACE", "Z"]
)
def test_events_go_on_to_the_window(start, gate, kind):
    """So views orbit, panels scroll and editors work."""
    operator, context, said = start()

    assert operator.modal(context, event(kind)) == {"PASS_THROUGH"}
    assert said == []


def test_only_one_operation_works_at_a_time(start, gate, addon):
    """They come back when it is over."""
    names = ["score", "apply", "levels", "find_floaters", "delete"]
    names += ["export_ply", "import_ply", "import_cameras"]
    bpy.ops.refine.score()
    bpy.ops.refine.find_floaters()

    def polls(those):
        return [getattr(bpy.ops.refine, name).poll() for name in those]

    before = polls(names)
    operator, context, _ = start()
    during, looks = polls(names), polls(["render"])
    operator.modal(context, event("ESC"))
    until_over(operator, context)

    assert before == polls(names) == [True] * len(names)
    assert during == [False] * len(names)
    assert looks == [False]


def test_what_stays_and_goes_is_not_changed_while_a_thread_works(start, gate):
    """Else marks would come too late for what was read already; they can be set again after it."""
    bpy.context.scene.refine.volumes.add()
    names = ("protect", "add_volume", "drop_volume")

    def polls():
        return [getattr(bpy.ops.refine, name).poll() for name in names]

    before = polls()
    operator, context, _ = start()
    during = polls()
    operator.modal(context, event("ESC"))
    until_over(operator, context)

    assert (before, during, polls()) == ([True] * 3, [False] * 3, [True] * 3)


@pytest.mark.parametrize("change", ["marks", "volume"])
def test_a_merge_is_refused_when_other_splats_must_stay_since(addon, few, start, change):
    """By a mark from a script or a volume that moved: each deletes or keeps what it must not."""
    bpy.ops.refine.score()
    settings = bpy.context.scene.refine
    settings.method, settings.percent = "merge", 80.0
    volume = bpy.data.objects.new("volume", None)
    volume.empty_display_type, volume.location = "CUBE", (1000.0, 0.0, 0.0)
    bpy.context.scene.collection.objects.link(volume)
    item = settings.volumes.add()
    item.role, item.object = "PROTECT", volume
    bpy.context.view_layer.update()
    count = len(few.data.vertices)
    operator, context, said = start(addon.ui.operators.REFINE_OT_apply)
    if change == "marks":
        addon.mesh.edit.mark_by_hand(few, np.arange(count) < 200)
    else:
        volume.location, volume.scale = (0.0, 0.0, 0.0), (100.0, 100.0, 100.0)

    assert until_over(operator, context) == {"CANCELLED"}

    assert "what must stay or go has changed meanwhile" in said[-1]
    assert len(few.data.vertices) == count
    assert noted(addon, few) is not None


def test_a_fault_on_the_thread_is_raised_and_locks_nothing(start, gate):
    """Blender prints what is raised; the buttons come back and the timer ends."""
    gate.error = ValueError("a fault")
    gate.open.set()
    operator, context, _ = start()

    with pytest.raises(ValueError, match="a fault"):
        until_over(operator, context)

    assert bpy.ops.refine.score.poll()
    assert context.timers == 0
    assert operator.modal(context, event("TIMER")) == {"CANCELLED"}


def test_only_sidebars_are_drawn_again(start, gate):
    """A 3D view with a million splats is not; the status bar says phase and share, .4 of 97 %."""
    operator, context, _ = start()
    until(operator, context, lambda: any("39%" in str(text) for text in context.said))
    operator.modal(context, event("ESC"))
    until_over(operator, context)

    assert set(context.drawn) == {"VIEW_3D UI"}
    assert "Scoring splats (looking); Esc cancels: 39%" in context.said
    assert context.timers == 0


def _replace(obj):
    obj.data = obj.data.copy()


def _move_a_vertex(obj):
    obj.data.vertices[7].co.x += 1e-3


def _fade_a_splat(obj):
    obj.data.attributes["opacity"].data[7].value -= 0.5


def _add_a_vertex(obj):
    obj.data.vertices.add(1)


CHANGED = "object 'room': its splats were changed meanwhile; start again"


@pytest.mark.parametrize("change", [_replace, _move_a_vertex, _fade_a_splat, _add_a_vertex])
def test_a_result_for_splats_that_changed_is_refused(start, gate, addon, few, change):
    """Whatever was done to the object; nothing is written to what it is now."""
    operator, context, said = start()
    change(few)
    gate.open.set()
    answer = until_over(operator, context)

    assert said == [CHANGED]
    assert answer == {"CANCELLED"}
    assert noted(addon, few) is None
    assert context.timers == 0
    assert addon.ui.operator_bases.now() is None


@pytest.mark.parametrize("how", ["removed", "out of the scene"])
def test_an_object_that_is_deleted_ends_the_work_at_once(start, gate, addon, few, how):
    """With one sentence, while the thread is still held back; every button comes back."""
    operator, context, said = start()
    if how == "removed":
        bpy.data.objects.remove(few)
    else:  # as Blender's own *Delete* does
        bpy.context.scene.collection.objects.unlink(few)

    assert operator.modal(context, event("TIMER")) == {"CANCELLED"}
    assert said == ["object 'room': was deleted; scoring splats has ended"]
    assert context.timers == 0
    assert addon.ui.operator_bases.now() is None
    assert bpy.ops.refine.import_ply.poll()


def test_all_objects_that_are_written_to_have_to_be_as_they_were(start, gate, addon, few):
    """Where an operator writes to several; the second is the one that changed."""
    other = few.copy()
    other.data = few.data.copy()
    bpy.context.scene.collection.objects.link(other)
    other.select_set(True)
    operator, context, said = start()
    _move_a_vertex(other)
    gate.open.set()

    assert until_over(operator, context) == {"CANCELLED"}
    assert said == ["object 'room.001': its splats were changed meanwhile; start again"]
    assert noted(addon, few) is None


def test_a_renamed_object_gets_its_result(start, gate, addon, few):
    """Another one has its name by then, and stays as it is."""
    operator, context, _ = start()
    few.name = "other"
    decoy = bpy.data.objects.new("room", few.data.copy())
    bpy.context.scene.collection.objects.link(decoy)
    gate.open.set()

    assert until_over(operator, context) == {"FINISHED"}
    assert noted(addon, few)["method"] == "occlusion"
    assert noted(addon, decoy) is None


def test_a_result_waits_until_edit_mode_is_left(start, gate, addon, few):
    """Attributes cannot be written there."""
    operator, context, _ = start()
    bpy.ops.object.mode_set(mode="EDIT")
    gate.open.set()
    until(operator, context, lambda: addon.ui.operator_bases.now().waits)
    waits = addon.ui.operator_bases.now().sentence
    bpy.ops.object.mode_set(mode="OBJECT")

    assert waits == "Scoring splats: go back to object mode for the result (Esc cancels)"
    assert until_over(operator, context) == {"FINISHED"}
    assert noted(addon, few)["method"] == "occlusion"


def test_scoring_on_the_thread_writes_what_scoring_at_once_writes(start, addon, few):
    """To the bit; it is one step."""
    expected, plain = scored_by(few, "occlusion"), noted(addon, few)
    del few.data[addon.mesh.scores.RECORD]
    operator, context, _ = start()

    assert until_over(operator, context) == {"FINISHED"}
    assert np.array_equal(values(few), expected)
    assert noted(addon, few) | {"seconds": plain["seconds"]} == plain


def test_esc_leaves_the_old_scores(start, gate, addon, few):
    """To the bit, with their note."""
    expected, note = scored_by(few, "occlusion"), noted(addon, few)
    operator, context, said = start()
    operator.modal(context, event("ESC"))

    assert until_over(operator, context) == {"CANCELLED"}
    assert said == ["Scoring splats cancelled; nothing was changed"]
    assert np.array_equal(values(few), expected)
    assert noted(addon, few) == note


def threads():
    """Return the threads of operators."""
    return [thread for thread in threading.enumerate() if thread.name == "refine"]


@pytest.mark.parametrize("how", ["another file", "disabled"])
def test_what_ends_the_session_ends_the_thread(start, gate, addon, how):
    """Another file is loaded, or the extension is switched off: nothing runs on or is left."""
    operator, context, _ = start()
    assert threads()
    if how == "another file":
        bpy.ops.wm.read_homefile(use_empty=True)
        operator.cancel(context)  # as Blender does, after load_pre
        assert context.timers == 0
    else:
        addon.ui.operator_bases.unregister()

    assert threads() == []
    assert addon.ui.operator_bases.now() is None
    assert bpy.ops.refine.import_ply.poll()


def test_work_that_listens_to_nobody_is_left_behind(start, addon, few, monkeypatch):
    """It still waits when the operator is over; what it comes to later is dropped."""
    free, expected = threading.Event(), scored_by(few, "occlusion")
    monkeypatch.setattr(addon.ui.operators, "score", lambda *_, **__: free.wait(600.0))
    operator, context, _ = start()
    operator.modal(context, event("ESC"))
    answer = until_over(operator, context)
    waits = len(threads())
    free.set()
    for thread in threads():
        thread.join()

    assert answer == {"CANCELLED"}
    assert waits == 1
    assert np.array_equal(values(few), expected)


@pytest.mark.parametrize("suffix", [".ply", ".sog"])
def test_files_are_written_and_read_on_the_thread_as_at_once(start, addon, few, tmp_path, suffix):
    """The same bytes, images of a SOG by Blender's library on the main thread included."""
    export, read = addon.ui.export_operators.REFINE_OT_export_ply, addon.ui.import_operators
    at_once, later = (tmp_path / f"{name}{suffix}" for name in ("now", "later"))
    bpy.ops.refine.export_ply(filepath=str(at_once))
    options = {"overwrite": False, "apply_transform": False}
    ended = until_over(*start(export, filepath=str(later), **options)[:2])
    options = {"files": [], "directory": "", "upright": False, "cameras": False, "level": 0}
    operator, context, said = start(read.REFINE_OT_import_ply, filepath=str(later), **options)
    imported = until_over(operator, context)
    obj = bpy.context.view_layer.objects.active

    assert ended == imported == {"FINISHED"}
    assert later.read_bytes() == at_once.read_bytes()
    assert said[-1] == "Imported 3,976 splats from 1 file"
    assert (obj.name, len(obj.data.vertices)) == ("later", len(few.data.vertices))


def test_a_file_whose_writing_is_cancelled_is_none(start, addon, few, tmp_path, monkeypatch):
    """Packing does not listen; what it wrote is not put in place afterwards, a second file is."""
    begun, free = threading.Event(), threading.Event()
    form = addon.core.formats.by_name.SPLAT
    registry = addon.core.formats.registry

    def write(stream, _splats):
        stream.write(b"half")
        begun.set()
        free.wait(600.0)

    held = SimpleNamespace(
        suffix=".splat", degree=form.degree, write=write, loss="", sizes=None, models=form.models
    )
    monkeypatch.setattr(registry, "format_named", lambda _path: held)
    export = addon.ui.export_operators.REFINE_OT_export_ply
    options = {"overwrite": False, "apply_transform": False}
    operator, context, _ = start(export, filepath=str(tmp_path / "out.splat"), **options)
    assert begun.wait(60.0)
    operator.modal(context, event("ESC"))
    answer = until_over(operator, context)
    free.set()
    for thread in threads():
        thread.join()

    assert answer == {"CANCELLED"}
    assert list(tmp_path.iterdir()) == []
    assert until_over(*start(export, filepath=str(tmp_path / "out.splat"), **options)[:2]) == {
        "FINISHED"
    }
    assert (tmp_path / "out.splat").read_bytes() == b"half"


def served(addon, function):
    """Return what a thread gets that asks the main thread to call a function."""
    worker = addon.ui.operator_bases.Worker(lambda _progress: addon.main_thread.call(function))
    while worker.running():
        addon.main_thread.serve()
    return worker.result()


def test_the_main_thread_answers_the_thread(addon):
    """With what the function returns or raises."""
    assert served(addon, threading.current_thread) == threading.main_thread()
    with pytest.raises(ZeroDivisionError):
        served(addon, lambda: 1 // 0)


def test_an_answer_just_after_the_time_out_is_no_time_out(addon, monkeypatch):
    """It arrives between the end of a wait and the look at whether there is one."""
    timed_out, answered = threading.Event(), threading.Event()

    class Late(addon.main_thread.Future):
        def result(self, timeout=None):
            try:
                return super().result(timeout)
            except TimeoutError:
                timed_out.set()
                answered.wait(60.0)
                raise

    monkeypatch.setattr(addon.main_thread, "Future", Late)
    worker = addon.ui.operator_bases.Worker(lambda _progress: addon.main_thread.call(lambda: 7))
    timed_out.wait(0.5)  # longer than a wait for an answer
    addon.main_thread.serve()
    answered.set()

    assert worker.result() == 7


def test_a_time_out_of_the_function_itself_is_raised(addon):
    """It is no answer that is late."""
    with pytest.raises(TimeoutError, match="disk"):
        served(addon, lambda: (_ for _ in ()).throw(TimeoutError("disk")))


def test_a_thread_that_is_cancelled_waits_for_no_answer(addon):
    """And what it asked for is not done."""
    main_thread, calls = addon.main_thread, []
    worker = addon.ui.operator_bases.Worker(
        lambda _progress: main_thread.call(lambda: calls.append(1))
    )
    while not main_thread._asked.qsize():
        time.sleep(0.01)
    worker.end()
    main_thread.serve()

    assert calls == []
    with pytest.raises(addon.core.Cancelled):
        worker.result()
