"""The estimate of the pictures' quality, a PSNR as budget, and whether cameras and splats fit."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import (
    Budget,
    ClosedForm,
    Merge,
    Occlusion,
    RefineError,
    Scores,
    ViewSet,
    execute,
    prune,
    read_cameras,
    read_splats,
    score,
    select,
)
from refine_addon.core.affine import QUARTERS
from refine_addon.core.pictures import compare
from refine_addon.core.quality.alignment import Alignment, alignment
from refine_addon.core.quality.curve import PSNR_CAP, SHARES, Quality
from refine_addon.core.quality.psnr import psnr_kept, psnr_of, with_quality
from refine_addon.core.visibility import cast
from refine_addon.core.visibility.cast import validation_rays
from refine_addon.core.visibility.rays import Rays
from tests.core.test_invariance import MOTIONS, moved
from tests.core.test_levels import merges  # noqa: F401 - a fixture
from tests.core.test_occlusion import cloud, look_along_z, ring, splats_of
from tests.places import ROOM

FAST, KNOWN = ClosedForm(), Alignment(1, known=True)
CURVE = Quality(*np.array([[0.2, 0.5, 0.8], [50.0, 40.0, 30.0], [52.0, 47.0, 38.0]]))


@pytest.mark.slow
@pytest.mark.parametrize(("rays", "within"), [(1 << 20, 0.01), (1 << 13, 0.25)])
def test_rays_tell_the_psnr_of_the_picture(monkeypatch, rays, within):
    """Of 24,000 pixels as many rays leave nothing to chance, a third a quarter of a dB."""
    splats, views, keep = cloud(), ring(), np.random.default_rng(5).random(300) < 0.5
    monkeypatch.setitem(cast.RAYS, "validation", (rays, 1 << 24))
    found = validation_rays(splats, views)
    whole = np.mean([one.psnr for one in compare(splats, splats.take(keep), views)])
    count = sum(len(rays.columns) * len(rays.rows) for rays in found.rays)
    assert count == 24_000 if rays > 24_000 else count < 8800
    assert psnr_kept(found, keep) == pytest.approx(whole, abs=within)


def test_few_rays_are_right_on_average():
    """Minus the logarithm of a mean is too high, by half the mean's relative variance, on average.

    That of the square of an exponential variable is 5, (24 - 4) / 4; so the mean of 50 rays is too
    high by 10 / ln 10 * 5 / 50 / 2 = .22 dB, and mended. An error that rises evenly is no chance.
    """
    errors = np.random.default_rng(0).exponential(size=(2000, 50)) ** 2 / 2e4
    view = look_along_z(width=1000, height=1000)
    even = np.linspace(0.0, 2e-4, 50)
    true = -10 * math.log10(np.mean(errors))
    *found, rising = [
        psnr_of(np.sqrt(row) * np.ones((3, 1)), np.zeros((3, 50)), view) for row in [*errors, even]
    ]
    plain = np.mean([-10 * math.log10(np.mean(row)) for row in errors])
    assert plain - true == pytest.approx(0.22, abs=0.06)
    assert np.mean(found) == pytest.approx(true, abs=0.1)
    assert rising == pytest.approx(40.0, abs=0.01)


def test_a_splat_behind_others_counts_by_what_shows_through():
    """Alpha .5 in front of alpha .5: with both .5 c + .25 c, without the one in front .5 c.

    Wider than the picture, they change all pixels by .125. A few dozen rays are too few to say.
    """
    views = ViewSet((look_along_z(),))
    splats = splats_of([[0, 0, 2.0], [0, 0, 3.0]], alphas=0.5, scales=100.0, color=0.5)
    found = validation_rays(splats, views)
    result = prune(splats_of([[0, 0, 2.0]] * 4, scales=0.02), views, Budget(keep=2), Occlusion())
    for keep in ([True, False], [False, True]):
        assert psnr_kept(found, np.array(keep)) == pytest.approx(-20 * math.log10(0.125), abs=0.01)
    assert result.report["estimated_psnr"] is None
    assert any("too little" in note for note in result.report["notes"])


@pytest.mark.slow
def test_the_curve_is_what_each_share_reaches():
    """As `select` removes the lowest; the mean of the views by their weights.

    One that looks away is no equal picture; one has millions of pixels a side."""
    one, two, *others = ring()
    lens = {"fx": 1e7, "fy": 1e7, "cx": 4e6, "cy": 3e6, "width": 8_000_000, "height": 6_000_000}
    away = replace(two, rotation=np.diag([-1.0, 1.0, -1.0]) @ two.rotation, name="away")
    views = ViewSet((replace(one, weight=3.0), replace(two, **lens), *others, away))
    scores = score(cloud(), views, Occlusion())
    curve, sample = scores.quality, scores.ray_sample
    assert curve.shares.tolist() == list(SHARES)
    for share, value in zip(SHARES, curve.psnr, strict=True):
        keep = select(scores, Budget(ratio=share))
        assert psnr_kept(sample, keep) == pytest.approx(value, abs=1e-9)
    mean = sum(view.weight * curve.views[view.name] for view in tuple(views)[:-1]) / 7.0
    assert np.allclose(mean, curve.psnr, atol=1e-9)
    assert len({tuple(of_view) for of_view in curve.views.values()}) == len(curve.views) == 5
    assert all(np.all(np.diff(of_view) <= 0.0) for of_view in curve.views.values())


def test_a_view_whose_splats_stay_is_not_changed():
    """Ten splats before each of two cameras; the lowest half is what one of them sees."""
    means = np.random.default_rng(2).normal(size=(20, 3)) * 0.3 + [0.0, 0.0, 4.0]
    means[10:, 0] += 40.0
    splats = splats_of(means, color=0.9, scales=0.2)
    views = ViewSet((replace(look_along_z(), name="a"), look_along_z((40.0, 0, 0), name="b")))
    values, rays = np.arange(20, dtype=np.float32), validation_rays(splats, views)
    curve = with_quality(Scores(values, np.zeros(20), 2, 0, ray_sample=rays)).quality
    assert curve.of_views(0.5) == {"a": pytest.approx(curve.views["a"][4]), "b": PSNR_CAP}
    assert curve.of_views(0.5)["a"] < 30.0


@pytest.mark.slow
@pytest.mark.parametrize("method", [FAST, Occlusion()])
def test_the_estimate_depends_on_nothing_but_the_scene(method):
    """But for the last digits, and scores do not change by being asked for it."""
    splats, views = cloud(), ring()
    order = np.random.default_rng(1).permutation(len(splats))
    there = moved(splats.take(order), tuple(views)[::-1], *MOTIONS["a turn and a move"])
    one = score(splats, views, method, quality=True, threads=1)
    other = score(*there, method, quality=True, threads=3)
    without = score(splats, views, method, quality=False)
    assert np.allclose(one.quality.psnr, other.quality.psnr, atol=0.05)
    assert np.array_equal(one.values, without.values)


def test_a_curve_is_read_between_its_points_and_back():
    """Linear in the logarithm of the odds; of equal points the last."""
    for way, points in (("delete", [50.0, 40.0, 30.0]), ("merge", [52.0, 47.0, 38.0])):
        assert [CURVE.at(at, way=way) for at in (0.2, 0.5, 0.8)] == pytest.approx(points)
        assert [CURVE.share(value, way=way) for value in points] == pytest.approx([0.2, 0.5, 0.8])
    # Odds of 1 to 2: halfway between 1 to 4 and 1 to 1 on a scale of logarithms.
    assert CURVE.at(1 / 3) == pytest.approx(45.0)
    assert CURVE.share(45.0) == pytest.approx(1 / 3)
    assert [CURVE.at(0.0), CURVE.at(0.99)] == [PSNR_CAP, 30.0]
    assert [CURVE.share(5.0), CURVE.share(200.0)] == [0.8, 0.0]
    assert 0.0 < CURVE.share(90.0) < 0.01
    assert Quality(CURVE.shares, np.full(3, 40.0), np.full(3, 40.0)).share(40.0) == 0.8


def test_on_a_ray_the_nearest_kept_hit_stands_in():
    """Red, green, blue, one behind the other, alpha .5; as near as another, the one behind."""
    line, half, three = np.zeros(3, np.int32), np.full(3, 0.5), np.arange(3)
    rays = Rays(np.arange(1), np.arange(1), line, three, half, three)
    for keep, expected in (
        ([True, False, True], [0.5, 0.0, 0.375]),
        ([False, False, True], [0.0, 0.0, 0.875]),
        ([False, False, False], [0.0, 0.0, 0.0]),
    ):
        seen = rays.colors_by_nearest_kept(np.eye(3), np.array(keep))[:, 0]
        assert seen.tolist() == pytest.approx(expected)


def test_a_curve_comes_back_from_json():
    """That of a file which an older version wrote has nothing to tell of between."""
    views, between = {"a": np.array([51.0, 41.0, 31.004])}, np.array([48.0, 36.0, 25.0])
    facts = json.loads(json.dumps(CURVE._replace(views=views, between=between).facts()))
    again = Quality.from_facts(facts)
    old = Quality.from_facts({key: value for key, value in facts.items() if key != "between"})
    for name in ("shares", "psnr", "merged"):
        assert np.array_equal(getattr(again, name), getattr(CURVE, name))
    assert again.views["a"].tolist() == [51.0, 41.0, 31.0]
    assert (again.at_between(0.5), old.at_between(0.5)) == (36.0, None)
    changes = {"psnr": [1.0]}, {"psnr": ["x"]}, {"views": {"a": [1.0]}}, {"views": 1}
    changes += ({"between": [1.0]},)
    emptied = {name: [] for name in facts}
    for wrong in (None, 3, {}, {"shares": [0.5]}, emptied, *(facts | each for each in changes)):
        assert Quality.from_facts(wrong) is None


@pytest.mark.slow
@pytest.mark.parametrize("method", [FAST, Occlusion()])
@pytest.mark.parametrize("goal", [20.0, 35.0])
def test_every_method_reaches_a_psnr(method, goal):
    """By its own estimate; nearly, where many are protected."""
    protected = np.arange(300) % 3 == 0
    for shield, near in ((None, 0.6), (protected, 1.0)):
        result = prune(cloud(), ring(), Budget(psnr=goal), method, protected=shield)
        assert result.report["estimated_psnr"] == pytest.approx(goal, abs=near)
        assert result.report["budget"] == {"psnr": goal}
        assert not result.keep.all()
        assert shield is None or result.keep[protected].all()


def test_the_report_has_the_estimate_and_the_curve():
    """Of the result and of all shares; the closed form would take longer by it."""
    scene = cloud(), ring(), Budget(ratio=0.5)
    done, plain = (prune(*scene, method).report for method in (Occlusion(), FAST))
    at = done["quality"]["shares"].index(0.5)
    assert done["estimated_psnr"] == pytest.approx(done["quality"]["psnr"][at], abs=0.01)
    expected = {"delete": done["estimated_psnr"], "merge": None, "refit": None}
    assert done["method"]["psnr"] == expected
    json.dumps(done, allow_nan=False)
    assert [plain["estimated_psnr"], plain["quality"], plain["notes"]] == [None, None, []]
    assert "only if a PSNR is the budget" in plain["estimated_psnr_note"]
    scores = Scores(np.arange(9, dtype=np.float32), np.zeros(9, np.int32), 1, 0)
    with pytest.raises(RefineError, match="score again with a PSNR as budget"):
        select(scores, Budget(psnr=40.0))


@pytest.mark.slow
def test_what_merging_would_reach_is_told_of_many_splats_alone(merges):
    few = score(cloud(), ring(), Occlusion())
    many = replace(few, quality=few.quality._replace(foretold=True))
    few_told, many_told = (
        prune(None, None, Budget(ratio=0.5), Occlusion(), scores=scores).report["method"]
        for scores in (few, many)
    )
    done = prune(cloud(), ring(), Budget(ratio=0.5), Merge()).report
    assert few_told["psnr"]["merge"] is None
    assert "fewer than 20,000 splats" in few_told["note"]
    assert many_told["psnr"]["delete"] < many_told["psnr"]["merge"] < many_told["psnr"]["refit"]
    assert many_told["note"] is None
    assert done["method"]["psnr"]["merge"] == done["estimated_psnr"]
    facts = few.quality.facts()
    assert not Quality.from_facts(facts).foretold
    del facts["foretold"]  # as of older versions
    assert Quality.from_facts(facts).foretold


def within() -> ViewSet:
    """Cameras in the midst of `cloud`, which look at its middle and see a part of it."""
    return ViewSet(tuple(replace(view, center=0.3 * view.center) for view in ring()))


@pytest.mark.slow
@pytest.mark.parametrize("turn", QUARTERS)
def test_cameras_of_another_up_axis_are_told_with_the_turn_that_helps(turn):
    """Pictures are then about 1.5 times as fine as any other; the right cameras need no turn."""
    splats = read_splats(ROOM / "point_cloud.ply").splats()
    views = read_cameras(ROOM / "cameras.json")
    given = ViewSet(tuple(view.turned(QUARTERS[turn].T) for view in views))
    found = alignment(splats, given, given)
    assert (found.turn, found.known, found.far) == (turn, False, ())
    fineness = dict(zip((0, 1, -1, 2), found.fineness, strict=True))
    best = fineness.pop(turn)
    assert best > 1.4 * max(fineness.values())


def test_views_that_see_all_or_look_one_way_are_not_judged():
    """Turned, they would look at something else, or at all of it from another side."""
    aside = ViewSet(tuple(look_along_z((x, 0.0, -5.0)) for x in range(3)))
    for views in (ring(1), aside, ring()):
        assert alignment(cloud(), views, views) == Alignment()
    assert alignment(cloud(), within(), within()).fineness != ()


def test_a_house_is_not_finer_from_outside():
    """Inside a shell of radius 1, splats of 0.03 are seen from 1 away; turned about the world's
    origin, which is 10 away, one of two views sees them from 14, where they look 14 times finer."""
    shell = np.random.default_rng(0).normal(size=(3000, 3))
    shell = shell / np.linalg.norm(shell, axis=1, keepdims=True) + (0.0, 0.0, 10.0)
    out = np.array([[1.0, 0.0, 0.0], [0.0, 0.5**0.5, -(0.5**0.5)], [0.0, -(0.5**0.5), -(0.5**0.5)]])
    view = replace(look_along_z((0.0, 0.0, 10.0)), rotation=out, fx=800.0, fy=800.0)
    aside = replace(view, center=np.array([0.5, 0.0, 10.0]), rotation=out * [[1], [-1], [-1]])
    views = ViewSet((view, aside))
    assert alignment(splats_of(shell, alphas=0.9, scales=0.03), views, views).turn == 0


def test_a_cloud_that_is_alike_from_all_sides_has_no_up_axis():
    """Opaque splats a unit wide are not fine: 50 px of 69, 1 / (1 + (.7 / .015)^2)."""
    splats = cloud(3000)
    small = replace(splats, log_scales=splats.log_scales - 2.5)
    large = splats_of(splats.means[:500], alphas=0.9, scales=1.0)
    found = alignment(small, within(), within())
    assert found.turn == 0
    assert min(found.fineness) > 0.8 * max(found.fineness) > 0.01
    assert 0.0 < max(alignment(large, within(), within()).fineness) < 0.005


def at(*depths):
    return ViewSet(tuple(replace(look_along_z((0, 0, z)), name=str(z)) for z in depths))


def test_cameras_far_away_are_named():
    """Twenty splats 2 wide fill 40 of 80 px from 5 away, from 500 away .4 px, a two-hundredth.

    Not what sees nothing or has weight 0; seven are too few; a mast as high as the picture is seen.
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


