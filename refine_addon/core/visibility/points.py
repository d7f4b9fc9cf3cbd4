"""Points over the footprints of a view, sorted by depth within the square cells of the image.

A lattice of points stands for a splat's normal distribution: the more cells the splat covers, the
more points. Each has a share of the splat's mass, the integral of its alpha.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..execute import checkpoint, chunks
from ..views import View
from .projection import Footprints

COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Numbers of points of a lattice along an axis."""

FLAT = 16
"""Points across and down the image for a splat much larger than the image."""

WIDE_EXTENT = 3.0
"""Standard deviations to which a lattice of many points reaches."""

FEW_CELLS = 10_000
"""Most cells of an image, unless it shows many footprints (`FOOTPRINTS`)."""

FOOTPRINTS = 4.0
"""Footprints for each cell beyond `FEW_CELLS`: cells much smaller than splats only cost points."""

MAX_CELLS = 65535
"""Most cells of an image: NumPy sorts numbers of 16 bits by radix, in linear time."""

CELL = 4.0
"""Least side of a cell, px."""

DENSITY = 3.7
"""Points per standard deviation that is as long as a cell."""

MAX_POINTS = 1 << 22
"""Most points of a view, as estimated: cells grow until there are fewer."""

LEAST_POINTS = 1.25
"""Points of a footprint that are always allowed: each has one at least, however large the cells."""

_EXTENT = 2.4  # standard deviations, of lattices of fewer than `_WIDE` points along an axis
_WIDE = 8
_CORNER = 0.1  # standard deviations; points farther than that beyond the extent are left out
_PATCH = 6  # points along a side of a patch, at most
_GROWTH = 2.0**0.25  # factor by which the side of a cell grows in a step
_SLACK = 1.01  # on the side of a cell: a column of cells may lie partly outside the image
_OUTSIDE = MAX_CELLS  # the cell number of points outside the image
_MARGIN = 1e-2  # cells; far more than what rounding moves a point by
_BLOCK = 1 << 15  # points processed at a time, which limits temporary memory
_FOOTPRINTS = 1 << 18  # so many get points at a time, likewise
_VAST = 8  # a lattice whose points lie an eighth of the image apart could miss the image
_FAR = 15.0  # standard deviations; farther out a Gaussian is 0 in float32


class _Lattices(NamedTuple):
    """L lattices of P patches, with K points in all; patches that miss the image are left out."""

    first: NDArray[np.int64]  # (L,), the first patch of each lattice
    patches: NDArray[np.int64]  # (L,), how many patches it has
    start: NDArray[np.int64]  # (P,), the first point of each patch
    sizes: NDArray[np.int64]  # (P,), how many points it has
    # Of the box around each patch, standard deviations along the major and the minor axis, (2, P).
    middle: NDArray[np.float32]
    half: NDArray[np.float32]
    points: NDArray[np.float32]  # (2, K), along the major and the minor axis, standard deviations
    shares: NDArray[np.float32]  # (K,), of the mass
    sums: NDArray[np.float32]  # (2, P), of the shares of each patch, and of their squares


class Points(NamedTuple):
    """The m points in an image, cell by cell, front to back, of n footprints in C cells.

    Of a splat's points in a cell the first has all their shares: a splat does not hide itself.
    """

    owners: NDArray[np.int32]  # (m,), rows of the `Footprints`
    shares: NDArray[np.float32]  # (m,), of the splat's mass
    counts: NDArray[np.int64]  # (C,), points of each cell: its column
    share_inside: NDArray[np.float32]  # (n,), sum of the shares in the image
    squares: NDArray[np.float32]  # (n,), sum of their squares
    area: float  # of a cell, px^2


def runs(sizes: NDArray[np.int64]) -> Iterator[tuple[slice, slice]]:
    """Yield slices of groups of `sizes` members, and of their members, about `_BLOCK` at a time."""
    ends = np.cumsum(sizes)
    cuts = np.searchsorted(ends, np.arange(_BLOCK, int(sizes.sum()), _BLOCK)) + 1
    start = member = 0
    for cut in np.unique([*cuts, len(sizes)]).tolist():
        if cut > start:
            checkpoint()
            yield slice(start, cut), slice(member, int(ends[cut - 1]))
            start, member = cut, int(ends[cut - 1])


