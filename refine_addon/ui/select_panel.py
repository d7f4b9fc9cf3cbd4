"""The box *Select* of the panel, and its settings."""

from __future__ import annotations

import bpy
from bpy.props import BoolProperty, EnumProperty, FloatProperty

from ..mesh import layout as mesh_layout
from . import wrapped
from .select_operators import ACTIONS
from .select_tools import MODES, SHAPES, selected_count

_ICONS = (
    *("CHECKBOX_HLT", "CHECKBOX_DEHLT", "SELECT_DIFFERENCE"),
    *("HIDE_ON", "PIVOT_CURSOR", "HIDE_OFF"),
)


class SelectSettings:
    """Settings of the tools and the box *Select*; part of `RefineSettings`."""

    select_radius: FloatProperty(
        name="Radius",
        description="Of the brush, in pixels",
        subtype="PIXEL",
        default=40.0,
        min=1.0,
        max=1000.0,
    )
    select_hidden: BoolProperty(
        name="Through", description="Take splats that others hide, too: those behind surfaces"
    )
    select_tolerance: FloatProperty(
        name="Tolerance",
        description="How much red, green or blue may differ from the colour under the mouse",
        subtype="FACTOR",
        default=0.1,
        min=0.0,
        max=1.0,
    )
    select_connected: BoolProperty(
        name="Connected", description="Take the colour only where it hangs together with the mouse"
    )
    select_mode: EnumProperty(
        name="Mode", description="What becomes of the splats that a button takes", items=MODES
    )
    select_opacity: FloatProperty(
        name="Opacity", description="Less opaque splats are taken", default=0.1, min=0.0, max=1.0
    )
    select_size: FloatProperty(
        name="Size",
        description="Splats with a longer standard deviation are taken, units of the object",
        default=0.1,
        min=1e-6,
        precision=3,
    )


class REFINE_PT_select(bpy.types.Panel):
    """The selection, its tools and its uses."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "REFINE"
    bl_label = "Select"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there are splats to select."""
        return mesh_layout.looks_like_splats(context.object)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the count, the tools, other ways to select, and the uses."""
        layout, settings, obj = self.layout, context.scene.refine, context.object
        total = mesh_layout.splat_count(obj.data)
        text = f"{selected_count(context):,} of {total:,} selected"
        layout.label(text=text, icon="RESTRICT_SELECT_OFF")
        grid = layout.grid_flow(columns=3, even_columns=True, align=True)
        for shape, text, _ in SHAPES:
            grid.operator("wm.tool_set_by_id", text=text).name = f"refine.select_{shape.lower()}"
        row = layout.row()
        row.prop(settings, "select_hidden")
        row.prop(settings, "select_connected")
        if obj.mode == "EDIT":
            wrapped.label(layout, context, "More in object mode", icon="INFO")
            return
        grid = layout.grid_flow(columns=3, even_columns=True, align=True)
        for (action, text, _), icon in zip(ACTIONS, _ICONS, strict=True):
            grid.operator("refine.select", text=text, icon=icon).action = action
        row = layout.row(align=True)
        row.operator("refine.grow_selection", text="Grow", icon="ADD").shrink = False
        row.operator("refine.grow_selection", text="Shrink", icon="REMOVE").shrink = True
        layout.row(align=True).prop(settings, "select_mode", expand=True, icon_only=True)
        menu = layout.operator_menu_enum("refine.select_by", "what", text="Select By")
        menu.mode = settings.select_mode
        row = layout.row(align=True)
        row.prop(settings, "select_opacity")
        row.prop(settings, "select_size")
        _draw_uses(layout)


def _draw_uses(layout: bpy.types.UILayout) -> None:
    row = layout.row(align=True)
    for mark, text, icon in (("STAY", "Stay", "LOCKED"), ("GO", "Go", "TRASH"), ("NONE", "", "X")):
        row.operator("refine.protect", text=text, icon=icon).mark = mark
    column = layout.column(align=True)
    column.operator("refine.separate_selected", text="Separate", icon="MOD_EXPLODE")
    column.operator("refine.delete", text="Delete", icon="X").what = "SELECTED"
