"""Operators that find floaters, by what the cameras see, and delete them."""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import numpy as np

from ..core.cleaning.clean import Cleaned, Cleaning, clean
from ..core.execute import Progress
from ..core.splats import Splats
from ..core.views import ViewSet
from ..core.volumes import Forced
from ..mesh import edit as mesh_edit
from ..mesh import floaters
from ..mesh import layout as mesh_layout
from ..mesh.layout import SplatObject
from ..objects import splat_object
from ..objects.demands import Demands
from . import plans
from .on_thread import OnThread
from .operator_bases import Answer, AtOnce, OnSplats
from .operators import chosen_views


@dataclass(frozen=True, eq=False)
class _Searching:
    """Where to search for floaters: splats and views as they stand in the world."""

    splats: Splats
    views: ViewSet
    settings: Cleaning
    forced: Forced


class REFINE_OT_find_floaters(OnThread, OnSplats, bpy.types.Operator):
    """Find splats that float where the cameras see empty space; nothing is deleted (Esc cancels)"""

    bl_idname = "refine.find_floaters"
    bl_label = "Find Floaters"
    bl_options = {"REGISTER", "UNDO"}
    doing = "Looking for floaters"

    def prepare(self, context: bpy.types.Context, checked: SplatObject) -> _Searching:
        """Gather splats and views."""
        settings = context.scene.refine
        mesh_edit.check_writable(checked.obj)
        return _Searching(
            splat_object.gather(checked),
            chosen_views(context),
            Cleaning(tuple(settings.reasons), settings.views),
            Demands.of_scene(context.scene).forced(checked),
        )

    @staticmethod
    def work(job: _Searching, progress: Progress) -> Cleaned:
        """Search."""
        return clean(
            job.splats, job.views, job.settings,
            protected=job.forced.protected, removed=job.forced.removed, progress=progress,
        )  # fmt: skip

    def finish(
        self, context: bpy.types.Context, checked: SplatObject, _job: _Searching, cleaned: Cleaned
    ) -> Answer:
        """Store what was found, mark it as what goes, and say it."""
        floaters.store(checked, cleaned)
        floaters.mark(checked, context.scene.refine.reasons)
        self.report({"INFO"}, f"Floaters: {cleaned.in_words()}")
        return {"FINISHED"}


def _searched(context: bpy.types.Context) -> str:
    """Return that floaters are to be looked for, "" if they were."""
    return "Find floaters first" if floaters.counts(context.object.data) is None else ""


class REFINE_OT_delete_floaters(AtOnce, OnSplats, bpy.types.Operator):
    """Delete the floaters that were found, for the reasons that are switched on"""

    bl_idname = "refine.delete_floaters"
    bl_label = "Delete Floaters"
    bl_options = {"REGISTER", "UNDO"}

    needs = (*OnSplats.needs, _searched)

    def act(self, context: bpy.types.Context) -> Answer:
        """Delete them, but for those that must stay by now."""
        checked = mesh_layout.check(context.object)
        floating = floaters.mask(checked, context.scene.refine.reasons)
        protected = Demands.of_scene(context.scene).forced(checked).protected
        spared = ""
        if protected is not None and (stays := int(np.count_nonzero(floating & protected))):
            floating &= ~protected
            spared = f"; {stays:,} more are protected by now"
        if not floating.any():
            self.report({"INFO"}, f"There are no floaters to delete{spared}")
            return {"CANCELLED"}
        outcome = splat_object.delete_splats(checked, ~floating)
        plans.forget(checked.mesh)
        plans.refresh(context)
        self.report(
            {"INFO"}, f"Deleted {outcome.removed:,} floaters, {outcome.kept:,} splats stay{spared}"
        )
        return {"FINISHED"}


CLASSES = (REFINE_OT_find_floaters, REFINE_OT_delete_floaters)
