"""Operators that show splats: drawn in the 3D views, or by modifiers."""

# ruff: noqa: D400, N801, RUF012, TC002 - Blender's names and tooltips; annotations are run
from __future__ import annotations

from typing import Any

import bpy
from bpy.props import BoolProperty, EnumProperty

from ..viewport import draw
from . import preview
from .operator_bases import Answer, AtOnce, Needing, on_splats, out_of_edit_mode

MODES = (
    ("OFF", "Off", "Show the plain points of the mesh again"),
    ("SCENE", "Scene", "Show the splats as they are"),
    ("HEAT", "Heat", "Colour each splat by its rank: dark goes first, yellow goes last"),
    ("STAYS", "What Stays", "Show what Apply would leave"),
    ("GOES", "What Goes", "Show what Apply would remove, in orange"),
)


class REFINE_OT_view(bpy.types.Operator):
    """Draw the splats in the 3D views; nothing in the scene is changed"""

    bl_idname = "refine.view"
    bl_label = "Show Splats"
    bl_options = {"INTERNAL"}

    mode: EnumProperty(name="Show", description="What is drawn", items=MODES)

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Tell whether there is a window to draw in."""
        return not bpy.app.background

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: Any) -> str:  # noqa: ANN401
        """Return the tooltip of a button."""
        return next(text for mode, _, text in MODES if mode == properties.mode)

    def execute(self, _context: bpy.types.Context) -> Answer:
        """Draw, or stop it."""
        draw.show(self.mode)
        return {"FINISHED"}


class REFINE_OT_preview(AtOnce, Needing, bpy.types.Operator):
    """Show the splats as points, or in renders as they are, without changing them"""

    bl_idname = "refine.preview"
    bl_label = "Preview"
    bl_options = {"REGISTER", "UNDO"}
    needs = (on_splats, out_of_edit_mode)

    mode: EnumProperty(
        name="Show",
        description="What the points show",
        items=(
            ("HEAT", "Heat Map", "Rank of each splat: dark goes first, yellow last"),
            ("COLOR", "Colour", "The splat's own colour"),
            ("OFF", "Off", "Show the plain mesh again"),
        ),
    )
    hide_removed: BoolProperty(
        name="Hide What Goes", description="Hide the splats that the budget removes"
    )
    style: EnumProperty(
        name="Style",
        description="What is made of each splat",
        items=(
            ("POINTS", "Points", "A sphere, for the viewport"),
            ("SPLATS", "For Renders", "The Gaussian itself, for pictures that Cycles renders"),
        ),
        options={"SKIP_SAVE"},
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: Any) -> str:  # noqa: ANN401
        """Return the tooltip of a button."""
        if properties.style == "SPLATS" and properties.mode != "OFF":
            return (
                "Let renders show the splats as they are; sets the scene to Cycles, without light "
                "and with the view transform Standard"
            )
        if properties.mode == "OFF":
            return "Show the plain mesh again"
        if properties.hide_removed:
            return "Hide the splats that would be removed; nothing is deleted"
        return {
            "HEAT": "Colour each splat by its rank: dark goes first, yellow goes last",
            "COLOR": "Show each splat in its own colour",
        }[properties.mode]

    def act(self, context: bpy.types.Context) -> Answer:
        """Add, change or remove the preview."""
        obj, shows = context.object, self.mode != "OFF"
        if shows:
            preview.show(obj, self.mode, hide_removed=self.hide_removed, style=self.style)
        else:
            preview.hide(obj)
        if shows and self.style == "SPLATS":
            preview.set_up_render(context.scene)
            return {"FINISHED"}  # too slow for the viewport, which draws them by itself
        draw.stop()
        shading = getattr(context.space_data, "shading", None)
        # Solid mode draws every point in one grey.
        if shows and shading and shading.type in {"SOLID", "WIREFRAME"}:
            shading.type = "MATERIAL"
        overlay = getattr(context.space_data, "overlay", None)
        if overlay:  # outlines of a million selected points hide their colours
            overlay.show_outline_selected = not shows
        return {"FINISHED"}
