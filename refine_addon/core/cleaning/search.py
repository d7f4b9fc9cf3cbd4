"""Which splats float: suspects are taken away round by round, and the views judge their places.

A round asks the rays of all views, some aimed at suspects, with the suspects so far absent. It
tells two things: what the views see at the places of the suspects, which is evidence, and how much
the others support each other without them. Who has lost support joins the suspects of the next
round, since a veil that reaches through a scene stops light near everything in it, and a cluster
vouches for itself.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..execute import Progress, chunks, part, run_all
from ..splats import Splats
from ..views import View, ViewSet
from ..visibility import projection
from ..visibility.measuring import VIEW_GROUPS
from ..visibility.projection import Gaussians
from ..visibility.scene import Scene
from .clumps import VIEW_PARTS, Looks, judge
from .clusters import cluster_sizes, touching
from .support import Evidence, Support, ViewHits, hits_of_view

Sums = TypeVar("Sums")

DOUBTED = 0.4
"""A splat is suspect, and may turn out to be in front of surfaces, if others support less than this
share of its light."""

SMALL = 100
"""A cluster of fewer splats is suspect."""

SOLID = (0.1, 0.3)
"""Splats of lower opacity do not hold clusters together: by each of these, since faint ones between
a dense cluster and a bush make one of the two."""

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

CLUMP_NEEDED = 125.0
"""That is multiplied by this for a clump that is judged as one, whatever it touches."""

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
        self.seen_by, self.past_by = np.zeros((2, VIEW_PARTS, len(gaussians)), np.float32)
        self.hits: list[ViewHits | None] = [None] * len(self.views)
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
        visible, faint = self._floats(suspects)
        faint &= suspects.doubted & ~large
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
        count = len(self.gaussians)
        nobody = np.zeros(count, np.bool_)
        support = self._first_look(part(progress, 0.0, 0.3))
        self.seen, self.width = support.views, support.width
        giant = (self.gaussians.largest >= HUGE) & (self.width >= GIANT)
        needle = self.slender & (self.width >= LONG) & ~giant
        shares = support.shares()
        suspects = _Suspects(nobody, giant, needle, nobody)
        new, open_ = shares < DOUBTED, shares < _DECIDED
        for number in range(ROUNDS):
            start = (0.3, 0.8, 0.9)[number]
            doubted = suspects.doubted | new
            small = self._clusters(~doubted & ~giant, part(progress, start, start + 0.02))
            suspects = _Suspects(doubted, giant, needle, suspects.small | small)
            absent = suspects.mask
            wanted = open_ & ~absent
            if not number:
                self._aim(absent, absent | open_, part(progress, 0.32, 0.7))
            sight = self._look(absent, wanted, part(progress, start + 0.02, start + 0.1))
            self.evidence = sight.evidence
            new = wanted & (sight.support.shares() < DOUBTED)
            if np.count_nonzero(new) <= FEW_NEW * np.count_nonzero(absent):
                break
        return suspects

    def _first_look(self, progress: Progress) -> Support:
        """Let all views look with all present but giants, which are absent where they are wide."""
        count = len(self.gaussians)
        all_ = np.ones(count, np.bool_)

        def of_group(numbers: range) -> Support:
            total = Support.zero(count)
            for number in numbers:
                view = self.views[number][0]
                footprints = projection.project(self.gaussians, self.scene, view)
                self.shown[footprints.index] = True
                total.views[footprints.index[footprints.inside]] += 1.0
                wide = footprints.sigmas[0] >= GIANT * max(view.width, view.height)
                absent = np.zeros(count, np.bool_)
                absent[footprints.index] = wide & (self.gaussians.largest[footprints.index] >= HUGE)
                hits = hits_of_view(self.gaussians, footprints, self.scene, (view, number), absent)
                if hits is not None:
                    total.add(hits.without(absent), all_)
            return total

        total = Support.zero(count)
        for support in self._in_groups(of_group, progress, "casting rays"):
            total.merge(support)
        if count and not total.width.any():
            raise RefineError(
                f"no camera sees the splats: none of {count} that show is hit by a ray of "
                f"any of {len(self.views)} views; check that cameras and splats share "
                "their frame and unit"
            )
        return total

    def _aim(
        self, suspects: NDArray[np.bool_], absent: NDArray[np.bool_], progress: Progress
    ) -> None:
        """Cast the rays of all rounds, aimed at suspects, (M,).

        What lies behind Gaussians that may become suspects, `absent`, (M,), is kept, too.
        """

        def of_group(numbers: range) -> None:
            for number in numbers:
                view = self.views[number][0]
                footprints = projection.project(self.gaussians, self.scene, view)
                self.hits[number] = hits_of_view(
                    self.gaussians, footprints, self.scene, (view, number), absent, suspects
                )

        self._in_groups(of_group, progress, "aiming rays")

    def _look(
        self, absent: NDArray[np.bool_], wanted: NDArray[np.bool_], progress: Progress
    ) -> _Sight:
        """Let all views look without suspects, (M,); `wanted`, (M,), says whose support counts."""
        count = len(self.gaussians)

        def of_group(numbers: range) -> _Sight:
            total = _Sight(Support.zero(count), Evidence.zero(count))
            for number in numbers:
                cast = self.hits[number]
                if cast is not None:
                    hits = cast.without(absent)
                    total.support.add(hits, wanted)
                    total.evidence.add(hits, absent, self.gaussians.colors)
            return total

        total = _Sight(Support.zero(count), Evidence.zero(count))
        self.seen_by[:], self.past_by[:] = 0.0, 0.0
        of_groups = self._in_groups(of_group, progress, "looking past suspects")
        for number, sight in enumerate(of_groups):
            total.support.merge(sight.support)
            total.evidence.merge(sight.evidence)
            self.seen_by[number % VIEW_PARTS] += sight.evidence.views
            self.past_by[number % VIEW_PARTS] += sight.evidence.past
        return total

    def _clusters(self, solid: NDArray[np.bool_], progress: Progress) -> NDArray[np.bool_]:
        """Return which Gaussians are of a small cluster, (M,), of those that are solid."""
        small = np.zeros(len(solid), np.bool_)
        for number, least in enumerate(SOLID):
            rows = np.flatnonzero(solid & (self.gaussians.alphas >= least))
            sizes = cluster_sizes(
                self.gaussians.take(rows),
                progress=part(progress, number / len(SOLID), (number + 1) / len(SOLID)),
                threads=self.threads,
            )
            small[rows[sizes < SMALL]] = True
        return small

    def _in_groups(
        self, work: Callable[[range], Sums], progress: Progress, what: str
    ) -> list[Sums]:
        """Return what `work` makes of the numbers of the views in each of some groups."""
        count = min(VIEW_GROUPS, len(self.views))
        return run_all(
            lambda piece: work(range(piece.start, len(self.views), count)),
            chunks(count, 1), progress=progress, what=what, threads=self.threads,
        )  # fmt: skip

    def _floats(self, suspects: _Suspects) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Return which suspects float and show, and which float but do not show, (M,) each."""
        giant, large = suspects.giant, suspects.giant | suspects.needle
        seen, past, support = self.evidence.views, self.evidence.past, self.evidence.support()
        passed = np.where(large, np.maximum(past, seen * (1.0 - support)), past)
        self.sure = (passed + 1.0) / (seen + 2.0)
        most = np.where(large | suspects.doubted, SUPPORT, ISOLATED_SUPPORT)
        may = suspects.mask & (support < most) & (large | (past >= AGREE * seen))
        may &= (past >= FEW) | (giant & (passed >= FEW))
        rows = np.flatnonzero(suspects.mask)
        near, touch = touching(self.gaussians, rows, threads=self.threads)
        in_clumps = self._clumps(np.flatnonzero(~large[rows]), rows, near, touch)
        near, touch, rows = near[may[rows]], touch[may[rows]], rows[may[rows]]
        needed = self._needed(suspects, passed, support)[rows]
        change = self._change(giant)[rows]
        hazy = self.gaussians.alphas < FAINT
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
        return shows, unheld(np.maximum(change, VISIBLE), needed) & ~shows

    def _clumps(
        self,
        chosen: NDArray[np.int64],
        rows: NDArray[np.int64],
        near: NDArray[np.int64],
        touch: NDArray[np.bool_],
    ) -> NDArray[np.bool_]:
        """Return which Gaussians go as the clump that they are in, (M,).

        `rows`, (s,), are the suspects, `chosen` the places among them of those that are not large,
        and `near` and `touch`, (s, k), say which splats each touches.
        """
        count = len(self.gaussians)
        chosen = chosen[self.gaussians.alphas[rows[chosen]] >= SOLID[-1]]
        members = rows[chosen]
        place = np.full(count, -1)
        place[members] = np.arange(len(members))
        one, other = np.nonzero(touch[chosen] & (place[near[chosen]] >= 0))
        evidence, change = self.evidence, np.minimum(self._effect()[members], GLARING)
        looks = Looks(
            evidence.near[members], evidence.behind[members], evidence.past[members], change,
            self.seen_by[:, members], self.past_by[:, members],
        )  # fmt: skip
        pairs = one, place[near[chosen[one], other]]
        needed = CLUMP_NEEDED * NEEDED, POWER
        goes = np.zeros(count, np.bool_)
        goes[members] = judge(looks, self.gaussians.alphas[members], pairs, needed)
        return goes

    def _needed(
        self, suspects: _Suspects, passed: NDArray[np.float64], support: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return how much evidence is needed against each suspect that touches nothing, (M,).

        `passed`, (M,), are the views that see past each, `support`, (M,), the share of the light
        that stops near it.
        """
        giant = GIANT_NEEDED * AT_SURFACE**support
        kind = np.select([suspects.giant, suspects.needle], [giant, NEEDLE_NEEDED], 1.0)
        return np.asarray(NEEDED * kind / (1.0 + passed) ** POWER)

    def _effect(self) -> NDArray[np.float64]:
        """Return by how much each suspect changes a pixel that it covers, (M,)."""
        behind = self.evidence.behind
        contrast = self.evidence.contrast / np.where(behind > 0.0, behind, 1.0)
        return np.asarray(self.gaussians.alphas * contrast, np.float64)

    def _change(self, giant: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Return how much that counts as evidence, (M,), where `giant`, (M,), are."""
        wide = np.where(giant, np.maximum(self.width, WIDE) / WIDE, 1.0)
        return np.asarray(np.minimum(self._effect(), GLARING) * wide)

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