def cell_size(footprints: Footprints, view: View) -> float:
    """Side of a view's cells, px: `CELL`, or more for `FOOTPRINTS`, `MAX_CELLS`, `MAX_POINTS`."""
    needed = max(FEW_CELLS, len(footprints.index) / FOOTPRINTS)
    side = max(CELL, math.sqrt(view.width * view.height / min(needed, MAX_CELLS)) * _SLACK)
    while math.ceil(view.width / side) * math.ceil(view.height / side) > MAX_CELLS:
        side *= _GROWTH  # happens for images that are only a few pixels wide or high
    # As cells grow, the points needed fall to one a footprint, which is below this limit.
    limit = max(MAX_POINTS, LEAST_POINTS * len(footprints.index))
    while True:
        along = (footprints.sigmas * np.float32(DENSITY / side)).clip(1.0, COUNTS[-1])
        if not float(np.dot(along[0], along[1])) > limit:  # about how many points
            return side
        side *= _GROWTH


def scatter(footprints: Footprints, view: View, side: float) -> Points:
    """Points over footprints, front to back, in cells of `side` px."""
    kinds = _kinds(footprints, view, DENSITY / side)  # (n,)
    pieces = [
        _points_of(footprints, view, side, kinds, piece)
        for piece in chunks(len(kinds), _FOOTPRINTS)
    ]
    owners, cells, shares, sums = (
        np.concatenate(each, axis=-1) for each in zip(*pieces, strict=True)
    )
    del pieces  # before memory is highest
    inside, squares = sums  # (n,)
    filled = np.bincount(cells, minlength=_OUTSIDE)[:_OUTSIDE]
    counts = filled[filled > 0]  # (C,)
    # A stable sort keeps the points of a cell front to back; those `_OUTSIDE` come last.
    order = np.argsort(cells, kind="stable")[: counts.sum()]
    del cells
    checkpoint()
    owners, shares = owners.take(order), shares.take(order)
    _merge(owners, shares, squares, counts)
    return Points(owners, shares, counts, inside, squares, side * side)


def _points_of(footprints, view, side, kinds, piece):
    """Owners, cells and shares of the points, (p,) each, of a piece of n footprints, and sums of
    these shares and of their squares, (2, n).
    """
    # Half axes, major, minor, and centre, each across and down, in cells, (6, n).
    axes = (footprints.major, footprints.minor, footprints.centers)
    axes = np.concatenate([each[:, piece] for each in axes])
    axes *= np.float32(1.0 / side)
    size = view.width / side, view.height / side
    vast = kinds[piece] == len(COUNTS) ** 2  # (n,), the few footprints much larger than the image
    axes[:, vast] = 0.0  # nothing is cut off; `_flat_points` replaces their points
    rows, patches, whole = _patches(axes, size, kinds[piece])  # (q,) each
    sizes = _lattices().sizes.take(patches)  # (q,)
    owners = np.repeat((rows + piece.start).astype(np.int32), sizes)
    cells, shares, sums = _lay_out(axes, size, rows, patches, whole)
    replaced = np.flatnonzero(vast.take(rows))
    if len(replaced):
        at = np.cumsum(sizes)[replaced][:, None] - np.arange(FLAT**2, 0, -1)
        of_all = rows[replaced] + piece.start
        cells[at], shares[at] = _flat_points(footprints, of_all, view, side)
        sums[:, replaced] = shares[at].sum(axis=1), (shares[at] ** 2).sum(axis=1)
    sums = np.stack([np.bincount(rows, sum_, len(vast)) for sum_ in sums])
    return owners, cells, shares, sums.astype(np.float32)


