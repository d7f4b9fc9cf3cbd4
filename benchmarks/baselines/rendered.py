"""What others prune by, on one footing: the same splats, the same views, the same renderer.

Every baseline is a function ``(splats, views, statistics) -> (N,) float64``, higher stays. The
statistics are those of `rasterizer.accumulate_statistics` over the scoring views; methods that do
not render ignore them (`RENDERED` names those that do).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from refine_addon.core.splats import Splats
from refine_addon.core.splats import opacity as activated_opacity
from refine_addon.core.views import ViewSet

from ..renderer.rasterizer import Statistics, accumulate_statistics
from . import fisher

Baseline = Callable[["Splats", "ViewSet", "Statistics | None"], "NDArray[np.float64]"]

VOLUME_POWER = 0.1
"""Exponent of the normalised volume in LightGaussian and MesonGS."""
ROUNDS = 8
"""Of removing by the removal error, with new renders in between."""


def random(
    splats: Splats, views: ViewSet, statistics: Statistics | None, *, seed: int = 0
) -> NDArray[np.float64]:
    """Score uniformly at random in [0, 1)."""
    del views, statistics
    return np.random.default_rng(seed).random(len(splats))


def opacity(splats: Splats, views: ViewSet, statistics: Statistics | None) -> NDArray[np.float64]:
    """Score by opacity, what the reference training itself prunes by."""
    del views, statistics
    return activated_opacity(splats.opacity_logits)


def light_gaussian(
    splats: Splats, views: ViewSet, statistics: Statistics | None
) -> NDArray[np.float64]:
    """Score by LightGaussian's global significance (Fan et al., NeurIPS 2024, Eq. 3 and 4).

    Sum over pixel hits of opacity T, times ``min(V / V90, 1)^0.1``; V is the product of the scales,
    V90 the volume that 90 % of the splats stay below.
    """
    del views
    relative = np.minimum(_relative_volume(splats, 0.9), 1.0)
    return _required(statistics).opacity_sum * relative**VOLUME_POWER


def meson_gs(splats: Splats, views: ViewSet, statistics: Statistics | None) -> NDArray[np.float64]:
    """Score by MesonGS's importance (Xie et al., ECCV 2024): weights and volume.

    Sum over pixel hits of alpha T, times ``(V / V_k)^0.1``. V_k, some quantile of the volume,
    scales all scores alike and so does not matter to the order; it is LightGaussian's here.
    """
    del views
    return _required(statistics).weight_sum * _relative_volume(splats, 0.9) ** VOLUME_POWER


def rad_splat(splats: Splats, views: ViewSet, statistics: Statistics | None) -> NDArray[np.float64]:
    """Score by RadSplat's importance (Niemeyer et al., 2024): the largest alpha T."""
    del splats, views
    return _required(statistics).weight_max


def removal_error(
    splats: Splats, views: ViewSet, statistics: Statistics | None
) -> NDArray[np.float64]:
    """Score by the exact squared error that removing this one splat adds to the pictures."""
    del splats, views
    return _required(statistics).removal_error


def removed_in_rounds(
    splats: Splats, views: ViewSet, keep_count: int, rounds: int = ROUNDS
) -> NDArray[np.int64]:
    """Remove splats by `removal_error` in rounds of equal size, rendered anew before each.

    POTR prunes so: what one removal costs depends on what else has gone.

    - returned, (keep_count,) int64: Which splats stay, ascending; of equal errors the first.
    """
    left = np.arange(len(splats))
    for number in range(1, rounds + 1):
        errors = accumulate_statistics(splats.take(left), views).removal_error
        count = len(splats) - (len(splats) - keep_count) * number // rounds
        left = np.sort(left[np.argsort(-errors, kind="stable")[:count]])
    return left


def pup_3dgs(splats: Splats, views: ViewSet, statistics: Statistics | None) -> NDArray[np.float64]:
    """Score by PUP 3D-GS's log determinant (Hanson, Tu et al., CVPR 2025); see `fisher`.

    It renders gradients of its own, so the statistics are no use to it.
    """
    del statistics
    return fisher.pup(splats, views)


BASELINES: dict[str, Baseline] = {
    "random": random,
    "opacity": opacity,
    "lightgaussian": light_gaussian,
    "mesongs": meson_gs,
    "radsplat": rad_splat,
    "removal-error": removal_error,
    "pup-3dgs": pup_3dgs,
}
"""Name on the command line -> function."""

RENDERED = frozenset({"lightgaussian", "mesongs", "radsplat", "removal-error"})
"""Which of them need rendered statistics."""


def _relative_volume(splats: Splats, quantile: float) -> NDArray[np.float64]:
    """Return each splat's product of scales over that quantile of them, (N,)."""
    volume = np.exp(np.sum(np.asarray(splats.log_scales, np.float64), axis=1))
    return volume / np.sort(volume)[int(len(volume) * quantile)]


def _required(statistics: Statistics | None) -> Statistics:
    if statistics is None:
        raise ValueError("this baseline needs the statistics of rendered views, got None")
    return statistics
