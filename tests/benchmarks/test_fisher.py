"""Gradients of the rendered pixels, against finite differences of the renderer itself."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("numba")

from numpy.typing import NDArray

from benchmarks.baselines import fisher
from benchmarks.renderer import rasterizer
from refine_addon.core.splats import Splats
from refine_addon.core.views import View

STEP = 1e-6
BACKGROUND = (0.2, 0.5, 0.9)


def views_of(count: int = 3) -> list[View]:
    """Return views along z: unequal focal lengths, principal point off the middle."""
    rng = np.random.default_rng(1)
    return [
        View(np.eye(3), rng.normal(0, 0.3, 3), 31.0, 27.0, 17.0, 16.0, 37, 29) for _ in range(count)
    ]


def scene_of(count: int = 12, seed: int = 0) -> Splats:
    """Return large soft splats ahead of the views, one of them opaque."""
    rng = np.random.default_rng(seed)
    logits = rng.normal(0, 1, count)
    logits[0] = 9.0
    return Splats(
        rng.normal([0, 0, 4.0], 0.9, (count, 3)),
        rng.normal(-0.6, 0.4, (count, 3)),
        rng.normal(size=(count, 4)),
        logits,
        rng.normal(0, 1, (count, 3)),
        rng.normal(0, 0.4, (count, 15, 3)),
    )


def differences(splats: Splats, view: View, index: int) -> NDArray[np.float64]:
    """Return central differences of the picture by one mean and log scale, (H, W, 3, 6)."""
    columns = []
    for name in ("means", "log_scales"):
        for axis in range(3):
            pictures = []
            for sign in (1, -1):
                changed = getattr(splats, name).copy()
                changed[index, axis] += sign * STEP
                moved = replace(splats, **{name: changed})
                pictures.append(rasterizer.render(moved, view, background=BACKGROUND))
            columns.append((pictures[0] - pictures[1]) / (2 * STEP))
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("index", [0, 1, 5, 8, 11])
def test_the_fisher_matrix_is_that_of_finite_differences(index: int) -> None:
    """J' J summed over pixels, channels and views.

    A step moves a footprint's edge over a pixel with probability 1e-6 each: this scene has none.
    """
    splats, views = scene_of(), views_of()
    expected = np.zeros((6, 6))
    for view in views:
        jacobian = differences(splats, view, index)
        expected += np.einsum("hwcp,hwcq->pq", jacobian, jacobian)

    found = fisher.fisher(splats, views, background=BACKGROUND)[index]

    assert np.linalg.norm(expected) > 0.1
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=1e-5 * np.abs(expected).max())


def test_beyond_the_clamped_field_of_view_the_gradient_is_still_that_of_the_picture() -> None:
    """A splat 1.5 times the half image beside the axis, so large that it reaches into the image."""
    view = views_of(1)[0]
    splats = scene_of(3)
    slope = (view.width - view.cx) / view.fx + 0.3 * view.width / view.fx
    splats.means[1] = view.center + np.array([slope * 3.0, 0.1, 3.0])
    splats.log_scales[1] = math.log(0.9)
    jacobian = differences(splats, view, 1)

    found = fisher.fisher(splats, [view], background=BACKGROUND)[1]

    expected = np.einsum("hwcp,hwcq->pq", jacobian, jacobian)
    assert np.linalg.norm(expected) > 0.01
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max())


def test_the_score_is_the_log_determinant_by_mean_and_scale() -> None:
    """By scale the last three derivatives are those by log scale over the scale."""
    splats, views = scene_of(), views_of()
    matrices = fisher.fisher(splats, views)
    factor = np.ones((len(splats), 6))
    factor[:, 3:] = np.exp(-splats.log_scales)
    expected = np.linalg.slogdet(matrices * factor[:, :, None] * factor[:, None, :])[1]

    np.testing.assert_allclose(fisher.pup(splats, views), expected, rtol=1e-6)


def test_a_splat_that_no_view_sees_scores_lowest() -> None:
    """Its F is zero: log 0, minus infinity, and no warning."""
    splats = scene_of()
    splats.means[3] = [0, 0, -5.0]

    scores = fisher.pup(splats, views_of())

    assert scores[3] == -np.inf
    assert np.isfinite(np.delete(scores, 3)).all()
