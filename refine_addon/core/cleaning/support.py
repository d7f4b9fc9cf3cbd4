"""How much of what the rays see stops near a splat, and how much goes on to what lies behind.

A ray hits splats front to back, and each takes a share of the light that reaches it. Of the light
that reaches a place, a share stops near that place, and the rest goes on. At a surface nearly all
of it stops; at a floater most goes on::

    support = light that stops near the place / light that stops there or behind

A splat is hit where its density is highest along the ray, not at the depth of its centre, so that a
large wall that is seen obliquely is a surface along all of it. Two hits are near each other if
their nearness (1 / depth, in scene sizes) differs by less than `WINDOW` of it, or by `PARALLAX`:
beyond, cameras a scene size apart see one move against the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ..views import View
from ..visibility import projection
from ..visibility.cast import aimed, cast, depth_complexity, pixels
from ..visibility.projection import Footprints, Gaussians
from ..visibility.rays import Rays, in_front
from ..visibility.scene import Scene

RAYS = 2500
"""Rays of a view."""

MAX_HITS = 1 << 20
"""About how many hits the rays of a view may have; there are fewer rays in dense scenes."""

WINDOW = 0.1
"""Hits on a ray are near each other if their nearness differs by less than this share of it."""

PARALLAX = 0.05
"""They are as well if it differs by less than this, per scene size."""

TARGET = 0.2
"""Rays are aimed at suspects whose standard deviations, multiplied, are less than this share of the
area that a ray stands for."""

REACHED = 1e-3
"""Hits that less of the light reaches tell nothing."""

NOTHING = 0.02
"""Where less of the light stops behind a place, there is nothing behind it."""

SEEN = 0.1
"""A view sees what lies at and behind a splat if this share of the light stops there."""

PAST = 0.15
"""A view sees past a splat if a lower share of the light stops near it."""

_TURNS = (0.6180339887498949, 0.7548776662466927)  # spread multiples modulo 1 evenly
_NEAREST = 0.2  # of the depth of its centre: as near as a ray may hit a splat
_FRACTION = 0.999  # how much of the numbers from one ray to the next the places on a ray take
_TINY = 1e-30  # replaces 0 as a divisor


class Around(NamedTuple):
    """What lies around r hits on their rays, as places among all hits.

    Those from `first` up to `last` are near them, those from `last` up to `end` lie behind.
    """

    first: NDArray[np.int64]
    last: NDArray[np.int64]
    end: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Hits:
    """The h hits of the rays of one view on u Gaussians: ray by ray, near to far.

    Attributes
    ----------
    hit : (u,) int64
        The Gaussians that any ray hits.
    width : (u,) float32
        The longer standard deviation of their footprints, as a share of the image's longer side.
    owner : (h,) int32
        Which of them each hit is on.
    alpha, transmittance, weight : (h,) float64
        Alpha there, the share of the light that reaches it, and the share that it takes: their
        product, or 0 where the Gaussian counts as absent.
    ray : (h,) float64
        The number of the ray.
    key : (h,) float64
        Ray plus place on it, 0 to 1; ascending.
    window : (h,) float64
        Hits on the same ray are near if their keys differ by at most this.
    """

    hit: NDArray[np.int64]
    width: NDArray[np.float32]
    owner: NDArray[np.int32]
    alpha: NDArray[np.float64]
    transmittance: NDArray[np.float64]
    weight: NDArray[np.float64]
    ray: NDArray[np.float64]
    key: NDArray[np.float64]
    window: NDArray[np.float64]

    def around(self, rows: NDArray[np.int64]) -> Around:
        """Return what lies around some hits on their rays."""
        key, window, ray = self.key[rows], self.window[rows], self.ray[rows]
        end = ray + (1.0 + _FRACTION) / 2.0
        return Around(
            np.searchsorted(self.key, np.maximum(key - window, ray)),
            np.searchsorted(self.key, np.minimum(key + window, end), side="right"),
            np.searchsorted(self.key, end),
        )

    def sums(self, rows: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return for each of `hit` the sum of values, (r,), of some hits, (u,)."""
        return np.asarray(np.bincount(self.owner[rows], values, len(self.hit)), np.float64)


@dataclass(frozen=True, eq=False)
class ViewHits:
    """What the rays of one view hit that may show once suspects are absent: h hits, near to far.

    Attributes
    ----------
    hit : (u,) int64
        The Gaussians that any ray hits.
    width : (u,) float32
        See `Hits`.
    owner : (h,) int32
        Which of them each hit is on.
    alpha : (h,) float32
    key : (h,) float64
        See `Hits`.
    scale : float
        How much of a key is one unit of nearness, 1 / scene size.
    """

    hit: NDArray[np.int64]
    width: NDArray[np.float32]
    owner: NDArray[np.int32]
    alpha: NDArray[np.float32]
    key: NDArray[np.float64]
    scale: float

    def without(self, absent: NDArray[np.bool_]) -> Hits:
        """Return the hits that light reaches if some Gaussians, (M,) bool, take none."""
        ray = np.floor(self.key)
        present = (~absent[self.hit]).take(self.owner).astype(np.float64)
        alpha = self.alpha.astype(np.float64)
        _, counts = np.unique(ray, return_counts=True)
        log_front = in_front(np.log1p(-alpha) * present, counts)
        reached = np.flatnonzero(log_front > math.log(REACHED))  # (h,)
        ray, key, alpha = ray[reached], self.key[reached], alpha[reached]
        transmittance = np.exp(log_front[reached])
        nearness = (ray + _FRACTION - key) / self.scale
        return Hits(
            self.hit, self.width, self.owner[reached], alpha, transmittance,
            transmittance * alpha * present[reached], ray, key,
            self.scale * np.maximum(WINDOW * nearness, PARALLAX),
        )  # fmt: skip


