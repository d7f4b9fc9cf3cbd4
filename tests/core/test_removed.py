"""Splats that go whatever they are worth: as if they had gone before, and counted as removed."""

from __future__ import annotations

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
    Zone,
    clean,
    lod,
    lod_file,
    prune,
    prune_file,
    read_ply,
    score,
)
from refine_addon.core.volumes import forced as forced_by
from tests.core.test_cleaning import FLOATER, cameras, joined, wall
from tests.core.test_levels import cameras as level_cameras
from tests.core.test_levels import (
    colourful,
    merges,  # noqa: F401 - a fixture
)
from tests.strategies import ply_of

pytestmark = pytest.mark.slow

COUNT = 576

BUDGETS = [
    Budget(ratio=0.5), Budget(ratio=0.1), Budget(keep=300), Budget(keep=1), Budget(max_mb=0.008),
    Budget(threshold=0.4), Budget(min_seen=40.0), Budget(psnr=35.0),
]  # fmt: skip


WAYS = pytest.mark.parametrize("method", [Occlusion(), Merge()], ids=["delete", "merge"])


@pytest.fixture(scope="module")
def splats():
    """Make a wall of 576 splats in many colours."""
    return colourful()


@pytest.fixture(scope="module")
def views():
    return level_cameras()


@pytest.fixture(scope="module")
def removed():
    """Choose a quarter of them, and more."""
    return np.random.default_rng(3).random(COUNT) < 0.3


def rest_budget(budget, gone):
    """Return what is left to a budget of 576 splats when some have gone."""
    if budget.ratio is None:
        return budget
    return Budget(keep=COUNT - max(int(budget.ratio * COUNT), gone))


@WAYS
@pytest.mark.parametrize("budget", BUDGETS, ids=lambda budget: f"{budget}")
def test_forcing_out_is_pruning_what_is_left_by_the_rest_of_the_budget(
    merges, splats, views, removed, budget, method
):
    """The same splats, values and estimate as when they are deleted first, by hand."""
    rest, size = ~removed, {"sizes": (20.0, 0)}
    left = prune(
        splats.take(rest), views, rest_budget(budget, int(removed.sum())), method, **size
    )  # fmt: skip

    found = prune(splats, views, budget, method, removed=removed, **size)

    assert not found.keep[removed].any()
    assert np.array_equal(found.keep[rest], left.keep)
    assert np.array_equal(found.scores.values[rest], left.scores.values)
    assert found.report["estimated_psnr"] == left.report["estimated_psnr"]
    assert found.report["splats"]["removed"] == COUNT - left.keep.sum()
    assert found.report["splats"]["removed_by_user"] == removed.sum()
    assert found.report["budget"] == {budget.kind: getattr(budget, budget.kind)}
    if method.changes:
        assert np.array_equal(found.merged.splats.means, left.merged.splats.means)
        assert np.array_equal(found.merged.keep, found.keep)


def test_a_share_counts_what_had_to_go(splats, views, removed):
    """Half of 576 is 288, of which what must go is a part; a tenth of them is less."""
    half = prune(splats, views, Budget(ratio=0.5), removed=removed).report["splats"]
    tenth = prune(splats, views, Budget(ratio=0.1), removed=removed).report["splats"]

    assert half["removed"] == 288
    assert tenth["removed"] == tenth["removed_by_user"] == removed.sum() > 57


def test_protection_wins_over_force(splats, views):
    """The first hundred must go, the first ten stay: ninety must go."""
    rows = np.arange(COUNT)

    found = prune(
        splats,
        views,
        Budget(ratio=0.9),
        protected=rows < 10,
        removed=rows < 100,
        method=Merge(),
    )

    assert found.keep[:10].all()
    assert not found.keep[10:100].any()
    assert not found.merged.changed[:10].any()
    assert (found.report["splats"]["protected"], found.report["splats"]["removed_by_user"]) == (
        10,
        90,
    )


