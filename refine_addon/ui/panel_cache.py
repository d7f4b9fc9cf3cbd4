"""What panels say of the scene, computed once until the scene changes, not at each draw."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import bpy
from bpy.app.handlers import persistent

Answer = TypeVar("Answer")

_answers: dict[Hashable, Any] = {}

_EVENTS = ("depsgraph_update_post", "frame_change_post", "undo_post", "redo_post", "load_post")
"""Handlers that are called after anything changed, the settings too."""


def cached(what: Hashable, context: bpy.types.Context, compute: Callable[[], Answer]) -> Answer:
    """What `compute` returns of the active object and the settings, until anything changes.

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
    obj, settings = context.object, context.scene.refine
    names = set(settings.bl_rna.properties.keys()) - {"rna_type", "name"}
    values = repr([getattr(settings, name) for name in sorted(names)])
    key = (what, context.scene.session_uid, obj and obj.session_uid, values)
    if key not in _answers:
        _answers[key] = compute()
    return _answers[key]


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
