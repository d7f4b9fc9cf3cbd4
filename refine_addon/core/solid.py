"""Which points lie inside a closed mesh.

A ray upward from a point counts the triangles that it crosses: those that turn their outer side up
count 1, the others -1. The sum is the winding number of the mesh about the point, 0 outside. Where
neighbours do not turn the same way, the number of crossings decides, odd inside.

Points are halved into groups. A group whose box no triangle touches lies inside or outside as a
whole, so that one ray tells of all its points.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import RefineError

_LEAF = 1 << 14  # pairs of point and triangle that are compared one by one


class Solid:
    """The inside of a closed mesh.

    A point on its surface belongs to the side towards which x, y and z grow, but for rounding, so
    that solids that share a face share no point. Parts that overlap are joined; where one turns its
    faces the other way, their overlap is outside, like the hollow of a hollow sphere.

    Attributes
    ----------
    vertices : (V, 3) float64
        Equal ones are made one.
    triangles : (T, 3) int64
        Three vertices each; those without area are left out where two of these are one.
    turned : bool
        Whether all triangles turn the same way as their neighbours.

    Examples
    --------
    >>> corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    >>> solid = Solid(corners, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]))
    >>> solid.inside(np.array([[0.2, 0.2, 0.2], [0.5, 0.5, 0.5]])).tolist()
    [True, False]
    """

    def __init__(self, vertices: NDArray[Any], triangles: NDArray[Any]) -> None:
        """Join equal vertices, and check the mesh."""
        vertices = np.asarray(vertices, np.float64).reshape(-1, 3) + 0.0  # -0 equals 0
        triangles = np.asarray(triangles, np.int64).reshape(-1, 3)
        if not len(triangles):
            raise RefineError("has no faces, expected a closed mesh")
        if not np.isfinite(vertices).all():
            raise RefineError("has a vertex that is not finite, expected a closed mesh")
        order = np.lexsort(vertices.T)
        new = np.ones(len(order), np.bool_)
        new[1:] = (vertices[order[1:]] != vertices[order[:-1]]).any(axis=1)
        joined = np.empty(len(order), np.int64)
        joined[order] = np.cumsum(new) - 1
        triangles = joined[triangles]
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (c != a)]
        start, end = triangles.reshape(-1), np.roll(triangles, -1, axis=1).reshape(-1)
        names = np.minimum(start, end) * len(order) + np.maximum(start, end)
        edge = np.unique(names, return_inverse=True)[1].reshape(-1)
        open_edges = np.count_nonzero(np.bincount(edge) % 2)
        if open_edges or not len(triangles):
            raise RefineError(
                f"is not closed: {open_edges} of its edges belong to an odd number of faces; fill "
                "the holes, or add a Remesh modifier"
            )
        self.vertices, self.triangles = vertices[order[new]], triangles
        self.turned = not np.bincount(edge, np.where(start < end, 1.0, -1.0)).any()

    def inside(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """Points, (N, 3) floating, that lie inside, (N,) bool; none that is not finite."""
        inside = np.zeros(len(points), np.bool_)
        corners = self.vertices.T[:, self.triangles]
        low, high = corners.min(axis=2), corners.max(axis=2)  # (3, T) each
        within = (points >= low.min(axis=1)) & (points < high.max(axis=1))
        rows = np.flatnonzero(within.all(axis=1))
        places = np.array(points[rows].T, np.float64, order="C")  # (3, n)
        turns, leader = np.zeros(len(rows)), np.arange(len(rows))
        waiting = [(leader.copy(), np.arange(corners.shape[1]))] if len(rows) else []
        while waiting:
            group, triangles = waiting.pop()
            of_group, lows, highs = places[:, group], low[:, triangles], high[:, triangles]
            first, last = of_group.min(axis=1), of_group.max(axis=1)
            reach = (lows <= last[:, None]) & (highs >= first[:, None])
            above = reach[0] & reach[1] & (highs[2] >= first[2])
            triangles = triangles[above]
            if not reach[2, above].any() or (first == last).all():  # all are where one is
                leader[group] = group[0]
                group = group[:1]
            if len(group) * len(triangles) > _LEAF and len(group) > 1:
                axis = int(np.argmax(last - first))
                half = of_group[axis] <= (first + last)[axis] / 2.0
                half &= of_group[axis] < last[axis]
                waiting += [(group[half], triangles), (group[~half], triangles)]
            else:
                turns[group] = self._turns(places[:, group], triangles, low, high)
        inside[rows] = (turns != 0.0 if self.turned else turns % 2.0 == 1.0)[leader]
        return inside

    def _turns(self, points, triangles, low, high):
        """Sum over the crossings of a ray upward from each point, (3, n): (n,).

        A crossing counts 1 or -1 by the way that the triangle turns, or 1 if not all are `turned`.
        An edge is crossed on the same side of a ray for both of its triangles, since its vertices
        are taken in the same order for both, and rays through a vertex count the edges that begin
        there: so no ray slips between two triangles or hits both.
        """
        (left, bottom), (right, top) = low[:2, triangles], high[:2, triangles]
        x, y = points[:2, :, None]
        rows, columns = np.nonzero((x >= left) & (x < right) & (y >= bottom) & (y < top))
        px, py, pz = points[:, rows]
        corners = self.triangles[triangles[columns]]  # (C, 3)
        below = self.vertices[corners, 1] <= py[:, None]
        one_below = below.sum(axis=1) == 1
        # The vertex that is alone on its side of the line along x through the ray.
        alone = np.where(one_below, below.argmax(axis=1), below.argmin(axis=1))
        apex, after, before = (
            np.take_along_axis(corners, (alone[:, None] + step) % 3, 1)[:, 0] for step in range(3)
        )
        # The edges that end in it cross the line here.
        x1, z1 = self._cut(apex, after, py)
        x2, z2 = self._cut(before, apex, py)
        crossed = (x1 > px) != (x2 > px)
        signs = np.where(((x1 > px) != one_below) & self.turned, -1.0, 1.0)
        arrays = rows, signs, px, pz, x1, x2, z1, z2
        rows, signs, px, pz, x1, x2, z1, z2 = (values[crossed] for values in arrays)
        above = z1 + (px - x1) / (x2 - x1) * (z2 - z1) > pz
        return np.bincount(rows[above], signs[above], points.shape[1])

    def _cut(self, one, other, height):
        """X and z where edges between vertices, (C,) each, have these y, (C,)."""
        first, last = np.minimum(one, other), np.maximum(one, other)
        x, y, z = self.vertices.T
        share = (height - y[first]) / (y[last] - y[first])
        cut = x[first] + share * (x[last] - x[first])
        # Within its ends, which the boxes of triangles go by.
        cut = np.clip(cut, np.minimum(x[first], x[last]), np.maximum(x[first], x[last]))
        return cut, z[first] + share * (z[last] - z[first])
