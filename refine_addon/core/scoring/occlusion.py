"""Scores that take into account what hides what, computed without a renderer.

    score_i = error_i  contribution_i^p,   p = 1/4 + 1/2 (share removed before)

`measuring` defines the error and the contribution. The error is exact for one splat that is removed
while all others stay. The contribution also counts what the splat hides, which matters once its
neighbours are removed too. From half removed on, the product ranks better than the error alone.

A floor is added to every score, for views that were not given: the closed form, with a weight that
rises with the share removed (`coverage`).

Splats hide each other, so they are removed in rounds: a part of the splats goes, the rest is scored
again, until a tenth is left. The result is one order of removal, so a larger budget also removes
all that a smaller one does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..errors import RefineError
from ..scores import Scores, shares_gone
from ..work import Progress, part, report, silent
from . import closed_form, coverage, projection
from .measuring import Measured, Measuring, Sampling

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from ..splats import Splats
    from ..views import ViewSet
    from .projection import Gaussians

LEAST = 0.1
"""Share of the splats that is left when scores are computed for the last time."""

PRIOR = closed_form.ClosedForm("distance", frustum=False, local=False)
"""Model of the floor. It has no frustum test, since splats that no view shows also need a floor."""


@dataclass(frozen=True)
class Occlusion(Sampling):
    """Settings of the occlusion method; the default ranks the same whatever the scene's unit.

    Attributes
    ----------
    cell, density : float
        See `measuring.Sampling`.
    rounds : int
        How often scores are computed: once, or again after each part of the removal.
    """

    rounds: int = 6

    def __post_init__(self) -> None:
        """Check the values.

        Raises
        ------
        RefineError
            If a value is out of range.
        """
        super().__post_init__()
        if self.rounds < 1:
            msg = f"rounds is {self.rounds}, expected 1 or more"
            raise RefineError(msg)


def score(
    splats: Splats,
    views: ViewSet,
    settings: Occlusion = Occlusion(),
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> Scores:
    """Score splats by how much the views would change without them, occlusion included.

    Parameters
    ----------
    splats : Splats
        In the frame and unit of the views.
    views : ViewSet
        All of them are used.
    settings : Occlusion
    progress : callable, optional
        See `refine_addon.core.work.Progress`.
    threads : int, optional

    Returns
    -------
    Scores
        ``values`` is the share of the splats that have been removed once this one is, in (0, 1].

    Raises
    ------
    RefineError
        If there are no splats, if none of them can be drawn, or if no view sees any.
    Cancelled
        If `progress` answers ``False``.

    Notes
    -----
    Memory: about 300 bytes a splat, plus a third of that for each thread beyond the first; and 100
    bytes for each point of a view, per thread. A view has at most about 4 million points
    (`froxels.MAX_POINTS`); only a view that shows more than 3 million splats has more.
    """
    return _scored(splats, views, settings, progress, threads)[0]


def score_once(
    splats: Splats,
    views: ViewSet,
    settings: Occlusion = Occlusion(),
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> tuple[Scores, Measured]:
    """Score splats in one round; also return what was measured of all N.

    Parameters
    ----------
    splats, views, settings, progress, threads
        See `score`; `settings.rounds` is ignored.

    Returns
    -------
    Scores, Measured

    Raises
    ------
    RefineError, Cancelled
        See `score`.
    """
    scores, run = _scored(splats, views, replace(settings, rounds=1), progress, threads)
    return scores, run.measured.for_all(run.gaussians.index, len(splats))


def _scored(
    splats: Splats,
    views: ViewSet,
    settings: Occlusion,
    progress: Progress,
    threads: int | None,
) -> tuple[Scores, _Run]:
    if not len(splats):
        msg = "there are no splats to score"
        raise RefineError(msg)
    gaussians, scene, good = projection.prepare(
        splats, views, progress=part(progress, 0.0, 0.05), threads=threads
    )
    if not good.any():
        msg = f"none of the {len(splats)} splats can be drawn: each is transparent or not finite"
        raise RefineError(msg)
    run = _Run(gaussians, Measuring(scene, views, settings, threads), settings.rounds)
    prior = closed_form.score(
        splats, views, PRIOR, progress=part(progress, 0.05, 0.1), threads=threads
    )
    values, seen = run.rank(prior.values, part(progress, 0.1, 1.0))
    if not run.measured.contribution.any():
        msg = (
            f"no camera sees the splats: none of {len(splats)} reaches into the image of any of "
            f"{len(views)} views; check that cameras and splats share their frame and unit"
        )
        raise RefineError(msg)
    values[~good] = 0.0
    scores = Scores(
        values=values,
        seen=seen,
        views_used=len(views),
        undrawable=int(np.count_nonzero(~good)),
        facts={"floor": run.floor_weights},
        method="occlusion",
    )
    return scores, run


def measure(
    splats: Splats,
    views: ViewSet,
    settings: Occlusion = Occlusion(),
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> Measured:
    """Measure what the views see of each splat, hidden by all others.

    Parameters
    ----------
    splats, views, settings, progress, threads
        See `score`; `settings.rounds` is ignored.

    Returns
    -------
    Measured
        Of all N splats; 0 for splats that no view shows or that cannot be drawn.

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """
    gaussians, scene, _ = projection.prepare(
        splats, views, progress=part(progress, 0.0, 0.1), threads=threads
    )
    measuring = Measuring(scene, views, settings, threads)
    found = measuring.measure(gaussians, part(progress, 0.1, 1.0))
    return found.for_all(gaussians.index, len(splats))


class _Run:
    """One scoring: rounds of measuring and removing.

    Attributes
    ----------
    gaussians : Gaussians
        The splats that can contribute to a picture, before any is removed.
    measured : Measured
        Of these Gaussians, in the first round.
    floor_weights : list of float
        The weight of the floor up to each of `coverage.SHARES`; chosen in the first round.
    """

    def __init__(self, gaussians: Gaussians, measuring: Measuring, rounds: int) -> None:
        self.gaussians, self.measuring, self.rounds = gaussians, measuring, rounds
        self.measured = Measured.zero(len(gaussians))
        self.floor_weights = [0.0] * len(coverage.SHARES)

    def rank(
        self, prior: NDArray[np.float32], progress: Progress
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Return the values and `seen` of all N splats.

        Parameters
        ----------
        prior : (N,) float32
            Orders the splats that are not among the Gaussians, and is the floor of all others.
        progress : callable
        """
        count, left = len(prior), self.gaussians
        removal = _Removal(count)
        undrawn = np.setdiff1d(np.arange(count), left.index)
        removal.add(undrawn[np.argsort(prior[undrawn], kind="stable")])
        seen, done = np.zeros(count, np.int32), 0.0
        for number, stay in enumerate(_survivors(count, self.rounds)):
            # A round costs views x splats left. All six rounds cost about three first rounds.
            end = done + (1.0 - done) * max(1.0 / (self.rounds - number), 0.25)
            ahead, done = part(progress, done, end), end
            if number == 0:
                measured = self.measured = self._measure_first(prior, ahead)
                seen[left.index] = measured.seen
            else:
                measured = self.measuring.measure(left, ahead)
            report(ahead, 1.0, "scoring")
            go = max(len(left) - stay, 0)
            order = self._order(measured, prior[left.index], removal, go)
            removal.add(left.index[order[:go]])
            left = left.take(np.sort(order[go:]))
        return removal.values, seen

    def _order(
        self, measured: Measured, prior: NDArray[np.float32], removal: _Removal, go: int
    ) -> NDArray[np.int64]:
        """Return the rows of the n splats left, in the order of removal.

        Parameters
        ----------
        measured : Measured
            Of the splats left.
        prior : (n,) float32
            Of the splats left.
        removal : _Removal
            What was removed before.
        go : int
            How many are removed in this round; the order of the others is not exact.
        """
        count, gone = len(removal.values), removal.gone
        share = gone / count
        floors = coverage.floor(prior.astype(np.float64), measured.seen, 1.0 + _exponent(share))
        # How many of these splats have been removed when each of the shares is reached.
        stops = np.clip(np.rint(np.multiply(coverage.SHARES, count)) - gone, 0, go).astype(int)
        stops[-1] = go
        scores = combined(measured, share)
        return coverage.order(scores, floors, prior, self.floor_weights, stops)

    def _measure_first(self, prior: NDArray[np.float32], progress: Progress) -> Measured:
        """Measure all Gaussians, and choose the weights of the floor by leaving views out."""
        sample = coverage.sample(self.gaussians)  # (m,)
        blocks = self.measuring.blocks(self.gaussians, sample, progress)
        measured = Measured.sum([block for block, _ in blocks])
        worth = prior[self.gaussians.index[sample]].astype(np.float64)  # (m,)

        def folds() -> Iterator[tuple[NDArray[np.float64], ...]]:
            for block, errors in blocks if len(blocks) > 1 else ():
                report(progress, 1.0, "scoring")
                others = Measured(
                    # Rounding can leave a negative difference.
                    np.maximum(measured.contribution[sample] - block.contribution[sample], 0.0),
                    np.maximum(measured.error[sample] - block.error[sample], 0.0),
                    measured.seen[sample] - block.seen[sample],
                )
                floors = coverage.floor(worth, others.seen, 1.0 + _exponent(0.0))
                yield combined(others, 0.0), floors, errors

        self.floor_weights = coverage.floor_weights(folds())
        return measured


class _Removal:
    """The order in which splats are removed.

    Attributes
    ----------
    values : (N,) float32
        For each splat that was added: the share of all N removed once this one is.
    gone : int
        How many were added.
    """

    def __init__(self, count: int) -> None:
        self.values = np.zeros(count, np.float32)
        self.gone = 0

    def add(self, splats: NDArray[np.int64]) -> None:
        """Append splats, the first to be removed first."""
        end = self.gone + len(splats)
        self.values[splats] = shares_gone(np.arange(self.gone + 1, end + 1), len(self.values))
        self.gone = end


def _survivors(count: int, rounds: int) -> list[int]:
    """Return how many of `count` splats stay after each round: `LEAST` before the last, then 0."""
    return [round(count * LEAST ** (number / (rounds - 1))) for number in range(1, rounds)] + [0]


def combined(measured: Measured, gone: float) -> NDArray[np.float64]:
    """Return ``error contribution^p``, (M,); p rises with the share `gone` that went before.

    The error is exact for one splat. The more of its neighbours go too, the more it matters how
    much of the picture the splat covers, whatever lies behind it.
    """
    return np.asarray(measured.error * measured.contribution ** _exponent(gone))


def _exponent(gone: float) -> float:
    return 0.25 + 0.5 * gone
