"""Lattices of points that stand for the standard normal distribution in two dimensions.

Each footprint is replaced by such points, more of them the more cells it covers (`points`).
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""How many points a lattice may have along an axis."""

FLAT = 16
"""A splat much larger than the image gets this many points across and down the image instead."""

WIDE_EXTENT = 3.0
"""Standard deviations to which a lattice of many points reaches."""

_EXTENT = 2.4  # standard deviations, of lattices of fewer than `_WIDE` points along an axis
_WIDE = 8
_CORNER = 0.1  # standard deviations; points farther than that beyond the extent are left out
_PATCH = 6  # points along a side of a patch, at most


class Table(NamedTuple):
    """L lattices of P patches and K points: a patch that misses the image is not laid out.

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
def lattice_table() -> Table:
    """All lattices: number ``i len(COUNTS) + j`` has ``COUNTS[i]`` by ``COUNTS[j]`` points.

    One more at the end has `FLAT` by `FLAT` points over the image; their coordinates are -1 to 1,
    in half image sizes.
    """
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
    return Table(
        first, count, start, sizes, (low + high) / 2, (high - low) / 2, points, shares, sums
    )


def _lattice(major, minor):
    """Points, (2, k), shares, (k,), and sizes of the patches of a grid without its corners.

    It is scaled to variance 1 again.
    """
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
    """Places and shares of the normal distribution: its mean in bins of equal width, variance 1."""
    if count == 1:
        return np.zeros(1), np.ones(1)
    extent = WIDE_EXTENT if count >= _WIDE else _EXTENT
    edges = np.linspace(-extent, extent, count + 1)
    mass = np.diff([math.erf(edge / math.sqrt(2.0)) for edge in edges]) / 2.0
    density = np.exp(-edges * edges / 2.0) / math.sqrt(2.0 * math.pi)
    place = -np.diff(density) / mass  # the mean of the normal distribution within each bin
    mass /= mass.sum()
    return place / np.sqrt(np.sum(mass * place * place)), mass
