"""The search for suspects, round by round, and the evidence: what views see in their places.

A round takes all suspects away and looks along rays, some of them aimed at suspects. That gives the
evidence, and the support of all other splats; those below `DOUBTED` are suspects in the next round.
One round is not enough: a veil through a scene supports everything in it, and the splats of a
cluster support each other. Rays are cast once, for all rounds.
"""

from __future__ import annotations

import math
from functools import reduce
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..execute import Progress, part, run_all, silent, stages
from ..merging.graph import nearest
from ..visibility import projection
from ..visibility.cast import aimed, cast, depth_complexity, pixels
from ..visibility.measuring import view_groups
from ..visibility.projection import Gaussians
from ..visibility.rays import in_front
from .support import FRACTION, REACHED, Evidence, Hits, evidence_of, own_support, share

RAYS = 2500
"""Rays of a view."""

MAX_HITS = 1 << 20
"""About the most hits of a view; dense scenes get fewer rays."""

TARGET = 0.2
"""Rays are aimed at suspects whose product of sigmas is less than this share of a ray's area."""

DOUBTED = 0.4
"""Support by other splats below which a splat is suspect."""

HUGE, GIANT = 0.15, 0.25
"""A giant's longest standard deviation is at least the first, in scene sizes, and the second, as a
share of a picture."""

SLENDER, LONG = 10.0, 0.05
"""A needle is at least this many times as long as wide; its longest standard deviation is at least
this share of a picture."""

ROUNDS = ((0.3, 0.8), (0.8, 0.9), (0.9, 1.0))
"""Begin and end of each round, as shares of the progress; the first casts the rays."""

FEW_NEW = 0.02
"""Rounds end when at most this share of the suspects is new."""

VIEW_PARTS = 4
"""Groups of views, each of which must see past a clump; see `clean.judge`."""

SMALL = 100
"""A cluster of fewer splats is suspect."""

SOLID = (0.1, 0.3)
"""Least opacities of the splats of a cluster, each tried: fainter splats link many clusters."""

NEIGHBOURS = 8
"""Near neighbours of a splat that are tested for touch."""

REACH = 2.0
"""Two splats touch within this many standard deviations of both, along the step between them."""

APART = 0.01
"""They also touch this close: a share of the scene's size plus the distance to its middle."""

_TURNS = (0.6180339887498949, 0.7548776662466927)  # spread multiples modulo 1 evenly
_NEAREST = 0.2  # of the depth of its centre: as near as a ray may hit a splat
_DECIDED = 0.8  # support in the first look from which a splat is not doubted in any round


class Suspects(NamedTuple):
    """Which of M Gaussians are suspect, why, and what the views see with these absent."""

    doubted: NDArray[np.bool_]  # (M,), as are giant to width: of low support in some round
    giant: NDArray[np.bool_]
    needle: NDArray[np.bool_]
    every: NDArray[np.bool_]  # all suspects: these, and those in a small cluster
    shown: NDArray[np.bool_]  # have a footprint in any view
    views: NDArray[np.float64]  # number of views that hold the centre
    width: NDArray[np.float64]  # largest of `Hits.width`
    evidence: Evidence  # of the last round
    by_part: NDArray[np.float32]  # (2, VIEW_PARTS, M), `Evidence.views` and `past` of each group

    @property
    def large(self) -> NDArray[np.bool_]:
        """Giants and needles, (M,) bool."""
        return self.giant | self.needle


