"""Numbers at the extremes: one test a row of docs/numerics.md."""

from __future__ import annotations

import math
from dataclasses import replace

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from refine_addon.core import (
    Budget,
    ClosedForm,
    Occlusion,
    RefineError,
    Splats,
    View,
    ViewSet,
    prune,
    score,
    select,
)
from refine_addon.core.merging import field as merge_field
from refine_addon.core.merging import graph as merge_graph
from refine_addon.core.prune import merge_down
from refine_addon.core.scoring import closed_form, occlusion
from refine_addon.core.scoring.closed_form import lambdas
from refine_addon.core.splats import ARRAYS, drawable, opacity
from refine_addon.core.visibility import points, projection

FINITE = [
    *(0.0, -0.0, 1.0, -1.0, 1e-45, 1e-38, -1e-30, 1e-3, 88.0, -88.0, 100.0, -100.0),
    *(1e3, -1e3, 1e6, 1e20, 1e30, -1e30, 3.4e38, -3.4e38),
]
EXTREME = [*FINITE, math.inf, -math.inf, math.nan]
DOUBLES = [1e-320, -1e-310, 1e-200, 1e-100, 1e100, -1e200, 1e308]
METHODS = {
    "closed form": ClosedForm(),
    "occlusion": Occlusion(),
}
READINGS: dict[str, dict[str, object]] = {
    "distance": {"depth": "distance"},
    "alone": {"local": False},
    "floor": {"depth": "distance", "frustum": False, "local": False},
}
by_method = pytest.mark.parametrize("settings", METHODS.values(), ids=METHODS)
by_method_and_reading = pytest.mark.parametrize(
    "settings", (METHODS | READINGS).values(), ids=METHODS | READINGS
)


@pytest.fixture(autouse=True)
def _raise_on_every_numpy_warning():
    """Overflow, underflow, invalid and division by zero are errors in here."""
    with np.errstate(all="raise"):
        yield


def cloud(count: int = 20, seed: int = 0) -> Splats:
    rng = np.random.default_rng(seed)
    return Splats(
        means=(rng.normal(size=(count, 3)) * 0.3 + [0, 0, 3]).astype(np.float32),
        log_scales=rng.normal(-3, 1, size=(count, 3)).astype(np.float32),
        quaternions=rng.normal(size=(count, 4)).astype(np.float32),
        opacity_logits=rng.normal(0, 2, size=count).astype(np.float32),
        sh_dc=rng.normal(size=(count, 3)).astype(np.float32),
        sh_rest=rng.normal(size=(count, 3, 3)).astype(np.float32),
    )


def view(center=(0.0, 0.0, 0.0), **changes) -> View:
    values = {"fx": 50.0, "fy": 50.0, "cx": 50.0, "cy": 50.0, "width": 100, "height": 100}
    return View(np.eye(3), np.array(center, float), **values | changes)


def scored(splats, views=None, settings=None):
    """Score in this thread: NumPy's flags are raised in it alone."""
    settings = settings or ClosedForm()
    views = views or ViewSet((view(), view([0.1, 0, 0])))
    if isinstance(settings, dict):
        return closed_form.score(splats, views, **settings, threads=1)
    return score(splats, views, settings, threads=1)


def check(splats, scores):
    """Assert what holds for every input: finite, not negative, lowest if undrawable."""
    good = drawable(splats)
    assert np.isfinite(scores.values).all()
    assert (scores.values[good] > 0).all()
    assert (scores.values[~good] == 0).all()
    assert scores.undrawable == np.count_nonzero(~good)
    assert (scores.seen >= 0).all()
    assert (scores.seen <= scores.views_used).all()
    if "lambda" in scores.facts:
        terms = list(scores.facts["lambda"].values())
        assert all(0 <= value <= 1 for value in terms)
        assert sum(terms) == pytest.approx(1)


def check_the_others(splats, scores, settings):
    """Assert that all but the first splat are ordered as if it were not there."""
    views = ViewSet((view(), view([0.1, 0, 0])))
    if isinstance(settings, Occlusion):  # in one round: how many go in each depends on their number
        scores = occlusion.score(splats, views, rounds=1, threads=1)
        expected = occlusion.score(splats.take(slice(1, None)), views, rounds=1, threads=1).values
    else:
        expected = scored(splats.take(slice(1, None)), settings=settings).values
        np.testing.assert_allclose(
            scores.values[1:] / scores.values[1], expected / expected[0], rtol=1e-6
        )
    assert np.argsort(scores.values[1:]).tolist() == np.argsort(expected).tolist()


