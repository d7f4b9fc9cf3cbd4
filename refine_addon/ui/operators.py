"""Operators that score and prune splat objects.

Read `REFINE_OT_apply` from `prepare` to `finish` to see what runs when *Apply* is clicked.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, NamedTuple

import bpy
import numpy as np
from numpy.typing import NDArray

from ..cameras.sets import CameraChoice
from ..core.execute import Progress, part
from ..core.lod import Level, Levels, lod, viewing_distance
from ..core.methods import Method
from ..core.prune import REFITTING, prune, score
from ..core.quality.curve import in_words
from ..core.report import scoring_notes, sizes_in_words
from ..core.result import Result
from ..core.scores import Scores
from ..core.splats import Splats
from ..core.views import ViewSet
from ..core.visibility import frustum
from ..core.volumes import Forced
from ..mesh import edit as mesh_edit
from ..mesh import scores as mesh_scores
from ..mesh.layout import SplatObject
from ..mesh.scores import Provenance
from ..objects import level_objects, splat_group, splat_object
from ..objects.demands import Demands
from ..objects.splat_object import Change, Frame
from . import plans, staleness
from .on_thread import OnThread
from .operator_bases import (
    Answer,
    OnSplats,
    in_object_mode,
    scored,
)
from .wrapped import counted

_SCORED = 0.97
"""Share of the time of a scoring after which only the splats in each view are to be counted."""


def chosen_views(context: bpy.types.Context) -> ViewSet:
    """Return the views of the cameras that the panel names."""
    return CameraChoice.of_scene(context.scene).views(context, context.object)


def apply_arguments(
    context: bpy.types.Context, group: splat_group.Members, forced: list[Forced]
) -> dict[str, Any]:
    """The arguments of `prune` for the selected objects, by the settings of the panel.

    `forced` is what must stay and what must go of each.
    """
    settings = context.scene.refine
    method = splat_object.possible(group, settings.to_method())
    views = chosen_views(context) if method.changes else None
    return splat_group.stored_arguments(group, settings.to_budget(), forced, method, views)


def _of_objects(group: splat_group.Members) -> str:
    """Return how many objects were worked on, if more than one."""
    return f" of {len(group)} objects" if len(group) > 1 else ""


@dataclass(frozen=True, eq=False)
class _Scoring:
    """What is to be scored, by which views and how; where all of it stood (`staleness.origin`)."""

    splats: Splats
    forced: Forced
    views: ViewSet
    method: Method
    quality: bool
    uids: tuple[int, ...]
    origins: list[dict[str, Any]]


class _Scored(NamedTuple):
    """Scores, how many splats lie in each view, (V,), and how many seconds scoring took."""

    scores: Scores
    counts: NDArray[np.int64]
    seconds: float


class REFINE_OT_score(OnThread, OnSplats, bpy.types.Operator):
    """Score each splat by how much the cameras would miss it (Esc cancels)"""

    bl_idname = "refine.score"
    bl_label = "Score"
    bl_options = {"REGISTER", "UNDO"}
    doing = "Scoring splats"

    def prepare(self, context: bpy.types.Context, checked: SplatObject) -> _Scoring:
        """Gather splats, views and settings."""
        method, views = context.scene.refine.to_method(), chosen_views(context)
        group = splat_group.members(context.view_layer, checked)
        for member in group:
            mesh_edit.check_writable(member.obj)
        quality = method.name != "closed-form" or context.scene.refine.budget == "psnr"
        splats = splat_group.gather(group, whole=None if quality else False)
        origins = [staleness.origin(context, member.obj) for member in group]
        forced = splat_group.joined_forced(splat_group.forced_of_each(context.scene, group), group)
        uids = splat_group.uids_of(group)
        return _Scoring(splats, forced, views, method, quality, uids, origins)

    def written(self, context: bpy.types.Context, checked: SplatObject | None) -> list[SplatObject]:
        """Return the objects that are scored, the active one first."""
        return splat_group.active_first(context.view_layer, checked)

    @staticmethod
    def work(job: _Scoring, progress: Progress) -> _Scored:
        """Score, and count how many splats lie in each view."""
        removed, means, start = job.forced.removed, job.splats.means, time.perf_counter()
        scores = score(
            job.splats, job.views, job.method,
            protected=job.forced.protected, removed=removed,
            quality=job.quality, progress=part(progress, 0.0, _SCORED),
        )  # fmt: skip
        seconds = time.perf_counter() - start
        means = means if removed is None else means[~removed]
        counts = frustum.census(means, job.views, progress=part(progress, _SCORED, 1.0))
        return _Scored(scores, counts, seconds)

    def finish(
        self,
        context: bpy.types.Context,
        checked: SplatObject,
        job: _Scoring,
        result: _Scored,
    ) -> Answer:
        """Store the scores on the meshes and say what came of it."""
        scores = result.scores
        pairs = zip(job.views, result.counts.tolist(), strict=True)
        cameras = [(view.name, count) for view, count in pairs if view.weight]
        group = splat_group.by_uids(job.uids, checked)
        provenance = Provenance(
            job.method, cameras=cameras, protected=job.forced.protected, seconds=result.seconds
        )
        splat_group.store(group, scores, provenance, job.origins)
        plans.refresh(context)
        self.report(
            {"INFO"}, _scored_in_words(group, scores, job.forced.counts()["removed_by_user"])
        )
        modifiers = [note for each in group for note in splat_object.modifier_notes(each.obj)]
        drifts = [note for each in group for note in splat_object.drift_notes(each)]
        for note in (*scoring_notes(scores), *modifiers, *drifts):
            self.report({"WARNING"}, note)
        return {"FINISHED"}


def _scored_in_words(group: splat_group.Members, scores: Scores, removed: int) -> str:
    """Return how many splats were scored by how many views, and how many of them these miss."""
    unseen = int((scores.seen == 0).sum()) - removed
    return (
        f"Scored {len(scores.values) - removed:,} splats{_of_objects(group)} by "
        f"{scores.views_used} of {counted(scores.views_given, 'view')}; {unseen:,} lie in none"
    )


@dataclass(frozen=True, eq=False)
class _Applying:
    """What is to be decided, of which objects, and what must stay and go of each."""

    arguments: dict[str, Any]
    uids: tuple[int, ...]
    forced: list[Forced]
    frames: list[Frame]
    counts: list[int]


class _Applied(NamedTuple):
    """What was decided of all objects, and what is to become of each."""

    result: Result
    changes: list[Change]

    @property
    def stopped(self) -> BaseException | None:
        """By what it was ended early, if it was; see `OnThread.offers`."""
        return self.result.stopped


def _scored_or_applied(context: bpy.types.Context) -> str:
    """Return that scores are needed, "" if there are any.

    Also where they led to an *Apply*: to adjust that, Blender asks before it undoes it.
    """
    return "" if mesh_scores.RANK in context.object.data.attributes else scored(context)


class REFINE_OT_apply(OnThread, OnSplats, bpy.types.Operator):
    """Delete the splats that the budget does not keep; the others make up for them, if they may"""

    bl_idname = "refine.apply"
    bl_label = "Apply"
    bl_options = {"REGISTER", "UNDO"}
    doing = "Pruning splats"
    offers = REFITTING

    needs = (*OnSplats.needs, _scored_or_applied)

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Answer:
        """Delete at once; merge and refit on a thread."""
        changes = context.scene.refine.to_method().changes
        return super().invoke(context, event) if changes else self.execute(context)

    def prepare(self, context: bpy.types.Context, checked: SplatObject) -> _Applying:
        """Gather the scores that decide; if kept splats change, splats and views besides."""
        group = splat_group.members(context.view_layer, checked)
        for member in group:
            mesh_edit.check_deletable(member.obj)
        forced = splat_group.forced_of_each(context.scene, group)
        counts = [len(member) for member in group]
        arguments = apply_arguments(context, group, forced)
        uids, frames = splat_group.uids_of(group), splat_group.frames_of(group)
        return _Applying(arguments, uids, forced, frames, counts)

    def written(self, context: bpy.types.Context, checked: SplatObject | None) -> list[SplatObject]:
        """Return the objects that lose splats, the active one first."""
        return splat_group.active_first(context.view_layer, checked)

    @staticmethod
    def work(job: _Applying, progress: Progress) -> _Applied:
        """Decide which splats stay, and what they become."""
        result = prune(**job.arguments, partial=True, progress=progress)
        return _Applied(result, splat_group.changes(job.frames, job.counts, result))

    def finish(
        self, context: bpy.types.Context, checked: SplatObject, job: _Applying, applied: _Applied
    ) -> Answer:
        """Delete what does not stay, and change what does."""
        result = applied.result
        context.view_layer.update()
        group = splat_group.by_uids(job.uids, checked)
        if job.arguments["method"].changes:  # on a thread, while volumes can be moved
            splat_group.check_forced(context.scene, group, job.forced)
        decided = job.arguments["budget"].needs_scores or not result.merged  # by the scores
        changed = _changes_since_scoring(context, group, job) if decided else []
        drifts = [note for each in group for note in splat_object.drift_notes(each)]
        outcome = splat_group.apply(group, applied.changes)
        for member in group:
            plans.forget(member.mesh)
        plans.refresh(context)
        psnr = result.report["estimated_psnr"]
        known = scoring_notes(result.scores)  # said when they were scored
        for note in result.report["notes"]:
            if note not in known:
                self.report({"INFO"}, note)
        self.report(
            {"INFO"},
            f"Kept {outcome.kept:,} splats{_of_objects(group)}, removed {outcome.removed:,}: "
            + sizes_in_words(outcome.bytes_before, "->", outcome.bytes_after)
            + (f", {in_words(psnr)} in the views that scored" if psnr is not None else ""),
        )
        for note in drifts:
            self.report({"WARNING"}, note)
        if changed:
            self.report(
                {"WARNING"},
                f"The scores were from before a change ({', '.join(changed)}); undo and "
                "score again if it is to count",
            )
        return {"FINISHED"}


def _changes_since_scoring(
    context: bpy.types.Context, group: splat_group.Members, job: _Applying
) -> list[str]:
    """Return what changed since the objects were scored, in a few words each."""
    protected = splat_group.parts_of(job.arguments["protected"], group)
    pairs = zip((member.obj for member in group), protected, strict=True)
    return staleness.changes_of(context, dict(pairs))


@dataclass(frozen=True, eq=False)
class _MakingLevels:
    """What levels are to be made of, by which views and how; what must stay and go."""

    splats: Splats
    views: ViewSet
    levels: Levels
    method: Method
    forced: Forced


class REFINE_OT_levels(OnThread, OnSplats, bpy.types.Operator):
    """Make objects with fewer and fewer splats, by what the cameras see, in a new collection"""

    bl_idname = "refine.levels"
    bl_label = "Make Levels"
    bl_options = {"REGISTER", "UNDO"}
    doing = "Making levels"

    needs = (*OnSplats.needs, in_object_mode)

    def prepare(self, context: bpy.types.Context, checked: SplatObject) -> _MakingLevels:
        """Gather splats, views and settings."""
        settings = context.scene.refine
        levels = settings.to_levels()
        return _MakingLevels(
            splat_object.gather(checked, whole=True if settings.to_method().changes else None),
            chosen_views(context),
            levels,
            settings.to_method(),
            Demands.of_scene(context.scene).forced(checked),
        )

    @staticmethod
    def work(job: _MakingLevels, progress: Progress) -> list[Level]:
        """Make the levels."""
        return list(
            lod(
                job.splats, job.views, job.levels, job.method,
                protected=job.forced.protected, removed=job.forced.removed, progress=progress,
            )
        )  # fmt: skip

    def finish(
        self,
        _context: bpy.types.Context,
        checked: SplatObject,
        job: _MakingLevels,
        levels: list[Level],
    ) -> Answer:
        """Make the objects and say what each level costs."""
        distance = viewing_distance(job.splats, job.views)
        collection = level_objects.add_levels(checked, levels, distance)
        counts = [
            f"{level.facts()['splats']:,}" + (f" ({in_words(level.psnr)})" if level.psnr else "")
            for level in levels
        ]
        told = f"'{collection.name}', hidden: {', '.join(counts)} splats"
        self.report({"INFO"}, f"{told}; show one by its eye in the Outliner")
        for note in job.levels.notes({level.asked: level.remark for level in levels}):
            self.report({"WARNING"}, note)
        return {"FINISHED"}


CLASSES = (REFINE_OT_score, REFINE_OT_apply, REFINE_OT_levels)
