"""Numbers at the extremes: the rows of docs/numerics.md."""

import math
from dataclasses import replace
from functools import partial

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
    ViewSet,
    execute,
    score,
    select,
)
from refine_addon.core.scoring import closed_form, occlusion
from refine_addon.core.scoring.closed_form import lambdas
from refine_addon.core.splats import ARRAYS, drawable

from .test_affine import TURN
from .test_closed_form import beside_their_neighbours, reference
from .test_invariance import moved
from .test_occlusion import cloud as round_cloud
from .test_views import view

EXTREME = [
    *(math.nan, math.nan, math.inf, math.inf, -math.inf, -math.inf, 0.0, 1e-45, 1e-38, -1e-30),
    *(88.0, -88.0, 1e3, -1e3, 1e20, 1e30, -1e30, 3.4e38, -3.4e38),
]
DOUBLES = [1e-320, -1e-310, 1e-200, 1e100, -1e200, 1e308]
METHODS = {"closed form": ClosedForm(), "occlusion": Occlusion()}
TWO = ViewSet((view(), view([0.1, 0, 0])))
by_method = pytest.mark.parametrize("settings", METHODS.values(), ids=METHODS)
by_method_and_floor = pytest.mark.parametrize(
    "settings", [*METHODS.values(), None], ids=[*METHODS, "floor"]
)


@pytest.fixture(autouse=True)
def _raise_on_every_numpy_warning():
    with np.errstate(all="raise"):
        yield


def cloud(count: int = 20) -> Splats:
    """Splats before the views, in float32."""
    splats = round_cloud(count)
    splats = replace(splats, means=splats.means * 0.3 + [0, 0, 3])
    return Splats(**{name: getattr(splats, name).astype(np.float32) for name in ARRAYS})


def scored(splats, views=TWO, settings=METHODS["closed form"]):
    """In this thread: NumPy's flags are raised in it alone. None is the floor of occlusion."""
    if settings is None:
        return execute.within(cores=1)(closed_form.score)(splats, views, prior=True)
    return score(splats, views, settings, threads=1)


def check(splats, scores):
    """What holds for every input: finite, not negative, lowest if undrawable."""
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


@pytest.mark.slow
@by_method_and_floor
@pytest.mark.parametrize("name", ARRAYS)
def test_one_extreme_splat_spoils_neither_itself_nor_the_others(name, settings):
    """Any value, floats and doubles, in all numbers of an attribute of the first or in one.

    If the first cannot be drawn, the others keep their order; by occlusion in one round:
    how many go in each depends on their number.
    """
    once, alone = isinstance(settings, Occlusion), cloud().take(slice(1, None))
    one_round = execute.within(cores=1)(partial(occlusion.score, views=TWO, rounds=1))
    expected = (one_round(alone)[0] if once else scored(alone, settings=settings)).values
    cases = [(value, np.float32) for value in EXTREME] + [(value, np.float64) for value in DOUBLES]
    for number, (value, kind) in enumerate(cases):
        values = getattr(cloud(), name).astype(kind)
        column = number // 2 % values[0].size
        values[:1].reshape(-1)[column if number % 2 else slice(None)] = value
        splats = replace(cloud(), **{name: values})
        scores = scored(splats, settings=settings)
        check(splats, scores)
        if not drawable(splats)[0]:
            rest = (one_round(splats)[0] if once else scores).values[1:]
            assert np.argsort(rest).tolist() == np.argsort(expected).tolist()
            if not once:
                np.testing.assert_allclose(rest / rest[0], expected / expected[0], rtol=1e-6)