class Search:
    """The search for suspects among M Gaussians, by a list of views."""

    def __init__(self, gaussians, scene, views):
        self.gaussians, self.scene, self.views = gaussians, scene, views
        self.groups = view_groups(len(views))
        self.shown = np.zeros(len(gaussians), np.bool_)
        self.huge = gaussians.largest >= HUGE
        self.hits: list[Hits | None] = [None] * len(views)

    def find(self, slender: NDArray[np.bool_], progress: Progress) -> Suspects:
        """Look in rounds until few suspects join (docs/method.md, 8); `RefineError` with no hit."""
        light, supported, views, width = self._first_look(part(progress, 0.0, ROUNDS[0][0]))
        support = share(supported, light)
        giant = self.huge & (width >= GIANT)
        needle = slender & (width >= LONG) & ~giant
        doubted = small = np.zeros(len(giant), np.bool_)
        new, open_ = support < DOUBTED, support < _DECIDED
        for number, (start, end) in enumerate(ROUNDS):
            doubted = doubted | new
            joining = part(progress, start, start + 0.02)
            small = small | small_clusters(self.gaussians, ~doubted & ~giant, joining)
            absent = doubted | giant | needle | small
            wanted = open_ & ~absent
            behind = None if number else absent | open_
            of_groups = self._look(absent, wanted, behind, part(progress, start + 0.02, end))
            light, supported, *evidence = reduce(np.add, of_groups)
            new = wanted & (share(supported, light) < DOUBTED)
            if np.count_nonzero(new) <= FEW_NEW * np.count_nonzero(absent):
                break
        by_part = np.zeros((2, VIEW_PARTS, len(giant)), np.float32)
        for number, sums in enumerate(of_groups):
            by_part[:, number % VIEW_PARTS] += sums[-2:]
        return Suspects(
            doubted, giant, needle, absent, self.shown, views, width, Evidence(*evidence), by_part
        )

    def _first_look(self, progress: Progress) -> NDArray[np.float64]:
        """Light, supported light, views and width, (4, M), with all present but giants."""

        def of_group(numbers: range) -> NDArray[np.float64]:
            *_, views, width = sums = np.zeros((4, len(self.shown)))
            for number in numbers:
                view = self.views[number]
                footprints = projection.project(self.gaussians, self.scene, view)
                index = footprints.index
                self.shown[index] = True
                views[index[footprints.inside]] += 1.0
                wide = footprints.sigmas[0] >= GIANT * max(view.width, view.height)
                absent = np.zeros(len(self.shown), np.bool_)
                absent[index] = wide & self.huge[index]
                hits = self.hits_of_view(number, footprints, absent)
                if hits is not None:
                    sums[:2, hits.hit] += own_support(hits.without(absent), ~absent)
                    width[hits.hit] = np.maximum(width[hits.hit], hits.width)
            return sums

        of_groups = run_all(of_group, self.groups, progress=progress, what="casting rays")
        total = reduce(np.add, of_groups)
        total[3] = np.max([sums[3] for sums in of_groups], axis=0)
        if len(self.shown) and not total[3].any():
            raise RefineError(
                f"no camera sees the splats: none of {len(self.shown)} that show is hit by a ray "
                f"of any of {len(self.views)} views; check that they share their frame and unit"
            )
        return total

    def _look(self, absent, wanted, behind, progress):
        """Light and supported light of those wanted, and evidence, (7, M), of each group of views.

        The first call, with `behind`, casts the rays of all rounds: aimed at absent ones, and with
        the hits that may show once all of `behind` are away.
        """

        def of_group(numbers: range) -> NDArray[np.float64]:
            sums = np.zeros((7, len(absent)))
            for number in numbers:
                if behind is not None:
                    footprints = projection.project(self.gaussians, self.scene, self.views[number])
                    self.hits[number] = self.hits_of_view(number, footprints, behind, absent)
                if (hits := self.hits[number]) is not None:
                    light = hits.without(absent)
                    sums[:2, hits.hit] += own_support(light, wanted)
                    sums[2:, hits.hit] += evidence_of(light, absent, self.gaussians.colors)
            return sums

        return run_all(of_group, self.groups, progress=progress, what="looking past suspects")

    def hits_of_view(self, number, footprints, absent, targets=None) -> Hits | None:
        """`Hits` of a view by its number, which sets its pixels; None if its rays hit nothing.

        Gaussians that are `absent`, (M,), are hit and stop no light; rays are aimed at `targets`
        that are small.
        """
        view = self.views[number]
        count = min(RAYS, MAX_HITS / max(depth_complexity(footprints, view), 1.0))
        columns, rows = pixels(view, number, count)
        aims = None
        if targets is not None:
            cell = view.width * view.height / (len(columns) * len(rows))
            aims = aimed(view, columns, rows, _targets(footprints, targets, number, TARGET * cell))
        rays = cast(footprints, columns, rows, aims)
        if not len(rays.ray):
            return None
        present = ~absent[rays.hit].take(rays.owner)  # (hits of the rays,)
        log_front = in_front(np.log1p(-rays.alpha) * present.astype(np.float64), rays.counts())
        reached = np.flatnonzero(log_front > math.log(REACHED))  # (h,)
        place = np.empty(len(self.gaussians), np.int64)
        place[footprints.index] = np.arange(len(footprints.index))
        footprints = footprints.take(place[rays.hit])  # of the u that are hit
        gaussians = self.gaussians.take(rays.hit)
        nearness = 1.0 / _depths(gaussians, footprints, self.scene, view, rays, reached)
        scale = FRACTION / float(nearness.max())
        key = rays.ray[reached] + np.maximum(FRACTION - scale * nearness, 0.0)
        order = np.argsort(key, kind="stable")
        reached = reached[order]
        width = footprints.sigmas[0] / np.float32(max(view.width, view.height))
        return Hits(rays.hit, width, rays.owner[reached], rays.alpha[reached], key[order], scale)


def _targets(footprints, targets, number, area):
    """Centres, (2, t) px, of targets below `area`, px^2, in an order that `number` shuffles."""
    small = footprints.sigmas[0] * footprints.sigmas[1] < area
    rows = np.flatnonzero(small & targets[footprints.index])
    turn = (footprints.index[rows] * _TURNS[0] + number * _TURNS[1]) % 1.0
    return footprints.centers[:, rows[np.argsort(turn)]]


