"""Scoring splats that no memory holds at once."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..scene import Scene, principal_axes
from ..scoring import closed_form, coverage
from ..scoring.occlusion import FIRST_END, PRIOR, Rounds, combined, exponent
from ..work import Progress, part
from .seen import MeasuringTiles, SceneJob, place
from .steps import Job, Shared
from .workers import Call

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    from ..scores import Scores
    from ..scoring.measuring import Measured
    from ..scoring.occlusion import Occlusion
    from .folder import Folder
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

    def remember(self, name: str, make: Callable[[], Any]) -> Any:  # noqa: ANN401 - as made
        """Return what was made of the name, even by a run before this one."""
        done, found = self.job.folder.noted(name)
        if not done:
            found = make()
            self.job.folder.note(name, found)
        return found


def by_closed_form(
    job: Job, units: Sequence[Unit], workers: Workers, progress: Progress
) -> closed_form.Found:
    """Score units by the closed form; the folder has ``values`` and ``seen`` of each afterwards.

    Parameters
    ----------
    job : Job
    units : sequence of Unit
    workers, progress : callable
        See `prune.prune_tiles`.

    Raises
    ------
    RefineError, Cancelled
        See `closed_form.score`.
    """
    steps = _Steps(job, units, workers, progress)
    total = sum(map(len, units))
    with np.errstate(under="ignore"):  # as in `pipeline.score`
        return closed_form.steps(
            steps.each, total, job.views, job.settings, remember=steps.remember
        )


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
    prior : (N,) float32
        See `occlusion.Rounds`.
    """

    job: SceneJob
    sources: Sequence[Unit]
    scores: Scores
    measured: Measured
    prior: NDArray[np.float32]

    def worth(self, now: Measured, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return what n splats are worth, (n,), as occlusion ranks them.

        Parameters
        ----------
        now : Measured
            Of these splats, as they are by now.
        rows : (n,) int64
            Which of the N they were.
        """
        prior, seen = self.prior[rows].astype(np.float64), self.measured.seen[rows]
        weight = self.scores.facts["floor"][len(coverage.SHARES) // 2]
        with np.errstate(under="ignore"):
            floors = coverage.floor(prior, seen, 1.0 + exponent(0.0))
            return coverage.with_floor(combined(now, 0.0), floors, weight)


def by_occlusion(
    job: Job,
    units: Sequence[Unit],
    settings: Occlusion,
    workers: Workers,
    progress: Progress,
) -> Seen:
    """Score units by occlusion; the same as in memory, but that nothing is estimated.

    The folder has ``values`` and ``seen`` of each unit afterwards.

    Parameters
    ----------
    job : Job
    units : sequence of Unit
    settings : Occlusion
    workers, progress : callable
        See `prune.prune_tiles`.

    Raises
    ------
    RefineError, Cancelled
        See `occlusion.score`.

    Notes
    -----
    Memory of this process: about 120 bytes a splat. A worker needs 20 bytes a splat, and for each
    view at work what it shows: about 160 bytes a splat, and its points, see `occlusion.score`.
    """
    prior = replace(job, folder=job.folder.inner("prior"), settings=PRIOR)
    found = by_closed_form(prior, units, workers, part(progress, 0.0, 0.1))
    values = _all_of(prior.folder, units, "values")
    unturned = Scene(job.middle[0], found.size, np.eye(3))
    seen = SceneJob(job.folder.inner("seen"), job.views, settings, unturned)
    scene = _scene(seen, units, workers, part(progress, 0.1, 0.12))
    seen = replace(seen, scene=scene)
    gaussians, good = place(seen, units, workers, part(progress, 0.12, 0.2))
    # It stands for Gaussians in memory: it has what `Rounds` asks of them.
    run = Rounds(gaussians, MeasuringTiles(seen, workers), settings.rounds, values, ~good)  # type: ignore[arg-type]
    end = 0.2 + 0.8 * FIRST_END if settings.rounds > 1 else 1.0
    with np.errstate(under="ignore"):
        measured = run.measure(range(run.measuring.count), part(progress, 0.2, end))
        scores = run.rank(part(progress, end, 1.0))
    start = 0
    for unit in units:
        rows = slice(start, start + len(unit))
        job.folder.save(unit.index, {"values": scores.values[rows], "seen": scores.seen[rows]})
        start = rows.stop
    every = measured.for_all(gaussians.index, len(values))
    return Seen(seen, units, scores, every, values)


def _all_of(folder: Folder, units: Sequence[Unit], name: str) -> NDArray[Any]:
    """Return an array of all units, (N,)."""
    return np.concatenate([folder.load(unit.index, [name])[name] for unit in units])


def _scene(seen: SceneJob, units: Sequence[Unit], workers: Workers, progress: Progress) -> Scene:
    """Return `scene.scene_of` of all units, given its origin and size."""
    calls = [Call("moments", (unit,), 1 / len(units)) for unit in units]
    total = np.zeros((4, 3))
    for found in workers(seen, calls, progress, "reading"):
        for moments in found:  # one after the other, as in memory
            total += moments
    return replace(seen.scene, axes=principal_axes(total[:3], total[3]))
