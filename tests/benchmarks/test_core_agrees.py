"""What core and the 3D view draw and measure, beside the reference renderer."""

import math

import numpy as np
import pytest

pytest.importorskip("numba")

from benchmarks.renderer import rasterizer
from benchmarks.renderer.footprints import (
    RED,
    camera_of,
    footprints_of,
    gaussians_of,
)
from refine_addon.core import Splats, View, ViewSet, read_cameras, read_splats
from refine_addon.core.pictures import CAMERAS, compare, draw
from refine_addon.core.splats import MODELS, with_model
from refine_addon.core.visibility import measuring, points, projection
from refine_addon.viewport import arrays
from refine_addon.viewport.arrays import Eye
from tests.places import ROOM

VIEW = View(np.eye(3), np.zeros(3), 100.0, 110.0, 60.3, 41.7, 120, 80, near=0.2)
SIDES = (12.0, 6.0, 3.0, 1.5)


@pytest.fixture(scope="module")
def room():
    return read_splats(ROOM / "point_cloud.ply").splats(), read_cameras(ROOM / "cameras.json")


def test_cells_converge_to_the_rendered_contributions_and_removal_errors(monkeypatch):
    """Halving the cells takes off a constant share of the error; 12 and 15 % are left at 1.5 px.

    Splats a few pixels large, several deep everywhere, half of them nearly opaque; errors are sums
    of absolute ones over the sum of values, without the edges.
    """
    rng = np.random.default_rng(8)
    splats = Splats(
        means=rng.uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 4.0], size=(400, 3)),
        log_scales=rng.normal(math.log(0.08), 0.4, size=(400, 3)),
        quaternions=rng.normal(size=(400, 4)),
        opacity_logits=rng.normal(1.0, 1.5, 400),
        sh_dc=rng.normal(size=(400, 3)),
        sh_rest=np.zeros((400, 0, 3)),
    )
    view = View(np.eye(3), np.zeros(3), 100.0, 100.0, 48.0, 36.0, 96, 72, near=0.2)
    _, exact = rasterizer.render_with_statistics(splats, view)
    middle = np.abs(splats.means[:, :2] / splats.means[:, 2:]).max(axis=1) < 0.25
    gaussians, frame, _ = projection.prepare(splats, ViewSet((view,)))
    errors = []
    for side in SIDES:
        for name, value in (("CELL", side), ("DENSITY", 8.0)):
            monkeypatch.setattr(points, name, value)
        total = measuring.measure(gaussians, frame, [(view, 1.0)], [range(1)])[0]
        back = np.argsort(gaussians.index)
        pairs = zip(total[:2], (exact.weight_sum, exact.removal_error), strict=True)
        errors.append([
            np.abs(found[back] - truth)[middle].sum() / truth[middle].sum()
            for found, truth in pairs
        ])  # fmt: skip

    slopes = np.polyfit(np.log2(SIDES), np.log2(errors), 1)[0]
    assert (np.diff(errors, axis=0) < 0).all()
    assert (slopes > 0.6).all(), errors
    assert (np.array(errors[-1]) < [0.12, 0.15]).all(), errors


def test_pictures_are_those_of_the_reference_renderer(room):
    """Rounding to 8 bits alone, errors even within +-.5 / 255, makes 10 log10(12 255^2) = 58.9 dB.

    The measured PSNR of a half removed at random is that of two renders to .01 dB.
    """
    splats, views = room
    half = splats.take(np.random.default_rng(0).random(len(splats)) < 0.5)

    for found in compare(splats, half, views.spread(CAMERAS)):
        near = found.view.near
        one, other = (
            rasterizer.render(s, found.view, near=near).clip(0.0, 1.0) for s in (splats, half)
        )
        assert -10.0 * np.log10(np.mean((found.before / 255.0 - one) ** 2)) > 58.5
        assert abs(found.psnr + 10.0 * np.log10(np.mean((other - one) ** 2))) < 0.01


def test_the_3d_view_draws_the_gaussians_and_colours_of_the_reference_renderer(room):
    """All covariances to float32; the colours of a view to float16's 2^-11, summed over 16."""
    splats, view = room[0], room[1][20]
    scene, packed = gaussians_of(splats), arrays.pack(splats)
    drawn = footprints_of(scene, camera_of(view), near=0.2)
    eye = Eye(
        np.append(view.rotation[2], -view.rotation[2] @ view.center), view.center, perspective=True
    )
    shown, depths = arrays.in_front(packed.means, eye, 0.2)
    colors = np.zeros((len(splats), 3))
    colors[packed.vertices] = arrays.colors(packed, eye)[:, :3]

    scale = np.abs(scene.covariances).max(axis=1, keepdims=True)[packed.vertices]
    away = packed.covariances[:, :6] - scene.covariances[packed.vertices]
    assert (np.abs(away) <= 1e-6 * scale).all()
    assert set(drawn.index) <= set(packed.vertices[shown])
    assert (depths > 0.2).all()
    np.testing.assert_allclose(colors[drawn.index], drawn.table[:, RED : RED + 3], atol=4e-3)


def cloud(count, seed=0, size=-3.0):
    random = np.random.default_rng(seed)
    return Splats(
        means=random.uniform([-2.5, -1.6, 1.0], [2.5, 1.6, 6.0], (count, 3)),
        log_scales=random.normal(size, 1.0, (count, 3)),
        quaternions=random.normal(size=(count, 4)),
        opacity_logits=random.normal(0.0, 2.0, count),
        sh_dc=random.normal(size=(count, 3)),
        sh_rest=random.normal(0.0, 0.2, (count, 8, 3)),
    )


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("size", [-6.0, -3.0, -0.5])
def test_core_draws_every_model_as_the_reference_renderer_does(model, size):
    """From splats smaller than a pixel to discs that the camera's plane cuts: 65 dB and more."""
    splats = with_model(cloud(300, 1, size), model)

    found = np.moveaxis(draw(splats, VIEW)[:3], 0, 2)

    expected = np.clip(rasterizer.render(splats, VIEW), 0.0, 1.0)
    assert -10.0 * np.log10(np.mean((found - expected) ** 2)) > 65.0
