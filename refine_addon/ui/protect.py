"""The operator that marks splats by hand to stay."""

# ruff: noqa: D400, N801, RUF012, TC002 - Blender's names and tooltips; annotations are run
from __future__ import annotations

from typing import TYPE_CHECKING

import bpy
import numpy as np
from bpy.props import EnumProperty

from ..core.errors import RefineError
from ..mesh import attributes as mesh_attributes
from ..mesh import edit as mesh_edit
from ..mesh import layout as mesh_layout
from . import demand_changes
from .operator_bases import Answer, AtOnce, Needing, idle, on_splats

if TYPE_CHECKING:
    from numpy.typing import NDArray


class REFINE_OT_protect(AtOnce, Needing, bpy.types.Operator):
    """Change which splats are marked to stay"""

    bl_idname = "refine.protect"
    bl_label = "Protect Splats"
    bl_options = {"REGISTER", "UNDO"}
    needs = (idle, on_splats)

    mode: EnumProperty(
        name="Mode",
        description="What is done to the marks",
        items=(
            ("ADD", "Protect Selected", "Mark the selected splats to stay"),
            ("SUBTRACT", "Release Selected", "Take the marks off the selected splats"),
            ("CLEAR", "Clear", "Take the marks off all splats"),
        ),
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.AnyType) -> str:
        """Return the tooltip of a button."""
        return {
            "ADD": "Mark the splats that are selected in edit mode: they stay, whatever the budget",
            "SUBTRACT": "Take the marks off the splats that are selected in edit mode",
            "CLEAR": "Take the marks off all splats",
        }[properties.mode]

    def act(self, context: bpy.types.Context) -> Answer:
        """Write the marks."""
        obj = context.object
        mesh_edit.check_writable(obj)
        if obj.mode == "EDIT" and obj.type == "MESH":
            _mark_in_edit_mode(obj, self.mode)
        else:
            _mark(obj, self.mode)
        if obj.mode == "EDIT":
            demand_changes.mark_after_edit_mode(obj)
        else:
            marked = mesh_edit.protected_mask(obj, "")
            count = 0 if marked is None else int(np.count_nonzero(marked))
            self.report({"INFO"}, f"{count:,} splats are marked to stay")
        demand_changes.mark_again(context)
        return {"FINISHED"}


def _mark(obj: bpy.types.Object, mode: str) -> None:
    """Change the marks by what is selected."""
    mesh, marked = obj.data, mesh_edit.protected_mask(obj, "")
    if marked is None:
        marked = np.zeros(mesh_layout.splat_count(mesh), np.bool_)
    if mode == "CLEAR":
        marked[:] = False
    else:
        marked[_selection(obj)] = mode == "ADD"
    mesh_edit.mark_protected(obj, marked)


def _selection(obj: bpy.types.Object) -> NDArray[np.bool_]:
    """Return which splats are selected, (N,), or raise `RefineError` if none is."""
    name = ".selection" if obj.type == "POINTCLOUD" else ".select_vert"
    attribute = obj.data.attributes.get(name)
    if attribute and attribute.domain == "POINT" and attribute.data_type in {"BOOLEAN", "FLOAT"}:
        selected = mesh_attributes.read_attribute(obj.data, name) > 0
        if selected.any():
            return np.asarray(selected)
    elif obj.mode == "EDIT":
        return np.ones(mesh_layout.splat_count(obj.data), np.bool_)  # Blender's way to say all
    msg = f"object '{obj.name}': no splat is selected; select some in edit mode first"
    raise RefineError(msg)


def _mark_in_edit_mode(obj: bpy.types.Object, mode: str) -> None:
    """Change the marks of a mesh in edit mode, where Blender itself has to write them.

    Raise `RefineError` if no splat is selected, or Blender fails.
    """
    mesh = obj.data
    if mode == "CLEAR":
        mesh_attributes.remove_attribute(mesh, mesh_edit.PROTECT)
        return
    if not mesh.total_vert_sel:
        msg = f"object '{obj.name}': no splat is selected"
        raise RefineError(msg)
    marks = mesh.attributes.get(mesh_edit.PROTECT)
    if marks and (marks.data_type, marks.domain) != ("BOOLEAN", "POINT"):
        mesh_attributes.remove_attribute(mesh, mesh_edit.PROTECT)
        marks = None
    before = mesh.attributes.active.name if mesh.attributes.active else ""
    mesh.attributes.active = marks or mesh.attributes.new(mesh_edit.PROTECT, "BOOLEAN", "POINT")
    try:
        bpy.ops.mesh.attribute_set(value_bool=mode == "ADD")
    except RuntimeError as error:
        msg = f"object '{obj.name}': Blender could not mark the splats ({str(error).strip()})"
        raise RefineError(msg) from error
    finally:
        if before in mesh.attributes:
            mesh.attributes.active = mesh.attributes[before]
