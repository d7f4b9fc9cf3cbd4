"""Operators that score, prune and compare splat objects.
Read `REFINE_OT_apply.work` to see what runs when *Apply* is clicked."""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial
from typing import Any

import bpy
import numpy as np
from bpy.types import Context
from numpy.typing import NDArray

from ..cameras import CameraChoice
from ..core import Result, Scores, ViewSet
from ..core.execute import Progress, part
from ..core.lod import Level, lod, viewing_distance
from ..core.pictures import AMPLIFIED, KINDS, Comparison, compare
from ..core.prune import REFITTING, prune, score
from ..core.quality.curve import in_words
from ..core.report import scoring_notes, sizes_in_words
from ..core.visibility import frustum
from ..mesh import edit, layout
from ..mesh import scores as mesh_scores
from ..objects import demands, splat_group
from ..viewport import draw as viewport_draw
from . import plans
from .images import put
from .operator_bases import Answer, Job, Work, in_object_mode, scored
from .wrapped import counted

_SCORED = 0.97  # Share of the time that scoring takes; the rest counts the splats in each view


def chosen_views(context: Context) -> ViewSet:
    """Views of the panel's cameras."""
    return CameraChoice.of_scene(context.scene).views(context, context.object)


def apply_arguments(context: Context, group: splat_group.Members) -> dict[str, Any]:
    """Arguments of `prune` for the selected objects, from the panel's settings."""
    settings, masks = context.scene.refine, demands.Demands.of_scene(context.scene).masks(group)
    method = splat_group.possible(group, settings.to_method())
    views = chosen_views(context) if method.changes else None
    return splat_group.stored_arguments(group, settings.to_budget(), masks, method, views)


def _of_objects(group: splat_group.Members) -> str:
    return f" of {len(group)} objects" if len(group) > 1 else ""


class REFINE_OT_score(Job, bpy.types.Operator):
    """Score each splat by how much the cameras would miss it (Esc cancels)"""

    bl_label = "Score"
    doing = "Scoring splats"

    def work(self, context: Context) -> Work:
        """Score, count the splats in each view; store both on the meshes and report."""
        settings = context.scene.refine
        method, views = settings.to_method(), chosen_views(context)
        group = splat_group.members(context.object)
        for member in group:
            edit.check_writable(member.obj)
        quality = method.name != "closed-form" or settings.budget == "psnr"
        splats = splat_group.gather(group, whole=None if quality else False)
        masks = demands.refresh(context.scene, group)  # before `origin` reads the marks
        removed, origins = masks["removed"], [plans.origin(member.obj) for member in group]

        def measure(progress: Progress) -> tuple[Scores, NDArray[np.int64], float]:
            start, first = time.perf_counter(), part(progress, 0.0, _SCORED)
            scores = score(splats, views, method, **masks, quality=quality, progress=first)
            seconds = time.perf_counter() - start
            means = splats.means if removed is None else splats.means[~removed]
            rest = part(progress, _SCORED, 1.0)
            return scores, frustum.census(means, views, progress=rest), seconds

        group, (scores, counts, seconds) = yield group, measure
        pairs = zip(views, counts.tolist(), strict=True)
        cameras = [(view.name, count) for view, count in pairs if view.weight]
        record = {"cameras": cameras, "protected": masks["protected"], "seconds": seconds}
        mesh_scores.store(group, scores, method, origins=origins, **record)
        plans.refresh(context)
        out = 0 if removed is None else int(np.count_nonzero(removed))
        unseen = int((scores.seen == 0).sum()) - out
        self.report(
            {"INFO"},
            f"Scored {len(scores.values) - out:,} splats{_of_objects(group)} by "
            f"{scores.views_used} of {counted(scores.views_given, 'view')}; "
            f"{unseen:,} lie in none",
        )
        modifiers = [note for each in group for note in splat_group.modifier_notes(each.obj)]
        drifts = [note for each in group for note in splat_group.drift_notes(each)]
        self.tell((*scoring_notes(scores), *modifiers, *drifts))


class REFINE_OT_apply(Job, bpy.types.Operator):
    """Delete the splats that the budget does not keep; Merge and Refit adapt the kept ones"""

    bl_label = "Apply"
    bl_options = {"UNDO"}
    needs = (*Job.needs, scored)
    doing = "Pruning splats"
    partial_step = REFITTING

    def invoke(self, context: Context, _event: bpy.types.Event) -> Answer:
        """Delete at once; merge and refit on a thread."""
        self.by_hand = context.scene.refine.to_method().changes
        return self.execute(context)

    def work(self, context: Context) -> Work:
        """Prune; delete removed splats, and change kept ones."""
        group = splat_group.members(context.object)
        for member in group:
            edit.check_deletable(member.obj)
        frames, form = splat_group.frames_of(group), context.scene.refine.to_form()
        reads = [splat_group.read_for_export(member) for member in group] if form else []
        arguments = apply_arguments(context, group)

        def pruned(progress: Progress) -> tuple[Result, list[splat_group.Change]]:
            sized = splat_group.sized(arguments, form, reads) if form else arguments
            result = prune(**sized, partial=True, progress=progress)
            return result, splat_group.changes(frames, result)

        group, (result, changes) = yield group, pruned
        context.view_layer.update()
        if arguments["method"].changes:  # volumes may have moved meanwhile
            splat_group.check_forced(context.scene, group, arguments)
        stored = [] if arguments["method"].changes else group  # who is not measured anew
        changed = plans.stale(*(each.obj for each in stored))
        drifts = [note for each in group for note in splat_group.drift_notes(each)]
        outcome = splat_group.apply(group, changes)
        plans.refresh(context)
        psnr = result.report["estimated_psnr"]
        reported = scoring_notes(result.scores)  # *Score* showed them
        self.tell((note for note in result.report["notes"] if note not in reported), "INFO")
        self.report(
            {"INFO"},
            f"Kept {outcome.kept:,} splats{_of_objects(group)}, removed {outcome.removed:,}: "
            + sizes_in_words(outcome.bytes_before, "->", outcome.bytes_after)
            + (f", {in_words(psnr)} in the views that scored" if psnr is not None else ""),
        )
        if changed:
            drifts.append(
                f"The scores were from before a change ({', '.join(changed)}); to have it count, "
                "undo and score again"
            )
        self.tell(drifts)


