"""What of *Apply* can be adjusted afterwards, in the box *Adjust Last Operation* (F9)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import bpy
from bpy.props import EnumProperty, FloatProperty, IntProperty

from .properties import AMOUNTS, RefineSettings


class Adjustable:
    """An operator that works by the budget of the panel, and can be done again by another one.

    To adjust it Blender undoes it and calls it again with other values. They are written to the
    panel, so that the panel says what was done, and they are not kept for the next click.
    """

    budget: EnumProperty(**AMOUNTS["budget"], options={"SKIP_SAVE"})
    percent: FloatProperty(**AMOUNTS["percent"], options={"SKIP_SAVE"})
    keep: IntProperty(**AMOUNTS["keep"], options={"SKIP_SAVE"})
    max_mb: FloatProperty(**AMOUNTS["max_mb"], options={"SKIP_SAVE"})
    threshold: FloatProperty(**AMOUNTS["threshold"], options={"SKIP_SAVE"})
    min_seen: FloatProperty(**AMOUNTS["min_seen"], options={"SKIP_SAVE"})
    psnr: FloatProperty(**AMOUNTS["psnr"], options={"SKIP_SAVE"})
    survivors: EnumProperty(**AMOUNTS["survivors"], options={"SKIP_SAVE"})
    rounds: IntProperty(**AMOUNTS["rounds"], options={"SKIP_SAVE"})

    if TYPE_CHECKING:  # of every operator
        properties: Any
        layout: Any

    def adjusted(self, context: bpy.types.Context, call: Callable[[], set[str]]) -> set[str]:
        """Write the values that the operator was given to the panel, call, and return its answer.

        The operator takes all other values from the panel. If the call does nothing, the panel is
        put back as it was.
        """
        settings = context.scene.refine
        before = {name: getattr(settings, name) for name in AMOUNTS}
        self._adjust(settings)
        answer = {"CANCELLED"}
        try:
            answer = call()
        finally:
            if answer == {"CANCELLED"}:
                for name, value in before.items():
                    if getattr(settings, name) != value:
                        setattr(settings, name, value)
        return answer

    def _adjust(self, settings: RefineSettings) -> None:
        for name in AMOUNTS:
            asked, in_panel = getattr(self, name), getattr(settings, name)
            if not self.properties.is_property_set(name):
                setattr(self, name, in_panel)
            elif asked != in_panel:
                setattr(settings, name, asked)

    def draw(self, _context: bpy.types.Context) -> None:
        """Draw the budget, as the panel does."""
        layout = self.layout
        layout.use_property_split = True
        layout.use_property_decorate = False
        layout.prop(self, "budget")
        layout.prop(self, "percent" if self.budget == "ratio" else self.budget)
        layout.prop(self, "survivors")
        if self.survivors == "refit":
            layout.prop(self, "rounds")
