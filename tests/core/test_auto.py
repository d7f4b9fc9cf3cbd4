"""The cheapest model that agrees: what it picks, estimates and reports."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from refine_addon.core import (
    Budget,
    ClosedForm,
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
)
from refine_addon.core.scoring import auto, occlusion

ROOM = Path(__file__).parents[1] / "data/room_small"
CHEAP = (ClosedForm(), Occlusion(cell=16.0, density=1.0, rounds=3))


@pytest.fixture(scope="module")
def scene():
    """Every eighth splat of the room, and 16 of its cameras."""
    splats = read_ply(ROOM / "point_cloud.ply").splats()
    views = read_cameras(ROOM / "cameras.json").take(range(0, 64, 4))
    return splats.take(slice(None, None, 8)), views


def scores_of(values) -> Scores:
    values = np.array(values, np.float32)
    return Scores(values, np.ones(len(values), np.int32), 1, 0)


def test_disagreement_is_the_share_of_the_kept_set_that_changes():
    """Of ten, 30 % removed keeps seven: {3..9} or {0, 1, 2, 6..9} share four, so 3/7 change.

    At 50 % {5..9} and {2, 6..9} share four of five, at 70 % {7, 8, 9} are the same: 3/7 is worst.
    """
    one = scores_of(range(10))
    other = scores_of([3.1, 3.2, 5.5, 0, 1, 2, 6, 7, 8, 9])

    assert auto.disagreement(one, other) == pytest.approx(3 / 7)
    assert auto.disagreement(one, one) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("tolerance", [0.0, 0.15, 0.3, 1.0])
def test_the_kept_set_differs_from_the_full_models_by_no_more_than_the_tolerance(scene, tolerance):
    """The full model is occlusion in rounds with all views."""
    full = occlusion.score(*scene, CHEAP[1])

    scores = auto.score(*scene, tolerance, CHEAP)

    assert auto.disagreement(full, scores) <= tolerance
    assert scores.facts["auto"]["estimate"] <= tolerance


@pytest.mark.slow
def test_on_the_whole_committed_scene_auto_keeps_its_tolerance_too():
    """All splats and cameras, the full model as it is by default."""
    splats = read_ply(ROOM / "point_cloud.ply").splats()
    views = read_cameras(ROOM / "cameras.json")
    full = score(splats, views, Settings("occlusion", views=0))

    for tolerance in (0.05, 0.2):
        scores = score(splats, views, Settings("auto", views=0, tolerance=tolerance))
        assert auto.disagreement(full, scores) <= tolerance


@pytest.mark.slow
def test_no_tolerance_is_the_full_model_to_the_bit(scene):
    """Nothing cheaper agrees wholly, so that runs."""
    expected = occlusion.score(*scene, CHEAP[1]).values

    np.testing.assert_array_equal(auto.score(*scene, 0.0, CHEAP).values, expected)


def test_where_all_may_differ_the_cheapest_model_is_taken(scene):
    """A kept set may differ altogether."""
    facts = auto.score(*scene, 1.0, CHEAP).facts["auto"]

    assert facts["model"] == "closed form without frustum test"


def test_the_report_says_what_was_tried_chosen_and_why(scene):
    """As JSON for programs, and as a sentence for people."""
    settings = Settings("auto", occlusion=CHEAP[1], tolerance=0.3)

    report = prune(*scene, Budget(ratio=0.5), settings).report

    facts = json.loads(json.dumps(report, allow_nan=False))["weights"]["auto"]
    assert set(facts) == {"model", "views", "estimate", "tolerance", "tried"}
    assert any("estimated to keep" in note and facts["model"] in note for note in report["notes"])


class Told:
    """Both scoring methods, as told: rankings of 1,000 splats by model and number of views.

    Of a ranking with k swaps, k splats of the kept tenth are others: the share k / 100.
    """

    def __init__(self, monkeypatch, **swaps) -> None:
        """Take the place of the methods; `swaps` says how many, a number or one by views."""
        self.swaps = {"open": 50, "closed": 50, "once": 50, "full": 0} | swaps
        monkeypatch.setattr(auto.closed_form, "score", self.closed_form)
        monkeypatch.setattr(auto.occlusion, "score", self.occlusion)

    def closed_form(self, _splats, views, settings, **_):
        """Stand for the closed form."""
        return self.ranking("closed" if settings.frustum else "open", views)

    def occlusion(self, _splats, views, settings, **_):
        """Stand for occlusion."""
        return self.ranking("once" if settings.rounds == 1 else "full", views)

    def ranking(self, model, views):
        """Return the ranking of a model."""
        swaps = self.swaps[model]
        swaps = swaps.get(len(views), 0) if isinstance(swaps, dict) else swaps
        values = np.arange(1000)
        low, high = 899 - np.arange(swaps), 900 + np.arange(swaps)
        values[low], values[high] = values[high], values[low].copy()
        return Scores(values.astype(np.float32), np.ones(1000, np.int32), len(views), 0)

    def chosen(self, tolerance, count=64):
        """Return what auto reports, of `count` views."""
        view = View(np.eye(3), np.zeros(3), 50.0, 50.0, 50.0, 50.0, 100, 100)
        views = ViewSet(tuple(replace(view, center=np.array([x, 0.0, 0.0])) for x in range(count)))
        scores = auto.score(None, views, tolerance, CHEAP)
        return scores.facts["auto"]


NAMES = ["closed form without frustum test", "closed form", "occlusion measured once", "occlusion"]


@pytest.mark.parametrize("agreeing", range(4))
def test_the_cheapest_model_that_agrees_is_taken(monkeypatch, agreeing):
    """Whatever dearer ones agree as well."""
    swaps = dict.fromkeys(["open", "closed", "once", "full"][agreeing:], 0)

    facts = Told(monkeypatch, **swaps).chosen(0.1)

    assert facts["model"] == NAMES[agreeing]
    assert list(facts["tried"])[: min(agreeing + 1, 3)] == NAMES[: min(agreeing + 1, 3)]


@pytest.mark.parametrize(("swaps", "model"), [(2, NAMES[2]), (3, NAMES[3])])
def test_what_probes_say_of_models_counts_four_times(monkeypatch, swaps, model):
    """2 of 100 are .08, within a tolerance of .1; 3 are .12, and the full model runs."""
    facts = Told(monkeypatch, once=swaps).chosen(0.1, 8)

    assert facts["model"] == model
    assert facts["tried"]["occlusion measured once"] == pytest.approx(0.04 * swaps)


def test_views_are_doubled_until_the_rest_of_the_series_is_within_the_tolerance(monkeypatch):
    """Changes of .02 and .01 fall by half; two more leave .005 + .0025: 32 of 128 views will do.

    All counts one and a half times. After one change nothing tells how fast they fall: by a tenth
    each, three leave .0488.
    """
    told = Told(monkeypatch, full={8: 3, 16: 1})

    facts = told.chosen(0.04, 128)

    assert facts["views"] == 32
    assert facts["estimate"] == pytest.approx(1.5 * 0.0075)
    assert facts["tried"]["8 instead of 16 views"] == pytest.approx(0.02)
    assert facts["tried"]["16 instead of 32 views"] == pytest.approx(0.01)


def test_where_doubling_will_not_do_all_views_are_used_at_once(monkeypatch):
    """A first change of .1 may halve twice, then .0225 are to come: those are left out."""
    facts = Told(monkeypatch, full={8: 10}).chosen(0.02, 128)

    assert (facts["views"], facts["estimate"]) == (128, 0.0)
    assert list(facts["tried"])[3:] == ["8 instead of 16 views"]


def test_the_model_and_the_views_share_the_tolerance(monkeypatch):
    """Of .14 the model spends .08, and .06 are the views'; the estimate is the sum of both.

    A first change of .03 leaves .073, but where it halves twice only .007; that is too much once
    the model has spent all but .005.
    """
    told = Told(monkeypatch, once={8: 5, 16: 2, 32: 1}, full={8: 3})
    facts = told.chosen(0.14, 128)

    assert facts["model"] == "occlusion measured once"
    assert facts["views"] == 32
    # 3 swaps are made at first, then 1: a third of .01, and a third of that again.
    assert facts["estimate"] == pytest.approx(0.08 + 1.5 * 0.01 * (1 / 3 + 1 / 9))

    dearer = Told(monkeypatch, once={8: 4, 16: 1}, full=0).chosen(0.165, 128)

    assert dearer["tried"]["occlusion measured once"] == pytest.approx(0.16)
    assert dearer["views"] == 128
    assert dearer["estimate"] == pytest.approx(0.16)


def test_views_of_no_weight_are_not_waited_for(scene):
    """Half of them have none, so the eight that probe are all there are."""
    splats, views = scene
    some = ViewSet(
        tuple(replace(view, weight=float(place % 2)) for place, view in enumerate(views))
    )

    scores = auto.score(splats, some, 0.0, CHEAP)

    assert scores.views_used == 8
    assert list(scores.facts["auto"]["tried"]) == NAMES[:3]


@pytest.mark.slow
def test_probes_that_see_nothing_leave_it_to_the_full_model(scene, monkeypatch):
    """The one probe is the view farthest from the others: far behind the room, looking away."""
    splats, views = scene
    away = replace(views[0], center=views[0].center - 1e3 * views[0].rotation[2],
                   rotation=np.diag([1.0, -1.0, -1.0]) @ views[0].rotation)  # fmt: skip
    many = ViewSet((*views, away))
    monkeypatch.setattr(auto, "PROBES", 1)

    scores = auto.score(splats, many, 0.1, CHEAP)

    expected = occlusion.score(splats, many, CHEAP[1]).values
    np.testing.assert_array_equal(scores.values, expected)
    assert "as none of 1 probe views sees anything; that is the full model" in scores.notes[-1]
    assert scores.facts["auto"]["model"] == "occlusion"


def test_a_cheaper_model_that_sees_nothing_does_not_agree(monkeypatch):
    """No centre lies in a view, but what is larger reaches in: the closed form refuses that."""
    told = Told(monkeypatch, once=0)

    def blind(*_, **__):
        msg = "no camera sees the splats"
        raise RefineError(msg)

    monkeypatch.setattr(auto.closed_form, "score", blind)
    facts = told.chosen(0.1)

    assert facts["model"] == "occlusion measured once"
    assert facts["tried"]["closed form"] == 1.0


@pytest.mark.parametrize("budget", [Budget(threshold=0.5), Budget(min_seen=3)])
def test_budgets_that_mean_something_else_to_each_model_are_refused(scene, budget):
    """A threshold of occlusion's places is none of the closed form's errors."""
    with pytest.raises(RefineError, match=f"{budget.kind} means something else to each"):
        prune(*scene, budget, Settings("auto"))


@pytest.mark.parametrize("tolerance", [-0.1, 1.1, float("nan")])
def test_a_tolerance_is_a_share(tolerance):
    """0 to 1."""
    with pytest.raises(RefineError, match="tolerance is"):
        Settings("auto", tolerance=tolerance)


@pytest.mark.slow
def test_progress_never_goes_back(scene):
    """Whatever models and views are tried."""
    told = []

    score(*scene, Settings("auto", occlusion=CHEAP[1], tolerance=0.2),
          progress=lambda fraction, _what: told.append(fraction))  # fmt: skip

    assert told == sorted(told)
    assert 0.0 <= told[0] <= told[-1] <= 1.0
