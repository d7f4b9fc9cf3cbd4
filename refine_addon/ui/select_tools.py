"""Toolbar tools that select the splats in view: brush, lasso, box, sphere, colour.
As a stroke begins, a thread computes which splats the view shows; until then the mouse is only
recorded. The result is kept for further strokes in the same view."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import bpy
import numpy as np
from bpy.props import EnumProperty
from bpy.types import Context
from numpy.typing import NDArray

from ..cameras import world_matrix
from ..core import Splats, picking
from ..core.affine import transformed
from ..core.execute import Progress
from ..core.picking import Mode, Prepared, Sight, Surface
from ..core.views import pinhole
from ..mesh import attributes, edit, selection
from ..mesh.layout import SplatObject
from ..viewport import draw as viewport_draw
from ..viewport import overlays
from ..viewport.view import Camera
from .operator_bases import FAILURES, Answer, Needing, Worker, fail, idle, on_splats
from .plans import cached

_TOOLS = (
    ("BRUSH", "Brush", "that a round brush covers", "generic.select_circle"),
    ("LASSO", "Lasso", "inside a line around them", "generic.select_lasso"),
    ("BOX", "Box", "inside a rectangle", "generic.select_box"),
    ("SPHERE", "Sphere", "around the place where you press", "mesh.primitive_sphere_add_gizmo"),
    ("COLOR", "Colour", "of the colour under the mouse", "sculpt.mask_by_color"),
)
"""Shapes of strokes: name, label, the splats they select, Blender's icon."""

SHAPES = tuple((name, label, f"Select the splats {which}") for name, label, which, _ in _TOOLS)

MODES = (
    ("SET", "Set", "Select these splats and no others", "SELECT_SET", 0),
    ("ADD", "Add", "Select these splats as well (Shift)", "SELECT_EXTEND", 1),
    ("SUBTRACT", "Subtract", "Deselect these splats (Ctrl)", "SELECT_SUBTRACT", 2),
    ("INTERSECT", "Intersect", "Deselect all but these splats (Shift Ctrl)", "SELECT_INTERSECT", 3),
)

_STEP = 0.03  # Seconds between two looks at the thread that computes what the view shows
LEAST_SIDE = 2  # Pixels: a narrower box or lasso was a click, which selects nothing
_kept: dict[object, Prepared | Sight] = {}  # The last stroke's splats, and what each view shows


class Stroke:
    """A tool's stroke over a view, from the press of the button to its release.
    `shape`, `mode`: see `SHAPES`, `Mode`; `path`: columns and rows from the
    region's upper left, pixels; `before`, `selected`: (N,), the latter None until computed."""

    def __init__(self, context: Context, shape: str, mode: Mode, at: tuple[float, float]) -> None:
        settings, region = context.scene.refine, context.region
        self.obj, self.shape, self.mode, self.path = context.object, shape, mode, [at]
        self._hidden, self._tolerance = settings.select_hidden, settings.select_tolerance
        self._connected, self._brush = settings.select_connected, settings.select_radius
        self._painted = 0
        self._area = np.zeros((region.height, region.width), np.bool_)
        self.released, self.selected = False, None
        self._surface: Surface | None = None
        self._worker = Worker(self._read(context))

    def _read(self, context: Context) -> Callable[[Progress], dict[object, Prepared | Sight]]:
        """Read selection and view; a thread-safe callable gives what `_kept` is to hold."""
        obj, camera = self.obj, Camera.of(context)
        matrix = world_matrix(obj)
        with selection.readable(obj) as checked:
            self.before = selection.selected(checked.obj)
            away, mode = selection.hidden(checked.obj), viewport_draw.mode()  # what views show not
            if mode in {"STAYS", "GOES"} and edit.REMOVE in checked.mesh.attributes:
                going = attributes.read_attribute(checked.mesh, edit.REMOVE) > 0
                away |= going if mode == "STAYS" else ~going
            digest = attributes.digest(checked)
            splats = (obj.data.session_uid, digest, matrix.tobytes(), away.tobytes())
            view = (splats, camera.key())
            source = _kept.get(view) or _kept.get(splats) or _drawn(checked, away)

        def look(_progress: Progress) -> dict[object, Prepared | Sight]:
            seen = source
            if isinstance(seen, Splats):
                world = transformed(seen, matrix, rotate_sh=False)
                seen = picking.prepare(world, pinhole(*camera, world.means))
            if isinstance(seen, Prepared):
                seen = picking.look(seen, pinhole(*camera, seen.splats.means))
            return {splats: seen.prepared, view: seen}

        return look

    def follow(self) -> bool:
        """Select what the stroke covers so far; False if the view is not computed yet."""
        if self._worker.running():
            return False
        _kept.clear()
        _kept.update(self._worker.result())
        if self.selected is None or self.shape != "COLOR":
            *_, sight = _kept.values()
            self.selected = picking.combined(self.before, self._taken(sight), self.mode)
        viewport_draw.select(self.obj.data.session_uid, self.selected)
        return True

    def outline(self) -> list[tuple[float, float]]:
        """Closed outline over the view; columns and rows."""
        (x, y), (u, v) = self.path[0], self.path[-1]
        if self.shape == "SPHERE":
            return _circle((x, y), math.hypot(u - x, v - y))
        if self.shape == "BRUSH":
            return _circle((u, v), self._brush)
        if self.shape == "LASSO":
            return [*self.path, (x, y)]
        return [(x, y), (u, y), (u, v), (x, v), (x, y)] if self.shape == "BOX" else []

    def end(self, *, kept: bool) -> None:
        """Select what the stroke covers, or restore the former selection."""
        if not kept or self.selected is None:
            self._worker.cancel()
            viewport_draw.select(self.obj.data.session_uid, self.before)
            return
        selection.select(self.obj, self.selected)
        if viewport_draw.mode() == "OFF" and self.obj.mode != "EDIT":
            viewport_draw.show("SCENE")  # or nobody would see it

    def _taken(self, seen: Sight) -> NDArray[np.bool_]:
        (x, y), (u, v) = self.path[0], self.path[-1]
        if self.shape == "BRUSH":
            for index in range(self._painted, len(self.path)):
                ends = self.path[max(index - 1, 0)], self.path[index]
                picking.paint(self._area, *ends, self._brush)
            self._painted = len(self.path)
            return seen.in_area(self._area, hidden=self._hidden)
        if self.shape in {"LASSO", "BOX"}:
            corners = self.outline()[:-1]
            if np.ptp(corners, axis=0).max() < LEAST_SIDE:
                return np.zeros(len(self.before), np.bool_)
            area = picking.polygon(corners, *self._area.shape[::-1])
            return seen.in_area(area, hidden=self._hidden)
        surface = self._surface = self._surface or seen.surface(int(x), int(y))
        if surface is None:
            return np.zeros(len(self.before), np.bool_)
        if self.shape == "COLOR":
            taken = seen.of_color(surface.color, self._tolerance, hidden=self._hidden)
            return seen.piece(taken, surface.place) if self._connected else taken
        radius = math.hypot(u - x, v - y) / surface.scale
        return seen.in_ball(surface.place, radius, hidden=self._hidden)