@pytest.mark.parametrize("value", [np.nan, np.inf, 3e38, 0.0])
def test_absurd_splats_are_measured_without_a_warning(value):
    splats = cloud()
    splats.means[::2] = value
    splats.log_scales[::3] = value
    found = alignment(splats, within(), within())
    assert len(found.fineness) == 4
    assert np.isfinite(found.fineness).all()


def test_a_signalling_nan_is_no_place_and_makes_no_warning():
    """Converting one to float64 is an invalid operation to the processor."""
    means = cloud().means.astype(np.float32)
    means.view(np.uint32)[::7, 0] = 0x7FA00000
    quiet = np.where(np.isnan(means), np.nan, means)
    loud, silent = (replace(cloud(), means=each, log_scales=each) for each in (means, quiet))
    with np.errstate(all="raise"):
        found = execute.within(cores=1)(alignment)(loud, within(), within())
    assert found == alignment(silent, within(), within())


def test_it_comes_back_from_json_and_tells_what_to_do():
    """What is damaged says nothing. Black is at most 99 times finer."""
    measured = Alignment(1, fineness=(0.1, 0.25, 0.05, 0.0), far=("a", "b"))
    for found in (Alignment(), KNOWN, measured):
        assert Alignment.from_facts(json.loads(json.dumps(found.facts()))) == found
    facts = measured.facts()
    for wrong in (None, {}, 3, "x", {"turn": "x"}, {"fineness": 1}, {"far": 2}):
        assert Alignment.from_facts(wrong) == Alignment()
    for wrong in (facts | {"turn": 7}, facts | {"fineness": [0.1]}, facts | {"fineness": []}):
        assert Alignment.from_facts(wrong).turn == 0
    assert "imported upright; turn the cameras a quarter about X" in KNOWN.turned()
    assert "2.5 times as fine" in measured.turned()
    assert "99.0 times" in measured._replace(fineness=(0.0, 0.25, 0.0, 0.0)).turned()
    assert "2 cameras see the splats from so far away" in " ".join(measured.notes())
