"""Volumes that protect or remove the splats whose centres they hold.

Whether a point lies in a closed mesh is decided by the triangles that a ray upward from it crosses.
Each counts 1 or -1, by the side it is crossed from; the sum is the winding number, 0 outside. In a
mesh with triangles that face another way than their neighbours, an odd number is inside. Points are
divided into groups, and one ray decides for a group if no triangle touches its box.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .affine import is_flat, moved, scales_of
from .errors import RefineError

Role = Literal["protect", "remove", "keep"]
Mask: TypeAlias = "NDArray[np.bool_] | None"
"""Some of N splats, (N,); None stands for none of them."""

_LEAF = 1 << 14  # pairs of point and triangle below which a group is not divided further


class Volume(Protocol):
    """A part of space."""

    def inside(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """Which points, (N, 3), lie inside, (N,) bool; those that are not finite do not."""
        ...


@dataclass(frozen=True)
class Box:
    """A box along the axes, without its upper faces, so boxes side by side share no point.

    Attributes
    ----------
    low, high : three float, the lower and the upper corner; may be infinite
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]

    def __post_init__(self) -> None:
        for axis, low, high in zip("xyz", self.low, self.high, strict=True):
            if not low < high:
                raise RefineError(
                    f"box goes from {low:g} to {high:g} in {axis}, expected a larger number last"
                )

    def inside(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """See `Volume.inside`."""
        between = ((points >= self.low) & (points < self.high)).all(axis=1)
        return np.asarray(between & np.isfinite(points).all(axis=1))


@dataclass(frozen=True)
class Sphere:
    """A sphere with its surface; `center` and `radius` are finite, in the frame of the points."""

    center: tuple[float, float, float]
    radius: float

    def __post_init__(self) -> None:
        if not np.isfinite([*self.center, self.radius]).all():
            raise RefineError(
                f"sphere at {self.center} has radius {self.radius}, expected finite numbers"
            )
        if self.radius <= 0.0:
            raise RefineError(f"sphere has radius {self.radius:g}, expected more than 0")

    def inside(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """See `Volume.inside`."""
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            away = (points - np.asarray(self.center, np.float64)) / self.radius
            return np.asarray(np.einsum("ij,ij->i", away, away) <= 1.0)


class Solid:
    """The inside of a closed mesh.

    Like `Box`, but for rounding, it holds the lower parts of its surface and not the upper ones, so
    solids side by side share no point. Overlapping parts are joined; if the faces of one point
    inward, the overlap is outside, as in a hollow sphere.

    Attributes
    ----------
    vertices : (V, 3) float64, without duplicates
    triangles : (T, 3) int64, rows of vertices, three different ones each
    turned : bool, whether all triangles face the same way as their neighbours

    Raises
    ------
    RefineError : if there are no faces, a vertex is not finite, or the mesh is not closed
    """

    def __init__(self, vertices: NDArray[Any], triangles: NDArray[Any]) -> None:
        vertices = np.asarray(vertices, np.float64).reshape(-1, 3) + 0.0  # -0 equals 0
        triangles = np.asarray(triangles, np.int64).reshape(-1, 3)
        if not len(triangles):
            raise RefineError("has no faces, expected a closed mesh")
        if not np.isfinite(vertices).all():
            raise RefineError("has a vertex that is not finite, expected a closed mesh")
        vertices, joined = np.unique(vertices, axis=0, return_inverse=True)
        triangles = joined.reshape(-1)[triangles]
        a, b, c = triangles.T
        triangles = triangles[(a != b) & (b != c) & (c != a)]
        start, end = triangles.reshape(-1), np.roll(triangles, -1, axis=1).reshape(-1)
        names = np.minimum(start, end) * len(vertices) + np.maximum(start, end)
        edge = np.unique(names, return_inverse=True)[1].reshape(-1)
        open_edges = np.count_nonzero(np.bincount(edge) % 2)
        if open_edges or not len(triangles):
            raise RefineError(
                f"is not closed: {open_edges} of its edges belong to an odd number of faces; fill "
                "the holes, or add a Remesh modifier"
            )
        self.vertices, self.triangles = vertices, triangles
        self.turned = not np.bincount(edge, np.where(start < end, 1.0, -1.0)).any()

    def inside(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """See `Volume.inside`."""
        inside = np.zeros(len(points), np.bool_)
        corners = self.vertices.T[:, self.triangles]
        low, high = corners.min(axis=2), corners.max(axis=2)  # (3, T) each
        within = (points >= low.min(axis=1)) & (points < high.max(axis=1))
        rows = np.flatnonzero(within.all(axis=1))
        places = np.array(points[rows].T, np.float64, order="C")  # (3, n)
        turns = np.zeros(len(rows))
        waiting = [(np.arange(len(rows)), np.arange(corners.shape[1]))] if len(rows) else []
        while waiting:
            group, triangles = waiting.pop()
            of_group, lows, highs = places[:, group], low[:, triangles], high[:, triangles]
            first, last = of_group.min(axis=1), of_group.max(axis=1)
            reach = (lows <= last[:, None]) & (highs >= first[:, None])
            above = reach[0] & reach[1] & (highs[2] >= first[2])
            triangles = triangles[above]
            alike = not reach[2, above].any() or (first == last).all()  # one stands for all
            if len(group) * len(triangles) > _LEAF and len(group) > 1 and not alike:
                axis = int(np.argmax(last - first))
                half = of_group[axis] <= (first + last)[axis] / 2.0
                half &= of_group[axis] < last[axis]
                waiting += [(group[half], triangles), (group[~half], triangles)]
            else:
                some = group[:1] if alike else group
                turns[group] = self._turns(places[:, some], triangles, low, high)
        inside[rows] = turns != 0.0 if self.turned else turns % 2.0 == 1.0
        return inside

    def _turns(self, points, triangles, low, high):
        """Signed crossings of a ray upward from each point, (3, n); unsigned if not `turned`."""
        # Both triangles of an edge take its vertices in one order, and rays through a vertex count
        # the edges that begin there: no ray slips between two triangles or hits both.
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
        """X and z, (C,), of the points with y `height`, (C,), on edges between vertices, (C,)."""
        first, last = np.minimum(one, other), np.maximum(one, other)
        x, y, z = self.vertices.T
        share = (height - y[first]) / (y[last] - y[first])
        cut = x[first] + share * (x[last] - x[first])
        # Not beyond the edge's ends, as the boxes of triangles are made of these.
        cut = np.clip(cut, np.minimum(x[first], x[last]), np.maximum(x[first], x[last]))
        return cut, z[first] + share * (z[last] - z[first])


@dataclass(frozen=True, eq=False)
class MovedVolume:
    """A volume moved by a matrix, (4, 4), from its frame to that of the points."""

    volume: Volume
    matrix: NDArray[np.float64]

    def __post_init__(self) -> None:
        if is_flat(self.matrix):
            scales = scales_of(self.matrix).round(9).tolist()
            raise RefineError(f"is flat (scales {scales}), expected a volume")

    def inside(self, points: NDArray[Any]) -> NDArray[np.bool_]:
        """See `Volume.inside`."""
        return self.volume.inside(moved(points, np.linalg.inv(self.matrix)))


def parse(text: str) -> Volume | None:
    """The volume that a text describes by numbers; None if it is a name; or `RefineError`.

    >>> parse("sphere:0,0,1.5,2"), parse("box:0,0,0,1,1,inf").high
    (Sphere(center=(0.0, 0.0, 1.5), radius=2.0), (1.0, 1.0, inf))
    """
    kind, colon, rest = text.partition(":")
    if not colon or kind not in _FORMS:
        return None
    try:
        numbers: Any = tuple(map(float, rest.split(",")))
    except ValueError:
        numbers = ()
    if len(numbers) != len(_FORMS[kind].split(",")):
        raise RefineError(f"expected {kind}:{_FORMS[kind]} in numbers, got '{text}'")
    try:
        return Box(numbers[:3], numbers[3:]) if kind == "box" else Sphere(numbers[:3], numbers[3])
    except RefineError as error:
        raise RefineError(f"'{text}': {error}") from error


_FORMS = {"box": "x0,y0,z0,x1,y1,z1", "sphere": "x,y,z,radius"}


@dataclass(frozen=True, eq=False)
class Zone:
    """A volume and what becomes of the splats in it.

    Attributes
    ----------
    role : "protect", "remove", or "keep", which removes those in no volume of this role
    name : str, of the volume, for messages and the report
    volume : Volume, in the frame of the views
    idle : bool, whether it may hold no splat, such as after an earlier prune
    """

    role: Role
    name: str
    volume: Volume
    idle: bool = False


class Forced(NamedTuple):
    """Which of N splats volumes, or the user otherwise, protect and remove."""

    protected: Mask = None
    removed: Mask = None  # none of the protected ones
    facts: tuple[dict[str, Any], ...] = ()  # ``role``, ``name``, ``splats`` of each volume

    @property
    def masks(self) -> dict[str, Any]:
        """``protected`` and ``removed``, as arguments of what decides."""
        return {"protected": self.protected, "removed": self.removed}

    def counts(self) -> dict[str, int]:
        """How many splats are ``protected`` and how many were ``removed_by_user``."""
        masks = {"protected": self.protected, "removed_by_user": self.removed}
        return {n: 0 if m is None else int(np.count_nonzero(m)) for n, m in masks.items()}

    def of(self, rows: NDArray[np.bool_]) -> Forced:
        """The same for the splats in `rows`, (N,) bool."""
        masks: dict[str, Any] = {n: None if m is None else m[rows] for n, m in self.masks.items()}
        return self._replace(**masks)


def forced(
    zones: Sequence[Zone], means: NDArray[Any], protected: Mask = None, removed: Mask = None
) -> Forced:
    """Which splats volumes protect and remove, by their centres.

    Parameters
    ----------
    zones : sequence of Zone
    means : (N, 3), centres in the frame of the volumes
    protected, removed : (N,) bool, optional; splats that are so whatever the volumes

    Raises
    ------
    RefineError : if a volume that is not `Zone.idle` holds no centre, or all splats are removed
    """
    inside = [(zone, zone.volume.inside(means)) for zone in zones]
    for zone, mask in inside:
        if not zone.idle and not mask.any():
            raise RefineError(f"{zone.name} holds the centre of no splat ({_extent(means)})")
    facts = tuple(
        {"role": zone.role, "name": zone.name, "splats": int(np.count_nonzero(mask))}
        for zone, mask in inside
    )
    protect, remove, keep = (
        any_of(*(mask for zone, mask in inside if zone.role == role))
        for role in ("protect", "remove", "keep")
    )
    protected = any_of(protected, protect)
    removed = any_of(removed, remove, None if keep is None else ~keep)
    return Forced(protected, must_go(removed, protected), facts)


def any_of(*masks: Mask) -> Mask:
    """Splats in any mask, (N,) bool; None if all are None."""
    given = [mask for mask in masks if mask is not None]
    return np.asarray(np.any(given, axis=0)) if given else None


def must_go(removed: Mask, protected: Mask = None) -> Mask:
    """Splats that are removed and not protected, (N,) bool; None if none, `RefineError` if all."""
    gone = removed if protected is None or removed is None else removed & ~protected
    if gone is None or not gone.any():
        return None
    if gone.all():
        raise RefineError(f"all {len(gone)} splats lie where they must go; nothing was removed")
    return gone


def _extent(means: NDArray[Any]) -> str:
    finite = means[np.isfinite(means).all(axis=1)]
    if not len(finite):
        return "there is none with a finite centre"
    low, high = (",".join(f"{x:g}" for x in ends(finite, axis=0)) for ends in (np.min, np.max))
    return f"they lie from {low} to {high}"
