"""What one view shows of splats, and which of them areas of the picture, places and colours take.

A splat is visible unless it lies behind a surface: behind the depth at which a ray has lost all but
`LIGHT_LEFT` of its light. A splat lies where its centre does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .splats import Splats
from .views import View, ViewSet
from .visibility import projection
from .visibility.cast import hits
from .visibility.projection import Footprints, Gaussians
from .visibility.rays import in_front
from .visibility.scene import Scene

LIGHT_LEFT = 0.1
"""Transmittance at whose depth a surface ends. Surfaces are made of several layers of splats: those
in front of where it is 0.5 make up a third of the picture, where it is 0.1 two thirds, and with
`THICKNESS` four fifths."""

THICKNESS = 2.0
"""So many standard deviations, along the view's axis, a visible splat may lie behind that depth."""

RAYS = 25_000
"""About how many rays find surfaces."""

LEAST_STEP = 4
"""Pixels between two of these rays, at least."""

FAR = 1000.0
"""Extents of the splats from which a view without perspective is looked at instead."""

_EMPTY = 0.1  # alpha of all that a ray hits, below which it meets nothing
_PAIRS = 1 << 17  # see `hits`


class Surface(NamedTuple):
    """What lies under a pixel.

    Attributes
    ----------
    place : (3,) float64
        Where half of what the pixel shows lies in front; in the frame of the view.
    color : (3,) float64
        Blended from the splats' constant colours, display-referred.
    scale : float
        Pixels that a length of 1 takes there.
    """

    place: NDArray[np.float64]
    color: NDArray[np.float64]
    scale: float


class Prepared(NamedTuple):
    """Splats ready to be looked at from anywhere."""

    splats: Splats
    gaussians: Gaussians
    scene: Scene


@dataclass(frozen=True, eq=False)
class Sight:
    """What a view shows of N splats.

    Attributes
    ----------
    prepared : Prepared
    view : View
    footprints : Footprints
        Front to back.
    rows : (n,) int64
        The splats whose centres lie in the image.
    pixels : (2, n) int64
        Column and row of each centre.
    visible : (n,) bool
        See the top of this file.
    """

    prepared: Prepared
    view: View
    footprints: Footprints
    rows: NDArray[np.int64]
    pixels: NDArray[np.int64]
    visible: NDArray[np.bool_]

    def in_area(self, area: NDArray[np.bool_], *, hidden: bool = False) -> NDArray[np.bool_]:
        """Splats whose centre lies in an area of the image, (N,) bool.

        Parameters
        ----------
        area : (H, W) bool
            The top row first.
        hidden : bool
            Whether those that are not visible count too.
        """
        return self._of(area[self.pixels[1], self.pixels[0]], hidden)

    def in_ball(
        self, center: NDArray[np.float64], radius: float, *, hidden: bool = False
    ) -> NDArray[np.bool_]:
        """Splats in the image that lie in a ball in space, (N,) bool."""
        away = self.prepared.splats.means[self.rows] - center
        return self._of(np.einsum("ij,ij->i", away, away) <= radius * radius, hidden)

    def of_color(
        self, color: NDArray[np.float64], tolerance: float, *, hidden: bool = False
    ) -> NDArray[np.bool_]:
        """Splats in the image that have nearly a colour, (N,) bool.

        Parameters
        ----------
        color : (3,) float64
            Display-referred.
        tolerance : float
            Greatest difference of red, green or blue.
        hidden : bool
            See `in_area`.
        """
        gaussians = self.prepared.gaussians
        place = np.full(len(self.prepared.splats), -1)
        place[gaussians.index] = np.arange(len(gaussians))
        colors = np.minimum(gaussians.colors[place[self.rows]], 1.0)
        return self._of(np.abs(colors - color).max(axis=1) <= tolerance, hidden)

    def surface(self, column: int, row: int) -> Surface | None:
        """What lies under a pixel, None where there is next to nothing."""
        pieces = list(hits(self.footprints, np.array([column]), np.array([row]), _PAIRS))
        if not pieces:
            return None
        owners, _, alphas = (np.concatenate(arrays) for arrays in zip(*pieces, strict=True))
        left = np.cumprod(1.0 - alphas.astype(np.float64))  # behind each hit
        if not len(left) or left[-1] > 1.0 - _EMPTY:
            return None
        shares = np.concatenate([[1.0], left[:-1]]) * alphas  # of the picture
        shown = np.cumsum(shares)
        middle = int(np.searchsorted(shown, shown[-1] / 2.0))
        gaussians = self.prepared.gaussians.take(self.footprints.index[owners])
        colors = np.minimum(gaussians.colors.astype(np.float64), 1.0)
        center = self.prepared.splats.means[gaussians.index[middle]].astype(np.float64)
        view = self.view
        depth = float((view.rotation @ (center - view.center))[2])
        ray = ((column + 0.5 - view.cx) / view.fx, (row + 0.5 - view.cy) / view.fy, 1.0)
        place = view.center + view.rotation.T @ ray * depth
        return Surface(place, shares @ colors / shown[-1], view.fx / depth)

    def _of(self, chosen, hidden):
        mask = np.zeros(len(self.prepared.splats), np.bool_)
        mask[self.rows[chosen if hidden else chosen & self.visible]] = True
        return mask


def prepare(splats: Splats, view: View) -> Prepared:
    """Splats ready to be looked at; the view is one of those to come."""
    return Prepared(splats, *projection.prepare(splats, ViewSet((view,)))[:2])


