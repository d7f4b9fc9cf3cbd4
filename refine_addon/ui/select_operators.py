"""Operators on the selection of splats: what changes it at once, and its uses."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty
from bpy.types import Context
from numpy.typing import NDArray

from ..core import picking
from ..core.errors import RefineError
from ..core.execute import Progress
from ..core.splats import opacity
from ..mesh import attributes as mesh_attributes
from ..mesh import edit as mesh_edit
from ..mesh import floaters, selection
from ..mesh import layout as mesh_layout
from ..mesh.layout import SplatObject
from ..objects import splat_group
from ..objects.demands import Demands
from . import plans
from .operator_bases import Answer, AtOnce, Job, OnSplats
from .select_tools import MODES

ACTIONS = (
    ("ALL", "All", "Select all splats that are not hidden"),
    ("NONE", "None", "Select no splat"),
    ("INVERT", "Invert", "Select what is not selected"),
    ("HIDE", "Hide", "Hide the selected splats in the 3D views"),
    ("ISOLATE", "Isolate", "Hide the splats that are not selected"),
    ("REVEAL", "Reveal", "Show the hidden splats again, selected"),
)

SETS = (
    ("FLOATERS", "Floaters", "Those that Find Floaters found, by the strength of Clean"),
    ("OUTSIDE", "Go", "Those that must go: outside or inside of volumes, or marked"),
    ("STAYING", "Stay", "Those that must stay: inside of volumes, or marked"),
    ("GOING", "What Goes", "Those that Apply would remove"),
    ("FAINT", "Opacity Below", "Those that are less opaque than the field says"),
    ("LARGE", "Size Above", "Those whose longest standard deviation is more than the field says"),
)


class REFINE_OT_select(AtOnce, OnSplats, bpy.types.Operator):
    """Select or hide splats"""

    bl_idname = "refine.select"
    bl_label = "Select"
    bl_options = {"REGISTER", "UNDO"}

    action: EnumProperty(name="Action", description="What is done", items=ACTIONS)

    @classmethod
    def description(cls, _context: Context, properties: bpy.types.AnyType) -> str:
        """A button's tooltip."""
        return next(text for name, _, text in ACTIONS if name == properties.action)

    def act(self, context: Context) -> Answer:
        """Do it."""
        obj = context.object
        mesh_edit.check_writable(obj)
        chosen, hidden = selection.selected(obj), selection.hidden(obj)
        if self.action == "HIDE":
            selection.hide(obj, hidden | _some(obj, chosen))
        elif self.action == "ISOLATE":
            selection.hide(obj, ~_some(obj, chosen))
        elif self.action == "REVEAL":
            selection.hide(obj, np.zeros_like(hidden))
            selection.select(obj, chosen | hidden)
        else:
            wanted = {"ALL": ~hidden, "NONE": np.zeros_like(chosen), "INVERT": ~chosen}
            selection.select(obj, wanted[self.action])
        return {"FINISHED"}


class REFINE_OT_select_by(AtOnce, OnSplats, bpy.types.Operator):
    """Select splats by what is known of them"""

    bl_idname = "refine.select_by"
    bl_label = "Select By"
    bl_options = {"REGISTER", "UNDO"}

    what: EnumProperty(name="What", description="Which splats are taken", items=SETS)
    mode: EnumProperty(name="Mode", description="What becomes of those taken", items=MODES)

    @classmethod
    def description(cls, _context: Context, properties: bpy.types.AnyType) -> str:
        """A button's tooltip."""
        return next(text for name, _, text in SETS if name == properties.what)

    def act(self, context: Context) -> Answer:
        """Select them."""
        checked = mesh_layout.check(context.object)
        taken = self._taken(context, checked) & ~selection.hidden(checked.obj)
        before = selection.selected(checked.obj)
        selection.select(checked.obj, picking.combined(before, taken, self.mode))
        self.report({"INFO"}, f"{selection.count(checked.obj):,} splats are selected")
        return {"FINISHED"}

    def _taken(self, context: Context, checked: SplatObject) -> NDArray[np.bool_]:
        settings, columns = context.scene.refine, mesh_attributes.stored_columns(checked)
        if self.what == "FAINT":
            return opacity(columns["opacity"]) < settings.select_opacity
        if self.what == "LARGE":
            names = (column.name for column in checked.layout.columns)
            scales = [columns[name] for name in names if name.startswith("scale_")]
            return np.max(scales, axis=0) > np.log(settings.select_size)
        if self.what == "FLOATERS":
            return floaters.mask(checked, settings.to_reasons())
        if self.what == "GOING":
            if mesh_edit.REMOVE not in checked.mesh.attributes:
                raise RefineError(
                    f"object '{checked.obj.name}': nothing goes yet; score the splats first"
                )
            return mesh_attributes.read_attribute(checked.mesh, mesh_edit.REMOVE) > 0
        forced = Demands.of_scene(context.scene).forced(checked)
        mask = forced.removed if self.what == "OUTSIDE" else forced.protected
        return np.zeros(len(checked), np.bool_) if mask is None else mask


