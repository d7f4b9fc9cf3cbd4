"""The operator that marks splats by hand: to stay, or to go."""

from __future__ import annotations

import bpy
import numpy as np
from bpy.props import EnumProperty

from ..core.errors import RefineError
from ..mesh import attributes as mesh_attributes
from ..mesh import edit as mesh_edit
from ..mesh import layout as mesh_layout
from ..mesh import selection
from . import demand_changes
from .operator_bases import Answer, AtOnce, Needing, idle, on_splats

_MARKS = {"STAY": mesh_edit.PROTECT, "GO": mesh_edit.MUST_GO}

_TOOLTIPS = {
    ("ADD", "STAY"): "Mark the selected splats: they stay, whatever the budget",
    ("ADD", "GO"): "Mark the selected splats: they go before all others",
    ("SUBTRACT", "STAY"): "Take the marks off the selected splats",
    ("SUBTRACT", "GO"): "Take the marks off the selected splats",
    ("CLEAR", "STAY"): "Take the marks off all splats",
    ("CLEAR", "GO"): "Take the marks off all splats",
}


class REFINE_OT_protect(AtOnce, Needing, bpy.types.Operator):
    """Change which splats are marked to stay, or to go"""

    bl_idname = "refine.protect"
    bl_label = "Mark Splats"
    bl_options = {"REGISTER", "UNDO"}
    needs = (idle, on_splats)

    mode: EnumProperty(
        name="Mode",
        description="What is done to the marks",
        items=(
            ("ADD", "Mark Selected", "Mark the selected splats"),
            ("SUBTRACT", "Release Selected", "Take the marks off the selected splats"),
            ("CLEAR", "Clear", "Take the marks off all splats"),
        ),
    )
    mark: EnumProperty(
        name="Mark",
        description="What is marked",
        items=(
            ("STAY", "Stay", "They stay, whatever else is said"),
            ("GO", "Must Go", "They go before all others"),
        ),
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.AnyType) -> str:
        """Return the tooltip of a button."""
        return _TOOLTIPS[properties.mode, properties.mark]

    def act(self, context: bpy.types.Context) -> Answer:
        """Write the marks; a splat that is marked one way loses its mark of the other."""
        obj, name = context.object, _MARKS[self.mark]
        mesh_edit.check_writable(obj)
        change = _mark_in_edit_mode if obj.mode == "EDIT" and obj.type == "MESH" else _mark
        change(obj, self.mode, name)
        for other in set(_MARKS.values()) - {name}:
            if self.mode == "ADD" and other in obj.data.attributes:
                change(obj, "SUBTRACT", other)
        if obj.mode == "EDIT":
            demand_changes.mark_after_edit_mode(obj)
        else:
            marked = mesh_edit.marks(obj, name)
            count = 0 if marked is None else int(np.count_nonzero(marked))
            self.report({"INFO"}, f"{count:,} splats are marked to {self.mark.lower()}")
        demand_changes.mark_again(context)
        return {"FINISHED"}


def _mark(obj: bpy.types.Object, mode: str, name: str) -> None:
    """Change the marks of a name by what is selected."""
    marked = mesh_edit.marks(obj, name)
    if marked is None:
        marked = np.zeros(mesh_layout.splat_count(obj.data), np.bool_)
    if mode == "CLEAR":
        marked[:] = False
    else:
        chosen = selection.selected(obj)
        if not chosen.any():
            raise RefineError(f"object '{obj.name}': no splat is selected; select some first")
        marked[chosen] = mode == "ADD"
    mesh_edit.mark_by_hand(obj, marked, name)


def _mark_in_edit_mode(obj: bpy.types.Object, mode: str, name: str) -> None:
    """Change the marks of a mesh in edit mode, where Blender itself has to write them.

    Raise `RefineError` if no splat is selected, or Blender fails.
    """
    mesh = obj.data
    if mode == "CLEAR":
        mesh_attributes.remove_attribute(mesh, name)
        return
    if not mesh.total_vert_sel:
        raise RefineError(f"object '{obj.name}': no splat is selected")
    marks = mesh.attributes.get(name)
    if marks and (marks.data_type, marks.domain) != ("BOOLEAN", "POINT"):
        mesh_attributes.remove_attribute(mesh, name)
        marks = None
    before = mesh.attributes.active.name if mesh.attributes.active else ""
    mesh.attributes.active = marks or mesh.attributes.new(name, "BOOLEAN", "POINT")
    try:
        bpy.ops.mesh.attribute_set(value_bool=mode == "ADD")
    except RuntimeError as error:
        raise RefineError(
            f"object '{obj.name}': Blender could not mark the splats ({str(error).strip()})"
        ) from error
    finally:
        if before in mesh.attributes:
            mesh.attributes.active = mesh.attributes[before]


CLASSES = (REFINE_OT_protect,)