def hits_of_view(
    gaussians: Gaussians,
    footprints: Footprints,
    scene: Scene,
    numbered: tuple[View, int],
    absent: NDArray[np.bool_],
    targets: NDArray[np.bool_] | None = None,
) -> ViewHits | None:
    """Return what the rays of one view hit; None if nothing.

    Parameters
    ----------
    gaussians, footprints
        The latter are those of the former in the view.
    scene
    numbered : View, int
        The view, and its number: each has its rays in other pixels.
    absent : (M,) bool
        Gaussians that may take no light, though they are hit.
    targets : (M,) bool, optional
        Rays are aimed at these if they are small.
    """
    view, number = numbered
    count = min(RAYS, MAX_HITS / max(depth_complexity(footprints, view), 1.0))
    columns, rows = pixels(view, number, count)
    aims = None
    if targets is not None:
        cell = view.width * view.height / (len(columns) * len(rows))
        aims = aimed(view, columns, rows, _centers(footprints, targets, number, TARGET * cell))
    rays = cast(footprints, columns, rows, aims)
    if not len(rays.ray):
        return None
    present = ~absent[rays.hit].take(rays.owner)  # (hits of the rays,)
    _, counts = np.unique(rays.ray, return_counts=True)
    log_front = in_front(rays.log_passed * present.astype(np.float64), counts)
    reached = np.flatnonzero(log_front > math.log(REACHED))  # (h,)
    place = np.empty(len(gaussians), np.int64)
    place[footprints.index] = np.arange(len(footprints.index))
    footprints = footprints.take(place[rays.hit])  # of the u that are hit
    depth = _depths(gaussians.take(rays.hit), footprints, scene, view, rays, reached)
    nearness = 1.0 / depth
    scale = _FRACTION / float(nearness.max())
    key = rays.ray[reached] + np.maximum(_FRACTION - scale * nearness, 0.0)
    order = np.argsort(key, kind="stable")
    reached = reached[order]
    width = footprints.sigmas[0] / np.float32(max(view.width, view.height))
    return ViewHits(rays.hit, width, rays.owner[reached], rays.alpha[reached], key[order], scale)


def _centers(
    footprints: Footprints, targets: NDArray[np.bool_], number: int, area: float
) -> NDArray[np.float32]:
    """Return the centres of those targets that rays spread evenly would miss, (2, t), pixels.

    They are smaller than an area, px^2, and in another order in each view.
    """
    small = footprints.sigmas[0] * footprints.sigmas[1] < area
    rows = np.flatnonzero(small & targets[footprints.index])
    turn = (footprints.index[rows] * _TURNS[0] + number * _TURNS[1]) % 1.0
    return footprints.centers[:, rows[np.argsort(turn)]]


