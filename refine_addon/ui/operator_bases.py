"""Common parts of operators: what they need to run, work on a thread, error messages.
At most one operation runs on a thread. It gets arrays only: Blender's data is not thread-safe."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import Future, wait
from contextlib import suppress
from typing import Any, NamedTuple

import bpy
from bpy.types import Context

from .. import main_thread
from ..core.errors import RefineError, described
from ..core.execute import Cancelled, Progress, TimeLeft, in_time, silent, within
from ..mesh import attributes, scores
from ..mesh.layout import SplatObject, check, looks_like_splats
from ..viewport import draw as viewport_draw

_STEP = 0.05  # Seconds between two looks at the thread
PATIENCE = 0.7  # Seconds that a cancelled thread has to end before it is left alone
Answer = set[str]  # FINISHED, CANCELLED, RUNNING_MODAL or PASS_THROUGH
Work = Generator[tuple[list[SplatObject], Callable[[Progress], Any]], Any, None]  # See `Job`
Need = Callable[[Context], str]  # Gives what an operator lacks to run, "" if nothing
FAILURES = (RefineError, MemoryError)  # Exceptions reported as errors; all others are bugs


def fail(operator: bpy.types.Operator, error: BaseException, *further: type[Exception]) -> Answer:
    """Report one of `FAILURES` or `further` to the user; CANCELLED. Other errors are raised."""
    if not isinstance(error, (*FAILURES, *further)):
        raise error
    operator.report({"ERROR"}, described(error))
    return {"CANCELLED"}


class Worker:
    """A thread that runs ``work(progress)``. `fraction`: share done, 0 to 1; `what`: its step;
    `partial_step`: the one that has a partial result on cancel."""

    def __init__(self, work: Callable[[Progress], Any], partial_step: str | None = None) -> None:
        self.fraction, self.what, self.partial_step = 0.0, "", partial_step
        self.cancelled: float | None = None  # time of `cancel`
        self._outcome: Future[Any] = Future()
        threading.Thread(target=self._run, args=(work,), name="refine", daemon=True).start()

    def running(self) -> bool:
        """Whether to wait for it: until it ends, or, without a partial result, `PATIENCE` after it
        was cancelled. Work that goes on after that ends at its next check; its result is dropped.
        """
        late = self.cancelled and time.monotonic() - self.cancelled > PATIENCE
        return not self._outcome.done() and (not late or self.what == self.partial_step)

    def cancel(self) -> None:
        """Ask it to stop; `result` raises `Cancelled` then, unless the step has a partial one."""
        self.cancelled = self.cancelled or time.monotonic()

    def end(self) -> None:
        """Wait until it has stopped, after `cancel`, or `PATIENCE` is over."""
        wait([self._outcome], PATIENCE)

    def result(self) -> Any:
        """The work's result; raises the work's error."""
        if self.cancelled and not self._outcome.done():
            raise Cancelled
        return self._outcome.result()

    def _run(self, work: Callable[[Progress], Any]) -> None:
        try:
            with within(check=self._check):
                result = work(self._progress)
            if self.what != self.partial_step:
                self._check()  # it may have been cancelled since its last check
            self._outcome.set_result(result)
        except BaseException as error:
            # A new `Cancelled`: the traceback of `error` would keep the work's arrays alive.
            self._outcome.set_exception(Cancelled() if self.cancelled else error)

    def _check(self) -> None:
        if self.cancelled:
            raise Cancelled

    def _progress(self, fraction: float, what: str) -> bool:
        self.fraction, self.what = fraction, what
        return not self.cancelled


class Target(NamedTuple):
    """State of an object when it was read; `uid` stays the same through undo."""

    name: str
    uid: int
    mode: str
    splats: tuple[int, ...]

    @classmethod
    def of(cls, checked: SplatObject) -> Target:
        """An object's present state."""
        obj, mesh = checked.obj, checked.mesh
        splats = mesh.session_uid, len(checked), attributes.digest(checked)
        return cls(obj.name, obj.session_uid, obj.mode, splats)


