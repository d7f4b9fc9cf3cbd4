"""Training on photos: gradients against finite differences, and that it wins back what it can."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("numba")
pytest.importorskip("skimage")

from benchmarks.renderer import rasterizer
from benchmarks.renderer.footprints import camera_of, gaussians_of
from benchmarks.renderer.gradients import HARMONICS, gradient
from benchmarks.tables import finetune
from benchmarks.tables.evaluate import Evaluator
from refine_addon.core.splats import Splats, rotation_matrices
from refine_addon.core.views import View, ViewSet

STEP = 1e-6
BACKGROUND = (0.2, 0.5, 0.9)
VIEW = View(np.eye(3), np.array([0.1, -0.2, 0.3]), 31.0, 27.0, 17.0, 16.0, 37, 29, name="a")
AWAY = replace(VIEW, center=np.array([-0.3, 0.2, -0.1]), name="b")


def scene_of(count: int = 12) -> Splats:
    """Return large soft splats ahead of the view, the first of them opaque, the second dark."""
    rng = np.random.default_rng(0)
    splats = Splats(
        rng.normal([0, 0, 4.0], 0.9, (count, 3)),
        rng.normal(-0.6, 0.4, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(0, 1, count),
        rng.normal(0, 1, (count, 3)),
        rng.normal(0, 0.4, (count, 15, 3)),
    )
    splats.opacity_logits[0] = 9.0
    splats.sh_dc[1] = -9.0
    return splats


@pytest.mark.parametrize("index", [0, 1, 5, 11])
def test_the_gradient_is_that_of_finite_differences(index: int) -> None:
    """Of the loss ``sum of G image``, G random: central differences by every parameter.

    Harmonics are linear and kept in float32, so their step is a large power of two. A turn of angle
    w about an axis multiplies the quaternion from the left by (cos w/2, sin w/2 axis).
    """
    splats = scene_of()
    weights = np.random.default_rng(1).normal(size=(VIEW.height, VIEW.width, 3))
    expected = np.zeros(HARMONICS + 48)
    for column in range(len(expected)):
        step = 2.0**-10 if column >= HARMONICS else STEP
        values = []
        for sign in (1.0, -1.0):
            parameters = finetune._Parameters(splats)
            change = np.zeros_like(parameters.values)
            change[index, column] = sign * step
            parameters.move(change)
            image = rasterizer.render(parameters.splats(), VIEW, background=BACKGROUND)
            values.append(np.sum(weights * image))
        expected[column] = (values[0] - values[1]) / (2.0 * step)

    axes = rotation_matrices(splats.quaternions) * np.exp(splats.log_scales)[:, None, :]
    scene, camera = gaussians_of(splats), camera_of(VIEW)
    found = gradient(scene, axes, camera, weights, background=BACKGROUND)[index]

    assert np.count_nonzero(expected) >= 10
    largest = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=2e-4, atol=2e-4 * largest)


def test_the_gradient_of_the_loss_is_that_of_finite_differences() -> None:
    """At every fortieth pixel of a random picture, by central differences."""
    rng = np.random.default_rng(0)
    image, photo = rng.random((13, 17, 3)), rng.random((13, 17, 3))
    found = finetune.loss(image, photo)[1].reshape(-1)

    for place in range(0, image.size, 40):
        values = []
        for sign in (1.0, -1.0):
            changed = image.copy()
            changed.reshape(-1)[place] += sign * STEP
            values.append(finetune.loss(changed, photo)[0])
        assert found[place] == pytest.approx((values[0] - values[1]) / (2.0 * STEP), rel=1e-5)


def test_equal_pictures_have_no_loss() -> None:
    """Mean difference 0, SSIM 1, and no slope but that of |0|, which counts as 0."""
    image = np.random.default_rng(0).random((16, 16, 3))

    value, slope = finetune.loss(image, image)

    assert value == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(slope, 0.0, atol=1e-12)


def test_training_wins_back_colour_opacity_and_shape() -> None:
    """Splats that were darkened, thinned, shrunk and turned come closer to pictures of the former.

    The mean squared error over both views falls to less than a third.
    """
    splats = scene_of()
    views = ViewSet((VIEW, AWAY))
    photos = {view.name: rasterizer.render(splats, view) for view in views}
    worse = replace(
        splats,
        sh_dc=splats.sh_dc - 0.4,
        opacity_logits=splats.opacity_logits - 0.4,
        log_scales=splats.log_scales - 0.15,
        quaternions=finetune.turned(
            splats.quaternions / np.linalg.norm(splats.quaternions, axis=1, keepdims=True),
            np.full((len(splats), 3), 0.1),
        ),
    )

    tuned = finetune.tune(worse, views, photos, 150)

    def error(now: Splats) -> float:
        pairs = ((rasterizer.render(now, view), photos[view.name]) for view in views)
        return sum(float(np.mean((image - photo) ** 2)) for image, photo in pairs)

    assert error(tuned) < error(worse) / 3
    assert np.abs(tuned.log_scales - worse.log_scales).max() > 0.01
    assert np.abs(tuned.quaternions - worse.quaternions).max() > 0.001


def test_a_splat_that_cannot_be_drawn_is_left_out_and_a_zero_quaternion_is_none() -> None:
    """NaN would spread over everything; a quaternion of zeros counts as the identity."""
    splats = scene_of()
    splats.means[3, 0] = np.nan
    splats.quaternions[4] = 0.0
    photos = {"a": np.zeros((VIEW.height, VIEW.width, 3))}

    tuned = finetune.tune(splats, ViewSet((VIEW, AWAY)), photos, 3)

    assert len(tuned) == len(splats) - 1
    assert np.isfinite(tuned.means).all()
    assert np.isfinite(tuned.quaternions).all()


def test_photos_of_held_out_views_are_needed() -> None:
    """Nothing else could say whether training won anything."""
    views = ViewSet((VIEW, AWAY))
    evaluator = Evaluator(scene_of(), views, metrics=("psnr",))
    photos = {view.name: rasterizer.render(scene_of(), view) for view in views}

    with pytest.raises(ValueError, match="photos of held-out views"):
        finetune.measure(lambda *_: scene_of(), ["some"], (views, photos), evaluator, 1)
