"""Splats selected by hand: visible ones by area, place and colour; selections painted and grown.

A splat is visible if its centre is not behind a surface, which is where a ray from the view has
lost all but `LIGHT_LEFT` of its light.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .cleaning.search import connected, touching
from .execute import Progress, silent
from .merging.graph import nearest
from .splats import Splats
from .views import View, ViewSet
from .visibility import projection
from .visibility.cast import cast, cast_visible
from .visibility.projection import Footprints, Gaussians
from .visibility.scene import Scene

LIGHT_LEFT = 0.1
"""Transmittance of a ray at a surface. Splats in front of the depth where it is 0.5 make up a third
of the picture; at 0.1 these are two thirds, and with `THICKNESS` four fifths."""

THICKNESS = 2.0  # a splat's standard deviations behind a surface up to which it is visible
RAYS = 25_000  # about how many rays find surfaces
LEAST_STEP = 4  # pixels between two of these rays, at least
_EMPTY = 0.1  # a ray with less alpha in all hits nothing

Mode = Literal["SET", "ADD", "SUBTRACT", "INTERSECT"]
"""How chosen splats change a selection."""

NEIGHBOURS = 8  # nearest splats by which a selection grows and shrinks


class Surface(NamedTuple):
    """The surface under a pixel."""

    place: NDArray[np.float64]  # (3,), in the splats' frame, with half of the pixel before it
    color: NDArray[np.float64]  # (3,), of constant harmonics, display-referred
    scale: float  # pixels of a length of 1 there


class Prepared(NamedTuple):
    """Splats prepared for any view."""

    splats: Splats
    gaussians: Gaussians
    scene: Scene


class Sight(NamedTuple):
    """N splats in a view."""

    prepared: Prepared
    view: View
    footprints: Footprints  # front to back
    centered: Gaussians  # the n whose centres lie in the image
    pixels: NDArray[np.int64]  # (2, n), column and row of each centre
    visible: NDArray[np.bool_]  # (n,), see the top of this file

    def in_area(self, area: NDArray[np.bool_], *, hidden: bool = False) -> NDArray[np.bool_]:
        """Splats, (N,) bool, visible or also `hidden`, with centres in an area, (H, W) bool."""
        return self._of(area[self.pixels[1], self.pixels[0]], hidden)

    def in_ball(
        self, center: NDArray[np.float64], radius: float, *, hidden: bool = False
    ) -> NDArray[np.bool_]:
        """Splats in the image with centres in a ball, (N,) bool; `center`, (3,), in their frame."""
        away = self.prepared.splats.means[self.centered.index] - center
        return self._of(np.einsum("ij,ij->i", away, away) <= radius * radius, hidden)

    def of_color(
        self, color: NDArray[np.float64], tolerance: float, *, hidden: bool = False
    ) -> NDArray[np.bool_]:
        """Splats in the image of a red, green and blue, within `tolerance`, all 0..1, (N,) bool."""
        colors = np.minimum(self.centered.colors, 1.0)
        return self._of(np.abs(colors - color).max(axis=1) <= tolerance, hidden)

    def piece(self, chosen: NDArray[np.bool_], place: NDArray[np.float64]) -> NDArray[np.bool_]:
        """The largest piece near a place, (3,), of chosen splats, (N,) bool, as such a mask.

        Splats of a piece touch, directly or by others, of which only neighbours are compared. A
        piece is near if it has one of the `NEIGHBOURS` chosen splats that are nearest to the place.
        """
        gaussians = self.prepared.gaussians
        picked = gaussians.take(np.flatnonzero(chosen[gaussians.index]))
        rows, mask = picked.index, np.zeros_like(chosen)
        if len(rows):
            near, touch = touching(picked, np.arange(len(rows)))
            one, link = np.nonzero(touch)
            parts = connected(len(rows), one, near[one, link])
            away = self.prepared.splats.means[rows] - place
            around = parts[np.argsort(np.einsum("ij,ij->i", away, away))[:NEIGHBOURS]]
            mask[rows[parts == around[np.argmax(np.bincount(parts)[around])]]] = True
        return mask

    def surface(self, column: int, row: int) -> Surface | None:
        """The surface under a pixel; None where a ray hits less than an alpha of `_EMPTY`."""
        rays = cast(self.footprints, np.array([column]), np.array([row]))
        shown = np.cumsum(rays.weights(), dtype=np.float64)  # up to each hit, of the picture
        if not len(shown) or shown[-1] < _EMPTY:
            return None
        gaussians = self.prepared.gaussians.take(rays.hit)
        color = rays.colors(np.minimum(gaussians.colors.T, np.float32(1.0)))[:, 0] / shown[-1]
        middle = rays.owner[np.searchsorted(shown, shown[-1] / 2.0)]
        center = self.prepared.splats.means[gaussians.index[middle]].astype(np.float64)
        view = self.view
        depth = float((view.rotation @ (center - view.center))[2])
        ray = ((column + 0.5 - view.cx) / view.fx, (row + 0.5 - view.cy) / view.fy, 1.0)
        place = view.center + view.rotation.T @ ray * depth
        return Surface(place, color, view.fx / depth)

    def _of(self, chosen, hidden):
        mask = np.zeros(len(self.prepared.splats), np.bool_)
        mask[self.centered.index[chosen if hidden else chosen & self.visible]] = True
        return mask


def prepare(splats: Splats, view: View) -> Prepared:
    """Prepare splats for `look`; `view` is one of the views to come, which set the scene's size."""
    return Prepared(splats, *projection.prepare(splats, ViewSet((view,)))[:2])


