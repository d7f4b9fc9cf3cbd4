"""The operator that deletes splats at once, without scores."""

from __future__ import annotations

import bpy
from bpy.props import EnumProperty

from ..core.errors import RefineError
from ..mesh import floaters, selection
from ..mesh import layout as mesh_layout
from ..objects import splat_group
from ..objects.demands import Demands
from . import plans
from .operator_bases import Answer, AtOnce, OnSplats, tooltips

WHAT = (
    ("SELECTED", "Selected", "Delete the selected splats, but for those that must stay"),
    ("FLOATERS", "Floaters", "Delete what floats, as much as the strength says"),
    ("VOLUMES", "By Volumes", "Delete what volumes and marks say must go, and nothing else"),
)

_NONE = {
    "SELECTED": "no splat is selected that need not stay",
    "FLOATERS": "no splat floats that need not stay",
    "VOLUMES": "no volume says of any splat that it must go",
}


class REFINE_OT_delete(AtOnce, OnSplats, bpy.types.Operator):
    """Delete splats now, without scores"""

    bl_idname = "refine.delete"
    bl_label = "Delete Splats"
    bl_options = {"REGISTER", "UNDO"}

    what: EnumProperty(name="What", description="Which splats go", items=WHAT)
    description = tooltips("what", WHAT)

    def act(self, context: bpy.types.Context) -> Answer:
        """Delete them, except protected ones, and report their number."""
        checked, settings = mesh_layout.check(context.object), context.scene.refine
        forced = Demands.of_scene(context.scene).forced(checked)
        if self.what == "SELECTED":
            going = selection.selected(checked.obj)
        elif self.what == "FLOATERS":
            going = floaters.mask(checked, settings.to_reasons())
        else:
            going = forced.removed
        if going is not None and forced.protected is not None:
            going = going & ~forced.protected
        if going is None or not going.any():
            raise RefineError(f"object '{checked.obj.name}': {_NONE[self.what]}")
        outcome = splat_group.delete_splats(checked, ~going)
        plans.refresh(context)
        self.report({"INFO"}, f"Deleted {outcome.removed:,} splats, {outcome.kept:,} stay")
        return {"FINISHED"}


CLASSES = (REFINE_OT_delete,)
