"""Scores that know what hides what, without a renderer: the froxel tier.

    contribution_i = sum over views of  integral of alpha_i  x  mean T        MesonGS, LightGaussian
    contrast_i     = sum over views of  integral of alpha_i^2  x  mean of T^2 |c_i - B_i|^2
    score_i        = contrast_i  contribution_i^p,   p = 1/4 + 1/2 (share removed before)

T, the transmittance in front of a splat, and B, the colour behind it, come from `froxels`. The
contrast is the squared error of the picture without the splat, what REFINE's Hessian stands for;
it is true for one splat removed among many that stay. The contribution also knows what the splat
hides once its neighbours are gone; the product is the better order from half removed on.

A floor under it, the closed form, keeps what these views do not show and others may, the more the
more splats go: `coverage`.

Splats are not independent, so the order of removal is found in rounds: part of the budget goes,
the scores of the survivors are computed anew, and so on to the last tenth. Budgets stay nested.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..errors import RefineError
from ..scores import Scores, shares_gone
from ..work import Progress, for_chunks, part, report, silent
from . import closed_form, coverage, froxels, projection

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from ..scene import Scene
    from ..splats import Splats
    from ..views import View, ViewSet
    from .projection import Gaussians

LEAST = 0.1
"""Share of the splats that is left when scores are computed for the last time."""

PRIOR = closed_form.ClosedForm("distance", frustum=False)
"""What is known of splats that no view shows: without a frustum, for they may lie in none."""

_BLOCKS = 8  # of views; sums are added up block by block, so that threads do not matter


@dataclass(frozen=True)
class Occlusion:
    """Settings of the occlusion method; the default ranks the same whatever the scene's unit.

    Attributes
    ----------
    cell : float
        Side of a cell, pixels; more where an image has more than 65,535 of them.
    density : float
        How finely a splat is sampled: points per standard deviation that is as long as a cell.
    rounds : int
        How often scores are computed: once, or anew after each part of the removal.
    """

    cell: float = 4.0
    density: float = 4.5
    rounds: int = 6

    def __post_init__(self) -> None:
        """Check the values.

        Raises
        ------
        RefineError
            If one cannot be.
        """
        for name in ("cell", "density"):
            value = getattr(self, name)
            if not 0.0 < value < np.inf:
                msg = f"{name} is {value}, expected a positive number"
                raise RefineError(msg)
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
    """Score splats by what the views would miss, given what hides them.

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
        ``values`` is the share of the splats that have gone once this one goes, in (0, 1].

    Raises
    ------
    RefineError
        If there is no splat, none can be drawn, or no view sees any.
    Cancelled
        If `progress` answers ``False``.

    Notes
    -----
    Memory: about 300 bytes a splat, a third more for each thread beyond the first; where a view
    has many points, 100 bytes for each of them and thread. A view has about 4 million points at
    most (`froxels.MAX_POINTS`), and more only where it shows more than 3 million splats.
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
    """Score splats in one round; return also what was measured of all N.

    Parameters
    ----------
    splats, views, settings, progress, threads
        See `score`; the rounds do not matter.

    Returns
    -------
    Scores, Measured

    Raises
    ------
    RefineError, Cancelled
        See `score`.
    """
    scores, run = _scored(splats, views, replace(settings, rounds=1), progress, threads)
    return scores, run.measured.spread(run.gaussians.index, len(splats))


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
    run = _Run(gaussians, scene, views, settings, threads)
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
        weights={"floor": run.floor_weights},
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
    """Measure once what the views see of each splat, hidden by all others.

    Parameters
    ----------
    splats, views, settings, progress, threads
        See `score`; the rounds do not matter.

    Returns
    -------
    Measured
        Of all N splats: zero of those that no view shows or no renderer draws.

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """
    gaussians, scene, _ = projection.prepare(
        splats, views, progress=part(progress, 0.0, 0.1), threads=threads
    )
    run = _Run(gaussians, scene, views, settings, threads)
    some = run.measure(gaussians, part(progress, 0.1, 1.0))
    return some.spread(gaussians.index, len(splats))


