"""The occlusion method against numbers by hand, and its laws."""

import contextlib
import math
from collections import namedtuple
from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import Cancelled, Splats, View, ViewSet, execute
from refine_addon.core.scoring import coverage, occlusion
from refine_addon.core.splats import SH_C0
from refine_addon.core.visibility import measuring, projection
from refine_addon.core.visibility import points as points_module

from .test_views import ring as circle
from .test_views import view as plain_view

CUT = 1.0 / 255.0


LENS = {"fx": 100.0, "fy": 100.0, "cx": 40.0, "cy": 30.0, "width": 80, "height": 60}


def look_along_z(center=(0.0, 0.0, 0.0), **changes) -> View:
    """A camera that looks along +z: 100 px focal length, 80 x 60 image."""
    return plain_view(center, **LENS | changes)


def splats_of(means, alphas=0.5, scales=0.05, color=0.5) -> Splats:
    """Splats along the axes; of a color for each, or a gray."""
    means = np.array(means, np.float64).reshape(-1, 3)
    count, color = len(means), np.asarray(color, float)
    alphas = np.broadcast_to(np.asarray(alphas, float), (count,))
    color = color[:, None] if color.ndim == 1 else color
    return Splats(
        means=means,
        log_scales=np.log(np.broadcast_to(np.asarray(scales, float), (count, 3))),
        quaternions=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        opacity_logits=np.log(alphas / (1.0 - alphas)),
        sh_dc=(np.broadcast_to(color, (count, 3)) - 0.5) / SH_C0,
        sh_rest=np.zeros((count, 0, 3)),
    )


Measured = namedtuple("Measured", ("contribution", "error", "seen"))


def measured(splats: Splats, *views: View) -> Measured:
    """Sums over views, in the order of the splats."""
    gaussians, frame, _ = projection.prepare(splats, ViewSet(views))
    pairs, every = [(view, 1.0) for view in views], [range(len(views))]
    total = measuring.measure(gaussians, frame, pairs, every)[0]
    return Measured(*total[:, np.argsort(gaussians.index)])


def footprints_of(splats: Splats, view: View) -> projection.Footprints:
    gaussians, frame, _ = projection.prepare(splats, ViewSet((view,)))
    return projection.project(gaussians, frame, view)


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
    return circle(count, 5.0, 0.3, **LENS)


def test_a_lone_splat_has_the_integrals_of_its_alpha_and_its_squared_colour():
    """A ball of sigma s at depth z has a footprint of variance (f s / z)^2 + 0.3 either way.

    Its alpha, ``A exp(-q / 2)`` down to 1/255, integrates to ``2 pi variance (A - 1/255)``, the
    square of it to ``pi variance (A^2 - 1/255^2)``, times 3 x .25 of gray .5 on black. f s / z is
    2.5 px; the long one has sigmas of 10 and 2.5 px.
    """
    found = measured(splats_of([[0, 0, 2]]), look_along_z())
    long = measured(splats_of([[0, 0, 2]], scales=[[0.2, 0.05, 0.01]]), look_along_z())
    variance = 2.5**2 + 0.3
    assert found.contribution[0] == pytest.approx(2 * math.pi * variance * (0.5 - CUT), rel=1e-5)
    error = math.pi * variance * (0.25 - CUT**2) * 0.75
    assert found.error[0] == pytest.approx(error, rel=1e-5)
    assert found.seen.tolist() == [1]
    both = math.sqrt((10.0**2 + 0.3) * variance)
    assert long.contribution[0] == pytest.approx(2 * math.pi * both * (0.5 - CUT), rel=2e-3)


def test_a_wall_hides_what_is_behind_it_and_not_what_is_before_or_beside_it():
    """Splats of sigma .05 every .05 cover half of the image 2 pi fold with alpha .99: tau is 10.

    What is before it costs nothing where it has the wall's gray, and errs by .4 in another.
    """
    x, y = np.meshgrid(np.linspace(0.2, 2, 37), np.linspace(-1.5, 1.5, 61))
    wall = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1)
    others = np.array([[0.3, 0, 1.5], [1, 0, 4], [-1, 0, 4]])
    means, alphas = np.vstack([wall, others]), np.r_[np.full(len(wall), 0.99), [0.5] * 3]
    same, other = (
        measured(
            splats_of(means, alphas, color=np.r_[np.full(len(wall), 0.5), [gray] * 3]),
            look_along_z(),
        )
        for gray in (0.5, 0.9)
    )
    alone = [measured(splats_of(place), look_along_z()).contribution[0] for place in others]
    before, behind, beside = same.contribution[-3:] / alone
    assert (before, beside) == pytest.approx((1.0, 1.0), abs=1e-4)
    assert behind < 0.05
    expected = math.pi * ((5 / 1.5) ** 2 + 0.3) * (0.25 - CUT**2) * 3 * 0.4**2
    assert other.error[-3] == pytest.approx(expected, rel=0.02)
    assert same.error[-3] < 1e-3 * other.error[-3]


