"""Numbers at the extremes: one test a row of docs/numerics.md."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from refine_addon.core import ClosedForm, RefineError, Settings, Splats, View, ViewSet, score
from refine_addon.core.adaptive import Statistics, weights
from refine_addon.core.splats import drawable

FINITE = [0.0, -0.0, 1.0, -1.0, 1e-45, 1e-38, -1e-30, 1e-3, 88.0, -88.0, 1e3, -1e3, 1e20, -1e30]
EXTREME = [*FINITE, 3.4e38, -3.4e38, math.inf, -math.inf, math.nan]
SETTINGS = [
    ClosedForm(),
    ClosedForm("distance"),
    ClosedForm.published("z"),
    ClosedForm.published("distance"),
    ClosedForm(projection=False, visibility=False),
]


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


def scored(splats, views=None, settings=ClosedForm()):  # noqa: B008 - frozen
    views = views or ViewSet((view(), view([0.1, 0, 0])))
    return score(splats, views, Settings(closed_form=settings))


def check(splats, scores):
    """Assert what holds for every input: finite, not negative, lowest if undrawable."""
    good = drawable(splats)
    assert np.isfinite(scores.values).all()
    assert (scores.values[good] > 0).all()
    assert (scores.values[~good] == 0).all()
    assert scores.undrawable == np.count_nonzero(~good)
    lambdas = list(scores.weights["lambda"].values())
    assert all(0 <= value <= 1 for value in lambdas)
    assert sum(lambdas) == pytest.approx(1)


def with_first(name: str, value: float) -> Splats:
    """Return the cloud, each number of one attribute of its first splat set to `value`."""
    splats = cloud()
    values = getattr(splats, name).copy()
    values[0] = value
    return replace(splats, **{name: values})


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("value", EXTREME)
@pytest.mark.parametrize("name", [item.name for item in fields(Splats)])
def test_one_extreme_splat_spoils_neither_itself_nor_the_others(name, value, settings):
    """Any property, any value; the order of the others is that of the scene without it."""
    splats = with_first(name, value)
    scores = scored(splats, settings=settings)

    check(splats, scores)
    if not drawable(splats)[0]:
        expected = scored(splats.take(slice(1, None)), settings=settings).values
        np.testing.assert_allclose(scores.values[1:] / scores.values[1], expected / expected[0],
                                   rtol=1e-6)  # fmt: skip


@given(data=st.data(), settings=st.sampled_from(SETTINGS))
def test_any_values_at_once_give_finite_scores_or_a_sentence(data, settings):
    """Every number of every attribute drawn from the extremes."""
    value = st.sampled_from(EXTREME) | st.floats(width=32)
    shapes = {"means": (4, 3), "log_scales": (4, 3), "quaternions": (4, 4), "sh_dc": (4, 3)}
    shapes |= {"opacity_logits": (4,), "sh_rest": (4, 3, 3)}
    arrays = {
        name: np.array(
            data.draw(st.lists(value, min_size=math.prod(shape), max_size=math.prod(shape))),
            np.float64,
        )
        .clip(-3.4e38, 3.4e38)
        .reshape(shape)
        for name, shape in shapes.items()
    }
    splats = Splats(**arrays)
    try:
        scores = scored(splats, settings=settings)
    except RefineError as error:
        said = str(error)
    else:
        check(splats, scores)
        return
    assert "no camera sees" in said or "can be drawn" in said


@pytest.mark.parametrize("exponent", [-30, -12, -6, -3, 0, 3, 6, 12, 30])
def test_the_ranking_is_the_same_in_nanometres_and_in_light_years(exponent):
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

    expected = scored(splats, views).values
    values = scored(scaled, moved).values

    np.testing.assert_allclose(values, expected, rtol=1e-5)


def test_detail_of_a_millimetre_survives_a_million_metres_from_the_origin():
    """Georeferenced scans come as doubles: offsets are taken from the views in float64 first."""
    splats = cloud(200)
    near = replace(splats, means=splats.means.astype(float) * 1e-3)
    shift = np.array([4e6, -1e6, 2e6])
    far = replace(near, means=near.means + shift)

    expected = scored(near, ViewSet((view([0, 0, 1e-4]),))).values
    values = scored(far, ViewSet((view(shift + np.array([0, 0, 1e-4])),))).values

    np.testing.assert_allclose(values, expected, rtol=1e-5)


@pytest.mark.parametrize("settings", SETTINGS)
@pytest.mark.parametrize("depth", [0.0, 1e-30, -1e-30, 1e-3, -1e-3, 1e30])
def test_depths_at_before_and_behind_the_camera_plane(depth, settings):
    """One splat at the depth, the rest before the camera."""
    splats = cloud()
    means = splats.means.copy()
    means[0] = [0, 0, depth]
    splats = replace(splats, means=means)

    check(splats, scored(splats, settings=settings))


def test_a_camera_inside_a_splat_scores_it():
    """Its centre lies at the camera's: nearer than the near plane, so the prior ranks it."""
    splats = cloud()
    means, logs = splats.means.copy(), splats.log_scales.copy()
    means[0], logs[0] = 0.0, 2.0
    splats = replace(splats, means=means, log_scales=logs)

    check(splats, scored(splats))


def test_all_splats_behind_every_camera_is_said():
    """Nothing to rank by."""
    splats = cloud()
    with pytest.raises(RefineError, match="no camera sees"):
        scored(replace(splats, means=-splats.means))


