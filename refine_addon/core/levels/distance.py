"""From how far away a level of detail will do, by the widths and by the pictures of its splats.

A camera k times as far away sees a thing k times as small: one of its pixels shows what k x k show
from near. So the pictures of the views, averaged over squares of k x k pixels, stand for those from
k times the distance, by a renderer that filters what is smaller than a pixel. Their PSNR comes from
rays through all pixels of some squares.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from ..estimate.psnr import MIN_RAYS_WITH_HITS
from ..estimate.quality import PSNR_CAP
from ..seeing import projection
from ..seeing.cast import cast
from ..seeing.ray_sample import colors_from
from ..work import Progress, for_chunks, part, silent

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..splats import Splats
    from ..views import ViewSet

Found = TypeVar("Found")

FACTORS = (1, 2, 4, 8, 16)
"""Times the distance of the views from which pictures are compared; powers of two."""

VIEWS = 8
"""At most so many views compare them."""

SQUARES = 4
"""Along each side of a picture, so many squares of the largest factor's size are looked at."""

OVERLOOKED = 0.01
"""Share of what the views see that may have changed at a larger width than the geometric error."""


@dataclass(frozen=True, eq=False)
class Reach:
    """From how far away a level will do.

    Attributes
    ----------
    error : float
        Geometric error, world units: what has changed and is wider makes up at most `OVERLOOKED`
        of what the views see; 0 if so little changed.
    psnr : tuple of (float, float)
        Distances, world units, and the PSNR against the original from there, dB; nearest first.
        There are none where the views see too little.
    focal : float
        The longest focal length of the views, pixels.
    """

    error: float
    psnr: tuple[tuple[float, float], ...]
    focal: float

    @property
    def pixel(self) -> float:
        """Distance from which the geometric error is at most a pixel wide, world units."""
        return self.focal * self.error

    def within(self, goal: float) -> float | None:
        """Return the distance from which on the PSNR is at least `goal`, dB; None if from nowhere.

        It is no less than that of the views: nothing is known from nearer. Between the distances
        the PSNR is taken as linear in the logarithm of the distance.

        Examples
        --------
        >>> reach = Reach(0.0, ((1.0, 30.0), (4.0, 40.0), (16.0, 60.0)), 100.0)
        >>> reach.within(35.0), reach.within(20.0), reach.within(70.0)
        (2.0, 1.0, None)
        """
        if not self.psnr or self.psnr[-1][1] < goal:
            return None
        lacking = [number for number, (_, value) in enumerate(self.psnr) if value < goal]
        if not lacking:
            return self.psnr[0][0]
        (near, low), (far, high) = self.psnr[lacking[-1] : lacking[-1] + 2]
        return near * math.exp(math.log(far / near) * (goal - low) / (high - low))


class Lookout:
    """What some of the views see of all splats, to compare levels with.

    Parameters
    ----------
    splats : Splats
        In the frame of the views.
    views : ViewSet
    progress : callable, optional
        See `refine_addon.core.work.Progress`.
    threads : int, optional

    Attributes
    ----------
    distance : float
        From the views to what they see, world units: the median over what makes up their pixels.
    focal : float
        See `Reach`.

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """

    def __init__(
        self,
        splats: Splats,
        views: ViewSet,
        *,
        progress: Progress = silent,
        threads: int | None = None,
    ) -> None:
        self._splats, self._chosen, self._threads = splats, views.spread(VIEWS), threads
        self._views = self._chosen.by_distance()
        self.focal = max(max(view.fx, view.fy) for view, _ in self._views)
        self._seen = self._look(splats, progress)
        self._contribution = _total(self._seen, len(splats))  # (N,)
        away = [np.empty(0)]
        for (view, _), seen in zip(self._views, self._seen, strict=True):
            steps = splats.means[seen.index].astype(np.float64) - view.center
            away.append(np.linalg.norm(steps, axis=1))
        shares = np.concatenate([np.empty(0), *(seen.contribution for seen in self._seen)])
        self.distance = _largest_but(np.concatenate(away), shares, 0.5)

    def reach(
        self,
        splats: Splats,
        keep: NDArray[np.bool_],
        changed: NDArray[np.bool_] | None = None,
        *,
        progress: Progress = silent,
    ) -> Reach:
        """Return from how far away a level will do.

        Parameters
        ----------
        splats : Splats
            The K of the level.
        keep : (N,) bool
            Which of all splats they are.
        changed : (K,) bool, optional
            Which of them are not what they were; none by default.
        progress : callable, optional

        Raises
        ------
        Cancelled
            If `progress` answers ``False``.
        """
        now = self._look(splats, progress)
        error = _width_of_most(self._splats, ~keep, self._contribution)
        if changed is not None:
            new = _width_of_most(splats, changed, _total(now, len(splats)))
            error = max(error, new)
        if sum(seen.hitting for seen in self._seen) < MIN_RAYS_WITH_HITS:
            return Reach(error, (), self.focal)
        rows, weights = [], []
        for (_, weight), before, after in zip(self._views, self._seen, now, strict=True):
            if before.hitting:
                rows.append([_psnr(after.picture - before.picture, size) for size in FACTORS])
                weights.append(weight)
        psnr = np.average(rows, axis=0, weights=weights)
        steps = [factor * self.distance for factor in FACTORS]
        return Reach(error, tuple(zip(steps, psnr.tolist(), strict=True)), self.focal)

    def _look(self, splats: Splats, progress: Progress) -> list[_ViewSample]:
        """Return what each of the views sees of some splats."""
        threads = self._threads
        with np.errstate(under="ignore"):
            gaussians, scene, _ = projection.prepare(
                splats, self._chosen, progress=part(progress, 0.0, 0.2), threads=threads
            )

        def look(piece: slice) -> _ViewSample:
            view = self._views[piece.start][0]
            columns, rows = _patches(view.width), _patches(view.height)
            with np.errstate(under="ignore"):
                footprints = projection.project(gaussians, scene, view)
                rays = cast(footprints, columns, rows)
                index = gaussians.index[rays.hit]
                colors = rays.colors(colors_from(splats, index, view))
            _, owner, weight = rays.contributions()
            contribution = np.bincount(owner, weight, len(index)).astype(np.float64)
            picture = colors.reshape(3, len(rows), len(columns))
            return _ViewSample(index, contribution, picture, rays.hitting)

        ahead = part(progress, 0.2, 1.0)
        return for_chunks(
            look, len(self._views), 1, progress=ahead, what="comparing", threads=threads
        )


