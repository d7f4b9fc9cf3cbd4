"""A reference renderer of 3D Gaussian splats on the CPU, and what each splat does to the picture.

Every pruning method is measured in pictures of this renderer, and the rendered baselines take their
statistics from it. It computes in float64 and follows the reference implementation's rules
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

Splats of another model (`Splats.model`) are drawn as its papers say. Antialiased ones have the
opacity ``o sqrt(det C / det(C + 0.3 I))``, C the covariance without the low-pass (Yu et al. 2024,
"Mip-Splatting"; gsplat). Discs are hit where the ray meets their plane, ``q = u^2 + v^2`` there,
and at most twice the squared distance in pixels from the centre (Huang et al. 2024, "2D Gaussian
Splatting"); see `footprints.disc_distance`.

One rule differs: the reference implementation draws a splat in the 16-pixel tiles that a square of
three standard deviations touches, so the cut depends on where the tiles lie. Here the footprint
ends where alpha reaches 1/255, and tiles only make it fast: no pixel depends on them. Nor does
any result depend on the number of threads, to the last bit.

Frame: OpenCV. Camera x right, y down, z forward; `rotation` is world to camera.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from refine_addon.core.splats import Splats
from refine_addon.core.views import View

from .compositing import (
    HITS,
    OPACITY_SUM,
    REMOVAL,
    SUMS,
    WEIGHT,
    WEIGHT_MAX,
    Bins,
    Target,
    bins_of,
    draw_tiles,
    merge,
)
from .footprints import (
    Camera,
    Gaussians,
    camera_of,
    footprints_of,
    gaussians,
    gaussians_of,
    sh_basis,
)

__all__ = [
    "Camera",
    "Gaussians",
    "Statistics",
    "accumulate_statistics",
    "camera_of",
    "gaussians",
    "gaussians_of",
    "render",
    "render_with_statistics",
    "sh_basis",
]


@dataclass(frozen=True, eq=False)
class Statistics:
    """What every splat does to the pixels of one view or of several.

    A hit is a pixel in which the splat is drawn: alpha at least 1/255 and the pixel not finished.
    T is the transmittance in front of the splat there.

    - weight_sum, (N,) float64: Sum of alpha T over all hits.
    - weight_max, (N,) float64: Largest alpha T of any hit; 0 without a hit.
    - opacity_sum, (N,) float64: Sum of opacity T over all hits, LightGaussian's count (Fan et al.
      2024, Eq. 3).
    - hits, (N,) int64: Number of hits.
    - removal_error, (N,) float64: Sum over pixels and channels of the squared change of the picture
      if this one splat were removed. See `compositing.removal_errors` for the derivation.
    """

    weight_sum: NDArray[np.float64]
    weight_max: NDArray[np.float64]
    opacity_sum: NDArray[np.float64]
    hits: NDArray[np.int64]
    removal_error: NDArray[np.float64]


def render(
    splats: Splats | Gaussians,
    view: View | Camera,
    *,
    near: float = 0.2,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> NDArray[np.float64]:
    """Draw one view.

    - splats: `Gaussians` saves the activation where many views are drawn.
    - view: Its clip distances and weight mean nothing here.
    - near: Splats whose mean is not deeper than this are not drawn, world units.
    - background: Colour where nothing is.

    - returned, (height, width, 3) float64: Not clipped: colours may exceed 1.
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
    total = np.zeros((len(prepared.means), SUMS))
    for view in views:
        _, sums = _draw(prepared, _camera(view), near, background, statistics=True)
        largest = np.maximum(total[:, WEIGHT_MAX], sums[:, WEIGHT_MAX])
        total += sums
        total[:, WEIGHT_MAX] = largest
    return _statistics(total)


def _statistics(sums: NDArray[np.float64]) -> Statistics:
    """Name the columns of `sums`, (N, 5)."""
    columns = [np.ascontiguousarray(column) for column in sums.T]
    return Statistics(
        columns[WEIGHT],
        columns[WEIGHT_MAX],
        columns[OPACITY_SUM],
        columns[HITS].astype(np.int64),
        columns[REMOVAL],
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
    footprints = footprints_of(scene, camera, near)
    bins = bins_of(footprints.boxes, camera.width, camera.height)
    target = Target(
        np.array(background, np.float64),
        np.empty((camera.height, camera.width, 3)),
        np.zeros((len(bins.entries) if statistics else 0, SUMS)),
    )
    draw_tiles(dealt(bins), bins, footprints, target)
    sums = np.zeros((len(scene.means) if statistics else 0, SUMS))
    if statistics:
        merge(bins.entries, footprints.index, target.sums, sums)
    return target.image, sums


def dealt(bins: Bins) -> NDArray[np.int64]:
    """Return the tiles in an order whose contiguous runs, one for each thread, weigh the same."""
    heaviest_first = np.argsort(-np.diff(bins.starts), kind="stable")
    threads = numba.get_num_threads()
    return np.concatenate([heaviest_first[k::threads] for k in range(threads)])