def _drawn(checked: SplatObject, away: NDArray[np.bool_]) -> Splats:
    """An object's splats; those in `away`, (N,), get no opacity."""
    splats = attributes.splats_from_object(checked, sh_rest=False)
    logits = np.where(away, np.float32(-np.inf), splats.opacity_logits)
    return replace(splats, opacity_logits=logits)


def _circle(middle: tuple[float, float], radius: float) -> list[tuple[float, float]]:
    """Points of a circle, closed."""
    return (overlays.CIRCLE * radius + middle).tolist()


def _in_view(context: Context) -> str:
    return "" if context.region_data else "Select over a 3D view"


class REFINE_OT_select_stroke(Needing, bpy.types.Operator):
    """Select the splats that the view shows, with Through also those behind them"""

    bl_label = "Select Splats"
    bl_options = {"UNDO"}
    needs = (idle, on_splats, _in_view)

    shape: EnumProperty(name="Shape", description="Shape of the stroke", items=SHAPES)
    mode: EnumProperty(name="Mode", description="How they combine with the selection", items=MODES)

    def invoke(self, context: Context, event: bpy.types.Event) -> Answer:
        """Begin a stroke."""
        try:
            self._stroke = Stroke(context, self.shape, self.mode, _place(context, event))
        except FAILURES as error:
            return fail(self, error)
        manager, arguments = context.window_manager, (self._stroke, context.region.as_pointer())
        self._timer = manager.event_timer_add(_STEP, window=context.window)
        self._drawn = bpy.types.SpaceView3D.draw_handler_add(
            _draw, arguments, "WINDOW", "POST_PIXEL"
        )
        manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context: Context, event: bpy.types.Event) -> Answer:
        """Follow the mouse until the button is released and the view is computed."""
        stroke = self._stroke
        if event.type in {"ESC", "RIGHTMOUSE"}:
            return self._over(context, kept=False)
        if event.type == "MOUSEMOVE" and not stroke.released:
            stroke.path.append(_place(context, event))
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            stroke.released = True
        elif event.type != "TIMER" or (stroke.selected is not None and not stroke.released):
            return {"RUNNING_MODAL"}
        try:
            context.area.tag_redraw()
            if stroke.follow():
                count, total = np.count_nonzero(stroke.selected), len(stroke.selected)
                context.area.header_text_set(f"{count:,} of {total:,} splats selected")
                if stroke.released:
                    return self._over(context, kept=True)
        except FAILURES as error:
            self._over(context, kept=False)
            return fail(self, error)
        return {"RUNNING_MODAL"}

    def cancel(self, context: Context) -> None:
        """End when Blender ends the operator, closing its window or file."""
        self._over(context, kept=False)

    def _over(self, context: Context, *, kept: bool) -> Answer:
        if context.area is not None:
            context.area.header_text_set(None)
            context.area.tag_redraw()
        context.window_manager.event_timer_remove(self._timer)
        bpy.types.SpaceView3D.draw_handler_remove(self._drawn, "WINDOW")
        self._stroke.end(kept=kept)
        return {"FINISHED"} if kept else {"CANCELLED"}


