"""Which splats float: they stand where the cameras see that nothing is.

1. Suspects are found: splats that have little support by others (`support.own_support`), small
   clusters that touch nothing else, giants and needles.
2. All suspects are taken away, and it is measured what the views see at the place of each: how much
   of the light that reaches it stops near it, and how much goes on to a surface behind. So floaters
   are no support for each other, and a surface supports all that belongs to it.

Only the second step decides. A splat with nothing behind it, such as one of a sky, stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ..errors import RefineError
from ..seeing import projection
from ..seeing.measuring import VIEW_GROUPS
from ..splats import among_all, refuse_undrawable
from ..volumes import refuse_all
from ..work import Progress, for_chunks, part, silent
from .clusters import cluster_sizes
from .support import Evidence, Support, hits_of_view

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from ..seeing.projection import Footprints, Gaussians
    from ..seeing.scene import Scene
    from ..splats import Splats
    from ..views import ViewSet
    from .support import Hits

Sums = TypeVar("Sums")

REASONS = {
    "front": "in front of surfaces",
    "isolated": "isolated",
    "giant": "giant",
    "needle": "needle-like",
    "transparent": "nearly transparent",
}
"""Why a splat may go, and how that is said after a number."""

DEFAULT_REASONS = ("front", "isolated", "giant", "needle")
"""All but the nearly transparent, which no picture shows."""

DOUBTED = 0.3
"""A splat is suspect, and may turn out to be in front of surfaces, if others support less than this
share of its light."""

SMALL = 100
"""A cluster of fewer splats is suspect."""

SOLID = 0.1
"""Splats of lower opacity do not hold clusters together."""

HUGE, GIANT = 0.15, 0.25
"""A giant is longer than this many scene sizes, and its standard deviation reaches across this
share of a picture's longer side."""

SLENDER, LONG = 10.0, 0.05
"""A needle is this many times as long as wide, and its standard deviation reaches across this share
of a picture's longer side."""

SUPPORT, GIANT_SUPPORT, VEIL_SUPPORT = 0.2, 0.3, 0.5
"""A suspect floats if less than this share of the light stops near it. Giants cross surfaces, so
they may have more near them, and giants that are veils up to a half."""

VEIL = 0.15
"""A giant of lower opacity is a veil."""

VIEWS = 3
"""At least so many views must see past a splat; all of them where fewer see it."""

AGREE = 0.6
"""At least this share of the views that see it must see past it."""

LOUD, LOUD_VIEWS, LOUD_AGREE = 10 / 255, 6, 0.3
"""Where a splat changes a pixel by at least this much, so many views that see past it are enough,
if they are this share of all: the others may see it against a surface just behind."""

VISIBLE, WIDE = 4 / 255, 0.05
"""By how much a splat must change a pixel, as its opacity times its contrast to what lies behind.
One whose standard deviation reaches across more than this share of a picture's longer side changes
more pixels, and must change each by so much less: the root mean square of the picture's change is
the same."""


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
        """Check the values.

        Raises
        ------
        RefineError
            If there is no such reason, or the number of views is negative.
        """
        object.__setattr__(self, "reasons", tuple(self.reasons))
        unknown = [reason for reason in self.reasons if reason not in REASONS]
        if unknown or not self.reasons:
            got = repr(unknown[0]) if unknown else "none"
            msg = f"reason is {got}, expected some of {', '.join(REASONS)}"
            raise RefineError(msg)
        if self.views < 0:
            msg = f"views is {self.views}, expected 0 (all) or more"
            raise RefineError(msg)


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
        )

    def facts(self) -> dict[str, Any]:
        """Return what a report says of it."""
        return {**self.counts(), "words": self.in_words()}

    def in_words(self) -> str:
        """Return what goes and why, such as "2,114 in front of surfaces in 3+ views, 301 isolated".

        Those that only one or two views see, all of them past it, are counted by themselves.
        """
        words = []
        for name, text in REASONS.items():
            if name not in self.settings.reasons:
                continue
            many = self.past >= VIEWS if name == "front" else np.ones(len(self.keep), np.bool_)
            views = f" in {VIEWS}+ views" if name == "front" else ""
            words.append((int(np.count_nonzero(self.by_reason[name] & many)), f"{text}{views}"))
            few = int(np.count_nonzero(self.by_reason[name] & ~many))
            words.append((few, f"{text} in all of the 1 or 2 views that see them"))
        counted = [f"{count:,} {text}" for count, text in words if count]
        return ", ".join(counted) or "nothing to clean away"

    def notes(self) -> list[str]:
        """Return what else the user should know, in sentences."""
        if not self.undrawable:
            return []
        return [f"{self.undrawable} splats cannot be drawn: no view shows them, and they stay"]


