"""Splats that go whatever they are worth: as if they had gone before, and counted as removed."""

from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import (
    Box,
    Budget,
    Cleaning,
    ClosedForm,
    Levels,
    Merge,
    Occlusion,
    RefineError,
    Refit,
    Zone,
    clean,
    lod,
    mapped,
    prune,
    prune_file,
    read_ply,
    score,
)
from refine_addon.core.mapped import on_disk
from tests.core.test_cleaning import FLOATER, cameras, joined, wall
from tests.core.test_levels import colourful, equal, file_of, merges  # noqa: F401 - a fixture

pytestmark = pytest.mark.slow

COUNT = 288
EVERY = np.arange(COUNT)
REMOVED = np.random.default_rng(3).random(COUNT) < 0.3
REST = ~REMOVED

DELETED = [
    Budget(ratio=0.5), Budget(ratio=0.1), Budget(keep=150), Budget(keep=1), Budget(max_mb=0.004),
    Budget(psnr=35.0),
]  # fmt: skip
MERGED = [Budget(ratio=0.5), Budget(keep=1), Budget(psnr=35.0)]


@pytest.fixture(scope="module")
def splats():
    return colourful().take(slice(COUNT))


@pytest.fixture(scope="module")
def views():
    return cameras()


@pytest.fixture(scope="module")
def scores(splats, views):
    return score(splats, views, removed=REMOVED)


@pytest.mark.parametrize(
    ("method", "budget"),
    [(Occlusion(), one) for one in DELETED] + [(Merge(), one) for one in MERGED],
    ids=str,
)
def test_forcing_out_is_pruning_what_is_left_by_the_rest_of_the_budget(
    merges, splats, views, budget, method
):
    """The same splats, values and estimate as when they are deleted first, by hand."""
    size, rest = {"sizes": (20.0, 0)}, budget
    if budget.ratio is not None:  # a share counts those that have gone
        rest = Budget(keep=COUNT - max(int(budget.ratio * COUNT), int(REMOVED.sum())))
    left = prune(splats.take(REST), views, rest, method, **size)

    found = prune(splats, views, budget, method, removed=REMOVED, **size)

    assert not found.keep[REMOVED].any()
    assert np.array_equal(found.keep[REST], left.keep)
    assert np.array_equal(found.scores.values[REST], left.scores.values)
    assert found.report["estimated_psnr"] == left.report["estimated_psnr"]
    assert found.report["splats"]["removed"] == COUNT - left.keep.sum()
    assert found.report["splats"]["removed_by_user"] == REMOVED.sum()
    assert found.report["budget"] == {budget.kind: getattr(budget, budget.kind)}
    if method.changes:
        assert np.array_equal(found.merged.splats.means, left.merged.splats.means)
        assert np.array_equal(found.merged.keep, found.keep)


@pytest.mark.parametrize("method", [Occlusion(), ClosedForm()])
def test_scores_of_what_is_left_decide_as_well_as_a_pruning_that_scores(splats, views, method):
    """As the panel does it: score without them, store, apply. They score 0 and no other does."""
    budget, scores = Budget(ratio=0.6), score(splats, views, method, removed=REMOVED)
    assert np.array_equal(scores.values == 0.0, REMOVED)
    expected = prune(splats, views, budget, method, removed=REMOVED)
    for given in (scores, replace(scores, ray_sample=None)):
        later = prune(None, None, budget, method, scores=given, removed=REMOVED)
        assert np.array_equal(later.keep, expected.keep)


def test_what_had_to_go_when_scored_and_need_not_now_has_no_score(scores):
    """It might be worth most: nothing tells. If more must go, scores tell of the others."""
    fewer, more = REMOVED & (EVERY > 100), REMOVED | (EVERY < 50)
    with pytest.raises(RefineError, match=r"splats were removed when the others were scored"):
        prune(None, None, Budget(ratio=0.6), Occlusion(), scores=scores, removed=fewer)
    found = prune(None, None, Budget(keep=100), Occlusion(), scores=scores, removed=more)
    assert not found.keep[more].any()
    assert found.keep.sum() == 100
    assert scores.values[found.keep].min() > scores.values[~found.keep & ~more].max()


def test_a_splat_without_a_score_is_known_by_its_row_not_by_their_number(splats, views):
    """The best splat must go, one cannot be drawn; then that one must go, or none need.

    One zero is then that of a splat that was never scored, as many as there are undrawable ones.
    """
    logits = splats.opacity_logits.copy()
    logits[5] = np.nan
    splats = replace(splats, opacity_logits=logits)
    settings = ClosedForm()
    best = np.argmax(score(splats, views, settings).values) == EVERY
    scores = score(splats, views, settings, removed=best)
    for removed in (EVERY == 5, None):
        with pytest.raises(RefineError, match=r"^1 splats were removed when the others were"):
            prune(None, None, Budget(ratio=0.5), settings, scores=scores, removed=removed)
    again = prune(None, None, Budget(ratio=0.5), settings, scores=scores, removed=best)
    assert not again.keep[best].any()


