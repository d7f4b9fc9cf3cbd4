"""A reference renderer of 3D Gaussian splats on the CPU, and what each splat does to the picture.

Every pruning method is judged by the pictures this renderer makes, and the rendered baselines take
their statistics from it. It computes in float64 and follows the reference implementation's rules
(Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering", 2023, sections 4 to
6; Zwicker et al., "EWA splatting", 2002, for the projection):

- A splat is drawn where its camera depth is above `near`; the footprint is the Gaussian with
  covariance ``J W S W' J' + 0.3 I`` (pixels squared), J the Jacobian of the projection at the mean,
  whose direction is clamped to 1.3 times the field of view.
- ``alpha = min(0.99, opacity exp(-q / 2))`` at the pixel's centre (k + 0.5), q the squared
  Mahalanobis distance; nothing below 1/255.
- Front to back by the depth of the mean, equal depths by index; a pixel is finished by the splat
  that would take its transmittance below 1e-4, and that splat is not drawn.
- Colour is ``max(0, SH(direction) + 0.5)``, direction from the camera's centre to the mean.

One rule differs: the reference implementation draws a splat in the 16-pixel tiles that a square of
three standard deviations touches, so the cut depends on where the tiles lie. Here the footprint
ends where alpha reaches 1/255, and tiles only make it fast: no pixel depends on them. Nor does
any result depend on the number of threads, to the last bit.

Frame: OpenCV. Camera x right, y down, z forward; `rotation` is world to camera.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numba
import numpy as np

from refine_addon.core.splats import drawable, opacity, rotation_matrices

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import ArrayLike, NDArray

    from refine_addon.core.splats import Splats
    from refine_addon.core.views import View

TILE = 16
"""Side of a tile, pixels."""
LOW_PASS = 0.3
"""Variance added to every footprint so that it is not thinner than a pixel, pixels squared."""
ALPHA_MAX = 0.99
ALPHA_CUT = 1.0 / 255.0
TRANSMITTANCE_STOP = 1e-4
FIELD_OF_VIEW_CLAMP = 1.3

# Columns of Footprints.table.
_U, _V, _A, _B, _C, _DETERMINANT, _LIMIT, _OPACITY, _RED, _COLUMNS = 0, 1, 2, 3, 4, 5, 6, 7, 8, 11
# Columns of what is summed for every splat.
_WEIGHT, _WEIGHT_MAX, _OPACITY_SUM, _HITS, _REMOVAL, _SUMS = 0, 1, 2, 3, 4, 5


class Gaussians(NamedTuple):
    """N splats as the renderer wants them; `gaussians` makes one from plain arrays.

    Attributes
    ----------
    means : (N, 3) float64
        Centres, world units.
    covariances : (N, 6) float64
        xx, xy, xz, yy, yz, zz of the world covariance, world units squared.
    opacities : (N,) float64
        0 to 1; 0 is never drawn, whatever the other values.
    harmonics : (N, (degree + 1)^2, 3) float32
        Spherical-harmonics coefficients of red, green, blue.
    """

    means: NDArray[np.float64]
    covariances: NDArray[np.float64]
    opacities: NDArray[np.float64]
    harmonics: NDArray[np.float32]


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

    Attributes
    ----------
    index : (M,) int64
        Which splat it is.
    table : (M, 11) float64
        u, v: centre, pixels; a, b, c: inverse covariance, 1 / px^2; determinant of the covariance,
        px^4; largest squared Mahalanobis distance drawn; opacity; red, green, blue.
    boxes : (M, 4) int32
        First and last pixel column, first and last pixel row, clipped to the image.
    """

    index: NDArray[np.int64]
    table: NDArray[np.float64]
    boxes: NDArray[np.int32]


class Bins(NamedTuple):
    """Which footprints every tile meets: ``entries[starts[t]:starts[t + 1]]``, front to back."""

    starts: NDArray[np.int64]
    entries: NDArray[np.int32]