def clean(  # noqa: PLR0913 - as `pipeline.prune`
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
        See `refine_addon.core.work.Progress`.
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
        search = _Search(gaussians, scene, splats, views.spread(settings.views), threads)
        reasons = search.reasons(part(progress, 0.05, 1.0))
    may_go = np.ones(len(splats), np.bool_) if protected is None else ~protected
    by_reason = {name: search.of_all(mask) & may_go for name, mask in reasons.items()}
    keep = ~np.any([by_reason[name] for name in settings.reasons], axis=0)
    if len(splats) and not keep.any():
        msg = f"cleaning would remove all {len(splats)} splats; nothing was removed"
        raise RefineError(msg)
    return Cleaned(
        keep, by_reason, search.of_all(search.evidence.past.astype(np.int32)),
        search.of_all(search.support.views.astype(np.int32)), int(np.count_nonzero(~good)),
        len(views), len(search.views), settings,
    )  # fmt: skip


class _Search:
    """The work of one `clean`, on M Gaussians."""

    def __init__(
        self,
        gaussians: Gaussians,
        scene: Scene,
        splats: Splats,
        views: ViewSet,
        threads: int | None,
    ) -> None:
        self.gaussians, self.scene, self.threads = gaussians, scene, threads
        self.views, self.count = views.by_distance(), len(splats)
        self.support, self.evidence = Support.zero(len(gaussians)), Evidence.zero(len(gaussians))
        with np.errstate(invalid="ignore"):
            scales = np.sort(splats.log_scales[gaussians.index].astype(np.float64), axis=1)
        self.slender = scales[:, 2] - scales[:, 1] >= np.log(SLENDER)

    def of_all(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return values of the M Gaussians, (M,), for all N splats, (N,); 0 for the others."""
        whole = np.zeros(self.count, values.dtype)
        whole[self.gaussians.index] = values
        return whole

    def reasons(self, progress: Progress) -> dict[str, NDArray[np.bool_]]:
        """Return for each reason which Gaussians it is true of, (M,) each; one each at most."""
        self._measure_support(part(progress, 0.0, 0.5))
        doubted, width = self.support.shares() < DOUBTED, self.support.width
        giant = (self.gaussians.largest >= HUGE) & (width >= GIANT)
        needle = self.slender & (width >= LONG) & ~giant
        small = self._clusters(~doubted & ~giant, part(progress, 0.5, 0.6))
        self._find_evidence(doubted | giant | needle | small, part(progress, 0.6, 1.0))
        effect = self._effect()
        floats = ~giant & self._floats(SUPPORT) & agreed(self.evidence, effect)
        most = np.where(self.gaussians.alphas < VEIL, VEIL_SUPPORT, GIANT_SUPPORT)
        shows = effect >= VISIBLE * (WIDE / np.maximum(width, WIDE))
        visible = floats & shows
        return {
            "front": visible & doubted & ~needle,
            "isolated": visible & small & ~needle,
            "giant": giant & self._floats(most) & shows,
            "needle": visible & needle,
            "transparent": floats & doubted & ~visible,
        }

    def _measure_support(self, progress: Progress) -> None:
        """Let all views see all Gaussians."""
        count = len(self.gaussians)
        nobody = np.zeros(count, np.bool_)

        def of_group(numbers: range) -> Support:
            total = Support.zero(count)
            for number in numbers:
                total.add(*self._seen(number, nobody))
            return total

        for support in self._in_groups(of_group, progress, "casting rays"):
            self.support.merge(support)
        if self.count and not self.support.weight.any():
            msg = (
                f"no camera sees the splats: none of {count} that show is hit by a ray of "
                f"any of {len(self.views)} views; check that cameras and splats share "
                "their frame and unit"
            )
            raise RefineError(msg)

    def _clusters(self, solid: NDArray[np.bool_], progress: Progress) -> NDArray[np.bool_]:
        """Return which Gaussians are of a small cluster, (M,), of those that are solid."""
        rows = np.flatnonzero(solid & (self.gaussians.alphas >= SOLID))
        small = np.zeros(len(solid), np.bool_)
        sizes = cluster_sizes(self.gaussians.take(rows), progress=progress, threads=self.threads)
        small[rows] = sizes < SMALL
        return small

    def _find_evidence(self, suspects: NDArray[np.bool_], progress: Progress) -> None:
        """Let all views see what is left without the suspects, (M,)."""

        def of_group(numbers: range) -> Evidence:
            total = Evidence.zero(len(suspects))
            for number in numbers:
                _, hits = self._seen(number, suspects)
                if hits is not None:
                    total.add(hits, suspects, self.gaussians.colors)
            return total

        for evidence in self._in_groups(of_group, progress, "casting rays"):
            self.evidence.merge(evidence)

    def _seen(self, number: int, absent: NDArray[np.bool_]) -> tuple[Footprints, Hits | None]:
        """Return the footprints of all Gaussians in a view, and what its rays hit."""
        view = self.views[number][0]
        footprints = projection.project(self.gaussians, self.scene, view)
        return footprints, hits_of_view(
            self.gaussians, footprints, self.scene, view, number, absent
        )

    def _in_groups(
        self, work: Callable[[range], Sums], progress: Progress, what: str
    ) -> list[Sums]:
        """Return what `work` makes of the numbers of the views in each of some groups."""
        count = min(VIEW_GROUPS, len(self.views))
        return for_chunks(
            lambda piece: work(range(piece.start, len(self.views), count)),
            count, 1, progress=progress, what=what, threads=self.threads,
        )  # fmt: skip

    def _floats(self, most: float | NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which suspects have a surface behind them and less than `most` support, (M,)."""
        views, near, behind = self.evidence.views, self.evidence.near, self.evidence.behind
        return (views > 0) & (near < most * (near + behind))

    def _effect(self) -> NDArray[np.float64]:
        """Return by how much each suspect changes a pixel that it covers, (M,)."""
        behind = self.evidence.behind
        contrast = self.evidence.contrast / np.where(behind > 0.0, behind, 1.0)
        return np.asarray(self.gaussians.alphas * contrast, np.float64)


def agreed(evidence: Evidence, effect: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return past which suspects enough views see, given by how much each changes a pixel, (M,)."""
    views, past = evidence.views, evidence.past
    most = (past >= np.minimum(VIEWS, views)) & (past >= AGREE * views)
    fewer = (past >= LOUD_VIEWS) & (past >= LOUD_AGREE * views)
    return most | (fewer & (effect >= LOUD))