def test_one_splat_and_one_view_score_one():
    """Each term is divided by its mean, its own; three of them, weighted by lambda, make 1."""
    splats = cloud(1)

    assert scored(splats, ViewSet((view(),))).values == pytest.approx([1.0])


def test_ten_thousand_views_are_one_mean():
    """Copies of one view change nothing."""
    splats = cloud()
    many = ViewSet((view(),) * 10_000)

    values = score(splats, many, Settings(views=0)).values

    np.testing.assert_allclose(values, scored(splats, ViewSet((view(),))).values, rtol=1e-6)


@pytest.mark.parametrize("focal", [1.0, 1e6])
def test_any_focal_length(focal):
    """1 px sees nearly the half space; 1e6 px needs an image as large to see anything."""
    splats = cloud()
    views = ViewSet((view(fx=focal, fy=focal, width=10**6, height=10**6, cx=5e5, cy=5e5),))

    check(splats, scored(splats, views))


def test_identical_splats_tie():
    """Same values, same score, so that the first in the file goes first."""
    splats = cloud(1).take(np.zeros(50, int))

    assert len(set(scored(splats).values.tolist())) == 1


@pytest.mark.parametrize(
    ("statistics", "expected"),
    [
        (Statistics(1.0, 0.0, 0.0), (1 / 3, 1 / 3, 1 / 3)),  # round, one grey, opacity 0 or 1
        (Statistics(1.0, 1e-33, 0.0), (1 / 3, 1 / 3, 1 / 3)),  # what rounding leaves of a variance
        (Statistics(0.2, 0.0, 0.5), (0.0, 0.0, 1.0)),  # ln 0.2 < 0 counts as 0
        (Statistics(1e6, 0.0, 0.0), (1.0, 0.0, 0.0)),
    ],
)
def test_weights_of_scenes_without_variety(statistics, expected):
    """Each lambda in [0, 1], their sum 1, equal where there is nothing to tell them apart."""
    assert weights(statistics) == pytest.approx(expected)


def test_denormal_opacities_and_scales_are_told_from_zero():
    """Above the smallest float32 a splat can be drawn, below it cannot."""
    splats = cloud(4)
    logits, logs = splats.opacity_logits.copy(), splats.log_scales.copy()
    logits[0], logs[1] = -103.0, -103.0
    logits[2], logs[3] = -104.0, -104.0
    splats = replace(splats, opacity_logits=logits, log_scales=logs)

    assert (scored(splats).values > 0).tolist() == [True, True, False, False]


def reference(splats: Splats, views: ViewSet) -> list:
    """Evaluate the paper's reading in 50 digits."""
    mpmath.mp.dps = 50
    real = mpmath.mpf
    eta = real("0.05")
    terms, lumas, alphas, ratios = [], [], [], []
    for i in range(len(splats)):
        depths = [
            sum(
                real(float(v.rotation[2, k])) * (real(float(splats.means[i, k])) - v.center[k])
                for k in range(3)
            )
            for v in views
        ]
        alpha = 1 / (1 + mpmath.exp(-real(float(splats.opacity_logits[i]))))
        weight = alpha * sum(1 / (z * z + eta) for z in depths) / len(views)
        s = sorted(mpmath.exp(real(float(x))) for x in splats.log_scales[i])
        color = [
            min(max(real(float(c)) / (2 * mpmath.sqrt(mpmath.pi)) + real("0.5"), 0), 1)
            for c in splats.sh_dc[i]
        ]
        luma = sum(real(k) * c for k, c in zip(("0.299", "0.587", "0.114"), color, strict=True))
        terms.append((weight * s[1] * s[2], weight * luma**2, weight * alpha**2))
        lumas.append(luma)
        alphas.append(alpha)
        ratios.append(s[2] / (s[0] + eta))
    count = len(splats)
    mean_luma = sum(lumas) / count
    raw = [
        max(mpmath.log(sum(ratios) / count + eta), 0) / real("10.73"),
        100 * sum((luma - mean_luma) ** 2 for luma in lumas) / count / real("56.06"),
        100 * sum(4 * a * (1 - a) for a in alphas) / count / real("100.67"),
    ]
    means = [sum(term[k] for term in terms) / count for k in range(3)]
    return [
        sum(raw[k] / sum(raw) * term[k] / means[k] if means[k] else 0 for k in range(3))
        for term in terms
    ]


@pytest.mark.parametrize("spread", [1e-3, 1.0, 1e3, 1e10])
@pytest.mark.parametrize("steep", [1.0, 10.0, 30.0])
def test_scores_equal_fifty_digits_over_the_range(spread, steep):
    """Positions to 1e10, log scales and opacity logits to some +-60."""
    rng = np.random.default_rng(4)
    splats = replace(
        cloud(15),
        means=(rng.normal(size=(15, 3)) * spread).astype(np.float32),
        log_scales=np.clip(rng.normal(size=(15, 3)) * steep, -60, 60).astype(np.float32),
        opacity_logits=(rng.normal(size=15) * steep).astype(np.float32),
    )
    views = ViewSet((view(), view([0.5, 0.25, -1.0])))
    expected = np.array([float(value) for value in reference(splats, views)])

    values = scored(splats, views, ClosedForm.published("z")).values

    normal = expected > 1e-37  # below, float32 has no digits left and the floor takes over
    np.testing.assert_allclose(values[normal], expected[normal], rtol=1e-5)
    assert (values[~normal] <= 2e-37).all()
