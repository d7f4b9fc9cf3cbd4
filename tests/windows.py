"""A window that nobody sees: an operator works on its thread as after a click."""

import time
from types import SimpleNamespace

import bpy

REGIONS = {"VIEW_3D": ("WINDOW", "UI", "HEADER"), "PROPERTIES": ("WINDOW",)}


class Context:
    """Blender's context with such a window.

    ``drawn``: kinds of the regions that were to be drawn again, of a 3D view and of another area.
    """

    def __init__(self):
        self.drawn, self.said, self._timers = [], [], []
        areas = [
            SimpleNamespace(type=area, regions=[self._region(area, kind) for kind in kinds])
            for area, kinds in REGIONS.items()
        ]
        self.window = SimpleNamespace(screen=SimpleNamespace(areas=areas))
        self.workspace = SimpleNamespace(status_text_set=self.said.append)
        self.window_manager = SimpleNamespace(
            event_timer_add=self._add_timer,
            event_timer_remove=self._remove_timer,
            modal_handler_add=lambda _: None,
            windows=[self.window],
        )

    @property
    def timers(self):
        """How many timers run."""
        return len(self._timers)

    def _add_timer(self, step, **_options):
        self._timers.append(bpy.context.window_manager.event_timer_add(step))
        return self._timers[-1]

    def _remove_timer(self, timer):
        self._timers.remove(timer)
        bpy.context.window_manager.event_timer_remove(timer)

    def _region(self, area, kind):
        return SimpleNamespace(type=kind, tag_redraw=lambda: self.drawn.append(f"{area} {kind}"))

    def __getattr__(self, name):
        """Return what Blender has."""
        return getattr(bpy.context, name)


def started_in_a_window(addon, cls, **properties):
    """Start an operator; return it, its context and what it reports."""
    skipped = {"__dict__", "__weakref__", "__annotations__", "bl_rna", "execute", "invoke"}
    kinds = [kind for kind in reversed(cls.__mro__) if kind.__module__.startswith(addon.__name__)]
    body = {name: value for kind in kinds for name, value in vars(kind).items()}
    body = {name: value for name, value in body.items() if name not in skipped}
    said = []
    body |= {"report": lambda _self, _kind, text: said.append(text), **properties}
    operator, context = type(cls.__name__, (addon.ui.operator_bases.Job,), body)(), Context()
    assert operator.launch(context) == {"RUNNING_MODAL"}
    return operator, context, said


def event(kind, value="PRESS", **held):
    """Return what Blender tells an operator of a key, the mouse or a timer."""
    keys = {"ctrl": False, "shift": False, "alt": False, "oskey": False}
    return SimpleNamespace(type=kind, value="NOTHING" if kind == "TIMER" else value, **keys | held)


def until(operator, context, is_so=lambda: False):
    """Send the timer's events until something is so, or the operator ends; return its answer."""
    for _ in range(30_000):  # five minutes
        answer = operator.modal(context, event("TIMER"))
        if answer != {"PASS_THROUGH"} or is_so():
            return answer
        time.sleep(0.01)
    raise AssertionError("it never ended")
