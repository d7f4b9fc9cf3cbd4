"""The Hessian of the pictures: its Jacobian against the renderer, its ratios by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("numba")

from benchmarks.renderer import rasterizer
from benchmarks.renderer.jacobians import CONTRAST, MOVES
from benchmarks.tables import hessian
from refine_addon.core.splats import Splats
from refine_addon.core.views import View, ViewSet

STEP = 1e-6
VIEW = View(np.eye(3), np.array([0.1, -0.2, 0.3]), 31.0, 27.0, 17.0, 16.0, 37, 29)


def scene_of(count: int = 12) -> Splats:
    """Return large soft splats ahead of the view."""
    rng = np.random.default_rng(0)
    return Splats(
        rng.normal([0, 0, 4.0], 0.9, (count, 3)),
        rng.normal(-0.6, 0.4, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(0, 1, count),
        rng.normal(0, 1, (count, 3)),
        rng.normal(0, 0.4, (count, 15, 3)),
    )


@pytest.mark.parametrize("index", [1, 5, 11])
def test_the_jacobian_is_that_of_finite_differences(index: int) -> None:
    """All 14 parameters of a splat, every pixel and channel.

    Colours are linear and kept in float32, so their step is large and a power of two.
    """
    splats = scene_of()
    columns = []
    names = {"means": 3, "log_scales": 3, "quaternions": 4, "opacity_logits": 1, "sh_dc": 3}
    for name, size in names.items():
        step = 2.0**-10 if name == "sh_dc" else STEP
        for axis in range(size):
            pictures = []
            for sign in (1, -1):
                changed = getattr(splats, name).copy()
                changed.reshape(len(splats), -1)[index, axis] += sign * step
                pictures.append(rasterizer.render(replace(splats, **{name: changed}), VIEW))
            columns.append((pictures[0] - pictures[1]) / (2 * step))
    expected = np.stack(columns, axis=-1).reshape(-1, 3, 14)
    camera = rasterizer.camera_of(VIEW)

    rows = hessian.rows_of(hessian._prepare(splats), camera, np.array([index]))

    found = np.zeros_like(expected)
    found[rows.pixels] = rows.jacobian(np.arange(len(rows.pixels)))
    assert np.abs(expected).max() > 0.1
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_what_a_hit_changes_is_the_removal_error_of_the_renderer() -> None:
    """Summed squares over pixels and channels; also of a splat whose alpha is clamped.

    Nothing here is opaque enough to end a pixel, so that removing moves no end.
    """
    splats = scene_of()
    splats.opacity_logits[5] = 9.0
    camera = rasterizer.camera_of(VIEW)
    expected = rasterizer.render_with_statistics(splats, VIEW)[1].removal_error

    rows = hessian.rows_of(hessian._prepare(splats), camera, np.arange(len(splats)))

    squares = np.sum(rows.values[:, CONTRAST : CONTRAST + 3] ** 2, axis=1)
    found = np.bincount(rows.splats, squares, len(splats))
    assert np.count_nonzero(rows.values[:, MOVES] == 0.0) > 0
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-18)


def test_energies_by_hand() -> None:
    """Blocks of 2 in [[1,0,2,0],[0,1,0,0],[2,0,3,0],[0,0,0,0]]: (1+1+9) of (11+8); alone: same."""
    matrix = np.zeros((4, 4))
    matrix[0, 0] = matrix[1, 1] = 1.0
    matrix[0, 2] = matrix[2, 0] = 2.0
    matrix[2, 2] = 3.0

    assert hessian.block_energy(matrix, 2) == pytest.approx(11 / 19)
    assert hessian.block_energy(matrix, 4) == 1.0


def test_splats_far_apart_in_the_image_are_independent() -> None:
    """Two small splats that share no pixel: every block off the diagonal is zero."""
    splats = scene_of(2)
    splats.means[:] = [[-0.8, 0, 3.0], [1.0, 0, 3.0]]
    splats.log_scales[:] = -3.0

    found = hessian.measure(splats, ViewSet((VIEW,)), groups=2, neighbours=1)

    assert (found.primitives, found.removals) == pytest.approx((1.0, 1.0), abs=1e-12)
    assert found.primitives_unitless == pytest.approx(1.0)
    assert found.attributes < 1.0


def test_splats_that_no_view_sees_are_left_out() -> None:
    """One behind the camera: only the other counts."""
    splats = scene_of(2)
    splats.means[:] = [[0, 0, 3.0], [0, 0, -3.0]]

    assert hessian.measure(splats, ViewSet((VIEW,)), groups=2, neighbours=0).groups == 1


def test_two_equal_splats_are_as_dependent_as_can_be() -> None:
    """Faint twins change the pictures alike: of four equal entries two are on the diagonal."""
    splats = scene_of(2).take(np.array([1, 1]))
    splats.opacity_logits[:] = -5.0

    found = hessian.measure(splats, ViewSet((VIEW,)), groups=1, neighbours=1)

    assert found.removals == pytest.approx(0.5, abs=0.01)
    assert found.primitives == pytest.approx(0.5, abs=0.05)
