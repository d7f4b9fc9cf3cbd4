"""What scoring rays say splats are worth while others go, against rays drawn anew."""

import tracemalloc
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import ViewSet
from refine_addon.core.execute import silent, within
from refine_addon.core.scoring import occlusion
from refine_addon.core.scoring.occlusion import KNOWN, _RemovalRounds
from refine_addon.core.visibility import cast, projection
from refine_addon.core.visibility import rays as rays_module
from refine_addon.core.visibility.cast import RaySample
from refine_addon.core.visibility.rays import Rays
from tests.core.test_occlusion import cloud, footprints_of, ring

RANDOM = np.random.default_rng(5)


def some_rays(count: int = 40, splats: int = 30) -> tuple[Rays, np.ndarray]:
    """Return rays that hit up to 20 of some splats each, the last of them nothing."""
    ray, owner = [], []
    for number in range(count - 1):
        hits = RANDOM.permutation(splats)[: RANDOM.integers(0, 21)]
        ray += [number] * len(hits)
        owner += hits.tolist()
    alpha = RANDOM.uniform(0.01, 0.9, len(ray)).astype(np.float32)
    rays = Rays(
        np.arange(count), np.zeros(1, np.int64), np.array(ray, np.int32),
        np.array(owner, np.int32), alpha, np.arange(splats),
    )  # fmt: skip
    return rays, RANDOM.uniform(0.0, 1.0, (3, splats)).astype(np.float32)


def drawn(rays: Rays, colors: np.ndarray, without: int = -1) -> np.ndarray:
    picture, left = np.zeros((rays.count, 3)), np.ones(rays.count)
    for ray, owner, alpha in zip(rays.ray, rays.owner, rays.alpha, strict=True):
        if owner != without:
            picture[ray] += left[ray] * alpha * colors[:, owner]
            left[ray] *= 1.0 - float(alpha)
    return picture


@pytest.mark.parametrize("piece", [7, 1 << 15])
def test_a_removal_error_is_the_squared_change_of_the_rays_without_a_splat(monkeypatch, piece):
    """Rays that hit nothing lose nothing."""
    monkeypatch.setattr(rays_module, "_PIECE", piece)
    rays, colors = some_rays()
    whole = drawn(rays, colors)
    expected = [((drawn(rays, colors, k) - whole) ** 2).sum() for k in range(30)]
    white = np.ones((3, 30), np.float32)
    parts = [
        (drawn(rays, white) - drawn(rays, white * (np.arange(30) != k)))[:, 0].sum()
        for k in range(30)
    ]
    error, contribution = rays.removal_errors(colors)
    # What lies behind less than 1e-4 of the light is left out.
    np.testing.assert_allclose(error, expected, rtol=1e-2, atol=1e-6)
    np.testing.assert_allclose(contribution, parts, rtol=1e-4, atol=1e-3)
    for each in rays.keeping(np.zeros(30, np.bool_)).removal_errors(colors):
        np.testing.assert_array_equal(each, np.zeros(30))


@pytest.fixture
def scene():
    """Return ranking rays into a cloud from two views, one of weight 3, and what they measure."""
    one, two = ring(2)
    views = ViewSet((one, replace(two, weight=3.0)))
    splats = cloud()
    gaussians, frame, _ = projection.prepare(splats, views)
    sample = RaySample(views.by_distance(), gaussians, splats, "scoring")
    sample.cast_all(gaussians, frame, silent)
    count = len(gaussians)
    random = np.random.default_rng(2)
    error, contribution = (random.uniform(0.5, 2.0, count) for _ in range(2))
    return sample, np.stack([contribution, error, np.arange(count)])


