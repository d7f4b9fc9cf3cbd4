"""What the 3D view draws, as arrays: its order, its colours, its textures."""

import numpy as np
import pytest

from refine_addon.core import spherical_harmonics
from refine_addon.viewport import arrays
from refine_addon.viewport.arrays import Eye

from .test_merging import cloud


def _eye(place=(0.0, 0.0, -5.0), *, perspective=True):
    """Return an eye that looks along +z from a place."""
    place = np.array(place)
    return Eye(np.array([0.0, 0.0, 1.0, -place[2]]), place, perspective)


@pytest.mark.parametrize("degree", [0, 1, 3, 4])
def test_colours_are_those_of_the_harmonics_along_the_line_from_the_eye(degree):
    """Within 4 units of float16's 2^-11: coefficients up to 4 times a basis below 1.

    Without perspective the eye's place is the direction of view, of any length. Without an eye
    they are ``1/2 + SH_C0 f_dc``, at least 0 and not cut at 1: blending does that.
    """
    splats = cloud(50, degree=degree)
    packed = arrays.pack(splats)
    away = splats.means - [0.0, 0.0, -5.0]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    along = np.broadcast_to([0.0, 0.6, 0.8], (50, 3))
    for direction, eye in ((away, _eye()), (along, _eye((0.0, 3.0, 4.0), perspective=False))):
        found = arrays.colors(packed, eye)
        expected = spherical_harmonics.colors(direction, splats.sh_dc, splats.sh_rest).clip(0.0)
        np.testing.assert_allclose(found[:, :3], expected, atol=8e-3)
        np.testing.assert_array_equal(found[:, 3], packed.opacities)
    plain = (0.5 + 0.28209479 * splats.sh_dc).clip(0.0)
    np.testing.assert_allclose(arrays.colors(packed)[:, :3], plain, atol=2e-3)


def test_what_cannot_be_drawn_is_not_packed_and_the_rest_is_of_half_precision():
    """One not finite, one more transparent than 1/255, whose logit is -5.5; the rest in order.

    The largest number of half precision is 65504. Scales 3, 2, 1 turned a quarter about z by a
    quaternion of any length are 2 along x, 3 along y: variances 4, 9, 1.
    """
    splats = cloud(5)
    splats.means[1, 0], splats.opacity_logits[3] = np.nan, -5.6
    splats.sh_rest[0, 0, 0], splats.sh_rest[2, 1, 1] = 1e9, -1e9
    splats.log_scales[4], splats.quaternions[4] = np.log([3.0, 2.0, 1.0]), [0.5, 0.0, 0.0, 0.5]
    packed = arrays.pack(splats)

    assert packed.vertices.tolist() == [0, 2, 4]
    assert [packed.harmonics[0, 1, 0], packed.harmonics[1, 2, 1]] == [65504.0, -65504.0]
    assert np.isfinite(arrays.colors(packed, _eye())).all()
    expected = [4.0, 0.0, 0.0, 9.0, 0.0, 1.0, 0.0, 0.0]
    np.testing.assert_allclose(packed.covariances[2], expected, atol=1e-5)


@pytest.mark.parametrize("perspective", [True, False])
def test_splats_are_drawn_from_the_farthest_to_the_nearest(perspective):
    """Depths fall but for steps of 16 bits: of the range, or in perspective of its logarithms.

    Equals stay as they come.
    """
    depths = np.exp(np.random.default_rng(1).uniform(-3.0, 6.0, 20_000)).astype(np.float32)
    found = depths[arrays.farthest_first(depths, perspective=perspective)]
    step = np.ptp(np.log(depths)) / 65535.0 * found[1:] if perspective else np.ptp(depths) / 65535.0

    assert sorted(found) == sorted(depths)
    assert (np.diff(found) <= 1.01 * step).all()
    for count in (4, 0):
        same = arrays.farthest_first(np.full(count, 2.0, np.float32), perspective=perspective)
        assert same.tolist() == list(range(count))


def test_what_lies_behind_the_near_plane_is_left_out():
    """From z = -5 along +z with the near plane at 1: depths 0.5 and -1 are not, 2 and 7 are."""
    means = np.zeros((4, 3), np.float32)
    means[:, 2] = [-4.5, -3.0, -6.0, 2.0]
    shown, depths = arrays.in_front(means, _eye(), 1.0)

    assert shown.tolist() == [1, 3]
    assert depths.tolist() == [2.0, 7.0]


def test_few_splats_are_those_of_the_highest_rank_or_the_largest_and_most_opaque():
    """Opacity times squared sizes: of equal opacity the larger first; ranks overrule that.

    30 of 60 is half of each of two objects; where all fit, all.
    """
    splats = cloud(3)
    splats.log_scales[:] = np.array([-2.0, 0.0, -1.0], np.float32)[:, None]
    splats.opacity_logits[:] = 0.0
    packed = arrays.pack(splats)

    assert arrays.most_important_first(packed).tolist() == [1, 2, 0]
    assert arrays.most_important_first(packed, np.array([0.5, 0.0, 1.0])).tolist() == [2, 0, 1]
    assert [arrays.first_of_each([40, 20], most) for most in (30, 60)] == [[20, 10], [40, 20]]


def test_heat_goes_along_the_ramp_by_rank_and_a_tint_leaves_opacity_alone():
    """Ranks 0, 1/2 and 1 of a ramp of three; a rank that is no number counts as 0.

    A quarter of red in a grey of .4: .55, .3, .3; above white counts as white.
    """
    packed = arrays.pack(cloud(4))
    ramp = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 0.0, 0.0]])
    found = arrays.heat(packed, np.array([0.0, 0.5, 1.0, np.nan]), ramp)
    rgba = np.array([[0.4, 0.4, 0.4, 0.7], [3.0, 0.0, 0.0, 0.1]], np.float32)
    tinted = arrays.tinted(rgba, (1.0, 0.0, 0.0), 0.25)

    assert found[:, 0].tolist() == [0.0, 0.5, 1.0, 0.0]
    np.testing.assert_array_equal(found[:, 3], packed.opacities)
    np.testing.assert_allclose(tinted, [[0.55, 0.3, 0.3, 0.7], [1.0, 0.0, 0.0, 0.1]], rtol=1e-6)


@pytest.mark.parametrize("mode", ["SCENE", "HEAT"])
@pytest.mark.parametrize("mark", [arrays.STAYS, arrays.GOES])
@pytest.mark.parametrize("ground", [0.0, 0.5, 1.0])
def test_tints_are_seen_on_black_grey_and_white(mode, mark, ground):
    """A channel changes by more than .15, 38 of 255; white, a tint before, changed no white."""
    splats = cloud(1)
    splats.sh_dc[:] = (ground - 0.5) / 0.28209479
    packed = arrays.pack(splats)
    rgba = arrays.colors(packed)
    marked = arrays.colored(packed, None, mode, arrays.Marks(forced=np.array([mark])))

    assert np.abs(marked - rgba).max() > 0.15
    assert np.abs(arrays.tinted(rgba, arrays.SELECTED, arrays.SELECTED_SHARE) - rgba).max() > 0.25


def test_a_texture_holds_a_value_after_the_other_in_rows_of_its_width():
    """WIDTH + 1 values of 2 channels: a second row, of which one texel is not zero."""
    values = np.arange(1.0, 2 * arrays.WIDTH + 3, dtype=np.float32).reshape(-1, 2)
    texels = arrays.as_texture(values)

    assert texels.shape == (2, 2 * arrays.WIDTH)
    assert np.array_equal(texels.ravel()[: values.size], values.ravel())
    assert not texels[1, 2:].any()
