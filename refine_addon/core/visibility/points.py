"""Points over the footprints of one view, sorted by depth within the cells of the image.

Each footprint is replaced by a lattice of points; each point has a share of the splat's mass, which
is the integral of its alpha. The image is divided into square cells. Within a cell the points are
sorted by depth: `froxels` tells what hides them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..execute import checkpoint
from ..views import View
from .lattices import COUNTS, FLAT, WIDE_EXTENT, lattice_table, lattices
from .projection import Footprints

FEW_CELLS = 10_000
"""An image may always have this many cells, even with few footprints."""

FOOTPRINTS = 4.0
"""Beyond `FEW_CELLS` cells, an image has at most one cell for this many footprints: cells that are
much smaller than the splats only cost points."""

MAX_CELLS = 65535
"""Most cells of an image: NumPy sorts numbers of 16 bits by radix, in linear time."""

MAX_POINTS = 1 << 22
"""Limit of the estimated number of points of a view: cells grow until it holds. A point takes about
100 bytes."""

LEAST_POINTS = 1.25
"""Point limit of a view: ``max(MAX_POINTS, LEAST_POINTS x footprints)``. A footprint has at least
one point, however large the cells are."""

_GROWTH = 2.0**0.25  # factor by which the side of a cell grows in a step
_SLACK = 1.01  # on the side of a cell: a column of cells may lie partly outside the image
_OUTSIDE = MAX_CELLS  # the cell number of points outside the image
_MARGIN = 1e-2  # cells; far more than what rounding moves a point by
_BLOCK = 1 << 15  # points processed at a time, which limits temporary memory
_VAST = 8  # a lattice whose points lie an eighth of the image apart could miss the image
_FAR = 15.0  # standard deviations; farther out a Gaussian is 0 in float32


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
    counts : (C,) int64
        How many points lie in each of the C cells that are not empty: the columns of points.
    share_inside, squares : (n,) float64
        Of each footprint: the sum of its shares, that is the share of its mass in the image, and
        the sum of their squares.
    area : float
        Of a cell, px^2.
    """

    owners: NDArray[np.int32]
    shares: NDArray[np.float32]
    counts: NDArray[np.int64]
    share_inside: NDArray[np.float64]
    squares: NDArray[np.float64]
    area: float

    def pieces(self) -> Iterator[tuple[slice, slice]]:
        """Yield about `_BLOCK` points at a time, in whole cells: slices of the cells and points."""
        for cells, members in _runs(self.counts):
            checkpoint()
            yield cells, members


