"""What the 3D view draws, as arrays: its order, its colours, its textures."""

from __future__ import annotations

import numpy as np
import pytest

from refine_addon.core import spherical_harmonics
from refine_addon.core.splats import Splats
from refine_addon.viewport import arrays
from refine_addon.viewport.arrays import Eye


def _splats(count=50, degree=3, seed=0):
    rng = np.random.default_rng(seed)
    return Splats(
        means=rng.normal(size=(count, 3)).astype(np.float32),
        log_scales=rng.normal(size=(count, 3)).astype(np.float32) - 2.0,
        quaternions=rng.normal(size=(count, 4)).astype(np.float32),
        opacity_logits=rng.normal(size=count).astype(np.float32),
        sh_dc=rng.normal(size=(count, 3)).astype(np.float32),
        sh_rest=rng.normal(size=(count, (degree + 1) ** 2 - 1, 3)).astype(np.float32) * 0.3,
    )


def _eye(place=(0.0, 0.0, -5.0), *, perspective=True):
    """Return an eye that looks along +z from a place."""
    place = np.array(place)
    return Eye(np.array([0.0, 0.0, 1.0, -place[2]]), place, perspective)


@pytest.mark.parametrize("degree", [0, 1, 3, 4])
def test_colours_are_those_of_the_harmonics_along_the_line_from_the_eye(degree):
    """Within 4 units of float16's 2^-11: coefficients up to 4 times a basis below 1."""
    splats, eye = _splats(degree=degree), _eye()
    away = splats.means - eye.place
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    expected = spherical_harmonics.colors(away, splats.sh_dc, splats.sh_rest).clip(0.0)
    packed = arrays.pack(splats)
    found = arrays.colors(packed, eye)

    np.testing.assert_allclose(found[:, :3], expected, atol=8e-3)
    np.testing.assert_array_equal(found[:, 3], packed.opacities)


def test_without_perspective_every_splat_is_seen_along_the_same_line():
    """The eye's place is then the direction of view, of any length."""
    splats = _splats(degree=2)
    along = np.broadcast_to([0.0, 0.6, 0.8], (50, 3))
    expected = spherical_harmonics.colors(along, splats.sh_dc, splats.sh_rest).clip(0.0)
    found = arrays.colors(arrays.pack(splats), _eye((0.0, 3.0, 4.0), perspective=False))

    np.testing.assert_allclose(found[:, :3], expected, atol=8e-3)


def test_constant_colours_need_no_eye():
    """They are ``1/2 + SH_C0 f_dc``, at least 0 and not cut at 1: blending does that."""
    splats = _splats()
    expected = (0.5 + 0.28209479 * splats.sh_dc).clip(0.0)

    np.testing.assert_allclose(arrays.colors(arrays.pack(splats))[:, :3], expected, atol=2e-3)


def test_what_cannot_be_drawn_is_not_packed():
    """One not finite, one more transparent than 1/255, whose logit is -5.5; the rest in order."""
    splats = _splats(5)
    splats.means[1, 0] = np.nan
    splats.opacity_logits[3] = -5.6

    assert arrays.pack(splats).vertices.tolist() == [0, 2, 4]


def test_harmonics_beyond_half_precision_are_cut_at_its_end():
    """Its largest number is 65504."""
    splats = _splats(2)
    splats.sh_rest[0, 0, 0], splats.sh_rest[1, 1, 1] = 1e9, -1e9
    packed = arrays.pack(splats)

    assert packed.harmonics[0, 1, 0] == 65504.0
    assert packed.harmonics[1, 2, 1] == -65504.0
    assert np.isfinite(arrays.colors(packed, _eye())).all()


@pytest.mark.parametrize("perspective", [True, False])
def test_splats_are_drawn_from_the_farthest_to_the_nearest(perspective):
    """Depths fall but for steps of 16 bits: of the range, or in perspective of its logarithms."""
    depths = np.exp(np.random.default_rng(1).uniform(-3.0, 6.0, 20_000)).astype(np.float32)
    found = depths[arrays.farthest_first(depths, perspective=perspective)]
    step = np.ptp(np.log(depths)) / 65535.0 * found[1:] if perspective else np.ptp(depths) / 65535.0

    assert sorted(found) == sorted(depths)
    assert (np.diff(found) <= 1.01 * step).all()


def test_equal_depths_and_none_at_all_are_in_order():
    """A stable sort leaves equals as they come."""
    assert arrays.farthest_first(np.full(4, 2.0, np.float32), perspective=True).tolist() == [
        *(0, 1, 2, 3)
    ]
    assert arrays.farthest_first(np.empty(0, np.float32), perspective=True).tolist() == []