def look(prepared: Prepared, view: View) -> Sight:
    """Find where the splats lie in a view, and which are visible."""
    gaussians, scene = prepared.gaussians, prepared.scene
    with np.errstate(under="ignore"):
        footprints = projection.project(gaussians, scene, view)
        depths = projection.coordinates(gaussians.means, scene, view)[2]
        step = max(LEAST_STEP, math.ceil(math.sqrt(view.width * view.height / RAYS)))
        ends = surfaces(footprints, depths, view, step)
        pixels = np.floor(footprints.centers).astype(np.int64)
        within = ((pixels >= 0) & (pixels < [[view.width], [view.height]])).all(axis=0)
        shown = np.flatnonzero(footprints.inside & within)
        pixels, rows = pixels[:, shown], footprints.index[shown]
        centered = gaussians.take(rows)
        _, covariances = projection.in_camera(centered, scene, view)
    thick = THICKNESS * np.sqrt(np.maximum(covariances[5], 0.0))
    visible = depths[rows] <= ends[pixels[1] // step, pixels[0] // step] + thick
    return Sight(prepared, view, footprints, centered, pixels, visible)


def surfaces(
    footprints: Footprints, depths: NDArray[np.float32], view: View, step: int
) -> NDArray[np.float32]:
    """Depths of surfaces along the view's axis, (rows, columns) float32, infinite without one.

    One ray for each cell of `step` pixels, whose surface is the first hit that leaves at most
    `LIGHT_LEFT`. `depths`, (M,), are those of the centres of all Gaussians.
    """
    columns, rows = (
        np.minimum(np.arange(0, size, step) + step // 2, size - 1)
        for size in (view.width, view.height)
    )
    rays, before = cast_visible(footprints, columns, rows)
    ends = np.full(rays.count, np.inf, np.float32)
    dark = np.flatnonzero(before * (1.0 - rays.alpha) < LIGHT_LEFT)
    ended, first = np.unique(rays.ray[dark], return_index=True)
    ends[ended] = depths[rays.hit[rays.owner[dark[first]]]]
    return ends.reshape(len(rows), len(columns))


def combined(before: NDArray[np.bool_], chosen: NDArray[np.bool_], mode: Mode) -> NDArray[np.bool_]:
    """A selection, (N,) bool, changed by chosen splats, (N,) bool."""
    both = before & chosen
    return {"ADD": before | chosen, "SUBTRACT": before ^ both, "INTERSECT": both}.get(mode, chosen)


def polygon(corners: Sequence[tuple[float, float]], width: int, height: int) -> NDArray[np.bool_]:
    """Pixels with centres in a polygon, (height, width) bool, by the even-odd rule.

    Corners are (column, row) in pixels, with the origin at the image's upper left.

    >>> polygon([(1, 0), (3, 0), (3, 2), (1, 2)], 4, 3).astype(int).tolist()
    [[0, 1, 1, 0], [0, 1, 1, 0], [0, 0, 0, 0]]
    """
    # Each edge turns all pixels to the right of it, row by row: one change a row, summed later.
    turns = np.zeros((height, width + 1), np.uint8)
    ends = np.asarray(corners, np.float64).reshape(-1, 2)
    for (x, y), (u, v) in zip(ends, np.roll(ends, -1, axis=0), strict=True):
        first, last = (min(max(math.ceil(end - 0.5), 0), height) for end in sorted((y, v)))
        if first < last:
            rows = np.arange(first, last)
            crossing = x + (rows + 0.5 - y) * ((u - x) / (v - y))
            columns = np.ceil(crossing - 0.5).clip(0, width).astype(np.int64)
            turns[rows, columns] ^= 1
    return np.bitwise_xor.accumulate(turns[:, :-1], axis=1).astype(np.bool_)


def paint(
    area: NDArray[np.bool_], start: tuple[float, float], end: tuple[float, float], radius: float
) -> None:
    """Add to an area, (H, W), in place, the pixels that a round brush covers on its way."""
    (left, right), (top, bottom) = (
        (max(math.floor(min(ends) - radius), 0), min(math.ceil(max(ends) + radius) + 1, size))
        for ends, size in zip(zip(start, end, strict=True), area.shape[::-1], strict=True)
    )
    if left >= right or top >= bottom:
        return
    across = np.arange(left, right) + 0.5 - start[0]  # from the start, pixels
    down = (np.arange(top, bottom) + 0.5 - start[1])[:, None]
    way = end[0] - start[0], end[1] - start[1]
    length = way[0] ** 2 + way[1] ** 2
    along = ((across * way[0] + down * way[1]) / length).clip(0.0, 1.0) if length else 0.0
    squared = (across - along * way[0]) ** 2 + (down - along * way[1]) ** 2
    area[top:bottom, left:right] |= squared <= radius * radius


def grown(neighbours: NDArray[np.int32], selected: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A selection, (N,) bool, and its neighbours, in either direction of `neighbours`, (N, K)."""
    more: NDArray[np.bool_] = selected | selected[neighbours].any(axis=1)
    more[neighbours[selected].ravel()] = True
    return more


def shrunk(neighbours: NDArray[np.int32], selected: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A selection, (N,) bool, without the splats that have a neighbour outside it."""
    return ~grown(neighbours, ~selected)


def neighbours_of(means: NDArray[Any], *, progress: Progress = silent) -> NDArray[np.int32]:
    """Rows of the `NEIGHBOURS` nearest centres of each, (N, K); meaningless for non-finite ones."""
    places = np.asarray(means, np.float64)
    finite = np.isfinite(places).all(axis=1)
    if not finite.any():
        return np.empty((len(places), 0), np.int32)
    middle = np.median(places[finite], axis=0)
    extent = np.median(np.abs(places[finite] - middle).max(axis=1)) or 1.0
    places = np.where(finite[:, None], (places - middle) / extent, 0.0)
    return nearest(places, NEIGHBOURS, progress=progress)