def test_nothing_left_is_refused_but_what_is_protected_is_enough(splats, views):
    every, mine = np.ones(COUNT, bool), EVERY == 200
    with pytest.raises(RefineError, match=f"all {COUNT} splats"):
        score(splats, views, removed=every)
    how = {"protected": mine, "removed": every}
    found = prune(splats, views, Budget(ratio=0.0), ClosedForm(), **how)
    assert np.array_equal(found.keep, mine)


@pytest.mark.parametrize("method", [Occlusion(), Merge()], ids=["delete", "merge"])
def test_levels_hold_nothing_of_it_and_are_those_of_the_rest(merges, splats, views, method):
    """Half of 288 stays in the first, of the others; as when the others are the scene.

    Where all that must go is protected nothing must, and each is made from the one before.
    """
    shares = (143.5 / REST.sum(), 28.5 / REST.sum())  # rounded up
    expected = list(lod(splats.take(REST), views, Levels(shares), method))
    found = list(lod(splats, views, Levels((0.5, 0.1)), method, removed=REMOVED))
    spared = lod(splats, views, Levels((0.5, 0.4)), method, protected=REMOVED, removed=REMOVED)
    for one, other in zip(found, expected, strict=True):
        assert np.array_equal(one.result.keep[REST], other.result.keep)
        assert not one.result.keep[REMOVED].any()
        assert np.array_equal(one.result.splats.means, other.result.splats.means)
        assert one.psnr == other.psnr
    assert [level.result.keep.sum() for level in found] == [144, 29]
    assert [level.result.keep[REMOVED].all() for level in spared] == [True, True]


def test_cleaning_takes_what_must_go_as_gone():
    """The wall before the floater is no surface then: of what no view sees past, nothing floats."""
    splats = joined(wall(), FLOATER)
    walls = np.arange(len(splats)) < len(splats) - 1
    some = np.arange(len(splats)) < 5
    found = clean(splats, cameras(), removed=some)
    expected = clean(splats.take(~some), cameras())
    alone = clean(splats, cameras(), removed=walls)
    assert not found.keep[:5].any()
    assert np.array_equal(found.keep[5:], expected.keep)
    assert found.counts() == expected.counts()
    assert alone.counts()["front"] == 0


def test_a_file_is_cleaned_and_pruned_by_volumes_as_by_masks(splats, views, tmp_path):
    """What must go is no evidence of what floats; the share is one of what is left of both."""
    path, budget = file_of(joined(splats, FLOATER), tmp_path / "in.ply"), Budget(ratio=0.8)
    zones = (
        Zone("protect", "edge", Box((-9, -9, -9), (-2, 9, 9))),
        Zone("remove", "lower", Box((-9, -9, -9), (9, -1, 9))),
    )
    loaded = read_ply(path).splats()
    x, y, _ = loaded.means.T
    stay, go = x < -2, (y < -1) & (x >= -2)

    found = prune_file(path, tmp_path / "out.ply", views, budget, zones=zones, cleaning=Cleaning())

    left = clean(loaded, views, protected=stay, removed=go).keep | go
    rest = prune(loaded.take(left), views, budget, protected=stay[left], removed=go[left])
    assert np.flatnonzero(~left).tolist() == [COUNT]
    assert np.array_equal(found.keep[left], rest.keep)
    assert not found.keep[COUNT]


@pytest.mark.parametrize("method", [Merge(), Refit(rounds=1)], ids=["merge", "refit"])
@pytest.mark.parametrize("region", [None, 80], ids=["in memory", "by regions of files"])
def test_protected_splats_keep_every_bit(
    merges, splats, views, tmp_path, monkeypatch, method, region
):
    """They fill regions, and lie among the others, of which most go: as many as are asked for."""
    stored, x = splats, splats.means[:, 0]
    mine = (x < np.quantile(x, 0.5)) | (EVERY % 6 == 0)
    if region:
        monkeypatch.setattr(mapped, "REGION", region)
        stored = on_disk(tmp_path / "job/splats", [splats])
    found = prune(stored, views, Budget(ratio=0.3), method, protected=mine)
    kept, same = found.splats, mine[found.keep]
    assert np.count_nonzero(found.keep) == COUNT - int(0.3 * COUNT)
    assert found.merged.changed.any()
    assert found.keep[mine].all()
    assert equal(kept.take(same), splats.take(mine))
