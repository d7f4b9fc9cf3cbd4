"""The nearest neighbours, against every distance computed."""

import numpy as np
import pytest

from refine_addon.core.execute import within
from refine_addon.core.merging.graph import nearest


def brute_force(points, count):
    squared = np.sum((points[:, None] - points[None]) ** 2, axis=2)
    np.fill_diagonal(squared, np.inf)
    return np.argsort(squared, axis=1, kind="stable")[:, :count]


@pytest.mark.parametrize("total", [0, 1, 2, 8, 9, 25, 128])
@pytest.mark.parametrize("count", [1, 8, 16])
def test_neighbours_in_a_small_cloud_are_those_of_brute_force(total, count):
    points = np.random.default_rng(total).normal(size=(total, 3))

    found = nearest(points, count)

    np.testing.assert_array_equal(found, brute_force(points, min(count, max(total - 1, 0))))


def clouds():
    """Give clouds and the least share of true neighbours that is found in each."""
    random = np.random.default_rng(5)
    ball = random.normal(size=(2000, 3))
    yield pytest.param(ball, 0.78, id="ball")
    yield pytest.param(ball * [1.0, 1.0, 0.01], 0.78, id="surface")
    yield pytest.param(ball[:1000] * 1e-3, 0.8, id="near the middle of the scene")
    yield pytest.param(ball[:1000] * 1e3, 0.68, id="far outside")
    clusters = [random.normal(size=(400, 3)) * size + size for size in (1e-3, 1.0, 1e3)]
    yield pytest.param(np.concatenate(clusters), 0.75, id="a million times as dense")


@pytest.mark.slow
@pytest.mark.parametrize(("points", "least"), [*clouds()])
def test_neighbours_in_a_large_cloud_are_mostly_those_of_brute_force(points, least):
    found, expected = nearest(points, 8), brute_force(points, 8)

    assert np.mean((found[:, :, None] == expected[:, None]).any(axis=1)) > least
    assert (found != np.arange(len(points))[:, None]).all()


def test_equal_points_are_neighbours_and_equal_distances_come_by_index():
    """On a line of unit steps both sides of point 5 are at distance 1."""
    found = nearest(np.zeros((100, 3)), 4)
    assert found.shape == (100, 4)
    assert all(len({*row, own}) == 5 for own, row in enumerate(found.tolist()))

    assert nearest(np.arange(11.0)[:, None] * [1.0, 0.0, 0.0], 2)[5].tolist() == [4, 6]


def test_threads_change_nothing():
    points = np.random.default_rng(3).normal(size=(20_000, 3))
    np.testing.assert_array_equal(*(within(cores=n)(nearest)(points, 8) for n in (1, 2)))
