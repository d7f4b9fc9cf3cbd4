"""The published formula against numbers by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.baselines.refine import refine
from tests.core.test_closed_form import three_splats


@pytest.mark.parametrize(
    ("depth", "eta", "offset"), [("z", 0.05, 0.05), ("distance", 0.5, 1e-6)], ids=["paper", "code"]
)
def test_both_published_readings_give_the_numbers_worked_out_by_hand(depth, eta, offset):
    """On the axis depth and distance agree: d = 1, 2, 3 and H_i = (1/2) / (d^2 + eta).

    Geometry G = 1, 4, 3; colour luma^2 = 0, 1/4, 1; opacity 1/4 each.
    F_gem = (1/(1 + o) + 2/(1 + o) + 3/(1 + o)) / 3 = 2 / (1 + o); F_col = var(0, 1/2, 1) = 1/6;
    mean 4 a (1 - a) = 1. So lt = ln(2 / (1 + o) + o) / 10.73, 100 / 6 / 56.06, 100 / 100.67.
    """
    splats, views = three_splats()
    h1, h2, h3 = 0.5 / (1 + eta), 0.5 / (4 + eta), 0.5 / (9 + eta)
    lt = [math.log(2 / (1 + offset) + offset) / 10.73, 100 / 6 / 56.06, 100 / 100.67]
    gem, col, opa = (value / sum(lt) for value in lt)
    mean_gem, mean_col = (h1 + 4 * h2 + 3 * h3) / 3, (h2 / 4 + h3) / 3
    mean_opa = (h1 + h2 + h3) / 12
    expected = [
        gem * h1 / mean_gem + opa * h1 / 4 / mean_opa,
        gem * 4 * h2 / mean_gem + col * h2 / 4 / mean_col + opa * h2 / 4 / mean_opa,
        gem * 3 * h3 / mean_gem + col * h3 / mean_col + opa * h3 / 4 / mean_opa,
    ]

    np.testing.assert_allclose(refine(splats, views, depth), expected, rtol=1e-6)


def test_the_papers_ablations_leave_out_what_they_name():
    """Without all three, each term counts a third and every view the same for every splat."""
    splats, views = three_splats()
    luma = np.array([0.0, 0.25, 1.0])
    expected = (np.array([1.0, 4.0, 3.0]) / (8 / 3) + luma / luma.mean() + 1.0) / 3

    found = refine(splats, views, "z", visibility=False, projection=False, equal_weights=True)

    np.testing.assert_allclose(found, expected, rtol=1e-6)
