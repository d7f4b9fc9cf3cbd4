"""Operators whose work runs on a thread, while the window stays alive and Esc cancels."""

from __future__ import annotations

from functools import partial

import bpy

from .. import main_thread
from ..core.execute import Cancelled, silent
from ..mesh import layout as mesh_layout
from ..mesh.layout import SplatObject
from . import running as at_work
from .operator_bases import FAILURES, Answer, fail
from .running import Running
from .target import Target
from .worker import Worker

_STEP = 0.05
"""Seconds between two events of the timer, at each of which the thread is looked at."""


class OnThread:
    """An operator that waits for a thread in a window, with a bar to watch and a key to cancel.

    It says what to do in three steps. `prepare` reads the scene and returns a job: all that is
    needed of it. `work` runs on the thread and touches the job's arrays alone. `finish` writes what
    came of it. The operator itself keeps neither.

    Meanwhile events go on to the rest of the window, but for undo and save. Before anything is
    written to an object, it is compared with what it was when it was read (`Target`).
    """

    doing = ""
    offers = ""
    """What progress calls the part of the work that offers what it has reached when it is cancelled
    (`Result.stopped`)."""
    reads_object = True
    """Whether it needs the active object."""
    _running: Running | None = None

    def written(
        self, _context: bpy.types.Context, checked: SplatObject | None
    ) -> list[SplatObject]:
        """Return the objects that `finish` writes to, the active one first."""
        return [checked] if checked else []

    def execute(self, context: bpy.types.Context) -> Answer:
        """Do all of it at once."""
        try:
            checked = self._checked(context)
            job = self.prepare(context, checked)
            return self.finish(context, checked, job, self.work(job, silent))
        except FAILURES as error:
            return fail(self, error)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> Answer:
        """Start the thread, unless there is nobody to watch."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        return self.launch(context)

    def launch(self, context: bpy.types.Context) -> Answer:
        """Read the scene, start the thread, and have Blender call `modal` from now on."""
        try:
            checked = self._checked(context)
            job = self.prepare(context, checked)
            targets = [Target.of(each) for each in self.written(context, checked)]
        except FAILURES as error:
            return fail(self, error)
        manager = context.window_manager
        self._running = Running(
            operator=type(self).bl_idname,
            doing=self.doing,
            escape="cancels",
            job=job,
            targets=targets,
            worker=Worker(partial(self.work, job)),
            timer=manager.event_timer_add(_STEP, window=context.window),
            offers=self.offers,
        )
        manager.modal_handler_add(self)
        at_work.begin(self._running)
        self._running.tell(context)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> Answer:
        """Wait for the thread, and write what it found."""
        running = self._running
        if running is None:
            return {"CANCELLED"}
        if event.type == "TIMER":
            try:
                main_thread.serve()
                return self._looked(context, running)
            except Exception:  # a fault of the program, which Blender prints
                running.worker.cancel()
                self._over(context, running)
                raise
        if event.type == "ESC" and event.value == "PRESS":
            running.worker.cancel()
        elif why := at_work.refused(event):
            self.report({"WARNING"}, why)
            running.say(why)
            running.tell(context)
        else:
            return {"PASS_THROUGH"}
        return {"RUNNING_MODAL"}

    def cancel(self, context: bpy.types.Context) -> None:
        """End the thread where Blender ends the operator: its window is closed, or its file."""
        if (running := self._running) is not None:
            self._over(context, running)
            running.worker.end()

    def _looked(self, context: bpy.types.Context, running: Running) -> Answer:
        """Look how far the thread is."""
        if not running.worker.running():
            waits = (target.waits() for target in running.targets)
            running.waits = next(filter(None, waits), "")
            if not running.waits:
                return self._done(context, running)
            if running.worker.cancelled:
                return self._stopped(context, running)
        running.tell(context)
        return {"PASS_THROUGH"}

    def _checked(self, context: bpy.types.Context) -> SplatObject | None:
        return mesh_layout.check(context.object) if self.reads_object else None

    def _done(self, context: bpy.types.Context, running: Running) -> Answer:
        """Write what the main work came to."""
        try:
            result = running.worker.result()
        except Cancelled:
            return self._stopped(context, running)
        except FAILURES as error:
            return self._stopped(context, running, error)
        self._over(context, running)
        try:
            return self.finish(context, running.target(), running.job, result)
        except FAILURES as error:
            return self._stopped(context, running, error)

    def _stopped(
        self, context: bpy.types.Context, running: Running, error: Exception | None = None
    ) -> Answer:
        """Say why nothing more comes."""
        self._over(context, running)
        if error is not None:
            fail(self, error)
        if error is None:
            self.report({"INFO"}, f"{self.doing} cancelled; nothing was changed")
        return {"CANCELLED"}

    def _over(self, context: bpy.types.Context, running: Running) -> None:
        """Clear the bar and let go of what ran."""
        if self._running is not None:
            self._running = None
            at_work.over(context, running)


class AskedFirst(OnThread):
    """Such an operator that asks something before it starts: for a file."""

    _asked = False

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> Answer:
        """Ask; Blender calls `execute` when that is answered."""
        raise NotImplementedError

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Answer:
        """Ask, and start the thread then."""
        self._asked = True
        return self.ask(context, event)

    def execute(self, context: bpy.types.Context) -> Answer:
        """Start the thread after asking; a script, or an operation adjusted, does all at once."""
        asked, self._asked = self._asked, False
        return OnThread.invoke(self, context, None) if asked else super().execute(context)
