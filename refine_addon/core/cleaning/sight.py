"""How much light stops where a splat is, on rays: by itself, and beside other splats.

A ray hits splats front to back. Of the light that reaches a place on it, a share stops
near that place, the rest goes on to what lies behind. At a surface nearly all of it stops; at a
floater most goes on::

    support = light that stops near the place / light that stops there or behind

Each splat lies where its density is highest on the line, not at the depth of its centre, so that a
large wall that is seen obliquely is a surface along all of it. Two places are near each other if
their nearness (1 / depth, in scene sizes) differs by less than `WINDOW` of it, or by `PARALLAX`:
beyond, cameras a scene size apart see one move against the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..seeing import projection
from ..seeing.cast import cast, depth_complexity, pixels
from ..seeing.ray_sums import in_front

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..seeing.projection import Footprints, Gaussians
    from ..seeing.ray_sample import RaySample
    from ..seeing.rays import Rays
    from ..seeing.scene import Scene
    from ..views import View

RAYS = 2500
"""Rays of a view."""

MAX_HITS = 1 << 20
"""About how many hits the rays of a view may have; there are fewer rays in dense scenes."""

WINDOW = 0.1
"""Share of the nearness by which places on a line differ that count as one."""

PARALLAX = 0.05
"""Difference of nearness, per scene size, up to which places on a line count as one."""

REACHED = 1e-3
"""Places that less of the light reaches tell nothing."""

NOTHING = 0.02
"""Where less of the light stops behind a place, there is nothing behind it."""

SEEN = 0.1
"""A view sees what lies at and behind a splat if this share of the light stops there."""

PAST = 0.15
"""A view sees past a splat if a lower share of the light stops near it."""

_NEAREST = 0.2  # of the depth of its centre: as near as a splat may lie on a line
_FRACTION = 0.999  # of a line's number: nearness is packed below it


@dataclass(frozen=True, eq=False)
class Hits:
    """What the rays of one view hit: ray by ray, near to far.

    Attributes
    ----------
    hit : (u,) int64
        The Gaussians that any ray hits.
    owner : (h,) int32
        Which of them each hit is.
    alpha, reaching, light : (h,) float64
        Alpha there, the share of the light that reaches it, and the share that it takes: 0 if it
        counts as absent.
    key : (h,) float64
        Line, and place on it; ascending.
    window : (h,) float64
        How much of `key` is near.
    line : (h,) float64
    """

    hit: NDArray[np.int64]
    owner: NDArray[np.int32]
    alpha: NDArray[np.float64]
    reaching: NDArray[np.float64]
    light: NDArray[np.float64]
    key: NDArray[np.float64]
    window: NDArray[np.float64]
    line: NDArray[np.float64]

    def around(self, rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], ...]:
        """Return the first hit near some hits, the one behind the last, and their line's end."""
        key, window, line = (values[rows] for values in (self.key, self.window, self.line))
        end = line + (1.0 + _FRACTION) / 2.0
        return (
            np.searchsorted(self.key, np.maximum(key - window, line)),
            np.searchsorted(self.key, np.minimum(key + window, end), side="right"),
            np.searchsorted(self.key, end),
        )

    def sums(self, rows: NDArray[np.int64], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return for each of `hit` the sum of values, (r,), of some hits, (u,)."""
        return np.asarray(np.bincount(self.owner[rows], values, len(self.hit)), np.float64)


def look(
    gaussians: Gaussians,
    footprints: Footprints,
    scene: Scene,
    sample: RaySample,
    number: int,
    absent: NDArray[np.bool_],
) -> tuple[Hits, NDArray[np.float32]] | None:
    """Return what the rays of one view hit; None if nothing.

    Parameters
    ----------
    gaussians : Gaussians
    footprints : Footprints
        Of these in the view.
    scene : Scene
    sample : RaySample
        Has the views, and tells where their rays lie.
    number : int
        Of the view.
    absent : (M,) bool
        Gaussians that take no light, though they are hit.

    Returns
    -------
    hits : Hits
    wide : (u,) float32
        The longer standard deviation of the footprints hit, as a share of the longer side.
    """
    view = sample.views[number][0]
    count = min(RAYS, MAX_HITS / max(depth_complexity(footprints, view), 1.0))
    rays = cast(footprints, *pixels(view, number, count))
    if not len(rays.ray):
        return None
    present = ~absent[rays.hit].take(rays.owner)
    first = np.flatnonzero(np.diff(rays.ray, prepend=-1))
    counts = np.diff(np.append(first, len(rays.ray)))
    passed = in_front(rays.log_passed * present.astype(np.float64), counts)
    there = np.flatnonzero(passed > math.log(REACHED))
    place = np.empty(len(gaussians), np.int64)
    place[footprints.index] = np.arange(len(footprints.index))
    own = footprints.take(place[rays.hit])
    hit = gaussians.take(rays.hit)
    camera = (*projection.in_camera(hit, scene, view), hit.largest)
    nearness = 1.0 / _depths(camera, view, own, rays, there)
    scale = _FRACTION / float(nearness.max())
    line = rays.ray[there].astype(np.float64)
    key = line + _FRACTION - scale * nearness
    order = np.argsort(key, kind="stable")
    there = there[order]
    alpha, reaching = rays.alpha[there].astype(np.float64), np.exp(passed[there])
    hits = Hits(
        rays.hit,
        rays.owner[there],
        alpha,
        reaching,
        reaching * alpha * present[there],
        key[order],
        scale * np.maximum(WINDOW * nearness, PARALLAX)[order],
        line[order],
    )
    return hits, own.sigmas[0] / np.float32(max(view.width, view.height))


def _depths(
    camera: tuple[NDArray[np.float32], ...],
    view: View,
    footprints: Footprints,
    rays: Rays,
    there: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return how deep splats lie on lines, scene sizes, (r,): where they are densest there.

    Given the place in the image, the mean depth of a Gaussian is that of its centre plus
    ``c' C^-1 d``, with C its covariance in the image, c that of image and depth, and d the step
    from its centre. That is the sum of ``(c.a / s^2) (d.a / s^2)`` over the footprint's axes a, of
    length s.

    Parameters
    ----------
    camera : (3, u), (6, u), (u,) float32
        Centres and covariances of what is hit in camera coordinates, and its longest deviation.
    view : View
    footprints : Footprints
        Of what is hit.
    rays : Rays
    there : (r,) int64
        Which hits of the rays.
    """
    local, shape, largest = (values.astype(np.float64) for values in camera)
    x, y, z = local
    across = view.fx / z * (shape[2] - x / z * shape[5])  # (u,), covariance with the depth
    down = view.fy / z * (shape[4] - y / z * shape[5])
    owner, ray = rays.owner[there], rays.ray[there]
    step = [
        rays.columns[ray % len(rays.columns)] + 0.5 - footprints.centers[0, owner],
        rays.rows[ray // len(rays.columns)] + 0.5 - footprints.centers[1, owner],
    ]
    depth = z[owner]
    for axes, sigmas in zip((footprints.major, footprints.minor), footprints.sigmas, strict=True):
        unit = axes / sigmas.astype(np.float64) ** 2  # (2, u)
        slope = across * unit[0] + down * unit[1]  # (u,), depth for a step of one sigma
        slope = slope.clip(-largest, largest)  # no splat is deeper than long
        along = step[0] * unit[0][owner] + step[1] * unit[1][owner]  # in sigmas
        depth = depth + slope[owner] * along
    return np.asarray(np.maximum(depth, _NEAREST * z[owner]), np.float64)


def own_support(hits: Hits) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the light that each of `hit` takes, and that times its support by others, (u,) each.

    It is the support if this one splat were gone: then what lies behind it gets ``1 / (1 - alpha)``
    of the light.
    """
    every = np.arange(len(hits.key))
    total = np.append(0.0, np.cumsum(hits.light))
    first, last, end = hits.around(every)
    more = 1.0 / (1.0 - hits.alpha)
    near = total[every] - total[first] + (total[last] - total[every + 1]) * more
    behind = (total[end] - total[last]) * more
    support = np.where(behind > NOTHING * hits.reaching, near / np.maximum(near + behind, 1e-30), 1)
    return hits.sums(every, hits.light), hits.sums(every, hits.light * support)


@dataclass(frozen=True, eq=False)
class Evidence:
    """What views see of suspects with all of them gone; sums over views, for M Gaussians.

    Attributes
    ----------
    near, behind : (M,) float64
        Light that stops near their places, and behind them, times their alpha.
    contrast : (M,) float64
        The latter times the difference of colour between suspect and what lies behind.
    views, past : (M,) int32
        How many views see what lies at and behind it, and how many of them see past it.
    """

    near: NDArray[np.float64]
    behind: NDArray[np.float64]
    contrast: NDArray[np.float64]
    views: NDArray[np.int32]
    past: NDArray[np.int32]

    @classmethod
    def zero(cls, count: int) -> Evidence:
        """Return the sums of no views."""
        near, behind, contrast = np.zeros((3, count))
        views, past = np.zeros((2, count), np.int32)
        return cls(near, behind, contrast, views, past)

    def add(self, hits: Hits, suspects: NDArray[np.bool_], colors: NDArray[np.float32]) -> None:
        """Add what one view sees.

        Parameters
        ----------
        hits : Hits
            Looked at without the suspects.
        suspects : (M,) bool
        colors : (M, 3) float32
        """
        rows = np.flatnonzero(suspects[hits.hit].take(hits.owner))
        total = np.append(0.0, np.cumsum(hits.light))
        first, last, end = hits.around(rows)
        alpha = hits.alpha[rows]
        near, behind = total[last] - total[first], total[end] - total[last]
        squared = np.zeros(len(rows))
        for channel in colors[hits.hit].T.astype(np.float64):
            sums = np.append(0.0, np.cumsum(hits.light * channel.take(hits.owner)))
            color = (sums[end] - sums[last]) / np.maximum(behind, 1e-30)
            squared += (channel.take(hits.owner[rows]) - color) ** 2
        contrast = np.where(behind > NOTHING, np.sqrt(squared / 3.0), 0.0)
        mass, stops, passes = (
            hits.sums(rows, alpha * v) for v in (np.ones_like(near), near, behind)
        )
        self.near[hits.hit] += stops
        self.behind[hits.hit] += passes
        self.contrast[hits.hit] += hits.sums(rows, alpha * behind * contrast)
        sees = (stops + passes > SEEN * mass) & (mass > 0.0)
        self.views[hits.hit[sees]] += 1
        self.past[hits.hit[sees & (stops < PAST * (stops + passes))]] += 1

    def merge(self, other: Evidence) -> None:
        """Add the sums of other views."""
        for name in ("near", "behind", "contrast", "views", "past"):
            getattr(self, name)[:] += getattr(other, name)