@dataclass(frozen=True, eq=False)
class _ViewSample:
    """What the rays of one view see.

    Attributes
    ----------
    index : (u,) int64
        Rows of splats.
    contribution : (u,) float64
        How many pixels each of them makes up.
    picture : (3, R, C) float64
        Patches of the picture, side by side.
    hitting : int
        How many rays hit a splat.
    """

    index: NDArray[np.int64]
    contribution: NDArray[np.float64]
    picture: NDArray[np.float64]
    hitting: int


def _patches(size: int) -> NDArray[np.int64]:
    """Return the columns (or rows) of an image of so many that are looked at, ascending, (C,).

    They are runs of the largest factor's length, spread evenly; all of them in small images.
    """
    side = FACTORS[-1]
    count = min(size // side, SQUARES)
    if not count:
        return np.arange(size)
    starts = np.floor((np.arange(count) + 0.5) * size / count - side / 2.0)
    return np.asarray((starts[:, None] + np.arange(side)).ravel(), np.int64)


def _psnr(change: NDArray[np.float64], size: int) -> float:
    """Return the PSNR of a picture, dB, averaged over squares of `size` pixels; at most 100.

    Parameters
    ----------
    change : (3, R, C) float64
        Difference of two pictures; what is left beside whole squares is not looked at.
    size : int
    """
    _, rows, columns = change.shape
    high, wide = min(size, rows), min(size, columns)
    cut = change[:, : rows // high * high, : columns // wide * wide]
    squares = cut.reshape(3, rows // high, high, columns // wide, wide).mean(axis=(2, 4))
    error = float(np.mean(squares**2))
    return PSNR_CAP if error <= 10.0 ** (-PSNR_CAP / 10.0) else -10.0 * math.log10(error)


def _total(views: list[_ViewSample], count: int) -> NDArray[np.float64]:
    """Return how many pixels of all views each of `count` splats makes up, (count,)."""
    total = np.zeros(count)
    for seen in views:
        total[seen.index] += seen.contribution
    return total


def _width_of_most(
    splats: Splats, some: NDArray[np.bool_], contribution: NDArray[np.float64]
) -> float:
    """Return the width that some splats exceed only by what makes up at most `OVERLOOKED` of all.

    The width of a splat is two standard deviations along its longest axis.

    Parameters
    ----------
    splats : Splats
    some : (N,) bool
    contribution : (N,) float64
        Of all splats; 0 for those that are not seen.
    """
    rows = np.flatnonzero(some & (contribution > 0.0))
    own, total = contribution[rows], float(contribution.sum())
    if float(own.sum()) <= OVERLOOKED * total:
        return 0.0
    widths = 2.0 * np.exp(splats.log_scales[rows].astype(np.float64).max(axis=1))
    return _largest_but(widths, own, OVERLOOKED * total / float(own.sum()))


def _largest_but(values: NDArray[np.float64], weights: NDArray[np.float64], share: float) -> float:
    """Return the largest value that remains if a share of the weights goes, the largest first.

    >>> _largest_but(np.array([1.0, 9.0, 5.0]), np.array([0.5, 0.1, 0.4]), 0.2)
    5.0
    """
    if not len(values):
        return 0.0
    order = np.argsort(-values, kind="stable")
    total = np.cumsum(weights[order])
    place = np.searchsorted(total, share * total[-1], "right")
    return float(values[order[min(place, len(order) - 1)]])
