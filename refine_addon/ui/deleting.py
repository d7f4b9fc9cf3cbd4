"""Operators that delete splats at once, without scores."""

from __future__ import annotations

import bpy
import numpy as np
from numpy.typing import NDArray

from ..mesh import layout as mesh_layout
from ..mesh.layout import SplatObject
from ..objects import splat_group
from . import plans
from .operator_bases import Answer, AtOnce, OnSplats


class Deleting(AtOnce, OnSplats):
    """An operator that deletes some splats of the active object."""

    def going(self, context: bpy.types.Context, checked: SplatObject) -> NDArray[np.bool_]:
        """Return which splats go, (N,), or raise `RefineError` if it is none."""
        raise NotImplementedError

    def act(self, context: bpy.types.Context) -> Answer:
        """Delete them, drop the plan that was made with them, and say how many they were."""
        checked = mesh_layout.check(context.object)
        outcome = splat_group.delete_splats(checked, ~self.going(context, checked))
        plans.refresh(context)
        self.report({"INFO"}, f"Deleted {outcome.removed:,} splats, {outcome.kept:,} stay")
        return {"FINISHED"}