def with_first(name: str, value: object, kind: type = np.float32) -> Splats:
    """Return the cloud, each number of one attribute of its first splat set to `value`."""
    splats = cloud()
    values = getattr(splats, name).astype(kind)
    values[0] = value
    return replace(splats, **{name: values})


# ----- one extreme at a time


@pytest.mark.slow
@by_method_and_reading
@pytest.mark.parametrize("name", ARRAYS)
def test_one_extreme_splat_spoils_neither_itself_nor_the_others(name, settings):
    """Any attribute, any value, floats and doubles."""
    for value, kind in [(v, np.float32) for v in EXTREME] + [(v, np.float64) for v in DOUBLES]:
        splats = with_first(name, value, kind)
        scores = scored(splats, settings=settings)

        check(splats, scores)
        if not drawable(splats)[0]:
            check_the_others(splats, scores, settings)


@pytest.mark.slow
@pytest.mark.parametrize("settings", [METHODS["closed form"], METHODS["occlusion"]])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_property_that_is_not_finite_makes_its_splat_the_lowest(value, settings):
    """Every property in turn; opacity 1 (logit +inf) and a flat splat (log scale -inf) are fine."""
    for item in ARRAYS:
        for column in np.ndindex(getattr(cloud(), item).shape[1:]):
            splats = cloud()
            getattr(splats, item)[(0, *column)] = value
            fine = (item, value) in (("opacity_logits", math.inf), ("log_scales", -math.inf))

            scores = scored(splats, settings=settings)

            assert (scores.values == 0).tolist() == [not fine] + [False] * 19
            assert scores.undrawable == (not fine)
            if not fine:
                check_the_others(splats, scores, settings)


@by_method
def test_splats_that_cannot_be_drawn_go_first_and_are_counted(settings):
    """Five of twenty: they go before all others, and report and notes say so."""
    splats = cloud()
    broken = [3, 4, 9, 15, 19]
    splats.means[broken] = np.nan
    views = ViewSet((view(), view([0.1, 0, 0])))

    result = prune(splats, views, Budget(keep=15), settings, threads=1)

    assert np.flatnonzero(~result.keep).tolist() == broken
    assert result.report["splats"]["undrawable"] == 5
    assert "5 splats cannot be drawn; they rank lowest" in result.report["notes"]


@pytest.mark.slow
@by_method
@pytest.mark.parametrize("axes", [[0], [1], [2], [0, 1], [1, 2], [2, 0]])
def test_a_scale_of_zero_along_one_axis_or_two_is_a_disk_or_a_needle(axes, settings):
    """It ranks as one that is thin by more than a million, not more and not less."""
    flat, thin = cloud(), cloud()
    flat.log_scales[0, axes] = -math.inf
    thin.log_scales[0, axes] = -40.0

    scores = scored(flat, settings=settings)

    check(flat, scores)
    assert scores.values[0] > 0
    np.testing.assert_allclose(scores.values, scored(thin, settings=settings).values, rtol=1e-6)


@by_method
def test_a_scale_of_zero_along_every_axis_cannot_be_drawn(settings):
    """A point covers nothing."""
    splats = with_first("log_scales", -math.inf)

    scores = scored(splats, settings=settings)

    assert np.flatnonzero(scores.values == 0).tolist() == [0]


@pytest.mark.slow
@by_method
@pytest.mark.parametrize("length", [1e-300, 1e-30, 3.7, 1e30, 1e300])
def test_the_length_of_quaternions_does_not_matter(length, settings):
    """Tiny, huge or just not normalised: the same rotations."""
    splats = cloud()
    units = splats.quaternions / np.linalg.norm(splats.quaternions.astype(float), axis=1)[:, None]
    expected = scored(replace(splats, quaternions=units), settings=settings).values

    values = scored(replace(splats, quaternions=units * length), settings=settings).values

    np.testing.assert_array_equal(values, expected)


@by_method
def test_a_quaternion_of_zero_is_the_identity(settings):
    """As conventions.md says."""
    expected = scored(with_first("quaternions", [1, 0, 0, 0]), settings=settings).values

    values = scored(with_first("quaternions", 0.0), settings=settings).values

    np.testing.assert_array_equal(values, expected)


@pytest.mark.slow
@by_method
@pytest.mark.parametrize("depth", [0.0, 1e-30, -1e-30, 1e-3, -1e-3, 0.0299, 0.0301, 1e30, -1e30])
def test_depths_at_before_and_behind_the_camera_plane(depth, settings):
    """One splat at the depth, the rest before the camera; the near plane lies at about .03."""
    splats = with_first("means", [0, 0, depth])

    check(splats, scored(splats, settings=settings))


