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


def within() -> ViewSet:
    """Return cameras in the midst of `cloud`, which look at its middle and see a part of it."""
    return ViewSet(tuple(replace(view, center=0.3 * view.center) for view in ring()))


@pytest.mark.slow
@pytest.mark.parametrize(("rotation", "turn"), [(np.eye(3), 0), (QUARTER, -1), (QUARTER.T, 1)])
def test_cameras_of_another_up_axis_are_told_with_the_turn_that_helps(room, rotation, turn):
    """The right ones need none; those that were turned by a quarter need that quarter back.

    Their pictures are then as fine as the right ones: about 1.5 times as fine as any other.
    """
    splats, views = room
    given = ViewSet(tuple(view.turned(rotation) for view in views))

    found = alignment(splats, given, given)

    assert (found.turn, found.known, found.far) == (turn, False, ())
    fineness = dict(zip((0, 1, -1), found.fineness, strict=True))
    best = fineness.pop(turn)
    assert best > 1.4 * max(fineness.values())


@pytest.mark.slow
def test_the_note_says_how_much_finer_and_reaches_the_report(room):
    """By occlusion; the closed form does not measure it: that would take as long as scoring."""
    splats, views = room
    wrong = ViewSet(tuple(view.turned(QUARTER) for view in views)).take(range(0, 72, 9))

    notes, plain = (
        " ".join(prune(splats, wrong, Budget(ratio=0.5), method).report["notes"])
        for method in (Occlusion(), ClosedForm())
    )

    words = "cameras and splats do not seem to share an up axis: turned a quarter about X"
    assert notes.count(words) == 1
    assert "times as fine" in notes
    assert words not in plain


@pytest.mark.parametrize(("turn", "sentences"), [(0, 0), (1, 1), (-1, 1)])
def test_what_is_known_of_the_views_is_not_measured(turn, sentences):
    """Views that know their turn say so, whatever the pictures look like."""
    views = replace(within(), turn=turn)

    found = alignment(cloud(), views, views)

    assert (found.turn, found.known, found.fineness) == (turn, True, ())
    assert len(found.notes()) == sentences


def test_views_that_see_all_or_look_one_way_are_not_judged():
    """Turned, one camera, or three side by side, would look at something else.

    A ring around the whole cloud would look at all of it from another side.
    """
    aside = ViewSet(tuple(look_along_z((x, 0.0, -5.0)) for x in range(3)))

    for views in (ring(1), aside, ring()):
        assert alignment(cloud(), views, views) == Alignment()
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


def at(*depths):
    """Return cameras that look along z at depths, named by them."""
    return ViewSet(tuple(replace(look_along_z((0, 0, z)), name=str(z)) for z in depths))


def test_cameras_far_away_are_named():
    """Twenty splats 2 wide, at focal length 100 px in a picture of 80 x 60.

    From 5 away they fill 40 px, half of the width, from 500 away .4 px, a two-hundredth. What sees
    nothing, and what has weight 0, is not far away. Seven are too few to tell a spread from, and a
    mast that is as high as the picture is seen, though it takes a hundredth of its width.
    """
    splats = splats_of(np.random.default_rng(3).uniform(-1.0, 1.0, (20, 3)))
    weightless = replace(at(-500)[0], weight=0.0, name="weightless")
    heights = np.linspace(-1.0, 1.0, 30)
    mast = splats_of(np.stack([0.01 * heights, heights, 0.0 * heights], axis=1))

    found = alignment(splats, ViewSet((*at(-5, -500, 500), weightless)))

    assert found.far == ("-500",)
    assert found.notes()[0].startswith("1 camera sees the splats from so far away")
    assert alignment(mast, at(-4)).far == ()
    assert alignment(splats.take(np.arange(7)), at(-500)).far == ()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e38, 0.0])
def test_absurd_splats_are_measured_without_a_warning(value):
    """Nothing is said of what cannot be drawn."""
    splats = cloud()
    splats.means[::2] = value
    splats.log_scales[::3] = value

    found = alignment(splats, within(), within())

    assert len(found.fineness) == 3
    assert np.isfinite(found.fineness).all()
    with pytest.raises(Cancelled):
        alignment(splats, within(), within(), progress=lambda *_: False)


def test_a_signalling_nan_is_no_place_and_makes_no_warning():
    """Converting one to float64 is an invalid operation to the processor; warnings are errors."""
    means = cloud().means.astype(np.float32)
    means.view(np.uint32)[::7, 0] = 0x7FA00000
    quiet = replace(cloud(), means=np.where(np.isnan(means), np.nan, means))

    with np.errstate(all="raise"):
        found = alignment(replace(cloud(), means=means), ring(20))

    assert found == alignment(quiet, ring(20))


def test_it_comes_back_from_json_and_tells_what_to_do():
    """As the mesh keeps it; what is damaged says nothing. Black is at most 99 times finer."""
    measured = Alignment(1, fineness=(0.1, 0.25, 0.05), far=("a", "b"))
    for found in (Alignment(), KNOWN, measured):
        assert Alignment.from_facts(json.loads(json.dumps(found.facts()))) == found

    facts = measured.facts()
    for wrong in (None, {}, 3, "x", {"turn": "x"}, {"fineness": 1}, {"far": 2}):
        assert Alignment.from_facts(wrong) == Alignment()
    for wrong in (facts | {"turn": 7}, facts | {"fineness": [0.1]}, facts | {"fineness": []}):
        assert Alignment.from_facts(wrong).turn == 0
    assert "imported upright; turn the cameras a quarter about X" in KNOWN.turned()
    assert "2.5 times as fine" in measured.turned()
    assert "99.0 times" in replace(measured, fineness=(0.0, 0.25, 0.0)).turned()
    assert "2 cameras see the splats from so far away" in " ".join(measured.notes())
