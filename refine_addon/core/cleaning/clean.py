"""Which splats float: they stand where the cameras see that nothing is.

1. Suspects are found: splats that have little support by others (`support.own_support`), small
   clusters that touch nothing else, giants and needles (`search.Search`).
2. All suspects are taken away, and it is measured what the views see at the place of each: how much
   of the light that reaches it stops near it, and how much goes on to a surface behind. So floaters
   are no support for each other, and a surface supports all that belongs to it. What has lost its
   support by that is suspect, too, and both steps are done again.

Only the second step decides. A splat with nothing behind it, such as one of a sky, stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..execute import Progress, part, silent
from ..splats import Splats, among_all, refuse_undrawable
from ..views import ViewSet
from ..visibility import projection
from ..volumes import refuse_all
from .search import Search

Sums = TypeVar("Sums")

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
        """Return how many splats go for each reason that is switched on."""
        return {name: int(np.count_nonzero(self.by_reason[name])) for name in self.settings.reasons}

    def for_all(self, rest: NDArray[np.bool_]) -> Cleaned:
        """Return this of what was left of N splats, (N,) bool, for them all: the others go too."""
        return replace(
            self,
            keep=among_all(self.keep, rest),
            by_reason={name: among_all(mask, rest) for name, mask in self.by_reason.items()},
            past=among_all(self.past, rest),
            seen=among_all(self.seen, rest),
            sure=among_all(self.sure, rest),
        )

    def surety(self) -> dict[str, float | None]:
        """Return the mean of `sure` for each of `REASONS`; None where no view tells."""
        return {
            name: float(self.sure[mask].mean(dtype=np.float64))
            if name != "outside" and mask.any()
            else None
            for name, mask in self.by_reason.items()
        }

    def facts(self) -> dict[str, Any]:
        """Return what a report says of it."""
        surety = self.surety()
        sure = {name: surety[name] for name in self.settings.reasons}
        return {**self.counts(), "sure": sure, "words": self.in_words()}

    def in_words(self) -> str:
        """Return what goes, why, and how sure that is, such as "2,114 in front of surfaces (96 %)".

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
        """Return what else the user should know, in sentences."""
        if not self.undrawable:
            return []
        return [f"{self.undrawable} splats cannot be drawn: no view shows them, and they stay"]


def clean(
    splats: Splats,
    views: ViewSet,
    settings: Cleaning = Cleaning(),
    *,
    protected: NDArray[np.bool_] | None = None,
    forced_out: NDArray[np.bool_] | None = None,
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
    forced_out : (N,) bool, optional
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
    if forced_out is not None and forced_out.any():
        rest = ~forced_out if protected is None else ~forced_out | protected
        refuse_all(~rest)
        cleaned = clean(
            splats.take(rest), views, settings,
            protected=None if protected is None else protected[rest],
            progress=progress, threads=threads,
        )  # fmt: skip
        return cleaned.for_all(rest)
    with np.errstate(under="ignore"):
        gaussians, scene, good = projection.prepare(
            splats, views, progress=part(progress, 0.0, 0.05), threads=threads
        )
        if len(splats):
            refuse_undrawable(int(np.count_nonzero(good)), len(good))
        used = views.spread(settings.views)
        names = {id(view) for view in used}
        unused = tuple(view for view in views if id(view) not in names)
        search = Search(gaussians, scene, splats, (used, unused), threads)
        reasons = search.reasons(part(progress, 0.05, 1.0))
    may_go = np.ones(len(splats), np.bool_) if protected is None else ~protected
    by_reason = {name: search.of_all(mask) & may_go for name, mask in reasons.items()}
    keep = ~np.any([by_reason[name] for name in settings.reasons], axis=0)
    if len(splats) and not keep.any():
        raise RefineError(f"cleaning would remove all {len(splats)} splats; nothing was removed")
    return Cleaned(
        keep, by_reason, search.of_all(search.evidence.past.astype(np.int32)),
        search.of_all(search.seen.astype(np.int32)), search.of_all(search.sure.astype(np.float32)),
        int(np.count_nonzero(~good)), len(views), len(search.views), settings,
    )  # fmt: skip
