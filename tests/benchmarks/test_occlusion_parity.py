"""The froxel tier against the reference renderer: what it converges to, and how fast."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("numba")

from benchmarks.renderer import rasterizer
from refine_addon.core import Splats, View, ViewSet
from refine_addon.core.visibility import measuring, projection
from refine_addon.core.visibility.measuring import Measured, Sampling

SIDES = (12.0, 6.0, 3.0, 1.5)


def crowd(count=400) -> Splats:
    """Splats a few pixels large, several deep everywhere, half of them nearly opaque."""
    rng = np.random.default_rng(8)
    return Splats(
        means=rng.uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 4.0], size=(count, 3)),
        log_scales=rng.normal(math.log(0.08), 0.4, size=(count, 3)),
        quaternions=rng.normal(size=(count, 4)),
        opacity_logits=rng.normal(1.0, 1.5, count),
        sh_dc=rng.normal(size=(count, 3)),
        sh_rest=np.zeros((count, 0, 3)),
    )


def view() -> View:
    return View(np.eye(3), np.zeros(3), 100.0, 100.0, 48.0, 36.0, 96, 72, near=0.2)


def measured(splats: Splats, side: float) -> Measured:
    """Return what the froxels say with cells of `side` pixels, points three to a cell's side."""
    views = ViewSet((view(),))
    gaussians, frame, _ = projection.prepare(splats, views, threads=1)
    total = Measured.zero(len(gaussians))
    settings = Sampling(cell=side, density=8.0)
    total._add_view(measuring._measure_view(gaussians, frame, view(), settings)[1], 1.0)
    back = np.argsort(gaussians.index)
    return Measured(total.contribution[back], total.error[back], total.seen[back])


def relative_errors(kind: str) -> np.ndarray:
    """Sum of absolute errors over the sum of values, for each of `SIDES`; edges left out."""
    splats = crowd()
    _, exact = rasterizer.render_with_statistics(splats, view())
    truth = {"contribution": exact.weight_sum, "error": exact.removal_error}[kind]
    middle = np.abs(splats.means[:, :2] / splats.means[:, 2:]).max(axis=1) < 0.25
    errors = []
    for side in SIDES:
        found = getattr(measured(splats, side), kind)
        errors.append(np.abs(found - truth)[middle].sum() / truth[middle].sum())
    return np.array(errors)


def test_contributions_converge_to_the_rendered_ones():
    """Halving the cells takes off a constant share of the error; 12 % or less at 1.5 pixels."""
    errors = relative_errors("contribution")

    slope = np.polyfit(np.log2(SIDES), np.log2(errors), 1)[0]
    assert (np.diff(errors) < 0).all()
    assert slope > 0.6, errors
    assert errors[-1] < 0.12, errors


def test_errors_converge_to_the_rendered_removal_error():
    """The error is what the rendered picture changes by without one splat; 15 % or less at 1.5."""
    errors = relative_errors("error")

    slope = np.polyfit(np.log2(SIDES), np.log2(errors), 1)[0]
    assert (np.diff(errors) < 0).all()
    assert slope > 0.6, errors
    assert errors[-1] < 0.15, errors
