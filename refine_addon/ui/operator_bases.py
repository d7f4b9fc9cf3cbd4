"""Common parts of operators: needs, threads, error messages."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import bpy

from .. import main_thread
from ..core.errors import RefineError
from ..core.execute import Cancelled, Progress, silent
from ..mesh import layout as mesh_layout
from ..mesh import scores as mesh_scores
from ..mesh.layout import SplatObject
from . import running
from .running import Running

Answer = set[str]  # FINISHED, CANCELLED, RUNNING_MODAL or PASS_THROUGH

Need = Callable[[bpy.types.Context], str]  # Gives what an operator lacks to run, "" if nothing

FAILURES = (RefineError, MemoryError)  # Exceptions reported as errors; all others are bugs


def fail(operator: bpy.types.Operator, error: Exception) -> Answer:
    """Report an error to the user; CANCELLED."""
    operator.report({"ERROR"}, described(error))
    return {"CANCELLED"}


def described(error: Exception) -> str:
    """One of `FAILURES` as a sentence."""
    if isinstance(error, MemoryError):
        return f"not enough memory ({error})" if str(error) else "not enough memory"
    return str(error)


def idle(_context: bpy.types.Context) -> str:
    """A need: no other operation may run on a thread."""
    return running.refusal()


def in_object_mode(context: bpy.types.Context) -> str:
    """A need: object mode."""
    return "" if context.mode == "OBJECT" else "Go to object mode first"


def on_splats(context: bpy.types.Context) -> str:
    """A need: the active object holds splats."""
    if mesh_layout.looks_like_splats(context.object):
        return ""
    return "Select an object that holds splats: import a file of splats"


def out_of_edit_mode(context: bpy.types.Context) -> str:
    """A need: the active object is not in edit mode."""
    return "Leave edit mode first" if context.object.mode == "EDIT" else ""


def scored(context: bpy.types.Context) -> str:
    """A need: the active object has scores."""
    return "" if mesh_scores.record(context.object.data) else "Score the splats first"


def tooltips(name: str, items: Sequence[Sequence[Any]]) -> Any:
    """The `description` of an operator whose buttons differ by an enum, of these items."""

    def described(_cls: type, _context: bpy.types.Context, properties: Any) -> str:
        return next(text for value, _, text, *_ in items if value == getattr(properties, name))

    return classmethod(described)


class Needing:
    """An operator that can run if none of its `needs`, in order, is missing."""

    needs: tuple[Need, ...] = (idle,)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether the operator can run; Blender shows why not."""
        missing = next(filter(None, (need(context) for need in cls.needs)), "")
        if missing:
            cls.poll_message_set(missing)
        return not missing


class OnSplats(Needing):
    """An operator on the active object, which must hold splats."""

    needs: tuple[Need, ...] = (idle, on_splats, out_of_edit_mode)


class OnScored(OnSplats):
    """An operator on the active object, which must be scored."""

    needs = (*OnSplats.needs, scored)


class AtOnce:
    """An operator without a thread."""

    def act(self, context: bpy.types.Context) -> Answer:
        """Do it; `FAILURES` are reported as errors."""
        raise NotImplementedError

    def execute(self, context: bpy.types.Context) -> Answer:
        """Do it, or report why not."""
        try:
            return self.act(context)
        except FAILURES as error:
            return fail(self, error)


class Job:
    """An operator on a thread, with progress bar and Esc: three functions and a name, `doing`.
    Other events go on to the window. Objects are compared with what they were before writing.
    `offers`: the stage whose partial result is kept on cancel (`Result.stopped`)."""

    doing = offers = ""
    by_hand = False  # Somebody watches: set by `invoke`, or before a file browser's `execute`
    _running: Running | None = None

    def gather(self, context: bpy.types.Context) -> tuple[list[SplatObject], Any]:
        """Objects that `put` writes to, and the input of `compute`; or raise why not."""
        raise NotImplementedError

    @staticmethod
    def compute(job: Any, progress: Progress) -> Any:
        """The result; on any thread, with arrays only."""
        raise NotImplementedError

    def put(
        self, context: bpy.types.Context, group: list[SplatObject], job: Any, result: Any
    ) -> None:
        """Write the result to the unchanged objects: all or nothing."""
        raise NotImplementedError

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> Answer:
        """Start the work on a thread."""
        self.by_hand = True
        return self.execute(context)

    def execute(self, context: bpy.types.Context) -> Answer:
        """Do all of it at once where nobody watches: a script, or an operation adjusted."""
        watched, self.by_hand = self.by_hand and not bpy.app.background, False
        if watched and context.window is not None:
            return self.launch(context)
        try:
            group, job = self.gather(context)
            self.put(context, group, job, self.compute(job, silent))
        except FAILURES as error:
            return fail(self, error)
        return {"FINISHED"}

    def launch(self, context: bpy.types.Context) -> Answer:
        """Read the scene, start the thread, and have Blender call `modal`."""
        try:
            self._running = Running(self, context, *self.gather(context))
        except FAILURES as error:
            return fail(self, error)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> Answer:
        """Wait for the thread, then put its result."""
        now = self._running
        if now is None:
            return {"CANCELLED"}
        if event.type == "TIMER":
            return self._looked(context, now)
        if event.type != "ESC" or event.value != "PRESS":
            return {"PASS_THROUGH"}
        now.worker.cancel()
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """End the thread when Blender ends the operator, closing its window or file."""
        if (now := self._running) is not None:
            self._over(context, now)
            now.worker.end()

    def _looked(self, context: bpy.types.Context, now: Running) -> Answer:
        """Check the thread; errors other than failures are bugs, which Blender prints."""
        try:
            main_thread.serve()
            if not now.done():
                now.tell(context)
                return {"PASS_THROUGH"}
            result, group = now.worker.result(), now.unchanged()
            self._over(context, now)
            self.put(context, group, now.job, result)
        except BaseException as error:
            self._over(context, now)
            if isinstance(error, FAILURES):
                return fail(self, error)
            if not isinstance(error, Cancelled):
                raise
            self.report({"INFO"}, f"{self.doing} cancelled; nothing was changed")
            return {"CANCELLED"}
        return {"FINISHED"}

    def _over(self, context: bpy.types.Context, now: Running) -> None:
        if self._running is not None:
            self._running = None
            now.over(context)
