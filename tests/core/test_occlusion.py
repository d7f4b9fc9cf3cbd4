"""The occlusion method against numbers by hand, and its laws."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import Cancelled, RefineError, Splats, View, ViewSet, execute
from refine_addon.core.affine import transformed
from refine_addon.core.scoring import coverage, occlusion
from refine_addon.core.splats import ARRAYS, SH_C0, rotation_matrices
from refine_addon.core.visibility import measuring, projection
from refine_addon.core.visibility import points as points_module
from refine_addon.core.visibility.measuring import Measured, Sampling

CUT = 1.0 / 255.0
SAMPLING = Sampling()


def look_along_z(center=(0.0, 0.0, 0.0), **changes) -> View:
    """Return a camera that looks along +z: 100 px focal length, 80 x 60 image."""
    lens = {"fx": 100.0, "fy": 100.0, "cx": 40.0, "cy": 30.0, "width": 80, "height": 60}
    return View(np.eye(3), np.array(center), **(lens | changes))


def splats_of(means, alphas=0.5, scales=0.05, gray=0.5) -> Splats:
    means = np.array(means, np.float64).reshape(-1, 3)
    count = len(means)
    alphas = np.broadcast_to(np.array(alphas, np.float64), (count,))
    scales = np.array(scales, np.float64)
    gray = np.broadcast_to(np.array(gray, np.float64), (count,))
    return Splats(
        means=means,
        log_scales=np.log(
            np.broadcast_to(scales.reshape(-1, scales.shape[-1] if scales.ndim else 1), (count, 3))
        ),
        quaternions=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        opacity_logits=np.log(alphas / (1.0 - alphas)),
        sh_dc=np.repeat((gray[:, None] - 0.5) / SH_C0, 3, axis=1),
        sh_rest=np.zeros((count, 0, 3)),
    )


def measured(splats: Splats, *views: View, sampling: Sampling = SAMPLING) -> Measured:
    """Return sums over views, in the order of the splats."""
    gaussians, frame, _ = projection.prepare(splats, ViewSet(views), threads=1)
    total = Measured.zero(len(gaussians))
    for view in views:
        total._add_view(measuring._measure_view(gaussians, frame, view, sampling)[1], 1.0)
    back = np.argsort(gaussians.index)
    return Measured(total.contribution[back], total.error[back], total.seen[back])


def cloud(count=300, seed=0) -> Splats:
    """Splats of all sizes, shapes and opacities in front of the cameras of `ring`."""
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.normal(size=(count, 3)),
        log_scales=rng.normal(-2.5, 0.7, size=(count, 3)),
        quaternions=rng.normal(size=(count, 4)),
        opacity_logits=rng.normal(0.0, 2.0, count),
        sh_dc=rng.normal(size=(count, 3)),
        sh_rest=rng.normal(size=(count, 3, 3)) * 0.1,
    )


def ring(count=5) -> ViewSet:
    """Cameras on a circle of radius 5, looking at its middle."""
    views = []
    for index in range(count):
        angle = 2 * math.pi * index / count + 0.3
        forward = np.array([-math.cos(angle), -math.sin(angle), 0.0])
        down = np.array([0.0, 0.0, -1.0])
        rotation = np.stack([np.cross(down, forward), down, forward])
        view = replace(look_along_z(), rotation=rotation, center=-5.0 * forward)
        views.append(replace(view, name=f"{index:02}"))
    return ViewSet(tuple(views))


def agreement(first, second) -> float:
    """Share of the kept half that two scores have in common."""
    half = len(first) // 2
    kept = [set(np.argsort(values, kind="stable")[half:]) for values in (first, second)]
    return len(kept[0] & kept[1]) / (len(first) - half)


def plain_footprint(splats: Splats, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return centre and 2D covariance of the first splat, the Jacobian by differences.

    Where the centre lies more than .15 of the image beside it, the projection is linearised there.
    """
    axes = rotation_matrices(splats.quaternions[0]) * np.exp(splats.log_scales[0])
    turned = view.rotation @ axes
    local = view.rotation @ (splats.means[0] - view.center)

    def pixel(point):
        return np.array([view.fx, view.fy]) * point[:2] / point[2] + [view.cx, view.cy]

    size = np.array([view.width, view.height])
    bound = pixel(local).clip(-0.15 * size, 1.15 * size)
    slope = (bound - [view.cx, view.cy]) / [view.fx, view.fy]
    at = np.array([*slope * local[2], local[2]])
    step = 1e-6 * local[2]
    jacobian = np.stack(
        [(pixel(at + step * unit) - pixel(at - step * unit)) / (2 * step) for unit in np.eye(3)], 1
    )
    return pixel(local), jacobian @ turned @ turned.T @ jacobian.T + 0.3 * np.eye(2)


# ----- numbers by hand


def test_a_lone_splat_contributes_the_integral_of_its_alpha():
    """A ball of sigma s at depth z has a footprint of variance (f s / z)^2 + 0.3 either way.

    Its alpha, ``A exp(-q / 2)`` down to 1/255, integrates to ``2 pi variance (A - 1/255)``:
    f = 100, s = .05, z = 2 -> variance 6.55; A = .5 -> 20.415.
    """
    expected = 2 * math.pi * (2.5**2 + 0.3) * (0.5 - CUT)

    found = measured(splats_of([[0, 0, 2]]), look_along_z())

    assert found.contribution[0] == pytest.approx(expected, rel=1e-5)
    assert found.seen.tolist() == [1]


def test_a_lone_splat_on_black_has_the_error_of_its_colour():
    """Integral of alpha^2 is ``pi variance (A^2 - 1/255^2)``; gray .5 on black: 3 x .25."""
    expected = math.pi * (2.5**2 + 0.3) * (0.25 - CUT**2) * 0.75

    found = measured(splats_of([[0, 0, 2]]), look_along_z())

    assert found.error[0] == pytest.approx(expected, rel=1e-5)


