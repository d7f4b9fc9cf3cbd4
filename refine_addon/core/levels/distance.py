"""From how far away a level of detail will do, by the pictures of its splats.

A camera k times as far away sees a thing k times as small: one of its pixels shows what k x k show
from near. So the pictures of the views, averaged over squares of k x k pixels, stand for those from
k times the distance, by a renderer that filters what is smaller than a pixel. Their PSNR comes from
rays through all pixels of some squares.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, chunks, part, run_all, silent
from ..quality.curve import PSNR_CAP
from ..quality.psnr import MIN_RAYS_WITH_HITS
from ..splats import Splats
from ..views import ViewSet
from ..visibility import projection
from ..visibility.ray_sample import cast_colored

FACTORS = (1, 2, 4, 8, 16)
"""Times the distance of the views from which pictures are compared; powers of two."""

VIEWS = 8
"""At most so many views compare them."""

SQUARES = 4
"""Along each side of a picture, so many squares of the largest factor's size are compared."""


@dataclass(frozen=True, eq=False)
class Reach:
    """From how far away a level will do.

    Attributes
    ----------
    psnr : tuple of (float, float)
        Distances, world units, and the PSNR against the original from there, dB; nearest first.
        There are none where the views see too little.
    """

    psnr: tuple[tuple[float, float], ...]

    def within(self, goal: float) -> float | None:
        """Return the distance from which on the PSNR is at least `goal`, dB; None if from nowhere.

        It is no less than that of the views: nothing is known from nearer. Between the distances
        the PSNR is taken as linear in the logarithm of the distance.

        Examples
        --------
        >>> reach = Reach(((1.0, 30.0), (4.0, 40.0), (16.0, 60.0)))
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


class OriginalPictures:
    """Pictures of all splats from some of the views, to compare levels with.

    Parameters
    ----------
    splats : Splats
        In the frame of the views.
    views : ViewSet
    progress : callable, optional
        See `refine_addon.core.execute.Progress`.
    threads : int, optional

    Attributes
    ----------
    distance : float
        From the views to what they see, world units: the median over what makes up their pixels; 0
        if they see nothing.

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
        self._chosen, self._threads = views.spread(VIEWS), threads
        self._views = self._chosen.by_distance()
        self._pictures = self._take(splats, progress)
        self.distance = _median(
            np.concatenate([picture.distance for picture in self._pictures]),
            np.concatenate([picture.contribution for picture in self._pictures]),
        )

    def reach(self, splats: Splats, *, progress: Progress = silent) -> Reach:
        """Return from how far away the splats of a level will do.

        Raises
        ------
        Cancelled
            If `progress` answers ``False``.
        """
        if sum(picture.hitting for picture in self._pictures) < MIN_RAYS_WITH_HITS:
            return Reach(())
        pictures = self._take(splats, progress)
        rows, weights = [], []
        for (_, weight), before, after in zip(self._views, self._pictures, pictures, strict=True):
            if before.hitting:
                rows.append([_psnr(after.colors - before.colors, size) for size in FACTORS])
                weights.append(weight)
        psnr = np.average(rows, axis=0, weights=weights)
        distances = [factor * self.distance for factor in FACTORS]
        return Reach(tuple(zip(distances, psnr.tolist(), strict=True)))

    def _take(self, splats: Splats, progress: Progress) -> list[_Picture]:
        """Return the pictures that the views have of some splats."""
        with np.errstate(under="ignore"):
            gaussians, scene, _ = projection.prepare(
                splats, self._chosen, progress=part(progress, 0.0, 0.2), threads=self._threads
            )

        def of_view(piece: slice) -> _Picture:
            view = self._views[piece.start][0]
            columns, rows = _patches(view.width), _patches(view.height)
            with np.errstate(under="ignore"):
                footprints = projection.project(gaussians, scene, view)
                rays, colors = cast_colored(splats, gaussians, footprints, view, columns, rows)
            _, owner, weight = rays.contributions()
            means = splats.means[gaussians.index[rays.hit]].astype(np.float64)
            return _Picture(
                rays.colors(colors).reshape(3, len(rows), len(columns)),
                rays.hitting,
                np.linalg.norm(means - view.center, axis=1),
                np.bincount(owner, weight, len(means)).astype(np.float64),
            )

        return run_all(
            of_view, chunks(len(self._views), 1),
            progress=part(progress, 0.2, 1.0), what="comparing", threads=self._threads,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Picture:
    """What some pixels of one view show, and the u splats that it is made of.

    Patches of the picture side by side, (3, R, C); how many of their rays hit a splat; of each
    splat its distance, world units, and how many of the pixels it makes up.
    """

    colors: NDArray[np.float64]
    hitting: int
    distance: NDArray[np.float64]
    contribution: NDArray[np.float64]


def _patches(size: int) -> NDArray[np.int64]:
    """Return which of `size` columns (or rows) of an image are compared, ascending, (C,).

    They are runs of the largest factor's length, spread evenly; all of them in small images.
    """
    side = FACTORS[-1]
    count = min(size // side, SQUARES)
    if not count:
        return np.arange(size)
    starts = np.floor((np.arange(count) + 0.5) * size / count - side / 2.0)
    return np.asarray((starts[:, None] + np.arange(side)).ravel(), np.int64)


def _psnr(change: NDArray[np.float64], size: int) -> float:
    """Return the PSNR of pictures averaged over squares of `size` pixels, dB; at most 100.

    `change` is their difference, (3, R, C); what is left beside whole squares does not count.
    """
    _, rows, columns = change.shape
    high, wide = min(size, rows), min(size, columns)
    cut = change[:, : rows // high * high, : columns // wide * wide]
    squares = cut.reshape(3, rows // high, high, columns // wide, wide).mean(axis=(2, 4))
    error = float(np.mean(squares**2))
    return PSNR_CAP if error <= 10.0 ** (-PSNR_CAP / 10.0) else -10.0 * math.log10(error)


def _median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Return the weighted median; 0 of no values.

    >>> _median(np.array([1.0, 9.0, 5.0]), np.array([0.2, 0.2, 0.6]))
    5.0
    """
    if not len(values):
        return 0.0
    order = np.argsort(-values, kind="stable")
    total = np.cumsum(weights[order])
    place = np.searchsorted(total, 0.5 * total[-1], "right")
    return float(values[order[min(place, len(order) - 1)]])