def _depths(
    gaussians: Gaussians,
    footprints: Footprints,
    scene: Scene,
    view: View,
    rays: Rays,
    reached: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return how deep rays hit splats, scene sizes, (h,): where the splats are densest on them.

    Given the place in the image, the mean depth of a Gaussian is that of its centre plus
    ``c' C^-1 d``, with C its covariance in the image, c that of image and depth, and d the step
    from its centre. That is the sum of ``(c.a / s^2) (d.a / s^2)`` over the footprint's axes a, of
    length s.

    `gaussians` and `footprints` are the u that are hit; `reached`, (h,), says which hits count.
    """
    means, covariances = (
        values.astype(np.float64) for values in projection.in_camera(gaussians, scene, view)
    )
    x, y, z = means
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
    return np.asarray(np.maximum(depth, _NEAREST * z[owner]), np.float64)


def own_support(
    hits: Hits, wanted: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the light that each of `hit` takes, and that times its support by others, (u,) each.

    Others support it as they would if it were gone: then ``1 / (1 - alpha)`` times as much light
    reaches what lies behind it. Both are 0 of those that are not wanted, (u,) bool.
    """
    rows = np.flatnonzero(wanted.take(hits.owner) & (hits.weight > 0.0))
    before = _running(hits.weight)
    around = hits.around(rows)
    more = 1.0 / (1.0 - hits.alpha[rows])
    near = before[rows] - before[around.first]
    near += (before[around.last] - before[rows + 1]) * more
    behind = (before[around.end] - before[around.last]) * more
    support = near / np.maximum(near + behind, _TINY)
    support = np.where(behind > NOTHING * hits.transmittance[rows], support, 1.0)
    weight = hits.weight[rows]
    return hits.sums(rows, weight), hits.sums(rows, weight * support)


@dataclass(frozen=True, eq=False)
class _Sums:
    """Sums over views for M Gaussians; each attribute is an array, (M,) float64."""

    @classmethod
    def zero(cls, count: int) -> Self:
        """Return the sums of no views, for `count` Gaussians."""
        return cls(*np.zeros((len(fields(cls)), count)))

    def merge(self, other: Self) -> None:
        """Add the sums of other views."""
        for item in fields(self):
            getattr(self, item.name)[:] += getattr(other, item.name)


@dataclass(frozen=True, eq=False)
class Support(_Sums):
    """What views see of M Gaussians, all of them present.

    Attributes
    ----------
    weight, supported : (M,) float64
        The light that each takes, and that times its support by others.
    views : (M,) float64
        In how many views the centre lies.
    width : (M,) float64
        The largest of `Hits.width`, not a sum.
    """

    weight: NDArray[np.float64]
    supported: NDArray[np.float64]
    views: NDArray[np.float64]
    width: NDArray[np.float64]

    def add(self, hits: Hits, wanted: NDArray[np.bool_]) -> None:
        """Add light and support, in one view, of the Gaussians that are wanted, (M,) bool."""
        weight, supported = own_support(hits, wanted[hits.hit])
        self.weight[hits.hit] += weight
        self.supported[hits.hit] += supported
        self.width[hits.hit] = np.maximum(self.width[hits.hit], hits.width)

    def merge(self, other: Self) -> None:
        """Add what other views see."""
        width = np.maximum(self.width, other.width)
        super().merge(other)
        self.width[:] = width

    def shares(self) -> NDArray[np.float64]:
        """Return the share of its light that others support, (M,); 1 where no view sees it."""
        lit = self.weight > 0.0
        return np.where(lit, self.supported / np.where(lit, self.weight, 1.0), 1.0)


@dataclass(frozen=True, eq=False)
class Evidence(_Sums):
    """What views see of M Gaussians with all suspects gone; 0 but for the suspects.

    Attributes
    ----------
    near, behind : (M,) float64
        Light that stops near their places, and behind them, times their alpha.
    contrast : (M,) float64
        The latter times the difference of colour between suspect and what lies behind.
    views, past : (M,) float64
        How many views see what lies at and behind it, and how many of them see past it.
    """

    near: NDArray[np.float64]
    behind: NDArray[np.float64]
    contrast: NDArray[np.float64]
    views: NDArray[np.float64]
    past: NDArray[np.float64]

    def support(self) -> NDArray[np.float64]:
        """Return the share of the light that stops near each, (M,); 1 where no view sees it."""
        total = self.near + self.behind
        return np.where(total > 0.0, self.near / np.where(total > 0.0, total, 1.0), 1.0)

    def add(self, hits: Hits, suspects: NDArray[np.bool_], colors: NDArray[np.float32]) -> None:
        """Add what one view sees.

        The hits are those with the suspects, (M,) bool, absent; colours are (M, 3).
        """
        rows = np.flatnonzero(suspects[hits.hit].take(hits.owner))
        around = hits.around(rows)
        before = _running(hits.weight)
        near = before[around.last] - before[around.first]
        behind = before[around.end] - before[around.last]
        alpha = hits.alpha[rows]
        mass, stops, passes = (
            hits.sums(rows, alpha * values) for values in (np.ones_like(near), near, behind)
        )
        contrast = _contrast(hits, rows, around, behind, colors)
        self.near[hits.hit] += stops
        self.behind[hits.hit] += passes
        self.contrast[hits.hit] += hits.sums(rows, alpha * behind * contrast)
        sees = (stops + passes > SEEN * mass) & (mass > 0.0)
        self.views[hits.hit[sees]] += 1.0
        self.past[hits.hit[sees & (stops < PAST * (stops + passes))]] += 1.0


def _contrast(
    hits: Hits,
    rows: NDArray[np.int64],
    around: Around,
    behind: NDArray[np.float64],
    colors: NDArray[np.float32],
) -> NDArray[np.float64]:
    """Return how much some hits differ in colour from what lies behind them, (r,).

    It is the root mean square of the channels. `around` is theirs, and `behind`, (r,), the light
    that stops behind them.
    """
    squared = np.zeros(len(rows))
    for channel in colors[hits.hit].T.astype(np.float64):
        of_hits = channel.take(hits.owner)
        before = _running(hits.weight * of_hits)
        color = (before[around.end] - before[around.last]) / np.maximum(behind, _TINY)
        squared += (of_hits[rows] - color) ** 2
    return np.where(behind > NOTHING, np.sqrt(squared / 3.0), 0.0)


def _running(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sum of the values before each place, and of all, (h + 1,)."""
    return np.append(0.0, np.cumsum(values))