def _runs(sizes: NDArray[np.int64]) -> Iterator[tuple[slice, slice]]:
    """Yield runs of consecutive groups with about `_BLOCK` members: slices of groups and members.

    `sizes`, (G,), is how many members each group has.
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
    side = max(cell, math.sqrt(view.width * view.height / min(needed, MAX_CELLS)) * _SLACK)
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
    frame = _in_cells(footprints, view, side)
    vast = kinds == len(lattices()) - 1  # (n,), the few footprints much larger than the image
    frame.axes[:, vast] = 0.0  # nothing is cut off; `_flat_points` replaces their points
    rows, patches, whole = _patches(frame, kinds)  # (q,) each
    sizes = lattice_table().sizes.take(patches)  # (q,)
    owners = np.repeat(rows.astype(np.int32), sizes)  # (p,)
    cells, shares, sums = _lay_out(frame, rows, patches, whole)  # (p,), (p,), (2, q)
    replaced = np.flatnonzero(vast.take(rows))
    if len(replaced):
        at = np.cumsum(sizes)[replaced][:, None] - np.arange(FLAT**2, 0, -1)
        cells[at], shares[at] = _flat_points(footprints, rows[replaced], view, side)
        sums[:, replaced] = shares[at].sum(axis=1), (shares[at] ** 2).sum(axis=1)
    inside, squares = (  # (n,) each
        np.asarray(np.bincount(rows, sum_, len(kinds)), np.float64) for sum_ in sums
    )
    return _sort_into_cells(cells, owners, shares, inside, squares, side * side)


def _kinds(footprints: Footprints, view: View, scale: float) -> NDArray[np.uint8]:
    """Return which of `lattices` each footprint gets, (n,); `scale`: points per pixel of sigma."""
    place_of = np.searchsorted(COUNTS, np.arange(COUNTS[-1] + 1)).astype(np.uint8)
    wanted = np.ceil((footprints.sigmas * np.float32(scale)).clip(1.0, COUNTS[-1]))  # (2, n)
    index = place_of[wanted.astype(np.int64)]  # (2, n)
    # The points of a larger lattice are so far apart that all of them could miss the image.
    spacing = footprints.sigmas[0] * (2.0 * WIDE_EXTENT / COUNTS[-1])
    vast = spacing > max(view.width, view.height) / _VAST
    kinds = index[0] * np.uint8(len(COUNTS)) + index[1]
    return np.where(vast, np.uint8(len(COUNTS) ** 2), kinds)


class _CellFrame(NamedTuple):
    """Footprints in units of a cell."""

    axes: NDArray[np.float32]  # (6, n): half axes, major, minor, and centre, each across and down
    size: tuple[float, float]  # of the image, across and down


def _in_cells(footprints: Footprints, view: View, side: float) -> _CellFrame:
    """Return footprints in units of a cell."""
    axes = np.concatenate([footprints.major, footprints.minor, footprints.centers])
    axes *= np.float32(1.0 / side)
    return _CellFrame(axes, (view.width / side, view.height / side))


def _patches(
    frame: _CellFrame, kinds: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.bool_]]:
    """Return the q patches that may reach into the image, footprint by footprint.

    `kinds`, (n,), is which lattice each footprint gets. Return the rows of their footprints and of
    the table, (q,) int64 each, and which lie in the image with all of their points, (q,).
    """
    table = lattice_table()
    count = table.patches.take(kinds)  # (n,)
    rows = np.repeat(np.arange(len(kinds)), count)  # (q,)
    before = np.cumsum(count) - count - table.first.take(kinds)  # (n,)
    patches = np.arange(len(rows)) - before.take(rows)  # (q,)
    touching, whole = _boxes_inside(frame, rows, patches)
    kept = np.flatnonzero(touching)
    return rows.take(kept), patches.take(kept), whole.take(kept)


def _boxes_inside(
    frame: _CellFrame, rows: NDArray[np.int64], patches: NDArray[np.int64]
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which patches may reach into the image, and which lie in it, (q,) each.

    By the box around each patch; `rows` and `patches`, (q,), are as `_patches` returns them.
    """
    table = lattice_table()
    middle, half = table.middle.take(patches, axis=1), table.half.take(patches, axis=1)  # (2, q)
    touching = np.ones(len(rows), np.bool_)
    whole = np.ones(len(rows), np.bool_)
    for axis, size in enumerate(frame.size):
        checkpoint()
        major, minor = frame.axes[axis].take(rows), frame.axes[2 + axis].take(rows)  # (q,) each
        center = major * middle[0] + minor * middle[1] + frame.axes[4 + axis].take(rows)
        extent = np.abs(major) * half[0] + np.abs(minor) * half[1] + np.float32(_MARGIN)
        low, high = center - extent, center + extent
        touching &= (high >= 0.0) & (low < size)
        whole &= (low >= 0.0) & (high < size)
    return touching, whole


