"""What hides what in a view: splats as points in the columns of a grid of cells, front to back.

A froxel is a cell of the image times a slab of depth. Slabs here are as thin as can be: within a
cell everything is in its exact order of depth, by one radix sort, and running sums along it say
how much lies in front of each point and which colour lies behind it. There is no dense grid, so
memory goes with the number of points, whatever the depth of the scene.

A splat is a lattice of points over its footprint, each standing for the share of its mass around
it. In a cell of area A a point of opacity-weighted mass m covers ``a = m / A`` of it, and points
that know nothing of each other let ``prod (1 - a)`` through: optical thickness ``-log(1 - a)``.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from .projection import ALPHA_CUT

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .projection import Footprints
    from .views import View

ALPHA_MAX = 0.99
"""Renderers let no single splat hide more than this."""

DOUBT = 2.0
"""Shape of the gamma distribution that the thickness in front is believed to have; see `light`."""

MAX_CELLS = 65535
"""Cells are numbered by 16 bits: such numbers sort by counting, in linear time."""

MAX_POINTS = 1 << 22
"""Points in one view, at most; cells grow until they suffice. About 100 bytes each."""

COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""How many points a lattice may have along an axis."""

FLAT = 16
"""Points along either side of the image for a splat that the whole image lies in."""

_EXTENT, _WIDE_EXTENT, _WIDE = 2.4, 3.0, 8  # standard deviations; the latter from 8 points on
_GROWTH = 2.0**0.25


@dataclass(frozen=True, eq=False)
class Lattices:
    """Lattices of points for the standard normal distribution, one after the other.

    Attributes
    ----------
    starts, counts : (L, L) int64
        First point, and number of points, of the lattice with ``COUNTS[i]`` points along the
        major and ``COUNTS[j]`` along the minor axis.
    points : (2, P) float32
        In standard deviations.
    weights : (P,) float32
        Share of the mass; sums to 1 in every lattice.

    The last ``FLAT * FLAT`` points are a lattice over an image, from -1 to 1.
    """

    starts: NDArray[np.int64]
    counts: NDArray[np.int64]
    points: NDArray[np.float32]
    weights: NDArray[np.float32]


@functools.cache
def lattices() -> Lattices:
    """Return the lattices (made once)."""
    lines = [_line(count) for count in COUNTS]
    starts = np.zeros((len(COUNTS), len(COUNTS)), np.int64)
    counts = np.zeros_like(starts)
    points: list[NDArray[np.float64]] = []
    weights: list[NDArray[np.float64]] = []
    for i, (x, x_weight) in enumerate(lines):
        for j, (y, y_weight) in enumerate(lines):
            weight = np.outer(x_weight, y_weight)
            radius = np.hypot(x[:, None], y)
            extent = _WIDE_EXTENT if COUNTS[max(i, j)] >= _WIDE else _EXTENT
            keep = (radius <= extent + 0.1) | (weight.size <= 4)  # noqa: PLR2004 - 2 x 2 is whole
            starts[i, j] = sum(map(len, weights))
            counts[i, j] = np.count_nonzero(keep)
            share = weight[keep] / weight[keep].sum()
            place = np.stack([axis[keep] for axis in np.broadcast_arrays(x[:, None], y)])
            variance = (place * place) @ share  # the corners are gone: back to 1
            points.append(place / np.sqrt(np.where(variance > 0.0, variance, 1.0))[:, None])
            weights.append(share)
    flat = (np.arange(FLAT) + 0.5) / FLAT * 2.0 - 1.0
    points.append(np.stack([axis.ravel() for axis in np.meshgrid(flat, flat)]))
    weights.append(np.full(FLAT * FLAT, 1.0 / FLAT**2))
    return Lattices(
        starts,
        counts,
        np.concatenate(points, axis=1).astype(np.float32),
        np.concatenate(weights).astype(np.float32),
    )