class Target(NamedTuple):
    """Where the tiles draw.

    Attributes
    ----------
    background : (3,) float64
    image : (H, W, 3) float64
    sums : (entries of the bins, 5) float64
        What each splat does in each tile; empty where nobody asks.
    """

    background: NDArray[np.float64]
    image: NDArray[np.float64]
    sums: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Statistics:
    """What every splat does to the pixels of one view or of several.

    A hit is a pixel in which the splat is drawn: alpha at least 1/255 and the pixel not finished.
    T is the transmittance in front of the splat there.

    Attributes
    ----------
    weight_sum : (N,) float64
        Sum of alpha T over all hits.
    weight_max : (N,) float64
        Largest alpha T of any hit; 0 without a hit.
    opacity_sum : (N,) float64
        Sum of opacity T over all hits, LightGaussian's count (Fan et al. 2024, Eq. 3).
    hits : (N,) int64
        Number of hits.
    removal_error : (N,) float64
        Sum over pixels and channels of the squared change of the picture if this one splat were
        removed. See `_removal_errors` for the derivation.
    """

    weight_sum: NDArray[np.float64]
    weight_max: NDArray[np.float64]
    opacity_sum: NDArray[np.float64]
    hits: NDArray[np.int64]
    removal_error: NDArray[np.float64]


def gaussians(
    means: ArrayLike,
    scales: ArrayLike,
    quaternions: ArrayLike,
    opacities: ArrayLike,
    harmonics: ArrayLike,
) -> Gaussians:
    """Prepare plain arrays for rendering; once for any number of views.

    Parameters
    ----------
    means : (N, 3) floating
        Centres, world units.
    scales : (N, 3) floating
        Standard deviations along the splat's axes, world units.
    quaternions : (N, 4) floating
        w x y z, of any length.
    opacities : (N,) floating
        0 to 1.
    harmonics : (N, K, 3) floating
        K = (degree + 1)^2 coefficients of each channel, degree 0 to 4.

    Raises
    ------
    ValueError
        If the shapes do not belong together.
    """
    means, scales, opacities = (
        np.ascontiguousarray(a, np.float64) for a in (means, scales, opacities)
    )
    harmonics = np.ascontiguousarray(harmonics, np.float32)
    count = len(means)
    shapes = means.shape, scales.shape, np.shape(quaternions), opacities.shape
    if shapes != ((count, 3), (count, 3), (count, 4), (count,)):
        msg = f"expected shapes (N, 3), (N, 3), (N, 4), (N,), got {shapes}"
        raise ValueError(msg)
    if harmonics.shape not in [(count, k * k, 3) for k in range(1, 6)]:
        msg = f"expected harmonics ({count}, 1, 4, 9, 16 or 25, 3), got {harmonics.shape}"
        raise ValueError(msg)
    axes = rotation_matrices(np.asarray(quaternions)) * scales[:, None, :]
    matrices = axes @ np.swapaxes(axes, 1, 2)
    rows, columns = np.triu_indices(3)
    return Gaussians(means, np.ascontiguousarray(matrices[:, rows, columns]), opacities, harmonics)


def gaussians_of(splats: Splats) -> Gaussians:
    """Activate `splats` for rendering; those that no renderer can draw become transparent."""
    good = drawable(splats)
    # What is not drawn is made harmless first: the rest would overflow on the way to nothing.
    scales = np.exp(np.where(good[:, None], splats.log_scales, 0.0).astype(np.float64))
    opacities = np.where(good, opacity(splats.opacity_logits), 0.0)
    harmonics = np.concatenate([splats.sh_dc[:, None, :], splats.sh_rest], axis=1)
    harmonics[~good] = 0.0
    return gaussians(splats.means, scales, splats.quaternions, opacities, harmonics)


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