@by_method
def test_a_camera_inside_a_splat_scores_it(settings):
    """Its centre lies at the camera's: nearer than the near plane, so no view sees it."""
    splats = cloud()
    splats.means[0], splats.log_scales[0] = 0.0, 2.0

    scores = scored(splats, ViewSet((view(),)), settings)

    check(splats, scores)
    assert scores.seen[0] == 0


@by_method
def test_denormal_opacities_and_scales_are_told_from_zero(settings):
    """Above the smallest float32 a splat can be drawn, below it cannot."""
    splats = cloud(5)
    splats.opacity_logits[[0, 2]] = -103.0, -104.0
    splats.log_scales[[1, 3]] = [[-103.0], [-104.0]]

    values = scored(splats, settings=settings).values

    assert (values > 0).tolist() == [True, True, False, False, True]


# ----- scenes and views as a whole


@by_method
def test_all_splats_behind_every_camera_is_said(settings):
    """Nothing to rank by."""
    splats = cloud()
    with pytest.raises(RefineError, match="no camera sees"):
        scored(replace(splats, means=-splats.means), settings=settings)


@by_method
def test_nothing_but_opacity_zero_is_said(settings):
    """Nothing to draw."""
    for nothing in (-1e3, -math.inf):
        splats = replace(cloud(), opacity_logits=np.full(20, nothing, np.float32))
        with pytest.raises(RefineError, match="none of the 20 splats can be drawn"):
            scored(splats, settings=settings)


@by_method
def test_one_splat_and_one_view_score_one(settings):
    """Three terms, each divided by its mean, its own, weighted by lambda; or the first of one."""
    splats = replace(cloud(1), means=np.array([[0.0, 0, 3]]), opacity_logits=np.ones(1))

    assert scored(splats, ViewSet((view(),)), settings).values == pytest.approx([1.0])


@pytest.mark.slow
def test_ten_thousand_views_are_one_mean():
    """Copies of one view change nothing."""
    splats = cloud()
    many = ViewSet((view(),) * 10_000)

    values = scored(splats, many, ClosedForm(0)).values

    np.testing.assert_allclose(values, scored(splats, ViewSet((view(),))).values, rtol=1e-6)


@pytest.mark.slow
def test_of_thousands_of_views_as_many_are_used_as_asked():
    """Along a line of 10 cm; by default 64."""
    splats = cloud()
    many = ViewSet(tuple(view([x, 0, 0]) for x in np.linspace(0, 0.1, 10_000)))

    scores = scored(splats, many, METHODS["occlusion"])

    check(splats, scores)
    assert scores.views_used == 64


@by_method
@pytest.mark.parametrize("focal", [1.0, 1e6])
def test_any_focal_length(focal, settings):
    """1 px sees nearly the half space; 1e6 px needs an image as large to see anything."""
    splats = cloud()
    views = ViewSet((view(fx=focal, fy=focal, width=10**6, height=10**6, cx=5e5, cy=5e5),))

    check(splats, scored(splats, views, settings))


@pytest.mark.slow
@by_method
@pytest.mark.parametrize(
    "changes",
    [
        {"center": [1e38, 0, 0]},
        {"center": [0, 0, -1e38]},
        {"center": [0, 0, -1e30], "fx": 1e30, "fy": 1e30},
        {"fx": 1e300, "fy": 1e300},
        {"fx": 1e-300, "fy": 1e-300},
        {"cx": 1e300},
        {"width": 10**18, "height": 10**18, "cx": 5e17, "cy": 5e17, "fx": 1e18, "fy": 1e18},
        {"near": 1e-300},
        {"near": 1e30, "far": 1e31},
        {"far": 1e-300},
    ],
)
def test_a_camera_beyond_all_reason_does_not_spoil_what_others_see(changes, settings):
    """One of four, at 1e38, of 1e300 px, with planes where nothing is."""
    splats = cloud()
    views = ViewSet((view(), view([0.1, 0, 0]), view([0, 0.1, 0]), view(**changes)))

    check(splats, scored(splats, views, settings))


@by_method
def test_views_of_weight_zero_change_nothing(settings):
    """To the bit; they do not count as used."""
    splats = cloud()
    two = ViewSet((view(), view([0.1, 0, 0])))
    three = ViewSet((two[0], view([0, 0.2, 0], weight=0.0), two[1]))

    scores = scored(splats, three, settings)

    np.testing.assert_array_equal(scores.values, scored(splats, two, settings).values)
    assert scores.views_used == 2


