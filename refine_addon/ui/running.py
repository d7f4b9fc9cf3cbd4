"""The operation that works on a thread: one at most, as panels, polls and menus see it."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import bpy
from bpy.app.handlers import persistent

from ..core.errors import RefineError
from ..core.execute import Cancelled, TimeLeft, in_time
from ..mesh import attributes as mesh_attributes
from ..mesh import layout as mesh_layout
from ..mesh.layout import SplatObject
from .worker import Worker

_STEP = 0.05
"""Seconds between two events of the timer, at each of which the thread is looked at."""


class Target(NamedTuple):
    """An object as it was read: known by its number in this session, which an undo keeps."""

    name: str
    uid: int
    mode: str
    splats: tuple[int, ...]

    @classmethod
    def of(cls, checked: SplatObject) -> Target:
        """What an object is now."""
        obj, mesh = checked.obj, checked.mesh
        splats = mesh.session_uid, len(checked), mesh_attributes.digest(checked)
        return cls(obj.name, obj.session_uid, obj.mode, splats)


class Running:
    """An operation while it runs: all that an operator holds of it, dropped when it is over.

    Blender keeps operators in its history, which must not keep splats in memory.

    Attributes
    ----------
    operator : str
        Name of the operator, as a button has it.
    job
        What was gathered from the scene.
    worker : Worker
        Where given, what stands for one: how far a render is, and how it is stopped.
    waits : str
        What has to happen before the result can be written, "" if nothing.
    """

    def __init__(
        self,
        operator: Any,
        context: bpy.types.Context,
        group: list[SplatObject],
        job: Any,
        worker: Any = None,
    ) -> None:
        self.operator, self.doing = type(operator).bl_idname, operator.doing
        self.job, self.waits = job, ""
        self._offers, self._targets = operator.offers, [Target.of(each) for each in group]
        self._left, self._told = TimeLeft(), ""
        self.worker = worker or Worker(partial(operator.compute, job))
        self._timer = context.window_manager.event_timer_add(_STEP, window=context.window)
        _now[:] = [self]
        self.tell(context)

    def objects(self) -> list[bpy.types.Object]:
        """The objects that are to be written to; raises `RefineError` once one was deleted."""
        there = {obj.session_uid: obj for obj in bpy.data.objects}
        found = [there.get(target.uid) for target in self._targets]
        for obj, target in zip(found, self._targets, strict=True):
            if obj is None or not obj.users_scene:
                raise RefineError(
                    f"object '{target.name}': was deleted; {self.doing.lower()} has ended"
                )
        return found

    def done(self) -> bool:
        """Whether the thread has ended and its result can be written; see `waits`."""
        pairs = zip(self.objects(), self._targets, strict=True)
        if self.worker.running():
            return False
        modes = (target.mode for obj, target in pairs if obj.mode != target.mode)
        mode = next(modes, "").replace("_", " ").lower()
        self.waits = f"go back to {mode} mode for the result" if mode else ""
        if self.waits and self.worker.cancelled:
            raise Cancelled
        return not self.waits

    def unchanged(self) -> list[SplatObject]:
        """The objects, whose splats are still those that were read; raises `RefineError` else."""
        group = [mesh_layout.check(obj) for obj in self.objects()]
        for checked, target in zip(group, self._targets, strict=True):
            if Target.of(checked).splats != target.splats:
                raise RefineError(
                    f"object '{target.name}': its splats were changed meanwhile; start again"
                )
        return group

    @property
    def at_escape(self) -> str:
        """What Esc does at this moment."""
        keeps = self._offers and self.worker.what == self._offers and not self.waits
        return "keeps what that has reached" if keeps else "cancels"

    @property
    def factor(self) -> float:
        """How much is done, 0 to 1."""
        return self.worker.fraction

    @property
    def share(self) -> str:
        """How much is done and how long the rest takes, as short as a bar wants it."""
        if self.waits:
            return "done"
        left = self._left.seconds(self.factor)
        return f"{self.factor:.0%}" + ("" if left is None else f", about {in_time(left)} left")

    @property
    def sentence(self) -> str:
        """What is being done, and what Esc does."""
        if self.waits:
            return f"{self.doing}: {self.waits} (Esc {self.at_escape})"
        what = f" ({self.worker.what})" if self.worker.what else ""
        return f"{self.doing}{what}; Esc {self.at_escape}"

    def tell(self, context: bpy.types.Context) -> None:
        """Say in status bar and panels how far it is, if there is news."""
        text = f"{self.sentence}: {self.share}"
        if text != self._told:
            self._told = text
            context.workspace.status_text_set(text)
            redraw_panels(context)

    def over(self, context: bpy.types.Context) -> None:
        """Stop what still works, and clear the bars."""
        self.worker.cancel()
        if self in _now:
            _now.clear()
        context.window_manager.event_timer_remove(self._timer)
        if not bpy.app.background:
            # Not at once: a window that is being closed ends Blender where it is drawn.
            bpy.app.timers.register(_clear_bars, first_interval=0.0)
        redraw_panels(context)


_now: list[Running] = []


def now() -> Running | None:
    """Return what runs, if anything does."""
    return _now[0] if _now else None


def refusal() -> str:
    """Return why nothing else can be started, "" where it can."""
    running = now()
    if running is None:
        return ""
    return f"{running.doing}: wait until it is over, or press Esc, which {running.at_escape}"


def _clear_bars() -> None:
    """Clear the status bars of all workspaces: another may have been chosen meanwhile."""
    for window in bpy.context.window_manager.windows if now() is None else ():
        for workspace in bpy.data.workspaces:
            with bpy.context.temp_override(window=window, workspace=workspace):
                workspace.status_text_set(None)


def redraw_panels(context: bpy.types.Context) -> None:
    """Have the sidebars of the 3D views drawn again, and not the views themselves."""
    for window in context.window_manager.windows:
        for area in window.screen.areas:
            if area.type != "VIEW_3D":
                continue
            for region in area.regions:
                if region.type == "UI":
                    region.tag_redraw()


def register() -> None:
    """End the work where another file is loaded."""
    bpy.app.handlers.load_pre.append(_end)


def unregister() -> None:
    """Undo `register`, and end the work: Blender drops the operator without a word."""
    running = now()
    if running is not None:
        _end()
        running.over(bpy.context)
    bpy.app.handlers.load_pre.remove(_end)


@persistent
def _end(*_arguments: object) -> None:
    """End the work, where its scene goes away."""
    if (running := now()) is not None:
        _now.clear()
        running.worker.end()