class Running:
    """A running operation. Holds the splats, as Blender's history would keep them in the operator.
    `operator`: its `bl_idname`; `gathered`: of `Job.gather`; `worker`: a `Worker`, or a render's
    stand-in; `waits`: what the user must do before the result is written, "" if nothing."""

    def __init__(self, operator: Any, context: Context, gathered: Any, worker: Any = None) -> None:
        self.operator, self.doing = type(operator).bl_idname, operator.doing
        group, self.job = gathered
        self._targets = [Target.of(each) for each in group]
        self._left, self._shown, self.waits = TimeLeft(), "", ""
        # The thread gets the function alone: cancelled, it may outlast all else.
        self.worker = worker or Worker(self.job[1], operator.partial_step)
        self._timer = context.window_manager.event_timer_add(_STEP, window=context.window)
        _now[:] = [self]
        self.tell(context)

    def objects(self) -> list[tuple[bpy.types.Object, Target]]:
        """Objects to write to, as they were; raises `RefineError` if one was deleted."""
        there = {obj.session_uid: obj for obj in bpy.data.objects}
        objects = [(there.get(target.uid), target) for target in self._targets]
        for obj, target in objects:
            if obj is None or not obj.users_scene:
                raise RefineError(
                    f"object '{target.name}': was deleted; {self.doing.lower()} has ended"
                )
        return objects

    def done(self) -> bool:
        """Whether the thread ended and its result can be written; see `waits`."""
        objects = self.objects()
        if self.worker.running():
            return False
        modes = (target.mode for obj, target in objects if obj.mode != target.mode)
        mode = next(modes, "").replace("_", " ").lower()
        self.waits = f"go back to {mode} mode for the result" if mode else ""
        if self.waits and self.worker.cancelled:
            raise Cancelled
        return not self.waits

    def unchanged(self) -> list[SplatObject]:
        """The objects; `RefineError` if their splats changed since."""
        group = []
        for obj, target in self.objects():
            group.append(check(obj))
            if Target.of(group[-1]).splats != target.splats:
                raise RefineError(
                    f"object '{target.name}': its splats were changed meanwhile; start again"
                )
        return group

    @property
    def at_escape(self) -> str:
        """What Esc does now."""
        keeps = self.worker.what == self.worker.partial_step and not self.waits
        return "keeps the result so far" if keeps else "cancels"

    @property
    def share(self) -> str:
        """Share done and time left, short enough for a bar."""
        if self.waits:
            return "done"
        done = self.worker.fraction
        left = self._left.seconds(done)
        return f"{done:.0%}" + ("" if left is None else f", about {in_time(left)} left")

    @property
    def sentence(self) -> str:
        """The current work, and what Esc does."""
        if self.waits:
            return f"{self.doing}: {self.waits} (Esc {self.at_escape})"
        what = f" ({self.worker.what})" if self.worker.what else ""
        return f"{self.doing}{what}; Esc {self.at_escape}"

    def tell(self, context: Context) -> None:
        """Show the progress in status bar and panels, if it changed."""
        text = f"{self.sentence}: {self.share}"
        if text != self._shown:
            self._shown = text
            context.workspace.status_text_set(text)
            redraw_panels(context)

    def over(self, context: Context) -> None:
        """Stop the worker and clear the bars, once."""
        if self not in _now:
            return
        _now.clear()
        self.worker.cancel()
        context.window_manager.event_timer_remove(self._timer)
        if not bpy.app.background:
            # Later: Blender crashes if a window is drawn while it is being closed.
            bpy.app.timers.register(_clear_bars, first_interval=0.0)
        redraw_panels(context)


_now: list[Running] = []


def now() -> Running | None:
    """The running operation, if any."""
    return _now[0] if _now else None


def idle(_context: Context) -> str:
    """A need: no other operation may run on a thread."""
    if (running := now()) is None:
        return ""
    return f"{running.doing}: wait until it is over, or press Esc, which {running.at_escape}"


def _clear_bars() -> None:
    for window in bpy.context.window_manager.windows if now() is None else ():
        for workspace in bpy.data.workspaces:
            with bpy.context.temp_override(window=window, workspace=workspace):
                workspace.status_text_set(None)


def redraw_panels(context: Context) -> None:
    """Redraw the sidebars of the 3D views, and not the views themselves."""
    for area in viewport_draw.areas(context):
        for region in area.regions:
            if region.type == "UI":
                region.tag_redraw()


def in_object_mode(context: Context) -> str:
    """A need: object mode."""
    return "" if context.mode == "OBJECT" else "Go to object mode first"


def on_splats(context: Context) -> str:
    """A need: the active object holds splats."""
    if looks_like_splats(context.object):
        return ""
    return "Select an object that holds splats, or import a file of splats"


def out_of_edit_mode(context: Context) -> str:
    """A need: the active object is not in edit mode."""
    return "Leave edit mode first" if context.object.mode == "EDIT" else ""


def scored(context: Context) -> str:
    """A need: the active object has scores."""
    return "" if scores.record(context.object.data) else "Score the splats first"


