"""Occlusion in one view: points of splats, sorted by depth within the cells of the image.

Each splat is replaced by a lattice of points over its footprint; each point has a share of the
splat's mass, which is the integral of its alpha. The image is divided into square cells. Within a
cell the points are sorted by depth, and running sums along the depth give the optical thickness in
front of each point and the colour behind it. (A froxel is a cell of the image times a slab of
depth. Sorted points are slabs without thickness, so no grid of depths has to be chosen or stored.)

A point of mass m covers the share ``a = m / A`` of a cell of area A. Points that are independent of
each other transmit ``prod (1 - a)``, so each has the optical thickness ``-log(1 - a)``.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..rendering import ALPHA_CUT, ALPHA_MAX
from ..work import checkpoint

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from typing import Any

    from numpy.typing import NDArray

    from ..views import View
    from .projection import Footprints

GAMMA_SHAPE = 2.3
"""Shape of the gamma distribution of the thickness in front of a point. The larger it is, the
narrower the distribution: `transmittance` tends to exp(-mean)."""

FEW_CELLS = 10_000
"""An image may have this many cells however few footprints it has."""

FOOTPRINTS = 4.0
"""An image of more than `FEW_CELLS` cells has at least this many footprints for each of them. So
the cells follow the splats, not the pixels: finer ones show nothing that the splats have."""

MAX_CELLS = 65535
"""Most cells of an image: NumPy sorts numbers of 16 bits by radix, in linear time."""

MAX_POINTS = 1 << 22
"""Most points of a view, as estimated: cells grow until it is met. A point takes about 100 bytes.
"""

LEAST_POINTS = 1.25
"""A view has this many points a footprint where `MAX_POINTS` would be fewer: a footprint has at
least one point, however large the cells are."""

COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""How many points a lattice may have along an axis."""

FLAT = 16
"""A splat much larger than the image gets this many points across and down the image instead."""

Line = tuple["NDArray[np.float64]", "NDArray[np.float64]"]
"""Points on a line and the share of the mass that each has."""

_EXTENT, _WIDE_EXTENT, _WIDE = 2.4, 3.0, 8  # standard deviations; the wide one from 8 points on
_GROWTH = 2.0**0.25  # factor by which the side of a cell grows in a step
_OUTSIDE = MAX_CELLS  # the cell number of points outside the image
_BLOCK = 1 << 16  # points processed at a time, which limits temporary memory


@dataclass(frozen=True, eq=False)
class Lattice:
    """Points that stand for the standard normal distribution in two dimensions.

    Attributes
    ----------
    points : (2, k) float32
        In standard deviations along the major and the minor axis.
    shares : (k,) float32
        Of the mass; their sum is 1.
    """

    points: NDArray[np.float32]
    shares: NDArray[np.float32]


@functools.cache
def lattices() -> tuple[Lattice, ...]:
    """Return all lattices: number ``i L + j`` has ``COUNTS[i]`` by ``COUNTS[j]`` points.

    L is the length of `COUNTS`. One more at the end has `FLAT` by `FLAT` points over the image;
    their coordinates are -1 to 1, in half image sizes.
    """
    lines = [_line(count) for count in COUNTS]
    made = [_lattice(major, minor) for major in lines for minor in lines]
    line = (np.arange(FLAT) + 0.5) / FLAT * 2.0 - 1.0
    flat = np.stack([axis.ravel() for axis in np.meshgrid(line, line)]).astype(np.float32)
    return (*made, Lattice(flat, np.full(FLAT**2, 1.0 / FLAT**2, np.float32)))


def _lattice(major: Line, minor: Line) -> Lattice:
    """Return the grid of two lines without its corners, scaled to variance 1 again."""
    product = np.outer(major[1], minor[1])  # (k_major, k_minor), shares
    place = np.broadcast_arrays(major[0][:, None], minor[0])  # (k_major, k_minor) each
    extent = _WIDE_EXTENT if max(product.shape) >= _WIDE else _EXTENT
    keep = np.hypot(*place) <= extent + 0.1
    keep |= product.size <= 4  # noqa: PLR2004 - 2 x 2 points are all corners
    shares = product[keep] / product[keep].sum()  # (k,)
    points = np.stack([axis[keep] for axis in place])  # (2, k)
    variance = (points * points) @ shares
    points /= np.sqrt(np.where(variance > 0.0, variance, 1.0))[:, None]
    return Lattice(points.astype(np.float32), shares.astype(np.float32))


