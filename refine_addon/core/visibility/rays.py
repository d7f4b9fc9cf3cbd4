"""Rays through some pixels of one view, their hits composited front to back as a renderer does:

    C = sum over hits of  T alpha c,    T = product over the hits in front of  1 - alpha

The hits of all rays lie one after the other. Running sums restart at each ray, without a loop;
`measuring` sums down its columns of points with the same functions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..execute import checkpoint

LOG_OPAQUE = -9.3
"""Logarithm of the transmittance, 1e-4, below which nothing is seen."""

LEAST_LEFT = 1e-8
"""Least transmittance behind a hit, as a divisor: hidden hits are gone, so it only replaces 0."""

_PIECE = 1 << 15  # hits processed at a time: what stays in the second-level cache


@dataclass(frozen=True, eq=False)
class Rays:
    """The P = C R rays of a view, where columns and rows cross, and their h hits on u Gaussians."""

    columns: NDArray[np.int64]  # (C,), ascending
    rows: NDArray[np.int64]  # (R,), ascending; rays are numbered row by row
    ray: NDArray[np.int32]  # (h,), ascending; the hits of a ray are front to back
    owner: NDArray[np.int32]  # (h,), the Gaussian that is hit, as a place in `hit`
    alpha: NDArray[np.float32]  # (h,)
    hit: NDArray[np.int64]  # (u,), rows of Gaussians, ascending
    aims: NDArray[np.int64] | None = None  # (2, P), pixels instead, see `cast.aimed`

    @property
    def count(self) -> int:
        """Number of rays."""
        return len(self.columns) * len(self.rows)

    def pixels_of(
        self, ray: NDArray[np.integer[Any]]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Column and row of the pixels of rays, (n,) each."""
        if self.aims is not None:
            return self.aims[0].take(ray), self.aims[1].take(ray)
        return self.columns.take(ray % len(self.columns)), self.rows.take(ray // len(self.columns))

    def keeping(self, keep: NDArray[np.bool_]) -> Rays:
        """The rays with only their hits on the splats `keep`, (u,) bool."""
        return self._with_hits(np.flatnonzero(keep.take(self.owner)))

    def visible(self, opaque: float) -> tuple[Rays, NDArray[np.float32]]:
        """The rays without hidden hits, which show the same; transmittance in front, (h,)."""
        transmittance = _transmittance(self.alpha, self.counts(), opaque)
        kept = np.flatnonzero(transmittance)
        return self.of_hits(kept), transmittance.take(kept)

    def of_hits(self, kept: NDArray[np.int64]) -> Rays:
        """The rays with some hits, and the splats of these."""
        rays, used = self._with_hits(kept), np.zeros(len(self.hit), np.bool_)
        used[rays.owner] = True
        place = np.cumsum(used, dtype=np.int32) - np.int32(1)
        return replace(rays, owner=place.take(rays.owner), hit=self.hit[used])

    def composited(
        self, weight: NDArray[np.float32], colors: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Colour of each ray over black, (3, P), 0..1, from T alpha, (h,), and colours, (3, u)."""
        first, result = self._first_hits(), np.zeros((3, self.count), np.float32)
        if len(first):
            hitting = self.ray.take(first)
            for row, channel in zip(result, colors, strict=True):
                row[hitting] = np.add.reduceat(weight * channel.take(self.owner), first)
        return result.clip(0.0, 1.0)

    def weights(self) -> NDArray[np.float32]:
        """T alpha, the share of the pixel, of each hit, (h,); 0 where it is hidden."""
        return self.alpha * _transmittance(self.alpha, self.counts())

    def colors(self, colors: NDArray[np.float32]) -> NDArray[np.float32]:
        """Colour of each ray over black, (3, P), 0..1, from those of the splats, (3, u)."""
        return self.composited(self.weights(), colors)

    def removal_errors(
        self, colors: NDArray[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Error and contribution of each splat, (u,) each, summed over rays; colours are (3, u).

        The error is ``sum (T alpha)^2 |c - B|^2``, B the colour behind, the contribution ``sum T
        alpha`` (docs/method.md, section 5).
        """
        ends = np.append(self._first_hits(), len(self.ray))
        cuts = np.unique(np.searchsorted(ends, [*range(0, len(self.ray), _PIECE), len(self.ray)]))
        error, weights = np.empty((2, len(self.ray)), np.float32)
        owner = self.owner.astype(np.intp)
        for first, last in pairwise(cuts.tolist()):  # whole rays at a time
            checkpoint()
            piece = slice(int(ends[first]), int(ends[last]))
            counts = np.diff(ends[first : last + 1])
            transmittance = _transmittance(self.alpha[piece], counts)
            weight = transmittance * self.alpha[piece]  # 0 where it is hidden
            left = np.maximum(transmittance - weight, np.float32(LEAST_LEFT))  # behind it
            changes = contrasts(weight, left, colors.take(owner[piece], axis=1), counts)
            error[piece] = sum(np.square(change * weight) for change in changes)
            weights[piece] = weight
        sums = [np.bincount(owner, each, len(self.hit)) for each in (error, weights)]
        return sums[0].astype(float), sums[1].astype(float)

    def colors_by_nearest_kept(
        self, colors: NDArray[np.float32], keep: NDArray[np.bool_]
    ) -> NDArray[np.float32]:
        """Colour of each ray, (3, P), 0..1, if kept splats, (u,) bool, stand in for removed ones.

        A removed splat keeps its alpha and takes the colour of the ray's nearest kept hit, counted
        in hits; of two equally near ones, of the one behind; without any, it is black.
        """
        kept, here = keep.take(self.owner), np.arange(len(self.owner))
        none = len(here)  # farther than any hit
        counts = self.counts()
        first = np.repeat(self._first_hits(), counts)  # (h,), the first hit of the same ray
        end = first + np.repeat(counts, counts)  # (h,), behind the last one
        before = np.maximum.accumulate(np.where(kept, here, -1))
        after = np.minimum.accumulate(np.where(kept, here, none)[::-1])[::-1]
        steps_front = np.where(before >= first, here - before, none)
        steps_back = np.where(after < end, after - here, none)
        nearest = np.where(steps_front < steps_back, before, after)
        alone = np.minimum(steps_front, steps_back) == none
        owner = self.owner.take(np.where(alone, here, nearest))
        owner[alone] = colors.shape[1]  # the column of black
        return replace(self, owner=owner).colors(np.pad(colors, ((0, 0), (0, 1))))

    def counts(self) -> NDArray[np.int64]:
        """Number of hits of each ray that has any."""
        return np.diff(np.append(self._first_hits(), len(self.ray)))

    def _first_hits(self):
        new = np.ones(len(self.ray), np.bool_)
        np.not_equal(self.ray[1:], self.ray[:-1], out=new[1:])
        return np.flatnonzero(new)

    def _with_hits(self, kept):
        names = ("ray", "owner", "alpha")
        return replace(self, **{name: getattr(self, name).take(kept) for name in names})


def _transmittance(alpha, counts, opaque=LOG_OPAQUE):
    """Transmittance in front of hits, (h,), 0 where hidden; `counts`, >= 1, are hits of rays."""
    log_front = in_front(np.log1p(-alpha).astype(np.float64), counts)
    result = np.exp(log_front.astype(np.float32))
    result[log_front < opaque] = 0.0
    return result


def paired(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[Any]:
    """Two real arrays as one complex array, (m,): its running sum takes the time of one."""
    pair = np.empty(first.shape, np.complex128)
    pair.real, pair.imag = first, second
    return pair


def in_front(values: NDArray[Any], counts: NDArray[np.int64]) -> NDArray[Any]:
    """Sums of the values, (m,), in front of each in its column; columns have `counts`, (C,) >= 1.

    >>> in_front(np.array([1.0, 2.0, 4.0, 8.0]), np.array([3, 1])).tolist()
    [0.0, 1.0, 3.0, 0.0]
    """
    sums = np.cumsum(values)
    sums -= values
    sums -= np.repeat(sums.take(np.cumsum(counts) - counts), counts)
    return sums


def behind(values: NDArray[Any], counts: NDArray[np.int64]) -> NDArray[Any]:
    """Sums of the values, (m,), behind each in its column, see `in_front`."""
    sums = np.cumsum(values)
    return np.repeat(sums.take(np.cumsum(counts) - 1), counts) - sums


def contrasts(
    weight: NDArray[np.float32],
    left: NDArray[np.float32],
    colors: NDArray[np.float32],
    counts: NDArray[np.int64],
) -> Iterator[NDArray[np.float32]]:
    """Yield B - c, colour behind less own colour, (m,), of each channel, in columns of `counts`."""
    red_green = behind(paired(weight * colors[0], weight * colors[1]), counts)
    blue = behind((weight * colors[2]).astype(np.float64), counts)
    for own, light in zip(colors, (red_green.real, red_green.imag, blue), strict=True):
        contrast = light.astype(np.float32)
        contrast /= left  # the colour behind
        contrast -= own
        yield contrast
