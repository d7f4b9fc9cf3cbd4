"""Splats as the reference renderer projects and colours them: prepared scenes, footprints.

The rules are those of `rasterizer`; the frame is OpenCV's.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from refine_addon.core.splats import Splats, drawable, opacity, rotation_matrices
from refine_addon.core.views import View

LOW_PASS = 0.3
"""Variance added to every footprint so that it is not thinner than a pixel, pixels squared."""
ALPHA_CUT = 1.0 / 255.0
FIELD_OF_VIEW_CLAMP = 1.3

DISC_FILTER = 2.0
"""Of discs (2DGS): the squared distance in pixels from the centre counts times this, at least."""

# Columns of Footprints.table; of discs, there follow the 9 of their homography and the near plane.
U, V, A, B, C, DETERMINANT, LIMIT, OPACITY, RED, COLUMNS = 0, 1, 2, 3, 4, 5, 6, 7, 8, 11
NEAR = COLUMNS + 9


class Gaussians(NamedTuple):
    """N splats as the renderer wants them; `gaussians` makes one from plain arrays.

    - means, (N, 3) float64: Centres, world units.
    - covariances, (N, 6) float64: xx, xy, xz, yy, yz, zz of the world covariance, world units
      squared.
    - opacities, (N,) float64: 0 to 1; 0 is never drawn, whatever the other values.
    - harmonics, (N, (degree + 1)^2, 3) float32: Spherical-harmonics coefficients of red, green,
      blue.
    - antialiased: Whether opacities fall where the low-pass widens footprints.
    - tangents, (N, 3, 2) float64: Of discs (2DGS): their two axes as columns, as long as a standard
      deviation, world units; of others (0, 3, 2).
    """

    means: NDArray[np.float64]
    covariances: NDArray[np.float64]
    opacities: NDArray[np.float64]
    harmonics: NDArray[np.float32]
    antialiased: bool
    tangents: NDArray[np.float64]


class Camera(NamedTuple):
    """The numbers of a pinhole camera (see `refine_addon.core.views.View`), for compiled code."""

    rotation: NDArray[np.float64]
    center: NDArray[np.float64]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


class Footprints(NamedTuple):
    """The M splats that may touch the image, front to back.

    - index, (M,) int64: Which splat it is.
    - table, (M, 11) float64: u, v: centre, pixels; a, b, c: inverse covariance, 1 / px^2;
      determinant of the covariance, px^4; largest squared Mahalanobis distance drawn; opacity; red,
      green, blue. Of discs (M, 21): see `_project_disc`.
    - boxes, (M, 4) int32: First and last pixel column, first and last pixel row, clipped to the
      image.
    """

    index: NDArray[np.int64]
    table: NDArray[np.float64]
    boxes: NDArray[np.int32]


def gaussians(
    means: ArrayLike,
    scales: ArrayLike,
    quaternions: ArrayLike,
    opacities: ArrayLike,
    harmonics: ArrayLike,
    *,
    model: str = "default",
) -> Gaussians:
    """Prepare plain arrays for rendering; once for any number of views.

    - means, (N, 3) floating: Centres, world units.
    - scales, (N, 3) floating: Standard deviations along the splat's axes, world units.
    - quaternions, (N, 4) floating: w x y z, of any length.
    - opacities, (N,) floating: 0 to 1.
    - harmonics, (N, K, 3) floating: K = (degree + 1)^2 coefficients of each channel, degree 0 to 4.
    - model, {"default", "antialiased", "2dgs"}

    - ValueError: if the shapes do not belong together.
    """
    means, scales, opacities = (
        np.ascontiguousarray(a, np.float64) for a in (means, scales, opacities)
    )
    harmonics = np.ascontiguousarray(harmonics, np.float32)
    count = len(means)
    shapes = means.shape, scales.shape, np.shape(quaternions), opacities.shape
    if shapes != ((count, 3), (count, 3), (count, 4), (count,)):
        raise ValueError(f"expected shapes (N, 3), (N, 3), (N, 4), (N,), got {shapes}")
    if harmonics.shape not in [(count, k * k, 3) for k in range(1, 6)]:
        raise ValueError(
            f"expected harmonics ({count}, 1, 4, 9, 16 or 25, 3), got {harmonics.shape}"
        )
    axes = rotation_matrices(np.asarray(quaternions)) * scales[:, None, :]
    matrices = axes @ np.swapaxes(axes, 1, 2)
    rows, columns = np.triu_indices(3)
    upper = np.ascontiguousarray(matrices[:, rows, columns])
    tangents = np.ascontiguousarray(axes[: count if model == "2dgs" else 0, :, :2])
    return Gaussians(means, upper, opacities, harmonics, model == "antialiased", tangents)


def gaussians_of(splats: Splats) -> Gaussians:
    """Activate `splats` for rendering; those that no renderer can draw become transparent."""
    good = drawable(splats)
    # What is not drawn is made harmless first: the rest would overflow on the way to nothing.
    scales = np.exp(np.where(good[:, None], splats.log_scales, 0.0).astype(np.float64))
    opacities = np.where(good, opacity(splats.opacity_logits), 0.0)
    harmonics = np.concatenate([splats.sh_dc[:, None, :], splats.sh_rest], axis=1)
    harmonics[~good] = 0.0
    return gaussians(
        splats.means, scales, splats.quaternions, opacities, harmonics, model=splats.model
    )


def camera_of(view: View) -> Camera:
    """Take the camera out of a view; its clip distances and weight mean nothing here."""
    return Camera(
        np.ascontiguousarray(view.rotation, np.float64),
        np.ascontiguousarray(view.center, np.float64),
        float(view.fx),
        float(view.fy),
        float(view.cx),
        float(view.cy),
        int(view.width),
        int(view.height),
    )


def footprints_of(scene: Gaussians, camera: Camera, near: float) -> Footprints:
    """Project every splat; keep those that may touch the image, in depth order."""
    depths, table, boxes = _project(scene, camera, near)
    visible = np.flatnonzero(np.isfinite(depths))
    index = visible[np.argsort(depths[visible], kind="stable")]
    ordered = table[index]
    _shade(scene, camera, index, ordered)
    return Footprints(index, ordered, boxes[index])


@numba.njit(cache=True, parallel=True)
def _project(
    scene: Gaussians, camera: Camera, near: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int32]]:
    """Return depth (infinite where not drawn), uncoloured `table` and `boxes` of every splat."""
    count = len(scene.means)
    depths = np.full(count, np.inf)
    discs = len(scene.tangents) > 0
    table = np.empty((count, NEAR + 1 if discs else COLUMNS))
    boxes = np.empty((count, 4), np.int32)
    for i in numba.prange(count):
        if scene.opacities[i] >= ALPHA_CUT:
            x, y, z = to_camera(camera, scene.means[i])
            out = table[i], boxes[i]
            if z <= near:
                continue
            if discs:
                drawn = _project_disc(scene, i, camera, near, out)
            else:
                drawn = _project_one(scene, i, camera, (x, y, z), out)
            if drawn:
                depths[i] = z
    return depths, table, boxes


@numba.njit(cache=True)
def to_camera(camera: Camera, point: NDArray[np.float64]) -> tuple[float, float, float]:
    """Transform a point of the world, (3,), to the camera's frame."""
    r = camera.rotation
    x, y, z = point[0] - camera.center[0], point[1] - camera.center[1], point[2] - camera.center[2]
    return (
        r[0, 0] * x + r[0, 1] * y + r[0, 2] * z,
        r[1, 0] * x + r[1, 1] * y + r[1, 2] * z,
        r[2, 0] * x + r[2, 1] * y + r[2, 2] * z,
    )