def _line(count: int) -> Line:
    """Return the normal distribution as points: its mean in bins of equal width, variance 1."""
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
    """The m points inside the image, cell by cell, and front to back in each cell.

    Points of one splat in one cell are merged into one, so that a splat does not hide itself.

    Attributes
    ----------
    owners : (m,) int64
        Row of the `Footprints`.
    shares : (m,) float32
        Of the splat's mass.
    columns : (C,) int64
        How many points lie in each of the C cells that are not empty.
    area : float
        Of a cell, px^2.
    """

    owners: NDArray[np.int64]
    shares: NDArray[np.float32]
    columns: NDArray[np.int64]
    area: float

    def pieces(self) -> Iterator[tuple[slice, Points]]:
        """Yield about `_BLOCK` points at a time, in whole cells: a slice and its points."""
        for cells, place in _runs(self.columns):
            checkpoint()
            columns = self.columns[cells]
            yield place, Points(self.owners[place], self.shares[place], columns, self.area)


def _runs(sizes: NDArray[np.int64]) -> Iterator[tuple[slice, slice]]:
    """Yield runs of consecutive groups with about `_BLOCK` members: slices of both.

    Parameters
    ----------
    sizes : (G,) int64
        How many members each group has.

    Yields
    ------
    groups, members : slice
    """
    ends = np.cumsum(sizes)
    cuts = np.searchsorted(ends, np.arange(_BLOCK, int(sizes.sum()), _BLOCK)) + 1
    start = member = 0
    for cut in np.unique([*cuts, len(sizes)]).tolist():
        if cut > start:
            yield slice(start, cut), slice(member, int(ends[cut - 1]))
            start, member = cut, int(ends[cut - 1])


def cell_size(footprints: Footprints, view: View, cell: float, density: float) -> float:
    """Return the side of a cell, pixels: `cell`, or larger, which saves points.

    It is larger where the image would have more cells than the footprints need (`FOOTPRINTS`), or
    more than `MAX_CELLS`, and where the footprints would have more than `MAX_POINTS` points.
    """
    needed = max(FEW_CELLS, len(footprints.index) / FOOTPRINTS)
    side = max(cell, math.sqrt(view.width * view.height / min(needed, MAX_CELLS)) * 1.01)
    while math.ceil(view.width / side) * math.ceil(view.height / side) > MAX_CELLS:
        side *= _GROWTH  # happens for images that are only a few pixels wide or high
    # As cells grow, the points needed fall to one a footprint, which is below this limit.
    limit = max(MAX_POINTS, LEAST_POINTS * len(footprints.index))
    while _points_needed(footprints, side, density) > limit:
        side *= _GROWTH
    return side


def _points_needed(footprints: Footprints, side: float, density: float) -> float:
    """Return about how many points the footprints have with cells of this side."""
    along = (footprints.sigmas * np.float32(density / side)).clip(1.0, COUNTS[-1])
    return float(np.dot(along[0], along[1]))


def scatter(footprints: Footprints, view: View, side: float, density: float) -> Points:
    """Return points over all footprints, sorted into cells.

    Parameters
    ----------
    footprints : Footprints
        Front to back.
    view : View
    side : float
        Of a cell, pixels.
    density : float
        Points per standard deviation that is as long as a cell.
    """
    kinds = _kinds(footprints, view, density / side)  # (n,)
    sizes, *_ = _table()
    counts = sizes[kinds]  # (n,), points of each footprint
    cells = np.empty(int(counts.sum()), np.uint16)  # (p,), as all that follows
    shares = np.empty(len(cells), np.float32)
    for row, place in _runs(counts):
        checkpoint()
        cells[place], shares[place] = _laid(footprints, row, kinds[row], view, side)
    # Replace the points of the few splats that are much larger than the image.
    vast = np.flatnonzero(kinds == len(sizes) - 1)
    if len(vast):
        at = np.cumsum(counts)[vast][:, None] - np.arange(FLAT**2, 0, -1)
        cells[at], shares[at] = _flat(footprints, vast, view, side)
    owners = np.repeat(np.arange(len(counts), dtype=np.int32), counts)
    return _merged(cells, owners, shares, side * side)


