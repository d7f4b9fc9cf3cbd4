"""Rays through some pixels of one view, and the splats that they hit.

A ray hits a splat where the splat's footprint holds the centre of the ray's pixel. The hits of a
ray are composited front to back, as a renderer composites a pixel::

    C = sum over hits of  T alpha c,    T = product over the hits in front of  1 - alpha

So the colours of these pixels are known with all splats and with any choice of them, exactly.

Values of all rays lie one after the other, those of each front to back. Running sums run over all
of them at once and restart at each ray, which costs no loop over rays; likewise down the columns of
points in the cells of an image (`measuring`).
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
"""Logarithm of the transmittance below which nothing is seen, 1e-4."""

LEAST_LEFT = 1e-8
"""The colour behind a hit is divided by the transmittance behind it, and at least by this. What is
hidden is left out before (`LOG_OPAQUE`), so it only guards against a division by 0."""

_PIECE = 1 << 15  # hits processed at a time: what stays in the second-level cache


@dataclass(frozen=True, eq=False)
class Rays:
    """The P rays of one view, and the h hits that they have on u splats.

    Attributes
    ----------
    columns, rows : (C,), (R,) int64
        The rays go through the pixels where these columns and rows cross, row by row: P = C R.
    ray : (h,) int32
        On which ray each hit lies, ascending; the hits of a ray are front to back.
    owner : (h,) int32
        Which splat it hits, as a place in `hit`.
    alpha, log_passed : (h,) float32
        Alpha of the splat there, and the logarithm of 1 - alpha.
    hit : (u,) int64
        The Gaussians that any ray hits, ascending.
    aims : (2, P) int64, optional
        Column and row of the pixels that the rays go through instead; see `cast.aimed`.
    """

    columns: NDArray[np.int64]
    rows: NDArray[np.int64]
    ray: NDArray[np.int32]
    owner: NDArray[np.int32]
    alpha: NDArray[np.float32]
    log_passed: NDArray[np.float32]
    hit: NDArray[np.int64]
    aims: NDArray[np.int64] | None = None

    @property
    def count(self) -> int:
        """How many rays there are."""
        return len(self.columns) * len(self.rows)

    def pixels_of(
        self, ray: NDArray[np.integer[Any]]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Column and row of the pixels that some rays, (n,), go through, (n,) each."""
        if self.aims is not None:
            return self.aims[0].take(ray), self.aims[1].take(ray)
        return self.columns.take(ray % len(self.columns)), self.rows.take(ray // len(self.columns))

    def keeping(self, keep: NDArray[np.bool_]) -> Rays:
        """The rays with their hits on some of the splats alone.

        Parameters
        ----------
        keep : (u,) bool
            Which of `hit` stay.
        """
        return self._with_hits(np.flatnonzero(keep.take(self.owner)))

    def visible(self) -> tuple[Rays, NDArray[np.float32]]:
        """The rays with the hits that are not hidden alone: they see the same.

        Besides the transmittance in front of each hit, (h,) float32.
        """
        kept, log_front = self._seen()
        owner = self.owner.take(kept)
        used = np.zeros(len(self.hit), np.bool_)
        used[owner] = True
        place = np.cumsum(used, dtype=np.int32) - np.int32(1)
        seen = replace(self._with_hits(kept), owner=place.take(owner), hit=self.hit[used])
        return seen, np.exp(log_front)

    def composited(
        self, weight: NDArray[np.float32], colors: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Colour of each ray over black, (3, P), 0..1; see `colors`.

        Parameters
        ----------
        weight : (h,) float32
            Transmittance times alpha.
        colors : (3, u) float32
        """
        first, result = self._first_hits(), np.zeros((3, self.count), np.float32)
        if len(first):
            hitting = self.ray.take(first)
            for row, channel in zip(result, colors, strict=True):
                row[hitting] = np.add.reduceat(weight * channel.take(self.owner), first)
        return result.clip(0.0, 1.0)

    def contributions(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]:
        """What the rays see: the r hits that are not hidden.

        Returns
        -------
        ray, owner : (r,) int32
            As the attributes.
        weight : (r,) float32
            Transmittance times alpha: the share of the pixel that the splat makes up.
        """
        seen, log_front = self._seen()
        return self.ray.take(seen), self.owner.take(seen), self.alpha.take(seen) * np.exp(log_front)

    def colors(self, colors: NDArray[np.float64]) -> NDArray[np.float64]:
        """Colour of each ray over black, (3, P), 0..1.

        Parameters
        ----------
        colors : (3, u) float64
            Of the splats that are hit.
        """
        ray, owner, weight = self.contributions()
        channels = [
            np.bincount(ray, weight * channel.take(owner), self.count) for channel in colors
        ]
        return np.stack(channels).clip(0.0, 1.0)

    def removal_errors(
        self, colors: NDArray[np.float32]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """How much all rays together would change without each splat, (u,) each.

        Parameters
        ----------
        colors : (3, u) float32
            Of the splats that are hit.

        Returns
        -------
        error : (u,) float64
            The squared change of the colours of the rays without this splat, over all channels:
            ``(T alpha)^2 |c - B|^2``, with T the transmittance in front of it and B the colour
            behind it.
        contribution : (u,) float64
            The sum of ``T alpha``, in pixels.
        """
        ends = np.append(self._first_hits(), len(self.ray))
        cuts = np.unique(np.searchsorted(ends, [*range(0, len(self.ray), _PIECE), len(self.ray)]))
        error, weight = np.empty((2, len(self.ray)), np.float32)
        owner = self.owner.astype(np.intp)
        for first, last in pairwise(cuts.tolist()):  # whole rays at a time
            checkpoint()
            piece = slice(int(ends[first]), int(ends[last]))
            error[piece], weight[piece] = _removal_errors(
                self.alpha[piece], self.log_passed[piece], colors.take(owner[piece], axis=1),
                np.diff(ends[first : last + 1]),
            )  # fmt: skip
        errors, weights = (np.bincount(owner, each, len(self.hit)) for each in (error, weight))
        return errors.astype(float), weights.astype(float)

    def colors_by_nearest_kept(
        self, colors: NDArray[np.float64], keep: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Colour of each ray, (3, P), 0..1, if kept splats stand in for removed ones.

        A removed splat is as opaque as it was, in the colour of the nearest kept hit of the ray, or
        black where there is none. Nearest in the number of hits between; of two, the one in front.

        Parameters
        ----------
        colors : (3, u) float64
            Of the splats that are hit.
        keep : (u,) bool
            Which of them are kept.
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
        return replace(self, owner=owner).colors(np.append(colors, np.zeros((3, 1)), axis=1))

    def counts(self) -> NDArray[np.int64]:
        """How many hits each ray has, of those that hit a splat."""
        return np.diff(np.append(self._first_hits(), len(self.ray)))

    def _first_hits(self):
        """Place of the first hit of each ray that has any."""
        new = np.ones(len(self.ray), np.bool_)
        np.not_equal(self.ray[1:], self.ray[:-1], out=new[1:])
        return np.flatnonzero(new)

    def _seen(self):
        """The hits that are not hidden, and the logarithm of the transmittance in front of them."""
        log_front = in_front(self.log_passed.astype(np.float64), self.counts())
        seen = np.flatnonzero(log_front > LOG_OPAQUE)
        return seen, log_front.take(seen).astype(np.float32)

    def _with_hits(self, kept):
        """The rays with some of their hits."""
        names = ("ray", "owner", "alpha", "log_passed")
        return replace(self, **{name: getattr(self, name).take(kept) for name in names})


def _removal_errors(alpha, log_passed, colors, counts):
    """How much a ray would change without each of its hits; some rays.

    For `alpha` and `log_passed`, (h,), see `Rays`; colours are (3, h), and `counts`, (n,), is how
    many hits each ray has, at least one. Errors and contributions, (h,) each, are those of
    `Rays.removal_errors`, and 0 where the hit is hidden.
    """
    log_front = in_front(log_passed.astype(np.float64), counts)
    transmittance = np.exp(log_front.astype(np.float32))
    transmittance[log_front < LOG_OPAQUE] = 0.0
    weight = transmittance * alpha
    left = np.maximum(transmittance - weight, np.float32(LEAST_LEFT))  # transmittance behind it
    error = np.zeros(len(alpha), np.float32)
    for change in contrasts(weight, left, colors, counts):
        change *= weight
        change *= change
        error += change
    return error, weight


def paired(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[Any]:
    """Two real arrays as the real and imaginary parts of one complex array, (m,).

    A running sum over the pair is two running sums in the time of one.
    """
    pair = np.empty(first.shape, np.complex128)
    pair.real, pair.imag = first, second
    return pair


def in_front(values: NDArray[Any], counts: NDArray[np.int64]) -> NDArray[Any]:
    """For each value the sum of those in front of it in its column, (m,).

    Parameters
    ----------
    values : (m,) float64 or complex128
    counts : (C,) int64
        How many values each column has, at least one.

    Examples
    --------
    >>> in_front(np.array([1.0, 2.0, 4.0, 8.0]), np.array([3, 1])).tolist()
    [0.0, 1.0, 3.0, 0.0]
    """
    sums = np.cumsum(values)
    sums -= values
    sums -= np.repeat(sums.take(np.cumsum(counts) - counts), counts)
    return sums


def behind(values: NDArray[Any], counts: NDArray[np.int64]) -> NDArray[Any]:
    """For each value the sum of those behind it in its column, (m,).

    Parameters
    ----------
    values, counts
        See `in_front`.

    Examples
    --------
    >>> behind(np.array([1.0, 2.0, 4.0, 8.0]), np.array([3, 1])).tolist()
    [6.0, 4.0, 0.0, 0.0]
    """
    sums = np.cumsum(values)
    return np.repeat(sums.take(np.cumsum(counts) - 1), counts) - sums


def contrasts(
    weight: NDArray[np.float32],
    left: NDArray[np.float32],
    colors: NDArray[np.float32],
    counts: NDArray[np.int64],
) -> Iterator[NDArray[np.float32]]:
    """Yield of each channel the colour behind each value less its own, (m,).

    Parameters
    ----------
    weight : (m,) float32
        Transmittance in front of each value times its alpha.
    left : (m,) float32
        Transmittance behind it, above 0.
    colors : (3, m) float32
    counts : (C,) int64
        See `in_front`.
    """
    red_green = behind(paired(weight * colors[0], weight * colors[1]), counts)
    blue = behind((weight * colors[2]).astype(np.float64), counts)
    for own, light in zip(colors, (red_green.real, red_green.imag, blue), strict=True):
        contrast = light.astype(np.float32)
        contrast /= left  # the colour behind
        contrast -= own
        yield contrast