def square(**changes) -> View:
    """A view of 64 x 64 px: 16 x 16 cells of 4, each with one point of every veil."""
    return replace(look_along_z(), width=64, height=64, cx=32.0, cy=32.0, **changes)


def test_the_error_of_each_veil_comes_from_its_contrast_to_what_lies_behind_it():
    """White .3 before gray .5 before .8 of gray .25: B = a c + (1 - a) B' from the back."""
    alphas, grays = np.array([0.3, 0.5, 0.8]), np.array([1.0, 0.5, 0.25])
    cover = alphas - CUT
    behind = [cover[1] * 0.5 + (1 - cover[1]) * cover[2] * 0.25, cover[2] * 0.25, 0.0]
    passed = np.cumprod([1.0, *(1.0 - cover[:2])])  # what is as wide leaves no gaps
    found = measured(splats_of([[0, 0, z] for z in (1, 2, 3)], alphas, 1000.0, grays), square())
    for index, (alpha, gray) in enumerate(zip(alphas, grays, strict=True)):
        alone = measured(splats_of([[0, 0, 1]], alpha, 1000.0, gray), square())
        expected = (passed[index] * (gray - behind[index]) / gray) ** 2
        assert found.error[index] / alone.error[0] == pytest.approx(expected, rel=1e-3)
        visible = found.contribution[index] / alone.contribution[0]
        assert visible == pytest.approx(passed[index], rel=1e-4)


@pytest.mark.parametrize(
    ("x", "y", "sigma", "near"),
    [
        *[(0, 0, 2.5, 0.001), (32, 0, 8, 0.1), (-33, 0, 8, 0.2), (0, 32, 8, 0.1), (0, -33, 8, 0.2)],
        *[(-30, 35, 80, 0.01), (0, -40, 80, 0.01), (0, 0, 500, 0.01), (800, 0, 500, 0.01)],
    ],
)
def test_a_splat_contributes_what_lies_over_pixels_of_the_image(x, y, sigma, near):
    """Alpha summed over the 64 x 64 pixels; its centre is not seen beyond the edge at 32."""
    splats = splats_of([[x / 50, y / 50, 2]], 0.5, sigma / 50)
    center = np.array([32.0 + x, 32.0 + y])
    slope = (center.clip(-0.15 * 64, 1.15 * 64) - 32.0) / 100.0  # where it is linearised
    covariance = sigma**2 * (np.eye(2) + np.outer(slope, slope)) + 0.3 * np.eye(2)
    found = measured(splats, square(near=0.1))
    steps = np.stack(np.meshgrid(np.arange(64) + 0.5, np.arange(64) + 0.5), -1) - center
    squared = np.einsum("xyi,ij,xyj->xy", steps, np.linalg.inv(covariance), steps)
    alphas = np.exp(-0.5 * squared) * (0.5 - CUT)
    assert found.contribution[0] == pytest.approx(alphas.sum(), rel=near)
    assert found.seen.tolist() == [max(abs(x), abs(y)) <= 32]


def test_a_splat_covers_no_more_of_a_cell_than_its_opacity(monkeypatch):
    """Sigma 2 px in a cell of 4: 2 pi 2^2 .5 / 16 is .78 of it, and yet half goes through.

    Of its thickness log 2 the share 4.3 / (4.3 + 16) is even, the rest gamma distributed.
    """
    monkeypatch.setattr(points_module, "DENSITY", 1.0)  # one point for each
    middle = np.array([0.02, 0.02])  # 2 px off the middle of the image: that of a cell
    front = splats_of([[*middle, 1.0], [*middle * 2, 2.0]], scales=[[0.02] * 3, [0.04] * 3])
    found = measured(front, square())
    alone = measured(front.take(slice(1, 2)), square())
    even = (2.0**2 + 0.3) / (2.0**2 + 0.3 + 16.0)
    k = measuring.GAMMA_SHAPE
    passed = 2.0**-even * (1.0 + (1.0 - even) * math.log(2.0) / k) ** -k
    assert found.contribution[1] / alone.contribution[0] == pytest.approx(passed, rel=1e-3)


def test_what_is_measured_is_the_mean_of_the_views_by_their_weights():
    """A view of weight 3 has 3/4 of two; turns of three parts make up the whole."""
    splats, views, nothing = cloud(), ring(11), np.zeros((2, 300))
    third = replace(views[4], weight=3.0)
    whole, one, other, both = (
        occlusion.measure_part(splats, ViewSet(some), 0, 1, nothing)[1]
        for some in (views.views, views.views[:1], (third,), (views[0], third))
    )
    mean = 0.25 * one + 0.75 * other
    np.testing.assert_allclose(both, mean, rtol=1e-3, atol=1e-3 * mean.max())
    parts = sum(occlusion.measure_part(splats, views, turn, 3, nothing)[1] for turn in range(3))
    np.testing.assert_allclose(parts, whole, rtol=1e-12)