@numba.njit(cache=True)
def _project_one(
    scene: Gaussians,
    i: int,
    camera: Camera,
    local: tuple[float, float, float],
    out: tuple[NDArray[np.float64], NDArray[np.int32]],
) -> bool:
    """Fill the row of `table` and `boxes` of splat `i`; return whether it may touch the image."""
    x, y, z = local
    row, box = out
    xx, xy, yy = _footprint_covariance(scene.covariances[i], camera, x / z, y / z, z)
    u = camera.fx * x / z + camera.cx
    v = camera.fy * y / z + camera.cy
    determinant = xx * yy - xy * xy
    if not (determinant > 0.0 and np.isfinite(determinant) and np.isfinite(u + v)):
        return False
    opacity = scene.opacities[i]
    if scene.antialiased:
        sharp = (xx - LOW_PASS) * (yy - LOW_PASS) - xy * xy
        opacity *= math.sqrt(max(sharp, 0.0) / determinant)
        if opacity < ALPHA_CUT:
            return False
    # opacity exp(-q / 2) = 1 / 255; the margin only keeps rounding from losing an edge pixel.
    limit = 2.0 * math.log(opacity / ALPHA_CUT) + 1e-9
    reach_x, reach_y = math.sqrt(limit * xx), math.sqrt(limit * yy)
    box[0], box[1] = _pixels_within(u - reach_x, u + reach_x, camera.width)
    box[2], box[3] = _pixels_within(v - reach_y, v + reach_y, camera.height)
    row[U], row[V] = u, v
    row[A], row[B], row[C] = yy / determinant, -xy / determinant, xx / determinant
    row[DETERMINANT], row[LIMIT] = determinant, limit
    row[OPACITY] = opacity
    return box[0] <= box[1] and box[2] <= box[3]


