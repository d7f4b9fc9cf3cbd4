"""Which splats float: suspects are taken away round by round, and the views judge their places.

A round casts the rays of all views with the suspects so far absent. It tells two things: what the
views see at the places of the suspects, which is evidence, and how much the others support each
other without them. Who has lost support joins the suspects of the next round, since a veil that
reaches through a scene stops light near everything in it, and a cluster vouches for itself.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np

from ..errors import RefineError
from ..seeing import projection
from ..seeing.measuring import VIEW_GROUPS
from ..work import Progress, for_chunks, part
from .clusters import cluster_sizes, touching
from .support import Evidence, Support, hits_of_view

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from ..seeing.projection import Footprints, Gaussians
    from ..seeing.scene import Scene
    from ..splats import Splats
    from ..views import View, ViewSet
    from .support import Hits

Sums = TypeVar("Sums")

DOUBTED = 0.4
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

ROUNDS = 3
"""In how many rounds at most suspects are absent."""

FEW_NEW = 0.02
"""Rounds end where this share of the suspects, or less, joins them."""

SUPPORT, LARGE_SUPPORT = 0.2, 0.3
"""A suspect floats if less than this share of the light stops near it; giants and needles cross
surfaces, so they may have more near them."""

LOUD_SUPPORT, CROSSING_SUPPORT, MANY = 0.35, 0.6, 16.0
"""What changes a pixel by `LOUD`, and what is a giant or a needle, may have this much near it if
at least so many views are clear about it."""

FAINT = 0.15
"""Haze is of lower opacity."""

FEW = 2.0
"""What fewer views see past stays: no view could be left out, and the others still tell."""

CLEAR, HELD = 1.6, 1.3
"""So many views have to be clear about a splat, times the second for each neighbour that touches it
and stays, at most half of all views: what hangs together with content needs more evidence."""

LARGE_CLEAR = (8.0, 1.1)
"""The same of giants and needles, which lie in more pictures and touch more."""

AGREE = 0.6
"""At least this share of the views that see it must see past it."""

LOUD, LOUD_VIEWS, LOUD_AGREE = 10 / 255, 6, 0.3
"""Where a splat changes a pixel by at least this much, so many views that see past it are enough,
if they are this share of all: the others may see it against a surface just behind."""

NEEDLE_VIEWS = 4
"""So many views must see past a needle that has more near it than `LARGE_SUPPORT`."""

VISIBLE, WIDE = 4 / 255, 0.05
"""By how much a splat must change a pixel, as its opacity times its contrast to what lies behind.
One whose standard deviation reaches across more than this share of a picture's longer side changes
more pixels, and must change each by so much less: the root mean square of the picture's change is
the same. Half is enough of what `MANY` views see past."""

NEAR = 0.3
"""Haze is at most so far from a camera, scene sizes."""

_DECIDED = 0.8  # others whose light is supported by this share in the first round are not doubted


class _Suspects(NamedTuple):
    """Which Gaussians are suspect, and why: (M,) bool each."""

    doubted: NDArray[np.bool_]
    giant: NDArray[np.bool_]
    needle: NDArray[np.bool_]
    small: NDArray[np.bool_]

    @property
    def mask(self) -> NDArray[np.bool_]:
        """Which are suspect for one of these, (M,)."""
        return self.doubted | self.giant | self.needle | self.small


class _Sight(NamedTuple):
    """What one look of all views tells."""

    support: Support
    evidence: Evidence


class Search:
    """The work of one `clean`.

    Parameters
    ----------
    gaussians : Gaussians
        The M of N splats that show.
    scene : Scene
    splats : Splats
    views : ViewSet, tuple of View
        Those that decide, and those that are only asked whether a splat is in their picture.
    threads : int, optional

    Attributes
    ----------
    seen : (M,) float64
        In how many views the centre lies.
    evidence : Evidence
        Of the last round.
    sure : (M,) float64
        The share of views that were left out which are expected to see past each suspect.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        scene: Scene,
        splats: Splats,
        views: tuple[ViewSet, tuple[View, ...]],
        threads: int | None,
    ) -> None:
        self.gaussians, self.scene, self.threads = gaussians, scene, threads
        self.views, self.unused, self.count = views[0].by_distance(), views[1], len(splats)
        self.seen, self.width, self.sure = np.zeros((3, len(gaussians)))
        self.shown = np.zeros(len(gaussians), np.bool_)
        self.evidence = Evidence.zero(len(gaussians))
        with np.errstate(invalid="ignore"):
            scales = np.sort(splats.log_scales[gaussians.index].astype(np.float64), axis=1)
        self.slender = scales[:, 2] - scales[:, 1] >= np.log(SLENDER)

    def of_all(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return values of the M Gaussians, (M,), for all N splats, (N,); 0 for the others."""
        whole = np.zeros(self.count, values.dtype)
        whole[self.gaussians.index] = values
        return whole

    def reasons(self, progress: Progress) -> dict[str, NDArray[np.bool_]]:
        """Return for each reason which Gaussians it is true of, (M,) each; one each at most.

        Raises
        ------
        RefineError
            If no view sees any.
        """
        suspects = self._suspects(progress)
        large = suspects.giant | suspects.needle
        effect = self._effect()
        least = np.where(self.evidence.past >= MANY, VISIBLE / 2.0, VISIBLE)
        shows = effect >= least * (WIDE / np.maximum(self.width, WIDE))
        floats = self._floats(suspects, effect, shows)
        visible, faint = floats & shows, floats & ~shows & suspects.doubted & ~large
        haze = faint & (self.gaussians.alphas < FAINT) & self._near_cameras(faint)
        return {
            "front": visible & suspects.doubted & ~large,
            "isolated": visible & ~suspects.doubted & ~large,
            "giant": visible & suspects.giant,
            "needle": visible & suspects.needle,
            "transparent": faint & ~haze,
            "haze": haze,
            "outside": self._outside(),
        }

    def _suspects(self, progress: Progress) -> _Suspects:
        """Let the views look until few suspects join."""
        nobody = np.zeros(len(self.gaussians), np.bool_)
        support = self._look(nobody, ~nobody, part(progress, 0.0, 0.25), first=True).support
        self.seen, self.width = support.views, support.width
        giant = (self.gaussians.largest >= HUGE) & (self.width >= GIANT)
        needle = self.slender & (self.width >= LONG) & ~giant
        shares = support.shares()
        suspects = _Suspects(nobody, giant, needle, nobody)
        new, open_ = shares < DOUBTED, shares < _DECIDED
        for number in range(ROUNDS):
            start = 0.25 * (number + 1)
            doubted = suspects.doubted | new
            small = self._clusters(~doubted & ~giant, part(progress, start, start + 0.02))
            suspects = _Suspects(doubted, giant, needle, suspects.small | small)
            absent = suspects.mask
            wanted = open_ & ~absent
            sight = self._look(absent, wanted, part(progress, start + 0.02, start + 0.25))
            self.evidence = sight.evidence
            new = wanted & (sight.support.shares() < DOUBTED)
            if np.count_nonzero(new) <= FEW_NEW * np.count_nonzero(absent):
                break
        return suspects

    def _look(
        self,
        absent: NDArray[np.bool_],
        wanted: NDArray[np.bool_],
        progress: Progress,
        *,
        first: bool = False,
    ) -> _Sight:
        """Let all views look without suspects, (M,); `wanted`, (M,), says whose support counts.

        In the first look the giants are absent where they are wide, and there are no suspects.
        """
        count = len(self.gaussians)

        def of_group(numbers: range) -> _Sight:
            total = _Sight(Support.zero(count), Evidence.zero(count))
            for number in numbers:
                footprints, hits = self._seen(number, absent, first=first)
                total.support.add(footprints, hits, wanted)
                if first:
                    self.shown[footprints.index] = True
                elif hits is not None:
                    total.evidence.add(hits, absent, self.gaussians.colors)
            return total

        total = _Sight(Support.zero(count), Evidence.zero(count))
        for sight in self._in_groups(of_group, progress, "casting rays"):
            total.support.merge(sight.support)
            total.evidence.merge(sight.evidence)
        if first and self.count and not total.support.width.any():
            msg = (
                f"no camera sees the splats: none of {count} that show is hit by a ray of "
                f"any of {len(self.views)} views; check that cameras and splats share "
                "their frame and unit"
            )
            raise RefineError(msg)
        return total

    def _seen(
        self, number: int, absent: NDArray[np.bool_], *, first: bool
    ) -> tuple[Footprints, Hits | None]:
        """Return the footprints of all Gaussians in a view, and what its rays hit."""
        view = self.views[number][0]
        footprints = projection.project(self.gaussians, self.scene, view)
        if first:
            wide = footprints.sigmas[0] >= GIANT * max(view.width, view.height)
            absent = absent.copy()
            absent[footprints.index] = wide & (self.gaussians.largest[footprints.index] >= HUGE)
        return footprints, hits_of_view(
            self.gaussians, footprints, self.scene, view, number, absent
        )

    def _clusters(self, solid: NDArray[np.bool_], progress: Progress) -> NDArray[np.bool_]:
        """Return which Gaussians are of a small cluster, (M,), of those that are solid."""
        rows = np.flatnonzero(solid & (self.gaussians.alphas >= SOLID))
        small = np.zeros(len(solid), np.bool_)
        sizes = cluster_sizes(self.gaussians.take(rows), progress=progress, threads=self.threads)
        small[rows] = sizes < SMALL
        return small

    def _in_groups(
        self, work: Callable[[range], Sums], progress: Progress, what: str
    ) -> list[Sums]:
        """Return what `work` makes of the numbers of the views in each of some groups."""
        count = min(VIEW_GROUPS, len(self.views))
        return for_chunks(
            lambda piece: work(range(piece.start, len(self.views), count)),
            count, 1, progress=progress, what=what, threads=self.threads,
        )  # fmt: skip

    def _floats(
        self, suspects: _Suspects, effect: NDArray[np.float64], shows: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Return which suspects float, (M,), given by how much each changes a pixel, (M,)."""
        seen, past = self.evidence.views, self.evidence.past
        large = suspects.giant | suspects.needle
        support = self.evidence.support()
        passed = np.where(large, seen * (1.0 - support), past)
        self.sure = (passed + 1.0) / (seen + 2.0)
        clear = np.where(large, passed, past * past / np.maximum(np.maximum(self.seen, past), 1.0))
        floats = large | agreed(self.evidence, effect)
        floats &= (past >= FEW) | (suspects.giant & (passed >= FEW))
        most = np.where(large, LARGE_SUPPORT, SUPPORT)
        crossing = np.where(large, CROSSING_SUPPORT, np.where(effect >= LOUD, LOUD_SUPPORT, 0.0))
        crossing[suspects.needle & (past < NEEDLE_VIEWS)] = 0.0
        floats &= (support < most) | ((clear >= MANY) & (support < crossing))
        rows = np.flatnonzero(floats)
        stays = ~(floats & shows)
        held = touching(self.gaussians, rows, stays, threads=self.threads)
        few, more = LARGE_CLEAR
        needed = np.where(large[rows], few * more**held, CLEAR * HELD**held)
        floats[rows] = clear[rows] >= np.minimum(needed, len(self.views) / 2.0)
        return floats

    def _effect(self) -> NDArray[np.float64]:
        """Return by how much each suspect changes a pixel that it covers, (M,)."""
        behind = self.evidence.behind
        contrast = self.evidence.contrast / np.where(behind > 0.0, behind, 1.0)
        return np.asarray(self.gaussians.alphas * contrast, np.float64)

    def _near_cameras(self, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return which of some Gaussians, (M,) bool, are near a camera, (M,)."""
        means = self.gaussians.means[:, chosen].T.astype(np.float64)  # (n, 3)
        near = np.zeros(len(means), np.bool_)
        for view, _ in self.views:
            step = means - self.scene.positions(view.center[None])
            near |= np.einsum("ij,ij->i", step, step) < NEAR * NEAR
        result = np.zeros(len(chosen), np.bool_)
        result[chosen] = near
        return result

    def _outside(self) -> NDArray[np.bool_]:
        """Return which Gaussians reach into the picture of no view, used or not, (M,)."""
        rows = np.flatnonzero(~self.shown)
        for view in self.unused:
            if len(rows):
                left = np.ones(len(rows), np.bool_)
                left[projection.project(self.gaussians.take(rows), self.scene, view).index] = False
                rows = rows[left]
        result = np.zeros(len(self.gaussians), np.bool_)
        result[rows] = True
        return result


def agreed(evidence: Evidence, effect: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return past which suspects enough views see, given by how much each changes a pixel, (M,)."""
    views, past = evidence.views, evidence.past
    fewer = (past >= LOUD_VIEWS) & (past >= LOUD_AGREE * views)
    return (past >= AGREE * views) | (fewer & (effect >= LOUD))