def render(
    splats: Splats | Gaussians,
    view: View | Camera,
    *,
    near: float = 0.2,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> NDArray[np.float64]:
    """Draw one view.

    Parameters
    ----------
    splats : Splats or Gaussians
        `Gaussians` saves the activation where many views are drawn.
    view : View or Camera
        Its clip distances and weight mean nothing here.
    near : float
        Splats whose mean is not deeper than this are not drawn, world units.
    background : sequence of 3 float
        Colour where nothing is.

    Returns
    -------
    (height, width, 3) float64
        Not clipped: colours may exceed 1.
    """
    image, _ = _draw(_prepared(splats), _camera(view), near, background, statistics=False)
    return image


def render_with_statistics(
    splats: Splats | Gaussians,
    view: View | Camera,
    *,
    near: float = 0.2,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> tuple[NDArray[np.float64], Statistics]:
    """Draw one view and say what every splat does in it; parameters as in `render`."""
    image, sums = _draw(_prepared(splats), _camera(view), near, background, statistics=True)
    return image, _statistics(sums)


def accumulate_statistics(
    splats: Splats | Gaussians,
    views: Iterable[View | Camera],
    *,
    near: float = 0.2,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> Statistics:
    """Sum the statistics of several views in their order (the largest of `weight_max`)."""
    prepared = _prepared(splats)
    total = np.zeros((len(prepared.means), _SUMS))
    for view in views:
        _, sums = _draw(prepared, _camera(view), near, background, statistics=True)
        largest = np.maximum(total[:, _WEIGHT_MAX], sums[:, _WEIGHT_MAX])
        total += sums
        total[:, _WEIGHT_MAX] = largest
    return _statistics(total)


def _statistics(sums: NDArray[np.float64]) -> Statistics:
    """Name the columns of `sums`, (N, 5)."""
    columns = [np.ascontiguousarray(column) for column in sums.T]
    return Statistics(
        columns[_WEIGHT],
        columns[_WEIGHT_MAX],
        columns[_OPACITY_SUM],
        columns[_HITS].astype(np.int64),
        columns[_REMOVAL],
    )


def _prepared(splats: Splats | Gaussians) -> Gaussians:
    return splats if isinstance(splats, Gaussians) else gaussians_of(splats)


def _camera(view: View | Camera) -> Camera:
    return view if isinstance(view, Camera) else camera_of(view)


def _draw(
    scene: Gaussians,
    camera: Camera,
    near: float,
    background: Sequence[float],
    *,
    statistics: bool,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the image, (H, W, 3), and the sums of every splat, (N, 5) or (0, 5)."""
    footprints = _footprints(scene, camera, near)
    bins = _bins(footprints.boxes, camera.width, camera.height)
    load = np.diff(bins.starts)
    heaviest_first = np.argsort(-load, kind="stable")
    threads = numba.get_num_threads()
    # A thread gets a contiguous run of this order: dealing the tiles out evens the runs.
    order = np.concatenate([heaviest_first[k::threads] for k in range(threads)])
    target = Target(
        np.array(background, np.float64),
        np.empty((camera.height, camera.width, 3)),
        np.zeros((len(bins.entries) if statistics else 0, _SUMS)),
    )
    _draw_tiles(order, bins, footprints, target)
    sums = np.zeros((len(scene.means) if statistics else 0, _SUMS))
    if statistics:
        _merge(bins.entries, footprints.index, target.sums, sums)
    return target.image, sums


def _footprints(scene: Gaussians, camera: Camera, near: float) -> Footprints:
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
    table = np.empty((count, _COLUMNS))
    boxes = np.empty((count, 4), np.int32)
    for i in numba.prange(count):
        if scene.opacities[i] >= ALPHA_CUT:
            x, y, z = _to_camera(camera, scene.means[i])
            if z > near and _project_one(scene, i, camera, (x, y, z), (table[i], boxes[i])):
                depths[i] = z
    return depths, table, boxes


@numba.njit(cache=True)
def _to_camera(camera: Camera, point: NDArray[np.float64]) -> tuple[float, float, float]:
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
    # opacity exp(-q / 2) = 1 / 255; the margin only keeps rounding from losing an edge pixel.
    limit = 2.0 * math.log(scene.opacities[i] / ALPHA_CUT) + 1e-9
    reach_x, reach_y = math.sqrt(limit * xx), math.sqrt(limit * yy)
    box[0], box[1] = _pixels_within(u - reach_x, u + reach_x, camera.width)
    box[2], box[3] = _pixels_within(v - reach_y, v + reach_y, camera.height)
    row[_U], row[_V] = u, v
    row[_A], row[_B], row[_C] = yy / determinant, -xy / determinant, xx / determinant
    row[_DETERMINANT], row[_LIMIT] = determinant, limit
    row[_OPACITY] = scene.opacities[i]
    return box[0] <= box[1] and box[2] <= box[3]


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
            table[k, _RED + channel] = max(0.0, value)


@numba.njit(cache=True)
def sh_basis(x: float, y: float, z: float, out: NDArray[np.float64]) -> None:
    """Evaluate the real spherical harmonics of a unit direction as 3DGS files mean them.

    Band by band, order -l to l, with the Condon-Shortley phase: the first band is
    -C y, C z, -C x (C = sqrt(3 / 4 pi)). Constants: Sloan, "Stupid Spherical Harmonics Tricks",
    2008, appendix A2.

    Parameters
    ----------
    x, y, z : float
        Direction from the camera to the splat, length 1, world frame.
    out : (25,) float64
        Filled with bands 0 to 4.
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


@numba.njit(cache=True)
def _bins(boxes: NDArray[np.int32], width: int, height: int) -> Bins:
    """Distribute the footprints over the tiles; each tile keeps their order, so none is sorted."""
    across = (width + TILE - 1) // TILE
    down = (height + TILE - 1) // TILE
    starts = np.zeros(across * down + 1, np.int64)
    for k in range(len(boxes)):
        for row in range(boxes[k, 2] // TILE, boxes[k, 3] // TILE + 1):
            for column in range(boxes[k, 0] // TILE, boxes[k, 1] // TILE + 1):
                starts[row * across + column + 1] += 1
    starts = np.cumsum(starts)
    entries = np.empty(starts[-1], np.int32)
    fill = starts[:-1].copy()
    for k in range(len(boxes)):
        for row in range(boxes[k, 2] // TILE, boxes[k, 3] // TILE + 1):
            for column in range(boxes[k, 0] // TILE, boxes[k, 1] // TILE + 1):
                tile = row * across + column
                entries[fill[tile]] = k
                fill[tile] += 1
    return Bins(starts, entries)


@numba.njit(cache=True, parallel=True)
def _draw_tiles(
    order: NDArray[np.int64], bins: Bins, footprints: Footprints, target: Target
) -> None:
    """Draw every tile, the threads taking equal runs of `order`."""
    for k in numba.prange(len(order)):
        _draw_tile(order[k], bins, footprints, target)


@numba.njit(cache=True)
def _draw_tile(tile: int, bins: Bins, footprints: Footprints, target: Target) -> None:
    """Collect the hits of a tile, then compose each pixel from its own list of them."""
    background, image = target.background, target.image
    height, width = image.shape[:2]
    across = (width + TILE - 1) // TILE
    left, top = tile % across * TILE, tile // across * TILE
    mine = slice(bins.starts[tile], bins.starts[tile + 1])
    entries, sums = bins.entries[mine], target.sums[mine]
    # Removing a splat divides what is behind it by 1 - alpha >= 0.01, so splats that come after
    # the end of the pixel can appear: their hits are needed too. 0.99 is a margin for rounding.
    stop = TRANSMITTANCE_STOP * (0.99 * (1.0 - ALPHA_MAX) if len(sums) else 1.0)
    size = min(TILE, width - left), min(TILE, height - top)
    starts, owners, alphas = _tile_hits(entries, footprints, (left, top), size, stop)
    longest = np.max(np.diff(starts))
    through, colors = np.empty(longest + 1), np.empty((longest + 1, 3))
    for pixel in range(size[0] * size[1]):
        hits = slice(starts[pixel], starts[pixel + 1])
        shown = entries[owners[hits]]
        end = _compose(shown, alphas[hits], footprints.table, through, colors)
        row = image[top + pixel // size[0], left + pixel % size[0]]
        for channel in range(3):
            row[channel] = colors[end, channel] + background[channel] * through[end]
        if len(sums):
            blended = through, colors, background
            opacities = footprints.table[shown, _OPACITY]
            _count_hits((owners[hits], alphas[hits], opacities), end, through, sums)
            _removal_errors(owners[hits], alphas[hits], end, blended, sums)


@numba.njit(cache=True)
def _tile_hits(
    entries: NDArray[np.int32],
    footprints: Footprints,
    corner: tuple[int, int],
    size: tuple[int, int],
    stop: float,
) -> tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float64]]:
    """Find which splats cover which pixels of a tile, until a pixel's transmittance is < `stop`.

    Returns
    -------
    starts : (pixels + 1,) int64
        Hits of pixel p (row by row in the tile) are ``starts[p]:starts[p + 1]``, front to back;
        the last of them may be the one that took the transmittance below `stop`.
    owners : (hits,) int32
        Which of `entries` it is.
    alphas : (hits,) float64
    """
    pixels = size[0] * size[1]
    through = np.ones(pixels)
    starts = np.zeros(pixels + 1, np.int64)
    count, alive = 0, pixels
    places, owners, alphas = np.empty(2048, np.int32), np.empty(2048, np.int32), np.empty(2048)
    for k in range(len(entries)):
        if alive == 0:
            break
        if count + pixels > len(owners):
            places, owners = _doubled(places), _doubled(owners)
            alphas = _doubled(alphas)
        before = count
        count = _splat_hits(
            footprints.table[entries[k]],
            footprints.boxes[entries[k]],
            (corner, size),
            (through, stop),
            (places, alphas, count),
        )
        for hit in range(before, count):
            owners[hit] = k
            starts[places[hit] + 1] += 1
            through[places[hit]] *= 1.0 - alphas[hit]
            if through[places[hit]] < stop:
                alive -= 1
    # A counting sort by pixel; it keeps the order of equal ones, front to back.
    starts = np.cumsum(starts)
    fill = starts[:-1].copy()
    sorted_owners, sorted_alphas = np.empty(count, np.int32), np.empty(count)
    for hit in range(count):
        place = fill[places[hit]]
        sorted_owners[place], sorted_alphas[place] = owners[hit], alphas[hit]
        fill[places[hit]] += 1
    return starts, sorted_owners, sorted_alphas


@numba.njit(cache=True)
def _doubled(values: NDArray[Any]) -> NDArray[Any]:
    """Return a copy with room for twice as many."""
    larger = np.empty(2 * len(values), values.dtype)
    larger[: len(values)] = values
    return larger


@numba.njit(cache=True)
def _splat_hits(
    row: NDArray[np.float64],
    box: NDArray[np.int32],
    region: tuple[tuple[int, int], tuple[int, int]],
    progress: tuple[NDArray[np.float64], float],
    hits: tuple[NDArray[np.int32], NDArray[np.float64], int],
) -> int:
    """Append one splat's unfinished pixels and alphas to `hits`; return how many there are then.

    On a row of pixels at height d from the centre, ``a e^2 + 2 b e d + c d^2 <= limit`` holds for
    e within ``sqrt(a limit - d^2 / det) / a`` of ``-b d / a``, because ``a c - b^2 = 1 / det``.
    """
    (left, top), (width, height) = region
    through, stop = progress
    places, alphas, count = hits
    first_column, last_column = max(box[0] - left, 0), min(box[1] - left, width - 1)
    for j in range(max(box[2] - top, 0), min(box[3] - top, height - 1) + 1):
        dy = top + j + 0.5 - row[_V]
        square = row[_A] * row[_LIMIT] - dy * dy / row[_DETERMINANT]
        if square < 0.0:
            continue
        reach = math.sqrt(square) / row[_A] + 1e-6
        middle = row[_U] - row[_B] / row[_A] * dy - 0.5 - left
        begin = max(first_column, math.ceil(max(middle - reach, -1.0)))
        end = min(last_column, math.floor(min(middle + reach, 1.0 * TILE)))
        for i in range(begin, end + 1):
            place = j * width + i
            if through[place] < stop:
                continue
            dx = left + i + 0.5 - row[_U]
            square = row[_A] * dx * dx + 2.0 * row[_B] * dx * dy + row[_C] * dy * dy
            alpha = min(ALPHA_MAX, row[_OPACITY] * math.exp(-0.5 * square))
            if alpha >= ALPHA_CUT:
                places[count], alphas[count] = place, alpha
                count += 1
    return count


@numba.njit(cache=True)
def _compose(
    shown: NDArray[np.int32],
    alphas: NDArray[np.float64],
    table: NDArray[np.float64],
    through: NDArray[np.float64],
    colors: NDArray[np.float64],
) -> int:
    """Blend one pixel's hits front to back, on past its end.

    Fills ``through[k]`` and ``colors[k]``, transmittance and colour in front of hit k, up to and
    including ``k = len(shown)``, and returns how many hits are drawn.
    """
    through[0], colors[0] = 1.0, 0.0
    end = len(shown)
    for k in range(len(shown)):
        through[k + 1] = through[k] * (1.0 - alphas[k])
        if through[k + 1] < TRANSMITTANCE_STOP and end == len(shown):
            end = k
        for channel in range(3):
            value = table[shown[k], _RED + channel]
            colors[k + 1, channel] = colors[k, channel] + alphas[k] * through[k] * value
    return end


@numba.njit(cache=True)
def _count_hits(
    hits: tuple[NDArray[np.int32], NDArray[np.float64], NDArray[np.float64]],
    end: int,
    through: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """Add the `end` drawn hits of a pixel (owners, alphas, opacities) to all sums but removal."""
    owners, alphas, opacities = hits
    for k in range(end):
        row = sums[owners[k]]
        row[_WEIGHT] += alphas[k] * through[k]
        row[_WEIGHT_MAX] = max(row[_WEIGHT_MAX], alphas[k] * through[k])
        row[_OPACITY_SUM] += opacities[k] * through[k]
        row[_HITS] += 1.0


@numba.njit(cache=True)
def _removal_errors(
    owners: NDArray[np.int32],
    alphas: NDArray[np.float64],
    end: int,
    blended: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    sums: NDArray[np.float64],
) -> None:
    """Add to each splat the squared change of this pixel if that splat alone were removed.

    Write T_k for the transmittance and C_k for the colour in front of hit k, so that
    ``C_{k+1} = C_k + a_k T_k c_k``, ``T_{k+1} = (1 - a_k) T_k``, and let hits 0 .. n - 1 be drawn
    (n is the first with T_{n+1} < 1e-4, or their number). The pixel is ``P = C_n + T_n G``, G the
    background. Without hit i, everything in front of it stays, and every transmittance behind it
    grows by 1 / (1 - a_i)::

        P' = C_i + (C_m - C_{i+1}) / (1 - a_i) + T_m / (1 - a_i) G

    where m >= n is the first hit behind i with T_{m+1} / (1 - a_i) < 1e-4: the pixel now ends
    later. If the end did not move (m = n), with B = ((C_n - C_{i+1}) + T_n G) / T_{i+1} the colour
    seen behind i, ``P' - P = a_i T_i (B - c_i)``: its weight times its contrast to what it hides.
    Hit n, which ended the pixel without being drawn, changes it too: hits behind it are drawn
    once it is gone. Hits after n change nothing.

    P' is compared with P directly, so no term is left out; what remains is rounding, about 1e-14
    of the colours per pixel (before squaring), and the decision m where a transmittance
    meets the stop to the last bit.

    Parameters
    ----------
    owners : (hits,) int32
        Row of `sums` for each hit of the pixel.
    alphas : (hits,) float64
        The hits go on past `end` until T < 1e-6, so that m is always among them.
    end : int
        n.
    blended : tuple
        T, (hits + 1,); C, (hits + 1, 3); background (3,).
    sums : (entries, 5) float64
        Column `_REMOVAL` is added to.
    """
    through, colors, background = blended
    for i in range(min(end + 1, len(owners))):
        rest = 1.0 - alphas[i]
        last = max(end, i + 1)
        while last < len(owners) and through[last + 1] >= TRANSMITTANCE_STOP * rest:
            last += 1
        for channel in range(3):
            with_it = colors[end, channel] + through[end] * background[channel]
            behind = colors[last, channel] - colors[i + 1, channel]
            behind += through[last] * background[channel]
            change = colors[i, channel] + behind / rest - with_it
            sums[owners[i], _REMOVAL] += change * change


@numba.njit(cache=True)
def _merge(
    entries: NDArray[np.int32],
    index: NDArray[np.int64],
    entry_sums: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None:
    """Add up the tiles' sums for every splat, tile by tile, so that threads do not matter."""
    for k in range(len(entries)):
        splat = index[entries[k]]
        largest = max(sums[splat, _WEIGHT_MAX], entry_sums[k, _WEIGHT_MAX])
        for column in range(_SUMS):
            sums[splat, column] += entry_sums[k, column]
        sums[splat, _WEIGHT_MAX] = largest
