"""An order of splats in which runs of consecutive ones lie near each other, found quickly."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

_BITS = 5
"""Bits of a cell's number along each axis: those of three axes fit into 16, which NumPy sorts by
radix."""

_SAMPLE = 4096  # splats that say where the grid lies

_ENDS = (0.02, 0.98)
"""The grid lies between these quantiles of the sample along each axis; splats beyond them count to
its outermost cells."""

_LEAST_SPAN = 1e-200


def near_order(means: NDArray[np.floating[Any]]) -> NDArray[np.int64]:
    """Return the order of positions along a Hilbert curve through a grid of 32 x 32 x 32 cells.

    Parameters
    ----------
    means : (N, 3) floating
        Finite, in any unit.

    Returns
    -------
    (N,) int64
        Those of a cell, and those beyond the same face of the grid, keep their order.
    """
    sample = means[:: max(len(means) // _SAMPLE, 1)].astype(np.float64)
    cell = np.zeros(len(means), np.uint16)
    with np.errstate(under="ignore"):
        low, high = np.quantile(sample, _ENDS, axis=0)  # (3,) each
        # Cubes: a run is about as wide as high, however flat the scene.
        scale = (1 << _BITS) / max(float(np.max(high - low)), _LEAST_SPAN)
        for values, least in zip(means.T, low, strict=True):
            number = np.subtract(values, least, dtype=np.float64)  # (N,)
            number *= scale
            cell <<= _BITS
            cell |= np.clip(number, 0, (1 << _BITS) - 1, out=number).astype(np.uint16)
    return np.argsort(_places()[cell], kind="stable")


@cache
def _places() -> NDArray[np.uint16]:
    """Return the place of each cell along the curve; cells count z first, then y, then x.

    J. Skilling, Programming the Hilbert curve, AIP Conf. Proc. 707, 2004: the loops are those of
    ``AxestoTranspose`` there, for all cells at once.
    """
    cells = np.arange(1 << 3 * _BITS)
    axes = np.stack([cells >> 2 * _BITS, cells >> _BITS, cells]) & ((1 << _BITS) - 1)  # (3, cells)
    for bit in range(_BITS - 1, 0, -1):
        lower = (1 << bit) - 1
        for axis in axes:
            # Where the bit is set the lower ones of the first axis turn over, elsewhere they are
            # exchanged with this axis'.
            turned = (axis >> bit & 1).astype(bool)
            swap = np.where(turned, 0, (axes[0] ^ axis) & lower)
            axes[0] ^= np.where(turned, lower, swap)
            np.bitwise_xor(axis, swap, out=axis)
    axes[1] ^= axes[0]
    axes[2] ^= axes[1]
    turns = np.zeros_like(cells)
    for bit in range(_BITS - 1, 0, -1):
        turns ^= np.where(axes[2] >> bit & 1, (1 << bit) - 1, 0)
    axes ^= turns
    places = np.zeros_like(cells)
    for bit in range(_BITS - 1, -1, -1):
        for axis in axes:
            places = places << 1 | axis >> bit & 1
    return places.astype(np.uint16)
