"""What frustums say of boxes, against what they say of the points in them."""

from __future__ import annotations

import numpy as np
import pytest

from refine_addon.core import View, ViewSet
from refine_addon.core.visibility.frustum import Frustums

REACH = 0.05


def views(random: np.random.Generator, count: int) -> ViewSet:
    """Return views of all kinds: long and short, off centre, with planes and without."""
    return ViewSet(
        tuple(
            View(
                np.linalg.qr(random.normal(size=(3, 3)))[0], random.normal(size=3),
                *random.uniform(30, 200, 2), *random.uniform(20, 80, 2), 100, 60,
                near=near, far=far,
            )
            for near, far in [(0.0, np.inf), (0.5, np.inf), (0.2, 2.0)] * count
        )
    )  # fmt: skip


def answers(seed: int) -> tuple[np.ndarray, ...]:
    """Return of 60 views and 200 boxes what is said of the boxes and of points in them.

    Some and whole, (V, k); which points count, be it that they reach inside, and which lie in the
    view, (V, k, n).
    """
    random = np.random.default_rng(seed)
    cameras = views(random, 20)
    frustums = Frustums(cameras, np.zeros(3), 0.01)
    low = random.normal(size=(3, 200)) * 2
    high = low + random.exponential(0.3, size=low.shape)
    some, whole = frustums.classify(low, high, np.full(200, REACH))
    corners = np.indices((2, 2, 2)).reshape(3, -1)
    share = np.concatenate([corners, random.random((3, 8))], axis=1)  # (3, n)
    points = np.ones((4, 200, share.shape[1]))
    points[:3] = low[..., None] + (high - low)[..., None] * share[:, None]
    _, beyond, between = frustums.project(points.reshape(4, -1), np.arange(60), 60)
    inside = between & (beyond <= 0.0)
    counted = between & (beyond < REACH * frustums.beyond_per_unit)
    shape = (60, 200, -1)
    return some, whole, counted.reshape(shape), inside.reshape(shape)


@pytest.mark.parametrize("seed", range(3))
def test_a_view_that_is_left_out_sees_nothing_of_a_box_and_one_that_sees_all_each_point(seed):
    """A third of all pairs is left out.

    Frustums are convex: where its corners are inside, all of the box is, and that is known.
    """
    some, whole, counted, inside = answers(seed)

    assert not counted[~some].any()
    assert np.mean(~some) > 1 / 3
    np.testing.assert_array_equal(whole, inside.all(axis=2))
    assert whole.any()


def test_a_box_that_touches_an_edge_is_neither_left_out_nor_whole_for_certain():
    """Edges are inside, by sums that round: a point at the edge is decided by `project` alone."""
    cameras = ViewSet((View(np.eye(3), np.zeros(3), 50.0, 50.0, 50.0, 50.0, 100, 100),))
    edge = np.array([[1.0], [0.0], [1.0]])

    some, whole = Frustums(cameras, np.zeros(3), 0.01).classify(edge, edge, np.zeros(1) + 1e-9)

    assert some.all()
    assert not whole.any()