@pytest.mark.parametrize("method", [Occlusion(), ClosedForm()])
def test_scores_of_what_is_left_decide_as_well_as_a_pruning_that_scores(
    splats, views, removed, method
):
    """As the panel does it: score without them, store, apply. They score 0 and no other does."""
    budget, scores = Budget(ratio=0.6), score(splats, views, method, removed=removed)

    assert np.array_equal(scores.values == 0.0, removed)
    expected = prune(splats, views, budget, method, removed=removed)
    for given in (scores, replace(scores, ray_sample=None)):
        later = prune(None, None, budget, method, scores=given, removed=removed)
        assert np.array_equal(later.keep, expected.keep)


def test_the_curve_has_protected_splats_last_though_others_must_go(splats, views, removed):
    """As where these have gone before; without protection it is another curve."""
    settings, rest = Occlusion(), ~removed
    protected = rest & (np.arange(COUNT) % 2 == 0)

    found, free = (
        score(splats, views, settings, removed=removed, protected=stays).quality.psnr
        for stays in (protected, None)
    )

    left = score(splats.take(rest), views, settings, protected=protected[rest])
    np.testing.assert_array_equal(found, left.quality.psnr)
    assert not np.array_equal(found, free)


def test_what_had_to_go_when_scored_and_need_not_now_has_no_score(splats, views, removed):
    """It might be worth most: nothing tells."""
    scores = score(splats, views, removed=removed)
    fewer = removed & (np.arange(COUNT) > 100)

    with pytest.raises(RefineError, match=r"splats had to go when the others were scored"):
        prune(None, None, Budget(ratio=0.6), Occlusion(), scores=scores, removed=fewer)


@pytest.mark.parametrize("now", ["another", "none"])
def test_a_splat_without_a_score_is_known_by_its_row_not_by_their_number(splats, views, now):
    """The best splat must go, one cannot be drawn; then that one must go, or none need.

    One zero is then that of a splat that was never scored, as many as there are undrawable ones.
    """
    logits = splats.opacity_logits.copy()
    logits[5] = np.nan
    splats = replace(splats, opacity_logits=logits)
    settings = ClosedForm()
    best = int(np.argmax(score(splats, views, settings).values))
    every = np.arange(COUNT)
    scores = score(splats, views, settings, removed=every == best)
    removed = every == 5 if now == "another" else None

    with pytest.raises(RefineError, match=r"^1 splats had to go when the others were scored"):
        prune(None, None, Budget(ratio=0.5), settings, scores=scores, removed=removed)

    again = prune(None, None, Budget(ratio=0.5), settings, scores=scores, removed=every == best)
    assert not again.keep[best]


def test_more_than_had_to_go_when_scored_goes_by_the_scores_there_are(splats, views, removed):
    """The others are ranked as they were."""
    scores = score(splats, views, removed=removed)
    more = removed | (np.arange(COUNT) < 50)

    found = prune(None, None, Budget(keep=200), Occlusion(), scores=scores, removed=more)

    assert not found.keep[more].any()
    assert found.keep.sum() == 200
    assert scores.values[found.keep].min() > scores.values[~found.keep & ~more].max()


def test_nothing_left_is_refused(splats, views):
    """In one sentence, before any work."""
    with pytest.raises(RefineError, match="all 576 splats lie where they must go"):
        prune(splats, views, Budget(ratio=0.5), removed=np.ones(COUNT, bool))
    with pytest.raises(RefineError, match="all 576 splats"):
        score(splats, views, removed=np.ones(COUNT, bool))


def test_all_but_what_is_protected_may_go(splats, views):
    """One stays, and more is not asked for."""
    mine = np.arange(COUNT) == 300

    found = prune(
        splats, views, Budget(ratio=0.0), ClosedForm(),
        protected=mine, removed=np.ones(COUNT, bool),
    )  # fmt: skip

    assert np.array_equal(found.keep, mine)


@WAYS
def test_levels_hold_nothing_of_it_and_are_those_of_the_rest(
    merges, splats, views, removed, method
):
    """Half of 576 stays in the first, of the others; as when the others are the scene."""
    rest = ~removed
    shares = (287.5 / rest.sum(), 57.5 / rest.sum())  # rounded up
    expected = list(lod(splats.take(rest), views, Levels(shares), method))

    found = list(lod(splats, views, Levels((0.5, 0.1)), method, removed=removed))

    for one, other in zip(found, expected, strict=True):
        assert np.array_equal(one.result.keep[rest], other.result.keep)
        assert not one.result.keep[removed].any()
        assert np.array_equal(one.result.splats.means, other.result.splats.means)
        assert one.psnr == other.psnr
    assert [level.result.keep.sum() for level in found] == [288, 58]