def test_a_long_splat_is_measured_by_both_its_axes():
    """Sigmas .2 and .05 across the view at z = 2: variances 100.3 and 6.55."""
    expected = 2 * math.pi * math.sqrt(100.3 * 6.55) * (0.5 - CUT)

    found = measured(splats_of([[0, 0, 2]], scales=[[0.2, 0.05, 0.01]]), look_along_z())

    assert found.contribution[0] == pytest.approx(expected, rel=2e-3)


def wall(depth) -> np.ndarray:
    x, y = np.meshgrid(np.linspace(-2, 2, 81), np.linspace(-1.5, 1.5, 61))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, depth)], axis=1)


def test_a_wall_hides_what_is_behind_it_and_not_what_is_before_it():
    """Splats of sigma .05 every .05 cover the image 2 pi fold with alpha .99: tau about 10."""
    means = np.vstack([wall(2.0), [[0, 0, 1.5], [0, 0, 4.0]]])
    alphas = np.r_[np.full(len(means) - 2, 0.99), 0.5, 0.5]

    found = measured(splats_of(means, alphas), look_along_z())
    alone = measured(splats_of(means[-2:], 0.5), look_along_z(), look_along_z())

    share = found.contribution[-2:] / (alone.contribution / 2)
    assert share[0] == pytest.approx(1.0, abs=1e-4)
    assert share[1] < 0.05


def test_a_wall_hides_nothing_beside_it():
    """One before the right half of the image leaves all of the left half as it is."""
    means = wall(2.0)
    means = means[means[:, 0] > 0.2]
    small = np.random.default_rng(1).uniform([-1.4, -1.0, 4.0], [-0.2, 1.0, 4.5], size=(200, 3))

    alone = measured(splats_of(small, scales=0.02), look_along_z())
    beside = measured(
        splats_of(
            np.vstack([means, small]),
            np.r_[np.full(len(means), 0.99), np.full(len(small), 0.5)],
            np.r_[np.full(len(means), 0.05), np.full(len(small), 0.02)][:, None].repeat(3, 1),
        ),
        look_along_z(),
    )

    np.testing.assert_allclose(beside.contribution[len(means) :], alone.contribution, rtol=1e-4)


def test_what_has_the_colour_of_what_is_behind_it_has_no_error():
    """In front of an opaque wall of its own gray a splat can go; of another gray it cannot."""
    means = np.vstack([wall(2.0), [[0, 0, 1.5]]])
    alphas = np.r_[np.full(len(means) - 1, 0.99), 0.5]

    same = measured(splats_of(means, alphas, gray=0.5), look_along_z())
    other = measured(
        splats_of(means, alphas, gray=np.r_[np.full(len(means) - 1, 0.5), 0.9]), look_along_z()
    )

    assert same.error[-1] < 1e-3 * other.error[-1]
    expected = math.pi * ((5 / 1.5) ** 2 + 0.3) * (0.25 - CUT**2) * 3 * 0.4**2
    assert other.error[-1] == pytest.approx(expected, rel=0.02)


def test_transmittance_is_the_mean_of_exp_of_a_gamma_distributed_thickness():
    """Numerically: exp(-tau) over many draws of mean 0, .5 and 3.

    What is even before it takes its exact share of that.
    """
    shape = measuring.GAMMA_SHAPE
    draws = np.random.default_rng(1).gamma(shape, size=400_000) / shape
    mean = np.array([0.0, 0.5, 3.0], np.float32)
    even = np.array([0.0, 0.5, 1.0], np.float32)

    loose = measuring._transmittance(mean, np.zeros_like(mean))
    partly = measuring._transmittance(mean + even, even)

    np.testing.assert_allclose(loose, [np.exp(-m * draws).mean() for m in mean], atol=2e-3)
    np.testing.assert_allclose(partly, loose * np.exp(-even), rtol=1e-5)


def test_a_splat_as_narrow_as_a_cell_is_half_even():
    """By its narrow side: sigma 4 px on cells of 16 px^2; a third of it is a tenth, thrice .9."""
    sigmas = np.array([[50.0, 5.0, 12.0], [4.0, 4 / 3, 12.0]], np.float32)
    footprints = projection.Footprints(
        np.arange(3), sigmas, sigmas, sigmas, sigmas, np.ones(3, bool), np.ones(3, np.float32)
    )

    found = measuring._evenness(footprints, 16.0)

    np.testing.assert_allclose(found, [0.5, 0.1, 0.9], rtol=1e-6)


