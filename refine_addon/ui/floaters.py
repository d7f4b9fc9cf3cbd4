"""Operators that find floaters, by what the cameras see, and delete them."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from bpy.types import Context

from ..core.cleaning.clean import Cleaned, Cleaning, clean
from ..core.execute import Progress
from ..mesh import edit as mesh_edit
from ..mesh import floaters
from ..mesh import layout as mesh_layout
from ..mesh.layout import SplatObject
from ..objects import splat_group
from ..objects.demands import Demands
from . import plans
from .operator_bases import Answer, AtOnce, Job, OnSplats
from .operators import chosen_views


class REFINE_OT_find_floaters(Job, OnSplats, bpy.types.Operator):
    """Find splats that float where the cameras see empty space; nothing is deleted (Esc cancels)"""

    bl_idname = "refine.find_floaters"
    bl_label = "Find Floaters"
    bl_options = {"REGISTER", "UNDO"}
    doing = "Looking for floaters"

    def gather(self, context: Context) -> tuple[list[SplatObject], Any]:
        """The arguments of `clean`, in the world."""
        checked, settings = mesh_layout.check(context.object), context.scene.refine
        mesh_edit.check_writable(checked.obj)
        cleaning = Cleaning(settings.to_reasons(), settings.views)
        forced = splat_group.forced(context.scene, [checked])
        masks = {"protected": forced.protected, "removed": forced.removed}
        return [checked], ((splat_group.gather([checked]), chosen_views(context), cleaning), masks)

    @staticmethod
    def compute(job: Any, progress: Progress) -> Cleaned:
        """What floats."""
        arguments, masks = job
        return clean(*arguments, **masks, progress=progress)

    def put(self, context: Context, group: list[SplatObject], _job: Any, cleaned: Any) -> None:
        """Store what was found, mark it as what goes, and say it."""
        floaters.store(group[0], cleaned)
        floaters.mark(group[0], context.scene.refine.to_reasons())
        self.report({"INFO"}, f"Floaters: {cleaned.in_words()}")


def _searched(context: Context) -> str:
    """Return that floaters are to be looked for, "" if they were."""
    return "Find floaters first" if floaters.counts(context.object.data) is None else ""


class REFINE_OT_delete_floaters(AtOnce, OnSplats, bpy.types.Operator):
    """Delete the floaters that were found, as many as the strength says"""

    bl_idname = "refine.delete_floaters"
    bl_label = "Delete Floaters"
    bl_options = {"REGISTER", "UNDO"}

    needs = (*OnSplats.needs, _searched)

    def act(self, context: Context) -> Answer:
        """Delete them, but for those that must stay by now."""
        checked = mesh_layout.check(context.object)
        floating = floaters.mask(checked, context.scene.refine.to_reasons())
        protected = Demands.of_scene(context.scene).forced(checked).protected
        spared = ""
        if protected is not None and (stays := int(np.count_nonzero(floating & protected))):
            floating &= ~protected
            spared = f"; {stays:,} more are protected by now"
        if not floating.any():
            self.report({"INFO"}, f"There are no floaters to delete{spared}")
            return {"CANCELLED"}
        outcome = splat_group.delete_splats(checked, ~floating)
        plans.refresh(context)
        self.report(
            {"INFO"}, f"Deleted {outcome.removed:,} floaters, {outcome.kept:,} splats stay{spared}"
        )
        return {"FINISHED"}


CLASSES = (REFINE_OT_find_floaters, REFINE_OT_delete_floaters)
