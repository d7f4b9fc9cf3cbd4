"""Which splats float: they stand where the cameras see that nothing is.

1. Suspects are found: splats that have little support by others (`support.own_support`), small
   clusters that touch nothing else, giants and needles (`search.Search`).
2. All suspects are taken away, and it is measured what the views see at the place of each: how much
   of the light that reaches it stops near it, and how much goes on to a surface behind. So floaters
   are no support for each other, and a surface supports all that belongs to it. A splat that has
   lost its support by that is suspect, too, and both steps are done again.

Only the second step decides (`judge`). A splat with nothing behind it, such as one of a sky, stays.
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
from ..volumes import must_go
from .judge import FAINT, judge
from .search import Search, is_slender

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
