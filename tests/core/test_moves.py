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


@pytest.mark.parametrize(
    "linear", [TURN, 0.01 * TURN, -TURN, np.diag([1.0, 2.0, 0.5]) @ TURN], ids=str
)
def test_points_that_are_moved_one_by_one_or_into_a_plane_have_no_map(linear):
    """The others have one, as Apply > Rotation & Scale leaves them: M p + t, in float32.

    20 of 4,000 went their own ways, one is not finite; 100 lie on a slanted plane, as a mirror
    modifier merges what is near it.
    """
    before = points()
    after = mapped(before, linear, [5.0, -2.0, 0.1])
    after[::200] += points(20, 1.0, seed=1)
    after[7] = np.nan
    after[1001:1100] = mapped(mapped(before[1001:1100], np.diag([0.0, 1.0, 1.0])), TURN)

    (move,) = affine_moves(before, after)

    lost = [*range(0, 4000, 200), 7, *range(1001, 1100)]
    np.testing.assert_array_equal(move.rows, np.setdiff1d(np.arange(4000), lost))
    np.testing.assert_allclose(move.matrix[:3, :3], linear, atol=1e-6)
    np.testing.assert_allclose(move.matrix[:3, 3], [5.0, -2.0, 0.1], atol=1e-5)
    assert affine_moves(before[1001:1100], after[1001:1100]) == []


def test_a_plane_is_turned_and_scaled_as_a_whole_but_a_line_or_four_points_are_not():
    """What lies across it follows by the scale within it, and is not mirrored: 3 R.

    Any four points have an affine map in common; a line can be turned about itself.
    """
    plane, line, few = points(), points(100), points(4)
    plane[:, 2], line[:, 1:] = 1.0, 0.0

    (move,) = affine_moves(plane, mapped(plane, 3.0 * TURN))

    np.testing.assert_allclose(move.matrix[:3, :3], 3.0 * TURN, atol=2e-6)
    assert affine_moves(few, mapped(few, TURN)) == affine_moves(line, mapped(line, TURN)) == []