class REFINE_OT_levels(Job, bpy.types.Operator):
    """Make copies of the active object with fewer and fewer splats, hidden in a new collection"""

    bl_label = "Make Levels"
    doing = "Making levels"

    needs = (*Job.needs, in_object_mode)

    def work(self, context: Context) -> Work:
        """Make the objects, and report each level's cost."""
        group, settings = [layout.check(context.object)], context.scene.refine
        method, wanted = settings.to_method(), settings.to_levels()
        splats = splat_group.gather(group, whole=True if method.changes else None)
        masks, views = demands.Demands.of_scene(context.scene).masks(group), chosen_views(context)

        def made(progress: Progress) -> list[Level]:
            return list(lod(splats, views, wanted, method, **masks, progress=progress))

        group, levels = yield group, made
        collection = splat_group.add_levels(group[0], levels, viewing_distance(splats, views))
        counts = [
            f"{level.facts()['splats']:,}" + (f" ({in_words(level.psnr)})" if level.psnr else "")
            for level in levels
        ]
        text = f"Made '{collection.name}', hidden: {', '.join(counts)} splats"
        self.report({"INFO"}, f"{text}; show one by its eye in the Outliner")
        self.tell(wanted.notes({level.goal: level.remark for level in levels}))


class REFINE_OT_compare(Job, bpy.types.Operator):
    """Draw what the active camera sees before and after Apply, and measure the loss in dB"""

    bl_label = "Compare"
    bl_options = {"REGISTER"}
    needs = (*Job.needs, scored)
    doing = "Comparing"

    def work(self, context: Context) -> Work:
        """Draw both pictures of the active camera's view; show them, and report the PSNR."""
        view = CameraChoice("ACTIVE").views(context, context.object)[0]
        group = splat_group.members(context.object)
        arguments = apply_arguments(context, group)
        splats = arguments["splats"] or splat_group.gather(group, whole=None)
        plan = plans.stored(context.object, context.scene.refine)

        def drawn(progress: Progress) -> tuple[Comparison, float | None]:
            pruned = 0.6 if arguments["method"].changes else 0.1  # share of the time
            result = prune(**arguments, partial=True, progress=part(progress, 0.0, pruned))
            kept = result.merged.splats if result.merged else splats.take(result.keep)
            views, rest = ViewSet((replace(view, weight=1.0),)), part(progress, pruned, 1.0)
            (comparison,) = compare(splats, kept, views, progress=rest)
            return comparison, result.report["estimated_psnr"]

        _, (comparison, estimated) = yield [], drawn
        if plan is not None:
            plan["measured"] = comparison
        pixels = {kind: getattr(comparison, kind) / np.float32(255.0) for kind in KINDS}
        images = [put(f"Compare: {kind}", picture) for kind, picture in pixels.items()]
        if not bpy.app.background and context.window is not None:
            _show(context, images)
        about = "" if estimated is None else f"; {in_words(estimated)} estimated in all views"
        self.report(
            {"INFO"},
            f"{comparison.psnr:.1f} dB measured in '{comparison.view.name}'{about}. "
            f"The difference is shown {AMPLIFIED} times as large",
        )


def measured(obj: bpy.types.Object, settings: Any) -> str:
    """The measured PSNR of the current plan in words, "" without."""
    measured: Comparison | None = (plans.stored(obj, settings) or {}).get("measured")
    return f"Measured in '{measured.view.name}': {measured.psnr:.1f} dB" if measured else ""


def _show(context: Context, images: list[bpy.types.Image]) -> None:
    shown = [area.spaces.active.image for area in viewport_draw.areas(context, "IMAGE_EDITOR")]
    if all(image in shown for image in images):
        return
    bpy.ops.wm.window_new()
    window = context.window_manager.windows[-1]
    (rest,) = window.screen.areas
    for left in range(len(images), 1, -1):  # several areas of one width, left to right
        with context.temp_override(window=window, screen=window.screen, area=rest):
            bpy.ops.screen.area_split(direction="VERTICAL", factor=1.0 / left)
    _, *before_rest = window.screen.areas  # Blender adds areas at the end
    for area, image in zip([*before_rest, rest], images, strict=True):
        area.type = "IMAGE_EDITOR"
        space = area.spaces.active
        space.image = image
        space.show_region_toolbar = space.show_region_ui = False
    # Until Blender has drawn them, areas have the size from before they were split.
    bpy.app.timers.register(partial(_fit, [image.name for image in images]), first_interval=0.2)


def _fit(names: list[str]) -> None:
    """Fit images into their editors; called once by Blender's timer."""
    windows = {window.screen: window for window in bpy.context.window_manager.windows}
    for area in viewport_draw.areas(bpy.context, "IMAGE_EDITOR"):
        image, place = area.spaces.active.image, {"area": area, "region": area.regions[-1]}
        if image and image.name in names:
            with bpy.context.temp_override(window=windows[area.id_data], **place):
                bpy.ops.image.view_all(fit_view=True)
