"""Baselines that render: removal in rounds."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("numba")

from benchmarks.baselines.rendered import removed_in_rounds
from benchmarks.renderer.rasterizer import accumulate_statistics
from refine_addon.core.splats import Splats
from refine_addon.core.views import View, ViewSet

VIEWS = ViewSet((View(np.eye(3), np.zeros(3), 40.0, 40.0, 20.0, 15.0, 40, 30),))


def scene_of(places: list[list[float]], logits: list[float]) -> Splats:
    """Return white splats of 10 cm."""
    count = len(places)
    return Splats(
        np.array(places),
        np.full((count, 3), np.log(0.1)),
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.array(logits),
        np.full((count, 3), 1.7),
        np.zeros((count, 0, 3)),
    )


def test_of_two_splats_that_stand_for_each_other_one_stays() -> None:
    """Errors follow from alpha u, u the footprint's Gaussian, by ``integral of change^2 / u du``.

    Removing one of two twins of opacity 1 changes a pixel by u (1 - u): 1/12. Removing one of two
    others, of opacity .6, by .6 u: .18. Removing the last of the twins, by u: 1/2. So at once both
    twins go; in rounds, one of them and the fainter of the others.
    """
    splats = scene_of([[0, 0, 2], [0, 0, 2.01], [0.5, 0, 2], [-0.5, 0, 2]], [4.6, 4.6, 0.4, 0.45])

    at_once = removed_in_rounds(splats, VIEWS, 2, rounds=1)
    in_rounds = removed_in_rounds(splats, VIEWS, 2, rounds=2)

    np.testing.assert_array_equal(at_once, [2, 3])
    assert np.count_nonzero(in_rounds < 2) == 1
    assert in_rounds[1] == 3


@pytest.mark.parametrize("keep_count", [1, 7, 12])
def test_as_many_stay_as_asked_for_and_one_round_is_the_order_of_the_error(keep_count: int) -> None:
    """Whether or not the number removed is a multiple of the rounds; ascending indices."""
    rng = np.random.default_rng(0)
    splats = scene_of((rng.normal([0, 0, 3], 0.3, (12, 3))).tolist(), rng.normal(0, 1, 12).tolist())
    error = accumulate_statistics(splats, VIEWS).removal_error

    once = removed_in_rounds(splats, VIEWS, keep_count, rounds=1)

    np.testing.assert_array_equal(once, np.sort(np.argsort(-error, kind="stable")[:keep_count]))
    assert len(removed_in_rounds(splats, VIEWS, keep_count)) == keep_count