def lattice(kind: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the points and shares of a lattice."""
    table = points_module._lattices()
    patches = slice(table.first[kind], table.first[kind] + table.patches[kind])
    start = table.start[patches.start]
    members = slice(start, start + table.sizes[patches].sum())
    return table.points[:, members].astype(float), table.shares[members].astype(float)


def test_every_lattice_has_the_moments_of_the_normal_distribution():
    """Shares sum to 1, means are 0, variances 1, or 0 of a single point."""
    for kind in range(len(points_module.COUNTS) ** 2):
        points, shares = lattice(kind)

        assert shares.sum() == pytest.approx(1.0, abs=1e-5)
        np.testing.assert_allclose(points @ shares, 0.0, atol=1e-4)
        variances = (points * points) @ shares
        assert all(abs(v - 1) < 1e-4 or v == 0.0 for v in variances)


# ----- veils: splats so large that they cover the image evenly, by hand


def veils(alphas, grays, depths) -> Splats:
    """Return splats a thousand times as large as the image."""
    return splats_of([[0, 0, z] for z in depths], alphas, 1000.0, grays)


def square(**changes) -> View:
    """Return a view of 64 x 64 px: 16 x 16 cells of 4, each with one point of every veil."""
    return replace(look_along_z(), width=64, height=64, cx=32.0, cy=32.0, **changes)


def let_through(*alphas: float) -> float:
    """Return the product of 1 - a: what is as wide as these veils leaves no gaps."""
    return math.prod(1.0 - (alpha - CUT) for alpha in alphas)


def test_a_veil_lets_through_what_it_leaves_uncovered():
    """Behind veils of alpha .6 and .9 a small splat contributes T, its error is T^2."""
    small = splats_of([[0, 0, 3]])
    behind = measured(
        Splats(
            **{
                name: np.concatenate(
                    [getattr(veils([0.6, 0.9], 0.0, [1, 2]), name), getattr(small, name)]
                )
                for name in ARRAYS
            }
        ),
        square(),
    )
    alone = measured(small, square())

    passed = let_through(0.6, 0.9)
    assert behind.contribution[2] / alone.contribution[0] == pytest.approx(passed, rel=1e-4)
    assert behind.error[2] / alone.error[0] == pytest.approx(passed**2, rel=1e-4)


def test_the_error_of_each_veil_comes_from_its_contrast_to_what_lies_behind_it():
    """White .3 before gray .5 before .8 of gray .25: B = a c + (1 - a) B' from the back."""
    alphas, grays = np.array([0.3, 0.5, 0.8]), np.array([1.0, 0.5, 0.25])
    cover = alphas - CUT
    behind = [cover[1] * 0.5 + (1 - cover[1]) * cover[2] * 0.25, cover[2] * 0.25, 0.0]
    passed = [1.0, let_through(0.3), let_through(0.3, 0.5)]

    found = measured(veils(alphas, grays, [1, 2, 3]), square())

    for index in range(3):
        one = slice(index, index + 1)
        alone = measured(veils(alphas[one], grays[one], [1]), square())
        expected = (passed[index] * (grays[index] - behind[index]) / grays[index]) ** 2
        assert found.error[index] / alone.error[0] == pytest.approx(expected, rel=1e-3)
        visible = found.contribution[index] / alone.contribution[0]
        assert visible == pytest.approx(passed[index], rel=1e-4)


@pytest.mark.parametrize(("x", "y"), [(0, 0), (40, 0), (0, -40), (-30, 35)])
def test_a_splat_larger_than_the_image_contributes_what_lies_over_its_pixels(x, y):
    """Sigma about 80 px, its centre so many pixels aside: alpha summed over 64 x 64 of them."""
    splats = splats_of([[x / 50, y / 50, 2]], 0.5, 1.6)
    center, covariance = plain_footprint(splats, square(near=0.1))

    found = measured(splats, square(near=0.1))

    steps = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5), -1) - center
    inverse = np.linalg.inv(covariance)
    alphas = np.exp(-0.5 * np.einsum("xyi,ij,xyj->xy", steps, inverse, steps)) * (0.5 - CUT)
    assert found.contribution[0] == pytest.approx(alphas.sum(), rel=1e-2)


def test_a_splat_covers_no_more_of_a_cell_than_its_opacity():
    """Sigma 2 px in a cell of 4: 2 pi 2^2 .5 / 16 is .78 of it, and yet half goes through.

    Of its thickness log 2 the share 4.3 / (4.3 + 16) is even, the rest gamma distributed.
    """
    sampling = Sampling(cell=4.0, density=1.0)  # one point for each
    middle = np.array([0.02, 0.02])  # 2 px off the middle of the image: that of a cell
    front = splats_of([[*middle, 1.0], [*middle * 2, 2.0]], scales=[[0.02] * 3, [0.04] * 3])

    found = measured(front, square(), sampling=sampling)
    alone = measured(front.take(slice(1, 2)), square(), sampling=sampling)

    even = (2.0**2 + 0.3) / (2.0**2 + 0.3 + 16.0)
    k = measuring.GAMMA_SHAPE
    passed = 2.0**-even * (1.0 + (1.0 - even) * math.log(2.0) / k) ** -k
    assert found.contribution[1] / alone.contribution[0] == pytest.approx(passed, rel=1e-3)


@pytest.mark.parametrize(("x", "y"), [(-0.8, 0), (0.8, 0), (0, -0.6), (0, 0.6)])
def test_half_of_a_splat_on_the_edge_of_the_image_counts(x, y):
    """At depth 2 and 100 px these are the edges of 80 x 60 px; sigma is 8 of them."""
    inside = measured(splats_of([[0, 0, 2]], scales=0.16), look_along_z())

    found = measured(splats_of([[x, y, 2]], scales=0.16), look_along_z())

    assert found.contribution[0] / inside.contribution[0] == pytest.approx(0.5, abs=0.05)
    assert found.error[0] / inside.error[0] == pytest.approx(0.5, abs=0.05)


@pytest.mark.parametrize(("x", "y"), [(-0.82, 0), (0.82, 0), (0, -0.62), (0, 0.62)])
def test_a_splat_beside_the_image_contributes_what_reaches_in_and_is_not_seen(x, y):
    """A pixel outside, of sigma 2.5: a third of it."""
    found = measured(splats_of([[x, y, 2]]), look_along_z())

    assert found.contribution[0] > 0.0
    assert found.seen.tolist() == [0]


# ----- footprints