def told(sample: RaySample, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return error, contribution and number of rays of all Gaussians, with some of them there."""
    error, contribution, hits = np.zeros((3, len(keep)))
    for number, (rays, (view, weight)) in enumerate(zip(sample.rays, sample.views, strict=True)):
        area = weight * view.width * view.height / rays.count
        colors = sample.colors(number, rays).astype(np.float32)
        hits[rays.hit] += np.bincount(rays.owner, minlength=len(rays.hit))
        for total, some in zip(
            (error, contribution), rays.keeping(keep[rays.hit]).removal_errors(colors), strict=True
        ):
            total[rays.hit] += area * some
    return error, contribution, hits


@pytest.mark.parametrize("threads", [1, 3])
def test_what_is_left_grows_as_rays_tell_and_unhit_splats_as_all_do(scene, threads):
    """Removed at once or one half after the other: the same."""
    sample, measured = scene
    count = measured.shape[1]
    keep = np.arange(count) % 3 > 0
    left = np.flatnonzero(keep)
    before, now = told(sample, np.ones(count, np.bool_)), told(sample, keep)
    hits = before[2][left]
    expected = []
    for sums, first, after in zip(measured[1::-1], before, now, strict=False):
        own, then, later = sums[left], first[left], after[left]
        prior = KNOWN / np.maximum(hits, 1) * own
        expected.append(own * (later + prior * later.sum() / then.sum()) / (then + prior))
    expected[0] = (hits * now[0][left] + KNOWN * expected[0]) / (hits + KNOWN)
    half = np.flatnonzero(keep | (np.arange(count) < count // 2))
    with within(cores=threads):  # they take the rays away from their sample
        at_once, halves = (_RemovalRounds(deepcopy(sample), count, silent) for _ in range(2))
        found = at_once.remove_and_measure(left, measured[:, left], silent)
        halves.remove_and_measure(half, measured[:, half], silent)
        again = halves.remove_and_measure(left, measured[:, left], silent)
    assert now[0][left].sum() > 1.05 * before[0][left].sum()
    np.testing.assert_allclose(found[:2], expected[::-1], rtol=1e-9)
    np.testing.assert_array_equal(again, found)
    np.testing.assert_array_equal(found[2], measured[2, left])


WIDE = replace(ring()[0], width=2000, height=1500, fx=900.0, fy=900.0, cx=1000.0, cy=750.0)


@pytest.mark.parametrize("count", [8, 16, 37, 64])
def test_equally_many_scoring_and_validation_rays_lie_apart(count, monkeypatch):
    """Half a step of the sequence is .38 of the way to the next column, .28 to the next row.

    By `number + len(views)` 16 views had their rays 1 to 2 pixels apart.
    """
    monkeypatch.setitem(cast.RAYS, "scoring", cast.RAYS["validation"])
    view = replace(WIDE, width=480, height=320, fx=450.0, fy=450.0, cx=240.0, cy=160.0)
    views, footprints = [(view, 1.0 / count)] * count, footprints_of(cloud(), view)
    for number in (0, count // 2, count - 1):
        some, others = (
            cast.cast_view(views, number, footprints, kind) for kind in ("validation", "scoring")
        )
        across, down = (
            np.abs(one[:, None] - other).min()
            for one, other in ((some.columns, others.columns), (some.rows, others.rows))
        )
        assert np.hypot(across, down) > 2.0


@pytest.mark.slow
def test_large_pictures_full_of_vast_splats_take_bounded_memory(monkeypatch):
    """500 splats as large as each of two pictures of 1080p: every ray hits all of them.

    The 8,192 validation and 32,768 scoring rays of a view would have 20 million hits, of 60 bytes
    while they are cast: 2.4 GB on two threads. A fifth of a million of each are 48 MB at most.
    Where splats are few, rays are as many as 16 bits tell apart.
    """
    few = cast.cast_view([(WIDE, 1.0)], 0, footprints_of(cloud(), WIDE), "scoring")
    assert 59_000 < few.count < 1 << 16
    monkeypatch.setattr(cast, "MAX_HITS_OF_VIEW", 200_000)
    view = replace(WIDE, width=1920, height=1080, fx=1e3, fy=1e3, cx=960.0, cy=540.0)
    views = ViewSet((view, replace(view, center=view.center + np.array([0.5, 0.0, 0.0]))))
    splats = replace(
        cloud(500),
        log_scales=np.full((500, 3), np.log(4.0), np.float32),
        opacity_logits=np.full(500, -3.0, np.float32),
    )
    tracemalloc.start()
    within(cores=2)(occlusion.score)(splats, views)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 60e6
