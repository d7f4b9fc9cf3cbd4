"""Which points lie in which view, and how deep: many points against many views at once."""

from __future__ import annotations

import math
import threading
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..views import ViewSet

_STACK = 16
"""Rows of one matrix product: so few that BLAS starts no threads, which would fight ours."""


class Frustums:
    """The frustums of V views around a common origin.

    Parameters
    ----------
    views : ViewSet
    origin : (3,) float64
        What points are given relative to, world units: near the views, so that a scene a million
        units from zero keeps its digits.
    near : float
        Near plane of views that bring none, world units, > 0.
    margin : float
        How far beyond the image's edge still counts as inside, in half image sizes.

    Attributes
    ----------
    centers : (V, 3) float64
        Of the views, relative to the origin.
    """

    def __init__(
        self, views: ViewSet, origin: NDArray[np.float64], near: float, margin: float
    ) -> None:
        self.centers = views.centers - origin
        self._rows = _rows(views, self.centers, margin)
        planes = np.array([view.near for view in views])
        self._near = np.where(planes > 0.0, planes, near)[:, None]
        self._far = np.array([view.far for view in views])[:, None]
        # Of each thread: memory asked for anew for every product costs as much as the product.
        self._own = threading.local()

    def project(
        self, points: NDArray[np.float64], block: slice
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return depths, and which points lie inside.

        Parameters
        ----------
        points : (4, n) float64
            x, y, z relative to the origin, and 1.
        block : slice
            Which views; b of them.

        Returns
        -------
        depth : (b, n) float64
            Along each view's axis, world units; yours until this thread asks again.
        inside : (b, n) bool
            Between near and far plane and within the widened image, edges included.
        """
        rows = self._rows[:, block].reshape(-1, 4)
        stack = np.zeros((-(-len(rows) // _STACK), _STACK, 4))
        stack.reshape(-1, 4)[: len(rows)] = rows
        product = self._memory((*stack.shape[:2], points.shape[1]))
        np.matmul(stack, points, out=product)
        x, y, depth = np.split(product.reshape(-1, points.shape[1])[: len(rows)], 3)
        np.maximum(np.abs(x, out=x), np.abs(y, out=y), out=x)
        inside = np.less_equal(x, depth)
        near, far = self._near[block], self._far[block]
        # One number for all views is twice as fast as one for each.
        inside &= depth >= (near if np.ptp(near) > 0.0 else near[0, 0])
        if np.isfinite(far).any():
            inside &= depth <= far
        return depth, inside

    def _memory(self, shape: tuple[int, ...]) -> NDArray[np.float64]:
        size = math.prod(shape)
        held: NDArray[np.float64] | None = getattr(self._own, "memory", None)
        if held is None or held.size < size:
            held = self._own.memory = np.empty(size)
        return held[:size].reshape(shape)


def _rows(views: ViewSet, centers: NDArray[np.float64], margin: float) -> NDArray[np.float64]:
    """Return rows whose products with ``(p, 1)`` are x', y' and z of every view.

    A point lies between the image's edges, widened by `margin`, where ``|x'| <= z`` and
    ``|y'| <= z``: the principal point and the half image size are in the rows.

    Returns
    -------
    (3, V, 4) float64
    """
    rows = np.empty((3, len(views), 4))
    for index, (view, center) in enumerate(zip(views, centers, strict=True)):
        right, down, forward = np.column_stack([view.rotation, -view.rotation @ center])
        half_width = view.width / 2 * (1 + margin)
        half_height = view.height / 2 * (1 + margin)
        rows[0, index] = (view.fx * right + (view.cx - view.width / 2) * forward) / half_width
        rows[1, index] = (view.fy * down + (view.cy - view.height / 2) * forward) / half_height
        rows[2, index] = forward
    return rows
