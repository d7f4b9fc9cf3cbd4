"""The operator that draws splats in the 3D views."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty

from ..viewport import draw
from .operator_bases import Answer, tooltips

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
    description = tooltips("mode", MODES)

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Whether there is a window to draw in."""
        return not bpy.app.background

    def execute(self, _context: bpy.types.Context) -> Answer:
        """Draw, or stop."""
        draw.show(self.mode)
        return {"FINISHED"}


CLASSES = (REFINE_OT_view,)
