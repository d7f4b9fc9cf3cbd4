"""Activations and what counts as drawable."""

from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import Splats
from refine_addon.core.splats import (
    ARRAYS,
    base_color,
    drawable,
    opacity,
    rotation_matrices,
    scales,
    single_log_scales,
    single_logits,
    single_unit_quaternions,
)


def one(**changes) -> Splats:
    values = {
        "means": np.zeros((1, 3), np.float32),
        "log_scales": np.zeros((1, 3), np.float32),
        "quaternions": np.array([[1, 0, 0, 0]], np.float32),
        "opacity_logits": np.zeros(1, np.float32),
        "sh_dc": np.zeros((1, 3), np.float32),
        "sh_rest": np.zeros((1, 15, 3), np.float32),
    }
    return Splats(**values | changes)


@pytest.mark.parametrize(
    ("logit", "expected"),
    [
        (0.0, 0.5),
        (np.log(3.0), 0.75),  # 1 / (1 + 1/3)
        (-np.log(3.0), 0.25),
        (np.inf, 1.0),
        (-50.0, 1.9287498479639178e-22),  # e^-50 / (1 + e^-50)
        (1e3, 1.0),
    ],
)
def test_opacity_is_the_logistic_function(logit, expected):
    with np.errstate(all="raise"):
        assert opacity(np.array(logit)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("logit", [-1e3, -1e30, -np.inf])
def test_opacity_underflows_silently(logit):
    """What is below 1e-304 is returned as about that: far below the smallest float32."""
    with np.errstate(all="raise"):
        assert 0.0 <= opacity(np.array(logit)) < 1e-303


def single(values):
    """Round to float32, as Blender's attributes do."""
    with np.errstate(all="ignore"):
        return np.asarray(values, np.float32)


def test_logits_and_log_scales_of_what_is_stored_give_it_back_to_the_bit():
    """Ends, the smallest number, the largest below 1; the activated value rounds to what was.

    Scales of 0 too: exp(-104) is 6.8e-46, less than half of the smallest float32, 7.0e-46. What is
    0 is not drawn, the smallest float32 is, of either.
    """
    stored = single([0.0, 1e-45, 1e-38, 1e-7, 0.25, 0.5, 1.0 - 2.0**-24, 1.0])
    sizes = np.append(stored, np.float32(3e38))
    with np.errstate(all="raise", under="ignore"):
        logits, logs = single_logits(stored), single_log_scales(sizes)

    assert np.isfinite(logits).all()
    assert np.isfinite(logs).all()
    assert single(opacity(logits)).tobytes() == stored.tobytes()
    assert single(scales(logs)).tobytes() == sizes.tobytes()
    assert single_log_scales(-sizes).tobytes() == logs.tobytes()
    assert logits[0] == pytest.approx(-104.0)
    assert logits[-1] == pytest.approx(np.log(2.0**26 - 1.0))  # the logit of 1 - 2^-26
    for k, seen in ((0, False), (1, True)):
        assert drawable(one(opacity_logits=single(logits[[k]]))).tolist() == [seen]
        assert drawable(one(log_scales=single(logs[[[k, k, k]]]))).tolist() == [seen]


def test_no_number_of_a_file_changes_by_a_millionth_on_the_way_through_float32():
    """The activated value is rounded to float32, then what is stored: 6e-8 each at most.

    Far from 0 the second rounding leads back: half a step of a logit of 32 is 2e-6, far more than
    the 6e-8 by which the first one moved it.
    """
    values = single(np.random.default_rng(0).uniform(-80.0, 80.0, 100_000))
    again = opacity(single(single_logits(single(opacity(values)))))
    sizes = scales(single(single_log_scales(single(scales(values)))))

    assert np.abs(again / opacity(values) - 1.0).max() < 2e-7
    assert np.abs(sizes / scales(values) - 1.0).max() < 2e-7


def test_quaternions_become_unit_and_stay_where_they_are():
    """(0, 3, 0, 4) / 5; zero is the identity; unit ones and those not finite keep their bits."""
    stored = single(np.random.default_rng(0).normal(size=(1000, 4)))
    stored = single(stored / np.linalg.norm(stored.astype(float), axis=1, keepdims=True))
    odd = single([[0, 3, 0, 4], [0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1], [1e38] * 4])
    with np.errstate(all="raise"):
        got = single_unit_quaternions(odd)

    assert single_unit_quaternions(stored).tobytes() == stored.tobytes()
    assert got[0] == pytest.approx([0.0, 0.6, 0.0, 0.8])
    assert got[1].tolist() == [1, 0, 0, 0]
    assert got[2:4].tobytes() == odd[2:4].tobytes()
    assert got[4] == pytest.approx([0.5] * 4)


def test_base_color_is_the_constant_harmonic_and_a_half():
    """0.5 + 0.28209 f_dc: 1 reaches 0.78209, +-1e20 clip."""
    assert base_color(np.array([1.0, 1e20, -1e20])) == pytest.approx([0.7820947917738781, 1, 0])


@pytest.mark.parametrize("small", [0.0, 1e-160, 1e-200, 1e-320])
@pytest.mark.parametrize("length", [1e-300, 1.0, 3.7, 1e300])
def test_a_quaternion_of_any_length_is_a_rotation(length, small):
    """(1, 0, 0, 1) turns a quarter about z: x goes to y. What is small beside the rest is nothing.

    One that says nothing counts as the identity.
    """
    quarter = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    quaternion = length * np.array([1.0, small, -small, 1.0])
    with np.errstate(all="raise"):
        matrix = rotation_matrices(quaternion)
        none = rotation_matrices(np.array([[0, 0, 0, 0], [np.nan, 0, 0, 0], [np.inf, 1, 0, 0]]))

    np.testing.assert_allclose(matrix, quarter, atol=1e-15)
    np.testing.assert_array_equal(none, np.tile(np.eye(3), (3, 1, 1)))


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_makes_a_splat_undrawable(name, value):
    """Except opacity 1 (logit +inf) and a flat splat (one log scale -inf)."""
    values = getattr(one(), name).copy()
    values.flat[-1] = value
    fine = (name, value) in (("opacity_logits", np.inf), ("log_scales", -np.inf))
    with np.errstate(all="raise"):
        assert drawable(one(**{name: values})).tolist() == [fine]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, True),
        ({"opacity_logits": [-103.0]}, True),  # 1.9e-45, the smallest float32 is 1.4e-45
        ({"opacity_logits": [-104.0]}, False),
        ({"log_scales": [[88.7, 0, 0]]}, True),  # 3.3e38, the largest float32 is 3.4e38
        ({"log_scales": [[88.8, 0, 0]]}, False),
        ({"log_scales": [[-104, -104, -104]]}, False),
        ({"log_scales": [[-104, -104, 0]]}, True),
        ({"log_scales": [[-np.inf, -np.inf, -np.inf]]}, False),
        ({"means": [[1e39, 0, 0]]}, False),
    ],
)
def test_what_leaves_the_range_of_float32_cannot_be_drawn(changes, expected):
    """Renderers compute in float32; doubles in a file may hold more."""
    arrays = {name: np.array(value, float) for name, value in changes.items()}
    with np.errstate(all="raise"):
        assert drawable(replace(one(), **arrays)).tolist() == [expected]