def _lay_out(
    frame: _CellFrame,
    rows: NDArray[np.int64],
    patches: NDArray[np.int64],
    whole: NDArray[np.bool_],
) -> tuple[NDArray[np.uint16], NDArray[np.float32], NDArray[np.float32]]:
    """Return the points of q patches of `_patches`, one after the other.

    Of p points these are the cells, (p,) uint16, `_OUTSIDE` outside the image, and their shares of
    the mass, (p,) float32; of each patch the sums of the shares of its points inside the image, and
    of their squares, (2, q).
    """
    table = lattice_table()
    sizes = table.sizes.take(patches)  # (q,)
    first = np.cumsum(sizes) - sizes  # (q,), number of each patch's first point
    cells = np.empty(int(sizes.sum()), np.uint16)
    shares, sums = np.empty(len(cells), np.float32), table.sums.take(patches, axis=1)
    # Equal patches are laid out together: they have the same points, so none needs an index.
    inner = np.flatnonzero(whole)
    inner = inner.take(np.argsort(patches.take(inner).astype(np.uint16), kind="stable"))
    for patch, run in _equal_runs(patches.take(inner)):
        equal = inner[run]
        numbers, cell, share = _lay_out_inside(frame, rows[equal], patch, first[equal])
        cells[numbers], shares[numbers] = cell, share
    edge = np.flatnonzero(~whole)
    for run, _ in _runs(sizes.take(edge)):
        checkpoint()
        cut = edge[run]
        numbers, cell, share, sums[:, cut] = _lay_out_at_edge(
            frame, rows[cut], patches[cut], first[cut]
        )
        cells[numbers], shares[numbers] = cell, share
    return cells, shares, sums


def _equal_runs(patches: NDArray[np.int64]) -> Iterator[tuple[int, slice]]:
    """Yield runs of equal numbers, which ascend, of about `_BLOCK` points: number and slice."""
    sizes = lattice_table().sizes
    stops = np.cumsum(np.bincount(patches, minlength=len(sizes))).tolist()
    for patch, (start, stop) in enumerate(pairwise([0, *stops])):
        step = max(_BLOCK // int(sizes[patch]), 1)
        for begin in range(start, stop, step):
            checkpoint()
            yield patch, slice(begin, min(begin + step, stop))


def _lay_out_inside(
    frame: _CellFrame, rows: NDArray[np.int64], patch: int, first: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.uint16], NDArray[np.float32]]:
    """Return the k points of each of b equal patches that lie in the image.

    `rows`, (b,), are those of their footprints, `patch` is the row of the table, and `first`, (b,),
    the number of each one's first point. Return the numbers and cells of the points, (k, b), and
    their shares, (k, 1).
    """
    table = lattice_table()
    members = slice(int(table.start[patch]), int(table.start[patch] + table.sizes[patch]))
    numbers = first + np.arange(members.stop - members.start)[:, None]
    positions = _positions(frame.axes.take(rows, axis=1), table.points[:, members, None])
    return numbers, _cell_numbers(positions, frame.size), table.shares[members, None]


def _lay_out_at_edge(
    frame: _CellFrame,
    rows: NDArray[np.int64],
    patches: NDArray[np.int64],
    first: NDArray[np.int64],
) -> tuple[NDArray[np.int64], NDArray[Any], NDArray[np.float32], NDArray[np.float32]]:
    """Return the points of q patches of `_patches` that lie across the edge of the image.

    `first`, (q,), is the number of each patch's first point. Return the numbers, cells and shares
    of the points, (p,) each, `_OUTSIDE` and 0 for those outside the image, and of each patch the
    sums of its shares and of their squares, (2, q).
    """
    table = lattice_table()
    sizes = table.sizes.take(patches)  # (q,)
    begin = np.cumsum(sizes) - sizes
    step = np.arange(int(sizes.sum())) - np.repeat(begin, sizes)  # (p,), as all that follows
    which = step + np.repeat(table.start.take(patches), sizes)
    axes = np.repeat(frame.axes.take(rows, axis=1), sizes, axis=1)
    positions = _positions(axes, table.points.take(which, axis=1))
    inside = np.ones(len(which), np.bool_)
    for coordinate, size in zip(positions, frame.size, strict=True):
        inside &= (coordinate >= 0.0) & (coordinate < np.float32(size))
    cells = np.where(inside, _cell_numbers(positions, frame.size), np.uint16(_OUTSIDE))
    shares = np.where(inside, table.shares.take(which), np.float32(0.0))
    sums = np.add.reduceat([shares, shares * shares], begin, axis=1)
    return step + np.repeat(first, sizes), cells, shares, sums