@by_method
def test_a_splat_is_seen_by_a_view_that_holds_its_centre_edges_and_planes_included(settings):
    """A 90 degree view holds what has |x| <= z. Without a near plane .01 of the scene's size is it.

    Of scale 1 each, all reach into the image and hold the camera.
    """
    beside = [[0, 0, 2], [2, 0, 2], [2.01, 0, 2], [0, -2.01, 2], [0, 0, -2], [0, 0, 0.001]]
    along = [[0, 0, z] for z in (-1e30, -1e-3, 0, 1e-30, 1, 2, 3, 4)]
    for places, planes, expected in (
        (beside, {}, [1, 1, 0, 0, 0, 0]),
        (along, {}, [0, 0, 0, 0, 1, 1, 1, 1]),
        (along, {"near": 2.0, "far": 3.0}, [0, 0, 0, 0, 0, 1, 1, 0]),
    ):
        splats = replace(cloud(len(places)), means=np.array(places, np.float32))
        splats.log_scales[:] = 0.0
        scores = scored(splats, ViewSet((view(**planes),)), settings)
        check(splats, scores)
        assert scores.seen.tolist() == expected


@by_method
@pytest.mark.parametrize(
    ("splats", "message"),
    [
        (replace(cloud(), means=-cloud().means), "no camera sees the splats"),
        (cloud(0), "there are no splats to score"),
        (replace(cloud(), opacity_logits=np.full(20, -1e3)), "none of the 20 splats can be drawn"),
    ],
)
def test_nothing_to_rank_or_to_rank_by_is_said(settings, splats, message):
    with pytest.raises(RefineError, match=message):
        scored(splats, settings=settings)


@pytest.mark.slow
@by_method
@pytest.mark.parametrize(
    "changes",
    [
        {"center": [1e38, 0, 0]},
        {"center": [0, 0, -1e30], "fx": 1e30, "fy": 1e30},
        {"fx": 1.0, "fy": 1.0},
        {"fx": 1e6, "fy": 1e6, "width": 10**6, "height": 10**6, "cx": 5e5, "cy": 5e5},
        {"fx": 1e300, "fy": 1e300},
        {"fx": 1e-300, "fy": 1e-300},
        {"cx": 1e300},
        {"width": 10**18, "height": 10**18, "cx": 5e17, "cy": 5e17, "fx": 1e18, "fy": 1e18},
        {"near": 1e30, "far": 1e31},
        {"far": 1e-300},
    ],
)
def test_a_camera_beyond_all_reason_does_not_spoil_what_others_see(changes, settings):
    splats = cloud()
    check(splats, scored(splats, ViewSet((*TWO, view([0, 0.1, 0]), view(**changes))), settings))


def test_identical_splats_tie():
    """Same values, same score, so that the first in the file goes first.

    Where occlusion counts they hide each other: each has a place. One in one view scores 1.
    """
    splats = cloud(1).take(np.zeros(50, int))
    for settings in METHODS.values():
        alone = scored(splats.take(slice(1)), ViewSet((view(),)), settings)
        assert alone.values == pytest.approx([1.0])
    for settings in (METHODS["closed form"], None):
        scores = scored(splats, settings=settings)
        assert len(set(scores.values.tolist())) == 1
        assert np.flatnonzero(~select(scores, Budget(keep=30))).tolist() == list(range(20))
    values, again = (scored(splats, settings=METHODS["occlusion"]).values for _ in range(2))
    np.testing.assert_allclose(np.sort(values), np.arange(1, 51) / 50, rtol=1e-6)
    np.testing.assert_array_equal(values, again)


@pytest.mark.parametrize(
    ("statistics", "expected"),
    [
        ((1.0, 1e-33, 0.0), (1 / 3, 1 / 3, 1 / 3)),  # round, one grey but for rounding, opacity 0
        ((1.0, 0.0, 0.5), (0.0, 0.0, 1.0)),
        ((1e6, 0.0, 0.0), (1.0, 0.0, 0.0)),
    ],
)
def test_weights_of_scenes_without_variety(statistics, expected):
    """Each in [0, 1], their sum 1, equal where there is nothing to tell them apart."""
    assert lambdas(*statistics) == pytest.approx(expected)


