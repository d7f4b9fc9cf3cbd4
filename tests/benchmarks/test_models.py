"""Antialiased splats and discs in the reference renderer, and in what core draws."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.renderer import rasterizer
from benchmarks.renderer.footprints import camera_of, disc_distance, footprints_of, gaussians_of
from benchmarks.tables.models import discs, version
from refine_addon.core import Splats, View
from refine_addon.core.pictures import draw
from refine_addon.core.splats import MODELS, rotation_matrices, scales, with_model

VIEW = View(np.eye(3), np.zeros(3), 100.0, 110.0, 60.3, 41.7, 120, 80, near=0.2)


def cloud(count, seed=0, size=-3.0):
    random = np.random.default_rng(seed)
    means = random.uniform([-2.5, -1.6, 1.0], [2.5, 1.6, 6.0], (count, 3))
    return Splats(
        means=means,
        log_scales=random.normal(size, 1.0, (count, 3)),
        quaternions=random.normal(size=(count, 4)),
        opacity_logits=random.normal(0.0, 2.0, count),
        sh_dc=random.normal(size=(count, 3)),
        sh_rest=random.normal(0.0, 0.2, (count, 8, 3)),
    )


def test_an_antialiased_splat_keeps_its_mass_however_small():
    """The sum of alpha over pixels is the integral 2 pi o sqrt(det C), C = diag(s_k^2 f_k^2 / z^2).

    It is so as long as alpha ends far below the low-pass's edge: 1/255 cuts .0043 of o = .9's
    effective alpha off, a share of cut over alpha, which the expected value leaves out too.
    """
    size, depth = 0.012, 2.0
    splat = Splats(
        np.array([[0.01, 0.02, depth]]), np.full((1, 3), math.log(size)), np.eye(4)[:1],
        np.array([math.log(9.0)]), np.full((1, 3), 10.0), np.zeros((1, 0, 3)), "antialiased",
    )  # fmt: skip
    footprint = footprints_of(gaussians_of(splat), camera_of(VIEW), 0.2)

    image = rasterizer.render(splat, VIEW)

    light = 0.5 + 10.0 * 0.28209479177387814
    sharp = size**2 / depth**2 * VIEW.fx * VIEW.fy
    blurred = math.sqrt((sharp * 10 / 11 + 0.3) * (sharp * 11 / 10 + 0.3))
    peak = 0.9 * sharp / blurred
    assert footprint.table[0, 7] == pytest.approx(peak, rel=1e-4)
    expected = 2.0 * math.pi * blurred * (peak - 1 / 255)
    assert image[..., 0].sum() / light == pytest.approx(expected, rel=0.02)


def test_a_disc_is_hit_where_the_ray_meets_its_plane():
    """Against the intersection of line and plane, solved for each pixel on its own."""
    splats = replace(cloud(40, size=-2.0), model="2dgs")
    footprints = footprints_of(gaussians_of(splats), camera_of(VIEW), 0.2)
    axes, sizes = rotation_matrices(splats.quaternions), scales(splats.log_scales)
    checked = 0
    for k, index in enumerate(footprints.index.tolist()):
        mean, turn, size = splats.means[index], axes[index], sizes[index]
        u, v = footprints.table[k, :2]
        for x, y in ((u + 1.3, v - 2.1), (u - 7.0, v + 4.5)):
            ray = np.array([(x - VIEW.cx) / VIEW.fx, (y - VIEW.cy) / VIEW.fy, 1.0])
            hit = ray * (turn[:, 2] @ mean) / (turn[:, 2] @ ray)
            plane = np.sum((turn[:, :2].T @ (hit - mean) / size[:2]) ** 2)
            expected = min(plane, 2.0 * ((x - u) ** 2 + (y - v) ** 2))
            if hit[2] > 0.2:
                assert disc_distance(footprints.table[k], x, y) == pytest.approx(expected, rel=1e-6)
                checked += 1
    assert checked > 40


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("size", [-6.0, -3.0, -0.5])
def test_core_draws_every_model_as_the_reference_renderer_does(model, size):
    """From splats smaller than a pixel to discs that the camera's plane cuts: 65 dB and more."""
    splats = with_model(cloud(300, 1, size), model)

    found = np.moveaxis(draw(splats, VIEW)[:3], 0, 2)

    expected = np.clip(rasterizer.render(splats, VIEW), 0.0, 1.0)
    assert -10.0 * np.log10(np.mean((found - expected) ** 2)) > 65.0


def test_discs_lie_in_the_two_longest_axes():
    splats = cloud(20)

    flat = discs(splats)

    assert version(splats, "antialiased").model == "antialiased"
    axes = rotation_matrices(flat.quaternions) * scales(flat.log_scales)[:, None, :]
    whole = rotation_matrices(splats.quaternions) * scales(splats.log_scales)[:, None, :]
    shortest = np.argmin(splats.log_scales, axis=1)
    for index in range(20):
        thick = whole[index, :, shortest[index]]
        expected = whole[index] @ whole[index].T - np.outer(thick, thick)
        np.testing.assert_allclose(axes[index] @ axes[index].T, expected, rtol=1e-5, atol=1e-8)
