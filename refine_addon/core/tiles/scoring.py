"""Scoring splats that no memory holds at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..scene import Scene, principal_axes
from ..score_splats import with_quality
from ..scores import Scores
from ..scoring import auto, closed_form
from ..scoring.occlusion import FIRST_END, PRIOR, OcclusionScoring
from ..work import Progress, part
from .seen import MeasuringTiles, SceneJob, StoredLines, place
from .steps import Job, Shared
from .workers import Call

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from ..scoring.occlusion import Occlusion
    from ..seeing.measuring import Measured
    from ..task import Settings
    from .units import Unit
    from .workers import Workers

SHARES: Mapping[str, tuple[float, float]] = {
    "read": (0.0, 0.24),
    "count": (0.24, 0.24),
    "sum_views": (0.24, 0.92),
    "add": (0.92, 0.95),
    "compare": (0.95, 1.0),
}
"""Step -> the part of the progress of the closed form that is its own."""

_NAMES = {"read": "reading", "count": "reading"}  # of steps; the others are "scoring"

_SMALL = 1 << 16
"""Bytes of an argument that travels with each step; larger ones lie in the folder."""


@dataclass
class _Steps:
    """Does the steps of the closed form with each unit.

    Attributes
    ----------
    job : Job
    units : sequence of Unit
    workers, progress : callable
    """

    job: Job
    units: Sequence[Unit]
    workers: Workers
    progress: Progress
    shared: int = 0

    def each(self, step: str, *arguments: Any) -> Iterator[Any]:  # noqa: ANN401 - of each step its own
        """Do a step with each unit."""
        given, total = tuple(map(self._small, arguments)), sum(map(len, self.units))
        calls = [
            Call("score", (unit, step, given), len(unit) / total, chunked=True)
            for unit in self.units
        ]
        ahead = part(self.progress, *SHARES[step])
        return self.workers(self.job, calls, ahead, _NAMES.get(step, "scoring"))

    def _small(self, argument: Any) -> Any:  # noqa: ANN401 - as given
        """Return an argument, or where it lies if it is large."""
        if not isinstance(argument, np.ndarray) or argument.nbytes <= _SMALL:
            return argument
        self.shared += 1
        name = f"shared-{self.shared}"
        self.job.folder.note(name, argument)
        return Shared(name)


def by_closed_form(
    job: Job, units: Sequence[Unit], workers: Workers, progress: Progress
) -> tuple[Scores, float]:
    """Score units by the closed form; the folder has ``values`` and ``seen`` of each afterwards.

    Parameters
    ----------
    job : Job
    units : sequence of Unit
    workers, progress : callable
        See `prune.prune_tiles`.

    Returns
    -------
    scores : Scores
        Without the values and numbers of views of any splat.
    size : float
        Of the scene.

    Raises
    ------
    RefineError, Cancelled
        See `closed_form.score`.
    """
    steps = _Steps(job, units, workers, progress)
    total = sum(map(len, units))
    with np.errstate(under="ignore"):  # as in `score_splats.score`
        found = closed_form.steps(
            steps.each, total, job.views, job.settings, remember=job.folder.once
        )
    nothing = np.empty(0)
    scores = Scores(
        nothing.astype(np.float32), nothing.astype(np.int32), len(job.views), found.undrawable,
        found.facts, method="closed-form", frustum=job.settings.frustum,
    )  # fmt: skip
    return scores, found.size


@dataclass(frozen=True, eq=False)
class Seen:
    """What views see of N splats, hidden by one another.

    Attributes
    ----------
    job : SceneJob
    sources : sequence of Unit
        The splats.
    scores : Scores
    measured : Measured
        Of all N.
    """

    job: SceneJob
    sources: Sequence[Unit]
    scores: Scores
    measured: Measured


def by_occlusion(
    job: Job,
    units: Sequence[Unit],
    settings: Settings,
    settled: int | None,
    workers: Workers,
    progress: Progress,
) -> Scores:
    """Score units by occlusion or auto: the same as in memory.

    The folder has ``values`` and ``seen`` of each unit afterwards.

    Parameters
    ----------
    job : Job
    units : sequence of Unit
    settings : Settings
    settled : int or None
        See `occlusion.score`.
    workers, progress : callable
        See `prune.prune_tiles`.

    Raises
    ------
    RefineError, Cancelled
        See `occlusion.score`.

    Notes
    -----
    Memory of this process: about 120 bytes a splat, and the hits of scoring rays, see
    `removal_rounds.RemovalRounds`. A worker needs 20 bytes a splat, and for each
    view at work what it shows: about 160 bytes a splat, and its points, see `occlusion.score`.
    """
    by_auto = settings.method == "auto"
    members = auto.groups_of(job.views) if by_auto else None
    how = settings.occlusion
    run = _Scoring(job, units, how, workers, members, part(progress, 0.0, 0.2))
    ahead = part(progress, 0.2, 0.98)
    with np.errstate(under="ignore"):
        if by_auto:
            scores = auto.finish(run, settings.tolerance, settled=settled, progress=ahead)
        else:
            scores = run.all(ahead, settled)
    return run.estimated(scores, part(progress, 0.98, 1.0))


def to_absorb(
    job: Job, units: Sequence[Unit], settings: Settings, workers: Workers, progress: Progress
) -> Seen:
    """Score units by occlusion in one round; see `by_occlusion`."""
    how = replace(settings.occlusion, rounds=1)
    run = _Scoring(job, units, how, workers, None, part(progress, 0.0, 0.2))
    with np.errstate(under="ignore"):
        scores = run.all(part(progress, 0.2, 0.98))
        measured = run.measured().for_all(run.gaussians.index, len(run.prior))
    return Seen(run.job, units, run.estimated(scores, part(progress, 0.98, 1.0)), measured)


class _Scoring(OcclusionScoring):
    """A scoring of units.

    Parameters
    ----------
    job : Job
    units : sequence of Unit
    settings : Occlusion
    workers : callable
    members : list of list of int, optional
        See `measuring.Measuring`.
    progress : callable
        Of getting ready to measure.
    """

    validation_rays: StoredLines

    def __init__(
        self,
        job: Job,
        units: Sequence[Unit],
        settings: Occlusion,
        workers: Workers,
        members: list[list[int]] | None,
        progress: Progress,
    ) -> None:
        prior = replace(job, folder=job.folder.inner("prior"), settings=PRIOR)
        _, size = by_closed_form(prior, units, workers, part(progress, 0.0, 0.5))
        values = np.concatenate(
            [prior.folder.load(unit.index, ["values"])["values"] for unit in units]
        )
        unturned = Scene(job.middle[0], size, np.eye(3))
        self.job = SceneJob(job.folder.inner("seen"), job.views, settings, unturned)
        scene = _scene(self.job, units, workers, part(progress, 0.5, 0.6))
        self.job = replace(self.job, scene=scene)
        gaussians, good = place(self.job, units, workers, part(progress, 0.6, 1.0))
        sights = StoredLines(self.job, workers, units, gaussians)
        measuring = MeasuringTiles(self.job, workers, members)
        # Those in the folder have what `OcclusionScoring` asks of Gaussians in memory.
        super().__init__(gaussians, measuring, settings.rounds, values, ~good, sights)  # type: ignore[arg-type]
        if settings.rounds > 1:
            self.scoring_rays = StoredLines(self.job, workers, units, gaussians, scoring=True)
        self._folder, self._units = job.folder, units

    def all(self, progress: Progress, settled: int | None = None) -> Scores:
        """Measure all blocks of views, and return the scores; see `occlusion.score`."""
        end = FIRST_END if self.rounds > 1 else 1.0
        self.measure(range(self.measuring.count), part(progress, 0.0, end))
        return self.rank(part(progress, end, 1.0), settled)

    def estimated(self, scores: Scores, progress: Progress) -> Scores:
        """Return scores with the curve of the estimated PSNR, and write those of each unit."""
        self.validation_rays.load()
        start = 0
        for unit in self._units:
            rows = slice(start, start + len(unit))
            arrays = {"values": scores.values[rows], "seen": scores.seen[rows]}
            self._folder.save(unit.index, arrays)
            start = rows.stop
        with np.errstate(under="ignore"):
            return with_quality(scores, progress=progress)


def _scene(seen: SceneJob, units: Sequence[Unit], workers: Workers, progress: Progress) -> Scene:
    """Return `scene.scene_of` of all units, given its origin and size."""
    calls = [Call("moments", (unit,), 1 / len(units)) for unit in units]
    total = np.zeros((4, 3))
    for found in workers(seen, calls, progress, "reading"):
        for moments in found:  # one after the other, as in memory
            total += moments
    return replace(seen.scene, axes=principal_axes(total[:3], total[3]))
