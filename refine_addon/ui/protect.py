"""The operator that marks splats by hand: to stay, or to go."""

from __future__ import annotations

import bpy
import numpy as np
from bpy.props import EnumProperty

from ..core.errors import RefineError
from ..mesh import attributes as mesh_attributes
from ..mesh import edit as mesh_edit
from ..mesh import selection
from . import plans
from .operator_bases import Answer, AtOnce, Needing, idle, on_splats, tooltips

_MARKS = {"STAY": mesh_edit.PROTECT, "GO": mesh_edit.MUST_GO}

_ITEMS = (
    ("STAY", "Stay", "Mark the selected splats: they stay, whatever the budget"),
    ("GO", "Go", "Mark the selected splats: they go before all others"),
    ("NONE", "Unmark", "Take both marks off the selected splats"),
)


class REFINE_OT_protect(AtOnce, Needing, bpy.types.Operator):
    """Mark the selected splats to stay, or to go"""

    bl_idname = "refine.protect"
    bl_label = "Mark Splats"
    bl_options = {"REGISTER", "UNDO"}
    needs = (idle, on_splats)

    mark: EnumProperty(name="Mark", description="What becomes of them", items=_ITEMS)
    description = tooltips("mark", _ITEMS)

    def act(self, context: bpy.types.Context) -> Answer:
        """Write the marks; a splat has one of the two."""
        obj = context.object
        mesh_edit.check_writable(obj)
        editing = obj.mode == "EDIT" and obj.type == "MESH"
        chosen = obj.data.total_vert_sel if editing else selection.selected(obj)
        if not np.any(chosen):
            raise RefineError(f"object '{obj.name}': no splat is selected; select some first")
        for mark, name in _MARKS.items():
            value = mark == self.mark
            if not value and name not in obj.data.attributes:
                continue
            if editing:
                _mark_in_edit_mode(obj, name, value)
                continue
            marked = mesh_edit.marks(obj, name)
            marked = np.zeros_like(chosen) if marked is None else marked
            mesh_edit.mark_by_hand(obj, np.where(chosen, value, marked), name)
        if editing:
            plans.mark_after_edit_mode(obj)
        plans.mark_again(context)
        return {"FINISHED"}


def _mark_in_edit_mode(obj: bpy.types.Object, name: str, value: bool) -> None:
    """Change marks of selected vertices, which only Blender can write there."""
    mesh = obj.data
    marks = mesh.attributes.get(name)
    if marks and (marks.data_type, marks.domain) != ("BOOLEAN", "POINT"):
        mesh_attributes.remove_attribute(mesh, name)
        marks = None
    before = mesh.attributes.active.name if mesh.attributes.active else ""
    mesh.attributes.active = marks or mesh.attributes.new(name, "BOOLEAN", "POINT")
    try:
        bpy.ops.mesh.attribute_set(value_bool=value)
    except RuntimeError as error:
        raise RefineError(
            f"object '{obj.name}': Blender could not mark the splats ({str(error).strip()})"
        ) from error
    finally:
        if before in mesh.attributes:
            mesh.attributes.active = mesh.attributes[before]


CLASSES = (REFINE_OT_protect,)
