"""The exact k-th of many numbers, from counts alone: a radix selection on their bit patterns.

The bits of a number are read in digits of 16, the highest first. Counting one digit of all numbers
that begin like the wanted one tells its next digit. Counts of parts add up to those of the whole,
so the numbers can be read a part at a time, on several machines, in any order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Count = Callable[[list[int], int], NDArray[np.int64]]

DIGIT = 16
"""Bits that are counted at a time."""


def keys_of(values: NDArray[np.floating[Any]]) -> NDArray[np.unsignedinteger[Any]]:
    """Return whole numbers in the order of floats: equal for equal floats, the highest for NaN.

    Parameters
    ----------
    values : (N,) float32 or float64

    Returns
    -------
    (N,) uint32 or uint64
        With the same number of bits.

    Examples
    --------
    >>> keys_of(np.array([-1.0, -0.0, 0.0, 1e-45, np.inf, np.nan], np.float32)).tolist()
    [1082130431, 2147483648, 2147483648, 2147483649, 4286578688, 4294967295]
    """
    size = values.dtype.itemsize
    unsigned = np.dtype(f"u{size}").type
    sign = unsigned(1 << (8 * size - 1))
    bits = (values + values.dtype.type(0.0)).view(unsigned)  # -0 becomes 0
    keys: NDArray[np.unsignedinteger[Any]] = bits | sign
    negative = bits >= sign
    if negative.any():
        keys[negative] = ~bits[negative]
    undefined = np.isnan(values)
    if undefined.any():
        keys[undefined] = ~unsigned(0)
    return keys


def value_of(key: int, dtype: np.dtype[Any]) -> float:
    """Return the float of a key: the inverse of `keys_of`."""
    bits = 8 * dtype.itemsize
    sign = 1 << (bits - 1)
    raw = key ^ sign if key & sign else ~key & (2 * sign - 1)
    return float(np.array([raw], f"u{dtype.itemsize}").view(dtype)[0])


def counts(
    keys: NDArray[np.unsignedinteger[Any]],
    prefixes: Sequence[int],
    shift: int,
    weights: NDArray[np.int64] | None = None,
) -> NDArray[np.int64]:
    """Return how often each value of a digit occurs in numbers that begin in a certain way.

    Parameters
    ----------
    keys : (N,) unsigned
    prefixes : sequence of P int
        The bits above the digit.
    shift : int
        How many bits stand below the digit.
    weights : (N,) int64, optional
        Each number counts so often; by default once.

    Returns
    -------
    (P, 65536) int64
    """
    kind = keys.dtype.type
    whole = shift + DIGIT == 8 * keys.dtype.itemsize
    occurrences = np.zeros((len(prefixes), 1 << DIGIT), np.int64)
    for index, prefix in enumerate(prefixes):
        chosen = slice(None) if whole else (keys >> kind(shift + DIGIT)) == kind(prefix)
        digits = ((keys[chosen] >> kind(shift)) & kind((1 << DIGIT) - 1)).astype(np.uint16)
        # Sums of whole numbers in float64, which are exact up to 2^53.
        weight = None if weights is None else weights[chosen]
        occurrences[index] = np.bincount(digits, weight, minlength=1 << DIGIT)
    return occurrences


class Sparse(NamedTuple):
    """Counts without those that are 0, which are most: what is sent from machine to machine.

    Attributes
    ----------
    prefixes : int
        How many rows of counts.
    places : (n,) uint32
        Where in all rows one after the other.
    counts : (n,) int64
    """

    prefixes: int
    places: NDArray[np.uint32]
    counts: NDArray[np.int64]

    @classmethod
    def of(cls, counts: NDArray[np.int64]) -> Sparse:
        """Return `counts` without zeros."""
        flat = counts.ravel()
        places = np.flatnonzero(flat)
        return cls(len(counts), places.astype(np.uint32), flat[places])


def added(parts: Iterable[Sparse]) -> NDArray[np.int64]:
    """Return the sum of counts of at least one part, (P, 65536)."""
    total = np.zeros(0, np.int64)
    for prefixes, places, each in parts:
        if not len(total):
            total = np.zeros(prefixes << DIGIT, np.int64)
        total[places] += each
    return total.reshape(-1, 1 << DIGIT)


def find(count: Count, bits: int, ranks: Sequence[int]) -> list[tuple[int, int]]:
    """Return the numbers that have certain places in ascending order, the smallest at 0.

    Parameters
    ----------
    count : callable
        ``count(prefixes, shift)`` returns `counts` of all numbers.
    bits : int
        Of a number.
    ranks : sequence of int
        In the range of the sum of all counts.

    Returns
    -------
    list of (key, below)
        For each place the key there, and how many numbers are smaller than it.

    Examples
    --------
    >>> keys = np.array([70000, 5, 9, 9], np.uint32)
    >>> find(lambda prefixes, shift: counts(keys, prefixes, shift), 32, [1, 2, 3])
    [(9, 1), (9, 1), (70000, 3)]
    """
    # Of each number the digits read so far, and how many numbers are smaller than these say.
    read = [(0, 0)] * len(ranks)
    for shift in range(bits - DIGIT, -1, -DIGIT):
        prefixes = sorted({prefix for prefix, _ in read})
        sums = dict(zip(prefixes, np.cumsum(count(prefixes, shift), axis=1), strict=True))
        for index, (rank, (prefix, below)) in enumerate(zip(ranks, read, strict=True)):
            upto = sums[prefix]
            digit = int(np.searchsorted(upto, rank - below, side="right"))
            less = int(upto[digit - 1]) if digit else 0
            read[index] = (prefix << DIGIT | digit, below + less)
    return read


def median(count: Count, dtype: np.dtype[Any], total: int) -> float:
    """Return the median of `total` floats as `numpy.median` does; see `find` for `count`."""
    ranks = [(total - 1) // 2, total // 2]
    low, high = (value_of(key, dtype) for key, _ in find(count, 8 * dtype.itemsize, ranks))
    return low if low == high else (low + high) / 2.0
