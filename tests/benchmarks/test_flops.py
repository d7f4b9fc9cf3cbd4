"""Counting arrays, and the count by hand against the count by running the code."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("numba")

from benchmarks.tables import flops
from benchmarks.tables.flops import ANALYTIC, READINGS, Counting
from refine_addon.core.scoring import closed_form
from refine_addon.core.splats import Splats
from refine_addon.core.views import View, ViewSet


def counted(values: object) -> int:
    """Return the count since the last time; `values` only makes the call read well."""
    del values
    total, Counting.total = Counting.total, 0
    return total


def test_arithmetic_is_counted_element_by_element() -> None:
    """A sum of 3 x 4 is 12, its total 11 more; a 2 x 3 by 3 x 4 product 8 (3 + 2) = 40."""
    a = np.ones((3, 4)).view(Counting)
    counted(None)

    assert counted(a + 1.0) == 12
    assert counted(np.sum(a)) == 11
    assert counted(np.ones((2, 3)) @ a) == 40
    assert counted(np.exp(a, out=a)) == 12
    assert counted(np.einsum("ij,ij->i", a, a)) == 2 * 12 - 3


def test_what_is_no_arithmetic_counts_nothing() -> None:
    """Copies, integers, booleans and selections are free."""
    a = np.ones((3, 4)).view(Counting)
    counted(None)

    assert counted(a[a.view(np.ndarray) > 0].copy()) == 0
    assert counted(np.arange(5).view(Counting) + 1) == 0
    assert counted(np.where(a.view(np.ndarray) > 0, a, 0.0)) == 0


@pytest.mark.parametrize(
    ("reading", "method"),
    [("default", "closed-form"), ("z", "refine-z"), ("distance", "refine-distance")],
)
def test_the_table_is_what_the_closed_form_does(reading: str, method: str) -> None:
    """32 views less 16, over 16 views and the splats; a fifth is of the boxes of runs."""
    rng = np.random.default_rng(0)
    count = 3000
    splats = Splats(
        rng.normal([0, 0, 4.0], 0.5, (count, 3)),
        rng.normal(-3, 0.4, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(0, 1, count),
        rng.normal(0, 1, (count, 3)),
        np.zeros((count, 0, 3)),
    )
    views = ViewSet(
        tuple(
            View(np.eye(3), rng.normal(0, 0.2, 3), 30.0, 30.0, 16.0, 16.0, 32, 32)
            for _ in range(32)
        )
    )
    expected = sum(term[READINGS.index(reading)] for term in ANALYTIC.values())

    few = flops.count(splats, views.take(range(16)), method)
    many = flops.count(splats, views, method)

    assert (many - few) / 16 / count == pytest.approx(expected, abs=0.3)
    assert closed_form.np is np


def test_the_table_s_terms_are_whole_numbers_of_all_readings() -> None:
    """12 for z, 11 for the distance, 35 for ours."""
    totals = [math.fsum(term[reading] for term in ANALYTIC.values()) for reading in range(3)]

    assert totals == [12, 11, 35]
