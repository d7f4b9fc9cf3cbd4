"""The occlusion method against numbers by hand, and its laws."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import RefineError, Splats, View, ViewSet, froxels, occlusion, projection
from refine_addon.core.occlusion import Measured, Occlusion
from refine_addon.core.splats import SH_C0
from refine_addon.core.transform import transformed

ONCE = Occlusion(rounds=1)
CUT = 1.0 / 255.0


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


def measured(splats: Splats, *views: View, settings: Occlusion = ONCE) -> Measured:
    """Return sums over views, in the order of the splats."""
    gaussians, frame, _ = projection.prepare(splats, ViewSet(views), threads=1)
    total = Measured.zero(len(gaussians))
    for view in views:
        occlusion.measure_view(gaussians, frame, view, 1.0, settings, total)
    back = np.argsort(gaussians.index)
    return Measured(total.contribution[back], total.contrast[back], total.seen[back])


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
        views.append(replace(look_along_z(), rotation=rotation, center=-5.0 * forward))
    return ViewSet(tuple(views))


def agreement(first, second) -> float:
    """Share of the kept half that two scores have in common."""
    half = len(first) // 2
    kept = [set(np.argsort(values, kind="stable")[half:]) for values in (first, second)]
    return len(kept[0] & kept[1]) / (len(first) - half)


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


def test_a_lone_splat_on_black_has_the_contrast_of_its_colour():
    """Integral of alpha^2 is ``pi variance (A^2 - 1/255^2)``; gray .5 on black: 3 x .25."""
    expected = math.pi * (2.5**2 + 0.3) * (0.25 - CUT**2) * 0.75

    found = measured(splats_of([[0, 0, 2]]), look_along_z())

    assert found.contrast[0] == pytest.approx(expected, rel=1e-5)


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


def test_what_has_the_colour_of_what_is_behind_it_has_no_contrast():
    """In front of an opaque wall of its own gray a splat can go; of another gray it cannot."""
    means = np.vstack([wall(2.0), [[0, 0, 1.5]]])
    alphas = np.r_[np.full(len(means) - 1, 0.99), 0.5]

    same = measured(splats_of(means, alphas, gray=0.5), look_along_z())
    other = measured(
        splats_of(means, alphas, gray=np.r_[np.full(len(means) - 1, 0.5), 0.9]), look_along_z()
    )

    assert same.contrast[-1] < 1e-3 * other.contrast[-1]
    expected = math.pi * ((5 / 1.5) ** 2 + 0.3) * (0.25 - CUT**2) * 3 * 0.4**2
    assert other.contrast[-1] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("side", [2.0, 4.0, 8.0])
def test_light_is_the_mean_of_exp_of_a_gamma_distributed_thickness(side):
    """Numerically: exp(-tau) over many draws of mean 0, .5 and 3; shape 12 over the side."""
    shape = froxels.DOUBT / side
    draws = np.random.default_rng(1).gamma(shape, size=400_000) / shape
    mean = np.array([0.0, 0.5, 3.0], np.float32)

    found = froxels.light(mean, side * side)

    np.testing.assert_allclose(found, [np.exp(-m * draws).mean() for m in mean], atol=2e-3)


def test_every_lattice_has_the_moments_of_the_normal_distribution():
    """Weights sum to 1, means are 0, variances 1, or 0 of a single point."""
    for lattice in froxels.lattices()[:-1]:
        points, weights = lattice.points.astype(float), lattice.weights.astype(float)

        assert weights.sum() == pytest.approx(1.0, abs=1e-5)
        np.testing.assert_allclose(points @ weights, 0.0, atol=1e-4)
        variances = (points * points) @ weights
        assert all(abs(v - 1) < 1e-4 or v == 0.0 for v in variances)


# ----- laws


def test_the_order_of_splats_does_not_matter():
    splats, views = cloud(), ring()
    order = np.random.default_rng(2).permutation(len(splats))

    found = occlusion.score(splats.take(order), views, ONCE).values

    expected = occlusion.score(splats, views, ONCE).values[order]
    np.testing.assert_allclose(found, expected, atol=2.5 / len(splats))


@pytest.mark.parametrize("factor", [1e-6, 1e-3, 7.0, 1e6])
def test_the_unit_of_the_scene_does_not_matter(factor):
    splats, views = cloud(), ring()
    matrix = np.diag([factor, factor, factor, 1.0])
    scaled = ViewSet(tuple(replace(view, center=view.center * factor) for view in views))

    found = occlusion.score(transformed(splats, matrix, rotate_sh=False), scaled, ONCE).values

    assert agreement(found, occlusion.score(splats, views, ONCE).values) > 0.97


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

    found = occlusion.score(transformed(splats, matrix, rotate_sh=False), moved, ONCE).values

    assert agreement(found, occlusion.score(splats, views, ONCE).values) > 0.97


def test_threads_change_nothing_at_all():
    splats, views = cloud(), ring(11)

    results = [occlusion.score(splats, views, Occlusion(), threads=n).values for n in (1, 2, 5)]

    np.testing.assert_array_equal(results[0], results[1])
    np.testing.assert_array_equal(results[0], results[2])


def test_the_order_of_views_does_not_matter():
    splats, views = cloud(), ring(11)

    found = occlusion.score(splats, views.take(np.arange(11)[::-1]), ONCE).values

    expected = occlusion.score(splats, views, ONCE).values
    np.testing.assert_allclose(found, expected, atol=2.5 / len(splats))


def test_rounds_give_every_splat_its_own_place():
    """The progressive score is a ranking: 1 / N to 1, each once."""
    splats = cloud(200)

    found = occlusion.score(splats, ring(), Occlusion(rounds=4))

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


@pytest.mark.parametrize("focal", [1.0, 30.0, 1e3, 1e6])
@pytest.mark.parametrize("spread", [1e-3, 1.0, 30.0])
def test_no_scene_makes_numpy_complain(focal, spread):
    """Cameras inside splats, splats of all sizes, any focal length; warnings are errors."""
    rng = np.random.default_rng(5)
    splats = cloud(400, 4)
    splats.means[:] *= spread
    splats.log_scales[:] = rng.uniform(-60.0, 60.0, size=(400, 3))
    splats.log_scales[::3] = rng.normal(0.0, 2.0, size=(134, 3))
    splats.means[5] = ring()[0].center
    splats.means[6], splats.log_scales[6], splats.opacity_logits[6] = 0.0, -3.0, 1.0  # seen by all
    splats.sh_dc[::7] *= 1e6
    views = ViewSet(tuple(replace(view, fx=focal, fy=focal * 1.1) for view in ring()))

    with np.errstate(all="raise"):
        found = occlusion.score(splats, views, Occlusion(rounds=2), threads=1)

    assert np.isfinite(found.values).all()
    assert (found.values > 0).all()


def test_an_image_of_any_shape_has_few_enough_cells():
    """16 bits number the cells, of an image of 50 Mpx as of one a pixel high."""
    splats = cloud(50)
    splats.means[6], splats.opacity_logits[6] = 0.0, 1.0  # seen by all
    for width, height in ((8000, 6000), (200_000, 1), (1, 1)):
        view = replace(ring()[0], width=width, height=height, cx=width / 2, cy=height / 2)
        footprints = projection.project(*projection.prepare(splats, ViewSet((view,)))[:2], view)

        side = froxels.cell_size(footprints, view, 4.0, 3.2)

        assert math.ceil(width / side) * math.ceil(height / side) <= froxels.MAX_CELLS
        assert np.isfinite(occlusion.score(splats, ViewSet((view,)), ONCE).values).all()


def test_views_that_see_nothing_are_an_error():
    away = ViewSet((look_along_z(),))

    with pytest.raises(RefineError, match="no camera sees the splats"):
        occlusion.score(splats_of([[0, 0, -2]]), away)
    with pytest.raises(RefineError, match="no splats"):
        occlusion.score(cloud(0), ring())
    with pytest.raises(RefineError, match="can be drawn"):
        occlusion.score(replace(cloud(2), opacity_logits=np.full(2, -np.inf)), ring())


@pytest.mark.parametrize("name", ["cell", "density", "rounds"])
def test_settings_that_cannot_be_are_refused(name):
    with pytest.raises(RefineError, match=name):
        Occlusion(**{name: 0})