@pytest.mark.parametrize("settings", [METHODS["closed form"], *READINGS.values()])
def test_identical_splats_tie(settings):
    """Same values, same score, so that the first in the file goes first."""
    splats = cloud(1).take(np.zeros(50, int))

    scores = scored(splats, settings=settings)

    assert len(set(scores.values.tolist())) == 1
    assert np.flatnonzero(~select(scores, Budget(keep=30))).tolist() == list(range(20))


def test_identical_splats_hide_each_other_where_occlusion_counts():
    """They lie in the order of the file, as renderers draw them: each has a place, always its."""
    splats = cloud(1).take(np.zeros(50, int))
    settings = METHODS["occlusion"]

    values = scored(splats, settings=settings).values

    np.testing.assert_allclose(np.sort(values), np.arange(1, 51) / 50, rtol=1e-6)
    np.testing.assert_array_equal(values, scored(splats, settings=settings).values)


@pytest.mark.parametrize(
    ("statistics", "expected"),
    [
        ((1.0, 0.0, 0.0), (1 / 3, 1 / 3, 1 / 3)),  # round, one grey, opacity 0 or 1
        ((1.0, 1e-33, 0.0), (1 / 3, 1 / 3, 1 / 3)),  # what rounding leaves of a variance
        ((1.0, 0.0, 0.5), (0.0, 0.0, 1.0)),
        ((1e6, 0.0, 0.0), (1.0, 0.0, 0.0)),
    ],
)
def test_weights_of_scenes_without_variety(statistics, expected):
    """Each lambda in [0, 1], their sum 1, equal where there is nothing to tell them apart."""
    assert lambdas(*statistics) == pytest.approx(expected)


@by_method_and_reading
def test_a_scene_without_variety_is_scored(settings):
    """Round splats of one size and one grey, all of opacity 1."""
    splats = replace(
        cloud(),
        log_scales=np.full((20, 3), -1.0, np.float32),
        opacity_logits=np.full(20, math.inf, np.float32),
        sh_dc=np.full((20, 3), 0.3, np.float32),
    )

    scores = scored(splats, settings=settings)

    check(splats, scores)
    if scores.facts.keys() == {"lambda", "statistics"}:
        assert list(scores.facts["lambda"].values()) == pytest.approx([1 / 3] * 3)


# ----- everything at once


def drawn(data, count: int = 4) -> Splats:
    """Return splats of which every number is drawn from the extremes."""
    value = st.sampled_from(EXTREME + DOUBLES) | st.floats(width=32)
    sizes = {item: getattr(cloud(count), item).shape for item in ARRAYS}
    arrays = {}
    for name, shape in sizes.items():
        size = math.prod(shape)
        numbers = np.array(data.draw(st.lists(value, min_size=size, max_size=size)), np.float64)
        if data.draw(st.booleans()):
            with np.errstate(all="ignore"):
                numbers = numbers.astype(np.float32)
        arrays[name] = numbers.reshape(shape)
    return Splats(**arrays)


def drawn_views(data) -> ViewSet:
    """Return two views, of which the first counts."""
    place = st.sampled_from([0.0, 1e-30, 0.1, 1e6, 1e30])
    return ViewSet(
        tuple(
            view(
                [data.draw(place), 0.0, -data.draw(place)],
                fx=data.draw(st.sampled_from([1.0, 50.0, 1e6])),
                near=data.draw(st.sampled_from([0.0, 1e-30, 1.0])),
                weight=data.draw(st.sampled_from(weights)),
            )
            for weights in ([1.0, 1e-3], [0.0, 1.0, 1e3])
        )
    )


@pytest.mark.parametrize("method", [*METHODS, "a reading"])
@given(data=st.data())
def test_any_values_at_once_give_finite_scores_or_a_sentence(method, data):
    """Every number of every attribute drawn from the extremes, and the views' too."""
    splats, views = drawn(data), drawn_views(data)
    settings = METHODS.get(method) or data.draw(st.sampled_from([*READINGS.values()]))
    try:
        scores = scored(splats, views, settings)
    except RefineError as error:
        said = str(error)
    else:
        check(splats, scores)
        return
    assert "no camera sees" in said or "can be drawn" in said