def _positions(
    axes: NDArray[np.float32], points: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return where points of lattices lie, across and down, in cells.

    `axes`, (6, ...), are those of `_CellFrame`; the points, (2, ...), lie along the major and the
    minor axis of the lattice.
    """
    across = axes[0] * points[0]
    across += axes[2] * points[1]
    across += axes[4]
    down = axes[1] * points[0]
    down += axes[3] * points[1]
    down += axes[5]
    return across, down


def _cell_numbers(
    positions: tuple[NDArray[np.float32], NDArray[np.float32]], size: tuple[float, float]
) -> NDArray[np.uint16]:
    """Return the number of each point's cell; meaningless for points outside the image.

    The position of each point and the size of the image are across and down, in cells.
    """
    number = positions[1].astype(np.int32)
    number *= math.ceil(size[0])
    number += positions[0].astype(np.int32)
    return number.astype(np.uint16)


def _flat_points(
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
        along = (dx * unit[0][:, None] + dy * unit[1][:, None]).clip(-_FAR, _FAR)
        squared += along * along
    mass = np.float32(2.0 * math.pi) * footprints.sigmas[0, row] * footprints.sigmas[1, row]
    share = np.float32(view.width * view.height / FLAT**2) / mass
    cells = _cell_numbers((u / np.float32(side), v / np.float32(side)), (view.width / side, 0.0))
    return cells, np.exp(squared / -2.0) * share[:, None]


def _sort_into_cells(
    cells: NDArray[np.uint16],
    owners: NDArray[np.int32],
    shares: NDArray[np.float32],
    inside: NDArray[np.float64],
    squares: NDArray[np.float64],
    area: float,
) -> Points:
    """Sort p points into cells, and merge those of one splat in one cell.

    Points of the cell `_OUTSIDE` are dropped. Owners ascend, that is, come front to back. For
    `inside` and `squares`, (n,), see `Points`; `squares` are those before merging, and changed in
    place.
    """
    filled = np.bincount(cells, minlength=_OUTSIDE)[:_OUTSIDE]
    counts = filled[filled > 0]  # (C,)
    # A stable sort keeps the points of a cell front to back; those `_OUTSIDE` come last.
    order = np.argsort(cells, kind="stable")[: counts.sum()]
    checkpoint()
    owners, shares = owners.take(order), shares.take(order)
    if len(order):
        first = np.empty(len(owners), np.bool_)  # whether a point is the first of its splat there
        np.not_equal(owners[1:], owners[:-1], out=first[1:])
        first[np.cumsum(counts) - counts] = True  # the first point of each cell
        _merge(owners, shares, squares, first)
    return Points(owners, shares, counts, inside, squares, area)


def _merge(
    owners: NDArray[np.int32],
    shares: NDArray[np.float32],
    squares: NDArray[np.float64],
    first: NDArray[np.bool_],
) -> None:
    """Give the shares of all points of a splat in a cell to the first of them, `first`, (m,).

    For the others, which come right behind it, see `_sort_into_cells`.
    """
    more = np.flatnonzero(~first)  # points that are not the first
    starts = np.flatnonzero(first.take(more - 1))  # where those of another splat or cell begin
    if len(starts):
        firsts = more.take(starts) - 1
        merged, own = shares.take(more), shares.take(firsts)
        total = own + np.add.reduceat(merged, starts)
        apart = own * own + np.add.reduceat(merged * merged, starts)
        squares += np.bincount(owners.take(firsts), total * total - apart, len(squares))
        shares[more] = 0.0
        shares[firsts] = total
