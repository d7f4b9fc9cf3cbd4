"""Clumps of solid suspects that touch go as one if groups of views agree on it.

The splats of a dense clump hold each other, and rays hit each in few views; together they are
evidence enough. The views are split into groups by turns, and what some groups see has to hold for
those left out.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .clusters import connected

VIEW_PARTS = 4
"""So many groups of views are asked whether they agree on a clump."""

AGREED = 0.7
"""A group agrees that a clump floats if, of its views that see the splats' places, this share sees
past them, weighted by opacity."""

FEWEST = 10
"""Clumps of at least so many splats are judged as one; what does not go so may go by itself."""

CLUMP_SUPPORT = 0.1
"""A clump goes only if less than this share of the light stops near its splats."""


class Looks(NamedTuple):
    """What views see of s suspects.

    Attributes
    ----------
    near, behind : (s,) float64
        See `support.Evidence`.
    past : (s,) float64
        How many views see past each.
    change : (s,) float64
        By how much each changes a pixel.
    seen_by, past_by : (VIEW_PARTS, s) float32
        How many views of each group see the place of each, and how many of them see past it.
    """

    near: NDArray[np.float64]
    behind: NDArray[np.float64]
    past: NDArray[np.float64]
    change: NDArray[np.float64]
    seen_by: NDArray[np.float32]
    past_by: NDArray[np.float32]


def judge(
    looks: Looks,
    alphas: NDArray[np.float32],
    pairs: tuple[NDArray[np.int64], NDArray[np.int64]],
    needed: tuple[float, float],
) -> NDArray[np.bool_]:
    """Return which of s solid suspects go with their clump, (s,).

    Parameters
    ----------
    looks : Looks
    alphas : (s,) float32
        Their opacity, by which they count in their clump.
    pairs : two of (e,) int64
        Which touch, as places among the s.
    needed : float, float
        A clump goes if its change of a pixel, times the power, the second, of one more than the
        views that see past it, is at least the first.
    """
    clump = connected(len(alphas), *pairs)
    weight = alphas.astype(np.float64)

    def total(values: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
        """Return the sum over the clump of each, (s,)."""
        return np.asarray(np.bincount(clump, values, len(clump))[clump], np.float64)

    size, mass = total(np.ones(len(clump))), total(weight)
    change, past = (total(weight * values) / mass for values in (looks.change, looks.past))
    agreed = np.ones(len(clump), np.bool_)
    for seen_by, past_by in zip(looks.seen_by, looks.past_by, strict=True):
        seen = total(weight * seen_by)
        agreed &= (seen <= 0.5 * mass) | (total(weight * past_by) >= AGREED * seen)
    near, behind = total(looks.near), total(looks.behind)
    enough = change * (1.0 + past) ** needed[1] >= needed[0]
    alone = near < CLUMP_SUPPORT * (near + behind)
    return np.asarray((size >= FEWEST) & agreed & enough & alone)
