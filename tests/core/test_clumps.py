"""Clumps of solid suspects that go as one if groups of views agree."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from refine_addon.core.cleaning.clean import _clumps
from refine_addon.core.cleaning.search import VIEW_PARTS, Found, small_clusters
from refine_addon.core.cleaning.support import Evidence
from refine_addon.core.execute import silent
from refine_addon.core.visibility import projection

from .test_cleaning import SIDE, cameras, joined, made, wall
from .test_cleaning_reasons import clump


def judged(count, past=8.0, near=0.0, past_by=2.0, parted=(), denied=()):
    """Return whether each splat of a chain goes; each group has two views.

    A clump needs 125 x 4/255 of evidence, 1.96: .1 of a pixel's change by 9^1.5 is 2.7, by 6^1.5
    1.47. The chain is parted before some splats, and one group sees past none of those denied.
    """
    ones, no = np.ones(count), np.zeros(count, np.bool_)
    by_part = np.full((2, VIEW_PARTS, count), 2.0, np.float32)
    by_part[1, 1] = past_by
    by_part[1, 3, list(denied)] = 0.0
    evidence = Evidence(near * ones, (1.0 - near) * ones, 0.0 * ones, 8.0 * ones, past * ones)
    found = Found(~no, no, no, no, ~no, 8.0 * ones, 0.0 * ones, evidence, by_part)
    chain = np.arange(count)
    near, touch = np.minimum(chain + 1, count - 1)[:, None], ~np.isin(chain + 1, parted)[:, None]
    gaussians = SimpleNamespace(alphas=0.5 * ones)
    return _clumps(gaussians, found, 0.1 * ones, chain, near, touch)


def test_ten_splats_that_touch_go_together():
    """All groups see past them, for 9^1.5 x .1 = 2.7 of evidence."""
    assert judged(10).all()


@pytest.mark.parametrize(
    "spared",
    [{"count": 9}, {"count": 10, "past": 5.0}, {"count": 10, "near": 0.11}],
    ids=["few splats", "little evidence", "light stops near"],
)
def test_what_does_not_go_as_a_clump_is_judged_splat_by_splat(spared):
    """Nine splats are no clump, 6^1.5 x .1 is less than 2, and .1 of the light may stop near."""
    assert not judged(**spared).any()


@pytest.mark.parametrize(("past_by", "goes"), [(1.41, True), (1.39, False)])
def test_every_group_of_views_has_to_agree(past_by, goes):
    """Of two views each, .7 have to see past: 1.4. The three other groups see past it all."""
    assert judged(10, past_by=past_by).tolist() == [goes] * 10


def test_clumps_apart_are_judged_apart():
    """Ten splats that no group denies go; ten beside them that one denies do not."""
    goes = judged(20, parted=(10,), denied=range(10, 20))

    np.testing.assert_array_equal(goes, np.arange(20) < 10)


def test_faint_splats_do_not_make_a_clump_one_with_the_wall():
    """Splats of opacity .2 lead from it to the wall: among those of .3 or more it is alone."""
    depth = np.arange(2.3, 4.01, 0.1)
    haze = made(np.stack([0 * depth, 0 * depth, depth], axis=1), 0.06, 0.2, 0.1)
    gaussians, _, _ = projection.prepare(joined(wall(), haze, clump()), cameras())

    small = small_clusters(gaussians, np.ones(len(gaussians), np.bool_), silent, 1)

    np.testing.assert_array_equal(small, gaussians.index >= SIDE**2 + len(depth))
