"""How points moved is found from where they were and where they are."""

from __future__ import annotations

import numpy as np
import pytest

from refine_addon.core.affine import affine_moves

TURN = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
TURN *= np.sign(np.linalg.det(TURN))


def points(count=4000, spread=3.0, seed=0):
    places = np.random.default_rng(seed).standard_t(3, size=(count, 3))
    return (spread * places).astype(np.float32)


def mapped(where, linear, shift=(0.0, 0.0, 0.0)):
    """Move points as Blender does: in float32."""
    linear, shift = np.float32(linear), np.float32(shift)
    return where @ linear.T + shift


@pytest.mark.parametrize(
    "linear", [TURN, 0.01 * TURN, -TURN, np.diag([1.0, 2.0, 0.5]) @ TURN], ids=str
)
def test_one_map_of_all_points_is_found_to_the_precision_of_float32(linear):
    """As Apply > Rotation & Scale leaves them: M p + t."""
    before = points()
    (move,) = affine_moves(before, mapped(before, linear, [5.0, -2.0, 0.1]))

    np.testing.assert_array_equal(move.rows, np.arange(len(before)))
    np.testing.assert_allclose(move.matrix[:3, :3], linear, atol=1e-6)
    np.testing.assert_allclose(move.matrix[:3, 3], [5.0, -2.0, 0.1], atol=1e-5)


def test_what_was_moved_alike_or_not_at_all_is_not_turned():
    """A translation by (100, 0, 0) loses digits of small coordinates: that is no rotation."""
    before = points()
    after = before.copy()
    after[1000:] += np.float32([100.0, 0.0, 0.0])

    still, shifted = affine_moves(before, after)

    for move in (still, shifted):
        np.testing.assert_array_equal(move.matrix[:3, :3], np.eye(3))
    np.testing.assert_array_equal(still.rows, np.arange(1000))
    np.testing.assert_array_equal(shifted.rows, np.arange(1000, 4000))


@pytest.mark.parametrize("seed", [0, 27, 1])
@pytest.mark.parametrize("order", ["joined", "scattered"])
def test_several_maps_are_told_apart(order, seed):
    """As Join leaves objects, and the edit mode selections: each point is in its own map."""
    before = points(2700, seed=seed)
    part = np.repeat([0, 1, 2, 3], [900, 900, 750, 150])
    if order == "scattered":
        part = np.random.default_rng(seed).permutation(part)
    linears = [np.eye(3), TURN, np.diag([1.0, 1.0, -1.0]), 2.0 * TURN.T]
    after = before.copy()
    for number, linear in enumerate(linears[1:], 1):
        after[part == number] = mapped(before[part == number], linear, [number, 0.0, 0.0])

    moves = affine_moves(before, after)

    assert len(moves) == 4
    for move in moves:
        (number,) = np.unique(part[move.rows])
        assert len(move.rows) == np.count_nonzero(part == number)
        np.testing.assert_allclose(move.matrix[:3, :3], linears[number], atol=1e-5)


def test_points_that_are_moved_one_by_one_have_no_map():
    """20 of 4,000 went their own ways after all were turned; one is not finite."""
    before = points()
    after = mapped(before, TURN)
    after[::200] += points(20, 1.0, seed=1)
    after[7] = np.nan

    (move,) = affine_moves(before, after)

    expected = np.setdiff1d(np.arange(4000), [*range(0, 4000, 200), 7])
    np.testing.assert_array_equal(move.rows, expected)
    np.testing.assert_allclose(move.matrix[:3, :3], TURN, atol=1e-6)


def test_points_that_are_moved_into_a_plane_have_no_map():
    """As a mirror modifier merges what is near it: 100 of 4,000 points, on a slanted plane."""
    before = points()
    after = mapped(before, np.diag([-1.0, 1.0, 1.0]))
    after[:100] = mapped(mapped(before[:100], np.diag([0.0, 1.0, 1.0])), TURN)

    (move,) = affine_moves(before, after)

    np.testing.assert_array_equal(move.rows, np.arange(100, 4000))
    assert affine_moves(before[:100], after[:100]) == []


def test_a_plane_is_turned_and_scaled_as_a_whole():
    """What lies across it follows by the scale within it, and is not mirrored: 3 R."""
    before = points()
    before[:, 2] = 1.0

    (move,) = affine_moves(before, mapped(before, 3.0 * TURN))

    np.testing.assert_allclose(move.matrix[:3, :3], 3.0 * TURN, atol=2e-6)


def test_too_few_points_and_points_on_a_line_have_no_map():
    """Any four points have an affine map in common; a line can be turned about itself."""
    few, line = points(4), points(100)
    line[:, 1:] = 0.0

    assert affine_moves(few, mapped(few, TURN)) == []
    assert affine_moves(line, mapped(line, TURN)) == []
