"""The tiled renderer against a plain one that lays every splat over every pixel, by depth."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest

pytest.importorskip("numba")
special = pytest.importorskip("scipy.special")

import numba
from numpy.typing import NDArray

from benchmarks.renderer import rasterizer
from benchmarks.renderer.rasterizer import Camera, Gaussians
from refine_addon.core.splats import Splats, rotation_matrices
from refine_addon.core.views import View

BACKGROUND = (0.2, 0.5, 0.9)
DC = math.sqrt(4.0 * math.pi)
"""Coefficient of the constant harmonic that adds 1 to a colour."""


class Plain(NamedTuple):
    """The arrays `rasterizer.gaussians` takes, in its order."""

    means: NDArray[np.float64]
    scales: NDArray[np.float64]
    quaternions: NDArray[np.float64]
    opacities: NDArray[np.float64]
    harmonics: NDArray[np.float32]

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> Plain:
        """Return the splats at `index`."""
        return Plain(*(values[index] for values in self))

    def prepared(self) -> Gaussians:
        """Return what the renderer takes."""
        return rasterizer.gaussians(*self)


# ----- the plain renderer: the whole model of rasterizer.py's docstring, nothing clever


def dense_geometry(scene: Plain, camera: Camera, near: float) -> list[tuple[float, ...]]:
    """For each splat its index, depth, u, v and inverse 2D covariance, front to back."""
    drawn = []
    for i in range(len(scene.means)):
        x, y, z = camera.rotation @ (scene.means[i] - camera.center)
        if z <= near:
            continue
        half_x, half_y = camera.width / 2 / camera.fx, camera.height / 2 / camera.fy
        middle_x = (camera.width / 2 - camera.cx) / camera.fx
        middle_y = (camera.height / 2 - camera.cy) / camera.fy
        tx = z * np.clip(x / z, middle_x - 1.3 * half_x, middle_x + 1.3 * half_x)
        ty = z * np.clip(y / z, middle_y - 1.3 * half_y, middle_y + 1.3 * half_y)
        jacobian = np.array(
            [[camera.fx / z, 0, -camera.fx * tx / z**2], [0, camera.fy / z, -camera.fy * ty / z**2]]
        )
        axes = rotation_matrices(scene.quaternions[i]) @ np.diag(scene.scales[i])
        projected = jacobian @ camera.rotation @ axes
        inverse = np.linalg.inv(projected @ projected.T + 0.3 * np.eye(2))
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        drawn.append((z, i, u, v, inverse))
    return sorted(drawn, key=lambda item: item[:2])


def real_harmonic(band: int, order: int, direction: NDArray[np.float64]) -> float:
    """Real spherical harmonic from scipy's associated Legendre functions (Condon-Shortley)."""
    x, y, z = direction
    m = abs(order)
    norm = (2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m)
    legendre = math.sqrt(norm) * float(special.lpmv(m, band, z))
    if order == 0:
        return legendre
    phi = math.atan2(y, x)
    return math.sqrt(2) * legendre * (math.cos(m * phi) if order > 0 else math.sin(m * phi))


def dense_color(scene: Plain, camera: Camera, i: int) -> NDArray[np.float64]:
    """Colour of splat `i` as seen from the camera."""
    direction = scene.means[i] - camera.center
    direction = direction / np.linalg.norm(direction)
    degree = round(scene.harmonics.shape[1] ** 0.5) - 1
    orders = [(band, order) for band in range(degree + 1) for order in range(-band, band + 1)]
    basis = np.array([real_harmonic(band, order, direction) for band, order in orders])
    return np.maximum(0.0, basis @ scene.harmonics[i].astype(np.float64) + 0.5)