def _place(context: Context, event: bpy.types.Event) -> tuple[float, float]:
    below = context.region.height - 1 - event.mouse_region_y
    return event.mouse_region_x + 0.5, below + 0.5


def _draw(stroke: Stroke, region: int) -> None:
    if bpy.context.region.as_pointer() == region:
        height = bpy.context.region.height
        _line([(x, height - y) for x, y in stroke.outline()])


def _line(places: list[tuple[float, float]]) -> None:
    """Draw a line, black beside white, visible on both."""
    for shift, shade in ((1.0, 0.0), (0.0, 1.0)) if places else ():
        colors = [(shade, shade, shade, 1.0)] * len(places)
        overlays.shape("LINE_STRIP", np.add(places, (shift, -shift)), colors)()


def _key(name: str, kind: str, *values: tuple[str, Any], **held: bool) -> tuple[Any, ...]:
    return (name, {"type": kind, "value": "PRESS", **held}, {"properties": [*values]})


_RADIUS = ("data_path", "scene.refine.select_radius")
_BRUSH_KEYS = (
    _key("wm.context_scale_float", "LEFT_BRACKET", _RADIUS, ("value", 1 / 1.2)),
    _key("wm.context_scale_float", "RIGHT_BRACKET", _RADIUS, ("value", 1.2)),
)

_OBJECT_KEYS = (
    _key("refine.select", "A", ("action", "ALL")),
    _key("refine.select", "A", ("action", "NONE"), alt=True),
    _key("refine.select", "I", ("action", "INVERT"), ctrl=True),
    _key("refine.select", "H", ("action", "HIDE")),
    _key("refine.select", "H", ("action", "ISOLATE"), shift=True),
    _key("refine.select", "H", ("action", "REVEAL"), alt=True),
    _key("refine.grow_selection", "NUMPAD_PLUS", ("shrink", False), ctrl=True),
    _key("refine.grow_selection", "NUMPAD_MINUS", ("shrink", True), ctrl=True),
    *(_key("refine.delete", key, ("what", "SELECTED")) for key in ("X", "DEL")),
)
"""Keys of the tools in object mode, besides the mouse; edit mode has Blender's own."""


def _draw_settings(
    context: Context, layout: bpy.types.UILayout, tool: bpy.types.WorkSpaceTool
) -> None:
    settings = context.scene.refine
    if tool.idname.endswith("brush"):
        layout.prop(settings, "select_radius")
    if tool.idname.endswith("color"):
        layout.prop(settings, "select_tolerance")
        layout.prop(settings, "select_connected")
    layout.prop(settings, "select_hidden")
    if not on_splats(context):
        layout.label(text=f"{selected_count(context):,} selected")


def selected_count(context: Context) -> int:
    """Number of selected splats of the active object."""
    return cached("selected", lambda: selection.count(context.object))


def _draw_brush(context: Context, _tool: bpy.types.WorkSpaceTool, place: tuple[int, int]) -> None:
    _line(_circle(place, context.scene.refine.select_radius))


def _tool(shape: str, label: str, which: str, icon: str, mode: str) -> type:
    press = "refine.select_stroke", "LEFTMOUSE", ("shape", shape)
    keys: tuple[Any, ...] = (
        _key(*press, ("mode", "SET")),
        _key(*press, ("mode", "ADD"), shift=True),
        _key(*press, ("mode", "SUBTRACT"), ctrl=True),
        _key(*press, ("mode", "INTERSECT"), shift=True, ctrl=True),
    )
    keys += _BRUSH_KEYS if shape == "BRUSH" else ()
    keys += _OBJECT_KEYS if mode == "OBJECT" else ()
    body: dict[str, Any] = {
        "bl_space_type": "VIEW_3D",
        "bl_context_mode": mode,
        "bl_idname": f"refine.select_{shape.lower()}",
        "bl_label": f"Select Splats: {label}",
        "bl_description": f"Select the splats {which}.\nShift adds, Ctrl subtracts, both intersect",
        "bl_icon": f"ops.{icon}",
        "bl_cursor": "EYEDROPPER" if shape == "COLOR" else "CROSSHAIR",
        "bl_keymap": keys,
        "draw_settings": staticmethod(_draw_settings),
    }
    if shape == "BRUSH":
        body["draw_cursor"] = staticmethod(_draw_brush)
    return type(f"REFINE_TOOL_{shape.lower()}_{mode.lower()}", (bpy.types.WorkSpaceTool,), body)


_TOOLBARS = [(_tool(*row, mode), row) for mode in ("OBJECT", "EDIT_MESH") for row in _TOOLS]
"""Tools of object mode and mesh edit mode, and their rows of `_TOOLS`."""


def register() -> None:
    """Add the tools to the toolbars."""
    for tool, row in _TOOLBARS:
        bpy.utils.register_tool(tool, separator=row is _TOOLS[0])


def unregister() -> None:
    """Remove the tools, and free what the last stroke saw."""
    for tool, _ in reversed(_TOOLBARS):
        bpy.utils.unregister_tool(tool)
    _kept.clear()