@numba.njit(cache=True)
def _project_disc(
    scene: Gaussians,
    i: int,
    camera: Camera,
    near: float,
    out: tuple[NDArray[np.float64], NDArray[np.int32]],
) -> bool:
    """Fill the row of `table` and `boxes` of disc `i`; return whether it may touch the image.

    The point (u, v) of a disc, in standard deviations along its axes, is seen at the pixel
    ``M (u, v, 1)``, up to a factor: M is the camera's matrix times the columns t_u, t_v and p in
    camera coordinates (Huang et al. 2024, Eq. 6 and 7). The row keeps M, row by row, and `near`.
    """
    row, box = out
    matrix = np.empty((3, 3))
    for column in range(3):
        mean = column == 2
        point = scene.means[i] if mean else scene.tangents[i, :, column] + camera.center
        x, y, z = to_camera(camera, point)
        matrix[0, column] = camera.fx * x + camera.cx * z
        matrix[1, column] = camera.fy * y + camera.cy * z
        matrix[2, column] = z
    row[COLUMNS:NEAR] = matrix.ravel()
    row[NEAR] = near
    row[U], row[V] = matrix[0, 2] / matrix[2, 2], matrix[1, 2] / matrix[2, 2]
    row[OPACITY] = scene.opacities[i]
    row[LIMIT] = 2.0 * math.log(scene.opacities[i] / ALPHA_CUT) + 1e-9
    # A square around the disc, seen whole, has it in the box of its corners.
    reach = math.sqrt(row[LIMIT])
    blob = math.sqrt(row[LIMIT] / DISC_FILTER)
    low_x, high_x, low_y, high_y = row[U] - blob, row[U] + blob, row[V] - blob, row[V] + blob
    for corner in range(4):
        u = reach if corner % 2 else -reach
        v = reach if corner // 2 else -reach
        seen = matrix[:, 0] * u + matrix[:, 1] * v + matrix[:, 2]
        if seen[2] < 1e-3 * matrix[2, 2]:
            low_x, low_y, high_x, high_y = 0.0, 0.0, 1.0 * camera.width, 1.0 * camera.height
            break
        low_x, high_x = min(low_x, seen[0] / seen[2]), max(high_x, seen[0] / seen[2])
        low_y, high_y = min(low_y, seen[1] / seen[2]), max(high_y, seen[1] / seen[2])
    if not np.isfinite(low_x + high_x + low_y + high_y):
        return False
    box[0], box[1] = _pixels_within(low_x, high_x, camera.width)
    box[2], box[3] = _pixels_within(low_y, high_y, camera.height)
    return box[0] <= box[1] and box[2] <= box[3]