def dense_render(
    scene: Plain, camera: Camera, near: float = 0.2, background: tuple[float, ...] = BACKGROUND
) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Image (H, W, 3) and the statistics that need one pass."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    image = np.zeros((camera.height, camera.width, 3))
    through = np.ones((camera.height, camera.width))
    finished = np.zeros((camera.height, camera.width), bool)
    count = len(scene.means)
    stats = {n: np.zeros(count) for n in ("weight_sum", "weight_max", "opacity_sum", "hits")}
    for _, i, u, v, inverse in dense_geometry(scene, camera, near):
        offset = np.stack([columns - u, rows - v], axis=-1)
        square = np.einsum("hwi,ij,hwj->hw", offset, inverse, offset)
        alpha = np.minimum(0.99, scene.opacities[i] * np.exp(-0.5 * square))
        covered = (alpha >= 1 / 255) & ~finished
        finished |= covered & (through * (1 - alpha) < 1e-4)
        hit = covered & ~finished
        weight = np.where(hit, alpha * through, 0.0)
        image += weight[..., None] * dense_color(scene, camera, i)
        stats["weight_sum"][i] = weight.sum()
        stats["weight_max"][i] = weight.max()
        stats["opacity_sum"][i] = scene.opacities[i] * through[hit].sum()
        stats["hits"][i] = hit.sum()
        through = np.where(hit, through * (1 - alpha), through)
    return image + through[..., None] * np.array(background), stats


# ----- scenes


