"""The tiled renderer against a plain one that lays every splat over every pixel, by depth."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("numba")

import numba
from numpy.typing import NDArray

from benchmarks.renderer import rasterizer
from refine_addon.core.spherical_harmonics import basis
from refine_addon.core.splats import Splats, opacity, opacity_logits, rotation_matrices
from refine_addon.core.views import View
from tests.benchmarks.scenes import BACKGROUND, round_scene

# ----- the plain renderer: the whole model of rasterizer.py's docstring, nothing clever


def dense_geometry(scene: Splats, camera: View) -> list[tuple[float, ...]]:
    """For each splat its index, depth, u, v and inverse 2D covariance, front to back."""
    drawn = []
    for i in range(len(scene.means)):
        x, y, z = camera.rotation @ (scene.means[i] - camera.center)
        if z <= 0.2:
            continue
        half_x, half_y = camera.width / 2 / camera.fx, camera.height / 2 / camera.fy
        middle_x = (camera.width / 2 - camera.cx) / camera.fx
        middle_y = (camera.height / 2 - camera.cy) / camera.fy
        tx = z * np.clip(x / z, middle_x - 1.3 * half_x, middle_x + 1.3 * half_x)
        ty = z * np.clip(y / z, middle_y - 1.3 * half_y, middle_y + 1.3 * half_y)
        jacobian = np.array(
            [[camera.fx / z, 0, -camera.fx * tx / z**2], [0, camera.fy / z, -camera.fy * ty / z**2]]
        )
        axes = rotation_matrices(scene.quaternions[i]) @ np.diag(np.exp(scene.log_scales[i]))
        projected = jacobian @ camera.rotation @ axes
        inverse = np.linalg.inv(projected @ projected.T + 0.3 * np.eye(2))
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        drawn.append((z, i, u, v, inverse))
    return sorted(drawn, key=lambda item: item[:2])


def dense_render(
    scene: Splats, camera: View
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Image (H, W, 3) and the statistics that need one pass."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    image = np.zeros((camera.height, camera.width, 3))
    through = np.ones((camera.height, camera.width))
    finished = np.zeros((camera.height, camera.width), bool)
    toward = scene.means - camera.center
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    harmonics = np.concatenate([scene.sh_dc[:, None], scene.sh_rest], axis=1)
    shown = (0.5 + np.einsum("nk,nkc->nc", basis(toward, scene.sh_degree), harmonics)).clip(0.0)
    opacities, count = opacity(scene.opacity_logits), len(scene)
    stats = {n: np.zeros(count) for n in ("weight_sum", "weight_max", "opacity_sum", "hits")}
    for _, i, u, v, inverse in dense_geometry(scene, camera):
        offset = np.stack([columns - u, rows - v], axis=-1)
        square = np.einsum("hwi,ij,hwj->hw", offset, inverse, offset)
        alpha = np.minimum(0.99, opacities[i] * np.exp(-0.5 * square))
        covered = (alpha >= 1 / 255) & ~finished
        finished |= covered & (through * (1 - alpha) < 1e-4)
        hit = covered & ~finished
        weight = np.where(hit, alpha * through, 0.0)
        image += weight[..., None] * shown[i]
        stats["weight_sum"][i] = weight.sum()
        stats["weight_max"][i] = weight.max()
        stats["opacity_sum"][i] = opacities[i] * through[hit].sum()
        stats["hits"][i] = hit.sum()
        through = np.where(hit, through * (1 - alpha), through)
    return image + through[..., None] * np.array(BACKGROUND), stats


# ----- scenes


def random_camera(rng: np.random.Generator, width: int = 37, height: int = 29) -> View:
    """Any place and direction; unequal focal lengths, principal point off the middle."""
    return View(
        rotation_matrices(rng.normal(size=4)), rng.normal(size=3), 31.0, 27.0,
        width * 0.45, height * 0.6, width, height,
    )  # fmt: skip


def random_scene(
    rng: np.random.Generator, camera: View, count: int = 60, degree: int = 3, opaque: float = 0.5
) -> Splats:
    """Splats around the view's axis, some beside and behind; every shape from ball to needle."""
    local = rng.normal(size=(count, 3)) * [1.5, 1.5, 2.0] + [0, 0, 3.0]
    opacities = np.where(
        rng.random(count) < opaque, rng.uniform(0.9, 1.0, count), rng.random(count)
    )
    harmonics = rng.normal(0, 0.4, size=(count, (degree + 1) ** 2, 3)).astype(np.float32)
    return Splats(
        local @ camera.rotation + camera.center,
        rng.normal(-1.5, 1.0, size=(count, 3)),
        rng.normal(size=(count, 4)),
        opacity_logits(opacities),
        harmonics[:, 0],
        harmonics[:, 1:],
    )


CAMERA = View(np.eye(3), np.zeros(3), 20.0, 20.0, 16.5, 16.5, 32, 32)
"""At the origin, axes of the world, principal point at the centre of pixel (16, 16)."""


