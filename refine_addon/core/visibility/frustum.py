"""The only definition of the frustum. A point with camera coordinates x, y, z lies in it if

    near <= z <= far,   0 <= fx x / z + cx <= width,   0 <= fy y / z + cy <= height

The last two are computed as ``|f x + offset z| <= half z``, without division, so they are False
behind the camera; the offset is from the image's centre to the principal point.
"""

from __future__ import annotations

import threading
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, chunks, run, silent
from ..views import View, ViewSet

_STACK = 16
"""Rows of one matrix product: so few that BLAS starts no threads, which would slow down ours."""

_POINTS = 4096
"""Points processed at a time: their projections into all views stay in the caches."""

_ROUNDING = 1e-14
"""Bound of the rounding error of a sum of four products, over the sum of their absolute values."""

_STEEPEST = 1e100
"""Largest focal length over half the image, so that squares of its products do not overflow."""


class Side(NamedTuple):
    """An image across or down, px; `offset` is from its centre to the principal point."""

    focal: float
    offset: float
    half: float


def image_sides(view: View) -> tuple[Side, Side]:
    """The image of a view across and down."""
    return (
        Side(view.fx, view.cx - view.width / 2, view.width / 2),
        Side(view.fy, view.cy - view.height / 2, view.height / 2),
    )


def clip_planes(view: View, near: float) -> tuple[float, float]:
    """Near and far plane, world units; `near` if the view has none of its own."""
    return (view.near if view.near > 0.0 else near), view.far


def contains(view: View, local: NDArray[Any], planes: tuple[float, float]) -> NDArray[np.bool_]:
    """Which points, (3, n) in camera coordinates, lie in a view's frustum between near and far."""
    x, y, z = local
    inside: NDArray[np.bool_] = (z >= planes[0]) & (z <= planes[1])
    for coordinate, side in zip((x, y), image_sides(view), strict=True):
        inside &= np.abs(side.focal * coordinate + side.offset * z) <= side.half * z
    return inside


class Frustums:
    """The frustums of V views, for points relative to `origin`, to keep digits far from zero.

    `near`, > 0, is for views that have no near plane of their own. `beyond_per_unit`, (V, 1), is
    the growth of `project`'s `beyond` per world unit away from a side.
    """

    def __init__(self, views: ViewSet, origin: NDArray[np.float64], near: float) -> None:
        # Times ``(p, 1)`` x', y' and z, (3, V, 4); p is in the image if ``|x'|, |y'| <= z``.
        self._rows = np.empty((3, len(views), 4))
        for index, (view, center) in enumerate(zip(views, views.centers - origin, strict=True)):
            *axes, forward = np.column_stack([view.rotation, -view.rotation @ center])  # (4,) each
            for row, axis, side in zip(self._rows, axes, image_sides(view), strict=False):
                row[index] = (side.focal * axis + side.offset * forward) / side.half
            self._rows[2, index] = forward
        slopes = [[side.focal / side.half for side in image_sides(view)] for view in views]
        slope = np.minimum(np.prod(np.sqrt(slopes), axis=1, keepdims=True), _STEEPEST)
        self.beyond_per_unit = np.hypot(1.0, slope)
        planes = np.array([clip_planes(view, near) for view in views])
        self._near, self._far = planes[:, :1], planes[:, 1:]
        self._has_far = bool(np.isfinite(self._far).any())
        # One buffer a thread is reused, since allocating one costs as much as the product.
        self._buffers = threading.local()

    def classify(
        self, low: NDArray[np.float64], high: NDArray[np.float64], reach: NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which views may see part of each box, and which surely see all of it, (V, k) bool each.

        Points of a box that a view does not touch lie beyond a plane, or their ``beyond``
        (`project`) is at least `reach`, world units, times `beyond_per_unit`.
        """
        middle, half = (low + high) / 2.0, (high - low) / 2.0
        x, y, z = self._rows
        # x' - z and the like are linear: their extremes in a box follow from middle and half size.
        least, most = [], []
        for row in (x - z, -x - z, y - z, -y - z, z):  # (V, 4) each
            steep = np.abs(row)
            at = row[:, :3] @ middle + row[:, 3:]  # (V, k)
            # Widened by what these sums and those of `project` may round.
            around = steep[:, :3] @ (half + _ROUNDING * (np.abs(middle) + half))
            around += _ROUNDING * steep[:, 3:]
            least.append(at - around)
            most.append(at + around)
        near, far = self._near, self._far
        outside = np.maximum.reduce(least[:4])
        touching = (outside < reach * self.beyond_per_unit) & (most[4] >= near) & (least[4] <= far)
        whole = (np.maximum.reduce(most[:4]) <= 0.0) & (least[4] >= near) & (most[4] <= far)
        return touching, whole

    def project(
        self, points: NDArray[np.float64], views: NDArray[np.int64], count: int
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Depths of points (x, y, z, 1) in b views; ``beyond`` and ``between`` in `count` of them.

        ``beyond``, (count, n), is ``max(|x'|, |y'|) - depth``, x' and y' in half images at depth 1:
        at most 0 in the image. ``between``, (count, n), says which lie between near and far plane.
        Depths and ``beyond`` last until this thread's next call.
        """
        end = len(views) + 2 * count
        stack = np.zeros((-(-end // _STACK), _STACK, 4))
        rows = stack.reshape(-1, 4)
        rows[: len(views)] = self._rows[2, views]
        rows[len(views) : end] = self._rows[:2, views[:count]].reshape(-1, 4)
        size = stack.shape[0] * _STACK * points.shape[1]
        if getattr(self._buffers, "memory", np.empty(0)).size < size:
            self._buffers.memory = np.empty(size)
        product = self._buffers.memory[:size].reshape(*stack.shape[:2], -1)
        np.matmul(stack, points, out=product)
        flat = product.reshape(-1, points.shape[1])
        depth, across = flat[: len(views)], flat[len(views) : end]
        np.abs(across, out=across)
        beyond = np.maximum(across[:count], across[count:], out=across[:count])
        beyond -= depth[:count]
        between = depth[:count] >= self._near[views[:count]]
        if self._has_far:
            between &= depth[:count] <= self._far[views[:count]]
        return depth, beyond, between


def census(
    points: NDArray[np.floating[Any]], views: ViewSet, *, progress: Progress = silent
) -> NDArray[np.int64]:
    """How many of N points, (N, 3), lie in each of V views, (V,); those not finite lie in none."""
    origin = views.middle()[0]
    frustums = Frustums(views, origin, float(np.finfo(np.float64).tiny))
    numbers = np.arange(len(views))

    def count_in_views(piece):
        local = np.ones((4, piece.stop - piece.start))
        with np.errstate(invalid="ignore", over="ignore", under="ignore"):
            local[:3] = (points[piece] - origin).T
            local[:, ~np.isfinite(local).all(axis=0)] = np.nan
            _, beyond, between = frustums.project(local, numbers, len(numbers))
            return np.count_nonzero(between & (beyond <= 0.0), axis=1)

    counts = run(count_in_views, chunks(len(points), _POINTS), progress=progress, what="counting")
    return sum(counts, np.zeros(len(views), np.int64))