def check_merged(splats, result, count):
    """Assert what holds of kept splats: they can be drawn, or are what they were."""
    assert len(result.splats) == count == np.count_nonzero(result.keep)
    assert drawable(result.splats.take(result.changed)).all()
    alphas = opacity(result.splats.opacity_logits[result.changed])
    assert ((alphas > 0) & (alphas < 1)).all()
    logs = result.splats.log_scales[result.changed]
    assert np.isfinite(logs).all()  # every axis of a covariance is positive
    for item in ARRAYS:
        np.testing.assert_array_equal(
            getattr(result.splats, item)[~result.changed],
            getattr(splats, item)[result.keep][~result.changed],
        )


@pytest.mark.slow
@examples(max_examples=25)
@given(data=st.data(), count=st.integers(1, 8))
def test_any_values_at_once_merge_and_stay_splats(data, count):
    """Extreme splats among good ones; kept splats are as many as asked for."""
    some, good = drawn(data, 4), cloud(12, data.draw(st.integers(0, 99)))
    splats = Splats(
        **{item: np.concatenate([getattr(some, item), getattr(good, item)]) for item in ARRAYS}
    )

    try:
        result = merge_down(splats, drawn_views(data), count, threads=1)
    except RefineError as error:
        if "no camera sees the splats" not in str(error):
            raise
    else:
        check_merged(splats, result, count)


@pytest.mark.slow
@pytest.mark.parametrize("name", ARRAYS)
def test_one_extreme_splat_among_good_ones_merges(name):
    """Any attribute, any value; half of the splats go."""
    views = ViewSet((view(), view([0.1, 0, 0])))
    for value in EXTREME:
        splats = with_first(name, value)

        result = merge_down(splats, views, 10, threads=1)

        check_merged(splats, result, 10)


# ----- what must not matter


@pytest.mark.slow
@by_method
@pytest.mark.parametrize("exponent", [-30, -12, -6, -3, 0, 3, 6, 12, 30])
def test_the_ranking_is_the_same_in_nanometres_and_in_light_years(exponent, settings):
    """Means, scales and view centres times 10^exponent, in float64."""
    splats = cloud(200)
    factor = 10.0**exponent
    scaled = replace(
        splats,
        means=splats.means.astype(float) * factor,
        log_scales=splats.log_scales.astype(float) + math.log(factor),
    )
    views = ViewSet((view(), view([0.2, 0.1, -0.5])))
    moved = ViewSet((view(), view(np.array([0.2, 0.1, -0.5]) * factor)))

    check_alike(scored(scaled, moved, settings), scored(splats, views, settings))


def check_alike(one, other):
    """Assert equal scores, but for rounding: 1e-5, or of a ranking one swap of neighbours."""
    tolerance = {"rtol": 1e-5} if "lambda" in one.facts else {"atol": 1.5 / len(one.values)}
    np.testing.assert_allclose(one.values, other.values, **tolerance)


@by_method
def test_detail_of_a_millimetre_survives_a_million_metres_from_the_origin(settings):
    """Georeferenced scans come as doubles: offsets are taken from the views in float64 first."""
    splats = cloud(200)
    near = replace(
        splats,
        means=splats.means.astype(float) * 1e-3,
        log_scales=splats.log_scales + math.log(1e-3),
    )
    shift = np.array([4e6, -1e6, 2e6])
    far = replace(near, means=near.means + shift)

    expected = scored(near, ViewSet((view([0, 0, 1e-4]),)), settings)
    scores = scored(far, ViewSet((view(shift + np.array([0, 0, 1e-4])),)), settings)

    check_alike(scores, expected)


@pytest.mark.slow
def test_the_size_of_the_pieces_of_work_changes_nothing_with_occlusion(monkeypatch):
    """Splats and points a few at a time, on one thread or on three: whole columns, so no sum."""
    splats, views = cloud(300), ViewSet(tuple(view([x, 0, 0]) for x in (-0.2, 0.0, 0.1, 0.3)))
    settings = Occlusion()
    expected = score(splats, views, settings, threads=1)
    kept = merge_down(splats, views, 100, threads=1)
    for module, name, size in (
        (points, "_BLOCK", 50),
        (projection, "_CHUNK", 7),
        (merge_field, "_CHUNK", 11),
        (merge_graph, "_CHUNK", 13),
    ):
        monkeypatch.setattr(module, name, size)

    for threads in (1, 3):
        scores = score(splats, views, settings, threads=threads)
        again = merge_down(splats, views, 100, threads=threads)

        np.testing.assert_allclose(scores.values, expected.values, atol=1.5 / 300)
        np.testing.assert_array_equal(scores.seen, expected.seen)
        np.testing.assert_array_equal(again.keep, kept.keep)
        for item in ARRAYS:
            np.testing.assert_allclose(
                getattr(again.splats, item), getattr(kept.splats, item), rtol=1e-5
            )