# ----- tests


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("opaque", [0.0, 0.9])
def test_pictures_and_statistics_are_those_of_a_dense_compositor(seed: int, opaque: float) -> None:
    """Tiles, boxes and row spans are for speed only: nothing differs by more than rounding.

    Sum and maximum of alpha T, sum of opacity T and hits, also where pixels end early.
    """
    rng = np.random.default_rng(seed)
    camera = random_camera(rng)
    scene = random_scene(rng, camera, count=150, degree=seed, opaque=opaque)

    image = rasterizer.render(scene, camera, background=BACKGROUND)
    again, stats = rasterizer.render_with_statistics(scene, camera, background=BACKGROUND)

    expected_image, expected = dense_render(scene, camera)
    np.testing.assert_allclose(image, expected_image, rtol=0, atol=1e-10)
    np.testing.assert_allclose(again, expected_image, rtol=0, atol=1e-10)
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(stats, name), values, atol=1e-10, err_msg=name)


@pytest.mark.parametrize("opaque", [0.0, 1.0])
def test_the_removal_error_is_that_of_rendering_again_without_each_splat(opaque: float) -> None:
    """All N renders without one splat, dense. Opaque scenes end pixels early, so the ends move."""
    rng = np.random.default_rng(11)
    camera = random_camera(rng, 21, 18)
    scene = random_scene(rng, camera, count=70, degree=1, opaque=opaque)
    everything, _ = dense_render(scene, camera)
    expected = []
    for i in range(len(scene.means)):
        without, _ = dense_render(scene.take(np.arange(len(scene.means)) != i), camera)
        expected.append(np.sum((without - everything) ** 2))

    _, stats = rasterizer.render_with_statistics(scene, camera, background=BACKGROUND)

    assert np.count_nonzero(expected) > 20
    np.testing.assert_allclose(stats.removal_error, expected, rtol=1e-9, atol=1e-18)


def test_a_splat_behind_or_beside_the_camera_adds_nothing() -> None:
    """Behind, on the near plane, and beyond each side of the image; nor does no splat at all.

    The near plane is a parameter: at depth 0.2 nothing is drawn by default; with near = 0.1 it is.
    """
    beside = [(50.0, 0, 2.0), (-50.0, 0, 2.0), (0, 50.0, 2.0), (0, -50.0, 2.0)]
    places = [(0, 0, -2.0), (0, 0, 0.2), *beside]
    scenes = [round_scene([place], [2.0]) for place in places]
    for scene in [*scenes, scenes[0].take(np.zeros(0, np.int64))]:
        image, stats = rasterizer.render_with_statistics(scene, CAMERA, background=BACKGROUND)
        np.testing.assert_array_equal(image, np.broadcast_to(BACKGROUND, image.shape))
        assert stats.hits.sum() == stats.removal_error.sum() == stats.weight_sum.sum() == 0
        assert len(stats.hits) == len(scene.means)

    assert rasterizer.render(scenes[1], CAMERA, near=0.1).max() > 0.5


def test_the_number_of_threads_changes_no_bit_and_views_add_up() -> None:
    """Every tile sums for itself, and the tiles are merged in order; maxima over views are kept."""
    rng = np.random.default_rng(5)
    camera = random_camera(rng, 100, 70)
    second = replace(camera, center=camera.center + 0.3)
    scene = random_scene(rng, camera, count=300)
    before = numba.get_num_threads()
    results = []
    try:
        for threads in {1, min(2, before), before}:
            numba.set_num_threads(threads)
            results.append(rasterizer.render_with_statistics(scene, camera))
    finally:
        numba.set_num_threads(before)

    image, stats = results[0]
    for other_image, other in results[1:]:
        np.testing.assert_array_equal(other_image, image)
        for name, values in vars(stats).items():
            np.testing.assert_array_equal(getattr(other, name), values)
    both = rasterizer.accumulate_statistics(scene, [camera, second])
    other = rasterizer.render_with_statistics(scene, second)[1]
    for name, values in vars(stats).items():
        add = np.maximum if name == "weight_max" else np.add
        np.testing.assert_array_equal(getattr(both, name), add(values, getattr(other, name)))


def test_splats_that_are_not_finite_are_left_out() -> None:
    """A NaN or infinity anywhere is never drawn, nor a size beyond float64."""
    rng = np.random.default_rng(2)
    camera = random_camera(rng)
    splats = random_scene(rng, camera, count=40)
    others = splats.take(np.delete(np.arange(40), [3, 7, 9, 11]))
    splats.means[3, 1] = np.nan
    splats.sh_rest[7, 2, 0] = np.inf
    splats.log_scales[9, 0] = 1e3
    splats.quaternions[11, 0] = np.nan

    image = rasterizer.render(splats, camera, background=BACKGROUND)

    expected, _ = dense_render(others, camera)
    np.testing.assert_allclose(image, expected, rtol=0, atol=1e-10)