def _depths(gaussians, footprints, scene, view, rays, reached):
    """Depths, scene sizes, (h,), where splats are densest on the rays that reach them.

    The centre's plus ``c' C^-1 d``, the sum of ``(c.a / s^2) (d.a / s^2)`` over axes a of length s:
    C is the covariance in the image, c that with depth, d the step from the centre.
    """
    in_camera = projection.in_camera(gaussians, scene, view)
    (x, y, z), covariances = (values.astype(np.float64) for values in in_camera)
    with_depth = (  # (u,) each: covariance of column and row with the depth
        view.fx / z * (covariances[2] - x / z * covariances[5]),
        view.fy / z * (covariances[4] - y / z * covariances[5]),
    )
    owner, ray = rays.owner[reached], rays.ray[reached]
    step = [  # (h,) each: from the splat's centre, pixels
        pixel + 0.5 - center.take(owner)
        for pixel, center in zip(rays.pixels_of(ray), footprints.centers, strict=True)
    ]
    longest = gaussians.largest.astype(np.float64)
    depth = z[owner]
    for axes, sigmas in zip((footprints.major, footprints.minor), footprints.sigmas, strict=True):
        unit = axes / sigmas.astype(np.float64) ** 2  # (2, u)
        slope = with_depth[0] * unit[0] + with_depth[1] * unit[1]  # (u,), for a step of one sigma
        slope = slope.clip(-longest, longest)  # no splat is deeper than long
        along = step[0] * unit[0][owner] + step[1] * unit[1][owner]  # (h,), in sigmas
        depth = depth + slope[owner] * along
    return np.maximum(depth, _NEAREST * z[owner])


def is_slender(log_scales: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Which splats, by log scales, (M, 3), are `SLENDER`, (M,)."""
    with np.errstate(invalid="ignore"):
        scales = np.sort(log_scales.astype(np.float64), axis=1)
    return scales[:, 2] - scales[:, 1] >= np.log(SLENDER)


def small_clusters(
    gaussians: Gaussians, solid: NDArray[np.bool_], progress: Progress
) -> NDArray[np.bool_]:
    """Which of the Gaussians `solid`, (M,), are in a small cluster, linked by touch, (M,)."""
    small = np.zeros(len(solid), np.bool_)
    for least, half in zip(SOLID, stages(progress, *[1.0] * len(SOLID)), strict=True):
        rows = np.flatnonzero(solid & (gaussians.alphas >= least))
        near, touch = touching(gaussians.take(rows), np.arange(len(rows)), half)
        one, other = np.nonzero(touch)
        labels = connected(len(rows), one, near[one, other])
        small[rows[np.bincount(labels, minlength=len(rows))[labels] < SMALL]] = True
    return small


def touching(
    gaussians: Gaussians, rows: NDArray[np.int64], progress: Progress = silent
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Near neighbours of the splats `rows`, (r,), and which of these each touches, (r, k) each."""
    points = gaussians.means.T.astype(np.float64)  # (M, 3)
    near = nearest(points, NEIGHBOURS, progress=progress)[rows].astype(np.int64)
    one, other = np.repeat(rows, near.shape[1]), near.ravel()
    step = points[other] - points[one]
    length = np.sqrt(np.einsum("ij,ij->i", step, step))
    x, y, z = (step / np.maximum(length, np.finfo(np.float64).tiny)[:, None]).T  # of length 1
    reach = np.zeros(len(one))
    for ends in (one, other):  # by their standard deviations along the step
        xx, xy, xz, yy, yz, zz = gaussians.covariances[:, ends].astype(np.float64)
        mixed = xy * x * y + xz * x * z + yz * y * z
        reach += np.sqrt(np.maximum(xx * x * x + yy * y * y + zz * z * z + 2.0 * mixed, 0.0))
    away = APART * (1.0 + np.sqrt(np.einsum("ij,ij->i", points, points)))[one]
    return near, (length <= reach * REACH + away).reshape(near.shape)


def connected(count: int, one: NDArray[np.int64], other: NDArray[np.int64]) -> NDArray[np.int64]:
    """Lowest node that is connected to each node of a graph, (count,); edges are (E,) each."""
    labels = np.arange(count)
    while True:
        low = np.minimum(labels[one], labels[other])
        before = labels.copy()
        for ends in (one, other):
            lower = low < labels[ends]
            # The root of a part that touches a lower one moves there, and its nodes follow.
            np.minimum.at(labels, before[ends[lower]], low[lower])
        while not np.array_equal(jumped := labels[labels], labels):
            labels = jumped
        if np.array_equal(labels, before):
            return labels
