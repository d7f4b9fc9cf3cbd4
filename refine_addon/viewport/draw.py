"""Drawing of splats in 3D views: switched on and off, and updated when the scene changes."""

from __future__ import annotations

import contextlib
import traceback
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core import RefineError
from ..mesh import drift
from ..mesh.layout import changed_data, looks_like_splats, splat_count
from ..objects.instances import placings
from . import overlays, shader
from .content import Content, hide_points, is_edited
from .view import Camera, View

MODES = (
    ("OFF", "Off", "Show the plain points of the mesh again"),
    ("SCENE", "Scene", "Show the splats as they are"),
    ("HEAT", "Heat", "Colour each splat by its rank: dark goes first, yellow goes last"),
    ("STAYS", "What Stays", "Show what Apply would keep; before scoring, all but What Goes"),
    ("GOES", "What Goes", "Show what Apply would remove; before scoring, what floats or must go"),
    ("ELLIPSES", "Ellipses", "Show each splat as a solid ellipse, one standard deviation large"),
    ("CENTERS", "Centres", "Show the centre of each splat as a dot"),
)
"""What is drawn: name, label, tooltip."""

SHOWN = "refine_shown"  # Custom property of the scene: the mode when the file was saved
_TICK = 0.03  # Seconds between two looks at the sorting thread
_EDIT_REST = 0.3  # Seconds without a change in edit mode before splats are read again
_VIEWS = 16  # Regions whose pictures stay on the graphics card


_state: Any = SimpleNamespace(
    mode="OFF", failure="", content=Content(), views={}, handles=[], reads=False
)
"""State while splats are drawn, not saved; `views`: by region."""


def mode() -> str:
    """Name of the current one of `MODES`."""
    return _state.mode


def failure() -> str:
    """Why splats cannot be drawn, or ""."""
    return _state.failure


def complete() -> bool:
    """Whether every view shows all it should."""
    return all(view.complete for view in _state.views.values()) and not _state.content.pending()


def drawn(region: bpy.types.Region) -> int:
    """Number of splats that a region shows."""
    view = _state.views.get(region.as_pointer())
    return view.count if view else 0


def select(mesh: int, chosen: NDArray[np.bool_]) -> None:
    """Show splats of a mesh, (N,), as selected during a tool's stroke; nothing is stored."""
    _state.content.select(mesh, chosen)
    _redraw()


def untint() -> None:
    """Show selected splats in their own colours until the selection changes."""
    _state.content.untint()


def show(wanted: str) -> None:
    """Draw splats in all 3D views, or stop and free everything."""
    if _state.mode == "OFF":
        if wanted == "OFF":
            return
        _state.failure = ""
    _state.mode = wanted
    if wanted == "OFF":
        for timer in (_tick, _read_edited):
            if bpy.app.timers.is_registered(timer):
                bpy.app.timers.unregister(timer)
        _forget()
        shader.program.cache_clear()
    _hide_points()
    _redraw()


def register() -> None:
    """Add draw callbacks."""
    add = bpy.types.SpaceView3D.draw_handler_add
    for work, kind in ((_draw, "POST_VIEW"), (_draw_legend, "POST_PIXEL")):
        _state.handles.append(add(partial(_guarded, work), (), "WINDOW", kind))


def unregister() -> None:
    """Stop drawing and undo `register`."""
    show("OFF")
    while _state.handles:
        bpy.types.SpaceView3D.draw_handler_remove(_state.handles.pop(), "WINDOW")


def _forget(*_: object) -> None:
    _state.content.pool.shutdown(wait=False, cancel_futures=True)
    _state.content, _state.views = Content(), {}


def _guarded(work: Callable[[], None]) -> None:
    """Draw; after an error stop, and let Blender draw its points again."""
    if _state.mode == "OFF" or _state.failure:
        return
    try:
        work()
    except Exception as error:
        traceback.print_exc()
        _state.failure = f"Splats cannot be drawn here: {error}"
        bpy.app.timers.register(partial(show, "OFF"), first_interval=0.0)


