"""What operators have in common: what they need to run, and how they say what went wrong."""

from __future__ import annotations

from collections.abc import Callable
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

Answer = set[str]
"""What Blender is told of an operator: FINISHED, CANCELLED, RUNNING_MODAL or PASS_THROUGH."""

Need = Callable[[bpy.types.Context], str]
"""Returns what an operator lacks to run, "" if nothing."""

FAILURES = (RefineError, MemoryError)
"""What an operator reports as an error; all else is a fault of the program."""


def fail(operator: bpy.types.Operator, error: Exception) -> Answer:
    """Report an error to the user, and return that nothing was done."""
    operator.report({"ERROR"}, described(error))
    return {"CANCELLED"}


def described(error: Exception) -> str:
    """Return one of `FAILURES` as a sentence."""
    if isinstance(error, MemoryError):
        return f"not enough memory ({error})" if str(error) else "not enough memory"
    return str(error)


def idle(_context: bpy.types.Context) -> str:
    """Return why another operation has to be over first, "" if none works on a thread."""
    return running.refusal()


def in_object_mode(context: bpy.types.Context) -> str:
    """Return that object mode is needed, "" in it."""
    return "" if context.mode == "OBJECT" else "Go to object mode first"


def on_splats(context: bpy.types.Context) -> str:
    """Return that the active object must hold splats, "" if it does."""
    if mesh_layout.looks_like_splats(context.object):
        return ""
    return "Select an object that holds splats: import a file of splats"


def out_of_edit_mode(context: bpy.types.Context) -> str:
    """Return that the active object must leave edit mode, "" if it is not in it."""
    return "Leave edit mode first" if context.object.mode == "EDIT" else ""


def scored(context: bpy.types.Context) -> str:
    """Return that the active object needs scores, "" if it has them."""
    return "" if mesh_scores.record(context.object.data) else "Score the splats first"


class Needing:
    """An operator that can run if nothing of what it needs is missing.

    Attributes
    ----------
    needs : tuple of Need
        Asked in this order.
    """

    needs: tuple[Need, ...] = (idle,)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether the operator can run, and if not, why."""
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
    """An operator that does all of it when it is clicked, without a thread."""

    def act(self, context: bpy.types.Context) -> Answer:
        """Do it; what is raised of `FAILURES` is reported as an error."""
        raise NotImplementedError

    def execute(self, context: bpy.types.Context) -> Answer:
        """Do it, or report why it cannot be done."""
        try:
            return self.act(context)
        except FAILURES as error:
            return fail(self, error)


class Job:
    """An operator that works beside the window, with a bar to watch and a key to cancel.

    It is three functions and a name. Meanwhile all events but Esc go on to the rest of the window.
    Before anything is written to an object, it is compared with what it was.

    Attributes
    ----------
    doing : str
        What it does.
    offers : str
        What progress calls the part of the work that offers what it has reached when it is
        cancelled (`Result.stopped`).
    """

    doing = offers = ""
    by_hand = False
    """Whether somebody watches: set by `invoke`, or before a file browser calls `execute`."""
    _running: Running | None = None

    def gather(self, context: bpy.types.Context) -> tuple[list[SplatObject], Any]:
        """The objects that `put` writes to, and all that `compute` needs, or what refuses it."""
        raise NotImplementedError

    @staticmethod
    def compute(job: Any, progress: Progress) -> Any:
        """What comes of it; on any thread, with arrays alone."""
        raise NotImplementedError

    def put(
        self, context: bpy.types.Context, group: list[SplatObject], job: Any, result: Any
    ) -> None:
        """Write it to the objects, which are as they were: all of it, or nothing."""
        raise NotImplementedError

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> Answer:
        """Do it beside the window."""
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
        """Read the scene, start the thread, and have Blender call `modal` from now on."""
        try:
            self._running = Running(self, context, *self.gather(context))
        except FAILURES as error:
            return fail(self, error)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> Answer:
        """Wait for the thread, and put what it found."""
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
        """End the thread where Blender ends the operator: its window is closed, or its file."""
        if (now := self._running) is not None:
            self._over(context, now)
            now.worker.end()

    def _looked(self, context: bpy.types.Context, now: Running) -> Answer:
        """Look how far the thread is; what is no failure is a fault, which Blender prints."""
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
        """Let go of what ran, once."""
        if self._running is not None:
            self._running = None
            now.over(context)