@pytest.mark.parametrize("seed", range(12))
def test_footprints_are_those_of_the_linearised_projection(seed):
    """Long splats turned anyhow, seen by a turned camera whose principal point is off the middle.

    Half of them lie beside the image and reach into it.
    """
    rng = np.random.default_rng(seed)
    view = look_along_z(
        rng.normal(size=3), fx=90.0, fy=130.0, cx=rng.uniform(10, 70), cy=rng.uniform(10, 50)
    )
    view = replace(view, rotation=np.linalg.qr(rng.normal(size=(3, 3)))[0])
    wide = 1.5 if seed % 2 else 0.9
    image = np.array([80, 60]) * (0.5 + wide * (rng.random(2) - 0.5))
    image = [80 * 1.4, image[1]] if seed % 4 == 1 else image
    image = [image[0], -60 * 0.4] if seed % 4 == 3 else image
    depth = rng.uniform(2, 5)
    local = np.array([(image[0] - view.cx) / 90.0, (image[1] - view.cy) / 130.0, 1.0]) * depth
    splats = replace(
        splats_of([view.rotation.T @ local + view.center], 0.9, [[0.7, 0.25, 0.05]]),
        quaternions=rng.normal(size=(1, 4)),
    )
    center, covariance = plain_footprint(splats, view)

    gaussians, frame, _ = projection.prepare(splats, ViewSet((view,)), threads=1)
    found = projection.project(gaussians, frame, view)

    halves = np.stack([found.major[:, 0], found.minor[:, 0]], axis=1).astype(float)
    np.testing.assert_allclose(found.centers[:, 0], center, rtol=1e-4)
    np.testing.assert_allclose(
        halves @ halves.T, covariance, rtol=2e-3, atol=1e-3 * covariance[0, 0]
    )
    assert abs(halves[:, 0] @ halves[:, 1]) < 1e-3 * covariance.max()
    np.testing.assert_allclose(found.sigmas[:, 0], np.linalg.norm(halves, axis=0), rtol=1e-5)


@pytest.mark.parametrize("unit", [1.0, 1e3])
def test_near_and_far_planes_are_lengths_of_the_world(unit):
    """Depths 1, 2, 3, 4 between planes at 1.5 and 3.5, in metres and in millimetres."""
    splats = splats_of([[0.1 * z * unit, 0, z * unit] for z in (1, 2, 3, 4)], scales=0.05 * unit)

    found = measured(splats, look_along_z(near=1.5 * unit, far=3.5 * unit))

    assert (found.contribution > 0).tolist() == [False, True, True, False]
    assert found.seen.tolist() == [0, 1, 1, 0]


def test_the_near_plane_belongs_to_the_inside():
    """As the far plane and the image's edges do, docs/conventions.md; .5 and 1 are exact."""
    splats = splats_of([[0, 0, 0.5], [0, 0, 1]])

    assert measured(splats, look_along_z(near=1.0)).seen.tolist() == [0, 1]
    assert measured(splats, look_along_z(far=0.5)).seen.tolist() == [1, 0]


def test_without_planes_what_is_nearer_than_a_hundredth_of_the_scene_is_not_seen():
    """The size of the scene is the median distance, 2."""
    splats = splats_of(
        [[0, 0, 0.019], [0, 0, 0.021], [0, 0, 2], [0, 0, 3], [0, 0, 1e7]], scales=1e-4
    )

    assert measured(splats, look_along_z()).seen.tolist() == [0, 1, 1, 1]


@pytest.mark.parametrize("center", [(0, 0, -1e20), (0, 0, -1e-3)])
@pytest.mark.parametrize("focal", [30.0, 1e-12])
def test_a_view_that_float32_cannot_hold_counts_as_empty(center, focal):
    """1e20 scene sizes away, or with a lens that projects all to a point: only neither is seen."""
    splats = splats_of([[0, 0, 2], [0, 0, 3], [0, 0, 4]])
    odd = look_along_z(center, fx=focal, fy=focal, name="odd")

    with np.errstate(all="raise", under="ignore"):
        found = measured(splats, *[look_along_z()] * 3, odd)

    seen_by_odd = center[2] > -1 and focal > 1
    assert found.seen.tolist() == [4 if seen_by_odd else 3] * 3


@pytest.mark.parametrize(("cx", "cy"), [(4.0, 30.0), (76.0, 30.0), (40.0, 3.0), (40.0, 57.0)])
def test_all_of_an_image_is_seen_wherever_its_principal_point_lies(cx, cy):
    """Small splats in its corners and on its middle."""
    pixels = np.array([[2, 2], [78, 2], [2, 58], [78, 58], [40, 30]])
    means = np.column_stack([(pixels - [cx, cy]) / 100.0 * 2.0, np.full(5, 2.0)])

    found = measured(splats_of(means, scales=0.005), look_along_z(cx=cx, cy=cy))

    assert found.seen.tolist() == [1] * 5
    np.testing.assert_allclose(found.contribution, found.contribution[4], rtol=0.05)


def test_what_lies_below_a_wide_image_is_not_seen():
    """Of 80 x 60 px, row 70 would be inside of 80 rows."""
    splats = splats_of([[0, 0.4 * 2, 2], [0, 0, 2]])

    assert measured(splats, look_along_z()).seen.tolist() == [0, 1]


# ----- rounds, weights, floor


def test_the_score_is_the_error_times_a_power_of_the_contribution():
    """3 x 16^(1/4) = 6."""
    sums = Measured(np.array([16.0]), np.array([3.0]), np.array([1], np.int32))

    assert occlusion._combined(sums) == pytest.approx([6.0])


def test_a_view_of_thrice_the_weight_counts_thrice():
    """Weights are shares: 1/4 and 3/4 of what either says alone."""
    splats, (one, two) = cloud(), ring(2)

    def measured(*views):
        return occlusion.measure_part(splats, ViewSet(views), 0, 1)[0]

    alone = [measured(view) for view in (one, two)]

    both = measured(one, replace(two, weight=3.0))

    for name in ("contribution", "error"):
        first, second = (getattr(sums, name) for sums in alone)
        np.testing.assert_allclose(
            getattr(both, name), 0.25 * first + 0.75 * second, rtol=1e-3, atol=1e-3 * first.max()
        )


