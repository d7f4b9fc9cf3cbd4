"""The scene's own frame: its middle, size and axes. (`operations.Scene` holds splats and demands.)

Results in float32 or compared with constants are computed in it, so they depend neither on the
frame of a file nor on the order of its splats.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..execute import chunks, run_all
from ..splats import Splats
from ..views import ViewSet

MIX = np.uint64(0x9E3779B97F4A7C15)
"""2^64 over the golden ratio: its multiples spread numbers that differ little."""

_CHUNK = 1 << 16  # rows that are computed together, which limits temporary memory
_SAMPLE = 10_000  # least positions for the medians in `nearby_order`; more change them little
_FARTHEST = 1e100  # in sizes; positions are clipped to it there, so that their squares are finite
_BITS = 21  # of each coordinate in `spatial_order`; three of them fit an int64
_SPREAD_BITS = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that leave two free bits behind each bit of a 21-bit number."""


@dataclass(frozen=True, eq=False)
class Scene:
    """The frame of a scene, in world units.

    Size is ``sqrt(S + V)`` (docs/method.md, section 1): S is the median over drawable splats of the
    squared distance to the origin, V that over views.
    """

    origin: NDArray[np.float64]  # (3,), geometric median of the views' centres
    size: float  # > 0
    axes: NDArray[np.float64]  # (3, 3), world to frame: rows are the splats' principal axes

    def positions(
        self, means: NDArray[Any], rows: NDArray[np.int64] | None = None
    ) -> NDArray[np.float64]:
        """Positions in the frame, (M, 3) scene sizes, of world means (N, 3), or M of their rows."""
        count, turn = len(means) if rows is None else len(rows), self.axes.T / self.size
        places = np.empty((count, 3))

        def fill(piece):
            # At least two rows at a time: BLAS rounds the product of one otherwise.
            begin = max(min(piece.start, piece.stop - 2), 0)
            chosen = slice(begin, piece.stop) if rows is None else rows[begin : piece.stop]
            product = (means[chosen] - self.origin) @ turn
            places[piece] = product[piece.start - begin :]

        run_all(fill, chunks(count, _CHUNK))
        return places


def size_of(median: float) -> float:
    """Size of a scene, from S + V of `Scene`; 1 if all is in one point."""
    return float(np.sqrt(median)) or 1.0


def scene_of(means: NDArray[Any], drawable: NDArray[np.bool_], views: ViewSet) -> Scene:
    """Frame of views and of those splats that are drawable."""
    origin, views_squared = views.middle()
    squared = np.empty(len(means))

    def measure(piece):
        # Undrawable splats may hold any number, such as infinity.
        offset = np.where(drawable[piece, None], means[piece], origin) - origin  # (n, 3)
        squared[piece] = np.einsum("ij,ij->i", offset, offset) + views_squared

    run_all(measure, chunks(len(means), _CHUNK))
    median = float(np.median(squared[drawable])) if drawable.any() else 0.0
    unturned = Scene(origin, size_of(median), np.eye(3))

    def moments(piece):  # weighted 1 / (1 + r^2)^2: far splats hardly matter
        positions = unturned.positions(means[piece][drawable[piece]])  # (n, 3)
        nearness = (1.0 + np.einsum("ij,ij->i", positions, positions)) ** -2.0  # (n,)
        weighted = positions * nearness[:, None]
        return np.vstack([weighted.T @ positions, weighted.sum(axis=0)])

    of_pieces = run_all(moments, chunks(len(means), _CHUNK))
    return replace(unturned, axes=principal_axes(sum(of_pieces, np.zeros((4, 3)))))


def principal_axes(total: NDArray[np.float64]) -> NDArray[np.float64]:
    """Principal axes as rows of a rotation, least variance first, from sums of positions p.

    `total`, (4, 3), holds the sums of ``w p p'`` and of ``w p``, w a weight; the latter set signs.
    """
    _, vectors = np.linalg.eigh(total[:3])  # in columns
    axes = (vectors * np.where(total[3] @ vectors < 0.0, -1.0, 1.0)).T
    if np.linalg.det(axes) < 0.0:
        axes[2] = -axes[2]
    return np.ascontiguousarray(axes)


def fingerprint(*columns: NDArray[Any]) -> NDArray[np.uint64]:
    """A hash of each row of float32 columns, (N,) each; give it values that no motion changes."""
    key = np.zeros(len(columns[0]), np.uint64)
    for values in columns:
        with np.errstate(over="ignore", under="ignore"):  # of float64
            bits = np.ascontiguousarray(values, np.float32).view(np.uint32)
        key = (key ^ bits) * MIX
        key ^= key >> np.uint64(29)
    return key


def splat_fingerprint(splats: Splats, rows: NDArray[np.int64]) -> NDArray[np.uint64]:
    """`fingerprint` of opacity and base colour of splats by their rows, (n,)."""
    return fingerprint(splats.opacity_logits[rows], *splats.sh_dc[rows].T)


def spatial_order(
    positions: NDArray[np.float64],
    ties: Callable[[NDArray[np.int64]], NDArray[np.uint64]] | None = None,
) -> NDArray[np.int64]:
    """Rows of positions, (N, 3) scene sizes, along a Z-curve (Morton, 1966): near ones are close.

    Those that agree in 21 bits a coordinate are ordered by ``ties(rows)``, or keep their order.
    """
    code, cells = np.empty(len(positions), np.int64), float(1 << _BITS)

    def fill(piece):
        place, interleaved = positions[piece], 0
        # All of space is mapped into a ball, so the resolution falls with the distance.
        scale = cells / 2.0 / (1.0 + np.sqrt(np.einsum("ij,ij->i", place, place)))  # (n,)
        for axis in range(3):
            bits = (place[:, axis] * scale + cells / 2.0).clip(0.0, cells - 1.0).astype(np.int64)
            for shift, mask in _SPREAD_BITS:
                bits = (bits | bits << shift) & mask
            interleaved |= bits << axis
        code[piece] = interleaved

    run_all(fill, chunks(len(positions), _CHUNK))
    order = np.argsort(code, kind="stable")
    if ties is not None and (same := np.diff(code[order]) == 0).any():  # (N - 1,)
        tied = np.flatnonzero(np.append(same, False) | np.append(False, same))
        rows = order[tied]
        order[tied] = rows[np.lexsort((ties(rows), code[rows]))]
    return order


def nearby_order(means: NDArray[Any]) -> NDArray[np.int64]:
    """Order, (N,), of finite positions, (N, 3), along a Z-shaped (Morton) curve."""
    sample = np.asarray(means[:: max(len(means) // _SAMPLE, 1)], np.float64)
    middle = np.median(sample, axis=0)
    size = float(np.median(np.abs(sample - middle))) or 1.0
    with np.errstate(over="ignore", under="ignore"):
        place = (np.asarray(means, np.float64) - middle) / size
        return spatial_order(np.clip(place, -_FARTHEST, _FARTHEST))
