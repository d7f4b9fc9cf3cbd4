"""The drawing of splats, on and off, and what keeps it true to the scene."""

from __future__ import annotations

import contextlib
import time
import traceback
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import bpy
import numpy as np
from bpy.app.handlers import persistent
from numpy.typing import NDArray

from ..core.errors import RefineError
from ..mesh.layout import looks_like_splats, splat_count
from . import background, legend, overlays, placing, points, shader
from .content import Content
from .view import Camera, View

MODES = ("OFF", "SCENE", "HEAT", "STAYS", "GOES")
"""What can be drawn: nothing, all as it is, coloured by rank, what Apply leaves, what it takes."""

SHOWN = "refine_shown"
"""Custom property of the scene: which of `MODES` was shown when the file was saved."""

_TICK = 0.03
"""Seconds between two looks at whether the thread has sorted more splats."""

_EDIT_REST = 0.3
"""Seconds without a change in edit mode after which the splats are drawn as they are by then."""

_VIEWS = 16
"""Regions whose pictures are kept on the graphics card."""


warned_by: list[Callable[[bpy.types.Context], Sequence[str]]] = []
"""Who is asked, whenever a view is drawn, for warnings that are written into it."""


class _State:
    """What is kept while splats are drawn, in memory alone."""

    def __init__(self) -> None:
        self.mode = "OFF"
        self.failure = ""
        self.content = Content()
        self.views: dict[int, View] = {}
        self.handles: list[Any] = []
        self.edited_at = 0.0
        self.reads = False


_state = _State()


def mode() -> str:
    """Return which of `MODES` is shown."""
    return _state.mode


def failure() -> str:
    """Return why nothing can be drawn here, or an empty text."""
    return _state.failure


def complete() -> bool:
    """Tell whether every view shows all it is to show."""
    return all(view.complete for view in _state.views.values()) and not _state.content.pending()


def drawn(region: bpy.types.Region) -> int:
    """Return how many splats a region shows."""
    view = _state.views.get(region.as_pointer())
    return view.count if view else 0


def select(mesh: int, chosen: NDArray[np.bool_]) -> None:
    """Show splats of a mesh, (N,), as selected while a tool selects them; nothing is stored."""
    if _state.mode != "OFF":
        _state.content.select(mesh, chosen)
        _redraw()


def show(wanted: str) -> None:
    """Draw splats in all 3D views, or stop it."""
    if wanted == "OFF":
        stop()
        return
    if _state.mode == "OFF":
        _state.failure = ""
        _hook()
    _state.mode = wanted
    _hide_points()
    _redraw()


def stop() -> None:
    """Draw nothing, and forget all that was held."""
    if _state.mode == "OFF":
        return
    _state.mode = "OFF"
    _unhook()
    background.stop()
    _forget()
    shader.forget()
    points.show()
    _redraw()


def register() -> None:
    """Have files keep what is shown, and show it again."""
    bpy.app.handlers.save_pre.append(_saving)
    bpy.app.handlers.load_post.append(_opened)


def unregister() -> None:
    """Draw nothing, and let files be."""
    stop()
    bpy.app.handlers.load_post.remove(_opened)
    bpy.app.handlers.save_pre.remove(_saving)


def _forget() -> None:
    _state.content, _state.views = Content(), {}


def _listeners() -> tuple[tuple[Callable[..., None], tuple[str, ...]], ...]:
    """Return what is called at which events of Blender."""
    return (
        (_updated, ("depsgraph_update_post", "frame_change_post")),
        (_undone, ("undo_post", "redo_post")),
        (_leaving, ("load_pre",)),
        (_loaded, ("load_post",)),
    )


def _hook() -> None:
    space = bpy.types.SpaceView3D
    _state.handles = [
        space.draw_handler_add(partial(_guarded, _draw), (), "WINDOW", "POST_VIEW"),
        space.draw_handler_add(partial(_guarded, _draw_legend), (), "WINDOW", "POST_PIXEL"),
    ]
    for handler, names in _listeners():
        for name in names:
            getattr(bpy.app.handlers, name).append(handler)


def _unhook() -> None:
    for handle in _state.handles:
        bpy.types.SpaceView3D.draw_handler_remove(handle, "WINDOW")
    _state.handles = []
    for handler, names in _listeners():
        for name in names:
            listening = getattr(bpy.app.handlers, name)
            if handler in listening:
                listening.remove(handler)
    for timer in (_tick, _read_edited):
        if bpy.app.timers.is_registered(timer):
            bpy.app.timers.unregister(timer)


