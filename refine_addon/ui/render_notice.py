"""F12 does not show splats: the status bar says which button does."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import bpy
from bpy.app.handlers import persistent

from ..render import copies
from ..render.meshes import drawn_by_us, restore

NOTICE = "Splats are not in this render: use Render > Render with Splats"
"""What is said."""

IN_BACKGROUND = "refine: splats are not in this render; use --command refine render"
"""What is said where there is no window."""

_LINGERS = 10.0
"""Seconds that it stays when the render is over."""

_until: list[float] = []


def register() -> None:
    """Say it from now on."""
    bpy.app.handlers.render_init.append(_began)
    for listening in _listened():
        listening.append(_returned)


def unregister() -> None:
    """Undo `register`."""
    for listening in _listened():
        listening.remove(_returned)
    bpy.app.handlers.render_init.remove(_began)


def _listened() -> tuple[list[Callable[..., None]], ...]:
    handlers = bpy.app.handlers
    return handlers.undo_post, handlers.redo_post, handlers.load_post


@persistent
def _began(scene: bpy.types.Scene, *_: object) -> None:
    """Look whether a render leaves splats out; called on the thread that renders."""
    if copies.MARK in scene:
        return
    shown = (layer.objects for layer in scene.view_layers if layer.use)
    if not any(drawn_by_us(obj) and not obj.hide_render for group in shown for obj in group):
        return
    if bpy.app.background:
        sys.stderr.write(f"{IN_BACKGROUND}\n")
    elif not _until:
        _until.append(time.monotonic() + _LINGERS)
        bpy.app.timers.register(_say, first_interval=0.0)


def _say() -> float | None:
    """Say it until the render has been over for a while."""
    if bpy.app.is_job_running("RENDER"):
        _until[0] = time.monotonic() + _LINGERS
    over = time.monotonic() > _until[0]
    for workspace in bpy.data.workspaces:
        workspace.status_text_set(None if over else NOTICE)
    if over:
        _until.clear()
    return None if over else 0.5


@persistent
def _returned(*_: object) -> None:
    """Remove what a step back, or a file, has brought of a render that is over."""
    if not bpy.app.is_job_running("RENDER"):
        copies.remove_all()
        restore()
