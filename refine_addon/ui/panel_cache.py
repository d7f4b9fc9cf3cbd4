"""What panels say of the scene, computed once until the scene changes, not at each draw."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import bpy
from bpy.app.handlers import persistent

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable

Answer = TypeVar("Answer")

_answers: dict[Hashable, Any] = {}

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
    obj, settings = context.object, context.scene.refine
    names = settings.bl_rna.properties.keys()
    values = repr([getattr(settings, name) for name in names if name not in _NOT_SETTINGS])
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