class _Run:
    """One scoring: the scene as Gaussians, and what the first round measured."""

    def __init__(
        self,
        gaussians: Gaussians,
        scene: Scene,
        views: ViewSet,
        settings: Occlusion,
        threads: int | None,
    ) -> None:
        self.gaussians, self.scene, self.settings, self.threads = (
            gaussians,
            scene,
            settings,
            threads,
        )
        self.measured = Measured.zero(len(gaussians))  # in the first round
        self.floor_weights = [0.0] * len(coverage.SHARES)  # up to each share
        self.views = _by_distance(views)

    def rank(
        self, prior: NDArray[np.float32], progress: Progress
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Return the values and `seen` of all splats; `prior` decides where the views do not."""
        count, left = len(prior), self.gaussians
        removal = _Removal(count)
        undrawn = np.setdiff1d(np.arange(count), left.index)
        removal.add(undrawn[np.argsort(prior[undrawn], kind="stable")])
        seen, done = np.zeros(count, np.int32), 0.0
        for number, stay in enumerate(_survivors(count, self.settings.rounds)):
            # A round costs the views times the splats left: all of them about three first rounds.
            end = done + (1.0 - done) * max(1.0 / (self.settings.rounds - number), 0.25)
            ahead, done = part(progress, done, end), end
            if number == 0:
                measured = self.measured = self._measure_first(prior, ahead)
                seen[left.index] = measured.seen
            else:
                measured = self.measure(left, ahead)
            report(ahead, 1.0, "scoring")
            go = max(len(left) - stay, 0)
            order = self._order(measured, prior[left.index], removal.gone, count, go)
            removal.add(left.index[order[:go]])
            left = left.take(np.sort(order[go:]))
        return removal.values, seen

    def _order(
        self,
        measured: Measured,
        prior: NDArray[np.float32],
        gone: int,
        count: int,
        go: int,
    ) -> NDArray[np.int64]:
        """Return the rows of those left in the order of removal, exact for the first `go`.

        Parameters
        ----------
        measured : Measured
        prior : (n,) float32
            Of those left.
        gone, count : int
            How many splats of how many have gone before.
        go : int
            How many go now.
        """
        share = gone / count
        floors = coverage.floor(prior.astype(np.float64), measured.seen, 1.0 + _exponent(share))
        stops = np.clip(np.rint(np.multiply(coverage.SHARES, count)) - gone, 0, go).astype(int)
        stops[-1] = go
        scores = combined(measured, share)
        return coverage.order(scores, floors, prior, self.floor_weights, stops)

    def _measure_first(self, prior: NDArray[np.float32], progress: Progress) -> Measured:
        """Measure all Gaussians, and choose the weights of the floor by what each view says."""
        sample = coverage.sample(self.gaussians)
        blocks = self._blocks(self.gaussians, sample, progress)
        measured = Measured.sum([block for block, _ in blocks])
        worth = prior[self.gaussians.index[sample]].astype(np.float64)

        def folds() -> Iterator[tuple[NDArray[np.float64], ...]]:
            for block, errors in blocks if len(blocks) > 1 else ():
                report(progress, 1.0, "scoring")
                others = Measured(
                    # What is left of a sum may be negative by rounding.
                    np.maximum(measured.contribution[sample] - block.contribution[sample], 0.0),
                    np.maximum(measured.contrast[sample] - block.contrast[sample], 0.0),
                    measured.seen[sample] - block.seen[sample],
                )
                floors = coverage.floor(worth, others.seen, 1.0 + _exponent(0.0))
                yield combined(others, 0.0), floors, errors

        self.floor_weights = coverage.floor_weights(folds())
        return measured

    def measure(self, gaussians: Gaussians, progress: Progress) -> Measured:
        """Sum contribution and contrast of the Gaussians over all views."""
        return Measured.sum([block for block, _ in self._blocks(gaussians, None, progress)])

    def _blocks(
        self, gaussians: Gaussians, sample: NDArray[np.int64] | None, progress: Progress
    ) -> list[tuple[Measured, NDArray[np.float64]]]:
        """Return the sums over each block of views, and the contrast of a sample in each view.

        Parameters
        ----------
        gaussians : Gaussians
        sample : (m,) int64, optional
            Rows.
        progress : callable

        Returns
        -------
        list of Measured, (views, m) float64
        """
        blocks = min(_BLOCKS, len(self.views))
        rows = np.empty(0, np.int64) if sample is None else sample

        def block(piece: slice) -> tuple[Measured, NDArray[np.float64]]:
            total = Measured.zero(len(gaussians))
            errors = []
            for view, weight in self.views[piece.start :: blocks]:
                before = total.contrast[rows]
                measure_view(gaussians, self.scene, view, weight, self.settings, total)
                errors.append(total.contrast[rows] - before)
            return total, np.array(errors)

        return for_chunks(block, blocks, 1, progress=progress, what="scoring", threads=self.threads)


class _Removal:
    """The order in which splats go.

    Attributes
    ----------
    values : (N,) float32
        Share of the splats that has gone once this one has, of those that were added.
    gone : int
        How many were added.
    """

    def __init__(self, count: int) -> None:
        self.values = np.zeros(count, np.float32)
        self.gone = 0

    def add(self, splats: NDArray[np.int64]) -> None:
        """Append splats in their order."""
        end = self.gone + len(splats)
        self.values[splats] = shares_gone(np.arange(self.gone + 1, end + 1), len(self.values))
        self.gone = end


def _survivors(count: int, rounds: int) -> list[int]:
    """Return how many of `count` splats stay after each round: `LEAST` before the last, then 0."""
    return [round(count * LEAST ** (number / (rounds - 1))) for number in range(1, rounds)] + [0]


def _by_distance(views: ViewSet) -> list[tuple[View, float]]:
    """Return views and weights, those of no weight left out, in an order that the scene gives.

    By distance from the middle, then from the view farthest from it: neither the order of the list
    nor, unless they are all alike, the frame decides which block a view belongs to.
    """
    centers = views.centers - views.weights @ views.centers
    order = np.lexsort((*centers.T, *views.rotations[:, 2].T))
    for _ in range(2):
        distance = np.einsum("ij,ij->i", centers, centers)
        largest = float(distance.max()) or 1.0
        # Rounded, so that what is equal but for rounding keeps the order it has.
        order = order[np.argsort(np.round(distance[order] / largest, 9), kind="stable")]
        centers = centers - centers[order[-1]]
    return [(views[int(k)], float(views.weights[k])) for k in order if views.weights[k] > 0]


@dataclass(frozen=True, eq=False)
class Measured:
    """Sums over views, for M Gaussians.

    Attributes
    ----------
    contribution, contrast : (M,) float64
        See the module; px^2, weighted by the views' weights.
    seen : (M,) int32
        In how many views the centre lies.
    """

    contribution: NDArray[np.float64]
    contrast: NDArray[np.float64]
    seen: NDArray[np.int32]

    @classmethod
    def zero(cls, count: int) -> Measured:
        """Return sums of no views."""
        return cls(np.zeros(count), np.zeros(count), np.zeros(count, np.int32))

    @classmethod
    def sum(cls, parts: list[Measured]) -> Measured:
        """Return the sums of all parts."""
        total = cls.zero(len(parts[0].seen))
        for other in parts:
            total.add(other)
        return total

    def spread(self, index: NDArray[np.int64], count: int) -> Measured:
        """Return the sums for `count` splats, of which these are those at `index`; 0 of others."""
        every = Measured.zero(count)
        every.contribution[index] = self.contribution
        every.contrast[index] = self.contrast
        every.seen[index] = self.seen
        return every

    def add(self, other: Measured) -> None:
        """Add the sums of other views."""
        self.contribution[:] += other.contribution
        self.contrast[:] += other.contrast
        self.seen[:] += other.seen


def combined(measured: Measured, gone: float) -> NDArray[np.float64]:
    """Return ``contrast contribution^p``; p rises with the share `gone` before.

    The contrast is exact for one splat; the more of its neighbours go too, the more counts what a
    splat covers, whatever is behind it.
    """
    return np.asarray(measured.contrast * measured.contribution ** _exponent(gone))


def _exponent(gone: float) -> float:
    return 0.25 + 0.5 * gone


def measure_view(
    gaussians: Gaussians,
    scene: Scene,
    view: View,
    weight: float,
    settings: Occlusion,
    total: Measured,
) -> None:
    """Add what one view says to `total`."""
    with np.errstate(under="ignore"):
        footprints = projection.project(gaussians, scene, view)
        count = len(footprints.index)
        if not count:
            return
        total.seen[footprints.index[footprints.inside]] += 1
        side = froxels.cell_size(footprints, view, settings.cell, settings.density)
        points = froxels.scatter(footprints, view, side, settings.density)
        alphas = gaussians.alphas[footprints.index]
        red, green, blue = gaussians.colors[footprints.index].T
        colors = (froxels.paired(red, green), blue.copy())
        mass, mass_squared = froxels.masses(footprints, alphas)
        evenness = froxels.evenness(footprints, points.area)
        transmittance = np.empty(len(points.owners), np.float32)
        squared_contrast = np.empty(len(points.owners), np.float32)
        for place, piece in points.pieces():
            thick = froxels.thickness(piece, alphas, mass)
            front, even = froxels.in_front(piece, thick, thick * evenness.take(piece.owners))
            transmittance[place] = froxels.transmittance(front, even, points.area)
            squared_contrast[place] = froxels.squared_contrast(piece, front, thick, colors)
        visible, errors = froxels.mean_visible(points, transmittance, squared_contrast, count)
        total.contribution[footprints.index] += weight * (mass * visible)
        total.contrast[footprints.index] += weight * (mass_squared * errors)
