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
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..rendering import ALPHA_CUT, ALPHA_MAX
from ..work import checkpoint

if TYPE_CHECKING:
    from collections.abc import Iterator
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
_PATCH = 6  # points along a side of a patch, at most
_MARGIN = 1e-2  # cells; far more than what rounding moves a point by
_BLOCK = 1 << 15  # points processed at a time, which limits temporary memory


@dataclass(frozen=True, eq=False)
class Lattice:
    """Points that stand for the standard normal distribution in two dimensions.

    Attributes
    ----------
    points : (2, k) float32
        In standard deviations along the major and the minor axis; patch by patch.
    shares : (k,) float32
        Of the mass; their sum is 1.
    patches : (P,) int64
        Sizes of groups of neighbouring points. Those that miss the image are not laid out.
    """

    points: NDArray[np.float32]
    shares: NDArray[np.float32]
    patches: NDArray[np.int64]


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
    whole = np.array([FLAT**2])
    return (*made, Lattice(flat, np.full(FLAT**2, 1.0 / FLAT**2, np.float32), whole))


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
    parts = [-(-count // _PATCH) for count in product.shape]
    row, column = (
        np.arange(count) * number // count
        for count, number in zip(product.shape, parts, strict=True)
    )
    patch = np.add.outer(row * parts[1], column)[keep]  # (k,)
    order = np.argsort(patch, kind="stable")
    sizes = np.bincount(patch)
    return Lattice(
        points[:, order].astype(np.float32), shares[order].astype(np.float32), sizes[sizes > 0]
    )


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

    Of several points of one splat in one cell the first has the shares of all, so that a splat does
    not hide itself; the others have none.

    Attributes
    ----------
    owners : (m,) int32
        Row of the `Footprints`.
    shares : (m,) float32
        Of the splat's mass.
    columns : (C,) int64
        How many points lie in each of the C cells that are not empty.
    inside, squares : (n,) float64
        Of each footprint: the sum of its shares, and of their squares.
    area : float
        Of a cell, px^2.
    """

    owners: NDArray[np.int32]
    shares: NDArray[np.float32]
    columns: NDArray[np.int64]
    inside: NDArray[np.float64]
    squares: NDArray[np.float64]
    area: float

    def pieces(self) -> Iterator[tuple[slice, slice]]:
        """Yield about `_BLOCK` points at a time, in whole cells: slices of the cells and points."""
        for cells, place in _runs(self.columns):
            checkpoint()
            yield cells, place


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
    frame = _framed(footprints, view, side)
    vast = kinds == len(lattices()) - 1  # (n,), the few footprints much larger than the image
    frame.axes[:, vast] = 0.0  # in the image; `_flat` replaces their points
    rows, patches, whole = _patches(frame, kinds)  # (q,) each
    sizes = _table().sizes.take(patches)  # (q,)
    owners = np.repeat(rows.astype(np.int32), sizes)  # (p,)
    cells, shares, sums = _laid(frame, rows, patches, whole)  # (p,), (p,), (2, q)
    replaced = np.flatnonzero(vast.take(rows))
    if len(replaced):
        at = np.cumsum(sizes)[replaced][:, None] - np.arange(FLAT**2, 0, -1)
        cells[at], shares[at] = _flat(footprints, rows[replaced], view, side)
        sums[:, replaced] = shares[at].sum(axis=1), (shares[at] ** 2).sum(axis=1)
    inside, squares = (  # (n,) each
        np.asarray(np.bincount(rows, some, len(kinds)), np.float64) for some in sums
    )
    return _merged(cells, owners, shares, inside, squares, side * side)


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


class _Table(NamedTuple):
    """All L lattices in one table of P patches and K points.

    Attributes
    ----------
    first, patches : (L,) int64
        The first patch of each lattice, and how many it has.
    start, sizes : (P,) int64
        The first point of each patch, and how many it has.
    middle, half : (2, P) float32
        Of the box around each patch, standard deviations along the major and the minor axis.
    points : (2, K) float32
        Along the major and the minor axis, standard deviations.
    shares : (K,) float32
        Of the mass.
    sums : (2, P) float32
        Of the shares of each patch, and of their squares.
    """

    first: NDArray[np.int64]
    patches: NDArray[np.int64]
    start: NDArray[np.int64]
    sizes: NDArray[np.int64]
    middle: NDArray[np.float32]
    half: NDArray[np.float32]
    points: NDArray[np.float32]
    shares: NDArray[np.float32]
    sums: NDArray[np.float32]


@functools.cache
def _table() -> _Table:
    """Return all lattices in one table."""
    count = np.array([len(lattice.patches) for lattice in lattices()])
    sizes = np.concatenate([lattice.patches for lattice in lattices()])
    start = np.cumsum(sizes) - sizes
    shares = np.concatenate([lattice.shares for lattice in lattices()])
    points = np.concatenate([lattice.points for lattice in lattices()], axis=1)
    low, high = np.minimum.reduceat(points, start, 1), np.maximum.reduceat(points, start, 1)
    sums = np.add.reduceat([shares, shares * shares], start, 1)
    first = np.cumsum(count) - count
    return _Table(
        first, count, start, sizes, (low + high) / 2, (high - low) / 2, points, shares, sums
    )


class _Frame(NamedTuple):
    """Footprints in units of a cell.

    Attributes
    ----------
    axes : (6, n) float32
        Half axes, major then minor, and centre: each across and down.
    size : tuple of float
        Of the image, across and down.
    """

    axes: NDArray[np.float32]
    size: tuple[float, float]


def _framed(footprints: Footprints, view: View, side: float) -> _Frame:
    """Return footprints in units of a cell."""
    axes = np.concatenate([footprints.major, footprints.minor, footprints.centers])
    axes *= np.float32(1.0 / side)
    return _Frame(axes, (view.width / side, view.height / side))


def _patches(
    frame: _Frame, kinds: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return the patches that may reach into the image, footprint by footprint.

    Parameters
    ----------
    frame : _Frame
    kinds : (n,) uint8
        Which lattice each footprint gets.

    Returns
    -------
    rows, patches : (q,) int64
        Of the footprints, and of the table.
    whole : (q,) bool
        Which lie in the image with all of their points.
    """
    table = _table()
    count = table.patches.take(kinds)  # (n,)
    rows = np.repeat(np.arange(len(kinds)), count)  # (q,)
    before = np.cumsum(count) - count - table.first.take(kinds)  # (n,)
    patches = np.arange(len(rows)) - before.take(rows)  # (q,)
    middle, half = table.middle.take(patches, axis=1), table.half.take(patches, axis=1)  # (2, q)
    touching = np.ones(len(rows), np.bool_)
    whole = np.ones(len(rows), np.bool_)
    for axis, size in enumerate(frame.size):
        checkpoint()
        major, minor = frame.axes[axis].take(rows), frame.axes[2 + axis].take(rows)  # (q,) each
        where = major * middle[0] + minor * middle[1] + frame.axes[4 + axis].take(rows)
        reach = np.abs(major) * half[0] + np.abs(minor) * half[1] + np.float32(_MARGIN)
        low, high = where - reach, where + reach
        touching &= (high >= 0.0) & (low < size)
        whole &= (low >= 0.0) & (high < size)
    some = np.flatnonzero(touching)
    return rows.take(some), patches.take(some), whole.take(some)


def _laid(
    frame: _Frame,
    rows: NDArray[np.int64],
    patches: NDArray[np.int64],
    whole: NDArray[np.bool_],
) -> tuple[NDArray[np.uint16], NDArray[np.float32], NDArray[np.float32]]:
    """Return the points of q patches, one after the other.

    Parameters
    ----------
    frame : _Frame
    rows, patches, whole : (q,) array
        See `_patches`.

    Returns
    -------
    cells : (p,) uint16
        `_OUTSIDE` for points beside the image.
    shares : (p,) float32
        Of the mass.
    sums : (2, q) float32
        Of the shares of each patch's points inside the image, and of their squares.
    """
    table = _table()
    sizes = table.sizes.take(patches)  # (q,)
    first = np.cumsum(sizes) - sizes  # (q,), number of each patch's first point
    cells = np.empty(int(sizes.sum()), np.uint16)
    shares, sums = np.empty(len(cells), np.float32), table.sums.take(patches, axis=1)
    # Patches alike are laid out together, which needs no look-up for each point.
    some = np.flatnonzero(whole)
    some = some.take(np.argsort(patches.take(some).astype(np.uint16), kind="stable"))  # (s,)
    axes, begin = frame.axes.take(rows.take(some), axis=1), first.take(some)
    for patch, piece in _alike(patches.take(some)):
        own = slice(int(table.start[patch]), int(table.start[patch] + table.sizes[patch]))
        at = begin[piece] + np.arange(own.stop - own.start)[:, None]  # (points, patches)
        cells[at] = _cells(_place(axes[:, piece], table.points[:, own, None]), frame.size)
        shares[at] = table.shares[own, None]
    edge = np.flatnonzero(~whole)
    for piece, _ in _runs(sizes.take(edge)):
        checkpoint()
        some = edge[piece]
        at, found, share, sums[:, some] = _cut(frame, rows[some], patches[some], first[some])
        cells[at], shares[at] = found, share
    return cells, shares, sums


def _alike(patches: NDArray[np.int64]) -> Iterator[tuple[int, slice]]:
    """Yield runs of equal numbers that have about `_BLOCK` points at most: number and slice.

    Parameters
    ----------
    patches : (s,) int64
        Ascending.
    """
    sizes = _table().sizes
    stops = np.cumsum(np.bincount(patches, minlength=len(sizes))).tolist()
    for patch, (start, stop) in enumerate(pairwise([0, *stops])):
        step = max(_BLOCK // int(sizes[patch]), 1)
        for begin in range(start, stop, step):
            checkpoint()
            yield patch, slice(begin, min(begin + step, stop))


def _cut(
    frame: _Frame,
    rows: NDArray[np.int64],
    patches: NDArray[np.int64],
    first: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[Any], NDArray[np.float32], NDArray[np.float32]]:
    """Return the points of q patches that lie across the edge of the image, one after the other.

    Parameters
    ----------
    frame : _Frame
    rows, patches : (q,) int64
        See `_patches`.
    first : (q,) int64
        The number of each patch's first point.

    Returns
    -------
    at : (p,) int64
        Numbers of the points.
    cells, shares : (p,) array
        `_OUTSIDE` and 0 for points beside the image.
    sums : (2, q) float32
        Of the shares of each patch, and of their squares.
    """
    table = _table()
    sizes = table.sizes.take(patches)  # (q,)
    begin = np.cumsum(sizes) - sizes
    step = np.arange(int(sizes.sum())) - np.repeat(begin, sizes)  # (p,), as all that follows
    which = step + np.repeat(table.start.take(patches), sizes)
    axes = np.repeat(frame.axes.take(rows, axis=1), sizes, axis=1)
    place = _place(axes, table.points.take(which, axis=1))
    there = np.ones(len(which), np.bool_)
    for where, size in zip(place, frame.size, strict=True):
        there &= (where >= 0.0) & (where < np.float32(size))
    cells = np.where(there, _cells(place, frame.size), np.uint16(_OUTSIDE))
    shares = np.where(there, table.shares.take(which), np.float32(0.0))
    sums = np.add.reduceat([shares, shares * shares], begin, axis=1)
    return step + np.repeat(first, sizes), cells, shares, sums


def _place(
    axes: NDArray[np.float32], points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return where points of lattices lie, across and down, in cells.

    Parameters
    ----------
    axes : (6, ...) float32
        See `_Frame`.
    points : (2, ...) float32
        Of the lattice, along the major and the minor axis.
    """
    across = axes[0] * points[0]
    across += axes[2] * points[1]
    across += axes[4]
    down = axes[1] * points[0]
    down += axes[3] * points[1]
    down += axes[5]
    return across, down


def _cells(
    place: tuple[NDArray[np.float32], NDArray[np.float32]], size: tuple[float, float]
) -> NDArray[np.uint16]:
    """Return the number of each point's cell; it means nothing beside the image.

    Parameters
    ----------
    place : tuple of float32 arrays
        Across and down, in cells.
    size : tuple of float
        Of the image, in cells.
    """
    number = place[1].astype(np.int32)
    number *= math.ceil(size[0])
    number += place[0].astype(np.int32)
    return number.astype(np.uint16)


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
    cells = _cells((u / np.float32(side), v / np.float32(side)), (view.width / side, 0.0))
    return cells, np.exp(squared / -2.0) * share[:, None]


def _merged(
    cells: NDArray[np.uint16],
    owners: NDArray[np.int32],
    shares: NDArray[np.float32],
    inside: NDArray[np.float64],
    squares: NDArray[np.float64],
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
    inside, squares : (n,) float64
        See `Points`; `squares` before merging, and changed in place.
    area : float
    """
    filled = np.bincount(cells, minlength=_OUTSIDE)[:_OUTSIDE]
    columns = filled[filled > 0]  # (C,)
    # A stable sort keeps the points of a cell front to back; those `_OUTSIDE` come last.
    order = np.argsort(cells, kind="stable")[: columns.sum()]
    checkpoint()
    owners, shares = owners.take(order), shares.take(order)
    if len(order):
        new = np.empty(len(owners), np.bool_)  # whether a point is the first of its splat there
        np.not_equal(owners[1:], owners[:-1], out=new[1:])
        new[np.cumsum(columns) - columns] = True  # the first point of each cell
        again = np.flatnonzero(~new)  # (a,)
        starts = np.flatnonzero(new.take(again - 1))  # where another splat's points begin
        if len(starts):
            first = again.take(starts) - 1
            more, own = shares.take(again), shares.take(first)
            total = own + np.add.reduceat(more, starts)
            apart = own * own + np.add.reduceat(more * more, starts)
            squares += np.bincount(owners.take(first), total * total - apart, len(squares))
            shares[again] = 0.0
            shares[first] = total
    return Points(owners, shares, columns, inside, squares, area)


def traits(
    footprints: Footprints,
    mass: NDArray[np.float32],
    colors: NDArray[np.float32],
    area: float,
) -> NDArray[np.float32]:
    """Return what points take from their splats, in one table: one look-up is faster than six.

    Parameters
    ----------
    footprints : Footprints
    mass : (n,) float32
    colors : (n, 3) float32
    area : float
        Of a cell, px^2.

    Returns
    -------
    (n, 6) float32
        Red, green, blue; the mass over the cell's area; the largest share of a cell that the splat
        covers, which is its opacity; `evenness`.
    """
    table = np.empty((len(mass), 6), np.float32)
    table[:, :3] = colors
    table[:, 3] = mass / np.float32(area)
    np.minimum(footprints.alphas, np.float32(ALPHA_MAX), out=table[:, 4])
    table[:, 5] = evenness(footprints, area)
    return table


def look(
    shares: NDArray[np.float32], traits: NDArray[np.float32], columns: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the transmittance in front of points and their squared contrast, (m,) each.

    Parameters
    ----------
    shares : (m,) float32
        Of the splat's mass.
    traits : (m, 6) float32
        Of each point's splat, see `traits`.
    columns : (C,) int64
        Lengths of the columns of points.
    """
    covered = shares * traits[:, 3]
    np.minimum(covered, traits[:, 4], out=covered)
    thick = thickness(covered)
    front, even = in_front(thick, thick * traits[:, 5], columns)
    return transmittance(front, even), squared_contrast(front, covered, traits[:, :3], columns)


def thickness(covered: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the optical thickness of points, ``-log(1 - a)``, (m,).

    Parameters
    ----------
    covered : (m,) float32
        a, the share of its cell that each point covers: its mass over the cell's area, at most the
        splat's opacity.
    """
    left = np.subtract(np.float32(1.0), covered)
    np.log(left, out=left)
    return np.asarray(np.negative(left, out=left))


def paired(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[Any]:
    """Return two real arrays as the real and imaginary parts of one complex array, (m,).

    A running sum over the pair is two running sums in the time of one.
    """
    pair = np.empty(first.shape, np.complex128)
    pair.real, pair.imag = first, second
    return pair


def in_front(
    thick: NDArray[np.float32], even: NDArray[np.float32], columns: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the sums of two thicknesses, (m,) each, over the points in front in the same cell."""
    values = paired(thick, even)
    sums = np.cumsum(values)
    sums -= values
    sums -= np.repeat(sums.take(np.cumsum(columns) - columns), columns)
    return sums.real.astype(np.float32), sums.imag.astype(np.float32)


def behind(values: NDArray[Any], columns: NDArray[np.int64]) -> NDArray[Any]:
    """Return for each of `values`, (m,), the sum of those behind it in its column."""
    sums = np.cumsum(values)
    return np.asarray(np.repeat(sums.take(np.cumsum(columns) - 1), columns) - sums)


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
    front: NDArray[np.float32],
    covered: NDArray[np.float32],
    colors: NDArray[np.float32],
    columns: NDArray[np.int64],
) -> NDArray[np.float32]:
    """Return the squared contrast of each point, (m,).

    Point j adds ``T_j a_j c_j`` to the picture; T_j is the transmittance in front of it and a_j the
    share of the cell that it covers. The colour behind point k, over black, is
    ``B_k = (sum over j > k of T_j a_j c_j) / T_{k+1}``. The contrast ``c_k - B_k`` is squared and
    summed over the channels.

    Parameters
    ----------
    front, covered : (m,) float32
        Optical thickness in front of each point, and a.
    colors : (m, 3) float32
    columns : (C,) int64
        Lengths of the columns of points.
    """
    shown = np.exp(-np.minimum(front, np.float32(60.0)))  # T_k
    # Limited, since a colour behind less transmittance than this cannot be seen anyway.
    left = np.maximum(shown * (np.float32(1.0) - covered), np.float32(1e-4))  # T_{k+1}
    shown *= covered  # T_k a_k
    pair = behind(paired(shown * colors[:, 0], shown * colors[:, 1]), columns)
    last = behind((shown * colors[:, 2]).astype(np.float64), columns)
    squared = np.zeros_like(front)
    for channel, light in enumerate((pair.real, pair.imag, last)):
        contrast = light.astype(np.float32)
        contrast /= left
        contrast -= colors[:, channel]
        contrast *= contrast
        squared += contrast
    return squared


def mean_visible(
    points: Points, visible: NDArray[np.float64], errors: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the means over each footprint of T and of ``T^2 |c - B|^2``, both (n,).

    The first is weighted by alpha, the second by alpha^2; both are 0 outside the image.

    Parameters
    ----------
    points : Points
    visible, errors : (m,) float64
        Of each point: its share times T, and the square of that times ``|c - B|^2``.
    """
    checkpoint()
    count = len(points.inside)
    owners = points.owners.astype(np.int64)
    total = np.asarray(np.bincount(owners, errors, count), np.float64)
    # The factors alpha^2 do not sum to 1: divide by their sum, and multiply by the share of the
    # footprint that lies in the image.
    total *= points.inside / np.maximum(points.squares, 1e-30)
    return np.asarray(np.bincount(owners, visible, count), np.float64), total


def masses(footprints: Footprints) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the integrals of alpha and of alpha^2 over each footprint, (n,) each, px^2.

    S is the product of the two sigmas, A the opacity, and q the squared Mahalanobis distance. The
    footprint ends where alpha falls to `ALPHA_CUT`::

        integral of A exp(-q / 2) = 2 pi S (A - cut)
        integral of A^2 exp(-q)   =   pi S (A^2 - cut^2)
    """
    alphas = footprints.alphas
    area = np.float32(2.0 * math.pi) * footprints.sigmas[0] * footprints.sigmas[1]
    excess = alphas - np.float32(ALPHA_CUT)
    return area * excess, np.float32(0.5) * area * excess * (alphas + np.float32(ALPHA_CUT))
