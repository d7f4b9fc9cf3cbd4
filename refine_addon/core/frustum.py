"""Which points lie in a view: the only definition of the frustum, for one view and for many.

A point with camera coordinates ``x, y, z`` lies in a view if it is between the near and the far
plane and projects into the image, edges included::

    near <= z <= far,   0 <= fx x / z + cx <= width,   0 <= fy y / z + cy <= height

Multiplied by z, with the principal point measured from the centre of the image, the latter two are
``|f x + offset z| <= half z``. This needs no division and excludes points behind the camera.
"""

from __future__ import annotations

import math
import threading
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .work import Progress, for_chunks, silent

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .views import View, ViewSet

_STACK = 16
"""Rows of one matrix product: so few that BLAS starts no threads, which would slow down ours."""

_POINTS = 4096
"""Points that are counted at a time: what is known of them in all views stays in the caches."""

_STEEPEST = 1e100
"""Limit of a focal length over half the image: its product with any length can be squared."""


class Side(NamedTuple):
    """An image across or down, pixels.

    Attributes
    ----------
    focal : float
        Focal length.
    offset : float
        From the centre of the image to the principal point.
    half : float
        Half the image's size.
    """

    focal: float
    offset: float
    half: float


def image_sides(view: View) -> tuple[Side, Side]:
    """Return the image of a view across and down."""
    return (
        Side(view.fx, view.cx - view.width / 2, view.width / 2),
        Side(view.fy, view.cy - view.height / 2, view.height / 2),
    )


def clip_planes(view: View, near: float) -> tuple[float, float]:
    """Return near and far plane, world units; `near` is for views that have none of their own."""
    return (view.near if view.near > 0.0 else near), view.far


def contains(view: View, local: NDArray[Any], planes: tuple[float, float]) -> NDArray[np.bool_]:
    """Return which points lie in a view, (n,).

    Parameters
    ----------
    view : View
    local : (3, n) floating
        Camera coordinates: x right, y down, z forward.
    planes : (near, far)
        In the unit of `local`.
    """
    x, y, z = local
    inside: NDArray[np.bool_] = (z >= planes[0]) & (z <= planes[1])
    for coordinate, side in zip((x, y), image_sides(view), strict=True):
        inside &= np.abs(side.focal * coordinate + side.offset * z) <= side.half * z
    return inside


class Frustums:
    """The frustums of V views around a common origin.

    Parameters
    ----------
    views : ViewSet
    origin : (3,) float64
        Points are given relative to it, world units. It is near the views, so that a scene far from
        zero keeps its digits.
    near : float
        Near plane of views that have none of their own, world units, > 0.

    Attributes
    ----------
    centers : (V, 3) float64
        Of the views, relative to the origin.
    steepness : (V, 1) float64
        By how much `beyond` of `project` grows with a step straight away from a side, for an image
        as high as wide and of the same area.
    """

    def __init__(self, views: ViewSet, origin: NDArray[np.float64], near: float) -> None:
        self.centers = views.centers - origin
        self._rows = _rows(views, self.centers)
        slopes = [[side.focal / side.half for side in image_sides(view)] for view in views]
        slope = np.minimum(np.prod(np.sqrt(slopes), axis=1, keepdims=True), _STEEPEST)
        self.steepness = np.hypot(1.0, slope)
        planes = np.array([clip_planes(view, near) for view in views])
        self._near, self._far = planes[:, :1], planes[:, 1:]
        # One buffer a thread is reused, since allocating one costs as much as the product.
        self._own = threading.local()

    def project(
        self, points: NDArray[np.float64], block: slice
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Return how deep points lie in views, and where.

        Parameters
        ----------
        points : (4, n) float64
            x, y, z relative to the origin, and 1.
        block : slice
            Which b views.

        Returns
        -------
        depth : (b, n) float64
            Along each view's axis, world units.
        beyond : (b, n) float64
            ``max(|x'|, |y'|) - depth`` with x' and y' from the centre of the image, in half sizes
            of it at depth 1, world units: at most 0 in the image, edges included.
        between : (b, n) bool
            Between near and far plane, planes included.

        The first two are overwritten by this thread's next call.
        """
        rows = self._rows[:, block].reshape(-1, 4)  # (3 b, 4)
        stack = np.zeros((-(-len(rows) // _STACK), _STACK, 4))
        stack.reshape(-1, 4)[: len(rows)] = rows
        product = self._memory((*stack.shape[:2], points.shape[1]))
        np.matmul(stack, points, out=product)
        x, y, depth = np.split(product.reshape(-1, points.shape[1])[: len(rows)], 3)
        np.maximum(np.abs(x, out=x), np.abs(y, out=y), out=x)
        x -= depth
        near, far = self._near[block], self._far[block]
        # Comparing with a single number is twice as fast as with one for each view.
        between = depth >= (near if np.ptp(near) > 0.0 else near[0, 0])
        if np.isfinite(far).any():
            between &= depth <= far
        return depth, x, between

    def _memory(self, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Return this thread's buffer in a shape; its content is arbitrary."""
        size = math.prod(shape)
        held: NDArray[np.float64] | None = getattr(self._own, "memory", None)
        if held is None or held.size < size:
            held = self._own.memory = np.empty(size)
        return held[:size].reshape(shape)


def census(
    points: NDArray[np.floating[Any]],
    views: ViewSet,
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> NDArray[np.int64]:
    """Return how many of N points lie in each of V views, (V,); those not finite lie in none.

    Parameters
    ----------
    points : (N, 3) floating
        World units.
    views : ViewSet
        A view without a near plane of its own begins at its centre.
    progress : callable, optional
        ``progress(fraction, what)``; returning ``False`` cancels.
    threads : int, optional

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """
    origin = views.middle()[0]
    frustums = Frustums(views, origin, float(np.finfo(np.float64).tiny))
    found = np.zeros((-(-len(points) // _POINTS), len(views)), np.int64)

    def work(piece: slice) -> None:
        local = np.ones((4, min(piece.stop, len(points)) - piece.start))
        with np.errstate(invalid="ignore", over="ignore", under="ignore"):
            local[:3] = (points[piece] - origin).T
            local[:, ~np.isfinite(local).all(axis=0)] = np.nan
            _, beyond, between = frustums.project(local, slice(0, len(views)))
            inside = between & (beyond <= 0.0)
        found[piece.start // _POINTS] = np.count_nonzero(inside, axis=1)

    for_chunks(work, len(points), _POINTS, progress=progress, what="counting", threads=threads)
    return np.asarray(found.sum(axis=0))


def _rows(views: ViewSet, centers: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return rows whose products with ``(p, 1)`` are x', y' and z of every view.

    x' and y' contain the principal point and the half image size, so a point p lies in the image
    where ``|x'| <= z`` and ``|y'| <= z``.

    Returns
    -------
    (3, V, 4) float64
    """
    rows = np.empty((3, len(views), 4))
    for index, (view, center) in enumerate(zip(views, centers, strict=True)):
        *axes, forward = np.column_stack([view.rotation, -view.rotation @ center])  # (4,) each
        for row, axis, side in zip(rows, axes, image_sides(view), strict=False):
            row[index] = (side.focal * axis + side.offset * forward) / side.half
        rows[2, index] = forward
    return rows
