"""The operation that works on a thread: one at most, as panels, polls and menus see it."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import bpy
from bpy.app.handlers import persistent

from ..core.execute import TimeLeft, in_time
from ..mesh.layout import SplatObject
from .target import Target
from .worker import Worker

_UNDO, _SAVE = "Undo", "Save"
_WAIT = {
    "ed.undo": _UNDO,
    "ed.redo": "Redo",
    "ed.undo_history": _UNDO,
    "wm.save_mainfile": _SAVE,
    "wm.save_as_mainfile": _SAVE,
}
"""What waits until the work is over, by the names of Blender's operators."""


_LONG = 5.0
"""Seconds for which a refusal stays in the status bar."""


@dataclass(eq=False)
class Running:
    """An operation while it runs: all that an operator holds of it, dropped when it is over.

    Blender keeps operators in its history, which must not keep splats in memory.

    Attributes
    ----------
    operator : str
        Name of the operator, as a button has it.
    doing : str
        What it does.
    escape : str
        What Esc does, but for the part of the work that offers something; see `at_escape`.
    job
        What was gathered from the scene.
    targets : list of Target
        The objects that are to be written to.
    worker : Worker
    timer : bpy.types.Timer
    waits : str
        What has to happen before the result can be written, "" if nothing.
    offers : str
        See `OnThread.offers`.
    """

    operator: str
    doing: str
    escape: str
    job: Any
    targets: list[Target]
    worker: Worker[Any]
    timer: bpy.types.Timer
    waits: str = ""
    offers: str = ""
    _said: tuple[str, float] = ("", 0.0)
    _left: TimeLeft = field(default_factory=TimeLeft)
    _told: str = ""

    def target(self) -> SplatObject | None:
        """Return the first object that is to be written to, None if none is.

        Raises
        ------
        RefineError
            If one is no longer as it was read; see `Target.unchanged`.
        """
        return next(iter([target.unchanged() for target in self.targets]), None)

    @property
    def at_escape(self) -> str:
        """What Esc does at this moment."""
        if self.offers and self.worker.what == self.offers and not self.waits:
            return "keeps what that has reached"
        return self.escape

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

    def say(self, text: str) -> None:
        """Say something in the status bar for `_LONG`."""
        self._said = text, time.monotonic() + _LONG

    def tell(self, context: bpy.types.Context) -> None:
        """Say in status bar and panels how far it is, if there is news."""
        said, until = self._said
        text = said if time.monotonic() < until else f"{self.sentence}: {self.share}"
        if text != self._told:
            self._told = text
            context.workspace.status_text_set(text)
            redraw_panels(context)


_now: list[Running] = []


def now() -> Running | None:
    """Return what runs, if anything does."""
    return _now[0] if _now else None


def begin(running: Running) -> None:
    """Let others know what runs."""
    _now[:] = [running]


def over(context: bpy.types.Context, running: Running) -> None:
    """Clear the bars of what ran."""
    if running in _now:
        _now.clear()
    context.window_manager.event_timer_remove(running.timer)
    for workspace in bpy.data.workspaces:  # work goes on where another one is chosen meanwhile
        workspace.status_text_set(None)
    redraw_panels(context)


def refusal() -> str:
    """Return why nothing else can be started, "" where it can."""
    running = now()
    if running is None:
        return ""
    return f"{running.doing}: wait until it is over, or press Esc, which {running.at_escape}"


def refused(event: bpy.types.Event) -> str:
    """Return why a key does not do what it usually does, "" where it does."""
    running = now()
    if running is None or event.value != "PRESS":
        return ""
    for keymap in bpy.context.window_manager.keyconfigs.user.keymaps:
        for item in keymap.keymap_items:
            if item.idname in _WAIT and _is(event, item):
                return f"{_WAIT[item.idname]} waits: {refusal()}"
    return ""


def _is(event: bpy.types.Event, item: bpy.types.KeyMapItem) -> bool:
    """Tell whether an event is what a line of a key map names."""
    if not item.active or item.type != event.type or item.value not in {"PRESS", "ANY"}:
        return False
    held = ("ctrl", "shift", "alt", "oskey")
    wanted = ((getattr(item, key), getattr(event, key)) for key in held)
    return item.any or all(want in {-1, int(have)} for want, have in wanted)


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
    """Say in the menus what waits, and end the work where another file is loaded."""
    bpy.types.TOPBAR_MT_edit.prepend(_draw_edit)
    bpy.types.TOPBAR_MT_file.prepend(_draw_file)
    bpy.app.handlers.load_pre.append(_end)


def unregister() -> None:
    """Undo `register`, and end the work: Blender drops the operator without a word."""
    running = now()
    if running is not None:
        _end()
        over(bpy.context, running)
    bpy.app.handlers.load_pre.remove(_end)
    bpy.types.TOPBAR_MT_file.remove(_draw_file)
    bpy.types.TOPBAR_MT_edit.remove(_draw_edit)


@persistent
def _end(*_arguments: object) -> None:
    """End the work, where its scene goes away."""
    if (running := now()) is not None:
        _now.clear()
        running.worker.end()


def _draw_edit(menu: bpy.types.Menu, _context: bpy.types.Context) -> None:
    """Switch off the menu with *Undo*, and say why."""
    if why := refusal():
        menu.layout.label(text=why, icon="TIME")
        menu.layout.separator()
        menu.layout.enabled = False


def _draw_file(menu: bpy.types.Menu, _context: bpy.types.Context) -> None:
    """Say above *Save* what it would leave out."""
    if (running := now()) is not None:
        text = f"{running.doing}: what is saved now is without it"
        menu.layout.label(text=text, icon="TIME")
        menu.layout.separator()