@WAYS
def test_levels_where_all_that_had_to_go_is_protected(splats, views, removed, method):
    """Nothing must go then, and each level is made from the one before."""
    levels = list(
        lod(splats, views, Levels((0.5, 0.3)), method, protected=removed, removed=removed)
    )

    assert len(levels) == 2
    assert all(level.result.keep[removed].all() for level in levels)


def test_cleaning_takes_what_must_go_as_gone():
    """The wall before the floater is no surface then: of what no view sees past, nothing floats."""
    splats = joined(wall(), FLOATER)
    walls = np.arange(len(splats)) < len(splats) - 1
    half = walls & (splats.means[:, 0] > 100.0)
    half[:5] = True

    found = clean(splats, cameras(), removed=half)
    expected = clean(splats.take(~half), cameras())
    alone = clean(splats, cameras(), Cleaning(), removed=walls)

    assert not found.keep[:5].any()
    assert np.array_equal(found.keep[5:], expected.keep)
    assert found.counts() == expected.counts()
    assert alone.counts()["front"] == 0


def scene(splats, path):
    """Write splats to a file."""
    columns = {f"f_dc_{k}": splats.sh_dc[:, k] for k in range(3)}
    columns |= dict(zip("xyz", splats.means.T, strict=True))
    columns |= {f"scale_{k}": splats.log_scales[:, k] for k in range(3)}
    columns |= {f"rot_{k}": splats.quaternions[:, k] for k in range(4)}
    columns["opacity"] = splats.opacity_logits
    path.write_bytes(ply_of(columns))
    return path


ZONES = (
    Zone("keep", "box", Box((-9, -9, -9), (1, 9, 9))),
    Zone("protect", "edge", Box((-9, -9, -9), (-2, 9, 9))),
    Zone("remove", "lower", Box((-9, -9, -9), (9, -1, 9))),
)


@pytest.mark.parametrize("cleaning", [None, Cleaning()], ids=["whole", "cleaned"])
def test_a_file_is_pruned_by_volumes_as_by_masks(splats, views, tmp_path, cleaning):
    """The report names the volumes and how many each holds."""
    path = scene(splats, tmp_path / "in.ply")
    loaded = read_ply(path).splats()
    masks = forced_by(ZONES, loaded.means)
    budget = Budget(ratio=0.8)

    found = prune_file(path, tmp_path / "out.ply", views, budget, zones=ZONES, cleaning=cleaning)

    x, y = loaded.means[:, 0], loaded.means[:, 1]
    protected, removed = x < -2, ((x >= 1) | (y < -1)) & (x >= -2)
    assert np.array_equal(masks.protected, protected)
    assert np.array_equal(masks.removed, removed)
    if cleaning is None:
        expected = prune(loaded, views, budget, protected=protected, removed=removed)
        assert np.array_equal(found.keep, expected.keep)
    assert found.keep[protected].all()
    assert not found.keep[removed].any()
    assert found.report["volumes"] == [
        {"role": "keep", "name": "box", "splats": int((x < 1).sum())},
        {"role": "protect", "name": "edge", "splats": int(protected.sum())},
        {"role": "remove", "name": "lower", "splats": int((y < -1).sum())},
    ]
    assert len(read_ply(tmp_path / "out.ply")) == found.keep.sum()


def test_levels_of_a_file_go_by_volumes(splats, views, tmp_path):
    """No level holds what must go, and each holds what is protected."""
    path = scene(splats, tmp_path / "in.ply")

    told = lod_file(path, tmp_path / "out", views, Levels((0.5, 0.4)), zones=ZONES)

    x = splats.means[:, 0].astype(np.float32)
    for entry in told["levels"]:
        level = read_ply(tmp_path / "out" / entry["file"]).splats()
        assert (level.means[:, 0] < 1.0).all()
        assert (level.means[:, 0] < -2.0).sum() >= (x < -2.0).sum()
    assert [fact["role"] for fact in told["volumes"]] == ["keep", "protect", "remove"]