def look(prepared: Prepared, view: View) -> Sight:
    """What a view shows of splats."""
    gaussians = prepared.gaussians
    with np.errstate(under="ignore"):
        footprints = projection.project(gaussians, prepared.scene, view)
        centers, covariances = projection.in_camera(
            gaussians.take(footprints.index), prepared.scene, view
        )
        step = max(LEAST_STEP, math.ceil(math.sqrt(view.width * view.height / RAYS)))
        ends = surfaces(footprints, centers[2], view, step)
    columns, rows = np.floor(footprints.centers).astype(np.int64)
    across, down = (columns >= 0) & (columns < view.width), (rows >= 0) & (rows < view.height)
    shown = np.flatnonzero(footprints.inside & across & down)
    thick = THICKNESS * np.sqrt(np.maximum(covariances[5, shown], 0.0))
    end = ends[rows[shown] // step, columns[shown] // step]
    pixels, visible = np.stack([columns[shown], rows[shown]]), centers[2, shown] <= end + thick
    index = gaussians.index[footprints.index[shown]]
    return Sight(prepared, view, footprints, index, pixels, visible)


def surfaces(
    footprints: Footprints, depths: NDArray[np.float32], view: View, step: int
) -> NDArray[np.float32]:
    """Depth of the hit behind which a ray has `LIGHT_LEFT`, infinite where none is.

    Parameters
    ----------
    footprints : Footprints
        Front to back.
    depths : (n,) float32
        Theirs.
    view : View
    step : int
        Pixels of a cell of the image; a ray goes through the middle of each.

    Returns
    -------
    (rows of cells, columns of cells) float32
    """
    columns, rows = (
        np.minimum(np.arange(0, size, step) + step // 2, size - 1)
        for size in (view.width, view.height)
    )
    ends = np.full(len(columns) * len(rows), np.inf, np.float32)
    thickness = np.zeros(len(ends))  # optical, of what rays have met
    limit = -math.log(LIGHT_LEFT)
    pieces = hits(footprints, columns, rows, _PAIRS, lambda _, rays: np.isinf(ends[rays]))
    for owners, rays, alphas in pieces:
        order = np.argsort(rays, kind="stable")  # hits of a ray stay front to back
        ray, thick = rays[order], -np.log1p(-alphas[order].astype(np.float64))
        met, counts = np.unique(ray, return_counts=True)
        behind = in_front(thick, counts) + thick + thickness[ray] if len(met) else thick
        dark = np.flatnonzero(behind > limit)
        ended, first = np.unique(ray[dark], return_index=True)
        ends[ended] = depths[owners[order[dark[first]]]]
        thickness[met] = behind[np.cumsum(counts) - 1]
    return ends.reshape(len(rows), len(columns))


def pinhole(
    matrix: NDArray[Any],
    projection_matrix: NDArray[Any],
    size: tuple[int, int],
    means: NDArray[Any],
) -> View:
    """View of a camera that is given by OpenGL's matrices.

    A camera without perspective is looked at from `FAR` extents of the splats away, where rays are
    parallel but for a thousandth.

    Parameters
    ----------
    matrix : (4, 4) float64
        World to camera: x right, y up, z back; rigid.
    projection_matrix : (4, 4) float64
    size : (int, int)
        Pixels across and up.
    means : (N, 3) floating
        Centres of the splats, in the world.
    """
    flip = np.diag([1.0, -1.0, -1.0])
    axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=1, keepdims=True)  # float32
    rotation = flip @ axes
    center = -rotation.T @ flip @ matrix[:3, 3]
    if projection_matrix[3, 3] == 0.0:
        return view_through(projection_matrix, (rotation, center), size)
    finite, middle, extent = means[np.isfinite(means).all(axis=1)], center, 1.0
    if len(finite):
        middle = np.median(finite, axis=0)
        extent = float(max([*np.ptp(finite, axis=0), 2.0 / projection_matrix[0, 0]]))
    depth = float((rotation @ (middle - center))[2])
    return view_through(projection_matrix, (rotation, center), size, (depth, FAR * extent))


def view_through(
    projection_matrix: NDArray[np.float64],
    pose: tuple[NDArray[np.float64], NDArray[np.float64]],
    size: tuple[int, int],
    parallel: tuple[float, float] = (0.0, 1.0),
) -> View:
    """View of a camera with one of OpenGL's projection matrices.

    Parameters
    ----------
    projection_matrix : (4, 4) float64
    pose : ((3, 3) float64, (3,) float64)
        Rotation and centre of the view.
    size : (int, int)
        Pixels across and up.
    parallel : (float, float)
        Of a camera without perspective: the depth at which pixels have their exact size, along its
        axis, and how far from there the view stands instead.
    """
    p, (width, height), (rotation, center) = projection_matrix, size, pose
    fx, fy = p[0, 0] * width / 2.0, p[1, 1] * height / 2.0
    # What shifts the image stands in the third column of a matrix with perspective, else in the
    # fourth.
    cx = (1.0 - p[0, 2] + p[0, 3]) * width / 2.0
    cy = (1.0 + p[1, 2] - p[1, 3]) * height / 2.0
    if p[3, 3] == 0.0:
        near = max(float(p[2, 3] / (p[2, 2] - 1.0)), 0.0)
        return View(rotation, center, fx, fy, cx, cy, width, height, near)
    depth, away = parallel
    center = center + rotation[2] * (depth - away)
    near = float((p[2, 3] + 1.0) / p[2, 2])  # along the axis, from the camera; may be behind it
    near = max(near - depth + away, 0.0)
    return View(rotation, center, fx * away, fy * away, cx, cy, width, height, near)
