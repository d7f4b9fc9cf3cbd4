"""Gradients of the rendered pixels against finite differences, and what is made of them."""

import math
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("numba")
pytest.importorskip("skimage")

from benchmarks.baselines import fisher
from benchmarks.renderer import rasterizer
from benchmarks.renderer.footprints import camera_of, gaussians_of
from benchmarks.renderer.gradients import HARMONICS, gradient
from benchmarks.tables import finetune
from benchmarks.tables.evaluate import Evaluator
from refine_addon.core.splats import Splats, rotation_matrices
from refine_addon.core.views import ViewSet
from tests.benchmarks.scenes import AWAY, BACKGROUND, VIEW, soft_scene

STEP = 1e-6
VIEWS = ViewSet((VIEW, AWAY))


@pytest.mark.parametrize("index", [0, 1, 5])
def test_the_gradient_is_that_of_finite_differences(index: int) -> None:
    """Of the loss ``sum of G image``, G random: central differences by every parameter.

    Harmonics are linear and kept in float32, so their step is a large power of two. A turn of angle
    w about an axis multiplies the quaternion from the left by (cos w/2, sin w/2 axis).
    """
    splats = soft_scene()
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


def beyond() -> Splats:
    """Return a scene whose splat 1 lies 1.5 times the half image beside the axis, but is large."""
    splats = soft_scene(3)
    slope = (VIEW.width - VIEW.cx) / VIEW.fx + 0.3 * VIEW.width / VIEW.fx
    splats.means[1] = VIEW.center + np.array([slope * 3.0, 0.1, 3.0])
    splats.log_scales[1] = math.log(0.9)
    splats.sh_dc[1] = 1.0
    return splats


@pytest.mark.parametrize(
    ("splats", "index", "least"),
    [(soft_scene(), 0, 0.1), (soft_scene(), 5, 0.1), (beyond(), 1, 0.01)],
)
def test_the_fisher_matrix_is_that_of_finite_differences(
    splats: Splats, index: int, least: float
) -> None:
    """J' J by mean and log scale, summed over pixels, channels and views; also beyond the clamp.

    A step moves a footprint's edge over a pixel with probability 1e-6 each: these scenes have none.
    """
    expected = np.zeros((6, 6))
    for view in VIEWS:
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
        jacobian = np.stack(columns, axis=-1)
        expected += np.einsum("hwcp,hwcq->pq", jacobian, jacobian)

    found = fisher.fisher(splats, VIEWS, background=BACKGROUND)[index]

    assert np.linalg.norm(expected) > least
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-5 * np.abs(expected).max())


def test_pups_score_is_the_log_determinant_by_mean_and_scale() -> None:
    """By scale the last three derivatives are those by log scale over the scale.

    What no view sees has F = 0: log 0, minus infinity, and no warning.
    """
    splats = soft_scene()
    splats.means[3] = [0, 0, -5.0]
    drawn = np.delete(np.arange(len(splats)), [1, 3])  # the second is black
    factor = np.ones((len(splats), 6))
    factor[:, 3:] = np.exp(-splats.log_scales)
    matrices = fisher.fisher(splats, VIEWS) * factor[:, :, None] * factor[:, None, :]

    scores = fisher.pup(splats, VIEWS)

    assert scores[3] == -np.inf
    np.testing.assert_allclose(scores[drawn], np.linalg.slogdet(matrices[drawn])[1], rtol=1e-6)


def test_the_gradient_of_the_loss_is_that_of_finite_differences() -> None:
    """At every fortieth pixel of a random picture; equal pictures have no loss and no slope."""
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

    value, slope = finetune.loss(image, image)
    assert value == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(slope, 0.0, atol=1e-12)


def test_training_wins_back_colour_opacity_and_shape() -> None:
    """Splats that were darkened, thinned, shrunk and turned come closer to pictures of the former.

    The mean squared error over both views falls to less than a third.
    """
    splats = soft_scene()
    photos = {view.name: rasterizer.render(splats, view) for view in VIEWS}
    lengths = np.linalg.norm(splats.quaternions, axis=1, keepdims=True)
    worse = replace(
        splats,
        sh_dc=splats.sh_dc - 0.4,
        opacity_logits=splats.opacity_logits - 0.4,
        log_scales=splats.log_scales - 0.15,
        quaternions=finetune.turned(splats.quaternions / lengths, np.full((len(splats), 3), 0.1)),
    )

    tuned = finetune.tune(worse, VIEWS, photos, 150)

    def error(now: Splats) -> float:
        pairs = ((rasterizer.render(now, view), photos[view.name]) for view in VIEWS)
        return sum(float(np.mean((image - photo) ** 2)) for image, photo in pairs)

    assert error(tuned) < error(worse) / 3
    assert np.abs(tuned.log_scales - worse.log_scales).max() > 0.01
    assert np.abs(tuned.quaternions - worse.quaternions).max() > 0.001


def test_training_leaves_out_what_cannot_be_drawn_and_needs_photos_of_held_out_views() -> None:
    """NaN would spread over everything; a quaternion of zeros counts as the identity."""
    splats = soft_scene()
    splats.means[3, 0] = np.nan
    splats.quaternions[4] = 0.0
    photos = {"a": np.zeros((VIEW.height, VIEW.width, 3))}

    tuned = finetune.tune(splats, VIEWS, photos, 3)

    assert len(tuned) == len(splats) - 1
    assert np.isfinite(tuned.means).all()
    assert np.isfinite(tuned.quaternions).all()
    evaluator = Evaluator(soft_scene(), VIEWS, metrics=("psnr",))
    with pytest.raises(ValueError, match="photos of held-out views"):
        finetune.measure(lambda *_: soft_scene(), ["some"], (VIEWS, photos), evaluator, 1)
