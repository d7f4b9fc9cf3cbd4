"""Which splats float: they stand where the cameras see that nothing is.

Suspects have little support (`support.own_support`), or are small clusters, giants or needles
(`search`). With all of them absent, the views measure how much light stops at the place of each and
how much goes on to a surface behind. Only this evidence decides (`judge`). docs/method.md, section
8, has the formulas.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..execute import Progress, part, silent, within
from ..splats import Splats, refuse_undrawable
from ..views import ViewSet
from ..visibility import projection
from ..visibility.projection import Gaussians
from ..volumes import must_go
from .search import SOLID, Search, Suspects, connected, is_slender, touching
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
"""Why a splat is removed: name, and words after a number, as in "12 in front of surfaces"."""

DEFAULT_REASONS = ("front", "isolated", "giant", "needle")
"""All but faint splats, which pictures hardly show, and those outside, which no view can judge."""

NEAR = 0.3
"""Distance from a camera, scene sizes, within which faint floaters are haze."""

SUPPORT = 0.5
"""A suspect floats only if its support in the last round is below this."""

ISOLATED_SUPPORT = 0.05
"""Likewise, of a suspect for no other reason than its small cluster."""

AGREE = 0.1
"""At least this share of the views that see a suspect must see past it, unless it is a giant or
needle."""

FEW = 2.0
"""Least number of views that see past it: with fewer, none could be left out."""

POWER = 1.5
"""Evidence is the change of a pixel times (views that see past + 1) to this power."""

NEEDED = 4 / 255
"""Evidence needed against a splat that touches nothing."""

HELD = 8.0
"""Factor of `NEEDED`, to the power of the root of the number of kept neighbours in touch."""

GIANT_NEEDED, NEEDLE_NEEDED = 8.0, 1 / 3
"""Factors of `NEEDED` for giants and needles."""

AT_SURFACE = 150.0
"""Factor of a giant's `NEEDED`, to the power of its support: giants of a sky support each other, a
veil has no support."""

FAINT = 0.15
"""Opacity below which splats are faint."""

HAZE_HELD = 1.35
"""Factor of `NEEDED` for a faint splat that is no giant, to the power of the number of faint
neighbours in touch, kept or not: pictures need the splats of a cloud together."""

VISIBLE, GLARING, WIDE = 4 / 255, 40 / 255, 0.05
"""Changes of a pixel, opacity times contrast. A splat that would float if its change
were at least the first is nearly transparent or haze. The second is the most that counts, but for
giants whose width, as a share of the picture, exceeds the third."""

CLUMP_NEEDED = 125.0
"""Factor of `NEEDED` for a clump that is judged as one, whatever it touches."""

AGREED = 0.7
"""Share of the views of a group that see a clump, weighted by opacity, that must see past it."""

FEWEST = 10
"""Least splats of a clump; smaller ones are judged singly."""

CLUMP_SUPPORT = 0.1
"""A clump floats only if its support is below this."""


@dataclass(frozen=True)
class Cleaning:
    """What to clean away, and by how many views.

    Parameters
    ----------
    reasons : tuple of str, among `REASONS`
    views : int, at most this many, spread evenly; 0 uses all
    """

    reasons: tuple[str, ...] = DEFAULT_REASONS
    views: int = 64

    def __post_init__(self) -> None:
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
    by_reason : dict of str to (N,) bool, for all `REASONS`; at most one a splat, none if protected
    past : (N,) int32, views that see past each splat
    seen : (N,) int32, views that hold its centre; 0 of those removed by the user
    sure : (N,) float32, (p + 1) / (n + 2) where p of n views see past it (Laplace)
    undrawable : int, splats that cannot be drawn, which stay
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
    views_between: ClassVar[int] = 0  # none decide

    def counts(self) -> dict[str, int]:
        """Splats to remove for each reason that is switched on."""
        return {name: int(np.count_nonzero(self.by_reason[name])) for name in self.settings.reasons}

    def surety(self) -> dict[str, float | None]:
        """Mean of `sure` for each of `REASONS`; None if no splat has it, and of those outside."""
        sure = {name: self.sure[mask] for name, mask in self.by_reason.items() if mask.any()}
        means = {name: float(values.mean(dtype=np.float64)) for name, values in sure.items()}
        return dict.fromkeys(self.by_reason) | means | {"outside": None}

    def facts(self) -> dict[str, Any]:
        """Plain JSON values for reports."""
        surety = self.surety()
        sure = {name: surety[name] for name in self.settings.reasons}
        return {**self.counts(), "sure": sure, "words": self.in_words()}

    def in_words(self) -> str:
        """What is removed, why and how surely, such as "2 giant (96 % sure)"."""
        surety = self.surety()
        return in_words({name: (n, surety[name]) for name, n in self.counts().items()})

    def notes(self) -> list[str]:
        """Notes for the user, in sentences."""
        note = f"{self.undrawable} splats cannot be drawn: no view shows them, and they stay"
        return [note] if self.undrawable else []


def in_words(found: Mapping[str, tuple[int, float | None]]) -> str:
    """Splats to remove by reason, with `Cleaned.surety`; see `Cleaned.in_words`."""
    words = [
        f"{count:,} {REASONS[name]}" + (f" ({100.0 * sure:.0f} %)" if sure else "")
        for name, (count, sure) in found.items()
        if count
    ]
    return ", ".join(words).replace(" %", " % sure", 1) or "nothing to clean away"


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
    """Find floaters and outliers by what the cameras see (docs/method.md, section 8).

    Parameters
    ----------
    splats : Splats, in the frame and unit of the views
    views : ViewSet
    settings : Cleaning
    protected : (N,) bool, splats that stay, and are evidence
    removed : (N,) bool, splats that go unless protected, and are no evidence
    progress, threads : see `prune`

    Raises
    ------
    RefineError : if no splat can be drawn, no view sees any, or nothing would be left
    """
    gone = must_go(removed, protected)
    rest = np.ones(len(splats), np.bool_) if gone is None else ~gone
    left = splats if gone is None else splats.take(rest)
    with np.errstate(under="ignore"), within(cores=threads):
        earlier = part(progress, 0.0, 0.05)
        gaussians, scene, good = projection.prepare(left, views, progress=earlier)
        if len(left):
            refuse_undrawable(int(np.count_nonzero(good)), len(left))
        deciding = [view for view, _ in views.spread(settings.views).by_distance()]
        slender = is_slender(left.log_scales[gaussians.index])
        suspects = Search(gaussians, scene, deciding).find(slender, part(progress, 0.05, 1.0))
        shows, faint, sure = judge(gaussians, suspects)
        faint &= suspects.doubted & ~suspects.large
        haze = faint & (gaussians.alphas < FAINT) & _near_any(gaussians, scene, deciding, faint)
        unused = [view for view in views if view not in deciding]
        masks = {
            "front": shows & suspects.doubted & ~suspects.large,
            "isolated": shows & ~suspects.doubted & ~suspects.large,
            "giant": shows & suspects.giant,
            "needle": shows & suspects.needle,
            "transparent": faint & ~haze,
            "haze": haze,
            "outside": _outside(gaussians, scene, suspects.shown, unused),
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
    past, seen = (of_all(x.astype(np.int32)) for x in (suspects.evidence.past, suspects.views))
    return Cleaned(
        keep, by_reason, past, seen, of_all(sure.astype(np.float32)),
        int(np.count_nonzero(~good)), len(views), len(deciding), settings,
    )  # fmt: skip


def _near_any(gaussians, scene, views, chosen):
    """Gaussians among those chosen that are near a camera, (M,) bool."""
    rows = np.flatnonzero(chosen)
    near = np.zeros(len(rows), np.bool_)
    for view in views:
        step = gaussians.means[:, rows].T - scene.positions(view.center[None])
        near |= np.einsum("ij,ij->i", step, step) < NEAR * NEAR
    return np.bincount(rows[near], minlength=len(chosen)) > 0


def _outside(gaussians, scene, shown, unused):
    """Gaussians that reach into the picture of no view, used or not, (M,) bool."""
    rows = np.flatnonzero(~shown)
    for view in unused:
        if len(rows):
            rows = np.delete(rows, projection.project(gaussians.take(rows), scene, view).index)
    return np.bincount(rows, minlength=len(shown)) > 0


def judge(
    gaussians: Gaussians, suspects: Suspects
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.float64]]:
    """Suspects that float, others that would if they were less faint, and `Cleaned.sure`, (M,).

    One floats if little light stops near it, views see past it, and the evidence suffices, more if
    kept splats touch it (docs/method.md, section 8). With nothing behind, as in a sky, it stays.
    """
    evidence, giant, large = suspects.evidence, suspects.giant, suspects.large
    seen, past = evidence.views, evidence.past
    support = share(evidence.near, evidence.near + evidence.behind)
    passed = np.where(large, np.maximum(past, seen * (1.0 - support)), past)
    most = np.where(large | suspects.doubted, SUPPORT, ISOLATED_SUPPORT)
    may = suspects.every & (support < most) & (large | (past >= AGREE * seen))
    may &= (past >= FEW) | (giant & (passed >= FEW))
    rows = np.flatnonzero(suspects.every)
    near, touch = touching(gaussians, rows)
    behind = np.where(evidence.behind > 0.0, evidence.behind, 1.0)
    change = np.minimum(gaussians.alphas * (evidence.contrast / behind), GLARING)
    in_clumps = _clumps(gaussians, suspects, change, rows, near, touch)
    near, touch, rows = near[may[rows]], touch[may[rows]], rows[may[rows]]
    kind = np.where(suspects.needle, NEEDLE_NEEDED, 1.0)
    kind = np.where(giant, GIANT_NEEDED * AT_SURFACE**support, kind)
    needed = (NEEDED * kind / (1.0 + passed) ** POWER)[rows]
    change = (change * np.where(giant, np.maximum(suspects.width, WIDE) / WIDE, 1.0))[rows]
    hazy = gaussians.alphas < FAINT
    in_haze = np.count_nonzero(touch & hazy[near], axis=1) * (hazy & ~giant)[rows]

    def floating(change: NDArray[np.float64], needed: NDArray[np.float64]) -> NDArray[np.bool_]:
        goes = may.copy()
        while True:  # kept neighbours raise what is needed: fewer go each time
            stay = np.count_nonzero(touch & ~goes[near], axis=1)
            left = change >= needed * HELD ** np.sqrt(stay)
            if np.array_equal(left, goes[rows]):
                return goes
            goes[rows] = left

    shows = floating(change, needed * HAZE_HELD**in_haze) | in_clumps
    faint = floating(np.maximum(change, VISIBLE), needed) & ~shows
    return shows, faint, (passed + 1.0) / (seen + 2.0)


def _clumps(gaussians, suspects, change, rows, near, touch):
    """Solid suspects that touch and float as one clump, (M,): few views have rays on each of them.

    Each group of views has to agree; `near` and `touch`, (s, k), are of the suspects `rows`.
    """
    chosen = np.flatnonzero(~suspects.large[rows] & (gaussians.alphas[rows] >= SOLID[-1]))
    members, near, touch = rows[chosen], near[chosen], touch[chosen]
    place = np.full(len(change), -1)
    place[members] = np.arange(len(members))
    one, other = np.nonzero(touch & (place[near] >= 0))
    clump = connected(len(members), one, place[near[one, other]])
    weight = gaussians.alphas[members].astype(np.float64)  # in the means of a clump

    def total(values):
        return np.bincount(clump, values, len(clump))[clump]

    evidence = Evidence(*(values[members] for values in suspects.evidence))
    size, mass = total(np.ones(len(clump))), total(weight)
    change, past = (total(weight * of_each) / mass for of_each in (change[members], evidence.past))
    goes = size >= FEWEST
    for seen_by, past_by in zip(*suspects.by_part[:, :, members], strict=True):
        seen = total(weight * seen_by)
        goes &= (seen <= 0.5 * mass) | (total(weight * past_by) >= AGREED * seen)
    goes &= change * (1.0 + past) ** POWER >= CLUMP_NEEDED * NEEDED
    stops, passes = total(evidence.near), total(evidence.behind)
    goes &= stops < CLUMP_SUPPORT * (stops + passes)
    return np.bincount(members[goes], minlength=len(place)) > 0