def test_what_no_renderer_draws_goes_first_the_least_first():
    """Opacity below 1/255: by the closed form, whatever the order of the file."""
    splats = cloud(60)
    faint = np.arange(0, 60, 3)
    splats.means[faint] = [0.0, 0.0, 0.1]
    splats.log_scales[faint] = -3.0
    splats.sh_dc[faint] = 0.0
    splats.opacity_logits[faint] = np.random.default_rng(6).permutation(20) * 0.1 - 9.0
    order = np.argsort(occlusion.score(splats, ring())[0].values)
    assert order[:20].tolist() == faint[np.argsort(splats.opacity_logits[faint])].tolist()


def test_the_floor_weighs_what_loses_least_of_what_the_left_out_views_saw():
    """The floor of what is worth 1, 1, 4 in 0, 3, 0 views, power 1/2, is 1, 1/4, 2 over 4/3.

    It weighs next to nothing where the scores are right, most where it is, 1 of no evidence. A view
    that sees nothing says nothing, and one that is bright says no more than others.
    """
    rng = np.random.default_rng(7)
    right, wrong = rng.random(200), rng.random(200)
    dark = np.zeros((1, 200))
    errors = np.stack([right * rng.uniform(0.9, 1.1, 200) for _ in range(4)])
    floors = coverage.floor(np.array([1.0, 1, 4]), np.array([0, 3, 0], np.int32), 0.5)
    good, bad = (right, wrong), (wrong, right)
    found, lost = coverage.floor_weights([(*good, errors), (*good, dark)], good)
    most, _ = coverage.floor_weights([(*bad, errors)], good)
    plain, glare = (
        coverage.floor_weights([(*good, np.vstack([errors, wrong * bright]))], good)[0]
        for bright in (1.0, 1e6)
    )
    np.testing.assert_allclose(floors, np.array([1.0, 0.25, 2.0]) * 0.75)
    assert max(found[:2]) < 2e-3
    assert found[2:] == list(coverage.LEAST_FLOOR_WEIGHTS)[2:]
    assert min(most[:2]) > 0.3
    assert min(most[2:]) == pytest.approx(max(coverage.FLOOR_WEIGHTS))
    assert plain == pytest.approx(glare)
    assert lost == pytest.approx(0.0, abs=0.01)
    assert coverage.floor_weights([(wrong, wrong, errors)], good)[1] > 1.0
    for nothing in ([], [(right, wrong, dark)]):
        assert coverage.floor_weights(nothing, good) == ([1.0] * len(coverage.SHARES), 0.0)


def test_what_lies_behind_all_cameras_does_not_all_go():
    """Views in one place agree that nothing else counts; half of the splats go nevertheless."""
    splats, behind = cloud(600), np.arange(600) >= 300
    splats.means[:, 2] += np.where(behind, -6.0, 6.0)
    views = ViewSet(tuple(look_along_z((x, 0.0, 0.0)) for x in np.linspace(-0.2, 0.2, 9)))
    values = occlusion.score(splats, views)[0].values
    kept = values > np.median(values)
    assert 0.2 < np.mean(kept[behind]) < np.mean(kept[~behind])


@pytest.mark.slow
def test_threads_change_nothing_at_all():
    scored = (execute.within(cores=n)(occlusion.score)(cloud(), ring(11)) for n in (1, 3))
    np.testing.assert_array_equal(*(scores.values for scores, _ in scored))


def test_scoring_is_cancelled_by_any_report_and_none_follows_it(monkeypatch):
    """No time need pass between two reports here, so views, folds and rounds report often."""
    monkeypatch.setattr(execute, "_INTERVAL", 0.0)

    def reports(last=math.inf):
        told = []
        with contextlib.suppress(Cancelled), execute.within(cores=1):
            occlusion.score(
                cloud(60), ring(3), progress=lambda *_: told.append(1) or len(told) < last
            )
        return len(told)

    total = reports()

    assert total > 60
    for last in (*range(1, total, 9), total):
        assert reports(last) == last


@pytest.mark.parametrize(("limit", "most"), [(500, 500), (1, 1.25 * 283)])
def test_cells_grow_until_the_points_of_a_view_fit_the_memory(monkeypatch, limit, most):
    """Of 1,370; each of 283 footprints has one however large the cells."""
    monkeypatch.setattr(points_module, "MAX_POINTS", limit)
    monkeypatch.setattr(points_module, "DENSITY", 3.2)
    view, footprints = ring()[0], footprints_of(cloud(), ring()[0])
    side = points_module.cell_size(footprints, view)
    assert len(points_module.scatter(footprints, view, side).owners) <= most


@pytest.mark.parametrize(("width", "height"), [(8000, 6000), (200_000, 1), (1, 1)])
def test_an_image_of_any_shape_has_few_enough_cells(width, height):
    """16 bits number the cells."""
    splats = cloud(50)
    splats.means[6], splats.opacity_logits[6] = 0.0, 1.0  # seen by all
    view = replace(ring()[0], width=width, height=height, cx=width / 2, cy=height / 2)
    side = points_module.cell_size(footprints_of(splats, view), view)
    assert math.ceil(width / side) * math.ceil(height / side) <= points_module.MAX_CELLS
    assert np.isfinite(occlusion.score(splats, ViewSet((view,)))[0].values).all()
