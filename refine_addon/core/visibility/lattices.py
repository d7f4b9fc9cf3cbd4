"""Lattices of points that stand for the standard normal distribution in two dimensions.

Each footprint is replaced by such points, more of them the more cells it covers (`points`).
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""How many points a lattice may have along an axis."""

FLAT = 16
"""A splat much larger than the image gets this many points across and down the image instead."""

WIDE_EXTENT = 3.0
"""Standard deviations to which a lattice of many points reaches."""

Axis = tuple["NDArray[np.float64]", "NDArray[np.float64]"]
"""Places along an axis of a lattice, and the share of the mass that each has."""

_EXTENT = 2.4  # standard deviations, of lattices of fewer than `_WIDE` points along an axis
_WIDE = 8
_CORNER = 0.1  # standard deviations; points farther than that beyond the extent are left out
_PATCH = 6  # points along a side of a patch, at most


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
    axes = [_axis(count) for count in COUNTS]
    grids = [_lattice(major, minor) for major in axes for minor in axes]
    steps = (np.arange(FLAT) + 0.5) / FLAT * 2.0 - 1.0
    flat = np.stack([axis.ravel() for axis in np.meshgrid(steps, steps)]).astype(np.float32)
    whole = np.array([FLAT**2])
    return (*grids, Lattice(flat, np.full(FLAT**2, 1.0 / FLAT**2, np.float32), whole))


def _lattice(major: Axis, minor: Axis) -> Lattice:
    """Return the grid of two axes without its corners, scaled to variance 1 again."""
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
    return Lattice(
        points[:, order].astype(np.float32), shares[order].astype(np.float32), sizes[sizes > 0]
    )


def _axis(count: int) -> Axis:
    """Return the normal distribution as points: its mean in bins of equal width, variance 1."""
    if count == 1:
        return np.zeros(1), np.ones(1)
    extent = WIDE_EXTENT if count >= _WIDE else _EXTENT
    edges = np.linspace(-extent, extent, count + 1)
    mass = np.diff([math.erf(edge / math.sqrt(2.0)) for edge in edges]) / 2.0
    density = np.exp(-edges * edges / 2.0) / math.sqrt(2.0 * math.pi)
    place = -np.diff(density) / mass  # the mean of the normal distribution within each bin
    mass /= mass.sum()
    return place / np.sqrt(np.sum(mass * place * place)), mass


class Table(NamedTuple):
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
def lattice_table() -> Table:
    """Return all lattices in one table."""
    count = np.array([len(lattice.patches) for lattice in lattices()])
    sizes = np.concatenate([lattice.patches for lattice in lattices()])
    start = np.cumsum(sizes) - sizes
    shares = np.concatenate([lattice.shares for lattice in lattices()])
    points = np.concatenate([lattice.points for lattice in lattices()], axis=1)
    low, high = np.minimum.reduceat(points, start, 1), np.maximum.reduceat(points, start, 1)
    sums = np.add.reduceat([shares, shares * shares], start, 1)
    first = np.cumsum(count) - count
    return Table(
        first, count, start, sizes, (low + high) / 2, (high - low) / 2, points, shares, sums
    )
