"""Which suspects float, by what the views see at their places.

A suspect floats if little light stops near it, views see past it, and the evidence is enough: by
how much it changes a pixel, and how many views see past it. What touches splats that stay needs
more evidence.

Solid suspects that touch each other are also judged as one clump: they hold each other, and rays
hit each in few views, but together they are evidence enough. The views are split into groups by
turns, and each group has to agree.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..execute import silent
from ..visibility.projection import Gaussians
from .clusters import SOLID, connected, touching
from .search import Found
from .support import Evidence, share

SUPPORT = 0.5
"""A suspect floats only if less than this share of the light stops near it."""

ISOLATED_SUPPORT = 0.05
"""The same of what only belongs to a small cluster."""

AGREE = 0.1
"""At least this share of the views that see it must see past it, but for giants and needles."""

FEW = 2.0
"""What fewer views see past stays: no view could be left out, and the others still tell."""

POWER = 1.5
"""The evidence is by how much a splat changes a pixel, times this power of one more than the views
that see past it."""

NEEDED = 4 / 255
"""So much evidence is needed against a splat that touches nothing."""

HELD = 8.0
"""For a single splat it is multiplied by this to the power of the square root of how many
neighbours touch it and stay."""

GIANT_NEEDED, NEEDLE_NEEDED = 8.0, 1 / 3
"""It is multiplied by these, too, for giants and needles."""

AT_SURFACE = 150.0
"""For giants by this to the power of their support, too: a sky is made of giants that lie near each
other, and a veil hangs before what lies behind."""

FAINT = 0.15
"""Haze is of lower opacity."""

HAZE_HELD = 1.35
"""For what is so faint, but for giants, by this to the power of how many faint neighbours touch it,
whether they stay or go: a cloud of faint splats was trained as one, and pictures need it as one."""

VISIBLE, GLARING, WIDE = 4 / 255, 40 / 255, 0.05
"""A change of a pixel is opacity times contrast to what lies behind, at most the second of these.
Where the standard deviation of a giant reaches across more than the third share of a picture's
longer side it counts by so much more. What stays, but would go if it changed a pixel by the first
and touched no haze, is nearly transparent."""

CLUMP_NEEDED = 125.0
"""`NEEDED` is multiplied by this for a clump that is judged as one, whatever it touches."""

AGREED = 0.7
"""A group agrees that a clump floats if, of its views that see the splats' places, this share sees
past them, weighted by opacity."""

FEWEST = 10
"""Clumps of at least so many splats are judged as one; what does not go so may go by itself."""

CLUMP_SUPPORT = 0.1
"""A clump goes only if less than this share of the light stops near its splats."""


def judge(
    gaussians: Gaussians, found: Found, threads: int | None = None
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float64]]:
    """Suspects that float and show, those that float but do not show, and how sure that is.

    Returns
    -------
    shows, faint : (M,) bool
    sure : (M,) float64
        The share of further views that is expected to see past each.
    """
    evidence, giant, large = found.evidence, found.giant, found.large
    seen, past = evidence.views, evidence.past
    support = share(evidence.near, evidence.near + evidence.behind)
    passed = np.where(large, np.maximum(past, seen * (1.0 - support)), past)
    most = np.where(large | found.doubted, SUPPORT, ISOLATED_SUPPORT)
    may = found.suspects & (support < most) & (large | (past >= AGREE * seen))
    may &= (past >= FEW) | (giant & (passed >= FEW))
    rows = np.flatnonzero(found.suspects)
    near, touch = touching(gaussians, rows, silent, threads)
    behind = np.where(evidence.behind > 0.0, evidence.behind, 1.0)
    change = np.minimum(gaussians.alphas * (evidence.contrast / behind), GLARING)
    in_clumps = _clumps(gaussians, found, change, rows, near, touch)
    near, touch, rows = near[may[rows]], touch[may[rows]], rows[may[rows]]
    kind = np.where(found.needle, NEEDLE_NEEDED, 1.0)
    kind = np.where(giant, GIANT_NEEDED * AT_SURFACE**support, kind)
    needed = (NEEDED * kind / (1.0 + passed) ** POWER)[rows]
    change = (change * np.where(giant, np.maximum(found.width, WIDE) / WIDE, 1.0))[rows]
    hazy = gaussians.alphas < FAINT
    in_haze = np.count_nonzero(touch & hazy[near], axis=1) * (hazy & ~giant)[rows]

    def unheld(change: NDArray[np.float64], needed: NDArray[np.float64]) -> NDArray[np.bool_]:
        goes = may.copy()
        while True:  # what stays holds its neighbours: fewer go each time
            stay = np.count_nonzero(touch & ~goes[near], axis=1)
            left = change >= needed * HELD ** np.sqrt(stay)
            if np.array_equal(left, goes[rows]):
                return goes
            goes[rows] = left

    shows = unheld(change, needed * HAZE_HELD**in_haze) | in_clumps
    faint = unheld(np.maximum(change, VISIBLE), needed) & ~shows
    return shows, faint, (passed + 1.0) / (seen + 2.0)


def _clumps(gaussians, found, change, rows, near, touch):
    """Gaussians that go as the clump of solid suspects that they are in, (M,) bool.

    Parameters
    ----------
    gaussians : Gaussians
    found : Found
    change : (M,) float64
        By how much each changes a pixel.
    rows : (s,) int64
        The suspects.
    near, touch : (s, k)
        Near splats, and which of them each touches.
    """
    chosen = np.flatnonzero(~found.large[rows] & (gaussians.alphas[rows] >= SOLID[-1]))
    members, near, touch = rows[chosen], near[chosen], touch[chosen]
    place = np.full(len(change), -1)
    place[members] = np.arange(len(members))
    one, other = np.nonzero(touch & (place[near] >= 0))
    clump = connected(len(members), one, place[near[one, other]])
    weight = gaussians.alphas[members].astype(np.float64)  # in the means of a clump

    def total(values):
        return np.bincount(clump, values, len(clump))[clump]

    evidence = Evidence(*(values[members] for values in found.evidence))
    size, mass = total(np.ones(len(clump))), total(weight)
    change, past = (total(weight * of_each) / mass for of_each in (change[members], evidence.past))
    goes = size >= FEWEST
    for seen_by, past_by in zip(*found.by_part[:, :, members], strict=True):
        seen = total(weight * seen_by)
        goes &= (seen <= 0.5 * mass) | (total(weight * past_by) >= AGREED * seen)
    goes &= change * (1.0 + past) ** POWER >= CLUMP_NEEDED * NEEDED
    stops, passes = total(evidence.near), total(evidence.behind)
    goes &= stops < CLUMP_SUPPORT * (stops + passes)
    return np.bincount(members[goes], minlength=len(place)) > 0
