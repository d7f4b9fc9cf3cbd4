"""Values for panels, computed once until the scene changes, not at each draw."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

import bpy
from bpy.app.handlers import persistent

Answer = TypeVar("Answer")

_answers: dict[Hashable, Any] = {}

_EVENTS = ("depsgraph_update_post", "frame_change_post", "undo_post", "redo_post", "load_post")


def cached(what: Hashable, context: bpy.types.Context, compute: Callable[[], Answer]) -> Answer:
    """Value of `compute` (of the scene, active object, settings), kept until anything changes.
    A script's silent changes, such as custom properties, show after the next change."""
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
    """Add the handlers."""
    for event in _EVENTS:
        getattr(bpy.app.handlers, event).append(_forget)


def unregister() -> None:
    """Remove the handlers."""
    for event in _EVENTS:
        getattr(bpy.app.handlers, event).remove(_forget)
    _forget()
