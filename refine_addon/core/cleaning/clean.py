"""Which splats float: they stand where the cameras see that nothing is.

1. Suspects are found: splats whose light has little support by others (`sight.own_support`), small
   clusters that touch nothing else, giants and needles.
2. All suspects are taken away, and the views judge each of them by what is left: how much of the
   light that reaches its place stops near it, and how much goes on to a surface behind. So floaters
   cannot vouch for each other, and a surface vouches for all that belongs to it.

Only the second step decides. A splat with nothing behind it, such as one of a sky, stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from ..errors import RefineError
from ..seeing import projection
from ..seeing.measuring import VIEW_GROUPS
from ..seeing.ray_sample import RaySample
from ..splats import among_all, refuse_undrawable
from ..volumes import refuse_all
from ..work import Progress, for_chunks, part, silent
from . import sight
from .clusters import cluster_sizes

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from ..seeing.projection import Footprints, Gaussians
    from ..seeing.scene import Scene
    from ..splats import Splats
    from ..views import ViewSet

Result = TypeVar("Result")

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
"""A splat is suspect, and may be found to be in front of surfaces, if others support less than this
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
"""What less of the light stops near than this share has no surface. Giants cross surfaces; of a
giant that is a veil, half may lie at one."""

VEIL = 0.15
"""A giant of lower opacity is a veil."""

VIEWS = 3
"""So many views must see past a splat; all of them where fewer see it."""

AGREE = 0.6
"""Share of the views that must see past it."""

LOUD, LOUD_VIEWS, LOUD_AGREE = 10 / 255, 6, 0.3
"""Of a splat that changes a pixel by as much, so many views that see past it are enough, if they
are this share: the others may see it against a surface just behind."""

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
    """What `clean` found.

    Attributes
    ----------
    keep : (N,) bool
        Which splats stay.
    found : dict of str to (N,) bool
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
    found: dict[str, NDArray[np.bool_]]
    past: NDArray[np.int32]
    seen: NDArray[np.int32]
    undrawable: int
    views_given: int
    views_used: int
    settings: Cleaning

    def counts(self) -> dict[str, int]:
        """Return how many splats go for each reason that is switched on."""
        return {name: int(np.count_nonzero(self.found[name])) for name in self.settings.reasons}

    def for_all(self, rest: NDArray[np.bool_]) -> Cleaned:
        """Return this of what was left of N splats, (N,) bool, for them all: the others go too."""
        found = {name: among_all(mask, rest) for name, mask in self.found.items()}
        keep, past, seen = (among_all(some, rest) for some in (self.keep, self.past, self.seen))
        return replace(self, keep=keep, found=found, past=past, seen=seen)

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
            words.append((int(np.count_nonzero(self.found[name] & many)), f"{text}{views}"))
            few = int(np.count_nonzero(self.found[name] & ~many))
            words.append((few, f"{text} in all of the 1 or 2 views that see them"))
        found = [f"{count:,} {text}" for count, text in words if count]
        return ", ".join(found) or "nothing to clean away"

    def notes(self) -> list[str]:
        """Return what else the user should know, in sentences."""
        if not self.undrawable:
            return []
        return [f"{self.undrawable} splats cannot be drawn: no camera judges them, and they stay"]


def clean(  # noqa: PLR0913 - as `pipeline.prune`
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
        See `refine_addon.core.work.Progress`.
    threads : int, optional

    Returns
    -------
    Cleaned

    Raises
    ------
    RefineError
        If there are splats and none of them can be drawn, if no view sees any, or if nothing would
        be left.
    Cancelled
        If `progress` answers ``False``.
    """
    if removed is not None and removed.any():
        rest = ~removed if protected is None else ~removed | protected
        refuse_all(~rest)
        found = clean(
            splats.take(rest), views, settings,
            protected=None if protected is None else protected[rest],
            progress=progress, threads=threads,
        )  # fmt: skip
        return found.for_all(rest)
    with np.errstate(under="ignore"):
        gaussians, scene, good = projection.prepare(
            splats, views, progress=part(progress, 0.0, 0.05), threads=threads
        )
        if len(splats):
            refuse_undrawable(int(np.count_nonzero(good)), len(good))
        run = _Run(gaussians, scene, splats, views.spread(settings.views), threads)
        reasons = run.reasons(part(progress, 0.05, 1.0))
    count = len(splats)
    masks = {name: np.zeros(count, np.bool_) for name in REASONS}
    keep = np.ones(count, np.bool_)
    for name, rows in reasons.items():
        masks[name][gaussians.index[rows]] = True
        if protected is not None:
            masks[name] &= ~protected
        if name in settings.reasons:
            keep &= ~masks[name]
    if count and not keep.any():
        msg = f"cleaning would remove all {count} splats; nothing was removed"
        raise RefineError(msg)
    past, seen = np.zeros((2, count), np.int32)
    past[gaussians.index], seen[gaussians.index] = run.evidence.past, run.seen
    undrawable = count - int(np.count_nonzero(good))
    return Cleaned(
        keep, masks, past, seen, undrawable, len(views), len(run.ray_sample.views), settings
    )


