"""Running sums front to back: along rays, and down the columns of points in the cells of an image.

Values of all columns lie one after the other, each column front to back. Sums run over all of them
at once and restart at each column, which costs no loop over columns.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def paired(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[Any]:
    """Return two real arrays as the real and imaginary parts of one complex array, (m,).

    A running sum over the pair is two running sums in the time of one.
    """
    pair = np.empty(first.shape, np.complex128)
    pair.real, pair.imag = first, second
    return pair


def in_front(values: NDArray[Any], counts: NDArray[np.int64]) -> NDArray[Any]:
    """Return for each value the sum of those in front of it in its column, (m,).

    Parameters
    ----------
    values : (m,) float64 or complex128
    counts : (C,) int64
        How many values each column has, at least one.

    Examples
    --------
    >>> in_front(np.array([1.0, 2.0, 4.0, 8.0]), np.array([3, 1])).tolist()
    [0.0, 1.0, 3.0, 0.0]
    """
    sums = np.cumsum(values)
    sums -= values
    sums -= np.repeat(sums.take(np.cumsum(counts) - counts), counts)
    return np.asarray(sums)


def behind(values: NDArray[Any], counts: NDArray[np.int64]) -> NDArray[Any]:
    """Return for each value the sum of those behind it in its column, (m,).

    Parameters
    ----------
    values, counts
        See `in_front`.

    Examples
    --------
    >>> behind(np.array([1.0, 2.0, 4.0, 8.0]), np.array([3, 1])).tolist()
    [6.0, 4.0, 0.0, 0.0]
    """
    sums = np.cumsum(values)
    return np.asarray(np.repeat(sums.take(np.cumsum(counts) - 1), counts) - sums)