def _line(count: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return points and weights on a line: equal bins, each at its mean, with variance 1."""
    if count == 1:
        return np.zeros(1), np.ones(1)
    extent = _WIDE_EXTENT if count >= _WIDE else _EXTENT
    edges = np.linspace(-extent, extent, count + 1)
    mass = np.diff([math.erf(edge / math.sqrt(2.0)) for edge in edges]) / 2.0
    density = np.exp(-edges * edges / 2.0) / math.sqrt(2.0 * math.pi)
    place = -np.diff(density) / mass  # the mean of the normal distribution within each bin
    mass /= mass.sum()
    return place / np.sqrt(np.sum(mass * place * place)), mass


@dataclass(frozen=True, eq=False)
class Points:
    """The m points of all splats that fall in the image, by cell and, in each, front to back.

    Points of one splat in one cell are one: a splat does not hide itself.

    Attributes
    ----------
    owners : (m,) int64
        Row of the `Footprints`.
    weights : (m,) float32
        Share of the splat's mass.
    columns : (C,) int64
        How many points each occupied cell holds.
    area : float
        Of a cell, px^2.
    """

    owners: NDArray[np.int64]
    weights: NDArray[np.float32]
    columns: NDArray[np.int64]
    area: float


def cell_size(footprints: Footprints, view: View, cell: float, density: float) -> float:
    """Return the side of a cell: `cell` pixels, or more where a limit asks for it."""
    side = max(cell, math.sqrt(view.width * view.height / MAX_CELLS) * 1.01)
    while math.ceil(view.width / side) * math.ceil(view.height / side) > MAX_CELLS:
        side *= _GROWTH  # an image a few pixels thin
    while _points_needed(footprints, side, density) > MAX_POINTS:
        side *= _GROWTH
    return side


def _points_needed(footprints: Footprints, side: float, density: float) -> float:
    along = (footprints.sigmas * np.float32(density / side)).clip(1.0, COUNTS[-1])
    return float(np.dot(along[0], along[1]))


def scatter(footprints: Footprints, view: View, side: float, density: float) -> Points:
    """Lay points over the footprints and sort them into the cells.

    Parameters
    ----------
    footprints : Footprints
        Front to back.
    view : View
    side : float
        Of a cell, pixels.
    density : float
        Points per standard deviation for cells of that size.
    """
    table = lattices()
    index = _lattice_index(footprints.sigmas, density / side)
    counts, firsts = table.counts[index[0], index[1]], table.starts[index[0], index[1]]
    # Of a splat much larger than the image no point of its own lattice may fall there.
    vast = footprints.sigmas[0] * (2 * _WIDE_EXTENT / COUNTS[-1]) > max(view.width, view.height) / 8
    counts = np.where(vast, FLAT * FLAT, counts)
    firsts = np.where(vast, len(table.weights) - FLAT * FLAT, firsts)
    owners = np.repeat(np.arange(len(counts)), counts)
    which = np.arange(len(owners)) + np.repeat(firsts - (np.cumsum(counts) - counts), counts)
    x, y = table.points[0, which], table.points[1, which]
    across = math.ceil(view.width / side)
    inside = np.ones(len(owners), np.bool_)
    place = []
    for axis, size in enumerate((view.width, view.height)):
        half = np.float32(size / 2)
        spans = [half, half * (axis == 0), half * (axis == 1)]
        values = footprints.centers[axis], footprints.major[axis], footprints.minor[axis]
        middle, major, minor = (
            np.repeat(np.where(vast, flat, own), counts)
            for flat, own in zip(spans, values, strict=True)
        )
        where = middle + major * x
        where += minor * y
        inside &= (where >= 0.0) & (where < size)
        place.append(where)
    weights = table.weights[which]
    if vast.any():
        flat = np.flatnonzero(vast[owners])
        weights[flat] = _flat_weights(footprints, owners[flat], [w[flat] for w in place], view)
    if not inside.all():
        owners, weights = owners[inside], weights[inside]
        place = [where[inside] for where in place]
    column, row = ((where * np.float32(1.0 / side)).astype(np.int32) for where in place)
    # Rounding may put the last pixel one cell beyond the last.
    row = np.minimum(row, math.ceil(view.height / side) - 1) * np.int32(across)
    cells = (row + np.minimum(column, across - 1)).astype(np.uint16)
    return _merged(cells, owners, weights, side * side)


def _flat_weights(
    footprints: Footprints,
    owners: NDArray[np.int64],
    place: list[NDArray[np.float32]],
    view: View,
) -> NDArray[np.float32]:
    """Share of a splat's mass around points of the lattice over the image, (m,)."""
    squared = np.zeros(len(owners), np.float32)
    offset = [where - footprints.centers[axis, owners] for axis, where in enumerate(place)]
    for half, sigma in zip((footprints.major, footprints.minor), footprints.sigmas, strict=True):
        along = (offset[0] * half[0, owners] + offset[1] * half[1, owners]) / sigma[owners] ** 2
        squared += along * along
    area = view.width * view.height / FLAT**2
    mass = np.float32(2.0 * math.pi) * footprints.sigmas[0] * footprints.sigmas[1]
    return np.asarray(np.exp(squared.clip(0.0, 100.0) / -2.0) * (area / mass[owners]))


def _merged(
    cells: NDArray[np.uint16],
    owners: NDArray[np.int64],
    weights: NDArray[np.float32],
    area: float,
) -> Points:
    """Sort points into the cells and merge those of one splat in one cell."""
    if not len(cells):
        return Points(owners, weights, np.empty(0, np.int64), area)
    order = np.argsort(cells, kind="stable")  # footprints came front to back, so cells stay so
    owners = owners[order]
    filled = np.bincount(cells)
    filled = filled[filled > 0]
    tops = np.cumsum(filled) - filled
    new = np.empty(len(owners), np.bool_)
    np.not_equal(owners[1:], owners[:-1], out=new[1:])
    new[tops] = True
    starts = np.flatnonzero(new)
    columns = np.add.reduceat(new, tops, dtype=np.int64)
    return Points(owners[starts], np.add.reduceat(weights[order], starts), columns, area)


def _lattice_index(sigmas: NDArray[np.float32], scale: float) -> NDArray[np.int64]:
    """Return which of `COUNTS` has enough points for each axis, (2, n)."""
    wanted = np.ceil((sigmas * np.float32(scale)).clip(1.0, COUNTS[-1])).astype(np.int64)
    return np.asarray(np.searchsorted(COUNTS, np.arange(COUNTS[-1] + 1))[wanted])


def thickness(
    points: Points, alphas: NDArray[np.float32], mass: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Optical thickness that each point adds to its cell, (m,).

    ``-log(1 - a)``, a the share of the cell that it covers: its mass over the cell's area, and no
    more than the splat's opacity.
    """
    share = points.weights * (mass / np.float32(points.area))[points.owners]
    np.minimum(share, np.minimum(alphas, ALPHA_MAX).astype(np.float32)[points.owners], out=share)
    return np.asarray(-np.log(np.float32(1.0) - share))


def in_front(points: Points, thick: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum the thickness, (m,), in front of each point in its cell."""
    total = np.cumsum(thick, dtype=np.float64)
    total -= thick
    starts = np.cumsum(points.columns) - points.columns
    total -= np.repeat(total[starts], points.columns)
    return total.astype(np.float32)


def light(front: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the expected transmittance through a thickness known from its mean over a cell alone.

    ``E[exp(-tau)] = (1 + mean / k)^-k`` for tau of a gamma distribution of shape k, `DOUBT`.
    A cell says how much lies in front, not whether it leaves a gap for the point: ``exp(-mean)``
    would take what shows through foliage for hidden, and the score would throw it away.
    """
    base = np.float32(1.0) + front * np.float32(1.0 / DOUBT)
    return np.asarray(np.float32(1.0) / (base * base))


def contrast(
    points: Points,
    front: NDArray[np.float32],
    thick: NDArray[np.float32],
    colors: NDArray[np.float32],
) -> NDArray[np.float32]:
    """Squared difference between each point's colour and that behind it in its cell, (m,).

    The colour in front of point k is ``C_k = sum over j < k of T_j a_j c_j``; behind it, over
    black, is ``B_k = (C_end - C_{k+1}) / T_{k+1}``.

    Parameters
    ----------
    points : Points
    front, thick : (m,) float32
        Optical thickness in front of it, and its own.
    colors : (m, 3) float32
    """
    through = np.exp(-np.minimum(front, np.float32(60.0)))
    left = through * np.exp(-thick)
    weight = through - left
    ends = np.cumsum(points.columns) - 1
    # Where less than this is left, what is behind changes nothing that could be seen.
    scale = np.float32(1.0) / np.maximum(left, np.float32(1e-4))
    squared = np.zeros_like(front)
    for channel in range(3):
        color = np.ascontiguousarray(colors[:, channel])
        shown = np.cumsum(weight * color, dtype=np.float64)
        behind = (np.repeat(shown[ends], points.columns) - shown).astype(np.float32)
        behind *= scale
        behind -= color
        squared += behind * behind
    return squared


def per_splat(points: Points, values: NDArray[np.float32], count: int) -> NDArray[np.float64]:
    """Sum values, (m,), times the weights over the points of each of `count` splats."""
    return np.bincount(points.owners, points.weights * values, count).astype(np.float64)


def masses(
    footprints: Footprints, alphas: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Integrals of alpha and of alpha^2 over each footprint, px^2.

    With ``S`` the product of the two sigmas and the footprint ending where alpha is `ALPHA_CUT`::

        integral of A exp(-q / 2) = 2 pi S (A - cut)
        integral of A^2 exp(-q)   =   pi S (A^2 - cut^2)
    """
    area = np.float32(2.0 * math.pi) * footprints.sigmas[0] * footprints.sigmas[1]
    excess = alphas - np.float32(ALPHA_CUT)
    return area * excess, np.float32(0.5) * area * excess * (alphas + np.float32(ALPHA_CUT))