@pytest.mark.slow
@by_method_and_floor
@examples(max_examples=30)
@given(numbers=st.lists(st.sampled_from(EXTREME + DOUBLES) | st.floats(width=32), min_size=40),
       seed=st.integers(0, 2**32))  # fmt: skip
def test_any_values_at_once_give_finite_scores_or_a_sentence(settings, numbers, seed):
    """In all attributes of four splats, floats or doubles; of two views the first counts."""
    random, arrays, views = np.random.default_rng(seed), {}, []
    for name in ARRAYS:
        values = random.choice(numbers, getattr(cloud(4), name).shape)
        with np.errstate(all="ignore"):
            arrays[name] = values.astype(random.choice([np.float32, np.float64]))
    for weights in ([1.0, 1e-3], [0.0, 1.0, 1e3]):
        choices = {"fx": [1.0, 50.0, 1e6], "near": [0.0, 1e-30, 1.0], "weight": weights}
        chosen = {name: random.choice(some) for name, some in choices.items()}
        x, z = random.choice([0.0, 1e-30, 0.1, 1e6, 1e30], 2)
        views.append(view([x, 0.0, -z], **chosen))
    splats = Splats(**arrays)
    try:
        check(splats, scored(splats, ViewSet(tuple(views)), settings))
    except RefineError as error:
        assert any(said in str(error) for said in ("no camera sees", "can be drawn"))


@pytest.mark.slow
@by_method
@pytest.mark.parametrize("exponent", [-29, -3, 3, 28])
def test_neither_order_nor_place_nor_unit_of_the_scene_matter(exponent, settings):
    """From nanometres to light years; in float64, which moves no splat.

    Nor do details of a millimetre get lost a million metres from the origin, as of scans.
    """
    splats = cloud(200)
    splats = replace(splats, means=splats.means.astype(float))
    other = view([0.2, 0.1, -0.5], far=4.0, name="b")
    views = ViewSet((view(name="a"), other, view([0, 0, 2], near=0.5, name="c")))
    order, step = np.random.default_rng(3).permutation(200), np.array([4e9, -1e9, 2e9])
    there = moved(splats.take(order), tuple(views)[::-1], TURN, step, 10.0**exponent)
    found = scored(*there, settings)
    expected = scored(splats, views, settings).values[order]
    # But for rounding, or, of a ranking, one swap of neighbours.
    tolerance = {"rtol": 2e-5} if "lambda" in found.facts else {"atol": 1.5 / 200}
    np.testing.assert_allclose(found.values, expected, **tolerance)


@pytest.mark.parametrize("spread", [1e-30, 1e-3, 1.0, 1e3, 1e10, 1e30])
@pytest.mark.parametrize("steep", [1.0, 10.0, 30.0, 100.0])
def test_scores_equal_fifty_digits_over_the_range(spread, steep):
    """The geometric median of four views is, by symmetry, the middle of their rectangle."""
    mpmath.mp.dps = 50
    rng = np.random.default_rng(4)
    splats = replace(
        cloud(15),
        means=(rng.normal(size=(15, 3)) * spread).astype(np.float32),
        log_scales=np.clip(rng.normal(size=(15, 3)) * steep, -88, 88).astype(np.float32),
        opacity_logits=np.clip(rng.normal(size=15) * steep, -100, 100).astype(np.float32),
    )
    views = ViewSet(tuple(view([x, y, -1.0]) for x in (-0.5, 0.5) for y in (-0.25, 0.25)))
    middle = (0.0, 0.0, -1.0), 0.5**2 + 0.25**2
    expected = np.array([float(v) for v in reference(splats, views, middle, real=mpmath.mpf)])
    expected = beside_their_neighbours(expected, splats.means - np.array(middle[0]), middle[1])
    values = scored(splats, views).values
    normal = expected > 1e-37  # below, float32 has no digits left and the floor takes over
    np.testing.assert_allclose(values[normal], expected[normal], rtol=1e-5)
    assert (values[~normal] <= 2e-37).all()