def test_parts_of_the_views_take_turns_and_make_up_the_whole():
    """Eleven views in eight blocks; one of weight 3 has 3 of 13. A fourth turn is the first."""
    splats, views = cloud(), ring(11)
    views = ViewSet((*views.views[:4], replace(views[4], weight=3.0), *views.views[5:]))

    found = [occlusion.measure_part(splats, views, turn, 3) for turn in range(4)]

    whole, _ = occlusion.measure_part(splats, views, 0, 1)
    for name in ("contribution", "error", "seen"):
        total = sum(getattr(part, name) for part, _ in found[:3])
        np.testing.assert_allclose(total, getattr(whole, name), rtol=1e-12)
        np.testing.assert_array_equal(getattr(found[3][0], name), getattr(found[0][0], name))
    assert sum(share for _, share in found[:3]) == pytest.approx(1.0)
    assert {round(share * 13) for _, share in found} <= {3, 4, 5, 6}
    assert occlusion.measure_part(splats, ring(1), 5, 3)[1] == 1.0


@pytest.mark.slow
def test_views_are_measured_once_and_scoring_rays_tell_the_rest(monkeypatch):
    """All rounds after the first ask the rays that were cast then."""
    asked = []

    def measure(gaussians, scene, views, groups, *args, original=occlusion.measure, **how):
        asked.append(groups)
        return original(gaussians, scene, views, groups, *args, **how)

    monkeypatch.setattr(occlusion, "measure", measure)
    occlusion.score(cloud(1000), ring(11), threads=1)

    assert asked == [measuring.view_groups(11)]


def test_a_round_orders_what_it_removes_and_the_next_one_the_rest_anew():
    """Of three rounds the first removes .684; until then it orders as the first of two, of .9."""
    splats, views = cloud(), ring()

    two, three = (
        np.argsort(occlusion.score(splats, views, rounds=rounds).values) for rounds in (2, 3)
    )

    np.testing.assert_array_equal(two[:205], three[:205])
    assert (two[205:270] != three[205:270]).any()
    assert set(two) == set(three) == set(range(300))


@pytest.mark.slow
def test_a_budget_ends_the_rounds_and_changes_no_place_up_to_it():
    """Of three rounds two are done for .7 removed, one for half, each with all of its order.

    One also for .684, which the first removes to the splat: no round is begun for what stays.
    """
    splats, views = cloud(), ring()
    whole = np.argsort(occlusion.score(splats, views, rounds=3).values)

    for settled, same, next_round in (
        (150, 205, 270),
        (205, 205, 270),
        (210, 270, 300),
        (300, 300, 300),
    ):
        found = occlusion.score(splats, views, rounds=3, settled=settled)
        order = np.argsort(found.values)
        assert found.settled == settled
        np.testing.assert_array_equal(order[:same], whole[:same])
        assert (order[same:next_round] != whole[same:next_round]).any() == (same < 300)


def test_what_no_renderer_draws_goes_first_the_least_first():
    """Opacity below 1/255: by the closed form, whatever the order of the file."""
    splats = cloud(60)
    faint = np.arange(0, 60, 3)
    splats.means[faint] = [0.0, 0.0, 0.1]
    splats.log_scales[faint] = -3.0
    splats.sh_dc[faint] = 0.0
    splats.opacity_logits[faint] = np.random.default_rng(6).permutation(20) * 0.1 - 9.0

    values = occlusion.score(splats, ring(), rounds=3).values

    assert (
        np.argsort(values)[:20].tolist() == faint[np.argsort(splats.opacity_logits[faint])].tolist()
    )


def test_a_large_splat_that_one_view_does_not_show_outlasts_a_faint_one_that_it_shows():
    """One view leaves all to be guessed: what is large and near may be plain from elsewhere."""
    splats = splats_of(
        [[0, 0, 2], [0.3, 0, 2], [3, 0, 0.5]],
        [0.9, 0.05, 0.9],
        [[0.1] * 3, [0.02] * 3, [0.1] * 3],
    )

    values = occlusion.score(splats, ViewSet((look_along_z(),)), rounds=1).values

    assert values.tolist() == pytest.approx([1.0, 1 / 3, 2 / 3])


def test_the_floor_falls_with_the_views_that_might_have_shown_a_splat():
    """Worth 1, 1, 4 in 0, 3, 0 views, power 1/2: 1, 1/4, 2 over the mean of 1, 1 and 2."""
    floors = coverage.floor(np.array([1.0, 1, 4]), np.array([0, 3, 0], np.int32), 0.5)

    np.testing.assert_allclose(floors, np.array([1.0, 0.25, 2.0]) * 0.75)
    np.testing.assert_allclose(
        coverage._with_floor(np.array([2.0, 4, 6]), floors, 2.0),
        np.array([0.5, 1, 1.5]) + 2 * floors,
    )


def test_the_floor_weighs_what_loses_least_of_what_the_left_out_views_saw():
    """So little that the scores decide where they are right, most where the floor is.

    And 1 where nothing was left out. A view that sees nothing says nothing, and one that is bright
    says no more than others.
    """
    rng = np.random.default_rng(7)
    right, wrong = rng.random(200), rng.random(200)
    dark = np.zeros((1, 200))
    errors = np.stack([right * rng.uniform(0.9, 1.1, 200) for _ in range(4)])

    found = coverage.floor_weights([(right, wrong, errors), (right, wrong, dark)])
    tenth = np.argsort(coverage._with_floor(right, wrong, found[0]))[:20]
    np.testing.assert_array_equal(np.sort(tenth), np.sort(np.argsort(right)[:20]))
    assert found[2:] == list(coverage.LEAST_FLOOR_WEIGHTS)[2:]
    most = coverage.floor_weights([(wrong, right, errors)])
    assert min(most[:2]) > 0.3
    assert min(most[2:]) == pytest.approx(max(coverage.FLOOR_WEIGHTS))
    assert coverage.floor_weights([]) == [1.0] * len(coverage.SHARES)
    assert coverage.floor_weights([(right, wrong, dark)]) == [1.0] * len(coverage.SHARES)
    plain, glare = (np.vstack([errors, wrong * bright]) for bright in (1.0, 1e6))
    assert coverage.floor_weights([(right, wrong, plain)]) == pytest.approx(
        coverage.floor_weights([(right, wrong, glare)])
    )


