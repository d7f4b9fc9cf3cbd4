"""Operators of the box *Select* of the panel."""

from __future__ import annotations

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, FloatProperty, FloatVectorProperty
from bpy.types import Context
from numpy.typing import NDArray

from ..core import RefineError, picking
from ..core.execute import Progress
from ..core.spherical_harmonics import grading
from ..core.splats import opacity
from ..mesh import attributes, edit, layout, scores, selection
from ..objects import splat_group
from ..objects.demands import Demands
from ..viewport import draw as viewport_draw
from . import plans
from .operator_bases import Acting, Answer, Job, Work, tooltips
from .select_tools import MODES

ACTIONS = (
    ("ALL", "All", "Select all splats that are not hidden", "CHECKBOX_HLT", 0),
    ("NONE", "None", "Select no splat", "CHECKBOX_DEHLT", 1),
    ("INVERT", "Invert", "Select what is not selected", "SELECT_DIFFERENCE", 2),
    ("HIDE", "Hide", "Hide the selected splats in the 3D views", "HIDE_ON", 3),
    ("ISOLATE", "Isolate", "Hide the splats that are not selected", "PIVOT_CURSOR", 4),
    ("REVEAL", "Reveal", "Show the hidden splats again, selected", "HIDE_OFF", 5),
)

SETS = (
    ("FLOATERS", "Floaters", "Select the floaters of the strength in Clean"),
    ("OUTSIDE", "Go", "Select what must go, by volumes and marks"),
    ("STAYING", "Stay", "Select what must stay, by volumes and marks"),
    ("GOING", "What Goes", "Select what Apply would remove, as the view What Goes shows it"),
    ("FAINT", "Opacity Below", "Select splats less opaque than the field below"),
    ("LARGE", "Size Above", "Select splats whose longest axis is above the field below"),
)


class REFINE_OT_select(Acting, bpy.types.Operator):
    """Select or hide splats"""

    bl_label = "Select"

    action: EnumProperty(name="Action", description="What to do", items=ACTIONS)
    description = tooltips("action", ACTIONS)

    def act(self, context: Context) -> None:
        """Do it."""
        obj = context.object
        chosen, hidden = selection.selected(obj), selection.hidden(obj)
        if self.action == "HIDE":
            selection.hide(obj, hidden | some(obj, chosen))
        elif self.action == "ISOLATE":
            selection.hide(obj, ~some(obj, chosen))
        elif self.action == "REVEAL":
            selection.hide(obj, np.zeros_like(hidden))
            selection.select(obj, chosen | hidden)
        else:
            wanted = {"ALL": ~hidden, "NONE": np.zeros_like(chosen), "INVERT": ~chosen}
            selection.select(obj, wanted[self.action])


class REFINE_OT_select_by(Acting, bpy.types.Operator):
    """Select splats by a property"""

    bl_label = "Select By"

    what: EnumProperty(name="What", description="The splats to select", items=SETS)
    mode: EnumProperty(name="Mode", description="How they combine with the selection", items=MODES)
    description = tooltips("what", SETS)

    def act(self, context: Context) -> None:
        """Select them."""
        checked = layout.check(context.object)
        chosen = taken(context, checked, self.what) & ~selection.hidden(checked.obj)
        before = selection.selected(checked.obj)
        selection.select(checked.obj, picking.combined(before, chosen, self.mode))
        self.report({"INFO"}, f"{selection.count(checked.obj):,} splats are selected")


def taken(context: Context, checked: layout.SplatObject, what: str) -> NDArray[np.bool_]:
    """Splats of one of `SETS`, or of `marks.WHAT`, (N,)."""
    settings = context.scene.refine
    if what == "SELECTED":
        return selection.selected(checked.obj)
    if what in {"FAINT", "LARGE"}:
        splats = attributes.splats_from_object(checked, sh_rest=False)
        if what == "FAINT":
            return opacity(splats.opacity_logits) < settings.select_opacity
        return splats.log_scales.max(axis=1) > np.log(settings.select_size)
    if what == "FLOATERS":
        return scores.floater_mask(checked, settings.to_reasons())
    if what == "GOING":
        if edit.REMOVE not in checked.mesh.attributes:
            raise RefineError(
                f"object '{checked.obj.name}': nothing goes yet; score the splats first"
            )
        return attributes.read_attribute(checked.mesh, edit.REMOVE) > 0
    masks = Demands.of_scene(context.scene).masks([checked])
    mask = masks["protected" if what == "STAYING" else "removed"]
    return np.zeros(len(checked), np.bool_) if mask is None else mask


