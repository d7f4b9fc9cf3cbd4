"""Which splats float: they stand where the cameras see that nothing is.

1. Suspects are found: splats that have little support by others (`support.own_support`), small
   clusters that touch nothing else, giants and needles (`search.Search`).
2. All suspects are taken away, and it is measured what the views see at the place of each: how much
   of the light that reaches it stops near it, and how much goes on to a surface behind. So floaters
   are no support for each other, and a surface supports all that belongs to it. A splat that has
   lost its support by that is suspect, too, and both steps are done again.

Only the second step decides (`judge`). A suspect floats if little light stops near it, views see
past it, and the evidence is enough: by how much it changes a pixel, and how many views see past it.
What touches splats that stay needs more evidence. A splat with nothing behind it, such as one of a
sky, stays.

Solid suspects that touch each other are also judged as one clump: they hold each other, and rays
hit each in few views, but together they are evidence enough. The views are split into groups by
turns, and each group has to agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..execute import Progress, part, silent
from ..splats import Splats, refuse_undrawable
from ..views import ViewSet
from ..visibility import projection
from ..visibility.projection import Gaussians
from ..volumes import must_go
from .search import SOLID, Found, Search, connected, is_slender, touching
from .support import Evidence, share

REASONS = {
    "front": "in front of surfaces",
    "isolated": "isolated",
    "giant": "giant",
    "needle": "needle-like",
    "transparent": "nearly transparent",
    "haze": "haze near cameras",
    "outside": "outside all views",
}
"""Why a splat may go, and how that is said after a number."""

DEFAULT_REASONS = ("front", "isolated", "giant", "needle")
"""All but what no picture shows, and what no view can judge."""

NEAR = 0.3
"""Haze is at most so far from a camera, scene sizes."""

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


@dataclass(frozen=True)
class Cleaning:
    """What to clean away.

    Attributes
    ----------
    reasons : tuple of str
        Among `REASONS`.
    views : int
        Use at most this many views, spread evenly; 0 uses all.
    """

    reasons: tuple[str, ...] = DEFAULT_REASONS
    views: int = 64

    def __post_init__(self) -> None:
        """Check the values."""
        object.__setattr__(self, "reasons", tuple(self.reasons))
        unknown = [reason for reason in self.reasons if reason not in REASONS]
        if unknown or not self.reasons:
            got = repr(unknown[0]) if unknown else "none"
            raise RefineError(f"reason is {got}, expected some of {', '.join(REASONS)}")
        if self.views < 0:
            raise RefineError(f"views is {self.views}, expected 0 (all) or more")


@dataclass(frozen=True, eq=False)
class Cleaned:
    """Which splats `clean` would remove, and why.

    Attributes
    ----------
    keep : (N,) bool
        Which splats stay.
    by_reason : dict of str to (N,) bool
        For each of `REASONS`, switched on or not, the splats that it is true of; a splat has one
        reason. Protected splats have none.
    past : (N,) int32
        How many views see past each splat.
    seen : (N,) int32
        In how many of the views used each splat's centre lies; 0 of those that had to go.
    sure : (N,) float32
        Of those that have a reason, the share of further views that is expected to see past each,
        (p + 1) / (n + 2) where p of n do (Laplace's rule of succession).
    undrawable : int
        How many splats cannot be drawn. They stay.
    views_given, views_used : int
        How many views there were, and how many of them were used.
    settings : Cleaning
    """

    keep: NDArray[np.bool_]
    by_reason: dict[str, NDArray[np.bool_]]
    past: NDArray[np.int32]
    seen: NDArray[np.int32]
    sure: NDArray[np.float32]
    undrawable: int
    views_given: int
    views_used: int
    settings: Cleaning

    def counts(self) -> dict[str, int]:
        """Number of splats that go for each reason that is switched on."""
        return {name: int(np.count_nonzero(self.by_reason[name])) for name in self.settings.reasons}

    def surety(self) -> dict[str, float | None]:
        """Mean of `sure` for each of `REASONS`; None where no view tells."""
        return {
            name: float(self.sure[mask].mean(dtype=np.float64))
            if name != "outside" and mask.any()
            else None
            for name, mask in self.by_reason.items()
        }

    def facts(self) -> dict[str, Any]:
        """What a report says of it."""
        surety = self.surety()
        sure = {name: surety[name] for name in self.settings.reasons}
        return {**self.counts(), "sure": sure, "words": self.in_words()}

    def in_words(self) -> str:
        """What goes, why, and how sure that is, such as "2,114 in front of surfaces (96 %)".

        The percentage is the mean of `sure`.
        """
        counts, surety = self.counts(), self.surety()
        words = [
            f"{counts[name]:,} {text}"
            + ("" if (sure := surety[name]) is None else f" ({100.0 * sure:.0f} %)")
            for name, text in REASONS.items()
            if counts.get(name)
        ]
        return ", ".join(words) or "nothing to clean away"

    def notes(self) -> list[str]:
        """What else the user should know, in sentences."""
        note = f"{self.undrawable} splats cannot be drawn: no view shows them, and they stay"
        return [note] if self.undrawable else []


def clean(
    splats: Splats,
    views: ViewSet,
    settings: Cleaning = Cleaning(),
    *,
    protected: NDArray[np.bool_] | None = None,
    removed: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Cleaned:
    """Find floaters and outliers by what the cameras see.

    Parameters
    ----------
    splats : Splats
        In the frame and unit of the views.
    views : ViewSet
    settings : Cleaning
    protected : (N,) bool, optional
        Splats that stay, whatever they are. They are evidence all the same.
    removed : (N,) bool, optional
        Splats that go, unless they are protected, and are no evidence: as if they had gone before.
    progress : callable, optional
        See `refine_addon.core.execute.Progress`.
    threads : int, optional

    Raises
    ------
    RefineError
        If there are splats and none of them can be drawn, if no view sees any, or if nothing would
        be left.
    Cancelled
        If `progress` answers ``False``.
    """
    gone = must_go(removed, protected)
    rest = np.ones(len(splats), np.bool_) if gone is None else ~gone
    left = splats if gone is None else splats.take(rest)
    with np.errstate(under="ignore"):
        gaussians, scene, good = projection.prepare(
            left, views, progress=part(progress, 0.0, 0.05), threads=threads
        )
        if len(left):
            refuse_undrawable(int(np.count_nonzero(good)), len(left))
        deciding = [view for view, _ in views.spread(settings.views).by_distance()]
        slender = is_slender(left.log_scales[gaussians.index])
        search = Search(gaussians, scene, deciding, threads)
        found = search.find(slender, part(progress, 0.05, 1.0))
        shows, faint, sure = judge(gaussians, found, threads)
        faint &= found.doubted & ~found.large
        haze = faint & (gaussians.alphas < FAINT) & _near_any(gaussians, scene, deciding, faint)
        unused = [view for view in views if view not in deciding]
        masks = {
            "front": shows & found.doubted & ~found.large,
            "isolated": shows & ~found.doubted & ~found.large,
            "giant": shows & found.giant,
            "needle": shows & found.needle,
            "transparent": faint & ~haze,
            "haze": haze,
            "outside": _outside(gaussians, scene, found.shown, unused),
        }
    rows = np.flatnonzero(rest)[gaussians.index]

    def of_all(values: NDArray[Any]) -> NDArray[Any]:
        """Values of M Gaussians, (M,), for all splats, (N,); 0 for the others."""
        whole = np.zeros(len(splats), values.dtype)
        whole[rows] = values
        return whole

    may_go = True if protected is None else ~protected
    by_reason = {name: of_all(mask) & may_go for name, mask in masks.items()}
    keep = rest & ~np.any([by_reason[name] for name in settings.reasons], axis=0)
    if len(left) and not keep.any():
        raise RefineError(f"cleaning would remove all {len(left)} splats; nothing was removed")
    past, seen = (of_all(x.astype(np.int32)) for x in (found.evidence.past, found.views))
    return Cleaned(
        keep, by_reason, past, seen, of_all(sure.astype(np.float32)),
        int(np.count_nonzero(~good)), len(views), len(deciding), settings,
    )  # fmt: skip


def _near_any(gaussians, scene, views, chosen):
    """Gaussians among those chosen, (M,) bool, that are near a camera, (M,) bool."""
    rows = np.flatnonzero(chosen)
    near = np.zeros(len(rows), np.bool_)
    for view in views:
        step = gaussians.means[:, rows].T - scene.positions(view.center[None])
        near |= np.einsum("ij,ij->i", step, step) < NEAR * NEAR
    return np.bincount(rows[near], minlength=len(chosen)) > 0


def _outside(gaussians, scene, shown, unused):
    """Gaussians that reach into the picture of no view, used or not, (M,)."""
    rows = np.flatnonzero(~shown)
    for view in unused:
        if len(rows):
            rows = np.delete(rows, projection.project(gaussians.take(rows), scene, view).index)
    return np.bincount(rows, minlength=len(shown)) > 0


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
