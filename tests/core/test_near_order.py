"""Orders in which consecutive positions lie near each other."""

from __future__ import annotations

import numpy as np
import pytest

from refine_addon.core.scoring.closed_form import _near_order, _places


def test_consecutive_cells_of_the_curve_share_a_face():
    """That is what makes it Hilbert's: each of 32768 cells occurs once, a step from the one before.

    The curve begins in the first cell, and ends at the far end of an axis.
    """
    path = np.argsort(_places())

    cells = np.stack([path >> 10, path >> 5 & 31, path & 31])
    assert (np.abs(np.diff(cells, axis=1)).sum(axis=0) == 1).all()
    assert sorted(_places().tolist()) == list(range(32**3))
    assert not cells[:, 0].any()
    assert sorted(cells[:, -1].tolist()) == [0, 0, 31]


@pytest.mark.parametrize("flat", [1.0, 0.01])
def test_runs_are_small_boxes(flat):
    """Of 2^16 positions, 64 runs of 1024 are on average at most half as long as the scene.

    Cubes that fill it would be a quarter as long, squares an eighth; runs of positions in random
    order, or of slices of the grid, are as long as the scene.
    """
    positions = np.random.default_rng(1).random((1 << 16, 3)) * (1.0, 1.0, flat)

    runs = positions[_near_order(positions)].reshape(64, 1024, 3)

    assert np.ptp(runs, axis=1).max(axis=1).mean() < 0.5


@pytest.mark.parametrize(
    "positions",
    [
        np.zeros((5, 3), np.float32),
        np.array([[3.4e38] * 3, [-3.4e38] * 3, [1e-45] * 3, [0, 0, 0]], np.float32),
        np.array([[1e-300, 0, 0], [-1e-300, 1e38, 0]]),
        np.ones((1, 3)),
    ],
    ids=["one place", "ends of float32", "ends of float64", "one"],
)
def test_any_finite_positions_have_an_order(positions):
    """No warning, and each row once."""
    assert sorted(_near_order(positions).tolist()) == list(range(len(positions)))


def test_positions_at_one_place_keep_their_order():
    """All are in one cell."""
    assert _near_order(np.full((100, 3), 7.0)).tolist() == list(range(100))