def _guarded(work: Callable[[], None]) -> None:
    """Draw; after the first failure splats are drawn no more, and their points are shown again."""
    if _state.mode == "OFF" or _state.failure:
        return
    try:
        work()
    except Exception as error:
        traceback.print_exc()
        _state.failure = f"Splats cannot be drawn here: {error}"
        # Handlers must not be removed while they run.
        bpy.app.timers.register(stop, first_interval=0.0)


def _draw() -> None:
    context = bpy.context
    region, region_3d, space = context.region, context.region_data, context.space_data
    visible = [obj for obj in context.view_layer.objects if obj.visible_get(viewport=space)]
    refused = len(_state.content.refused)
    placed = _state.content.update(placing.placings(visible), placing.every)
    if len(_state.content.refused) > refused:  # Blender shows these as it did before
        bpy.app.timers.register(_hide_points, first_interval=0.0)
    key = region.as_pointer()
    view = _state.views.pop(key, None) or View()
    _state.views[key] = view  # the one drawn last is last
    while len(_state.views) > _VIEWS:
        del _state.views[next(iter(_state.views))]
    camera = Camera(
        np.array(region_3d.view_matrix, np.float64),
        np.array(region_3d.window_matrix, np.float64),
        (region.width, region.height),
    )
    solid = not overlays.is_xray(space.shading)
    solid = solid and not all(looks_like_splats(obj) for obj in context.visible_objects)
    view.draw(_state.content, placed, camera, _state.mode, solid=solid)
    overlays.draw(context)
    if view.waits() and not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=_TICK)


def _draw_legend() -> None:
    warnings = [text for tell in warned_by for text in tell(bpy.context)]
    legend.draw(bpy.context, _state.mode, _state.content.marks(), warnings)


def _tick() -> float | None:
    """Redraw the views that have more to show, until none has."""
    if _state.mode == "OFF":
        return None
    ready = _state.content.ready()
    for region in _regions():
        view = _state.views.get(region.as_pointer())
        if view is None or ready or view.due():
            region.tag_redraw()
    return None if complete() else _TICK


def _read_edited() -> float | None:
    """Read the objects in edit mode once nothing has changed there for a moment."""
    waits = _EDIT_REST - (time.monotonic() - _state.edited_at)
    if waits > 0.0:
        return waits
    layers = [window.view_layer for window in bpy.context.window_manager.windows]
    _state.reads = True  # which counts as a change of its own
    for obj in {obj for layer in layers for obj in layer.objects}:
        if points.is_edited(obj) and looks_like_splats(obj) and splat_count(obj.data):
            with contextlib.suppress(RefineError):
                _state.content.read_edited(obj)
    for layer in layers:
        layer.update()
    _state.reads = False
    _redraw()
    return None


def _redraw() -> None:
    for region in _regions():
        region.tag_redraw()
    for area in _areas():
        area.tag_redraw()


def _hide_points() -> None:
    if _state.mode != "OFF":
        for depsgraph in points.graphs():
            points.hide(depsgraph, _state.content.refused)


def _areas() -> list[bpy.types.Area]:
    windows = bpy.context.window_manager.windows
    return [a for window in windows for a in window.screen.areas if a.type == "VIEW_3D"]


def _regions() -> list[bpy.types.Region]:
    return [r for area in _areas() for r in area.regions if r.type == "WINDOW"]


@persistent
def _saving(*_: object) -> None:
    """Note in the file what is shown, where that says anything of its splats."""
    if bpy.app.background:
        return
    for scene in bpy.data.scenes:
        if not scene.library and any(looks_like_splats(obj) for obj in scene.objects):
            scene[SHOWN] = _state.mode


@persistent
def _opened(*_: object) -> None:
    """Show what was shown when the file was saved."""
    wanted = bpy.context.scene.get(SHOWN) if not bpy.app.background else None
    if wanted in MODES:
        show(wanted)
        _loaded()


@persistent
def _updated(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    if depsgraph is None:
        return
    for update in depsgraph.updates:
        if update.is_updated_geometry:
            data = getattr(update.id.original, "data", update.id.original)
            if isinstance(data, (bpy.types.Mesh, bpy.types.PointCloud)):
                _state.content.has_changed(data.session_uid)
                if getattr(data, "is_editmode", False) and not _state.reads:
                    _state.edited_at = time.monotonic()
                    if not bpy.app.timers.is_registered(_read_edited):
                        bpy.app.timers.register(_read_edited, first_interval=_EDIT_REST)
    points.hide(depsgraph, _state.content.refused)


@persistent
def _undone(*_: object) -> None:
    _state.content.has_changed()
    _hide_points()


@persistent
def _leaving(*_: object) -> None:
    _forget()


@persistent
def _loaded(*_: object) -> None:
    for window in bpy.context.window_manager.windows:
        window.view_layer.update()  # what is not evaluated yet would be drawn as points once
    _hide_points()
    _redraw()