@numba.njit(cache=True)
def disc_distance(row: NDArray[np.float64], x: float, y: float) -> float:
    """Return the squared distance of a ray to the centre of a disc, in standard deviations.

    The pixel (x, y) is where two planes meet, ``x M_3 - M_1`` and ``y M_3 - M_2`` on the disc, M_k
    the rows of M; they cross where their cross product points (Huang et al. 2024, Eq. 9 and 10).
    It is at most `DISC_FILTER` times the squared distance in pixels (Eq. 11). Where the ray hits
    nearer than the near plane, nothing is drawn: infinite.
    """
    m = row[COLUMNS:NEAR]
    a, b, c = x * m[6] - m[0], x * m[7] - m[1], x * m[8] - m[2]
    d, e, f = y * m[6] - m[3], y * m[7] - m[4], y * m[8] - m[5]
    p, q, r = b * f - c * e, c * d - a * f, a * e - b * d
    blob = DISC_FILTER * ((x - row[U]) ** 2 + (y - row[V]) ** 2)
    if r == 0.0:
        return blob
    u, v = p / r, q / r
    square = u * u + v * v
    if square > blob:
        return blob
    if m[6] * u + m[7] * v + m[8] < row[NEAR]:
        return np.inf
    return square


@numba.njit(cache=True)
def _pixels_within(low: float, high: float, count: int) -> tuple[int, int]:
    """Return the first and the last pixel whose centre lies in low..high; first > last if none."""
    # Clipped before rounding: a huge footprint would not fit the integers.
    first = min(max(low - 0.5, 0.0), 1.0 * count)
    last = min(max(high - 0.5, -1.0), count - 1.0)
    return math.ceil(first), math.floor(last)


@numba.njit(cache=True)
def _footprint_covariance(
    covariance: NDArray[np.float64], camera: Camera, slope_x: float, slope_y: float, z: float
) -> tuple[float, float, float]:
    """Return xx, xy, yy of ``J W S W' J' + 0.3 I``, pixels squared (Zwicker et al. 2002, Eq. 31).

    The slopes x / z and y / z are clamped to 1.3 times the field of view in J. Where the
    principal point is off the middle, to 0.3 half-widths beyond the image on either side, which is
    the same thing in the middle (the reference implementation knows no other place).
    """
    beyond_x = (FIELD_OF_VIEW_CLAMP - 1.0) * 0.5 * camera.width / camera.fx
    beyond_y = (FIELD_OF_VIEW_CLAMP - 1.0) * 0.5 * camera.height / camera.fy
    left, right = -camera.cx / camera.fx, (camera.width - camera.cx) / camera.fx
    top, bottom = -camera.cy / camera.fy, (camera.height - camera.cy) / camera.fy
    slope_x = min(max(slope_x, left - beyond_x), right + beyond_x)
    slope_y = min(max(slope_y, top - beyond_y), bottom + beyond_y)
    # Rows of J W: the image's gradients of column and row with respect to the world.
    rotation = camera.rotation
    p0 = camera.fx / z * (rotation[0, 0] - slope_x * rotation[2, 0])
    p1 = camera.fx / z * (rotation[0, 1] - slope_x * rotation[2, 1])
    p2 = camera.fx / z * (rotation[0, 2] - slope_x * rotation[2, 2])
    q0 = camera.fy / z * (rotation[1, 0] - slope_y * rotation[2, 0])
    q1 = camera.fy / z * (rotation[1, 1] - slope_y * rotation[2, 1])
    q2 = camera.fy / z * (rotation[1, 2] - slope_y * rotation[2, 2])
    s = covariance
    sp0, sp1, sp2 = (
        s[0] * p0 + s[1] * p1 + s[2] * p2,
        s[1] * p0 + s[3] * p1 + s[4] * p2,
        s[2] * p0 + s[4] * p1 + s[5] * p2,
    )
    sq0, sq1, sq2 = (
        s[0] * q0 + s[1] * q1 + s[2] * q2,
        s[1] * q0 + s[3] * q1 + s[4] * q2,
        s[2] * q0 + s[4] * q1 + s[5] * q2,
    )
    return (
        p0 * sp0 + p1 * sp1 + p2 * sp2 + LOW_PASS,
        q0 * sp0 + q1 * sp1 + q2 * sp2,
        q0 * sq0 + q1 * sq1 + q2 * sq2 + LOW_PASS,
    )