def target_collection(context: Context) -> bpy.types.Collection:
    """Active collection, or the scene's where that is a library's."""
    active = context.collection
    return context.scene.collection if active is None or active.library else active


def tooltips(name: str, items: Sequence[Sequence[Any]]) -> Any:
    """A `description` for an operator: the tooltip of the enum item that its button sets."""

    def described(_cls: type, _context: Context, properties: Any) -> str:
        return next(text for value, _, text, *_ in items if value == getattr(properties, name))

    return classmethod(described)


class Needing:
    """An operator that can run if all its `needs` are met; Blender shows the first unmet one.
    Most need an active object that holds splats."""

    bl_options = {"REGISTER", "UNDO"}
    needs: tuple[Need, ...] = (idle, on_splats, out_of_edit_mode)

    @classmethod
    def poll(cls, context: Context) -> bool:
        """Whether the operator can run."""
        missing = next(filter(None, (need(context) for need in cls.needs)), "")
        if missing:
            cls.poll_message_set(missing)
        return not missing

    def tell(self, notes: Iterable[str], kind: str = "WARNING") -> None:
        """Report each note."""
        for note in notes:
            self.report({kind}, note)


class Acting(Needing):
    """An operator that ``act(context)`` does or starts; `FAILURES` are reported as errors."""

    def execute(self, context: Context) -> Answer:
        """Act, or report why not."""
        try:
            return self.act(context) or {"FINISHED"}
        except FAILURES as error:
            return fail(self, error)


class Job(Acting):
    """An operator on a thread, with progress bar and Esc. The window stays usable; the result is
    refused if objects changed. A class defines `doing`, its name while it runs, and
    ``work(context)``, a generator that raises `FAILURES`. It yields the objects that it is to write
    to, and a function of `Progress` for the thread, with arrays only. It gets back the objects, if
    they are unchanged, and the function's result, and writes to all objects or none.

    `partial_step`: the step whose partial result is kept on cancel."""

    doing, partial_step = "", None
    by_hand = False  # Whether a user started it; `invoke` sets it, also before a file browser

    def gather(self, context: Context) -> tuple[list[SplatObject], Any]:
        """Begin `work`: the objects, and the job, which is the rest of `work` and the function."""
        rest = self.work(context)
        group, function = next(rest)
        return group, (rest, function)

    @staticmethod
    def compute(job: Any, progress: Progress) -> Any:
        """The function's result, on any thread."""
        return job[1](progress)

    def put(self, _context: Context, group: list[SplatObject], job: Any, result: Any) -> None:
        """Do the rest of `work`, which writes the result."""
        with suppress(StopIteration):
            job[0].send((group, result))

    def invoke(self, context: Context, _event: bpy.types.Event) -> Answer:
        """Start the work on a thread."""
        self.by_hand = True
        return self.execute(context)

    def act(self, context: Context) -> Answer | None:
        """Start a thread for a user; for scripts and *Adjust Last Operation* do all at once."""
        watched, self.by_hand = self.by_hand and not bpy.app.background, False
        if watched and context.window is not None:
            return self.launch(context)
        group, job = self.gather(context)
        self.put(context, group, job, self.compute(job, silent))
        return None

    def launch(self, context: Context) -> Answer:
        """Read the scene, start the thread, and have Blender call `modal`."""
        Running(self, context, self.gather(context))  # held as `now`
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: Context, event: bpy.types.Event) -> Answer:
        """Wait for the thread, then put its result."""
        if (running := now()) is None:
            return {"CANCELLED"}
        if event.type == "ESC" and event.value == "PRESS":
            running.worker.cancel()
            return {"RUNNING_MODAL"}
        if event.type != "TIMER":
            return {"PASS_THROUGH"}
        try:  # Blender prints errors that are no `FAILURES`
            main_thread.serve()
            if not running.done():
                running.tell(context)
                return {"PASS_THROUGH"}
            result, group = running.worker.result(), running.unchanged()
            running.over(context)
            self.put(context, group, running.job, result)
        except BaseException as error:
            running.over(context)
            if not isinstance(error, Cancelled):
                return fail(self, error)
            self.report({"INFO"}, f"{self.doing} cancelled; nothing was changed")
            return {"CANCELLED"}
        return {"FINISHED"}

    def cancel(self, _context: Context) -> None:
        """End the thread when Blender ends the operator, closing its window or file."""
        _end()


def _end(*_: object) -> None:
    """End the work: Blender drops the operator silently."""
    if (running := now()) is not None:
        running.over(bpy.context)
        running.worker.end()


unregister, HANDLERS = _end, {_end: ("load_pre",)}