def test_what_lies_behind_the_near_plane_is_left_out():
    """From z = -5 along +z with the near plane at 1: depths 0.5 and -1 are not, 2 and 7 are."""
    means = np.zeros((4, 3), np.float32)
    means[:, 2] = [-4.5, -3.0, -6.0, 2.0]
    shown, depths = arrays.in_front(means, _eye(), 1.0)

    assert shown.tolist() == [1, 3]
    assert depths.tolist() == [2.0, 7.0]


def test_few_splats_are_those_of_the_highest_rank_or_the_largest_and_most_opaque():
    """Opacity times squared sizes: of equal opacity the larger first; ranks overrule that."""
    splats = _splats(3)
    splats.log_scales[:] = np.array([-2.0, 0.0, -1.0], np.float32)[:, None]
    splats.opacity_logits[:] = 0.0
    packed = arrays.pack(splats)

    assert arrays.most_important_first(packed).tolist() == [1, 2, 0]
    assert arrays.most_important_first(packed, np.array([0.5, 0.0, 1.0])).tolist() == [2, 0, 1]


def test_several_objects_share_what_is_drawn_while_moving():
    """30 of 60 is half of each; where all fit, all."""
    assert arrays.first_of_each([40, 20], 30) == [20, 10]
    assert arrays.first_of_each([40, 20], 60) == [40, 20]


def test_a_texture_holds_a_value_after_the_other_in_rows_of_its_width():
    """WIDTH + 1 values of 2 channels: a second row, of which one texel is not zero."""
    values = np.arange(2 * (arrays.WIDTH + 1), dtype=np.float32).reshape(-1, 2)
    texels = arrays.as_texture(values)

    assert texels.shape == (2, 2 * arrays.WIDTH)
    assert texels[0].tolist() == values[: arrays.WIDTH].ravel().tolist()
    assert texels[1, :2].tolist() == values[-1].tolist()
    assert not texels[1, 2:].any()
    assert arrays.as_texture(np.empty(0)).shape == (1, arrays.WIDTH)


def test_heat_goes_along_the_ramp_by_rank():
    """Ranks 0, 1/2 and 1 of a ramp of three; a rank that is no number counts as 0."""
    packed = arrays.pack(_splats(4))
    ramp = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 0.0, 0.0]])
    found = arrays.heat(packed, np.array([0.0, 0.5, 1.0, np.nan]), ramp)

    assert found[:, 0].tolist() == [0.0, 0.5, 1.0, 0.0]
    np.testing.assert_array_equal(found[:, 3], packed.opacities)


def test_a_tint_leaves_opacity_alone():
    """A quarter of red in a grey of .4: .55, .3, .3; above white counts as white."""
    rgba = np.array([[0.4, 0.4, 0.4, 0.7], [3.0, 0.0, 0.0, 0.1]], np.float32)
    found = arrays.tinted(rgba, (1.0, 0.0, 0.0), 0.25)

    np.testing.assert_allclose(found, [[0.55, 0.3, 0.3, 0.7], [1.0, 0.0, 0.0, 0.1]], rtol=1e-6)


def test_a_covariance_is_turned_as_its_splat():
    """Scales 3, 2, 1 turned a quarter about z: 2 along x, 3 along y; variances 4, 9, 1."""
    splats = _splats(1)
    splats.log_scales[0] = np.log([3.0, 2.0, 1.0])
    splats.quaternions[0] = [0.5, 0.0, 0.0, 0.5]  # of any length
    expected = [4.0, 0.0, 0.0, 9.0, 0.0, 1.0]

    np.testing.assert_allclose(arrays.pack(splats).covariances[0], expected, atol=1e-5)


@pytest.mark.parametrize("mode", ["SCENE", "HEAT"])
@pytest.mark.parametrize("mark", [arrays.STAYS, arrays.GOES])
@pytest.mark.parametrize("ground", [0.0, 0.5, 1.0])
def test_tints_are_seen_on_black_grey_and_white(mode, mark, ground):
    """A channel changes by more than .15, 38 of 255; white, a tint before, changed no white."""
    rgba = np.array([[ground, ground, ground, 1.0]], np.float32)
    tinted = arrays.marked(rgba, np.array([mark]), mode)

    assert np.abs(tinted - rgba).max() > 0.15
    selected = arrays.tinted(rgba, arrays.SELECTED, arrays.SELECTED_SHARE)
    assert np.abs(selected - rgba).max() > 0.25
