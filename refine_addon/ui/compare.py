"""*Compare*: the active camera's picture now, after *Apply*, and their difference."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import bpy
import numpy as np
from bpy.types import Context

from ..cameras.sets import CameraChoice
from ..core.execute import Progress, part
from ..core.pictures import AMPLIFIED, KINDS, Comparison, compare
from ..core.prune import prune
from ..core.quality.curve import in_words
from ..core.views import ViewSet
from ..objects import splat_group
from ..objects.splat_group import Members
from . import plans
from .images import put
from .operator_bases import Job, OnScored
from .operators import apply_arguments, selected

NAMES = {kind: f"Compare: {kind}" for kind in KINDS}
"""Image names of the pictures, replaced by each comparison."""


class REFINE_OT_compare(Job, OnScored, bpy.types.Operator):
    """Draw what the active camera sees before and after Apply, and say how close both are in dB"""

    bl_idname = "refine.compare"
    bl_label = "Compare"
    bl_options = {"REGISTER"}
    doing = "Comparing"

    def gather(self, context: Context) -> tuple[Members, Any]:
        """Apply's arguments, the splats, and the active camera's view."""
        view = CameraChoice("ACTIVE").views(context, context.object)[0]
        group = selected(context)
        forced = splat_group.forced(context.scene, group)
        arguments = apply_arguments(context, group, forced)
        splats = arguments["splats"] or splat_group.gather(group, whole=None)
        return [], (arguments, splats, ViewSet((replace(view, weight=1.0),)))

    @staticmethod
    def compute(job: Any, progress: Progress) -> tuple[Comparison, float | None]:
        """Both pictures of the kept splats; the estimated PSNR, dB."""
        arguments, splats, view = job
        decided = 0.6 if arguments["method"].changes else 0.1  # of the time, by then
        result = prune(**arguments, partial=True, progress=part(progress, 0.0, decided))
        kept = result.merged.splats if result.merged else splats.take(result.keep)
        (comparison,) = compare(splats, kept, view, progress=part(progress, decided, 1.0))
        return comparison, result.report["estimated_psnr"]

    def put(self, context: Context, _group: Members, _job: Any, result: Any) -> None:
        """Put the pictures into images, show them, report the PSNR."""
        comparison, estimated = result
        plan = plans.stored(context.object, context.scene.refine)
        if plan is not None:
            plan["measured"] = comparison
        images = [put(NAMES[kind], getattr(comparison, kind) / np.float32(255.0)) for kind in KINDS]
        if not bpy.app.background and context.window is not None:
            _show(context, images)
        about = "" if estimated is None else f"; {in_words(estimated)} estimated in all views"
        self.report(
            {"INFO"},
            f"{comparison.psnr:.1f} dB measured in '{comparison.view.name}'{about}. "
            f"The difference is shown {AMPLIFIED} times as large",
        )


def measured(obj: bpy.types.Object, settings: Any) -> str:
    """A sentence on the measurement of the current plan, "" without."""
    measured: Comparison | None = (plans.stored(obj, settings) or {}).get("measured")
    return f"Measured in '{measured.view.name}': {measured.psnr:.1f} dB" if measured else ""


def _show(context: Context, images: list[bpy.types.Image]) -> None:
    manager = context.window_manager
    shown = [
        area.spaces.active.image
        for window in manager.windows
        for area in window.screen.areas
        if area.type == "IMAGE_EDITOR"
    ]
    if all(image in shown for image in images):
        return
    before = set(manager.windows)
    bpy.ops.wm.window_new()
    (window,) = set(manager.windows) - before
    for area, image in zip(_split(context, window, len(images)), images, strict=True):
        area.type = "IMAGE_EDITOR"
        space = area.spaces.active
        space.image = image
        space.show_region_toolbar = space.show_region_ui = False
    # Until Blender has drawn them, areas have the size from before they were split.
    bpy.app.timers.register(partial(_fit, [image.name for image in images]), first_interval=0.2)


def _split(context: Context, window: bpy.types.Window, count: int) -> list[bpy.types.Area]:
    """Split a window's only area into several of one width, left to right."""
    (rest,) = window.screen.areas
    areas: list[bpy.types.Area] = []
    for left in range(count, 1, -1):
        with context.temp_override(window=window, screen=window.screen, area=rest):
            bpy.ops.screen.area_split(direction="VERTICAL", factor=1.0 / left)
        areas += [area for area in window.screen.areas if area != rest and area not in areas]
    return [*areas, rest]


def _fit(names: list[str]) -> None:
    """Fit images into their editors; called once by Blender's timer."""
    for window in bpy.context.window_manager.windows:
        for area in window.screen.areas:
            space = area.spaces.active
            if area.type != "IMAGE_EDITOR" or not space.image or space.image.name not in names:
                continue
            region = next(each for each in area.regions if each.type == "WINDOW")
            with bpy.context.temp_override(window=window, area=area, region=region):
                bpy.ops.image.view_all(fit_view=True)


CLASSES = (REFINE_OT_compare,)