def _kinds(footprints: Footprints, view: View, scale: float) -> NDArray[np.uint8]:
    """Return which of `lattices` each footprint gets, (n,); `scale`: points per pixel of sigma."""
    table = np.searchsorted(COUNTS, np.arange(COUNTS[-1] + 1)).astype(np.uint8)
    wanted = np.ceil((footprints.sigmas * np.float32(scale)).clip(1.0, COUNTS[-1]))  # (2, n)
    index = table[wanted.astype(np.int64)]  # (2, n)
    # The points of a larger lattice are so far apart that all of them could miss the image.
    spacing = footprints.sigmas[0] * (2.0 * _WIDE_EXTENT / COUNTS[-1])
    vast = spacing > max(view.width, view.height) / 8
    kinds = index[0] * np.uint8(len(COUNTS)) + index[1]
    return np.where(vast, np.uint8(len(COUNTS) ** 2), kinds)


@functools.cache
def _table() -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[Any], NDArray[Any]]:
    """Return all L lattices in one table: sizes (L,), starts (L,), points (2, K), shares (K,)."""
    sizes = np.array([len(lattice.shares) for lattice in lattices()])
    points = np.concatenate([lattice.points for lattice in lattices()], axis=1)
    shares = np.concatenate([lattice.shares for lattice in lattices()])
    return sizes, np.cumsum(sizes) - sizes, points, shares


def _laid(
    footprints: Footprints, row: slice, kinds: NDArray[np.uint8], view: View, side: float
) -> tuple[NDArray[np.uint16], NDArray[np.float32]]:
    """Return cells and shares, (p,) each, of the points of r footprints, one after the other."""
    sizes, starts, points, shares = _table()
    counts = sizes[kinds]  # (r,)
    first = np.cumsum(counts) - counts  # (r,), number of each footprint's first point
    # (p,), row of the table for each point: start of its footprint's lattice plus a running number.
    which = np.arange(int(counts.sum())) - np.repeat(first - starts[kinds], counts)
    along, across = points[0].take(which), points[1].take(which)
    place = []
    for axis in range(2):
        where = along * np.repeat(footprints.major[axis, row], counts)
        where += across * np.repeat(footprints.minor[axis, row], counts)
        where += np.repeat(footprints.centers[axis, row], counts)
        place.append(where)
    return _cells(place, view, side), shares.take(which)


def _cells(place: list[NDArray[np.float32]], view: View, side: float) -> NDArray[np.uint16]:
    """Return the number of each point's cell, (p,), or `_OUTSIDE` for points beside the image.

    Parameters
    ----------
    place : list of (p,) float32
        Across and down, pixels.
    view : View
    side : float
        Of a cell, pixels.
    """
    inside = np.ones(place[0].shape, np.bool_)
    number = np.zeros(place[0].shape, np.int32)
    for where, size in zip(place[::-1], (view.height, view.width), strict=True):
        inside &= where >= 0.0
        inside &= where < size
        # Clipped as floats, since far points do not fit an integer. Rounding of float32 can put
        # the last pixel one cell too far, which the clipping corrects.
        cell = where * np.float32(1.0 / side)
        np.maximum(cell, np.float32(0.0), out=cell)
        np.minimum(cell, np.float32(math.ceil(size / side) - 1), out=cell)
        number *= math.ceil(view.width / side)
        number += cell.astype(np.int32)
    cells = number.astype(np.uint16)
    cells[~inside] = _OUTSIDE
    return cells


def _flat(
    footprints: Footprints, row: NDArray[np.int64], view: View, side: float
) -> tuple[NDArray[np.uint16], NDArray[np.float32]]:
    """Return cells, (FLAT^2,), and shares, (r, FLAT^2), for r footprints wider than the image.

    The share of a point is the density of the splat's mass there times the area around the point.
    """
    points = lattices()[-1].points
    u = np.float32(view.width / 2) * (points[0] + 1)
    v = np.float32(view.height / 2) * (points[1] + 1)
    squared = np.zeros((len(row), len(u)), np.float32)  # squared Mahalanobis distance
    dx = u - footprints.centers[0, row][:, None]
    dy = v - footprints.centers[1, row][:, None]
    for half, sigma in zip((footprints.major, footprints.minor), footprints.sigmas, strict=True):
        unit = half[:, row] / sigma[row] ** 2
        along = (dx * unit[0][:, None] + dy * unit[1][:, None]).clip(-15.0, 15.0)
        squared += along * along
    mass = np.float32(2.0 * math.pi) * footprints.sigmas[0, row] * footprints.sigmas[1, row]
    share = np.float32(view.width * view.height / FLAT**2) / mass
    return _cells([u, v], view, side), np.exp(squared / -2.0) * share[:, None]