def test_what_lies_behind_all_cameras_does_not_all_go():
    """Views in one place agree that nothing else counts; half of the splats go nevertheless."""
    splats, behind = cloud(600), np.arange(600) >= 300
    splats.means[:, 2] += np.where(behind, -6.0, 6.0)
    views = ViewSet(tuple(look_along_z((x, 0.0, 0.0)) for x in np.linspace(-0.2, 0.2, 9)))

    values = occlusion.score(splats, views).values

    kept = values > np.median(values)
    assert 0.2 < np.mean(kept[behind]) < np.mean(kept[~behind])


def test_each_share_has_the_weight_that_is_right_up_to_there():
    """Scores tell the tenth that is worth least apart, floors all others."""
    rng = np.random.default_rng(8)
    truth = rng.permutation(400) + 1.0
    scores = np.where(truth <= 40, truth, rng.uniform(41.0, 400.0, 400))
    floors = np.where(truth <= 40, 41.0, truth)
    errors = np.stack([truth * rng.uniform(0.9, 1.1, 400) for _ in range(4)])

    found = coverage.floor_weights([(scores, floors, errors)])

    assert found[0] < 0.002 < min(found[1:3])


def test_a_floor_that_gains_nothing_has_no_weight_while_little_goes():
    """Scores and floors agree, so any weight loses the same: 0 is stood for by 10^-5.5.

    From half removed on it weighs what it must at least.
    """
    right = np.random.default_rng(9).random(200)

    found = coverage.floor_weights([(right, right, right[None])])

    assert max(found[:2]) < 1e-5
    assert found[2:] == list(coverage.LEAST_FLOOR_WEIGHTS)[2:]


def test_splats_go_by_the_weight_of_the_floor_that_holds_up_to_each_stop():
    """Two by scores alone, none by a weight whose stop is no further, then by a large floor."""
    scores, floors = np.array([5.0, 1, 2, 3, 4]), np.array([1.0, 9, 9, 4, 3])
    ties = np.zeros(5, np.float32)

    found = coverage.order(scores, floors, ties, (0.0, 50.0, 1e3), np.array([2, 2, 5]))

    assert found.tolist() == [1, 2, 0, 4, 3]


def test_what_goes_after_the_last_stop_and_ties_are_in_order_too():
    """No splat is lost; of equal ones that with the smaller tie goes first."""
    scores, ties = np.array([1.0, 1, 0, 2]), np.array([2, 1, 0, 0], np.float32)

    found = coverage.order(scores, np.zeros(4), ties, (0.0, 1.0), np.array([1, 2]))

    assert found.tolist() == [2, 1, 0, 3]


# ----- laws


def test_the_order_of_splats_does_not_matter():
    splats, views = cloud(), ring()
    order = np.random.default_rng(2).permutation(len(splats))

    found = occlusion.score(splats.take(order), views, rounds=1).values

    expected = occlusion.score(splats, views, rounds=1).values[order]
    np.testing.assert_allclose(found, expected, atol=2.5 / len(splats))


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 7.0, 1e6])
def test_the_unit_of_the_scene_does_not_matter(factor):
    splats, views = cloud(), ring()
    matrix = np.diag([factor, factor, factor, 1.0])
    scaled = ViewSet(tuple(replace(view, center=view.center * factor) for view in views))

    found = occlusion.score(transformed(splats, matrix, rotate_sh=False), scaled, rounds=1).values

    expected = occlusion.score(splats, views, rounds=1).values
    assert agreement(found, expected) > 0.99
    np.testing.assert_allclose(found, expected, atol=0.1)


