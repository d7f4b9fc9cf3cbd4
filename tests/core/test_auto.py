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
    ViewSet,
    auto,
    occlusion,
    prune,
    read_cameras,
    read_ply,
    score,
)

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


@pytest.mark.parametrize("tolerance", [0.0, 0.15, 0.3, 1.0])
def test_the_kept_set_differs_from_the_full_models_by_no_more_than_the_tolerance(scene, tolerance):
    """The full model is occlusion in rounds with all views."""
    full = occlusion.score(*scene, CHEAP[1])

    scores = auto.score(*scene, tolerance, CHEAP)

    assert auto.disagreement(full, scores) <= tolerance
    assert scores.weights["auto"]["estimate"] <= tolerance


def test_no_tolerance_is_the_full_model_to_the_bit(scene):
    """Nothing cheaper agrees wholly, so that runs."""
    expected = occlusion.score(*scene, CHEAP[1]).values

    np.testing.assert_array_equal(auto.score(*scene, 0.0, CHEAP).values, expected)


def test_where_all_may_differ_the_cheapest_model_is_taken(scene):
    """A kept set may differ altogether."""
    facts = auto.score(*scene, 1.0, CHEAP).weights["auto"]

    assert facts["model"] == "closed form without frustum test"


def test_the_report_says_what_was_tried_chosen_and_why(scene):
    """As JSON for programs, and as a sentence for people."""
    settings = Settings("auto", occlusion=CHEAP[1], tolerance=0.3)

    report = prune(*scene, Budget(ratio=0.5), settings).report

    facts = json.loads(json.dumps(report, allow_nan=False))["weights"]["auto"]
    assert set(facts) == {"model", "views", "estimate", "tolerance", "tried"}
    assert any("estimated to keep" in note and facts["model"] in note for note in report["notes"])


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
    assert "see nothing" in scores.notes[-1]


@pytest.mark.parametrize("tolerance", [-0.1, 1.1, float("nan")])
def test_a_tolerance_is_a_share(tolerance):
    """0 to 1."""
    with pytest.raises(RefineError, match="tolerance is"):
        Settings("auto", tolerance=tolerance)


def test_progress_never_goes_back(scene):
    """Whatever models and views are tried."""
    told = []

    score(*scene, Settings("auto", occlusion=CHEAP[1], tolerance=0.2),
          progress=lambda fraction, _what: told.append(fraction))  # fmt: skip

    assert told == sorted(told)
    assert 0.0 <= told[0] <= told[-1] <= 1.0