# ----- fifty digits


def square_of_views() -> ViewSet:
    """Return four views whose geometric median is, by symmetry, the middle of their rectangle."""
    return ViewSet(tuple(view([x, y, -1.0]) for x in (-0.5, 0.5) for y in (-0.25, 0.25)))


def reference(splats: Splats, views: ViewSet) -> list:
    """Evaluate the closed form but for neighbourhoods, in 50 digits."""
    mpmath.mp.dps = 50
    real = mpmath.mpf
    middle = [real(0), real(0), real(-1)]  # of `square_of_views`
    spread = real("0.3125")  # .5^2 + .25^2
    places = [[real(float(x)) for x in mean] for mean in splats.means]
    squared = [
        sum((a - b) ** 2 for a, b in zip(place, middle, strict=True)) + spread for place in places
    ]
    ordered = sorted(squared)
    count = len(splats)
    size2 = (ordered[(count - 1) // 2] + ordered[count // 2]) / 2  # the square of the median's root
    eta = real("0.005") * size2
    near = real("0.01") * mpmath.sqrt(size2)
    terms, lumas, alphas, ratios = [], [], [], []
    for i, place in enumerate(places):
        total = real(0)
        s = sorted(mpmath.exp(real(float(x))) for x in splats.log_scales[i])
        for one in views:
            x, y, z = (a - real(float(b)) for a, b in zip(place, one.center, strict=True))
            slopes = [real(one.fx) * 2 / one.width, real(one.fy) * 2 / one.height]
            across = max(slopes[0] * abs(x), slopes[1] * abs(y), z)
            share = 1 - (across - z) / (2 * s[2] * mpmath.sqrt(1 + slopes[0] * slopes[1]))
            if z < near or share <= 0:
                continue
            total += share / (across * across + eta) / len(views)
        if not total:
            total = real("1e-6") / (squared[i] + eta)
        alpha = 1 / (1 + mpmath.exp(-real(float(splats.opacity_logits[i]))))
        weight = alpha * total
        color = [
            min(max(real(float(c)) / (2 * mpmath.sqrt(mpmath.pi)) + real("0.5"), 0), 1)
            for c in splats.sh_dc[i]
        ]
        luma = sum(real(k) * c for k, c in zip(("0.299", "0.587", "0.114"), color, strict=True))
        terms.append((weight * s[1] * s[2], weight * luma**2, weight * alpha**2))
        lumas.append(luma)
        alphas.append(alpha)
        ratios.append(min(s[2] / s[0], real(10) ** 6))
    mean_luma = sum(lumas) / count
    f_gem = sum(ratios) / count
    raw = [
        max(mpmath.log(f_gem), 0) / real("10.73"),
        100 * sum((luma - mean_luma) ** 2 for luma in lumas) / count / real("56.06"),
        100 * sum(4 * a * (1 - a) for a in alphas) / count / real("100.67"),
    ]
    means = [sum(term[k] for term in terms) / count for k in range(3)]
    return [
        sum(raw[k] / sum(raw) * term[k] / means[k] if means[k] else 0 for k in range(3))
        for term in terms
    ]


@pytest.mark.parametrize("spread", [1e-30, 1e-3, 1.0, 1e3, 1e10, 1e30])
@pytest.mark.parametrize("steep", [1.0, 10.0, 30.0, 100.0])
def test_scores_equal_fifty_digits_over_the_range(spread, steep):
    """Positions to 1e30, log scales to +-88 and opacity logits to +-100."""
    rng = np.random.default_rng(4)
    splats = replace(
        cloud(15),
        means=(rng.normal(size=(15, 3)) * spread).astype(np.float32),
        log_scales=np.clip(rng.normal(size=(15, 3)) * steep, -88, 88).astype(np.float32),
        opacity_logits=np.clip(rng.normal(size=15) * steep, -100, 100).astype(np.float32),
    )
    views = square_of_views()
    expected = np.array([float(v) for v in reference(splats, views)])
    values = scored(splats, views, {"local": False}).values

    normal = expected > 1e-37  # below, float32 has no digits left and the floor takes over
    np.testing.assert_allclose(values[normal], expected[normal], rtol=1e-5)
    assert (values[~normal] <= 2e-37).all()