def _merged(
    cells: NDArray[np.uint16],
    owners: NDArray[np.int32],
    shares: NDArray[np.float32],
    area: float,
) -> Points:
    """Sort p points into cells, and merge those of one splat in one cell.

    Parameters
    ----------
    cells : (p,) uint16
        Points of the cell `_OUTSIDE` are dropped.
    owners : (p,) int32
        Ascending, that is, front to back.
    shares : (p,) float32
    area : float
    """
    filled = np.bincount(cells, minlength=_OUTSIDE)[:_OUTSIDE]
    filled = filled[filled > 0]  # (C,), points of each cell before merging
    # A stable sort keeps the points of a cell front to back; those `_OUTSIDE` come last.
    order = np.argsort(cells, kind="stable")[: filled.sum()]
    checkpoint()
    if not len(order):
        return Points(order, shares[:0], order, area)
    owners = owners.take(order)
    tops = np.cumsum(filled) - filled  # first point of each cell
    new = np.empty(len(owners), np.bool_)  # whether a point is the first of its splat in its cell
    np.not_equal(owners[1:], owners[:-1], out=new[1:])
    new[tops] = True
    starts = np.flatnonzero(new)
    columns = np.add.reduceat(new, tops, dtype=np.int64)
    return Points(
        owners.take(starts).astype(np.int64),
        np.add.reduceat(shares.take(order), starts),
        columns,
        area,
    )


