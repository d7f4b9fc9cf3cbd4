"""The nearest neighbours, against every distance computed."""

import numpy as np
import pytest

from refine_addon.core.execute import Cancelled
from refine_addon.core.merging.graph import nearest


def brute_force(points, count):
    squared = np.sum((points[:, None] - points[None]) ** 2, axis=2)
    np.fill_diagonal(squared, np.inf)
    return np.argsort(squared, axis=1, kind="stable")[:, :count]


@pytest.mark.parametrize("total", [2, 3, 8, 9, 25, 97, 128])
@pytest.mark.parametrize("count", [1, 8, 16])
def test_neighbours_in_a_small_cloud_are_those_of_brute_force(total, count):
    points = np.random.default_rng(total).normal(size=(total, 3))

    found = nearest(points, count)

    np.testing.assert_array_equal(found, brute_force(points, min(count, total - 1)))


@pytest.mark.parametrize(("unit", "least"), [(1e-3, 0.8), (1.0, 0.8), (1e3, 0.68)])
def test_near_and_far_of_the_middle_neighbours_are_found_as_well(unit, least):
    """A cloud that is all near the middle of the scene, one around it, and one far outside."""
    points = np.random.default_rng(1).normal(size=(1000, 3)) * unit

    found, expected = nearest(points, 8), brute_force(points, 8)

    assert np.mean((found[:, :, None] == expected[:, None]).any(axis=1)) > least


@pytest.mark.slow
@pytest.mark.parametrize("flatness", [1.0, 0.01])
def test_neighbours_in_a_large_cloud_are_mostly_those_of_brute_force(flatness):
    """A ball and a surface; the share of the true ones that is found."""
    points = np.random.default_rng(5).normal(size=(4000, 3)) * [1.0, 1.0, flatness]

    found, expected = nearest(points, 8), brute_force(points, 8)

    assert np.mean((found[:, :, None] == expected[:, None]).any(axis=1)) > 0.78
    assert (found != np.arange(4000)[:, None]).all()
    assert np.mean(found[:, 0] == expected[:, 0]) > 0.94


def test_a_cloud_of_very_uneven_density_is_searched_as_well():
    """Clusters a million times apart in size, and a line: the hardest, and still three of four."""
    rng = np.random.default_rng(2)
    points = np.concatenate(
        [rng.normal(size=(400, 3)) * size + size for size in (1e-3, 1.0, 1e3)]
        + [np.linspace(0, 1, 100)[:, None] * [5.0, 0.0, 0.0]]
    )

    found, expected = nearest(points, 7), brute_force(points, 7)

    assert np.mean((found[:, :, None] == expected[:, None]).any(axis=1)) > 0.75


def test_points_at_one_place_are_each_others_neighbours():
    found = nearest(np.zeros((100, 3)), 4)

    assert found.shape == (100, 4)
    assert all(len(set(row) | {own}) == 5 for own, row in enumerate(found.tolist()))


def test_equal_distances_come_by_index():
    """On a line of unit steps both sides of point 5 are at distance 1."""
    points = np.arange(11.0)[:, None] * [1.0, 0.0, 0.0]

    assert nearest(points, 2)[5].tolist() == [4, 6]


def test_there_are_no_neighbours_of_one_point():
    assert nearest(np.zeros((1, 3)), 8).shape == (1, 0)
    assert nearest(np.zeros((0, 3)), 8).shape == (0, 0)


@pytest.mark.slow
def test_threads_change_nothing():
    points = np.random.default_rng(3).normal(size=(60_000, 3))

    np.testing.assert_array_equal(nearest(points, 8, threads=1), nearest(points, 8, threads=2))


def test_the_search_can_be_cancelled():
    with pytest.raises(Cancelled):
        nearest(np.random.default_rng(4).normal(size=(100, 3)), 3, progress=lambda *_: False)
