"""Which points lie inside a closed mesh.

A ray upward from a point counts the triangles that it crosses: those that turn their outer side up
count 1, the others -1. The sum is the winding number of the mesh about the point, 0 outside. Where
neighbours do not turn the same way, the number of crossings decides, odd inside.

Points are sorted into a grid. A cell that no triangle touches lies inside or outside as a whole, so
that rays are cast only from the points of the others.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import RefineError

Index = NDArray[np.int64]

_GRID = 128  # cells along each axis at most; four points a cell hold more than the grid costs
_FEW = 512  # points below which a grid does not pay
_LEAF = 1 << 13  # pairs of point and triangle that are compared one by one
_AT_ONCE = 1 << 20  # pairs that are computed together
_SLACK = 1e-6  # of a cell: by how much a triangle may reach into the next by rounding


@dataclass(frozen=True, eq=False)
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

    vertices: NDArray[Any]
    triangles: NDArray[Any]
    turned: bool = field(init=False)

    def __post_init__(self) -> None:
        """Join equal vertices, and check the mesh."""
        vertices = np.asarray(self.vertices, np.float64).reshape(-1, 3) + 0.0  # -0 equals 0
        triangles = np.asarray(self.triangles, np.int64).reshape(-1, 3)
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
        open_edges, turned = _edges(triangles, len(order))
        if open_edges or not len(triangles):
            raise RefineError(
                f"is not closed: {open_edges} of its edges belong to an odd number of faces; fill "
                "the holes, or add a Remesh modifier"
            )
        for name, value in (
            ("vertices", vertices[order[new]]),
            ("triangles", triangles),
            ("turned", turned),
        ):
            object.__setattr__(self, name, value)

    def inside(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """Which points, (N, 3) floating, lie inside, (N,); none that is not finite."""
        inside = np.zeros(len(points), np.bool_)
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        rows = np.flatnonzero(((points >= low) & (points < high)).all(axis=1))
        near = np.asarray(points[rows], np.float64)
        if len(rows) >= _FEW:
            cells = min(int(np.cbrt(4 * len(rows))), _GRID)
            scale = cells / (high - low)
            place = np.minimum(((near - low) * scale).astype(np.int64), cells - 1)
            flat = np.ravel_multi_index(tuple(place.T), (cells,) * 3)
            inside[rows] = self._grid(low, scale, cells).reshape(-1)[flat]
            mixed = _touched((self.vertices - low) * scale, self.triangles, cells)[flat]
            rows, near = rows[mixed], near[mixed]
        inside[rows] = self._crossed(near)
        return inside

    def _crossed(self, points):
        """Which points, (N, 3), lie inside, each by its own ray."""
        turns = np.zeros(len(points))
        for rows, heights, signs in self._crossings(points[:, :2]):
            above = heights > points[rows, 2]
            turns += np.bincount(rows[above], signs[above], len(points))
        return self._holds(turns)

    def _holds(self, turns):
        """Which winding numbers mean inside."""
        return np.asarray(turns != 0.0 if self.turned else turns % 2.0 == 1.0)

    def _grid(self, low, scale, cells):
        """Which cells of a grid lie inside, (G, G, G); meaningless where one is touched.

        It has G = `cells` each way, the lowest corner `low`, (3,), and `scale` cells a unit, (3,).
        """
        centers = np.arange(cells) + 0.5
        columns = np.stack(np.meshgrid(centers, centers, indexing="ij"), -1).reshape(-1, 2)
        turns = np.zeros(cells**3)
        for rows, heights, signs in self._crossings(columns / scale[:2] + low[:2]):
            level = np.clip((heights - low[2]) * scale[2], 0, cells - 1).astype(np.int64)
            turns += np.bincount(rows * cells + level, signs, cells**3)
        turns = turns.reshape(cells, cells, cells)
        above = turns[:, :, ::-1].cumsum(axis=2)[:, :, ::-1] - turns
        return self._holds(above)

    def _crossings(self, places):
        """Yield where rays along z through places, (N, 2), cross triangles.

        An edge is crossed on the same side of a ray for both of its triangles, since its vertices
        are taken in the same order for both, and rays through a vertex count the edges that begin
        there: so no ray slips between two triangles or hits both.

        Of C crossings these are the rays, the heights, and the signs, (C,) each: 1 or -1 by the way
        that the triangle turns, or 1 throughout if not all are `turned`.
        """
        for rows, triangles in _pairs(places, self.vertices[self.triangles, :2]):
            px, py = places[rows].T
            apex, after, before, one_below = self._apexes(triangles, py)
            # The edges that end in the apex cross the line along x through the ray here.
            x1, z1 = self._cut(apex, after, py)
            x2, z2 = self._cut(before, apex, py)
            crossed = (x1 > px) != (x2 > px)
            x1, x2, z1, z2, px = (values[crossed] for values in (x1, x2, z1, z2, px))
            heights = z1 + (px - x1) / (x2 - x1) * (z2 - z1)
            signs = np.ones(len(px))
            if self.turned:
                signs[(x1 > px) != one_below[crossed]] = -1.0
            yield rows[crossed], heights, signs

    def _apexes(self, triangles, height):
        """Corners of triangles, (C,), by the side of a line along x on which they lie.

        `height`, (C,), is y of the line. These are the vertex that is alone on its side, the next
        in the triangle, the one before it, and whether that side is below, (C,) each.
        """
        corners = self.triangles[triangles]  # (C, 3)
        below = self.vertices[corners, 1] <= height[:, None]
        one_below = below.sum(axis=1) == 1
        alone = np.where(one_below, below.argmax(axis=1), below.argmin(axis=1))
        every = np.arange(len(corners))
        apex, after, before = (corners[every, (alone + step) % 3] for step in range(3))
        return apex, after, before, one_below

    def _cut(self, one, other, height):
        """X and z where edges between vertices, (C,) each, have these y, (C,)."""
        first, last = np.minimum(one, other), np.maximum(one, other)
        x, y, z = self.vertices.T
        share = (height - y[first]) / (y[last] - y[first])
        cut = x[first] + share * (x[last] - x[first])
        # Within its ends, which the boxes of triangles go by.
        cut = np.clip(cut, np.minimum(x[first], x[last]), np.maximum(x[first], x[last]))
        return cut, z[first] + share * (z[last] - z[first])


def _edges(triangles, count):
    """How many edges belong to an odd number of triangles, and whether all turn one way."""
    start = triangles.reshape(-1)
    end = np.roll(triangles, -1, axis=1).reshape(-1)
    names = np.minimum(start, end) * count + np.maximum(start, end)
    _, edge = np.unique(names, return_inverse=True)
    edge = edge.reshape(-1)
    turns = np.bincount(edge, np.where(start < end, 1.0, -1.0))
    return int(np.count_nonzero(np.bincount(edge) % 2)), not turns.any()


def _pairs(places, corners):
    """Yield places and triangles whose boxes hold them, as pairs: (C,) and (C,).

    Places are (N, 2), corners of the triangles (T, 3, 2).
    """
    batch: list[tuple[Index, Index]] = []
    total = 0
    for pairs in _pairs_of_groups(places, corners):
        batch.append(pairs)
        total += len(pairs[0])
        if total > _AT_ONCE:
            yield _joined(batch)
            batch, total = [], 0
    if total:
        yield _joined(batch)


def _joined(batch):
    rows, triangles = zip(*batch, strict=True)
    return np.concatenate(rows), np.concatenate(triangles)


def _pairs_of_groups(places, corners):
    """Yield the pairs of `_pairs` for groups of places near each other.

    A group is halved along its longer side until few triangles may hold one of its places.
    """
    low, high = corners.min(axis=1).T.copy(), corners.max(axis=1).T.copy()  # (2, T) each
    waiting = [(np.arange(len(places)), np.arange(len(corners)))] if len(places) else []
    while waiting:
        rows, triangles = waiting.pop()
        group = places[rows]
        first, last = group.min(axis=0), group.max(axis=0)
        (left, bottom), (right, top) = low[:, triangles], high[:, triangles]
        near = (left <= last[0]) & (right > first[0]) & (bottom <= last[1]) & (top > first[1])
        triangles = triangles[near]
        if len(rows) * len(triangles) > _LEAF and len(rows) > 1:
            half, axis = len(rows) // 2, int(np.argmax(last - first))
            order = np.argpartition(group[:, axis], half)
            waiting += [(rows[order[:half]], triangles), (rows[order[half:]], triangles)]
        elif len(triangles):
            x, y = group.T[:, :, None]
            (left, bottom), (right, top) = low[:, triangles], high[:, triangles]
            held = np.nonzero((x >= left) & (x < right) & (y >= bottom) & (y < top))
            yield rows[held[0]], triangles[held[1]]


def _touched(vertices, triangles, cells):
    """Which cells of a grid triangles touch, (G * G * G,), and some beside them.

    Triangles wider than a cell are halved until they are not; of the eight cells in which the
    others may lie, those that the triangle's plane crosses are touched. Vertices, (V, 3), are in
    cells.
    """
    touched = np.zeros(cells**3, np.bool_)
    corners = vertices[triangles]  # (T, 3, 3)
    while len(corners):
        first = np.floor(corners.min(axis=1) - _SLACK)
        wide = (np.floor(corners.max(axis=1) + _SLACK) - first > 1.0).any(axis=1)
        _touch(touched, corners[~wide], first[~wide], cells)
        corners = corners[wide]
        sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)  # (T, 3)
        every, longest = np.arange(len(corners)), sides.argmax(axis=1)
        after = (longest + 1) % 3
        middle = (corners[every, longest] + corners[every, after]) / 2.0
        halves = corners.copy(), corners.copy()
        halves[0][every, longest], halves[1][every, after] = middle, middle
        corners = np.concatenate(halves)
    return touched


def _touch(touched, corners, first, cells):
    """Set which of the eight cells from `first` on the planes of small triangles meet."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    reach = np.abs(normals).sum(axis=1) * (0.5 + _SLACK)
    for offset in np.ndindex(2, 2, 2):
        cell = first + offset
        away = np.einsum("ij,ij->i", normals, cell + 0.5 - corners[:, 0])
        place = np.clip(cell[np.abs(away) <= reach], 0, cells - 1).astype(np.int64)
        touched[np.ravel_multi_index(tuple(place.T), (cells,) * 3)] = True