class _Run:
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
        self.ray_sample = RaySample(views.by_distance(), gaussians, splats)
        self.evidence = sight.Evidence.zero(len(gaussians))
        self.seen = np.zeros(len(gaussians), np.int32)
        with np.errstate(invalid="ignore"):
            scales = np.sort(splats.log_scales[gaussians.index].astype(np.float64), axis=1)
        self.slender = scales[:, 2] - scales[:, 1] >= np.log(SLENDER)

    def reasons(self, progress: Progress) -> dict[str, NDArray[np.bool_]]:
        """Return for each reason which Gaussians it is true of, (M,) each; one each at most."""
        support, widest = self._support(part(progress, 0.0, 0.5))
        giant = (self.gaussians.largest >= HUGE) & (widest >= GIANT)
        needle = self.slender & (widest >= LONG) & ~giant
        doubted = support < DOUBTED
        small = self._clusters(~doubted & ~giant, part(progress, 0.5, 0.6))
        self._judge(doubted | giant | needle | small, part(progress, 0.6, 1.0))
        effect = self._effect()
        floats = ~giant & self._floats(SUPPORT) & agreed(self.evidence, effect)
        most = np.where(self.gaussians.alphas < VEIL, VEIL_SUPPORT, GIANT_SUPPORT)
        shows = effect >= VISIBLE * (WIDE / np.maximum(widest, WIDE))
        visible = floats & shows
        return {
            "front": visible & doubted & ~needle,
            "isolated": visible & small & ~needle,
            "giant": giant & self._floats(most) & shows,
            "needle": visible & needle,
            "transparent": floats & doubted & ~visible,
        }

    def _support(self, progress: Progress) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the support of each Gaussian by the others, and its widest footprint, (M,) each.

        The latter is the longer standard deviation as a share of a picture's longer side. What no
        view sees is fully supported.
        """
        count = len(self.gaussians)
        none = np.zeros(count, np.bool_)

        def block(numbers: range) -> tuple[NDArray[np.float64], ...]:
            light, supported, widest, inside = np.zeros((4, count))
            for number in numbers:
                footprints, looked = self._look(number, none)
                inside[footprints.index[footprints.inside]] += 1.0
                if looked is not None:
                    hits, wide = looked
                    taken, held = sight.own_support(hits)
                    light[hits.hit] += taken
                    supported[hits.hit] += held
                    widest[hits.hit] = np.maximum(widest[hits.hit], wide)
            return light, supported, widest, inside

        blocks = self._blocks(block, progress, "looking")
        lights, supports, widths, insides = (
            np.array(arrays) for arrays in zip(*blocks, strict=True)
        )
        self.seen = insides.sum(axis=0).astype(np.int32)
        light = lights.sum(axis=0)
        lit = light > 0.0
        if len(self.ray_sample.splats) and not lit.any():
            msg = (
                f"no camera sees the splats: none of {count} that show is hit by a ray of "
                f"any of {len(self.ray_sample.views)} views; check that cameras and splats share "
                "their frame and unit"
            )
            raise RefineError(msg)
        support = supports.sum(axis=0) / np.where(lit, light, 1.0)
        return np.where(lit, support, 1.0), widths.max(axis=0)

    def _clusters(self, solid: NDArray[np.bool_], progress: Progress) -> NDArray[np.bool_]:
        """Return which Gaussians are of a small cluster, (M,), of those that are solid."""
        rows = np.flatnonzero(solid & (self.gaussians.alphas >= SOLID))
        small = np.zeros(len(solid), np.bool_)
        sizes = cluster_sizes(self.gaussians.take(rows), progress=progress, threads=self.threads)
        small[rows] = sizes < SMALL
        return small

    def _judge(self, suspects: NDArray[np.bool_], progress: Progress) -> None:
        """Let all views see what is left without the suspects, (M,)."""

        def block(numbers: range) -> sight.Evidence:
            total = sight.Evidence.zero(len(suspects))
            for number in numbers:
                _, looked = self._look(number, suspects)
                if looked is not None:
                    total.add(looked[0], suspects, self.gaussians.colors)
            return total

        for found in self._blocks(block, progress, "judging"):
            self.evidence.merge(found)

    def _look(
        self, number: int, absent: NDArray[np.bool_]
    ) -> tuple[Footprints, tuple[sight.Hits, NDArray[np.float32]] | None]:
        """Return the footprints of all Gaussians in a view, and `sight.look`."""
        view = self.ray_sample.views[number][0]
        footprints = projection.project(self.gaussians, self.scene, view)
        looked = sight.look(self.gaussians, footprints, self.scene, self.ray_sample, number, absent)
        return footprints, looked

    def _blocks(
        self, work: Callable[[range], Result], progress: Progress, what: str
    ) -> list[Result]:
        """Return what `work` makes of the numbers of the views in each of some blocks."""
        count = min(VIEW_GROUPS, len(self.ray_sample.views))
        return for_chunks(
            lambda piece: work(range(piece.start, len(self.ray_sample.views), count)),
            count, 1, progress=progress, what=what, threads=self.threads,
        )  # fmt: skip

    def _floats(self, most: float | NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return which suspects have a surface behind them and less than `most` support, (M,)."""
        seen = self.evidence
        return (seen.views > 0) & (seen.near < most * (seen.near + seen.behind))

    def _effect(self) -> NDArray[np.float64]:
        """Return by how much each suspect changes a pixel that it covers, (M,)."""
        behind = self.evidence.behind
        contrast = self.evidence.contrast / np.where(behind > 0.0, behind, 1.0)
        return np.asarray(self.gaussians.alphas * contrast, np.float64)


def agreed(seen: sight.Evidence, effect: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which suspects, of some effects on a pixel, enough views see past, (M,)."""
    most = (seen.past >= np.minimum(VIEWS, seen.views)) & (seen.past >= AGREE * seen.views)
    some = (seen.past >= LOUD_VIEWS) & (seen.past >= LOUD_AGREE * seen.views)
    return most | (some & (effect >= LOUD))
