"""Toolbar tools that select the splats one sees: brush, lasso, box, sphere, colour."""

from __future__ import annotations

from typing import Any

import bpy
import gpu
from bpy.props import EnumProperty
from bpy.types import Context
from gpu_extras.batch import batch_for_shader

from ..core.picking import Mode
from ..mesh import selection
from . import selecting
from .operator_bases import FAILURES, Answer, Needing, fail, idle, on_splats
from .panel_cache import cached
from .selecting import Stroke, circle

SHAPES = (
    ("BRUSH", "Brush", "Take the splats that a round brush covers"),
    ("LASSO", "Lasso", "Take the splats inside a line around them"),
    ("BOX", "Box", "Take the splats inside a rectangle"),
    ("SPHERE", "Sphere", "Take the splats around the place where the mouse was pressed"),
    ("COLOR", "Colour", "Take the splats of the colour under the mouse"),
)

MODES = (
    ("SET", "Set", "Select these splats and no others", "SELECT_SET", 0),
    ("ADD", "Add", "Select these splats as well (Shift)", "SELECT_EXTEND", 1),
    ("SUBTRACT", "Subtract", "Select these splats no more (Ctrl)", "SELECT_SUBTRACT", 2),
    ("INTERSECT", "Intersect", "Select what both hold (Shift Ctrl)", "SELECT_INTERSECT", 3),
)

_KEYS: dict[Mode, dict[str, bool]] = {
    "SET": {},
    "ADD": {"shift": True},
    "SUBTRACT": {"ctrl": True},
    "INTERSECT": {"shift": True, "ctrl": True},
}

_STEP = 0.03  # Seconds between two looks at the thread that sees the view


def _in_view(context: Context) -> str:
    return "" if context.region_data else "Select over a 3D view"


class REFINE_OT_select_stroke(Needing, bpy.types.Operator):
    """Select splats by what the view shows; those that others hide only if the tool is told so"""

    bl_idname = "refine.select_stroke"
    bl_label = "Select Splats"
    bl_options = {"UNDO"}
    needs = (idle, on_splats, _in_view)

    shape: EnumProperty(name="Shape", description="What takes splats", items=SHAPES)
    mode: EnumProperty(name="Mode", description="What becomes of those taken", items=MODES)

    _stroke: Stroke | None = None

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
        """Follow the mouse until the button is released and the view's splats are known."""
        stroke = self._stroke
        if stroke is None or event.type in {"ESC", "RIGHTMOUSE"}:
            return self._over(context, kept=False)
        if event.type == "MOUSEMOVE" and not stroke.released:
            stroke.path.append(_place(context, event))
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            stroke.released = True
        elif event.type != "TIMER" or (stroke.selected is not None and not stroke.released):
            return {"RUNNING_MODAL"}
        try:
            known = stroke.follow()
            context.area.tag_redraw()
            if known:
                context.area.header_text_set(stroke.sentence())
            if known and stroke.released:
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
        stroke, self._stroke = self._stroke, None
        if stroke is None:
            return {"CANCELLED"}
        context.window_manager.event_timer_remove(self._timer)
        bpy.types.SpaceView3D.draw_handler_remove(self._drawn, "WINDOW")
        stroke.end(kept=kept)
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
    program = gpu.shader.from_builtin("UNIFORM_COLOR")
    for shift, shade in ((1.0, 0.0), (0.0, 1.0)) if places else ():
        beside = [(x + shift, y - shift) for x, y in places]
        program.uniform_float("color", (shade, shade, shade, 1.0))
        batch_for_shader(program, "LINE_STRIP", {"pos": beside}).draw(program)


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
    _key("refine.delete", "DEL", ("what", "SELECTED")),
)
"""Keys in object mode, besides the mouse's. Edit mode has its own."""

_ICONS = {
    "BRUSH": "ops.generic.select_circle",
    "LASSO": "ops.generic.select_lasso",
    "BOX": "ops.generic.select_box",
    "SPHERE": "ops.mesh.primitive_sphere_add_gizmo",
    "COLOR": "ops.sculpt.mask_by_color",
}


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
    return cached("selected", context, lambda: selection.count(context.object))


def _draw_brush(context: Context, _tool: bpy.types.WorkSpaceTool, place: tuple[int, int]) -> None:
    _line(circle(place, context.scene.refine.select_radius))


def _tool(shape: str, mode: str) -> type[bpy.types.WorkSpaceTool]:
    label, text = next((label, text) for name, label, text in SHAPES if name == shape)
    keys = tuple(
        _key("refine.select_stroke", "LEFTMOUSE", ("shape", shape), ("mode", mode), **held)
        for mode, held in _KEYS.items()
    )
    keys += _BRUSH_KEYS if shape == "BRUSH" else ()
    keys += _OBJECT_KEYS if mode == "OBJECT" else ()
    body: dict[str, Any] = {
        "bl_space_type": "VIEW_3D",
        "bl_context_mode": mode,
        "bl_idname": f"refine.select_{shape.lower()}",
        "bl_label": f"Select Splats: {label}",
        "bl_description": f"{text}.\nShift adds, Ctrl subtracts, both intersect",
        "bl_icon": _ICONS[shape],
        "bl_cursor": "EYEDROPPER" if shape == "COLOR" else "CROSSHAIR",
        "bl_keymap": keys,
        "draw_settings": staticmethod(_draw_settings),
    }
    if shape == "BRUSH":
        body["draw_cursor"] = staticmethod(_draw_brush)
    return type(f"REFINE_TOOL_{shape.lower()}_{mode.lower()}", (bpy.types.WorkSpaceTool,), body)


_tools: list[type[bpy.types.WorkSpaceTool]] = []


def register() -> None:
    """Add the tools to the toolbars of object mode and mesh edit mode."""
    for mode in ("OBJECT", "EDIT_MESH"):
        for number, (shape, *_) in enumerate(SHAPES):
            tool = _tool(shape, mode)
            bpy.utils.register_tool(tool, separator=number == 0)
            _tools.append(tool)


def unregister() -> None:
    """Remove the tools."""
    while _tools:
        bpy.utils.unregister_tool(_tools.pop())
    selecting.forget()


CLASSES = (REFINE_OT_select_stroke,)
