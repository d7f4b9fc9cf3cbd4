"""How the reference renderer's pixels change with a splat's parameters, exactly.

A splat enters a pixel by its shape (u, v, xx, xy, yy: centre and covariance of the footprint, px
and px^2; and the logarithm of its opacity o) and by its colour. With T the transmittance in front
of it, B the colour behind it, d the pixel less the centre and ``e = inverse(covariance) d``::

    d pixel / d colour = alpha T
    d pixel / d shape  = alpha T (colour - B) w,  w = (e_x, e_y, e_x^2 / 2, e_x e_y, e_y^2 / 2, 1)

How shape and colour depend on a parameter follows once for each splat and view. The derivative is
that of what is drawn: where alpha is clamped to 0.99 it does not move, the splats keep their order,
and the edges of footprints (alpha = 1/255) and ends of pixels (T = 1e-4) stay where they are, as
they do in the reference implementation's own gradients.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from .compositing import ALPHA_MAX, TILE, TRANSMITTANCE_STOP, Bins, compose, tile_hits
from .footprints import (
    FIELD_OF_VIEW_CLAMP,
    RED,
    A,
    B,
    C,
    Camera,
    Footprints,
    U,
    V,
    sh_basis,
    to_camera,
)

SHAPE = 5
"""Numbers of a footprint without its opacity: u, v, xx, xy, yy."""

# Columns of Hits.values.
WEIGHT, E_X, E_Y, CONTRAST, MOVES, VALUES = 0, 1, 2, 3, 6, 7


class Hits(NamedTuple):
    """What is drawn in a tile, pixel by pixel and front to back.

    - owners, (hits,) int32: Which of the tile's entries it is.
    - pixels, (hits,) int32: Row by row in the image.
    - values, (hits, 7) float64: alpha T; e, 1 / px; alpha T (colour - B) of red, green, blue; 0
      where alpha is clamped, else 1.
    """

    owners: NDArray[np.int32]
    pixels: NDArray[np.int32]
    values: NDArray[np.float64]


@numba.njit(cache=True)
def hits_of(
    tile: int,
    bins: Bins,
    footprints: Footprints,
    size: tuple[int, int],
    background: NDArray[np.float64],
) -> Hits:
    """Return the drawn hits of a tile of an image of `size` (width, height)."""
    width, height = size
    across = (width + TILE - 1) // TILE
    left, top = tile % across * TILE, tile // across * TILE
    entries = bins.entries[bins.starts[tile] : bins.starts[tile + 1]]
    inner = min(TILE, width - left), min(TILE, height - top)
    starts, owners, alphas = tile_hits(entries, footprints, (left, top), inner, TRANSMITTANCE_STOP)
    longest = np.max(np.diff(starts))
    through, colors = np.empty(longest + 1), np.empty((longest + 1, 3))
    out = Hits(
        np.empty(len(owners), np.int32),
        np.empty(len(owners), np.int32),
        np.empty((len(owners), VALUES)),
    )
    count = 0
    for pixel in range(inner[0] * inner[1]):
        mine = slice(starts[pixel], starts[pixel + 1])
        shown = entries[owners[mine]]
        end = compose(shown, alphas[mine], footprints.table, through, colors)
        place = left + pixel % inner[0], top + pixel // inner[0]
        for k in range(end):
            out.owners[count] = owners[starts[pixel] + k]
            out.pixels[count] = place[1] * width + place[0]
            values = out.values[count]
            alpha, row = alphas[starts[pixel] + k], footprints.table[shown[k]]
            _slopes(row, place, values)
            values[WEIGHT] = alpha * through[k]
            values[MOVES] = 1.0 if alpha < ALPHA_MAX else 0.0
            for channel in range(3):
                behind = colors[end, channel] + through[end] * background[channel]
                behind = (behind - colors[k + 1, channel]) / through[k + 1]
                values[CONTRAST + channel] = values[WEIGHT] * (row[RED + channel] - behind)
            count += 1
    return Hits(out.owners[:count], out.pixels[:count], out.values[:count])


@numba.njit(cache=True)
def _slopes(row: NDArray[np.float64], place: tuple[int, int], values: NDArray[np.float64]) -> None:
    """Fill the columns of e for the pixel at `place` (column, row)."""
    dx, dy = place[0] + 0.5 - row[U], place[1] + 0.5 - row[V]
    values[E_X] = row[A] * dx + row[B] * dy
    values[E_Y] = row[B] * dx + row[C] * dy


@numba.njit(cache=True)
def shape_gradient(
    mean: NDArray[np.float64],
    axes: NDArray[np.float64],
    camera: Camera,
    out: NDArray[np.float64],
) -> None:
    """Differentiate u, v, xx, xy, yy by mean and log scale.

    - mean, (3,) float64
    - axes, (3, 3) float64: Columns: the splat's axes, each as long as its scale; their outer
      products sum to the covariance S.
    - out, (5, 6) float64: Filled; columns 0 to 2 by the mean, 3 to 5 by the logarithms of the
      scales.

    Notes
    -----
    p and q are the rows of J W (see `footprints`), p = fx / z (r0 - sx r2) with r0, r2 rows of W
    and sx = x / z, or its clamp. So ``dp_a / dmean_b = -(p_a r2_b + r2_a p_b) / z``, where clamped
    ``-p_a r2_b / z``; xx = p' S p and so on, and dS / d log s_k = 2 a_k a_k'.
    """
    x, y, z = to_camera(camera, mean)
    p, q, free_x, free_y = image_rows(mean, camera)
    r0, r1, r2 = camera.rotation[0], camera.rotation[1], camera.rotation[2]
    out[0, :3] = camera.fx / z * (r0 - x / z * r2)
    out[1, :3] = camera.fy / z * (r1 - y / z * r2)
    out[:2, 3:] = 0.0
    pa, qa = p @ axes, q @ axes
    sp, sq = axes @ pa, axes @ qa
    for b in range(3):
        dp = -(p * r2[b] + free_x * r2 * p[b]) / z
        dq = -(q * r2[b] + free_y * r2 * q[b]) / z
        out[2, b] = 2.0 * np.sum(sp * dp)
        out[3, b] = np.sum(sq * dp) + np.sum(sp * dq)
        out[4, b] = 2.0 * np.sum(sq * dq)
        out[2, 3 + b] = 2.0 * pa[b] * pa[b]
        out[3, 3 + b] = 2.0 * pa[b] * qa[b]
        out[4, 3 + b] = 2.0 * qa[b] * qa[b]


@numba.njit(cache=True)
def image_rows(
    mean: NDArray[np.float64], camera: Camera
) -> tuple[NDArray[np.float64], NDArray[np.float64], float, float]:
    """Return the rows of J W, and for each 1 where its slope is not clamped, else 0."""
    x, y, z = to_camera(camera, mean)
    sx, free_x = _clamped(x / z, camera.fx, camera.cx, camera.width)
    sy, free_y = _clamped(y / z, camera.fy, camera.cy, camera.height)
    forward = camera.rotation[2]
    p = camera.fx / z * (camera.rotation[0] - sx * forward)
    q = camera.fy / z * (camera.rotation[1] - sy * forward)
    return p, q, free_x, free_y


@numba.njit(cache=True)
def _clamped(slope: float, focal: float, middle: float, size: int) -> tuple[float, float]:
    """Return the slope as the footprint's Jacobian takes it, and 1 where it is not clamped."""
    beyond = (FIELD_OF_VIEW_CLAMP - 1.0) * 0.5 * size / focal
    low, high = -middle / focal - beyond, (size - middle) / focal + beyond
    if slope < low:
        return low, 0.0
    if slope > high:
        return high, 0.0
    return slope, 1.0


