"""The operator that finds floaters by what the cameras see."""

from __future__ import annotations

from typing import Any

import bpy
from bpy.types import Context

from ..core.cleaning.clean import Cleaned, Cleaning, clean
from ..core.execute import Progress
from ..mesh import edit as mesh_edit
from ..mesh import floaters
from ..mesh import layout as mesh_layout
from ..mesh.layout import SplatObject
from ..objects import splat_group
from .operator_bases import Job, OnSplats
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
        """The floaters."""
        arguments, masks = job
        return clean(*arguments, **masks, progress=progress)

    def put(self, context: Context, group: list[SplatObject], _job: Any, cleaned: Any) -> None:
        """Store the floaters, mark them as removed, report them."""
        floaters.store(group[0], cleaned)
        floaters.mark(group[0], context.scene.refine.to_reasons())
        self.report({"INFO"}, f"Floaters: {cleaned.in_words()}")


CLASSES = (REFINE_OT_find_floaters,)
