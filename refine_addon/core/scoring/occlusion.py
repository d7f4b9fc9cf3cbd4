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
from ..work import Progress, for_chunks, part, silent
from . import closed_form, coverage, froxels, projection

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from ..splats import Splats
    from ..views import View, ViewSet
    from .projection import Frame, Gaussians

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
    has many points, 100 bytes for each of them and thread, of which
    there are at most 4 million (`froxels.MAX_POINTS`).
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
    gaussians, frame, good = projection.prepare(
        splats, views, progress=part(progress, 0.0, 0.05), threads=threads
    )
    if not good.any():
        msg = f"none of the {len(splats)} splats can be drawn: each is transparent or not finite"
        raise RefineError(msg)
    run = _Run(gaussians, frame, views, settings, threads)
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
        weights={"floor": run.weights},
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
    gaussians, frame, _ = projection.prepare(
        splats, views, progress=part(progress, 0.0, 0.1), threads=threads
    )
    run = _Run(gaussians, frame, views, settings, threads)
    some = Measured.sum(run.measure(gaussians, part(progress, 0.1, 1.0)))
    return some.spread(gaussians.index, len(splats))


class _Run:
    """One scoring: the scene as Gaussians, and what is left of it."""

    def __init__(
        self,
        gaussians: Gaussians,
        frame: Frame,
        views: ViewSet,
        settings: Occlusion,
        threads: int | None,
    ) -> None:
        self.gaussians, self.frame, self.settings, self.threads = (
            gaussians,
            frame,
            settings,
            threads,
        )
        self.measured = Measured.zero(len(gaussians))  # in the first round
        self.weights = [0.0] * len(coverage.SHARES)  # of the floor, up to each share
        self.views = _by_distance(views)
        # Neighbours follow each other, so every k-th of them is all over the scene.
        self.some = slice(None, None, max(-(-len(gaussians) // coverage.SAMPLE), 1))
        self.errors: dict[int, list[NDArray[np.float64]]] = {}  # of those, for the views of a block

    def rank(
        self, prior: NDArray[np.float32], progress: Progress
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Return the values and `seen` of all splats; `prior` decides where the views do not."""
        count, rounds, left = len(prior), self.settings.rounds, self.gaussians
        values, seen = np.zeros(count, np.float32), np.zeros(count, np.int32)
        hopeless = np.ones(count, np.bool_)
        hopeless[left.index] = False
        going = np.flatnonzero(hopeless)
        going = going[np.argsort(prior[going], kind="stable")]
        gone, start = 0, 0.0
        for number in range(rounds):
            values[going] = shares_gone(np.arange(gone + 1, gone + len(going) + 1), count)
            gone += len(going)
            # Each round has the views times what is left to do; all of them about thrice the first.
            end = start + (1.0 - start) * max(1.0 / (rounds - number), 0.25)
            blocks = self.measure(left, part(progress, start, end))
            start, share = end, gone / count
            measured = Measured.sum(blocks)
            if number == 0:
                self.weights = self._weigh(blocks, measured, prior)
                seen[left.index] = measured.seen
                self.measured = measured
            last = number == rounds - 1
            stay = 0 if last else round(count * LEAST ** ((number + 1) / (rounds - 1)))
            floors = coverage.floor(
                prior[left.index].astype(np.float64), measured.seen, 1.0 + _exponent(share)
            )
            go = max(len(left) - stay, 0)
            stops = np.clip(np.rint(np.multiply(coverage.SHARES, count)) - gone, 0, go).astype(int)
            stops[-1] = go
            order = coverage.order(
                combined(measured, share), floors, prior[left.index], self.weights, stops
            )
            going = left.index[order[:go]]
            left = left.take(np.sort(order[go:]))
        values[going] = shares_gone(np.arange(gone + 1, gone + len(going) + 1), count)
        return values, seen

    def _weigh(
        self, blocks: list[Measured], measured: Measured, prior: NDArray[np.float32]
    ) -> list[float]:
        """Return the weights of the floor by what each block of views says of the others."""
        some = self.some
        worth = prior[self.gaussians.index[some]].astype(np.float64)
        power = 1.0 + _exponent(0.0)

        def folds() -> Iterator[tuple[NDArray[np.float64], ...]]:
            for number, block in enumerate(blocks if len(blocks) > 1 else ()):
                others = Measured(
                    # What is left of a sum may be negative by rounding.
                    np.maximum(measured.contribution[some] - block.contribution[some], 0.0),
                    np.maximum(measured.contrast[some] - block.contrast[some], 0.0),
                    measured.seen[some] - block.seen[some],
                )
                floors = coverage.floor(worth, others.seen, power)
                yield combined(others, 0.0), floors, np.array(self.errors[number])

        return coverage.floor_weights(folds())

    def measure(self, gaussians: Gaussians, progress: Progress) -> list[Measured]:
        """Sum contribution and contrast of the Gaussians over the views of each block."""
        blocks = min(_BLOCKS, len(self.views))

        def block(piece: slice) -> Measured:
            total = Measured.zero(len(gaussians))
            errors = []
            for view, weight in self.views[piece.start :: blocks]:
                before = total.contrast[self.some].copy()
                measure_view(gaussians, self.frame, view, weight, self.settings, total)
                errors.append(total.contrast[self.some] - before)
            self.errors[piece.start] = errors
            return total

        return for_chunks(block, blocks, 1, progress=progress, what="scoring", threads=self.threads)


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
    frame: Frame,
    view: View,
    weight: float,
    settings: Occlusion,
    total: Measured,
) -> None:
    """Add what one view says to `total`."""
    with np.errstate(under="ignore"):
        footprints = projection.project(gaussians, frame, view)
        count = len(footprints.index)
        if not count:
            return
        total.seen[footprints.index[footprints.inside(view)]] += 1
        side = froxels.cell_size(footprints, view, settings.cell, settings.density)
        points = froxels.scatter(footprints, view, side, settings.density)
        alphas = gaussians.alphas[footprints.index]
        red, green, blue = gaussians.colors[footprints.index].T
        colors = (red + np.complex64(1j) * green, blue.copy())
        mass, mass_squared = froxels.masses(footprints, alphas)
        evenness = froxels.evenness(footprints, points.area)
        light = np.empty(len(points.owners), np.float32)
        contrast = np.empty(len(points.owners), np.float32)
        for place, piece in points.pieces():
            thick = froxels.thickness(piece, alphas, mass)
            front, even = froxels.in_front(piece, thick, thick * evenness.take(piece.owners))
            light[place] = froxels.light(front, even, points.area)
            contrast[place] = froxels.contrast(piece, front, thick, colors)
        shown, errors = froxels.mean_light(points, light, contrast, count)
        total.contribution[footprints.index] += weight * (mass * shown)
        total.contrast[footprints.index] += weight * (mass_squared * errors)
