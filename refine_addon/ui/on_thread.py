"""Operators whose work runs on a thread, while a bar shows how far it is and Esc cancels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import bpy

from .. import splat_object
from ..core.errors import Cancelled, RefineError
from ..core.work import silent
from ..mesh import layout as mesh_layout
from .worker import Worker

Answer = set[str]

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


@dataclass
class _Running:
    """An operation while it runs: all that an operator holds of it, dropped when it is over.

    Blender keeps an operator in its history long after; splats and results are not to stay there.

    Attributes
    ----------
    job
        What `prepare` gathered.
    name : str
        Of the object: the object itself may not be the same one after an undo.
    worker : Worker
    timer : bpy.types.Timer
    """

    job: Any
    name: str
    worker: Worker[Any]
    timer: bpy.types.Timer


class OnThread:
    """An operator that waits for a thread in a window, with a bar to watch and a key to cancel.

    It says what to do in three steps. `prepare` reads the scene and returns a job: all that is
    needed of it. `work` runs on the thread and touches the job's arrays alone. `finish` writes what
    came of it. The operator itself keeps neither.
    """

    doing = ""
    _running: _Running | None = None

    def execute(self, context: bpy.types.Context) -> Answer:
        """Do all of it at once."""
        try:
            checked = mesh_layout.check(context.object)
            job = self.prepare(context, checked)
            return self.finish(context, checked, job, self.work(job, silent))
        except FAILURES as error:
            return fail(self, error)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> Answer:
        """Start the thread, unless there is nobody to watch."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        try:
            job = self.prepare(context, mesh_layout.check(context.object))
        except FAILURES as error:
            return fail(self, error)
        self.start(context, job)
        return {"RUNNING_MODAL"}

    def start(self, context: bpy.types.Context, job: Any) -> None:  # noqa: ANN401 - its own kind
        """Start the thread, and have Blender call `modal` from now on."""
        manager = context.window_manager
        self._running = _Running(
            job=job,
            name=context.object.name,
            worker=Worker(partial(self.work, job)),
            timer=manager.event_timer_add(0.05, window=context.window),
        )
        manager.modal_handler_add(self)
        _show_progress(context, self.doing, 0.0)

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> Answer:
        """Wait for the thread, and write what it found."""
        running = self._running
        if running is None:
            return {"CANCELLED"}
        worker = running.worker
        if event.type == "ESC":
            worker.cancel()
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}
        if worker.running():
            _show_progress(context, self.doing, worker.fraction)
            return {"RUNNING_MODAL"}
        self._over(context, running)
        try:
            result = worker.result()
            checked = mesh_layout.check(splat_object.find(running.name))
            return self.finish(context, checked, running.job, result)
        except Cancelled:
            self.report({"INFO"}, f"{self.doing} cancelled; nothing was changed")
            return {"CANCELLED"}
        except FAILURES as error:
            return fail(self, error)

    def cancel(self, context: bpy.types.Context) -> None:
        """Stop the thread where Blender ends the operator."""
        if (running := self._running) is not None:
            self._over(context, running)
            running.worker.cancel()

    def _over(self, context: bpy.types.Context, running: _Running) -> None:
        """Clear the bar and let go of what ran."""
        self._running = None
        context.window_manager.event_timer_remove(running.timer)
        _show_progress(context, self.doing, None)


def _show_progress(context: bpy.types.Context, doing: str, fraction: float | None) -> None:
    """Draw how much is done in panel and status bar; None clears both."""
    context.window_manager.refine_progress = -1.0 if fraction is None else fraction
    text = None if fraction is None else f"{doing}: {fraction:.0%} (Esc cancels)"
    context.workspace.status_text_set(text)
    for area in context.window.screen.areas:
        if area.type == "VIEW_3D":
            area.tag_redraw()
