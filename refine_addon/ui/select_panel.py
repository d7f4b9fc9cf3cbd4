"""The box *Select* of the panel, its settings, and its histogram."""

from __future__ import annotations

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, FloatProperty
from numpy.typing import NDArray

from ..core.errors import RefineError
from ..mesh import layout as mesh_layout
from . import price, wrapped
from .chart import BINS, Chart, Histogram
from .panel_cache import cached_soon
from .select_operators import ACTIONS, QUANTITIES, SETS, Quantity, in_range, quantity
from .select_tools import MODES, SHAPES, selected_count

_ICON = "selection"
"""Name of the histogram among the previews of `price`."""

_ICONS = (
    *("CHECKBOX_HLT", "CHECKBOX_DEHLT", "SELECT_DIFFERENCE"),
    *("HIDE_ON", "PIVOT_CURSOR", "HIDE_OFF"),
)
"""Of `ACTIONS`."""


class SelectSettings:
    """What the tools and the box *Select* go by; part of `RefineSettings`."""

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
    select_by: EnumProperty(
        name="By", description="What the histogram shows", items=QUANTITIES, default="OPACITY"
    )
    select_low: FloatProperty(
        name="From", description="Where the range begins", subtype="FACTOR", min=0.0, max=1.0
    )
    select_high: FloatProperty(
        name="To", description="Where the range ends", subtype="FACTOR", default=0.1,
        min=0.0, max=1.0,
    )  # fmt: skip


class REFINE_PT_select(bpy.types.Panel):
    """What is selected, how, and what for."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "REFINE"
    bl_label = "Select"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether there are splats to select."""
        return mesh_layout.looks_like_splats(context.object)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the count, the tools, what else takes splats, and what is done with them."""
        layout, settings, obj = self.layout, context.scene.refine, context.object
        total = mesh_layout.splat_count(obj.data)
        text = f"{selected_count(context):,} of {total:,} selected"
        layout.label(text=text, icon="RESTRICT_SELECT_OFF")
        grid = layout.grid_flow(columns=3, even_columns=True, align=True)
        for shape, text, _ in SHAPES:
            grid.operator("wm.tool_set_by_id", text=text).name = f"refine.select_{shape.lower()}"
        layout.prop(settings, "select_hidden")
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
        column = layout.column(align=True)
        for what, text, _ in SETS[:-1]:
            button = column.operator("refine.select_by", text=text)
            button.what, button.mode = what, settings.select_mode
        _draw_range(layout, context)
        _draw_uses(layout)


def _draw_range(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the histogram and the range on it."""
    header, body = layout.panel("REFINE_range", default_closed=True)
    header.label(text="Histogram")
    if not body:
        return
    settings = context.scene.refine
    body.row(align=True).prop(settings, "select_by", expand=True)
    shown = cached_soon("histogram", context, _shown)
    if shown is None:  # drawn again when it is known
        return
    if isinstance(shown, str):
        wrapped.label(body, context, shown, icon="INFO")
        return
    row = body.row()
    row.alignment = "CENTER"
    row.template_icon(icon_value=price.icon(_ICON), scale=price.WIDTH)
    column = body.column(align=True)
    column.prop(settings, "select_low")
    column.prop(settings, "select_high")
    low, high, count = shown
    body.label(text=f"{low:.3g} to {high:.3g}: {count:,}")
    button = body.operator("refine.select_by", text="Select Range")
    button.what, button.mode, button.quantity = "RANGE", settings.select_mode, settings.select_by
    button.low, button.high = settings.select_low, settings.select_high


def _shown(
    obj: bpy.types.Object, settings: bpy.types.PropertyGroup
) -> tuple[float, float, int] | str:
    """Make the histogram; return the range's values and its splats, or why there is none."""
    try:
        found = quantity(mesh_layout.check(obj), settings.select_by)
    except RefineError as error:
        return str(error)
    places = found.axis.places(found.values)
    taken = in_range(places, settings.select_low, settings.select_high)
    look = price.look_of(bpy.context.preferences)
    name = next(text for name, text, _ in QUANTITIES if name == settings.select_by)
    histogram = _histogram(found, places, name.lower())
    price.upload(Chart(look, None, histogram).picture(None, histogram.going(~taken)), _ICON)
    ends = sorted((settings.select_low, settings.select_high))
    low, high = (found.axis.value(end) for end in ends)
    return low, high, int(np.count_nonzero(taken))


def _histogram(found: Quantity, places: NDArray[np.float64], name: str) -> Histogram:
    bins = (places * BINS).clip(0, BINS - 1).astype(np.uint8)
    ticks = tuple((place, f"{found.axis.value(place):.2g}") for place in (0.0, 0.5, 1.0))
    total = np.bincount(bins, minlength=BINS)
    return Histogram(bins, total, ticks, name, ("in range", "others"))


def _draw_uses(layout: bpy.types.UILayout) -> None:
    """Draw what is done with what is selected."""
    column = layout.column(align=True)
    for mark, text, icon in (("STAY", "Stays", "LOCKED"), ("GO", "Must Go", "TRASH")):
        row = column.row(align=True)
        for mode, name, sign in (
            ("ADD", text, icon),
            ("SUBTRACT", "", "REMOVE"),
            ("CLEAR", "", "X"),
        ):
            button = row.operator("refine.protect", text=name, icon=sign)
            button.mode, button.mark = mode, mark
    column.operator("refine.separate_selected", text="Separate", icon="MOD_EXPLODE")
    column.operator("refine.delete_selected", text="Delete", icon="X")
