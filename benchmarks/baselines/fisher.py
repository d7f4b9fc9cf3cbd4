"""PUP 3D-GS: how well the pictures determine where a splat is and how large.

Hanson, Tu et al., "PUP 3D-GS: Principled Uncertainty Pruning for 3D Gaussian Splatting", CVPR 2025:
the score is ``log |det F|`` of the 6 x 6 Fisher matrix ``F = sum over views, pixels and channels of
J' J``, J the gradient of the rendered value by the splat's mean and scale, at the views' full
resolution. A splat whose F is singular (seen too little) has the lowest score there is.
"""

from __future__ import annotations

from collections.abc import Iterable

import numba
import numpy as np
from numpy.typing import NDArray

from refine_addon.core.splats import Splats, rotation_matrices
from refine_addon.core.views import View

from ..renderer.compositing import Bins, add_up, bins_of
from ..renderer.footprints import (
    Camera,
    Footprints,
    Gaussians,
    camera_of,
    footprints_of,
    gaussians_of,
)
from ..renderer.jacobians import (
    CONTRAST,
    E_X,
    E_Y,
    MOVES,
    SHAPE,
    WEIGHT,
    color_gradient,
    hits_of,
    shape_gradient,
)
from ..renderer.rasterizer import dealt

# Columns of a splat's moments: of contrast^2 w w' (upper triangle), of weight contrast w for each
# channel, and of weight^2.
_MIXED = SHAPE * (SHAPE + 1) // 2
_SQUARE = _MIXED + 3 * SHAPE
_MOMENTS = _SQUARE + 1


def pup(splats: Splats, views: Iterable[View]) -> NDArray[np.float64]:
    """Score splats by PUP 3D-GS, (N,) float64; minus infinity where F is singular."""
    matrices = fisher(splats, views)
    sign, logarithm = np.linalg.slogdet(matrices)
    # By scale instead of log scale: every derivative divided by its scale.
    logs = np.sum(np.asarray(splats.log_scales, np.float64), axis=1)
    usable = (sign > 0.0) & np.isfinite(logarithm) & np.isfinite(logs)
    return np.where(usable, logarithm - 2.0 * logs, -np.inf)


def fisher(
    splats: Splats,
    views: Iterable[View],
    *,
    near: float = 0.2,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> NDArray[np.float64]:
    """Sum J' J over the pixels and channels of all views.

    - returned, (N, 6, 6) float64: By the mean (3) and the logarithms of the scales (3).
    """
    scene = gaussians_of(splats)
    visible = scene.opacities > 0.0
    logs = np.where(visible[:, None], splats.log_scales, 0.0).astype(np.float64)
    axes = rotation_matrices(np.asarray(splats.quaternions)) * np.exp(logs)[:, None, :]
    total = np.zeros((len(splats), 6, 6))
    for view in views:
        camera = camera_of(view)
        footprints = footprints_of(scene, camera, near)
        bins = bins_of(footprints.boxes, camera.width, camera.height)
        moments = np.zeros((len(bins.entries), _MOMENTS))
        size = (camera.width, camera.height)
        _tiles(dealt(bins), bins, footprints, (size, np.array(background)), moments)
        merged = np.zeros((len(footprints.index), _MOMENTS))
        add_up(bins.entries, moments, merged)
        _add(scene, axes, camera, (footprints.index, merged), total)
    return total


@numba.njit(cache=True, parallel=True)
def _tiles(
    order: NDArray[np.int64],
    bins: Bins,
    footprints: Footprints,
    picture: tuple[tuple[int, int], NDArray[np.float64]],
    moments: NDArray[np.float64],
) -> None:
    """Fill `moments`, (entries, 31), tile by tile."""
    size, background = picture
    for k in numba.prange(len(order)):
        tile = order[k]
        hits = hits_of(tile, bins, footprints, size, background)
        mine = moments[bins.starts[tile] : bins.starts[tile + 1]]
        for hit in range(len(hits.owners)):
            _collect(hits.values[hit], mine[hits.owners[hit]])


@numba.njit(cache=True)
def _collect(values: NDArray[np.float64], row: NDArray[np.float64]) -> None:
    """Add one hit to its splat's moments."""
    x, y = values[E_X], values[E_Y]
    w = (x, y, 0.5 * x * x, x * y, 0.5 * y * y)
    contrast = values[MOVES] * values[CONTRAST : CONTRAST + 3]
    square = np.sum(contrast * contrast)
    column = 0
    for i in range(SHAPE):
        for j in range(i, SHAPE):
            row[column] += square * w[i] * w[j]
            column += 1
    for channel in range(3):
        for i in range(SHAPE):
            row[column] += values[WEIGHT] * contrast[channel] * w[i]
            column += 1
    row[column] += values[WEIGHT] * values[WEIGHT]


@numba.njit(cache=True, parallel=True)
def _add(
    scene: Gaussians,
    axes: NDArray[np.float64],
    camera: Camera,
    found: tuple[NDArray[np.int64], NDArray[np.float64]],
    total: NDArray[np.float64],
) -> None:
    """Add one view's J' J to `total`.

    With G = d shape / d parameters (5 x 6), D = d colour / d parameters (3 x 6) and J of one
    channel ``contrast w' G + weight D``: the sum of J' J needs only the moments.
    """
    index, moments = found
    for k in numba.prange(len(index)):
        i = index[k]
        shape, color = np.empty((SHAPE, 6)), np.zeros((3, 6))
        shape_gradient(scene.means[i], axes[i], camera, shape)
        color_gradient(scene.means[i], camera, scene.harmonics[i], color[:, :3])
        square = np.empty((SHAPE, SHAPE))
        column = 0
        for a in range(SHAPE):
            for b in range(a, SHAPE):
                square[a, b] = square[b, a] = moments[k, column]
                column += 1
        mixed = np.zeros((SHAPE, 6))
        for channel in range(3):
            for a in range(SHAPE):
                mixed[a] += moments[k, _MIXED + channel * SHAPE + a] * color[channel]
        cross = shape.T @ mixed
        total[i] += shape.T @ square @ shape + cross + cross.T
        total[i] += moments[k, _SQUARE] * (color.T @ color)