def _kinds(footprints, view, scale):
    """Number of each footprint's lattice, (n,); `scale` is points per pixel of sigma."""
    place_of = np.searchsorted(COUNTS, np.arange(COUNTS[-1] + 1)).astype(np.uint8)
    wanted = np.ceil((footprints.sigmas * np.float32(scale)).clip(1.0, COUNTS[-1]))  # (2, n)
    index = place_of[wanted.astype(np.int64)]  # (2, n)
    # The points of a larger lattice are so far apart that all of them could miss the image.
    spacing = footprints.sigmas[0] * (2.0 * WIDE_EXTENT / COUNTS[-1])
    vast = spacing > max(view.width, view.height) / _VAST
    kinds = index[0] * np.uint8(len(COUNTS)) + index[1]
    return np.where(vast, np.uint8(len(COUNTS) ** 2), kinds)


def _patches(axes, size, kinds):
    """Patches that may reach into the image: footprint, patch, whether all is inside, (q,) each."""
    table = _lattices()
    count = table.patches.take(kinds)  # (n,)
    rows = np.repeat(np.arange(len(kinds)), count)  # (q,), as all that follows
    before = np.cumsum(count) - count - table.first.take(kinds)  # (n,)
    patches = np.arange(len(rows)) - before.take(rows)
    middle, half = table.middle.take(patches, axis=1), table.half.take(patches, axis=1)  # (2, q)
    touching, whole = np.ones((2, len(rows)), np.bool_)
    for axis, length in enumerate(size):
        checkpoint()
        major, minor = axes[axis].take(rows), axes[2 + axis].take(rows)
        center = major * middle[0] + minor * middle[1] + axes[4 + axis].take(rows)
        extent = np.abs(major) * half[0] + np.abs(minor) * half[1] + np.float32(_MARGIN)
        low, high = center - extent, center + extent
        touching &= (high >= 0.0) & (low < length)
        whole &= (low >= 0.0) & (high < length)
    kept = np.flatnonzero(touching)
    return rows.take(kept), patches.take(kept), whole.take(kept)


