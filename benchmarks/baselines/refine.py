"""REFINE as published: the paper's formulas, its authors' public code, and the paper's ablations.

*REFINE: Super-efficient 3D Gaussian Splatting Pruning via Rendering-Free Primitive Importance*
(arXiv 2606.09074, Eq. 7-20). There is no frustum test and no comparison with splats around. The
terms G, the division by their means and the calibration are facts of the authors' code. Views are
all used, where the code draws 64 at random.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from refine_addon.core.scoring.closed_form import CALIBRATION, LUMA
from refine_addon.core.splats import Splats, base_color, opacity
from refine_addon.core.views import ViewSet

CONSTANTS = {"z": (0.05, 0.05), "distance": (0.5, 1e-6)}
"""Eta and the constant beside the shortest axis: of the paper, and of its authors' code."""


def refine(
    splats: Splats,
    views: ViewSet,
    depth: Literal["z", "distance"],
    *,
    visibility: bool = True,
    projection: bool = True,
    equal_weights: bool = False,
) -> NDArray[np.float64]:
    """Score drawable splats as published, (N,).

    - depth, {"z", "distance"}: Along the view's axis, as in the paper; or to its centre, as in the
      authors' code.
    - visibility, projection, equal_weights: The paper's ablations: H without alpha, H without 1 /
      (d^2 + eta), lambda = 1/3 each.
    """
    eta, beside = CONSTANTS[depth]
    means = splats.means.astype(np.float64)
    alpha, luma = opacity(splats.opacity_logits), base_color(splats.sh_dc) @ np.array(LUMA)
    small, middle, large = np.exp(np.sort(splats.log_scales.astype(np.float64), axis=1)).T
    counted = np.zeros(len(splats))
    for view, weight in zip(views, views.weights, strict=True):
        away = means - view.center
        if not projection:
            counted += weight
        elif depth == "z":
            counted += weight / ((away @ view.rotation[2]) ** 2 + eta)
        else:
            counted += weight / (np.einsum("ni,ni->n", away, away) + eta)
    if visibility:
        counted *= alpha
    statistics = (
        max(math.log(np.mean(large / (small + beside)) + beside), 0.0),
        100.0 * np.var(luma),
        100.0 * np.mean(4.0 * alpha * (1.0 - alpha)),
    )
    weights = np.ones(3) if equal_weights else np.array(statistics) / CALIBRATION
    terms = counted * np.stack([large * middle, luma**2, alpha**2])
    means_of_terms = np.mean(terms, axis=1)
    shares = np.divide(weights, means_of_terms, out=np.zeros(3), where=means_of_terms > 0.0)
    return np.asarray(shares @ terms / weights.sum())
