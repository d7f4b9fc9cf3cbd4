"""Whether cameras and splats can belong together: an up axis, and how far away they are."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from refine_addon.core import (
    Budget,
    Cancelled,
    ClosedForm,
    Occlusion,
    ViewSet,
    prune,
    read_cameras,
    read_splats,
    score,
)
from refine_addon.core.affine import QUARTER
from refine_addon.core.quality.alignment import Alignment, alignment
from tests.core.test_occlusion import cloud, look_along_z, ring, splats_of

ROOM = Path(__file__).parents[1] / "data" / "room_small"
KNOWN = Alignment(1, known=True)


@pytest.fixture(scope="module")
def room():
    """Read the small trained room and its cameras."""
    return read_splats(ROOM / "point_cloud.ply").splats(), read_cameras(ROOM / "cameras.json")


def turned(views: ViewSet, rotation: np.ndarray) -> ViewSet:
    """Return the views turned with the world."""
    return ViewSet(tuple(view.turned(rotation) for view in views))


def within() -> ViewSet:
    """Return cameras in the midst of `cloud`, which look at its middle and see a part of it."""
    return ViewSet(tuple(replace(view, center=0.3 * view.center) for view in ring()))


def test_a_turned_view_sees_of_turned_points_what_it_saw():
    """Point p lies at ``rotation @ (p - center)`` in the camera, so does the turned p."""
    view, point, shift = ring()[2], np.array([0.3, -2.0, 1.0]), np.array([4.0, 5.0, 6.0])
    other = view.turned(QUARTER, shift)

    moved = other.rotation @ (QUARTER @ point + shift - other.center)

    assert np.allclose(moved, view.rotation @ (point - view.center), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("rotation", "turn"), [(np.eye(3), 0), (QUARTER, -1), (QUARTER.T, 1)])
def test_cameras_of_another_up_axis_are_told_with_the_turn_that_helps(room, rotation, turn):
    """The right ones need none; those that were turned by a quarter need that quarter back.

    Their pictures are then as fine as the right ones: about 1.5 times as fine as any other.
    """
    splats, views = room
    given = turned(views, rotation)

    found = alignment(splats, given, given)

    assert found.turn == turn
    assert not found.known
    assert found.far == ()
    fineness = dict(zip((0, 1, -1), found.fineness, strict=True))
    others = [value for number, value in fineness.items() if number != turn]
    assert fineness[turn] > 1.4 * max(others)


@pytest.mark.slow
def test_the_note_says_how_much_finer_and_reaches_the_report(room):
    """By occlusion; the closed form does not measure it: that would take as long as scoring."""
    splats, views = room
    wrong = turned(views, QUARTER).take(range(0, 72, 9))
    budget = Budget(ratio=0.5)

    report = prune(splats, wrong, budget, Occlusion()).report
    plain = prune(splats, wrong, budget, ClosedForm()).report

    words = "cameras and splats do not seem to share an up axis: turned a quarter about X"
    assert [words in note for note in report["notes"]].count(True) == 1
    assert "times as fine" in " ".join(report["notes"])
    assert words not in " ".join(plain["notes"])


@pytest.mark.slow
def test_what_is_known_of_the_views_is_not_measured():
    """Views that know their turn say so, whatever the pictures look like."""
    for turn, sentences in ((0, 0), (1, 1), (-1, 1)):
        views = replace(ring(), turn=turn)
        scores = score(cloud(), views, Occlusion())

        assert scores.alignment is not None
        assert (scores.alignment.turn, scores.alignment.known) == (turn, True)
        assert scores.alignment.fineness == ()
        assert len(scores.alignment.notes()) == sentences


def test_views_that_look_one_way_are_not_judged():
    """One camera, and three side by side: turned, they would look at something else."""
    for views in (ring(1), ViewSet(tuple(look_along_z((x, 0.0, -5.0)) for x in range(3)))):
        found = alignment(cloud(), views, views)

        assert found == Alignment()


def test_views_that_see_all_from_outside_are_not_judged():
    """A ring around the whole cloud: turned, it looks at all of it from another side."""
    assert alignment(cloud(), ring(), ring()) == Alignment()
    assert alignment(cloud(), within(), within()).fineness != ()


def test_a_cloud_that_is_alike_from_all_sides_has_no_up_axis():
    """Splats of the same law in all directions are as fine from wherever cameras look at them."""
    splats = cloud(3000)
    small = replace(splats, log_scales=splats.log_scales - 2.5)

    found = alignment(small, within(), within())

    assert found.turn == 0
    assert min(found.fineness) > 0.8 * max(found.fineness) > 0.02


def test_splats_that_fill_the_picture_are_not_fine():
    """Opaque ones a unit wide, at most two away: 50 px of 69, weight 1 / (1 + (.7 / .015)^2)."""
    means = np.random.default_rng(4).normal(size=(500, 3))

    found = alignment(splats_of(means, alphas=0.9, scales=1.0), within(), within())

    assert len(found.fineness) == 3
    assert 0.0 < max(found.fineness) < 0.005


def test_cameras_far_away_are_named():
    """Twenty splats 2 wide, at focal length 100 px in a picture of 80 x 60.

    From 5 away they fill 40 px, half of the width, from 500 away .4 px, a two-hundredth. What sees
    nothing, and what has weight 0, is not far away.
    """
    splats = splats_of(np.random.default_rng(3).uniform(-1.0, 1.0, (20, 3)))
    views = ViewSet(
        tuple(
            replace(look_along_z((0.0, 0.0, z)), name=name, weight=weight)
            for z, name, weight in (
                (-5.0, "near", 1.0),
                (-500.0, "far", 1.0),
                (-500.0, "weightless", 0.0),
                (500.0, "nothing", 1.0),
            )
        )
    )

    found = alignment(splats, views)

    assert found.far == ("far",)
    assert found.notes()[0].startswith("1 camera sees the splats from so far away")


def test_a_long_thin_thing_is_not_far_away():
    """A mast that is as high as the picture is seen, though it takes a hundredth of its width."""
    heights = np.linspace(-1.0, 1.0, 30)
    splats = splats_of(np.stack([0.01 * heights, heights, 0.0 * heights], axis=1))
    views = ViewSet((look_along_z((0.0, 0.0, -4.0)),))

    assert alignment(splats, views).far == ()


def test_few_splats_in_a_picture_are_not_called_far():
    """Seven are too few to tell a spread from; so few may as well be a small thing in the open."""
    splats = splats_of(np.random.default_rng(3).uniform(-1.0, 1.0, (7, 3)))

    assert alignment(splats, ViewSet((look_along_z((0.0, 0.0, -500.0)),))).far == ()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e38, 0.0])
def test_absurd_splats_are_measured_without_a_warning(value):
    """Nothing is said of what cannot be drawn."""
    splats = cloud()
    splats.means[::2] = value
    splats.log_scales[::3] = value

    found = alignment(splats, within(), within())

    assert len(found.fineness) == 3
    assert np.isfinite(found.fineness).all()


def test_a_signalling_nan_is_no_place_and_makes_no_warning():
    """Converting one to float64 is an invalid operation to the processor; warnings are errors."""
    means = cloud().means.astype(np.float32)
    means.view(np.uint32)[::7, 0] = 0x7FA00000

    found = alignment(replace(cloud(), means=means), ring(20))

    assert found == alignment(
        replace(cloud(), means=np.where(np.isnan(means), np.nan, means)), ring(20)
    )


def test_measuring_can_be_cancelled():
    """At the first report."""
    with pytest.raises(Cancelled):
        alignment(cloud(), within(), within(), progress=lambda _fraction, _what: False)


def test_it_comes_back_from_json():
    """As the mesh keeps it; what is damaged says nothing."""
    measured = Alignment(-1, fineness=(0.1, 0.05, 0.2), far=("a", "b"))
    for found in (Alignment(), KNOWN, measured):
        assert Alignment.from_facts(json.loads(json.dumps(found.facts()))) == found

    facts = measured.facts()
    for wrong in (None, {}, 3, "x", {"turn": "x"}, {"fineness": 1}, {"far": 2}):
        assert Alignment.from_facts(wrong) == Alignment()
    for wrong in (facts | {"turn": 7}, facts | {"fineness": [0.1]}, facts | {"fineness": []}):
        assert Alignment.from_facts(wrong).turn == 0


def test_sentences_count_and_name_what_to_do():
    """Known and measured turns are told apart; the pictures of black are at most 99 times finer."""
    measured = Alignment(1, fineness=(0.1, 0.25, 0.05))

    assert "imported upright; turn the cameras a quarter about X" in KNOWN.turned()
    assert "2.5 times as fine" in measured.turned()
    assert "99.0 times" in replace(measured, fineness=(0.0, 0.25, 0.0)).turned()
    assert Alignment(far=("a", "b")).notes() == [
        "2 cameras see the splats from so far away that they fill less than 2% of a picture"
    ]
    assert Alignment().notes() == []


def test_a_signalling_nan_as_a_position_makes_no_warning():
    """It lies in no view; converted to float64 it became a quiet one with a warning of NumPy's."""
    splats = cloud()
    means = np.array(splats.means, np.float32)
    means.view(np.uint32)[0, 0] = 0x7FA00001

    with np.errstate(all="raise"):
        found = alignment(replace(splats, means=means), ring())

    assert found == alignment(splats, ring())