def _draw() -> None:
    context = bpy.context
    space = context.space_data
    visible = {obj for obj in context.view_layer.objects if obj.visible_get(viewport=space)}
    refused = len(_state.content.refused)
    shown = (p for p in placings(context.view_layer.depsgraph) if p.shown_by in visible)
    placed = _state.content.update(shown)
    if len(_state.content.refused) > refused:  # Blender is to draw these
        bpy.app.timers.register(_hide_points, first_interval=0.0)
    key = context.region.as_pointer()
    view = _state.views.pop(key, None) or View()
    _state.views[key] = view  # the one drawn last is last
    while len(_state.views) > _VIEWS:
        del _state.views[next(iter(_state.views))]
    shading = space.shading
    xray = {"SOLID": shading.show_xray, "WIREFRAME": shading.show_xray_wireframe}
    others = not all(looks_like_splats(obj) for obj in context.visible_objects)
    solid = others and not xray.get(shading.type)  # seen through, meshes hide nothing
    view.draw(_state.content, placed, Camera.of(context), _state.mode, solid=solid)
    overlays.draw(context, mixed=view.count > 0, has_depths=view.depths is not None)
    if not view.complete and not bpy.app.timers.is_registered(_tick):
        bpy.app.timers.register(_tick, first_interval=_TICK)


def _draw_legend() -> None:
    warnings = [  # here too, as the panel may be closed
        f"'{obj.name}' was transformed by Blender's own tools: Mend Splats in the tab REFINE"
        for obj in bpy.context.visible_objects
        if looks_like_splats(obj) and (found := drift.of(obj)) and found.mendable
    ]
    overlays.draw_legend(bpy.context, _state.mode, _state.content.marks(), warnings)


def _tick() -> float | None:
    ready = _state.content.ready()
    for region in (region for area in areas(bpy.context) for region in area.regions):
        view = _state.views.get(region.as_pointer())
        if region.type == "WINDOW" and (view is None or ready or view.due()):
            region.tag_redraw()
    return None if complete() else _TICK


def _read_edited() -> None:
    layers = [window.view_layer for window in bpy.context.window_manager.windows]
    _state.reads = True  # reading makes Blender report a change
    for obj in {obj for layer in layers for obj in layer.objects}:
        if is_edited(obj) and looks_like_splats(obj) and splat_count(obj.data):
            with contextlib.suppress(RefineError):
                _state.content.read_edited(obj)
    for layer in layers:
        layer.update()
    _state.reads = False
    _redraw()


def _redraw() -> None:
    for area in areas(bpy.context):
        area.tag_redraw()


def _hide_points() -> None:
    """Hide Blender's points of drawn splats in all windows, or show them again."""
    refused = None if _state.mode == "OFF" else _state.content.refused
    for window in bpy.context.window_manager.windows:
        window.view_layer.update()  # else unevaluated splats are drawn as points once
        hide_points(window.view_layer.depsgraph, refused)


def areas(context: bpy.types.Context, kind: str = "VIEW_3D") -> list[bpy.types.Area]:
    """Areas of a type in all windows."""
    windows = context.window_manager.windows
    return [a for window in windows for a in window.screen.areas if a.type == kind]


def _saving(*_: object) -> None:
    """Store the mode in scenes with splats."""
    if bpy.app.background:
        return
    for scene in bpy.data.scenes:
        if not scene.library and any(looks_like_splats(obj) for obj in scene.objects):
            scene[SHOWN] = _state.mode


def _opened(*_: object) -> None:
    wanted = None if bpy.app.background else bpy.context.scene.get(SHOWN)
    show(wanted if wanted in {name for name, *_ in MODES} else _state.mode)


def _updated(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    if depsgraph is None or _state.mode == "OFF":
        return
    for data in changed_data(depsgraph):
        _state.content.has_changed(data.session_uid)
        if getattr(data, "is_editmode", False) and not _state.reads:
            if bpy.app.timers.is_registered(_read_edited):
                bpy.app.timers.unregister(_read_edited)
            bpy.app.timers.register(_read_edited, first_interval=_EDIT_REST)
    hide_points(depsgraph, _state.content.refused)


def _undone(*_: object) -> None:
    _state.content.has_changed()


HANDLERS: dict[Callable[..., None], tuple[str, ...]] = {
    _updated: ("depsgraph_update_post", "frame_change_post"),
    _undone: ("undo_post", "redo_post"),
    _forget: ("load_pre",),
    _opened: ("load_post",),
    _saving: ("save_pre",),
}