class REFINE_OT_grow_selection(Job, bpy.types.Operator):
    """Select the neighbours of selected splats too, or deselect those at the edge (Esc cancels)"""

    bl_label = "Grow Selection"
    doing = "Looking for neighbours"

    shrink: BoolProperty(name="Shrink", description="Deselect those at the edge")

    def work(self, context: Context) -> Work:
        """Grow or shrink the selection."""
        checked, shrink = layout.check(context.object), self.shrink
        edit.check_writable(checked.obj)
        chosen = some(checked.obj, selection.selected(checked.obj))
        means = attributes.read_attribute(checked.mesh, "position")

        def changed(progress: Progress) -> NDArray[np.bool_]:
            neighbours = picking.neighbours_of(means, progress=progress)
            return (picking.shrunk if shrink else picking.grown)(neighbours, chosen)

        (checked,), wanted = yield [checked], changed
        selection.select(checked.obj, wanted)


class REFINE_OT_separate_selected(Acting, bpy.types.Operator):
    """Move the selected splats into a new object"""

    bl_label = "Separate Selected"

    def act(self, context: Context) -> None:
        """Copy the object, and delete from each the other's splats."""
        checked = layout.check(context.object)
        chosen = some(checked.obj, selection.selected(checked.obj))
        edit.check_deletable(checked.obj)
        if chosen.all():
            raise RefineError(
                f"object '{checked.obj.name}': all splats are selected; none would be left"
            )
        apart = checked.obj.copy()
        apart.data = checked.mesh.copy()
        for collection in checked.obj.users_collection:
            collection.objects.link(apart)
        try:
            splat_group.delete_splats(layout.check(apart), chosen)
            splat_group.delete_splats(checked, ~chosen)
        except BaseException:
            bpy.data.batch_remove([apart.data, apart])
            raise
        selection.select(apart, np.zeros(layout.splat_count(apart.data), np.bool_))
        apart.select_set(False)  # selected objects are pruned together
        plans.refresh(context)
        self.report({"INFO"}, f"'{apart.name}' has {layout.splat_count(apart.data):,} splats")


class REFINE_OT_grade(Acting, bpy.types.Operator):
    """Grade the colours of the selected splats, or of all if none is selected"""

    bl_label = "Grade Colours"

    exposure: FloatProperty(
        name="Exposure", description="Stops: each doubles the light, below 0 halves it",
        min=-10.0, max=10.0, soft_min=-3.0, soft_max=3.0, options={"SKIP_SAVE"},
    )  # fmt: skip
    tint: FloatVectorProperty(
        name="Tint", description="Factors of red, green and blue, as they are displayed (sRGB)",
        subtype="COLOR_GAMMA", default=(1.0, 1.0, 1.0), min=0.0, max=1.0, options={"SKIP_SAVE"},
    )  # fmt: skip
    saturation: FloatProperty(
        name="Saturation", description="0 is grey, 1 leaves the colours as they are",
        subtype="FACTOR", default=1.0, min=0.0, max=2.0, options={"SKIP_SAVE"},
    )  # fmt: skip

    def invoke(self, context: Context, event: bpy.types.Event) -> Answer:
        """Show the values beside the mouse; each change of one is drawn at once."""
        return context.window_manager.invoke_props_popup(self, event)

    def act(self, context: Context) -> None:
        """Grade them."""
        checked = layout.check(context.object)
        chosen = selection.selected(checked.obj)
        rows = np.flatnonzero(chosen if chosen.any() else ~chosen)
        splat_group.grade(checked, rows, grading(self.exposure, self.tint, self.saturation))
        viewport_draw.untint()


def some(obj: bpy.types.Object, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The chosen splats, (N,); `RefineError` if there are none."""
    if not chosen.any():
        raise RefineError(f"object '{obj.name}': no splat is selected; select some first")
    return chosen