def thickness(
    points: Points, alphas: NDArray[np.float32], mass: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return the optical thickness of each point, (m,).

    It is ``-log(1 - a)``. a is the share of the cell that the point covers: its mass over the
    cell's area, at most the splat's opacity.

    Parameters
    ----------
    points : Points
    alphas, mass : (n,) float32
        Of the footprints.
    """
    covered = points.shares * (mass / np.float32(points.area)).take(points.owners)
    np.minimum(covered, np.minimum(alphas, np.float32(ALPHA_MAX)).take(points.owners), out=covered)
    np.subtract(np.float32(1.0), covered, out=covered)
    np.log(covered, out=covered)
    return np.negative(covered, out=covered)


def paired(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[Any]:
    """Return two real arrays as the real and imaginary parts of one complex array, (n,).

    Sums, and products with real numbers, work on both parts separately, so one running sum over the
    pair is two running sums in the time of one.
    """
    pair = np.empty(first.shape, np.result_type(first, np.complex64))
    pair.real, pair.imag = first, second
    return pair


def in_front(
    points: Points, thick: NDArray[np.float32], even: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the sums of two thicknesses, (m,) each, over the points in front in the same cell."""
    sums = _before(paired(thick, even), points.columns)
    return sums.real.astype(np.float32), sums.imag.astype(np.float32)


def _before(values: NDArray[Any], columns: NDArray[np.int64]) -> NDArray[Any]:
    """Return for each of `values`, (m,), the sum of those before it in its column, in float64.

    Parameters
    ----------
    values : (m,) floating or complex
    columns : (C,) int64
        Lengths of the columns, which follow each other.
    """
    starts = np.cumsum(columns) - columns
    steps = np.empty(len(values), np.result_type(values, np.float64))
    steps[1:] = values[:-1]
    steps[starts] = 0.0
    # Subtract the previous column's total, so that the running sum restarts at 0.
    steps[starts[1:]] = -np.add.reduceat(steps, starts)[:-1]
    return np.cumsum(steps)


def evenness(footprints: Footprints, area: float) -> NDArray[np.float32]:
    """Return the share of each splat's thickness that counts as uniform over the cell, (n,).

    It is ``s^2 / (s^2 + area)``, with s the shorter sigma and the area of the cell: near 0 for a
    splat much narrower than a cell, which leaves gaps, and near 1 for a much wider one.
    """
    narrow = footprints.sigmas[1] ** 2
    return np.asarray(narrow / (narrow + np.float32(area)))


def transmittance(front: NDArray[np.float32], even: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the transmittance in front of each point, (m,), given the mean thickness of its cell.

    Splats narrower than a cell leave gaps, so the thickness in front of a point differs from the
    cell's mean. It is modelled as gamma distributed with shape k, and the transmittance is the
    expectation ``E[exp(-tau)] = (1 + mean / k)^-k``. (With ``exp(-mean)``, splats that show through
    foliage would count as hidden and be removed.) The even part has no gaps: ``exp(-even)``.

    Parameters
    ----------
    front : (m,) float32
        Mean thickness in front of each point.
    even : (m,) float32
        The part of it that is uniform over the cell; see `evenness`.
    """
    shape = np.float32(GAMMA_SHAPE)
    gaps = np.maximum(front - even, np.float32(0.0))
    return np.asarray(np.exp(-even) * (np.float32(1.0) + gaps / shape) ** -shape)


def squared_contrast(
    points: Points,
    front: NDArray[np.float32],
    thick: NDArray[np.float32],
    colors: Sequence[NDArray[Any]],
) -> NDArray[np.float32]:
    """Return the squared contrast of each point, (m,).

    Point j adds ``T_j a_j c_j`` to the picture; T_j is the transmittance in front of it and a_j the
    share of the cell that it covers. The colour behind point k, over black, is
    ``B_k = (sum over j > k of T_j a_j c_j) / T_{k+1}``. The contrast ``c_k - B_k`` is squared and
    summed over the channels.

    Parameters
    ----------
    points : Points
    front, thick : (m,) float32
        Optical thickness in front of each point, and its own.
    colors : sequence of (n,) arrays
        Channels of the footprints, or two of them `paired`.
    """
    shown = np.exp(-np.minimum(front, np.float32(60.0)))  # T_k, then T_k a_k
    left = shown * np.exp(-thick)  # T_{k+1}
    shown -= left
    # Limited, since a colour behind less transmittance than this cannot be seen anyway.
    scale = np.float32(1.0) / np.maximum(left, np.float32(1e-4))
    squared = np.zeros_like(front)
    for pair in colors:
        color = pair.take(points.owners)  # (m,)
        behind = _before((shown * color)[::-1], points.columns[::-1])[::-1].astype(pair.dtype)
        behind *= scale
        behind -= color
        squared += np.square(behind.real)
        if np.iscomplexobj(pair):
            squared += np.square(behind.imag)
    return squared


def mean_visible(
    points: Points,
    transmittance: NDArray[np.float32],
    squared_contrast: NDArray[np.float32],
    count: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the means over each footprint of T and of ``T^2 |c - B|^2``, both (count,).

    The first is weighted by alpha, the second by alpha^2; both are 0 outside the image.

    Parameters
    ----------
    points : Points
    transmittance, squared_contrast : (m,) float32
        Of each point.
    count : int
        Number of footprints.
    """
    checkpoint()
    owners, shares = points.owners, points.shares
    squares = shares * shares
    visible = np.bincount(owners, shares * transmittance, count)
    errors = np.bincount(owners, squares * transmittance * transmittance * squared_contrast, count)
    # The factors alpha^2 do not sum to 1: divide by their sum, and multiply by the share of the
    # footprint that lies in the image.
    inside = np.bincount(owners, shares, count)
    errors = errors * inside / np.maximum(np.bincount(owners, squares, count), 1e-30)
    return np.asarray(visible, np.float64), np.asarray(errors, np.float64)


def masses(
    footprints: Footprints, alphas: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the integrals of alpha and of alpha^2 over each footprint, (n,) each, px^2.

    S is the product of the two sigmas, A the opacity, and q the squared Mahalanobis distance. The
    footprint ends where alpha falls to `ALPHA_CUT`::

        integral of A exp(-q / 2) = 2 pi S (A - cut)
        integral of A^2 exp(-q)   =   pi S (A^2 - cut^2)
    """
    area = np.float32(2.0 * math.pi) * footprints.sigmas[0] * footprints.sigmas[1]
    excess = alphas - np.float32(ALPHA_CUT)
    return area * excess, np.float32(0.5) * area * excess * (alphas + np.float32(ALPHA_CUT))
