"""What panels say of the scene, computed once until the scene changes, not at each draw."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import bpy
from bpy.app.handlers import persistent

from .running import redraw_panels

Answer = TypeVar("Answer")

_answers: dict[Hashable, Any] = {}

_asked: set[Hashable] = set()
"""What a timer is to compute."""

_EVENTS = ("depsgraph_update_post", "frame_change_post", "undo_post", "redo_post", "load_post")
"""Handlers that are called after anything changed, the settings too."""

_NOT_SETTINGS = {"rna_type", "name"}  # of every group of properties


def cached(what: Hashable, context: bpy.types.Context, compute: Callable[[], Answer]) -> Answer:
    """Return what `compute` returns of the active object and the settings, until anything changes.

    What a script changes without telling Blender, such as a custom property, is seen after the next
    change.

    Parameters
    ----------
    what : hashable
        Names the value, beside the object and the settings.
    context : bpy.types.Context
    compute : callable
        Reads the scene, the active object and the panel's settings, and nothing else.
    """
    key = _key(what, context)
    if key not in _answers:
        _answers[key] = compute()
    return _answers[key]


def cached_soon(
    what: Hashable,
    context: bpy.types.Context,
    compute: Callable[[bpy.types.Object, bpy.types.PropertyGroup], Answer],
) -> Answer | None:
    """Return what `compute` returned; where it did not yet, None, and call it after the drawing.

    Parameters
    ----------
    what, context
        See `cached`.
    compute : callable
        ``compute(obj, settings)``: of the active object and the panel's settings. It may take
        longer than a panel should be drawn.
    """
    key, names = _key(what, context), (context.scene.name, context.object.name)

    def answer() -> None:
        _asked.discard(key)
        scene, obj = bpy.data.scenes.get(names[0]), bpy.data.objects.get(names[1])
        if scene is not None and obj is not None:
            _answers[key] = compute(obj, scene.refine)
            redraw_panels(bpy.context)

    if key not in _answers and key not in _asked and not bpy.app.background:
        _asked.add(key)
        bpy.app.timers.register(answer, first_interval=0.0)
    return _answers.get(key)


def _key(what: Hashable, context: bpy.types.Context) -> Hashable:
    """Return what an answer depends on."""
    obj, settings = context.object, context.scene.refine
    names = settings.bl_rna.properties.keys()
    values = repr([getattr(settings, name) for name in names if name not in _NOT_SETTINGS])
    return (what, context.scene.session_uid, obj and obj.session_uid, values)


@persistent
def _forget(*_arguments: object) -> None:
    _answers.clear()


def register() -> None:
    """Hear of changes."""
    for event in _EVENTS:
        getattr(bpy.app.handlers, event).append(_forget)


def unregister() -> None:
    """Hear of changes no more."""
    for event in _EVENTS:
        getattr(bpy.app.handlers, event).remove(_forget)
    _forget()