def random_rotation(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return a uniformly random (3, 3) rotation."""
    return rotation_matrices(rng.normal(size=4))


def random_camera(rng: np.random.Generator, width: int = 37, height: int = 29) -> Camera:
    """Any place and direction; unequal focal lengths, principal point off the middle."""
    return Camera(
        random_rotation(rng), rng.normal(size=3), 31.0, 27.0, width * 0.45, height * 0.6,
        width, height,
    )  # fmt: skip


def random_scene(
    rng: np.random.Generator, camera: Camera, count: int = 60, degree: int = 3, opaque: float = 0.5
) -> Plain:
    """Splats around the view's axis, some beside and behind; every shape from ball to needle."""
    local = rng.normal(size=(count, 3)) * [1.5, 1.5, 2.0] + [0, 0, 3.0]
    return Plain(
        local @ camera.rotation + camera.center,
        np.exp(rng.normal(-1.5, 1.0, size=(count, 3))),
        rng.normal(size=(count, 4)),
        np.where(rng.random(count) < opaque, rng.uniform(0.9, 1.0, count), rng.random(count)),
        rng.normal(0, 0.4, size=(count, (degree + 1) ** 2, 3)).astype(np.float32),
    )


def facing_camera(width: int = 32, height: int = 32, focal: float = 20.0) -> Camera:
    """At the origin, axes of the world, principal point at the centre of pixel (16, 16)."""
    return Camera(np.eye(3), np.zeros(3), focal, focal, 16.5, 16.5, width, height)


def single(scale: float, opacity: float, z: float = 2.0) -> Plain:
    """One ball on the axis, of colour (1, 0.5, 0)."""
    dc = DC * (np.array([1.0, 0.5, 0.0]) - 0.5)
    return Plain(
        np.array([[0.0, 0.0, z]]),
        np.full((1, 3), scale),
        np.array([[1.0, 0.0, 0.0, 0.0]]),
        np.array([opacity]),
        dc.astype(np.float32)[None, None],
    )


# ----- tests


def test_the_pixel_under_a_single_splat_is_its_colour_times_its_opacity() -> None:
    """At the mean the exponent is 0: alpha = 0.6, picture 0.6 (1, 0.5, 0) + 0.4 background."""
    image = rasterizer.render(
        single(0.1, 0.6).prepared(), facing_camera(), background=(0.1, 0.2, 0.3)
    )

    np.testing.assert_allclose(image[16, 16], [0.64, 0.38, 0.12], rtol=1e-7)


def test_a_single_splat_falls_off_as_the_projected_gaussian() -> None:
    """On the axis the Jacobian is f / z: variance (20 / 2 * 0.1)^2 + 0.3 = 1.3 px^2.

    Two pixels to the right alpha = 0.6 exp(-4 / 2.6); at (3, 1) it is 0.6 exp(-10 / 2.6).
    At (4, 0), 0.6 exp(-16 / 2.6) = 0.0013 is below 1/255: nothing.
    """
    image = rasterizer.render(single(0.1, 0.6).prepared(), facing_camera())

    np.testing.assert_allclose(image[16, 18, 0], 0.6 * math.exp(-4 / 2.6), rtol=1e-6)
    np.testing.assert_allclose(image[17, 19, 0], 0.6 * math.exp(-10 / 2.6), rtol=1e-6)
    assert image[16, 20].max() == 0.0


def test_an_opaque_splat_covers_at_most_99_percent() -> None:
    """The reference clamps alpha to 0.99, so 1 % of the background shines through."""
    image = rasterizer.render(single(0.1, 1.0).prepared(), facing_camera(), background=(0, 0, 1.0))

    np.testing.assert_allclose(image[16, 16], [0.99, 0.495, 0.01], rtol=1e-6)


def test_statistics_of_a_single_splat_are_those_of_its_gaussian() -> None:
    """With nothing in front, T = 1 in every hit.

    weight_max = 0.6; weight_sum = 0.6 sum of exp(-d^2 / 2.6) over the pixels where it is at least
    1 / 153; opacity_sum = 0.6 per hit; over black, removal loses alpha (1, 0.5, 0), so
    the error is 1.25 times the sum of alpha squared.
    """
    d = np.arange(-16, 16)
    alpha = 0.6 * np.exp(-(d[:, None] ** 2 + d[None] ** 2) / 2.6)
    alpha = alpha[alpha >= 1 / 255]

    _, stats = rasterizer.render_with_statistics(single(0.1, 0.6).prepared(), facing_camera())

    assert stats.hits[0] == len(alpha)
    np.testing.assert_allclose(stats.weight_max, 0.6)
    np.testing.assert_allclose(stats.weight_sum, alpha.sum())
    np.testing.assert_allclose(stats.opacity_sum, 0.6 * len(alpha))
    np.testing.assert_allclose(stats.removal_error, 1.25 * np.sum(alpha**2), rtol=1e-6)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("opaque", [0.0, 0.9])
def test_the_picture_is_that_of_a_dense_compositor(seed: int, opaque: float) -> None:
    """Tiles, boxes and row spans are for speed only: no pixel differs by more than rounding."""
    rng = np.random.default_rng(seed)
    camera = random_camera(rng)
    scene = random_scene(rng, camera, count=150, degree=seed % 5, opaque=opaque)

    image = rasterizer.render(scene.prepared(), camera, background=BACKGROUND)

    expected, _ = dense_render(scene, camera)
    np.testing.assert_allclose(image, expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("seed", range(4))
def test_the_statistics_are_those_of_a_dense_compositor(seed: int) -> None:
    """Sum and maximum of alpha T, sum of opacity T and hits, also where pixels end early."""
    rng = np.random.default_rng(seed)
    camera = random_camera(rng)
    scene = random_scene(rng, camera, count=150, degree=1, opaque=0.8)

    image, stats = rasterizer.render_with_statistics(
        scene.prepared(), camera, background=BACKGROUND
    )

    expected_image, expected = dense_render(scene, camera)
    np.testing.assert_allclose(image, expected_image, rtol=0, atol=1e-10)
    for name, values in expected.items():
        np.testing.assert_allclose(getattr(stats, name), values, atol=1e-10, err_msg=name)


@pytest.mark.parametrize("opaque", [0.0, 0.5, 1.0])
def test_the_removal_error_is_that_of_removing_each_splat_and_rendering_again(
    opaque: float,
) -> None:
    """All N renders without one splat, dense. Opaque scenes end pixels early, so the ends move."""
    rng = np.random.default_rng(11)
    camera = random_camera(rng, 21, 18)
    scene = random_scene(rng, camera, count=70, degree=1, opaque=opaque)
    everything, _ = dense_render(scene, camera)
    expected = []
    for i in range(len(scene.means)):
        without, _ = dense_render(scene.take(np.arange(len(scene.means)) != i), camera)
        expected.append(np.sum((without - everything) ** 2))

    _, stats = rasterizer.render_with_statistics(scene.prepared(), camera, background=BACKGROUND)

    assert np.count_nonzero(expected) > 20
    np.testing.assert_allclose(stats.removal_error, expected, rtol=1e-9, atol=1e-18)


def test_removing_the_splat_that_ends_a_pixel_shows_what_is_behind_it() -> None:
    """One pixel, four white balls of alpha 0.99, 0.9, 0.99, 0.5 on black.

    T in front of them: 1, 0.01, 0.001, 0.00001. The third would leave 0.00001 < 1e-4, so it ends
    the pixel undrawn and the fourth is not seen: 0.99 + 0.009 = 0.999. Without the third the
    fourth is drawn at T = 0.001 (leaving 0.0005): the pixel gains 0.0005 in each channel.
    """
    one = single(0.5, 1.0)
    scene = Plain(
        np.array([[0, 0, 2.0], [0, 0, 3.0], [0, 0, 4.0], [0, 0, 5.0]]),
        np.tile(one.scales, (4, 1)),
        np.tile(one.quaternions, (4, 1)),
        np.array([1.0, 0.9, 1.0, 0.5]),
        np.full((4, 1, 3), 0.5 * DC, np.float32),
    )
    camera = Camera(np.eye(3), np.zeros(3), 20.0, 20.0, 0.5, 0.5, 1, 1)

    image, stats = rasterizer.render_with_statistics(scene.prepared(), camera)

    np.testing.assert_allclose(image[0, 0], 0.999, rtol=1e-6)
    assert stats.hits.tolist() == [1, 1, 0, 0]
    np.testing.assert_allclose(stats.removal_error[2], 3 * 0.0005**2, rtol=1e-6)
    assert stats.removal_error[3] == 0.0


@pytest.mark.parametrize("degree", range(5))
def test_colours_follow_the_harmonics_of_every_band(degree: int) -> None:
    """Each basis function alone, against scipy's Legendre functions, in random directions."""
    rng = np.random.default_rng(degree)
    out = np.empty(25)
    for direction in rng.normal(size=(50, 3)):
        unit = direction / np.linalg.norm(direction)

        rasterizer.sh_basis(*unit, out)

        expected = [real_harmonic(degree, order, unit) for order in range(-degree, degree + 1)]
        np.testing.assert_allclose(out[degree**2 : (degree + 1) ** 2], expected, atol=1e-12)


def test_the_first_band_has_the_signs_of_the_reference_files() -> None:
    """-0.4886 y, 0.4886 z, -0.4886 x: 0.4886 = sqrt(3 / 4 pi)."""
    out = np.empty(25)

    rasterizer.sh_basis(0.48, 0.6, 0.64, out)

    np.testing.assert_allclose(out[1:4], 0.4886025119 * np.array([-0.6, 0.64, -0.48]))


def test_colours_are_cut_at_zero_but_not_at_one() -> None:
    """SH + 0.5 of -0.5 shows as 0, of 1.5 as 1.5."""
    scene = single(0.1, 0.5)._replace(
        harmonics=(DC * np.array([[[-1.0, 1.0, 0.0]]])).astype(np.float32)
    )

    image = rasterizer.render(scene.prepared(), facing_camera())

    np.testing.assert_allclose(image[16, 16], [0.0, 0.75, 0.25], rtol=1e-6)


@pytest.mark.parametrize(
    "mean",
    [(0, 0, -2.0), (0, 0, 0.2), (50.0, 0, 2.0), (-50.0, 0, 2.0), (0, 50.0, 2.0), (0, -50.0, 2.0)],
)
def test_a_splat_behind_or_beside_the_camera_adds_nothing(mean: tuple[float, ...]) -> None:
    """Behind, on the near plane, and beyond each side of the image."""
    scene = single(0.1, 0.9)._replace(means=np.array([mean]))

    image, stats = rasterizer.render_with_statistics(
        scene.prepared(), facing_camera(), background=BACKGROUND
    )

    np.testing.assert_array_equal(image, np.broadcast_to(BACKGROUND, image.shape))
    assert stats.hits[0] == stats.removal_error[0] == stats.weight_sum[0] == 0


def test_the_near_plane_is_a_parameter() -> None:
    """At depth 0.2 nothing is drawn by default; with near = 0.1 it is."""
    scene = single(0.01, 0.9, z=0.2).prepared()

    assert rasterizer.render(scene, facing_camera()).max() == 0.0
    assert rasterizer.render(scene, facing_camera(), near=0.1).max() > 0.5


def test_an_empty_scene_shows_the_background() -> None:
    """No splats, no hits, no failure."""
    nothing = single(0.1, 0.5).take(np.zeros(0, np.int64)).prepared()

    image, stats = rasterizer.render_with_statistics(
        nothing, facing_camera(), background=BACKGROUND
    )

    np.testing.assert_array_equal(image, np.broadcast_to(BACKGROUND, image.shape))
    assert stats.hits.shape == (0,)


def test_the_number_of_threads_changes_no_bit() -> None:
    """Every tile sums for itself, and the tiles are merged in order."""
    rng = np.random.default_rng(5)
    camera = random_camera(rng, 100, 70)
    scene = random_scene(rng, camera, count=300).prepared()
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


def test_statistics_add_up_over_views_and_maxima_are_kept() -> None:
    """Two views accumulated equal the sum (the maximum) of each alone."""
    rng = np.random.default_rng(8)
    first = random_camera(rng)
    second = first._replace(center=first.center + 0.3)
    scene = random_scene(rng, first).prepared()

    both = rasterizer.accumulate_statistics(scene, [first, second])

    a = rasterizer.render_with_statistics(scene, first)[1]
    b = rasterizer.render_with_statistics(scene, second)[1]
    np.testing.assert_array_equal(both.weight_max, np.maximum(a.weight_max, b.weight_max))
    for name in ("weight_sum", "opacity_sum", "hits", "removal_error"):
        np.testing.assert_array_equal(getattr(both, name), getattr(a, name) + getattr(b, name))


def test_stored_splats_are_activated_and_broken_ones_left_out() -> None:
    """Log scale, logit opacity, the constant harmonic first; a NaN anywhere is never drawn."""
    rng = np.random.default_rng(2)
    camera = random_camera(rng)
    plain = random_scene(rng, camera, count=40)
    splats = Splats(
        plain.means,
        np.log(plain.scales),
        plain.quaternions,
        np.log(plain.opacities / (1 - plain.opacities)),
        plain.harmonics[:, 0],
        plain.harmonics[:, 1:],
    )
    view = View(*camera)
    splats.means[3, 1] = np.nan
    splats.sh_rest[7, 2, 0] = np.inf
    splats.log_scales[9, 0] = 1e3
    splats.quaternions[11, 0] = np.nan

    image = rasterizer.render(splats, view, background=BACKGROUND)

    expected, _ = dense_render(plain.take(np.delete(np.arange(40), [3, 7, 9, 11])), camera)
    np.testing.assert_allclose(image, expected, rtol=0, atol=1e-10)


def test_shapes_that_do_not_belong_together_are_refused() -> None:
    """The message names what was got."""
    good = single(0.1, 0.5)

    with pytest.raises(ValueError, match=r"got .*\(1, 2\)"):
        rasterizer.gaussians(*good._replace(scales=np.ones((1, 2))))
    with pytest.raises(ValueError, match=r"got \(1, 2, 3\)"):
        rasterizer.gaussians(*good._replace(harmonics=np.zeros((1, 2, 3))))