@numba.njit(cache=True)
def color_gradient(
    mean: NDArray[np.float64],
    camera: Camera,
    harmonics: NDArray[np.float32],
    out: NDArray[np.float64],
) -> None:
    """Differentiate the colour by the mean, which turns the direction it is seen along.

    - mean, (3,) float64
    - harmonics, (K, 3) float32
    - out, (3, 3) float64: Filled; rows red, green, blue.

    Notes
    -----
    The harmonics are polynomials of the direction: their derivative is the imaginary part of their
    value a tiny imaginary step away, to the last bit, since nothing is subtracted.
    """
    offset = mean - camera.center
    length = math.sqrt(np.sum(offset * offset))
    unit = offset / length
    basis, step = np.empty(25, np.complex128), 1e-30
    for b in range(3):
        turn = -unit * unit[b]
        turn[b] += 1.0
        d = unit + 1j * step * turn / length
        sh_basis(d[0], d[1], d[2], basis)
        for channel in range(3):
            value = 0.5 + 0.0j
            for j in range(len(harmonics)):
                value += basis[j] * harmonics[j, channel]
            out[channel, b] = value.imag / step if value.real > 0.0 else 0.0


@numba.njit(cache=True)
def turn_gradient(
    mean: NDArray[np.float64],
    axes: NDArray[np.float64],
    camera: Camera,
    out: NDArray[np.float64],
) -> None:
    """Differentiate xx, xy, yy by a small turn of the splat about the axes of the world.

    - mean, axes, camera: As in `shape_gradient`.
    - out, (3, 3) float64: Filled; columns: the turn's x, y, z, radians.

    Notes
    -----
    A turn w moves every axis a by w x a, so ``p' dS q = w . (Sq x p + Sp x q)``.
    """
    p, q, _, _ = image_rows(mean, camera)
    sp, sq = axes @ (p @ axes), axes @ (q @ axes)
    out[0] = 2.0 * np.cross(sp, p)
    out[1] = np.cross(sq, p) + np.cross(sp, q)
    out[2] = 2.0 * np.cross(sq, q)
