"""As many views as the pictures need: what auto measures, estimates and reports."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from refine_addon.core import (
    Budget,
    Occlusion,
    RefineError,
    Scores,
    Settings,
    View,
    ViewSet,
    prune,
    read_cameras,
    read_ply,
    score,
    select,
)
from refine_addon.core.costs import Images
from refine_addon.core.quality.psnr import psnr_kept
from refine_addon.core.scoring import auto, occlusion
from refine_addon.core.visibility.ray_sample import validation_rays

ROOM = Path(__file__).parents[1] / "data/room_small"
COARSE = Occlusion(cell=16.0, density=1.0, rounds=2)


@pytest.fixture(scope="module")
def scene():
    """Every eighth splat of the room, and 16 of its cameras."""
    splats = read_ply(ROOM / "point_cloud.ply").splats()
    views = read_cameras(ROOM / "cameras.json").take(range(0, 64, 4))
    return splats.take(slice(None, None, 8)), views


@pytest.mark.slow
def test_pictures_lose_no_more_than_the_tolerance():
    """On the committed room: compared on the rays of the views that `split.json` holds out.

    All of 63 views against those that auto chooses, fewer at either tolerance.
    """
    splats = read_ply(ROOM / "point_cloud.ply").splats()
    views = read_cameras(ROOM / "cameras.json")
    held = json.loads((ROOM / "split.json").read_text())["test"]
    train = views.take([k for k, view in enumerate(views) if view.name not in held])
    unseen = validation_rays(splats, views.take(
        [k for k, view in enumerate(views) if view.name in held]))  # fmt: skip
    full = score(splats, train, Settings("occlusion"))

    for tolerance in (0.5, 3.0):
        scores = score(splats, train, Settings(tolerance=tolerance))

        assert scores.views_used < len(train)
        for ratio in auto.RATIOS:
            best, found = (
                psnr_kept(unseen, select(some, Budget(ratio=ratio))) for some in (full, scores)
            )
            assert found > best - tolerance


@pytest.mark.slow
def test_where_nothing_may_be_lost_all_views_measure(scene):
    """Also where the validation views expect no gain."""
    scores = auto.score(*scene, 0.0, COARSE)

    assert scores.views_used == 16
    assert scores.facts["auto"]["loss"] == 0.0


def test_where_all_may_be_lost_five_of_eight_groups_measure(scene):
    """Half of 16 views, and two more; the splats count only the views used."""
    scores = auto.score(*scene, 1e9, COARSE)

    assert scores.views_used == 10
    assert scores.seen.max() <= 10
    assert scores.facts["auto"]["views"] == 10


@pytest.mark.slow
def test_the_report_says_what_was_expected_and_chosen(scene):
    """How many of the views measured, what that may lose, and what the validation views told."""
    settings = Settings(occlusion=COARSE, tolerance=30.0)

    report = prune(*scene, Budget(ratio=0.5), settings, survivors="unchanged").report

    facts = json.loads(json.dumps(report, allow_nan=False))["weights"]["auto"]
    assert set(facts) == {"views", "given", "loss", "tolerance", "expected", "saved"}
    assert facts["given"] == 16
    assert facts["saved"] < 0.375  # 6 of 16 views, less what finding out takes
    assert list(facts["expected"]) == ["8 views", "10 views"]
    assert report["views"] == {"given": 16, "used": 10}
    assert 0.0 <= facts["loss"] <= facts["tolerance"] == 30.0


def ring(count: int) -> ViewSet:
    """Return views in a line, named by their place."""
    view = View(np.eye(3), np.zeros(3), 50.0, 50.0, 50.0, 50.0, 100, 100)
    places = [np.array([x, 0.0, 0.0]) for x in range(count)]
    return ViewSet(
        tuple(replace(view, center=place, name=f"{k:03}") for k, place in enumerate(places))
    )


def test_the_first_groups_are_half_of_the_views_spread_evenly():
    """Of 64 in a line every gap is 1 or 2, at the ends as well; each view is in one group."""
    views = ring(64)
    order = [view for view, _ in views.by_distance()]
    groups = auto.groups_of(views)

    assert [len(group) for group in groups] == [8] * 8
    assert sorted(number for group in groups for number in group) == list(range(64))
    half = sorted(order[number].center[0] for group in groups[:4] for number in group)
    assert max(np.diff(half)) <= 3
    assert half[0] <= 2
    assert half[-1] >= 61


def test_a_view_given_many_times_is_in_one_group_each_time():
    """All 16 the same: half of them are in the first four groups."""
    groups = auto.groups_of(ViewSet((ring(1).views[0],) * 16))

    assert [len(group) for group in groups] == [2] * 8
    assert sorted(number for group in groups for number in group) == list(range(16))


@pytest.mark.slow
def test_few_views_all_measure(scene):
    """Of 15 too few would be left to validate: the scores are those of occlusion to the bit."""
    splats, views = scene
    few = views.take(range(15))

    scores = auto.score(splats, few, 1e9, COARSE)

    assert auto.groups_of(few) is None
    expected = occlusion.score(splats, few, COARSE)
    np.testing.assert_array_equal(scores.values, expected.values)
    assert scores.method == "auto"


@pytest.fixture(scope="module")
def few(scene):
    """Every tenth splat of the scene, where it does not matter how good the pictures are."""
    return scene[0].take(slice(None, None, 10)), scene[1]


class Told:
    """Validation views that say what they are told: the PSNR after each number of views, dB."""

    def __init__(self, monkeypatch, *psnr) -> None:
        """Take the place of the validation views."""
        told = None if None in psnr else np.array(psnr, float)
        monkeypatch.setattr(auto, "psnr_by_views", lambda *_, **__: told)


@pytest.mark.parametrize(
    ("psnr_of_few", "psnr_of_more", "tolerance", "used"),
    [
        # 1/8 and 1/10 differ by .025, 1/10 and 1/16 by .0375: what is to come is 1.5 times the gain
        ([40.0, 30.0, 20.0, 10.0], [40.0, 30.2, 20.1, 9.0], 0.31, 10),
        ([40.0, 30.0, 20.0, 10.0], [40.0, 30.2, 20.1, 9.0], 0.29, 16),
        # no eye tells 61 dB from 70
        ([61.0, 30.0, 20.0, 10.0], [70.0, 30.0, 20.0, 10.0], 0.01, 10),
        # but 59 from 60
        ([59.0, 30.0, 20.0, 10.0], [70.0, 30.0, 20.0, 10.0], 1.4, 16),
        ([59.0, 30.0, 20.0, 10.0], [70.0, 30.0, 20.0, 10.0], 1.6, 10),
    ],
)
def test_what_an_eighth_gained_tells_what_the_rest_would(
    monkeypatch, few, psnr_of_few, psnr_of_more, tolerance, used
):
    """The largest gain over the shares counts."""
    Told(monkeypatch, psnr_of_few, psnr_of_more)

    assert auto.score(*few, tolerance, COARSE).views_used == used


def test_validation_views_that_see_too_little_leave_it_to_all_views(monkeypatch, few):
    """Whatever may be lost."""
    Told(monkeypatch, None)

    assert auto.score(*few, 1e9, COARSE).views_used == 16


def test_rankings_are_compared_by_views_that_did_not_measure(monkeypatch, few):
    """Two groups of eight validate what five measured; their rays are cast before."""
    compared = []

    def note(sample, rankings, shares, views, **_):
        compared.append(views)
        assert shares == auto.RATIOS
        assert all(sample.rays[number] is not None for number in views)
        return np.array([[30.0] * 4] * len(rankings))

    monkeypatch.setattr(auto, "psnr_by_views", note)

    auto.score(*few, 1.0, COARSE)

    groups = auto.groups_of(few[1])
    assert compared == [groups[5] + groups[6]]


def test_what_was_saved_is_the_views_left_out_less_what_finding_out_took():
    """Of a million splats, 64 views: 24 less save a seventh; where all are needed, a tenth is lost.

    Measuring is about two thirds of scoring, so 24 of 64 views are 25 % of it.
    """
    stays = occlusion.survivors_of_rounds(1_000_000, 8, 500_000)

    assert auto.saved(1_000_000, Images(64, 150_000.0), 40, stays) == pytest.approx(0.15, abs=0.03)
    assert auto.saved(1_000_000, Images(64, 150_000.0), 64, stays) == pytest.approx(-0.1, abs=0.02)


def test_a_threshold_is_refused(scene):
    """It was of the closed form's errors when that was the default; occlusion's are shares."""
    with pytest.raises(RefineError, match="a threshold means something else to each method"):
        prune(*scene, Budget(threshold=0.5))


@pytest.mark.parametrize("tolerance", [-0.1, float("inf"), float("nan")])
def test_a_tolerance_is_a_number_of_decibels(tolerance):
    """0 or more."""
    with pytest.raises(RefineError, match="tolerance is"):
        Settings(tolerance=tolerance)


@pytest.mark.slow
def test_progress_never_goes_back(scene):
    """However many views measure."""
    for tolerance in (0.0, 1e9):
        told = []

        score(*scene, Settings(occlusion=COARSE, tolerance=tolerance),
              progress=lambda fraction, _what, told=told: told.append(fraction))  # fmt: skip

        assert told == sorted(told)
        assert 0.0 <= told[0] <= told[-1] <= 1.0


@pytest.mark.slow
def test_scores_depend_on_no_order_of_views(scene):
    """Backwards: the same views measure first, and the same validate."""
    splats, views = scene
    backwards = views.take(range(15, -1, -1))

    here, there = (auto.score(splats, some, 0.5, COARSE) for some in (views, backwards))

    assert here.facts["auto"]["expected"] == there.facts["auto"]["expected"]
    np.testing.assert_array_equal(here.values, there.values)
    assert isinstance(here, Scores)
