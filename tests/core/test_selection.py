"""Budgets and what they select, against a slow reference that anybody can read."""

import re
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from refine_addon.core import Budget, RefineError, Scores, rank, select
from refine_addon.core.scores import shares_gone
from tests.strategies import masks, scores


def scored(values, seen=None, views: int = 64) -> Scores:
    values = np.asarray(values, np.float32)
    seen = np.zeros(len(values), np.int32) if seen is None else np.asarray(seen, np.int32)
    return Scores(values, seen, views, 0)


def slow_keep(values, count: int, protected) -> list[bool]:
    """Remove one after the other: the lowest that may go, of equal ones the first."""
    keep = [True] * len(values)
    for _ in range(count):
        left = [i for i in range(len(values)) if keep[i] and not protected[i]]
        if left:
            keep[min(left, key=lambda i: (values[i], i))] = False
    return keep


@pytest.mark.slow
@given(values=scores(), data=st.data())
def test_the_lowest_scores_go_and_the_first_of_equal_ones(values, data):
    """As if one went after the other, with any of them protected; whole numbers are of any kind."""
    count = len(values)
    protected = data.draw(st.one_of(st.none(), masks(count)))
    stay = data.draw(st.one_of(st.integers(1, count + 3), st.just(10**400)))
    kind = data.draw(st.sampled_from([int, float, np.int64, np.float32])) if stay < 1e300 else int
    shield = np.zeros(count, np.bool_) if protected is None else protected
    keep = select(scored(values), Budget(keep=kind(stay)), protected=protected)

    assert slow_keep(values, max(count - stay, 0), shield) == keep.tolist()
    assert np.bool_ == keep.dtype


@given(values=scores(least=2), data=st.data())
def test_budgets_are_nested(values, data):
    """What survives a harsher budget survives a milder one."""
    low, high = sorted(data.draw(st.tuples(*[st.floats(0, 1, exclude_max=True)] * 2)))
    mild, harsh = (select(scored(values), Budget(ratio=ratio)) for ratio in (low, high))

    assert not (harsh & ~mild).any()


@pytest.mark.parametrize(
    ("ratio", "count", "expected"),
    [
        (0.0, 10, 0),
        (0.29, 100, 29),  # as binary floating point, .29 * 100 is 28.999999999999996
        (0.57, 100, 57),  # 56.99999999999999
        (0.1, 39755, 3975),
        (0.999999, 10, 9),
        (1e-300, 10, 0),
        (0.5, 1, 0),
    ],
)
def test_a_ratio_is_the_decimal_that_was_written(ratio, count, expected):
    """floor(ratio N) of the decimal; a ratio below 1 always leaves one."""
    assert expected == Budget(ratio=ratio).removals(count)
    assert expected == np.count_nonzero(~select(scored(np.arange(count)), Budget(ratio=ratio)))


@given(
    megabytes=st.one_of(st.floats(1e-4, 1e3), st.sampled_from([1e303, 1.7e308])),
    row=st.integers(1, 1000),
    fixed=st.integers(0, 2000),
    count=st.integers(1, 10**6),
)
def test_a_size_is_met_by_as_many_splats_as_fit(megabytes, row, fixed, count):
    """In whole numbers: fixed + kept * row <= size < fixed + (kept + 1) * row, or all stay."""
    size = Fraction(repr(megabytes)) * 10**6
    budget = Budget(max_mb=megabytes)
    if fixed + row > size:
        with pytest.raises(RefineError, match="too small for one splat"):
            budget.removals(count, row, fixed)
        return
    kept = count - budget.removals(count, row, fixed)

    assert fixed + kept * row <= size
    assert kept == count or fixed + (kept + 1) * row > size


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("name", "values", "expected"),
    [
        ("ratio", (-0.1, 1, 1.5, NAN, INF, -INF, 10**400), "expected 0 <= ratio < 1"),
        ("keep", (0, -1, 1.5, NAN, INF), "expected a whole number of at least 1"),
        ("max_mb", (0, -1, NAN, INF), "expected a positive number"),
        ("psnr", (-1, 0, 100, NAN, INF), "expected more than 0 and less than 100 dB"),
    ],
)
def test_a_budget_that_cannot_be_is_refused_with_its_name(name, values, expected):
    """Each says what it is and what was expected; it is exactly one number.

    From Python, where `select` is not told the size of a splat, one in megabytes is refused.
    """
    for value in values:
        with pytest.raises(RefineError, match=re.escape(f"{name} is {value}, {expected}")):
            Budget(**{name: value})
    with pytest.raises(RefineError, match="expected one of ratio, keep, max_mb, psnr, got"):
        Budget()
    with pytest.raises(RefineError, match=re.escape("got ['keep', 'psnr']")):
        Budget(keep=50, psnr=3)
    with pytest.raises(RefineError, match="max_mb needs to know how many bytes"):
        select(scored([1, 2]), Budget(max_mb=1.0))


@given(values=scores())
def test_the_rank_is_the_place_in_the_order_of_removal(values):
    """0 goes first, 1 last, evenly; equal scores by their place in the file."""
    order = sorted(range(len(values)), key=lambda i: (values[i], i))
    ranks = rank(values)

    assert np.float64 == ranks.dtype
    assert order == np.argsort(ranks, kind="stable").tolist()
    assert ranks.max() == 1.0
    assert (0.0 if len(values) > 1 else 1.0) == ranks.min()
    expected = np.linspace(0, 1, len(values)) if len(values) > 1 else np.ones(1)
    np.testing.assert_allclose(ranks[order], expected, atol=1e-6)


MANY = (1 << 24) + 100
"""More than float32 has equal steps between 0 and 1."""


@pytest.mark.slow
def test_ranks_of_more_splats_than_float32_can_tell_apart_are_distinct():
    """Scored in the order of the file, the rank of row k is k / (N - 1), each above the last.

    Of shares half, 2^23 + 50, go to the 2^23 numbers from 0.5 to 1: as quotients 50 would tie.
    """
    ranks = rank(np.arange(MANY, dtype=np.float32))  # neighbours tie, and go by row
    places = np.arange(1, MANY + 1)
    quotients = (places / MANY).astype(np.float32)
    shares = shares_gone(places, MANY)

    assert (np.diff(ranks) > 0.0).all()
    assert (ranks[0], ranks[-1]) == (0.0, 1.0)
    assert np.float32 == shares.dtype
    assert np.count_nonzero(np.diff(quotients) == 0.0) == 50
    assert (np.diff(shares) > 0.0).all()
    assert (shares <= quotients).all()
    assert (shares[0], shares[-1]) == (quotients[0], 1.0)
