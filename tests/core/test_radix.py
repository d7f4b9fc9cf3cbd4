"""The exact k-th of many numbers, against sorting them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from refine_addon.core import radix

ODD = [0.0, -0.0, 1.0, 1.0, -1.0, 1e-45, -1e-45, 3e38, np.inf, -np.inf, np.nan, 0.1, 0.1]
WIDTHS = st.sampled_from([32, 64])


def floats(width):
    """Draw floats of a width, with many that are equal."""
    some = st.floats(width=width) | st.sampled_from(ODD).map(np.dtype(f"f{width // 8}").type)
    return st.lists(some, min_size=1, max_size=40).map(
        lambda values: np.array(values, f"f{width // 8}")
    )


@given(WIDTHS.flatmap(floats))
def test_keys_are_in_the_order_of_sorted_floats(values):
    """NumPy sorts NaN behind infinity; 0 and -0 are equal, and so are all NaN."""
    order = np.argsort(radix.keys_of(values), kind="stable")

    np.testing.assert_array_equal(values[order], np.sort(values))


@given(WIDTHS.flatmap(floats), st.integers(1, 6))
def test_the_kth_of_parts_is_that_of_the_whole(values, parts):
    """Counts of the parts are added up, as machines would; below it are those that are smaller."""
    pieces = np.array_split(radix.keys_of(values), parts)
    keys = np.sort(np.concatenate(pieces))

    def count(prefixes, shift):
        return radix.added(
            radix.Sparse.of(radix.counts(piece, prefixes, shift)) for piece in pieces
        )

    found = radix.find(count, 8 * values.dtype.itemsize, range(len(values)))

    assert [key for key, _ in found] == keys.tolist()
    assert [below for _, below in found] == np.searchsorted(keys, keys).tolist()


@given(WIDTHS.flatmap(floats))
def test_a_key_leads_back_to_its_float(values):
    """A NaN is a NaN, whatever its bits were."""
    back = [radix.value_of(int(key), values.dtype) for key in radix.keys_of(values)]

    np.testing.assert_array_equal(np.array(back, values.dtype), values)


@given(st.lists(st.floats(0.0, 1e300), min_size=1, max_size=30))
def test_the_median_is_that_of_numpy(values):
    """Of an even number, the middle between two."""
    keys = radix.keys_of(np.array(values))

    found = radix.median(
        lambda prefixes, shift: radix.counts(keys, prefixes, shift), np.dtype("f8"), len(values)
    )

    assert found == np.median(values)


@pytest.mark.parametrize(("rank", "key"), [(0, 3), (9, 3), (10, 7), (11, 7), (12, 9)])
def test_a_number_with_a_weight_takes_up_as_many_places(rank, key):
    """Ten times 3, twice 7, once 9."""
    keys, weights = np.array([9, 3, 7], np.uint32), np.array([1, 10, 2])

    def count(prefixes, shift):
        return radix.counts(keys, prefixes, shift, weights)

    assert radix.find(count, 32, [rank])[0][0] == key
