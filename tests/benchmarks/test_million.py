"""Scenes split into more splats, and the files that commands are given."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("numba")
pytest.importorskip("skimage")

from pathlib import Path

from benchmarks.renderer import rasterizer
from benchmarks.renderer.footprints import gaussians_of
from benchmarks.tables import million, sizes
from refine_addon.core.cameras.read import read_cameras
from refine_addon.core.formats.ply import read_ply
from refine_addon.core.splats import Splats, opacity
from refine_addon.core.views import View, ViewSet

VIEW = View(np.eye(3), np.zeros(3), 62.0, 62.0, 32.0, 24.0, 64, 48, name="front")


def scene_of(count: int = 20) -> Splats:
    """Return faint splats of three different axes ahead of the view."""
    rng = np.random.default_rng(0)
    return Splats(
        rng.normal([0, 0, 4.0], 0.5, (count, 3)).astype(np.float32),
        rng.normal([-1.0, -1.5, -3.0], 0.2, (count, 3)).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.normal(-2.0, 0.5, count).astype(np.float32),
        rng.normal(0, 1, (count, 3)).astype(np.float32),
        np.zeros((count, 3, 3), np.float32),
    )


def full(six: np.ndarray) -> np.ndarray:
    """Return symmetric matrices of xx, xy, xz, yy, yz, zz."""
    return six[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)


def test_the_two_of_a_split_splat_have_its_mean_covariance_and_thickness() -> None:
    """The covariance of a mixture is the mean of the two's plus that of their centres.

    Thickness times volume, - ln(1 - opacity) times the product of the scales, is halved.
    """
    one = scene_of(5)

    first, second = million._halves(one, np.random.default_rng(0))

    whole = gaussians_of(one)
    halves = [gaussians_of(part) for part in (first, second)]
    aside = (halves[0].means - halves[1].means) / 2.0
    mean = (halves[0].means + halves[1].means) / 2.0
    covariance = (full(halves[0].covariances) + full(halves[1].covariances)) / 2.0
    covariance += aside[:, :, None] * aside[:, None, :]
    np.testing.assert_allclose(mean, whole.means, atol=1e-6)
    np.testing.assert_allclose(covariance, full(whole.covariances), atol=1e-6)
    for part, scene in zip((first, second), halves, strict=True):
        before = -np.log1p(-whole.opacities) * np.exp(one.log_scales.sum(axis=1))
        after = -np.log1p(-scene.opacities) * np.exp(part.log_scales.sum(axis=1))
        np.testing.assert_allclose(after, before / 2.0, rtol=1e-4)


def test_splitting_makes_the_number_asked_for_and_keeps_the_picture() -> None:
    """20 become 133, by three rounds of which the last splits the largest; over 30 dB alike."""
    splats = scene_of()

    many = million.split(splats, 133)

    assert len(many) == 133
    error = np.mean((rasterizer.render(many, VIEW) - rasterizer.render(splats, VIEW)) ** 2)
    assert -10.0 * math.log10(error) > 30.0


def test_the_largest_are_split_first() -> None:
    """One of three becomes two: that with the largest product of its two longest axes."""
    splats = scene_of(3)
    splats.log_scales[:] = [[-1, -3, -9], [-2, -1, -3], [-1, -2.5, -1.6]]

    many = million.split(splats, 4)

    np.testing.assert_array_equal(many.means[:2], splats.means[[1, 0]])


def test_fewer_than_there_are_is_refused() -> None:
    """Splitting only makes more."""
    with pytest.raises(ValueError, match="cannot make 3 splats of 20"):
        million.split(scene_of(), 3)


def test_an_opaque_splat_stays_drawable() -> None:
    """Its thickness has no bound; an opacity next to 1 stands for it."""
    splats = scene_of()
    splats.opacity_logits[:] = [40.0, np.inf] * 10

    many = million.split(splats, 40)

    assert np.isfinite(many.opacity_logits).all()
    assert opacity(many.opacity_logits).min() > 0.99


def test_files_read_as_they_were_written(tmp_path: Path) -> None:
    """The splats to the bit, the cameras to rounding."""
    splats = scene_of()
    turned = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    views = ViewSet((VIEW, replace(VIEW, rotation=turned, center=np.ones(3), name="side")))

    million.write_ply(tmp_path / "in.ply", splats)
    million.write_cameras(tmp_path / "cameras.json", views)

    read = read_ply(tmp_path / "in.ply").splats()
    for name in vars(splats):
        np.testing.assert_array_equal(getattr(read, name), getattr(splats, name))
    for view, other in zip(read_cameras(tmp_path / "cameras.json"), views, strict=True):
        np.testing.assert_allclose(view.rotation, other.rotation, atol=1e-12)
        np.testing.assert_array_equal(view.center, other.center)
        found = (view.fx, view.cx, view.cy, view.width, view.height, view.name)
        assert found == (other.fx, other.cx, other.cy, other.width, other.height, other.name)


def test_scaled_cameras_see_the_same_in_other_pixels() -> None:
    """A point at column u of a picture 64 wide lies at 2.5 u in one 160 wide, rows alike."""
    point = np.array([0.3, -0.2, 2.0])

    larger = sizes.scaled(ViewSet((VIEW,)), 160)[0]

    assert (larger.width, larger.height) == (160, 120)
    for focal, middle, larger_focal, larger_middle, place in (
        (VIEW.fx, VIEW.cx, larger.fx, larger.cx, point[0]),
        (VIEW.fy, VIEW.cy, larger.fy, larger.cy, point[1]),
    ):
        before = focal * place / point[2] + middle
        after = larger_focal * place / point[2] + larger_middle
        assert after == pytest.approx(2.5 * before)
