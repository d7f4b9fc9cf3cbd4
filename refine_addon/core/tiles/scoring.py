"""Scoring splats that no memory holds at once by occlusion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from .. import costs
from ..execute import Progress
from ..pace import phases
from ..pipeline.score_splats import with_quality
from ..scores import Scores
from ..scoring.occlusion import PRIOR, Occlusion, OcclusionScoring, survivors_of_rounds
from ..task import Settings
from ..visibility.measuring import Measured
from ..visibility.scene import Scene, principal_axes
from .closed_form import ClosedFormContext, by_closed_form
from .gaussians import SceneContext, SumMoments, store_gaussians
from .seeing import StoredRays, TileMeasuring
from .units import Unit
from .workers import Runner


@dataclass(frozen=True, eq=False)
class MeasuredTiles:
    """What views see of all splats, hidden by one another, and their validation rays."""

    context: SceneContext
    units: Sequence[Unit]
    scores: Scores
    measured: Measured
    rays: StoredRays


def by_occlusion(
    closed_form: ClosedFormContext,
    units: Sequence[Unit],
    settings: Settings,
    settled: int | None,
    runners: Sequence[Runner],
) -> Scores:
    """Score units by occlusion: the same as in memory.

    The folder has ``values`` and ``seen`` of each unit afterwards.

    Parameters
    ----------
    closed_form : ClosedFormContext
        For the prior; its folder is that of the job.
    units : sequence of Unit
    settings : Settings
    settled : int or None
        See `occlusion.score`.
    runners : sequence of Runner
        They get the splats ready, score them, and save the scores.

    Raises
    ------
    RefineError, Cancelled
        See `occlusion.score`.

    Notes
    -----
    Memory of this process: about 120 bytes a splat, and the hits of scoring rays, see
    `removal_rounds.RemovalRounds`. A worker needs 20 bytes a splat, and for each view at work about
    160 bytes for each splat that it shows, and its points, see `occlusion.score`.
    """
    preparing, progress, saving = runners[0], runners[1].progress, runners[2].progress
    scoring = _TileScoring(closed_form, units, settings.occlusion, preparing)
    with np.errstate(under="ignore"):
        scores = scoring.finish(progress, settled)
    return scoring.save(scores, saving)


def measured_once(
    closed_form: ClosedFormContext,
    units: Sequence[Unit],
    settings: Settings,
    runners: Sequence[Runner],
) -> MeasuredTiles:
    """Score units by occlusion in one round; parameters as `by_occlusion`."""
    how = replace(settings.occlusion, rounds=1)
    scoring = _TileScoring(closed_form, units, how, runners[0])
    with np.errstate(under="ignore"):
        scores = scoring.finish(runners[1].progress)
        measured = scoring.measured().for_all(scoring.gaussians.index, len(scoring.prior))
    scores = scoring.save(scores, runners[2].progress)
    return MeasuredTiles(scoring.context, units, scores, measured, scoring.validation_rays)


class _TileScoring(OcclusionScoring):
    """A scoring of units, made ready by the runner; `closed_form` has the folder of the job."""

    validation_rays: StoredRays

    def __init__(
        self,
        closed_form: ClosedFormContext,
        units: Sequence[Unit],
        settings: Occlusion,
        runner: Runner,
    ) -> None:
        self._job, self._units = closed_form.folder, units
        prior = replace(closed_form, folder=self._job.inner("prior"), settings=PRIOR)
        plans = costs.preparing(sum(map(len, units)), len(prior.views))
        by_prior, activating = runner.phases(*reversed(plans))
        _, size = by_closed_form(prior, units, by_prior)
        values = prior.folder.joined((unit.index for unit in units), "values")
        unturned = Scene(prior.middle[0], size, np.eye(3))
        context = SceneContext(self._job.inner("seen"), prior.views, settings, unturned)
        context = replace(context, scene=_turned(context, units, activating.part(0.0, 0.2)))
        self.context = context
        gaussians, good = store_gaussians(context, units, activating.part(0.2, 1.0))
        # They have what `OcclusionScoring` asks of Gaussians in memory.
        super().__init__(
            gaussians,  # type: ignore[arg-type]
            TileMeasuring(context, runner),
            settings.rounds,
            values,
            ~good,
            StoredRays(context, runner, units, gaussians),
        )
        if settings.rounds > 1:
            self.scoring_rays = StoredRays(context, runner, units, gaussians, scoring=True)

    def finish(self, progress: Progress, settled: int | None = None) -> Scores:
        """Measure all groups of views, and return the scores; see `occlusion.score`."""
        count, stays = len(self.prior), survivors_of_rounds(len(self.prior), self.rounds, settled)
        images = costs.Images.of(view for view, _ in self.measuring.views)
        _, *plans = costs.occlusion(count, images, stays)
        measuring, ranking = phases(progress, *plans)
        self.measure(range(self.measuring.count), measuring)
        return self.rank(ranking, settled)

    def save(self, scores: Scores, progress: Progress) -> Scores:
        """Save the scores of each unit; return them with the curve of the estimated PSNR."""
        self.validation_rays.load()
        start = 0
        for unit in self._units:
            rows = slice(start, start + len(unit))
            arrays = {"values": scores.values[rows], "seen": scores.seen[rows]}
            self._job.save(unit.index, arrays)
            start = rows.stop
        with np.errstate(under="ignore"):
            return with_quality(scores, progress=progress)


def _turned(context: SceneContext, units: Sequence[Unit], runner: Runner) -> Scene:
    """Return `scene.scene_of` of all units, given its origin and size."""
    steps, total = [SumMoments(unit) for unit in units], np.zeros((4, 3))
    for pieces in runner.run(context, steps, "reading"):
        for moments in pieces:  # one after the other, as in memory
            total += moments
    return replace(context.scene, axes=principal_axes(total))