@numba.njit(cache=True, parallel=True)
def _shade(
    scene: Gaussians, camera: Camera, index: NDArray[np.int64], table: NDArray[np.float64]
) -> None:
    """Fill the colour columns of `table` for the splats at `index`."""
    for k in numba.prange(len(index)):
        x, y, z = scene.means[index[k]] - camera.center
        length = math.sqrt(x * x + y * y + z * z)
        basis = np.empty(25)
        sh_basis(x / length, y / length, z / length, basis)
        for channel in range(3):
            value = 0.5
            for j in range(scene.harmonics.shape[1]):
                value += basis[j] * scene.harmonics[index[k], j, channel]
            table[k, RED + channel] = max(0.0, value)


@numba.njit(cache=True)
def sh_basis(x: float, y: float, z: float, out: NDArray[np.float64]) -> None:
    """Evaluate the real spherical harmonics of a unit direction as 3DGS files mean them.

    Band by band, order -l to l, with the Condon-Shortley phase: the first band is
    -C y, C z, -C x (C = sqrt(3 / 4 pi)). Constants: Sloan, "Stupid Spherical Harmonics Tricks",
    2008, appendix A2.

    - x, y, z: Direction from the camera to the splat, length 1, world frame.
    - out, (25,) float64: Filled with bands 0 to 4.
    """
    out[0] = math.sqrt(1.0 / (4.0 * math.pi))
    c = math.sqrt(3.0 / (4.0 * math.pi))
    out[1], out[2], out[3] = -c * y, c * z, -c * x
    xx, yy, zz = x * x, y * y, z * z
    c = 0.5 * math.sqrt(15.0 / math.pi)
    out[4], out[5], out[7] = c * x * y, -c * y * z, -c * x * z
    out[6] = 0.25 * math.sqrt(5.0 / math.pi) * (2.0 * zz - xx - yy)
    out[8] = 0.5 * c * (xx - yy)
    c = 0.25 * math.sqrt(35.0 / (2.0 * math.pi))
    out[9], out[15] = -c * y * (3.0 * xx - yy), -c * x * (xx - 3.0 * yy)
    c = 0.5 * math.sqrt(105.0 / math.pi)
    out[10], out[14] = c * x * y * z, 0.5 * c * z * (xx - yy)
    c = 0.25 * math.sqrt(21.0 / (2.0 * math.pi)) * (4.0 * zz - xx - yy)
    out[11], out[13] = -c * y, -c * x
    out[12] = 0.25 * math.sqrt(7.0 / math.pi) * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
    _sh_band_4(x, y, z, out)


@numba.njit(cache=True)
def _sh_band_4(x: float, y: float, z: float, out: NDArray[np.float64]) -> None:
    """Fill out[16:25] (Sloan 2008, appendix A2)."""
    xx, yy, zz = x * x, y * y, z * z
    c = 0.75 * math.sqrt(35.0 / math.pi)
    out[16], out[24] = c * x * y * (xx - yy), 0.25 * c * (xx * (xx - 3 * yy) - yy * (3 * xx - yy))
    c = 0.75 * math.sqrt(35.0 / (2.0 * math.pi)) * z
    out[17], out[23] = -c * y * (3.0 * xx - yy), -c * x * (xx - 3.0 * yy)
    c = 0.75 * math.sqrt(5.0 / math.pi) * (7.0 * zz - 1.0)
    out[18], out[22] = c * x * y, 0.5 * c * (xx - yy)
    c = 0.75 * math.sqrt(5.0 / (2.0 * math.pi)) * z * (7.0 * zz - 3.0)
    out[19], out[21] = -c * y, -c * x
    out[20] = 3.0 / 16.0 * math.sqrt(1.0 / math.pi) * (zz * (35.0 * zz - 30.0) + 3.0)