def _lay_out(axes, size, rows, patches, whole):
    """Cells and shares of p points of q patches, and sums of shares and their squares, (2, q)."""
    table = _lattices()
    sizes = table.sizes.take(patches)  # (q,)
    first = np.cumsum(sizes) - sizes  # (q,), number of each patch's first point
    cells = np.empty(int(sizes.sum()), np.uint16)
    shares, sums = np.empty(len(cells), np.float32), table.sums.take(patches, axis=1)
    # Equal patches are laid out together: they have the same points, so none needs an index.
    inner = np.flatnonzero(whole)
    inner = inner.take(np.argsort(patches.take(inner).astype(np.uint16), kind="stable"))
    stops = np.cumsum(np.bincount(patches.take(inner), minlength=len(table.sizes))).tolist()
    for patch, (begin, stop) in enumerate(pairwise([0, *stops])):
        length = int(table.sizes[patch])
        members = slice(int(table.start[patch]), int(table.start[patch]) + length)
        step = max(_BLOCK // length, 1)
        for start in range(begin, stop, step):
            checkpoint()
            equal = inner[start : min(start + step, stop)]  # (b,)
            numbers = first[equal] + np.arange(length)[:, None]  # (k, b)
            of_equal = axes.take(rows[equal], axis=1)
            positions = _positions(of_equal, table.points[:, members, None])
            cells[numbers] = _cell_numbers(positions, size)
            shares[numbers] = table.shares[members, None]
    edge = np.flatnonzero(~whole)
    for run, _ in runs(sizes.take(edge)):
        cut = edge[run]
        lengths = sizes[cut]
        begins = np.cumsum(lengths) - lengths
        step = np.arange(int(lengths.sum())) - np.repeat(begins, lengths)  # as all that follows
        which = step + np.repeat(table.start.take(patches[cut]), lengths)
        of_patches = np.repeat(axes.take(rows[cut], axis=1), lengths, axis=1)
        positions = _positions(of_patches, table.points.take(which, axis=1))
        inside = np.ones(len(which), np.bool_)
        for coordinate, extent in zip(positions, size, strict=True):
            inside &= (coordinate >= 0.0) & (coordinate < np.float32(extent))
        share = np.where(inside, table.shares.take(which), np.float32(0.0))
        sums[:, cut] = np.add.reduceat([share, share * share], begins, axis=1)
        numbers = step + np.repeat(first[cut], lengths)
        cells[numbers] = np.where(inside, _cell_numbers(positions, size), np.uint16(_OUTSIDE))
        shares[numbers] = share
    return cells, shares, sums


def _positions(axes, points):
    """Positions of lattice points, (2, ...), in cells; axes, (6, ...), as in `scatter`."""
    across = axes[0] * points[0]
    across += axes[2] * points[1]
    across += axes[4]
    down = axes[1] * points[0]
    down += axes[3] * points[1]
    down += axes[5]
    return across, down


def _cell_numbers(positions, size):
    """Cell of each position in cells, across and down; meaningless outside the image."""
    number = positions[1].astype(np.int32)
    number *= math.ceil(size[0])
    number += positions[0].astype(np.int32)
    return number.astype(np.uint16)


def _flat_points(footprints, row, view, side):
    """Cells, (FLAT^2,), and shares, density times area, (r, FLAT^2), of r vast footprints."""
    points = _lattices().points[:, -(FLAT**2) :]
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


def _merge(owners, shares, squares, counts):
    """Give the shares of a splat's adjacent points in a cell to the first; update `squares`."""
    first = np.ones(len(owners), np.bool_)  # whether a point is the first of its splat there
    np.not_equal(owners[1:], owners[:-1], out=first[1:])
    first[np.cumsum(counts) - counts] = True  # the first point of each cell
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


@functools.cache
def _lattices():
    """Lattice ``i len(COUNTS) + j``: ``COUNTS[i]`` by ``COUNTS[j]`` points; the last is `FLAT`."""
    axes = [_axis(count) for count in COUNTS]
    steps = (np.arange(FLAT) + 0.5) / FLAT * 2.0 - 1.0
    flat = np.stack(np.meshgrid(steps, steps)).reshape(2, -1)
    grids = [_lattice(major, minor) for major in axes for minor in axes]
    grids.append((flat, np.full(FLAT**2, 1.0 / FLAT**2), np.array([FLAT**2])))
    every_points, every_shares, patches = zip(*grids, strict=True)
    points = np.concatenate(every_points, axis=1).astype(np.float32)
    shares = np.concatenate(every_shares).astype(np.float32)
    count, sizes = np.array([len(each) for each in patches]), np.concatenate(patches)
    start = np.cumsum(sizes) - sizes
    low, high = np.minimum.reduceat(points, start, 1), np.maximum.reduceat(points, start, 1)
    sums = np.add.reduceat([shares, shares * shares], start, 1)
    first = np.cumsum(count) - count
    return _Lattices(
        first, count, start, sizes, (low + high) / 2, (high - low) / 2, points, shares, sums
    )


def _lattice(major, minor):
    """Points, (2, k), of variance 1, shares, (k,), and patch sizes of a grid without corners."""
    product = np.outer(major[1], minor[1])  # (k_major, k_minor), shares
    place = np.broadcast_arrays(major[0][:, None], minor[0])  # (k_major, k_minor) each
    extent = WIDE_EXTENT if max(product.shape) >= _WIDE else _EXTENT
    keep = np.hypot(*place) <= extent + _CORNER
    keep |= product.size <= 4
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
    return points[:, order], shares[order], sizes[sizes > 0]


def _axis(count):
    """Places and shares of `count` equally wide bins of the normal distribution, of variance 1."""
    if count == 1:
        return np.zeros(1), np.ones(1)
    extent = WIDE_EXTENT if count >= _WIDE else _EXTENT
    edges = np.linspace(-extent, extent, count + 1)
    mass = np.diff([math.erf(edge / math.sqrt(2.0)) for edge in edges]) / 2.0
    density = np.exp(-edges * edges / 2.0) / math.sqrt(2.0 * math.pi)
    place = -np.diff(density) / mass  # the mean of the normal distribution within each bin
    mass /= mass.sum()
    return place / np.sqrt(np.sum(mass * place * place)), mass