class REFINE_OT_grow_selection(Job, OnSplats, bpy.types.Operator):
    """Select the neighbours of the selected splats too, or leave out those at the edge (Esc cancels)"""  # noqa: E501

    bl_idname = "refine.grow_selection"
    bl_label = "Grow Selection"
    bl_options = {"REGISTER", "UNDO"}
    doing = "Looking for neighbours"

    shrink: BoolProperty(name="Shrink", description="Leave out those at the edge")

    def gather(self, context: Context) -> tuple[list[SplatObject], Any]:
        """Positions, and the selection."""
        checked = mesh_layout.check(context.object)
        mesh_edit.check_writable(checked.obj)
        chosen = _some(checked.obj, selection.selected(checked.obj))
        means = mesh_attributes.read_attribute(checked.mesh, "position")
        return [checked], (means, chosen, self.shrink)

    @staticmethod
    def compute(job: Any, progress: Progress) -> NDArray[np.bool_]:
        """The grown or shrunk selection, (N,)."""
        means, chosen, shrink = job
        neighbours = picking.neighbours_of(means, progress=progress)
        return (picking.shrunk if shrink else picking.grown)(neighbours, chosen)

    def put(self, _context: Context, group: list[SplatObject], _job: Any, wanted: Any) -> None:
        """Select it."""
        selection.select(group[0].obj, wanted)


class REFINE_OT_separate_selected(AtOnce, OnSplats, bpy.types.Operator):
    """Make an object of its own of the selected splats"""

    bl_idname = "refine.separate_selected"
    bl_label = "Separate Selected"
    bl_options = {"REGISTER", "UNDO"}

    def act(self, context: Context) -> Answer:
        """Copy the object, and delete from each the other's splats."""
        checked = mesh_layout.check(context.object)
        chosen = _some(checked.obj, selection.selected(checked.obj))
        mesh_edit.check_deletable(checked.obj)
        if chosen.all():
            raise RefineError(
                f"object '{checked.obj.name}': all splats are selected; none would be left"
            )
        apart = checked.obj.copy()
        apart.data = checked.mesh.copy()
        for collection in checked.obj.users_collection:
            collection.objects.link(apart)
        try:
            splat_group.delete_splats(mesh_layout.check(apart), chosen)
            splat_group.delete_splats(checked, ~chosen)
        except BaseException:
            bpy.data.batch_remove([apart.data, apart])
            raise
        selection.select(apart, np.zeros(mesh_layout.splat_count(apart.data), np.bool_))
        apart.select_set(True)
        plans.refresh(context)
        self.report({"INFO"}, f"'{apart.name}' has {mesh_layout.splat_count(apart.data):,} splats")
        return {"FINISHED"}


def _some(obj: bpy.types.Object, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    if not chosen.any():
        raise RefineError(f"object '{obj.name}': no splat is selected")
    return chosen


CLASSES = (
    REFINE_OT_select,
    REFINE_OT_select_by,
    REFINE_OT_grow_selection,
    REFINE_OT_separate_selected,
)
