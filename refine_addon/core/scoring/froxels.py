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

from ..rendering import ALPHA_CUT, ALPHA_MAX
from ..work import checkpoint

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from typing import Any

    from numpy.typing import NDArray

    from ..views import View
    from .projection import Footprints

DOUBT = 12.0
"""What lies loosely in front is believed to be gamma distributed, its shape this over the side of a
cell in pixels: coarse cells know less, and as cells shrink nothing is left to doubt."""

MAX_CELLS = 65535
"""Cells are numbered by 16 bits: such numbers sort by counting, in linear time."""

MAX_POINTS = 1 << 22
"""Points that a view may have, as estimated: cells grow until they suffice. About 100 bytes each.
"""

LEAST_POINTS = 1.25
"""Points that a footprint may have on average in a view of so many that `MAX_POINTS` are too few:
each needs one at least, whatever the size of the cells."""

COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""How many points a lattice may have along an axis."""

FLAT = 16
"""Points along either side of the image for a splat that the whole image lies in."""

Line = tuple["NDArray[np.float64]", "NDArray[np.float64]"]
"""Points and their weights."""

_EXTENT, _WIDE_EXTENT, _WIDE = 2.4, 3.0, 8  # standard deviations; the latter from 8 points on
_GROWTH = 2.0**0.25
_OUTSIDE = MAX_CELLS  # the number of no cell
_BLOCK = 1 << 16  # points worked on at a time: fewer calls to wait for, and memory stays bounded


@dataclass(frozen=True, eq=False)
class Lattice:
    """Points that stand for the standard normal distribution in two dimensions.

    Attributes
    ----------
    points : (2, k) float32
        In standard deviations along the major and the minor axis.
    weights : (k,) float32
        Share of the mass; sums to 1.
    """

    points: NDArray[np.float32]
    weights: NDArray[np.float32]


@functools.cache
def lattices() -> tuple[Lattice, ...]:
    """Return the lattice of every kind: ``COUNTS[i]`` by ``COUNTS[j]`` points are number i L + j.

    After those comes one of `FLAT` by `FLAT` points over an image, from -1 to 1.
    """
    lines = [_line(count) for count in COUNTS]
    made = [_lattice(major, minor) for major in lines for minor in lines]
    line = (np.arange(FLAT) + 0.5) / FLAT * 2.0 - 1.0
    flat = np.stack([axis.ravel() for axis in np.meshgrid(line, line)]).astype(np.float32)
    return (*made, Lattice(flat, np.full(FLAT**2, 1.0 / FLAT**2, np.float32)))


def _lattice(major: Line, minor: Line) -> Lattice:
    weight = np.outer(major[1], minor[1])
    place = np.broadcast_arrays(major[0][:, None], minor[0])
    extent = _WIDE_EXTENT if max(weight.shape) >= _WIDE else _EXTENT
    keep = (np.hypot(*place) <= extent + 0.1) | (weight.size <= 4)  # noqa: PLR2004 - 2 x 2 is whole
    weights = weight[keep] / weight[keep].sum()
    points = np.stack([axis[keep] for axis in place])
    variance = (points * points) @ weights  # the corners are gone: back to 1
    points /= np.sqrt(np.where(variance > 0.0, variance, 1.0))[:, None]
    return Lattice(points.astype(np.float32), weights.astype(np.float32))


def _line(count: int) -> Line:
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

    def pieces(self) -> Iterator[tuple[slice, Points]]:
        """Cut into whole columns, about `_BLOCK` points at a time: (place, points) in turn."""
        for cells, place in _runs(self.columns):
            checkpoint()
            columns = self.columns[cells]
            yield place, Points(self.owners[place], self.weights[place], columns, self.area)


def _runs(sizes: NDArray[np.int64]) -> Iterator[tuple[slice, slice]]:
    """Cut groups of such sizes into runs of about `_BLOCK` members: (groups, members) in turn."""
    ends = np.cumsum(sizes)
    cuts = np.searchsorted(ends, np.arange(_BLOCK, int(sizes.sum()), _BLOCK)) + 1
    start = member = 0
    for cut in np.unique([*cuts, len(sizes)]).tolist():
        if cut > start:
            yield slice(start, cut), slice(member, int(ends[cut - 1]))
            start, member = cut, int(ends[cut - 1])


def cell_size(footprints: Footprints, view: View, cell: float, density: float) -> float:
    """Return the side of a cell: `cell` pixels, or more where a limit asks for it."""
    side = max(cell, math.sqrt(view.width * view.height / MAX_CELLS) * 1.01)
    while math.ceil(view.width / side) * math.ceil(view.height / side) > MAX_CELLS:
        side *= _GROWTH  # an image a few pixels thin
    # As cells grow the points needed fall to one a footprint: always below this limit.
    limit = max(MAX_POINTS, LEAST_POINTS * len(footprints.index))
    while _points_needed(footprints, side, density) > limit:
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
    kinds = _kinds(footprints, view, density / side)
    sizes, *_ = _table()
    counts = sizes[kinds]
    cells = np.empty(int(counts.sum()), np.uint16)
    weights = np.empty(len(cells), np.float32)
    for row, place in _runs(counts):
        checkpoint()
        cells[place], weights[place] = _laid(footprints, row, kinds[row], view, side)
    # Few, if any: theirs are laid again, over the image.
    vast = np.flatnonzero(kinds == len(sizes) - 1)
    if len(vast):
        at = np.cumsum(counts)[vast][:, None] - np.arange(FLAT**2, 0, -1)
        cells[at], weights[at] = _flat(footprints, vast, view, side)
    return _merged(
        cells, np.repeat(np.arange(len(counts), dtype=np.int32), counts), weights, side * side
    )


def _kinds(footprints: Footprints, view: View, scale: float) -> NDArray[np.uint8]:
    """Return which of `lattices` suits each footprint."""
    table = np.searchsorted(COUNTS, np.arange(COUNTS[-1] + 1)).astype(np.uint8)
    wanted = np.ceil((footprints.sigmas * np.float32(scale)).clip(1.0, COUNTS[-1]))
    index = table[wanted.astype(np.int64)]
    # Of a splat much larger than the image no point of its own lattice may fall there.
    spacing = footprints.sigmas[0] * (2.0 * _WIDE_EXTENT / COUNTS[-1])
    vast = spacing > max(view.width, view.height) / 8
    kinds = index[0] * np.uint8(len(COUNTS)) + index[1]
    return np.where(vast, np.uint8(len(COUNTS) ** 2), kinds)


@functools.cache
def _table() -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[Any], NDArray[Any]]:
    """Return the lattices one after the other: size and start of each, points and weights."""
    sizes = np.array([len(lattice.weights) for lattice in lattices()])
    points = np.concatenate([lattice.points for lattice in lattices()], axis=1)
    weights = np.concatenate([lattice.weights for lattice in lattices()])
    return sizes, np.cumsum(sizes) - sizes, points, weights


def _laid(
    footprints: Footprints, row: slice, kinds: NDArray[np.uint8], view: View, side: float
) -> tuple[NDArray[np.uint16], NDArray[np.float32]]:
    """Return cell and weight of every point of some footprints, one footprint after the other."""
    sizes, starts, points, weights = _table()
    counts = sizes[kinds]
    first = np.cumsum(counts) - counts
    which = np.arange(int(counts.sum())) - np.repeat(first - starts[kinds], counts)
    along, across = points[0].take(which), points[1].take(which)
    place = []
    for axis in range(2):
        where = along * np.repeat(footprints.major[axis, row], counts)
        where += across * np.repeat(footprints.minor[axis, row], counts)
        where += np.repeat(footprints.centers[axis, row], counts)
        place.append(where)
    return _cells(place, view, side), weights.take(which)


def _cells(place: list[NDArray[np.float32]], view: View, side: float) -> NDArray[np.uint16]:
    """Return the number of the cell that each point lies in, or `_OUTSIDE`."""
    inside = np.ones(place[0].shape, np.bool_)
    number = np.zeros(place[0].shape, np.int32)
    for where, size in zip(place[::-1], (view.height, view.width), strict=True):
        inside &= where >= 0.0
        inside &= where < size
        # Clipped before rounding: far outside they would not fit the integers, and rounding may
        # put the last pixel one cell beyond the last.
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
    """Return cells and weights of points all over the image, for splats larger than it."""
    points = lattices()[-1].points
    u = np.float32(view.width / 2) * (points[0] + 1)
    v = np.float32(view.height / 2) * (points[1] + 1)
    squared = np.zeros((len(row), len(u)), np.float32)
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
    weights: NDArray[np.float32],
    area: float,
) -> Points:
    """Sort points into the cells and merge those of one splat in one cell."""
    filled = np.bincount(cells, minlength=_OUTSIDE)[:_OUTSIDE]
    filled = filled[filled > 0]
    # Footprints came front to back, so cells stay so; what is outside comes last.
    order = np.argsort(cells, kind="stable")[: filled.sum()]
    if not len(order):
        return Points(order, weights[:0], order, area)
    owners = owners.take(order)
    tops = np.cumsum(filled) - filled
    new = np.empty(len(owners), np.bool_)
    np.not_equal(owners[1:], owners[:-1], out=new[1:])
    new[tops] = True
    starts = np.flatnonzero(new)
    columns = np.add.reduceat(new, tops, dtype=np.int64)
    return Points(
        owners.take(starts).astype(np.int64),
        np.add.reduceat(weights.take(order), starts),
        columns,
        area,
    )


def thickness(
    points: Points, alphas: NDArray[np.float32], mass: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Optical thickness that each point adds to its cell, (m,).

    ``-log(1 - a)``, a the share of the cell that it covers: its mass over the cell's area, and no
    more than the splat's opacity.
    """
    share = points.weights * (mass / np.float32(points.area)).take(points.owners)
    np.minimum(share, np.minimum(alphas, np.float32(ALPHA_MAX)).take(points.owners), out=share)
    np.subtract(np.float32(1.0), share, out=share)
    np.log(share, out=share)
    return np.negative(share, out=share)