def test_a_rigid_motion_does_not_matter():
    splats, views = cloud(), ring()
    rotation, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    rotation *= np.linalg.det(rotation)
    shift = np.array([100.0, -50.0, 30.0])
    matrix = np.block([[rotation, shift[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
    moved = ViewSet(
        tuple(
            replace(v, rotation=v.rotation @ rotation.T, center=rotation @ v.center + shift)
            for v in views
        )
    )

    found = occlusion.score(transformed(splats, matrix, rotate_sh=False), moved, rounds=1).values

    expected = occlusion.score(splats, views, rounds=1).values
    assert agreement(found, expected) > 0.99
    np.testing.assert_allclose(found, expected, atol=0.1)


@pytest.mark.slow
def test_threads_change_nothing_at_all():
    splats, views = cloud(), ring(11)

    results = [occlusion.score(splats, views, threads=n).values for n in (1, 2, 5)]

    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])


def test_the_order_of_views_does_not_matter():
    splats, views = cloud(), ring(11)

    found = occlusion.score(splats, views.take(np.arange(11)[::-1]), rounds=1).values

    expected = occlusion.score(splats, views, rounds=1).values
    np.testing.assert_allclose(found, expected, atol=2.5 / len(splats))


def test_rounds_give_every_splat_its_own_place():
    """The progressive score is a ranking: 1 / N to 1, each once."""
    splats = cloud(200)

    found = occlusion.score(splats, ring(), rounds=4)

    np.testing.assert_allclose(np.sort(found.values), np.arange(1, 201) / 200, rtol=1e-6)


# ----- extremes


def test_what_cannot_be_drawn_scores_zero_and_all_else_more():
    splats = cloud(50)
    splats.means[3, 1] = np.nan
    splats.opacity_logits[7] = -np.inf
    splats.opacity_logits[9] = -20.0
    splats.opacity_logits[10] = np.inf

    found = occlusion.score(splats, ring())

    assert np.flatnonzero(found.values == 0).tolist() == [3, 7]
    assert np.isfinite(found.values).all()
    assert found.undrawable == 2


@pytest.mark.slow
@pytest.mark.parametrize("focal", [1.0, 30.0, 1e3, 1e6])
@pytest.mark.parametrize("spread", [1e-3, 1.0, 30.0])
def test_no_scene_makes_numpy_complain(focal, spread):
    """Cameras inside splats, splats of all sizes, any focal length; warnings are errors."""
    rng = np.random.default_rng(5)
    splats = cloud(200, 4)
    splats.means[:] *= spread
    splats.log_scales[:] = rng.uniform(-60.0, 60.0, size=(200, 3))
    splats.log_scales[::3] = rng.normal(0.0, 2.0, size=(67, 3))
    splats.means[5] = ring()[0].center
    splats.means[6], splats.log_scales[6], splats.opacity_logits[6] = 0.0, -3.0, 1.0  # seen by all
    splats.sh_dc[::7] *= 1e6
    views = ViewSet(tuple(replace(view, fx=focal, fy=focal * 1.1) for view in ring()[:2]))

    with np.errstate(all="raise"):
        found = occlusion.score(splats, views, rounds=2, threads=1)

    assert np.isfinite(found.values).all()
    assert (found.values > 0).all()


def test_cells_grow_until_the_points_of_a_view_fit_the_memory(monkeypatch):
    """Of 4,000 splats of a hundred points each; one more for each where a cell is not full."""
    rng = np.random.default_rng(9)
    means = rng.uniform([-0.7, -0.5, 2], [0.7, 0.5, 2], size=(4000, 3))
    splats, view = splats_of(means, scales=0.15), look_along_z()
    footprints = projection.project(*projection.prepare(splats, ViewSet((view,)))[:2], view)
    free = points_module.cell_size(footprints, view, 4.0, 3.2)
    monkeypatch.setattr(points_module, "MAX_POINTS", 20_000)

    side = points_module.cell_size(footprints, view, 4.0, 3.2)

    assert free == 4.0
    assert len(points_module.scatter(footprints, view, side, 3.2).owners) <= 2 * 20_000


@pytest.mark.parametrize("scale", [1, 4, 16])
@pytest.mark.parametrize("count", [100, 60_000])
def test_cells_follow_the_footprints_not_the_pixels(count, scale):
    """An image of 400 x 300 px has 7,500 cells of 4 px.

    Those of 4 and 16 times the pixels a side have `FEW_CELLS` of them for 100 footprints, and a
    quarter as many as footprints for 60,000.
    """
    sigmas = np.full((2, count), 1.0, np.float32)
    footprints = projection.Footprints(
        np.arange(count), sigmas, sigmas, sigmas, sigmas, np.ones(count, bool), sigmas[0]
    )
    view = look_along_z(width=400 * scale, height=300 * scale)

    side = points_module.cell_size(footprints, view, 4.0, 1.0)

    cells = max(points_module.FEW_CELLS, count / points_module.FOOTPRINTS)
    assert side == pytest.approx(max(4.0, 1.01 * math.sqrt(view.width * view.height / cells)))


def test_a_view_of_many_splats_is_cancelled_within(monkeypatch):
    """300 splats, 50 at a time: between six projections, then between lattices, then cells.

    No time need pass between two reports here, so each of these steps reports: there are more than
    1 + 6 of them, and whichever answers ``False`` is the last.
    """
    monkeypatch.setattr(projection, "_CHUNK", 50)
    monkeypatch.setattr(points_module, "_BLOCK", 50)
    monkeypatch.setattr(execute, "_INTERVAL", 0.0)
    steps = []

    def scoring(last=10**6):
        steps.clear()

        def progress(_fraction, what):
            if what == "scoring":
                steps.append(what)
            return len(steps) < last

        occlusion.measure_part(cloud(300), ring(1), 0, 1, progress=progress, threads=1)

    scoring()
    total = len(steps)

    assert total > 1 + 6
    for last in (1, 2, 8, total):
        with pytest.raises(Cancelled):
            scoring(last)
        assert len(steps) == last


@pytest.mark.parametrize("last", [1, 3, 5, 6])
def test_scoring_is_cancelled_while_the_floor_is_weighed(monkeypatch, last):
    """Five views are five folds, one call of `floor` each; the sixth orders the splats.

    When that many calls have begun the next report answers ``False``: no other follows.
    """
    calls = []

    def counted(*arguments, floor=coverage.floor):
        calls.append(1)
        return floor(*arguments)

    monkeypatch.setattr(coverage, "floor", counted)

    with pytest.raises(Cancelled):
        occlusion.score(cloud(), ring(), progress=lambda *_: len(calls) < last)

    assert len(calls) == last


@pytest.mark.slow
@pytest.mark.parametrize(("large", "steps"), [(0.05, 0), (0.1, 1), (0.3, 3)])
def test_cells_stop_growing_where_each_footprint_needs_a_point_of_its_own(large, steps):
    """4.3 million footprints are more than the 2^22 points of a view: 1.25 a footprint are allowed.

    Cells of 4 px, 2 points per standard deviation of that length: sigma .5 has one point and sigma
    4 has 2 x 2. A share p of the latter needs 1 + 3 p a footprint: 1.15, 1.3 and 1.9. Cells grow by
    2^(1/4), each step divides the 4 by sqrt 2: after one 1.18 at p = .1, after three 1.12 at .3.
    """
    count = 4_300_000
    sigmas = np.where(np.arange(count) < large * count, 4.0, 0.5).astype(np.float32)
    both = np.broadcast_to(sigmas, (2, count))
    footprints = projection.Footprints(
        np.arange(count), both, both, both, both, np.ones(count, bool), sigmas
    )

    side = points_module.cell_size(footprints, look_along_z(), 4.0, 2.0)

    assert side == pytest.approx(4.0 * 2.0 ** (steps / 4))


def test_an_image_of_any_shape_has_few_enough_cells():
    """16 bits number the cells, of an image of 50 Mpx as of one a pixel high."""
    splats = cloud(50)
    splats.means[6], splats.opacity_logits[6] = 0.0, 1.0  # seen by all
    for width, height in ((8000, 6000), (200_000, 1), (1, 1)):
        view = replace(ring()[0], width=width, height=height, cx=width / 2, cy=height / 2)
        footprints = projection.project(*projection.prepare(splats, ViewSet((view,)))[:2], view)

        side = points_module.cell_size(footprints, view, 4.0, 3.2)

        assert math.ceil(width / side) * math.ceil(height / side) <= points_module.MAX_CELLS
        assert np.isfinite(occlusion.score(splats, ViewSet((view,)), rounds=1).values).all()


@pytest.mark.parametrize("size", [(40.0, 1600.0), (39.2, 1599.5)])
def test_each_cell_of_a_narrow_image_has_a_number_of_its_own(size):
    """64,000 cells, the last column and row also if they are cut: numbers of 16 bits hold them.

    With one more number a row they would not. The last of them says that a point is outside.
    """
    across, down = (place.ravel() for place in np.meshgrid(np.arange(40.0), np.arange(1600.0)))

    numbers = points_module._cell_numbers((across + 0.1, down + 0.1), size)

    assert len(np.unique(numbers)) == 64_000
    assert numbers.max() < points_module._OUTSIDE


def test_views_that_see_nothing_are_an_error():
    away = ViewSet((look_along_z(),))

    with pytest.raises(RefineError, match="no camera sees the splats"):
        occlusion.score(splats_of([[0, 0, -2]]), away)
    with pytest.raises(RefineError, match="no splats"):
        occlusion.score(cloud(0), ring())
    with pytest.raises(RefineError, match="can be drawn"):
        occlusion.score(replace(cloud(2), opacity_logits=np.full(2, -np.inf)), ring())


@pytest.mark.parametrize("name", ["cell", "density"])
def test_a_sampling_that_cannot_be_is_refused(name):
    with pytest.raises(RefineError, match=name):
        Sampling(**{name: 0})


def test_no_rounds_are_refused():
    with pytest.raises(RefineError, match="rounds is 0"):
        occlusion.score(cloud(3), ring(1), rounds=0)


def test_weights_that_are_nearly_as_good_do_not_jump():
    """A last digit of one error changes the weight in its last digits: it is a smooth mean."""
    rng = np.random.default_rng(9)
    scores, floors = rng.random(300), rng.random(300)
    errors = rng.random((4, 300))

    found = coverage.floor_weights([(scores, floors, errors)])
    again = coverage.floor_weights([(scores, floors, errors * (1.0 + 1e-7 * rng.random((4, 300))))])

    np.testing.assert_allclose(again, found, rtol=1e-3)


# ----- points


def plain_points(footprints, view, side, density) -> dict[tuple[int, int], float]:
    """Return the share of each footprint, front to back, that lies in each cell, point by point."""
    found: dict[tuple[int, int], float] = {}
    kinds = points_module._kinds(footprints, view, density / side)
    for row, kind in enumerate(kinds):
        points, shares = lattice(kind)
        axes = np.stack([footprints.major[:, row], footprints.minor[:, row]], axis=1)
        place = footprints.centers[:, row][:, None] + axes @ points  # (2, k)
        for (x, y), share in zip(place.T, shares, strict=True):
            if 0 <= x < view.width and 0 <= y < view.height:
                cell = int(y / side) * math.ceil(view.width / side) + int(x / side)
                found[row, cell] = found.get((row, cell), 0.0) + float(share)
    return found


def test_points_lie_where_their_lattices_put_them_in_and_across_the_image():
    """Large, small and thin splats, many across an edge: against a loop over all of their points.

    A cell holds the share of each splat once, and what lies beside the image is in none. The sums
    of shares and of their squares follow. Sizes are random, so no point lies on an edge.
    """
    view = look_along_z(center=(0.0, 0.0, -3.0))
    splats = cloud(150)
    splats.log_scales[::10, 0] += 0.7
    splats.means[:, 2] = np.maximum(splats.means[:, 2], -1.0)  # none fills the image
    footprints = projection.project(*projection.prepare(splats, ViewSet((view,)))[:2], view)

    points = points_module.scatter(footprints, view, 4.0, 3.7)

    expected = plain_points(footprints, view, 4.0, 3.7)
    assert sorted(points.owners[points.shares > 0].tolist()) == sorted(row for row, _ in expected)
    count = len(footprints.index)
    inside, squares = np.zeros(count), np.zeros(count)
    for (row, _), share in expected.items():
        inside[row] += share
        squares[row] += share**2
    assert 0.1 < np.mean(inside < 0.99) < 0.9
    np.testing.assert_allclose(points.share_inside, inside, rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(points.squares, squares, rtol=1e-4, atol=1e-6)
    of_cells = np.add.reduceat(points.shares, np.cumsum(points.counts) - points.counts)
    cells = sorted({cell for _, cell in expected})
    totals = [sum(s for (_, c), s in expected.items() if c == cell) for cell in cells]
    np.testing.assert_allclose(of_cells, totals, rtol=1e-4)


@pytest.mark.parametrize("x", [0.0, 8.0, -16.0])
def test_a_splat_wider_than_the_image_counts_all_of_it_wherever_its_centre_is(x):
    """Sigma 500 px on 80 x 60: against the sum of its alpha over the pixels, up to 800 px off."""
    view, splats = look_along_z(), splats_of([[x, 0, 2]], scales=10.0)
    center, covariance = plain_footprint(splats, view)
    row, column = np.mgrid[:60, :80] + 0.5
    away = np.stack([column.ravel(), row.ravel()]) - center[:, None]
    squared = np.sum(away * np.linalg.solve(covariance, away), axis=0)

    found = measured(splats, view)

    # The mass leaves out the edge below 1/255, a share of 1/127 of it.
    assert found.contribution[0] == pytest.approx(0.5 * np.exp(-squared / 2).sum(), rel=0.01)
