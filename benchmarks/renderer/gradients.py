"""The gradient of a loss by all parameters of all splats, exactly; see `jacobians` for its terms.

The loss is any function of one rendered picture, given by its gradient by the pixels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numba
import numpy as np
from numpy.typing import NDArray

from .compositing import Bins, add_up, bins_of
from .footprints import RED, Camera, Footprints, Gaussians, footprints_of, sh_basis
from .jacobians import (
    CONTRAST,
    E_X,
    E_Y,
    MOVES,
    SHAPE,
    WEIGHT,
    color_gradient,
    hits_of,
    shape_gradient,
    turn_gradient,
)
from .rasterizer import dealt

# Columns of what is summed for every splat: by its shape, by log opacity, by its colour.
_LOG_OPACITY, _COLOR, _SUMS = SHAPE, SHAPE + 1, SHAPE + 4

MEAN, SCALE, TURN, LOGIT, HARMONICS = 0, 3, 6, 9, 10
"""First columns of a gradient: by the mean, the logarithms of the scales, a turn about the axes of
the world, the opacity's logit, and the harmonics (coefficient by coefficient, each r, g, b)."""


def gradient(
    scene: Gaussians,
    axes: NDArray[np.float64],
    camera: Camera,
    by_pixel: NDArray[np.float64],
    *,
    near: float = 0.2,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> NDArray[np.float64]:
    """Return the gradient of a loss by the parameters of the splats.

    - axes, (N, 3, 3) float64: The axes of the splats, each column as long as its scale.
    - by_pixel, (H, W, 3) float64: The gradient of the loss by the pixels of what
      `rasterizer.render` draws.
    - near, background: As in `rasterizer.render`.

    - returned, (N, 10 + 3 K) float64: See `MEAN`; K coefficients of each channel. 0 for splats that
      are not drawn.
    """
    footprints = footprints_of(scene, camera, near)
    bins = bins_of(footprints.boxes, camera.width, camera.height)
    entries = np.zeros((len(bins.entries), _SUMS))
    pixels = np.ascontiguousarray(by_pixel.reshape(-1, 3))
    picture = ((camera.width, camera.height), np.array(background, np.float64), pixels)
    _tiles(dealt(bins), bins, footprints, picture, entries)
    sums = np.zeros((len(footprints.index), _SUMS))
    add_up(bins.entries, entries, sums)
    out = np.zeros((len(scene.means), HARMONICS + 3 * scene.harmonics.shape[1]))
    _chain(scene, axes, camera, (footprints.index, footprints.table, sums), out)
    return out


@numba.njit(cache=True, parallel=True)
def _tiles(
    order: NDArray[np.int64],
    bins: Bins,
    footprints: Footprints,
    picture: tuple[tuple[int, int], NDArray[np.float64], NDArray[np.float64]],
    entries: NDArray[np.float64],
) -> None:
    """Fill `entries`, (entries of the bins, 9), tile by tile."""
    size, background, by_pixel = picture
    for k in numba.prange(len(order)):
        tile = order[k]
        hits = hits_of(tile, bins, footprints, size, background)
        mine = entries[bins.starts[tile] : bins.starts[tile + 1]]
        for hit in range(len(hits.owners)):
            _collect(hits.values[hit], by_pixel[hits.pixels[hit]], mine[hits.owners[hit]])


@numba.njit(cache=True)
def _collect(
    values: NDArray[np.float64], slope: NDArray[np.float64], row: NDArray[np.float64]
) -> None:
    """Add one hit to its splat's sums."""
    along = 0.0
    for channel in range(3):
        row[_COLOR + channel] += values[WEIGHT] * slope[channel]
        along += values[CONTRAST + channel] * slope[channel]
    along *= values[MOVES]
    x, y = values[E_X], values[E_Y]
    row[0] += along * x
    row[1] += along * y
    row[2] += along * 0.5 * x * x
    row[3] += along * x * y
    row[4] += along * 0.5 * y * y
    row[_LOG_OPACITY] += along


@numba.njit(cache=True, parallel=True)
def _chain(
    scene: Gaussians,
    axes: NDArray[np.float64],
    camera: Camera,
    found: tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]],
    out: NDArray[np.float64],
) -> None:
    """Go on from shape, opacity and colour to the parameters."""
    index, table, sums = found
    for k in numba.prange(len(index)):
        i = index[k]
        mean, own, row = scene.means[i], axes[i], out[i]
        shape, turn, color = np.empty((SHAPE, 6)), np.empty((3, 3)), np.empty((3, 3))
        shape_gradient(mean, own, camera, shape)
        turn_gradient(mean, own, camera, turn)
        color_gradient(mean, camera, scene.harmonics[i], color)
        by_shape, by_color = sums[k, :SHAPE], sums[k, _COLOR:]
        row[MEAN:TURN] = by_shape @ shape
        row[MEAN:SCALE] += by_color @ color
        row[TURN:LOGIT] = by_shape[2:] @ turn
        row[LOGIT] = sums[k, _LOG_OPACITY] * (1.0 - scene.opacities[i])
        offset = mean - camera.center
        x, y, z = offset / math.sqrt(np.sum(offset * offset))
        basis = np.empty(25)
        sh_basis(x, y, z, basis)
        for channel in range(3):
            # A colour below 0 is drawn as 0 whatever its harmonics are.
            if table[k, RED + channel] > 0.0:
                for j in range(scene.harmonics.shape[1]):
                    row[HARMONICS + 3 * j + channel] = basis[j] * by_color[channel]
