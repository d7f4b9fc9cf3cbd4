"""Splats and harmonics moved by matrices, and how points moved from where they were and are."""

import math
from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import RefineError, Splats
from refine_addon.core.affine import affine_moves, baked, quaternion, transformed
from refine_addon.core.spherical_harmonics import (
    basis,
    colors,
    grading,
    recolored,
    rotate,
    stretched,
)
from refine_addon.core.splats import rotation_matrices

from .test_merging import cloud

RNG = np.random.default_rng(7)


def some(count: int = 50, degree: int = 3) -> Splats:
    return cloud(count, degree=degree)


def covariances(splats: Splats) -> np.ndarray:
    axes = rotation_matrices(splats.quaternions) * np.exp(splats.log_scales.astype(float))[:, None]
    return axes @ axes.transpose(0, 2, 1)


def directions(count: int = 40) -> np.ndarray:
    points = RNG.normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def affine(linear, shift=(0, 0, 0)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    matrix[:3, 3] = shift
    return matrix


def seen(splats, where, degree):
    """Return what the harmonics add up to in some directions, (D, N, 3)."""
    every = np.concatenate([splats.sh_dc[:, None], splats.sh_rest], axis=1)
    return np.einsum("dk,nkc->dnc", basis(where, degree), every)


ROTATION = np.linalg.qr(RNG.normal(size=(3, 3)))[0]


def test_the_basis_holds_the_real_harmonics_with_the_signs_of_the_reference():
    """From Legendre's polynomials, at (1, 2, 2) / 3 and (-6, 2, 3) / 7, degrees 0 to 4.

    Y = sqrt((2l + 1) / 4 pi (l - m)! / (l + m)!) (-sin)^m P_l^(m)(cos), times sqrt(2) cos or sin
    of m phi for m > 0. Degree 1 in 3DGS code is -0.4886 y, 0.4886 z, -0.4886 x."""
    for x, y, z in np.array([[1, 2, 2], [-6, 2, 3]]) / [[3], [7]]:
        expected = []
        for order in range(5):
            for m in range(-order, order + 1):
                size, legendre = abs(m), np.polynomial.legendre.Legendre.basis(order)
                ratio = math.factorial(order - size) / math.factorial(order + size)
                value = math.sqrt((2 * order + 1) / (4 * math.pi) * ratio) * (-1) ** size
                value *= legendre.deriv(size)(z) * (math.sqrt(2) if m else 1.0)
                turn = complex(x, y) ** size
                expected.append(value * (turn.imag if m < 0 else turn.real))

        np.testing.assert_allclose(basis(np.array([x, y, z]), 4), expected, rtol=1e-12)
        np.testing.assert_allclose(expected[1:4], 0.4886025 * np.array([-y, z, -x]), rtol=1e-6)


def test_colours_do_not_depend_on_how_harmonics_lie_in_memory():
    """Files hold them channel by channel, what was joined does not; colours agree to the bit."""
    splats, along = some(), directions(50)
    expected = colors(along, splats.sh_dc, splats.sh_rest)
    for order in ((0, 2, 1), (2, 1, 0)):
        rest = np.ascontiguousarray(splats.sh_rest.transpose(order)).transpose(order)
        np.testing.assert_array_equal(colors(along, splats.sh_dc, rest), expected)


@pytest.mark.parametrize("matrix", [ROTATION, -ROTATION, np.diag([1, 1, -1]), np.eye(3)])
@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_rotated_harmonics_show_the_old_colour_along_the_rotated_direction(matrix, degree):
    """Colour'(R d) = colour(d), for rotations and reflections."""
    rest = RNG.normal(size=(5, (degree + 1) ** 2 - 1, 3))
    where = directions()
    expected = np.einsum("dk,nkc->ndc", basis(where, degree)[:, 1:], rest)
    turned = rotate(rest, matrix)
    there = np.einsum("dk,nkc->ndc", basis(where @ matrix.T, degree)[:, 1:], turned)
    np.testing.assert_allclose(there, expected, atol=1e-12)


@pytest.mark.parametrize("degree", [0, 1, 3, 4])
def test_graded_colours_are_a_matrix_times_the_old_ones_in_all_directions(degree):
    """The inverse gives them back; what is not finite, or would not be, stays to the bit."""
    splats, matrix = some(degree=degree), grading(0.7, (1.0, 0.5, 0.2), 1.6)
    splats.sh_dc[:2] = [[np.nan, 1.0, 1.0], [3e38, -3e38, 0.0]]
    old, where = (splats.sh_dc, splats.sh_rest), directions(50)
    new = recolored(*old, matrix)
    expected = colors(where, *old)[2:] @ matrix.T
    np.testing.assert_allclose(colors(where, *new)[2:], expected, atol=1e-5)
    for back, stays, before in zip(recolored(*new, np.linalg.inv(matrix)), new, old, strict=True):
        np.testing.assert_allclose(back[2:], before[2:], atol=1e-5)
        np.testing.assert_array_equal(stays[:2], before[:2])


def test_a_stop_doubles_the_light_and_no_saturation_leaves_luma():
    """A grey of 0.5 is 0.214 of the light; twice that is 0.687. Orange: 0.2126 + 0.5 x 0.7152."""
    white = (1.0, 1.0, 1.0)
    np.testing.assert_allclose(grading(1.0, white, 1.0) @ (0.5 * np.ones(3)), 0.687, atol=0.003)
    np.testing.assert_allclose(grading(0.0, white, 0.0) @ [1.0, 0.5, 0.0], 0.5702, atol=1e-12)
    np.testing.assert_array_equal(grading(0.0, white, 1.0), np.eye(3))


STRETCH = np.array([[2, 0.3, 0], [0, 1, 0], [0, 0, 0.5]])


@pytest.mark.parametrize("linear", [1e-3 * ROTATION, ROTATION, -250.0 * ROTATION, STRETCH])
def test_a_transform_moves_means_covariances_and_colours(linear):
    """M mean + t and M covariance M'; of colours the nearest harmonics, which a rotation has.

    A stretch has none that are exact, and is refused unless colours may stay."""
    splats, matrix = some(), affine(linear, [1, -2, 3])
    stretch = linear is STRETCH
    moved = transformed(splats, matrix, rotate_sh=not stretch)

    np.testing.assert_allclose(moved.means, splats.means @ linear.T + [1, -2, 3], rtol=1e-9)
    expected = linear @ covariances(splats) @ linear.T
    scale = np.abs(expected).max((1, 2), keepdims=True)
    near = 1e-6 if stretch else 2e-6
    np.testing.assert_allclose(covariances(moved) / scale, expected / scale, atol=near)
    if stretch:
        with pytest.raises(RefineError, match="scales directions differently"):
            transformed(splats, matrix)
    else:
        turn = linear / np.cbrt(abs(np.linalg.det(linear)))
        np.testing.assert_allclose(moved.sh_rest, rotate(splats.sh_rest, turn), atol=1e-5)
        sh_dc, sh_rest = stretched(splats.sh_dc, splats.sh_rest, linear)
        np.testing.assert_allclose(sh_dc, splats.sh_dc, atol=1e-12)
        np.testing.assert_allclose(sh_rest, rotate(splats.sh_rest, turn), atol=1e-12)


@pytest.mark.parametrize("log", [-104.0, -np.inf, 88.0])
def test_a_stretch_keeps_splats_of_extreme_size(log):
    """Scales are stretched relative to the longest axis, so nothing leaves the range."""
    logs = np.tile(np.array([log, 0.0, 88.0 if log > 0 else -1.0], np.float32), (4, 1))
    upright = np.tile(np.float32([1, 0, 0, 0]), (4, 1))
    splats = replace(some(4), log_scales=logs, quaternions=upright)
    with np.errstate(all="raise"):
        moved = transformed(splats, affine(np.diag([2.0, 1.0, 1.0])), rotate_sh=False)
    expected = np.sort(logs[0] + np.array([math.log(2), 0, 0]))[::-1]
    if log > -100:
        np.testing.assert_allclose(moved.log_scales[0], expected, atol=1e-4)
    assert not np.isnan(moved.log_scales).any()


@pytest.mark.parametrize(
    "matrix",
    [np.eye(3), affine(np.diag([1, 1, 0])), affine(np.eye(3) * np.nan), np.diag([1, 1, 1, 2])],
    ids=["3 x 3", "flat", "NaN", "projective"],
)
def test_a_matrix_that_cannot_be_applied_is_refused(matrix):
    """Each would lose the splats."""
    with pytest.raises(RefineError, match=r"matrix|flat or not affine"):
        transformed(some(3), matrix)


def test_the_quaternion_of_a_rotation_gives_it_back_even_at_half_a_turn():
    """Signs differ, matrices do not."""
    turns = [ROTATION * np.linalg.det(ROTATION), np.diag([1.0, -1, -1]), np.diag([-1.0, -1, 1])]
    matrices = rotation_matrices(quaternion(np.array(turns)))

    np.testing.assert_allclose(matrices, turns, atol=1e-14)


@pytest.mark.parametrize("degree", [1, 3])
def test_no_other_harmonics_are_nearer_to_stretched_colours(degree):
    """Of least squares over the sphere: what is left is orthogonal to every harmonic."""
    linear = np.diag([1.0, 1.5, 0.8]) @ ROTATION
    splats = some(5, degree)
    where = directions(50_000)
    before = where @ np.linalg.inv(linear).T
    before /= np.linalg.norm(before, axis=1, keepdims=True)
    moved = baked(splats, affine(linear))
    left = seen(moved, where, degree) - seen(splats, before, degree)
    inner = np.einsum("dk,dnc->nkc", basis(where, degree), left) / len(where)
    assert np.abs(inner).max() < 0.02 * np.abs(seen(splats, before, degree)).mean()
    assert np.abs(left).mean() > 10 * np.abs(inner).max()


TURN = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
TURN *= np.sign(np.linalg.det(TURN))


def points(count=4000, spread=3.0, seed=0):
    places = np.random.default_rng(seed).standard_t(3, size=(count, 3))
    return (spread * places).astype(np.float32)


def mapped(where, linear, shift=(0.0, 0.0, 0.0)):
    """Move points as Blender does: in float32."""
    linear, shift = np.float32(linear), np.float32(shift)
    return where @ linear.T + shift


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
    modifier merges what is near it."""
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

    Any four points have an affine map in common; a line can be turned about itself."""
    plane, line, few = points(), points(100), points(4)
    plane[:, 2], line[:, 1:] = 1.0, 0.0
    (move,) = affine_moves(plane, mapped(plane, 3.0 * TURN))

    np.testing.assert_allclose(move.matrix[:3, :3], 3.0 * TURN, atol=2e-6)
    assert affine_moves(few, mapped(few, TURN)) == affine_moves(line, mapped(line, TURN)) == []


def test_as_many_maps_are_looked_for_whether_or_not_some_points_stay():
    """32 of 40 groups that move apart."""
    before = points(41 * 20)
    shifts = np.repeat(np.arange(41.0, dtype=np.float32), 20)[:, None]
    for some in (slice(None), slice(20, None)):
        moves = affine_moves(before[some], (before + shifts)[some])
        assert sum(move.matrix[0, 3] != 0.0 for move in moves) == 32