def in_front(
    points: Points, thick: NDArray[np.float32], even: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Sum two thicknesses, (m,) each, in front of each point in its cell."""
    both = np.empty(len(thick), np.complex128)  # running sums of two take as long as of one
    both.real, both.imag = thick, even
    both = _before(both, points.columns)
    return both.real.astype(np.float32), both.imag.astype(np.float32)


def _before(values: NDArray[Any], columns: NDArray[np.int64]) -> NDArray[Any]:
    """Sum what stands before each of `values`, (m,), in its group of so many; in float64."""
    starts = np.cumsum(columns) - columns
    steps = np.empty(len(values), np.result_type(values, np.float64))
    steps[1:] = values[:-1]
    steps[starts] = 0.0
    # Each group begins by taking back what the last one came to.
    steps[starts[1:]] = -np.add.reduceat(steps, starts)[:-1]
    return np.cumsum(steps)


def evenness(footprints: Footprints, area: float) -> NDArray[np.float32]:
    """Return how evenly each splat covers the cells it lies in, (n,): 0 a dot, 1 a veil."""
    narrow = footprints.sigmas[1] ** 2
    return np.asarray(narrow / (narrow + np.float32(area)))


def light(
    front: NDArray[np.float32], even: NDArray[np.float32], area: float
) -> NDArray[np.float32]:
    """Return the expected transmittance through a thickness of which only the mean is known.

    ``E[exp(-tau)] = (1 + mean / k)^-k`` for tau of a gamma distribution of shape k.
    A cell says how much lies in front, not whether it leaves a gap for the point: ``exp(-mean)``
    would take what shows through foliage for hidden, and the score would throw it away. Splats
    wider than a cell leave no gaps: for them it is ``exp(-mean)``.

    Parameters
    ----------
    front : (m,) float32
        Mean thickness in front of each point.
    even : (m,) float32
        The part of it that covers the cell evenly.
    area : float
        Of a cell, px^2.
    """
    shape = np.float32(DOUBT / math.sqrt(area))
    gaps = np.maximum(front - even, np.float32(0.0))
    return np.asarray(np.exp(-even) * (np.float32(1.0) + gaps / shape) ** -shape)


def contrast(
    points: Points,
    front: NDArray[np.float32],
    thick: NDArray[np.float32],
    colors: Sequence[NDArray[Any]],
) -> NDArray[np.float32]:
    """Squared difference between each point's colour and that behind it in its cell, (m,).

    The colour in front of point k is ``C_k = sum over j < k of T_j a_j c_j``; behind it, over
    black, is ``B_k = (C_end - C_{k+1}) / T_{k+1}``.

    Parameters
    ----------
    points : Points
    front, thick : (m,) float32
        Optical thickness in front of it, and its own.
    colors : sequence of (n,) arrays
        Of the footprints; complex where two channels are one.
    """
    through = np.exp(-np.minimum(front, np.float32(60.0)))
    left = through * np.exp(-thick)
    through -= left
    # Where less than this is left, what is behind changes nothing that could be seen.
    scale = np.float32(1.0) / np.maximum(left, np.float32(1e-4))
    squared = np.zeros_like(front)
    for pair in colors:
        color = pair.take(points.owners)
        behind = _before((through * color)[::-1], points.columns[::-1])[::-1].astype(pair.dtype)
        behind *= scale
        behind -= color
        squared += np.square(behind.real)
        if np.iscomplexobj(pair):
            squared += np.square(behind.imag)
    return squared


def mean_light(
    points: Points, light: NDArray[np.float32], contrast: NDArray[np.float32], count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return for each of `count` splats its mean transmittance and its mean visible contrast.

    The former is weighted by alpha, the latter, ``T^2 |c - B|^2``, by alpha^2; what falls outside
    the image counts as 0.
    """
    owners, weights = points.owners, points.weights
    squares = weights * weights
    shown = np.bincount(owners, weights * light, count)
    errors = np.bincount(owners, squares * light * light * contrast, count)
    # Over the sum of the squares, and the share of the footprint that lies in the image.
    share = np.bincount(owners, weights, count)
    errors = errors * share / np.maximum(np.bincount(owners, squares, count), 1e-30)
    return np.asarray(shown, np.float64), np.asarray(errors, np.float64)


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
