"""Selections of splats: how they are combined, painted, grown, and bounded on a histogram."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from .execute import Progress, silent
from .merging.neighbours import nearest

Mode = Literal["SET", "ADD", "SUBTRACT", "INTERSECT"]
"""What becomes of a selection when some splats are taken."""

NEIGHBOURS = 8
"""So many nearest splats are the neighbours by which a selection grows and shrinks."""


def combined(before: NDArray[np.bool_], taken: NDArray[np.bool_], mode: Mode) -> NDArray[np.bool_]:
    """A selection, (N,), once some splats were taken, (N,).

    Examples
    --------
    >>> before, taken = np.array([True, True, False]), np.array([True, False, True])
    >>> combined(before, taken, "SUBTRACT").tolist()
    [False, True, False]
    """
    if mode == "ADD":
        return before | taken
    if mode == "SUBTRACT":
        return before & ~taken
    return before & taken if mode == "INTERSECT" else taken


def polygon(corners: Sequence[tuple[float, float]], width: int, height: int) -> NDArray[np.bool_]:
    """Pixels whose centres lie in a polygon, (height, width), by the even-odd rule.

    Parameters
    ----------
    corners : sequence of (float, float)
        Column and row, pixels; the last is joined to the first.
    width, height : int
        Of the image.

    Examples
    --------
    >>> polygon([(1, 0), (3, 0), (3, 2), (1, 2)], 4, 3).astype(int).tolist()
    [[0, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 0]]
    """
    # Each edge turns all pixels to the right of it, row by row: one change a row, summed later.
    turns = np.zeros((height, width + 1), np.uint8)
    ends = np.asarray(corners, np.float64).reshape(-1, 2)
    for (x, y), (u, v) in zip(ends, np.roll(ends, -1, axis=0), strict=True):
        first, last = (min(max(math.ceil(end - 0.5), 0), height) for end in sorted((y, v)))
        if first < last:
            rows = np.arange(first, last)
            crossing = x + (rows + 0.5 - y) * ((u - x) / (v - y))
            columns = np.ceil(crossing - 0.5).clip(0, width).astype(np.int64)
            turns[rows, columns] ^= 1
    return np.bitwise_xor.accumulate(turns[:, :-1], axis=1).astype(np.bool_)


def paint(
    area: NDArray[np.bool_], start: tuple[float, float], end: tuple[float, float], radius: float
) -> None:
    """Add to an area, (H, W), the pixels that a round brush covers on its way.

    Parameters
    ----------
    area : (H, W) bool
        Changed in place.
    start, end : (float, float)
        Column and row of the brush's middle, pixels.
    radius : float
        Pixels.
    """
    (left, right), (top, bottom) = (
        (max(math.floor(min(ends) - radius), 0), min(math.ceil(max(ends) + radius) + 1, size))
        for ends, size in zip(zip(start, end, strict=True), area.shape[::-1], strict=True)
    )
    if left >= right or top >= bottom:
        return
    across = np.arange(left, right) + 0.5 - start[0]  # from the start, pixels
    down = (np.arange(top, bottom) + 0.5 - start[1])[:, None]
    way = end[0] - start[0], end[1] - start[1]
    length = way[0] ** 2 + way[1] ** 2
    along = ((across * way[0] + down * way[1]) / length).clip(0.0, 1.0) if length else 0.0
    squared = (across - along * way[0]) ** 2 + (down - along * way[1]) ** 2
    area[top:bottom, left:right] |= squared <= radius * radius


def grown(neighbours: NDArray[np.int32], selected: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A selection, (N,), and the neighbours of its splats.

    Parameters
    ----------
    neighbours : (N, K) int32
        See `neighbours_of`; two splats are neighbours if one is among those of the other.
    selected : (N,) bool
    """
    more: NDArray[np.bool_] = selected | selected[neighbours].any(axis=1)
    more[neighbours[selected].ravel()] = True
    return more


def shrunk(neighbours: NDArray[np.int32], selected: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A selection, (N,), without the splats that have a neighbour outside it."""
    return ~grown(neighbours, ~selected)


def neighbours_of(means: NDArray[Any], *, progress: Progress = silent) -> NDArray[np.int32]:
    """The `NEIGHBOURS` nearest of each splat, (N, K), of centres (N, 3).

    Splats that are not finite have neighbours of no meaning.
    """
    places = np.asarray(means, np.float64)
    finite = np.isfinite(places).all(axis=1)
    if not finite.any():
        return np.empty((len(places), 0), np.int32)
    middle = np.median(places[finite], axis=0)
    extent = np.median(np.abs(places[finite] - middle).max(axis=1)) or 1.0
    places = np.where(finite[:, None], (places - middle) / extent, 0.0)
    return nearest(places, NEIGHBOURS, progress=progress)


@dataclass(frozen=True)
class Axis:
    """The axis of a histogram, 0 to 1.

    Attributes
    ----------
    low, high : float
        The values at its ends, or their logarithms to base 10.
    logarithmic : bool
    """

    low: float
    high: float
    logarithmic: bool = False

    @classmethod
    def of(cls, values: NDArray[Any], *, logarithmic: bool = False) -> Axis:
        """Axis that holds all finite values; logarithmic, all but the least hundredth."""
        usable = values[np.isfinite(values) & ((values > 0.0) | (not logarithmic))]
        if not len(usable):
            return cls(0.0, 1.0, logarithmic)
        if logarithmic:
            usable = np.log10(np.quantile(usable.astype(np.float64), [0.01, 1.0]))
        low, high = float(usable.min()), float(usable.max())
        return cls(low, high if high > low else low + 1.0, logarithmic)

    def places(self, values: NDArray[Any]) -> NDArray[np.float64]:
        """Places of values, (N,), 0 to 1; those beyond an end lie at it, as NaN at 0."""
        numbers = np.asarray(values, np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            numbers = np.log10(numbers) if self.logarithmic else numbers
            shares = (numbers - self.low) / (self.high - self.low)
        return np.nan_to_num(shares, nan=0.0, posinf=1.0, neginf=0.0).clip(0.0, 1.0)

    def value(self, place: float) -> float:
        """Value at a place of the axis.

        Examples
        --------
        >>> Axis(-2.0, 0.0, logarithmic=True).value(0.5)
        0.1
        """
        number = self.low + place * (self.high - self.low)
        return float(10.0**number) if self.logarithmic else number
