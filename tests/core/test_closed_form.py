"""The closed form against numbers by hand, a plain reference, and its laws."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from refine_addon.core import RefineError, Splats, View, ViewSet
from refine_addon.core.scoring import closed_form
from refine_addon.core.visibility.frustum import Frustums
from refine_addon.core.visibility.scene import principal_axes

READINGS = [
    {},
    {"depth": "distance"},
    {"frustum": False},
    {"local": False},
    {"depth": "distance", "local": False},
    {"depth": "distance", "frustum": False, "local": False},
]


def splats_of(means, logits, logs, dc=None) -> Splats:
    means = np.array(means, np.float32).reshape(-1, 3)
    count = len(means)
    return Splats(
        means=means,
        log_scales=np.broadcast_to(np.array(logs, np.float32), (count, 3)).copy(),
        quaternions=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        opacity_logits=np.broadcast_to(np.array(logits, np.float32), (count,)).copy(),
        sh_dc=np.zeros((count, 3), np.float32) if dc is None else np.array(dc, np.float32),
        sh_rest=np.zeros((count, 0, 3), np.float32),
    )


def view_at(center=(0.0, 0.0, 0.0), rotation=None, **changes) -> View:
    values = {"fx": 50.0, "fy": 50.0, "cx": 50.0, "cy": 50.0, "width": 100, "height": 100}
    return View(np.eye(3) if rotation is None else rotation, np.array(center), **values | changes)


def random_scene(seed: int, count: int = 300, view_count: int = 5) -> tuple[Splats, ViewSet]:
    rng = np.random.default_rng(seed)
    splats = Splats(
        means=rng.normal(size=(count, 3)).astype(np.float32) * 2,
        log_scales=rng.normal(-3, 1.5, size=(count, 3)).astype(np.float32),
        quaternions=rng.normal(size=(count, 4)).astype(np.float32),
        opacity_logits=rng.normal(0, 3, size=count).astype(np.float32),
        sh_dc=rng.normal(size=(count, 3)).astype(np.float32),
        sh_rest=rng.normal(size=(count, 3, 3)).astype(np.float32),
    )
    views = [view_at([0, 0, -6])]  # sees nearly all, so that no scene is unseen
    for index in range(1, view_count):
        rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        views.append(
            view_at(
                rng.normal(size=3) * 3,
                rotation,
                cx=rng.uniform(20, 80),
                fy=rng.uniform(30, 70),
                cy=rng.uniform(10, 50),
                height=60,
                weight=rng.uniform(0.1, 2),
                near=rng.choice([0.0, 0.5]),
                far=rng.choice([4.0, math.inf]),
                name=str(index),
            )
        )
    return splats, ViewSet(tuple(views))


def middle_of(views: ViewSet) -> tuple[np.ndarray, float]:
    """Weiszfeld's iteration for the geometric median, and the weighted median from there."""
    weights = [view.weight / sum(view.weight for view in views) for view in views]
    middle = sum(w * v.center for w, v in zip(weights, views, strict=True))
    for _ in range(2000):
        pulls = [w / np.linalg.norm(v.center - middle) for w, v in zip(weights, views, strict=True)]
        middle = sum(k * v.center for k, v in zip(pulls, views, strict=True)) / sum(pulls)
    away = sorted(zip([float(np.sum((v.center - middle) ** 2)) for v in views], weights,
                      strict=True))  # fmt: skip
    passed = itertools.accumulate(weight for _, weight in away)
    return middle, next(d for (d, _), p in zip(away, passed, strict=True) if p >= 0.5)


def reference(splats, views, depth="z", frustum=True, local=True) -> np.ndarray:
    """Evaluate the formulas of docs/method.md one splat and one view at a time, in float64."""
    count = len(splats)
    weights = [view.weight / sum(view.weight for view in views) for view in views]
    means = splats.means.astype(float)
    middle, spread = middle_of(views)
    squared = [float(np.sum((p - middle) ** 2)) + spread for p in means]
    size = math.sqrt(float(np.median(squared)))
    eta = 0.005 * size**2
    alpha = [1 / (1 + math.exp(-float(x))) for x in splats.opacity_logits]
    colors = np.clip(0.28209479177387814 * splats.sh_dc.astype(float) + 0.5, 0, 1)
    luma = [0.299 * r + 0.587 * g + 0.114 * b for r, g, b in colors]
    terms = np.zeros((3, count))
    ratios = []
    for i in range(count):
        s = sorted(math.exp(float(x)) for x in splats.log_scales[i])
        ratios.append(min(s[2] / s[0], 1e6))
        weight = 0.0
        for w, view in zip(weights, views, strict=True):
            x, y, z = view.rotation @ (means[i] - view.center)
            share, across = 1.0, z
            if frustum:
                near = view.near if view.near > 0 else 0.01 * size
                if not (near <= z <= view.far):
                    continue
                half_x, half_y = view.width / 2, view.height / 2
                edge_x = abs(view.fx * x + (view.cx - half_x) * z) / half_x
                edge_y = abs(view.fy * y + (view.cy - half_y) * z) / half_y
                across = max(edge_x, edge_y, z)
                steepness = math.sqrt(1 + view.fx * view.fy / (half_x * half_y))
                share = 1 - (across - z) / (2 * s[2] * steepness)
                if share <= 0:
                    continue
            d2 = across * across if depth == "z" else x * x + y * y + z * z
            weight += w * share / (d2 + eta)
        if weight == 0:
            weight = 1e-6 / (squared[i] + eta)
        weight *= alpha[i]
        terms[:, i] = weight * s[1] * s[2], weight * luma[i] ** 2, weight * alpha[i] ** 2
    raw = np.array(
        [
            math.log(np.mean(ratios)) / 10.73,
            100 * np.var(luma) / 56.06,
            100 * np.mean([4 * a * (1 - a) for a in alpha]) / 100.67,
        ]
    )
    scores = raw / raw.sum() @ (terms / terms.mean(axis=1, keepdims=True))
    if not local:
        return scores
    offset = means - middle
    weighted = offset / np.array(squared)[:, None]
    axes = principal_axes(np.vstack([weighted.T @ offset, weighted.sum(axis=0)]))
    return beside_their_neighbours(scores, offset @ axes.T / size)


def beside_their_neighbours(scores, place) -> np.ndarray:
    """Divide each score by a power of the mean in its cell, of 64 along each axis of a ball."""
    ball = place / (1 + np.linalg.norm(place, axis=1, keepdims=True))
    cells = defaultdict(list)
    for i, cell in enumerate(np.floor((ball + 1) * 32).astype(int)):
        cells[tuple(cell)].append(i)
    overall, changed = scores.mean(), scores.copy()
    for members in cells.values():
        mean = scores[members].mean() / overall
        for i in members:
            weight = scores[i] / (scores[i] + 0.05 * overall)
            changed[i] = scores[i] / mean ** (weight / 2)
    return changed


@pytest.mark.parametrize("settings", READINGS)
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_scores_equal_a_plain_reference_for_every_setting(seed, settings):
    """The stored score is float32, so 1e-5 leaves room for its rounding (6e-8) and no more."""
    splats, views = random_scene(seed)
    expected = reference(splats, views, **settings)

    scores = closed_form.score(splats, views, **settings)

    np.testing.assert_allclose(scores.values, expected, rtol=1e-5)


def three_splats() -> tuple[Splats, ViewSet]:
    """Three splats on the axis of one view at depths 1, 2 and 3, opacity 1/2, black, grey, white.

    Scales e^0 = 1 along each axis of the first, so that area 1; 2, 2, 1 of the second: area 4;
    3, 1, 1 of the third: area 3. Grey is f_dc = 0; +-10 clips to white and black.
    """
    logs = np.log([[1, 1, 1], [2, 2, 1], [3, 1, 1]])
    dc = [[-10] * 3, [0] * 3, [10] * 3]
    splats = splats_of([[0, 0, 1], [0, 0, 2], [0, 0, 3]], [0.0, 0.0, 0.0], logs, dc)
    return splats, ViewSet((view_at(),))


def test_only_splats_inside_the_frustum_are_seen():
    """A 90 degree view sees the centres with |x| <= z; near is .01 of the size of the scene.

    Of scale 1 each, all reach into the image: that is no part of being seen.
    """
    places = [[0, 0, 2], [2, 0, 2], [2.01, 0, 2], [0, -2.01, 2], [0, 0, -2], [0, 0, 0.001]]
    splats = splats_of(places, 0.0, 0.0)

    scores = closed_form.score(splats, ViewSet((view_at(),)))

    assert scores.seen.tolist() == [1, 1, 0, 0, 0, 0]


def test_a_splat_counts_by_the_share_inside_of_its_two_standard_deviations(monkeypatch):
    """A 90 degree view, splats at depth 2 and x = 2, 3, 4, 5 whose longest axis is s.

    The side of the frustum is the plane x = z, which lies (x - z) / sqrt(2) away: with s =
    sqrt(2) / 2, twice which is sqrt(2), a splat with x - z = 1 is half outside of its reach and
    one with x - z = 2 just out of it. H is share / max(x, z)^2, eta being next to nothing, so
    1/4 and (1/2) / 9. Those out of reach have the millionth of what no view sees.
    """
    places = [[x, 0, 2] for x in (2, 3, 4, 5)]
    splats = splats_of(places, 0.0, np.log([0.1, np.sqrt(0.5), 0.1]))
    monkeypatch.setattr(closed_form, "ETA_RELATIVE", 1e-12)

    values = closed_form.score(splats, ViewSet((view_at(),)), local=False).values

    assert values[1] / values[0] == pytest.approx((1 / 2 / 9) / (1 / 4), rel=1e-5)
    assert (values[2:] < 1e-5 * values[1]).all()


def test_a_splat_around_the_camera_does_not_outshine_what_is_in_the_image(monkeypatch):
    """A wide splat whose centre lies just before the camera, far to the side of the image.

    Its depth of .05 alone would give it 1 / .05^2 = 400; where the image is wide enough to show its
    centre, the depth is 3, so that at most 1 / 9 remains of it.
    """
    splats = splats_of([[0, 0, 3], [3, 0, 0.05]], 0.0, np.log([1.0, 4.0, 1.0]))
    monkeypatch.setattr(closed_form, "ETA_RELATIVE", 1e-12)

    values = closed_form.score(splats, ViewSet((view_at(near=0.01),)), local=False).values

    assert 0.0 < values[1] < values[0]


def crowd() -> tuple[Splats, ViewSet]:
    """Return 50 splats close together, each as good as the next, and one alone, half as opaque.

    All are at the same depth, of the same size and colour.
    """
    rng = np.random.default_rng(2)
    means = np.column_stack([rng.uniform(0.1, 0.11, (50, 2)), np.full(50, 2.0)])
    alphas = np.append(np.full(50, 0.6), 0.5)
    logits = np.log(alphas / (1 - alphas))
    splats = splats_of(np.vstack([means, [[-1.0, -1.0, 2.0]]]), logits, -5.0)
    return splats, ViewSet((view_at(),))


def test_a_splat_alone_gains_on_those_of_a_crowd():
    """Scores a bit below the mean of all stand out less where those around are as low.

    Of 50 equal ones the mean is their own score d, and alone it is the splat's own, e. So the
    scores become d^(1 - w/2) and e^(1 - w/2) with w near 1, and e / d comes nearer to 1.
    """
    splats, views = crowd()

    plain = closed_form.score(splats, views, local=False).values
    values = closed_form.score(splats, views).values

    assert plain[50] < 0.9 * plain[:50].min()
    assert values[50] / values[:50].min() > (plain[50] / plain[:50].min()) ** 0.6


def test_near_and_far_of_the_view_are_honoured():
    """Depths 1 and 4 lie outside 2 .. 3; both planes belong to the inside."""
    splats = splats_of([[0, 0, 1], [0, 0, 2], [0, 0, 3], [0, 0, 4]], 0.0, 0.0)
    views = ViewSet((view_at(near=2.0, far=3.0),))

    assert closed_form.score(splats, views).seen.tolist() == [0, 1, 1, 0]


def test_what_no_view_sees_ranks_below_all_that_is_seen_and_nearer_above_farther():
    """Behind the view: the prior orders by distance, a millionth of what is seen."""
    splats = splats_of([[0, 0, -9], [0, 0, 90], [0, 0, -3]], 0.0, -3.0)

    values = closed_form.score(splats, ViewSet((view_at(),))).values

    assert values.argsort().tolist() == [0, 2, 1]


def test_a_view_of_twice_the_weight_counts_as_two():
    """The mean over views is weighted, so doubling a view and doubling its weight agree."""
    splats, views = random_scene(3, view_count=3)
    first = views[0]
    double = ViewSet((replace(first, weight=2 * first.weight), *views.views[1:]))
    twice = ViewSet((first, *views.views))

    np.testing.assert_allclose(
        closed_form.score(splats, double).values, closed_form.score(splats, twice).values, rtol=1e-6
    )


@given(st.integers(0, 2**32 - 1), st.randoms(use_true_random=False))
def test_permuting_the_splats_permutes_the_scores(seed, random):
    """Nothing depends on the order but the last bits of the sums over the scene."""
    splats, views = random_scene(seed, count=40)
    order = list(range(40))
    random.shuffle(order)

    expected = closed_form.score(splats, views).values[order]

    values = closed_form.score(splats.take(np.array(order)), views).values
    np.testing.assert_allclose(values, expected, rtol=1e-6)


@given(st.integers(0, 2**32 - 1))
def test_the_order_of_views_changes_nothing(seed):
    """The mean over views is a sum in float64."""
    splats, views = random_scene(seed, count=40)

    np.testing.assert_allclose(
        closed_form.score(splats, views.take([3, 0, 4, 1, 2])).values,
        closed_form.score(splats, views).values,
        rtol=1e-6,
    )


@given(st.integers(0, 2**32 - 1), st.floats(-6, 6), st.booleans())
def test_scaling_moving_and_turning_the_scene_keeps_the_scores(seed, exponent, mirrored):
    """Score, ranking and lambda have no unit: a scene in nanometres ranks like one in kilometres.

    The moved means are float64 here; float32 would move the splats themselves.
    """
    splats, views = random_scene(seed, count=60)
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn)) * (-1 if mirrored else 1)
    scale = 10.0**exponent
    shift = rng.normal(size=3) * scale * 10
    moved = replace(
        splats,
        means=scale * splats.means.astype(float) @ turn.T + shift,
        log_scales=splats.log_scales.astype(float) + math.log(scale),
    )
    there = ViewSet(
        tuple(
            replace(
                view,
                rotation=view.rotation @ turn.T,
                center=scale * turn @ view.center + shift,
                near=view.near * scale,
                far=view.far * scale,
            )
            for view in views
        )
    )

    here = closed_form.score(splats, views)
    scores = closed_form.score(moved, there)

    np.testing.assert_allclose(scores.values, here.values, rtol=2e-5)
    assert scores.facts["lambda"] == pytest.approx(here.facts["lambda"], rel=1e-5)


@pytest.mark.parametrize(("chunk", "threads", "block"), [(7, 1, 64), (64, 3, 2), (4096, 2, 1)])
def test_chunks_threads_and_view_blocks_change_nothing(monkeypatch, chunk, threads, block):
    """Chunks and blocks split sums of float64 differently; threads change no bit."""
    splats, views = random_scene(5)
    expected = closed_form.score(splats, views, threads=1)
    monkeypatch.setattr(closed_form, "_CHUNK", chunk)
    monkeypatch.setattr(closed_form, "_VIEW_BLOCK", block)
    monkeypatch.setattr(closed_form, "_RUN", 1 + chunk // 5)

    scores = closed_form.score(splats, views, threads=threads)

    np.testing.assert_allclose(scores.values, expected.values, rtol=1e-6)
    alone = closed_form.score(splats, views, threads=1)
    np.testing.assert_array_equal(scores.values, alone.values)
    np.testing.assert_array_equal(scores.seen, expected.seen)


def test_blocks_are_scored_side_by_side_to_the_same_bits(monkeypatch):
    """Ten blocks on three threads, and one after the other; what is told never falls."""
    splats, views = random_scene(7, count=1000, view_count=3)
    monkeypatch.setattr(closed_form, "ROWS", 100)
    expected = closed_form.score(splats, views, threads=1)
    told = []

    scores = closed_form.score(splats, views, threads=3, progress=lambda done, _: told.append(done))

    np.testing.assert_array_equal(scores.values, expected.values)
    np.testing.assert_array_equal(scores.seen, expected.seen)
    assert told == sorted(told)
    assert told[-1] > 0.9


@pytest.mark.parametrize("settings", READINGS[:2], ids=str)
def test_views_that_are_left_out_or_see_all_of_a_run_change_nothing(monkeypatch, settings):
    """The same as where every view is asked of every splat, but for the order of sums."""
    splats, views = random_scene(6, count=2000, view_count=20)
    monkeypatch.setattr(closed_form, "_RUN", 20)
    said = []

    def every(self, low, high, reach):
        said.append(look(self, low, high, reach))
        return np.ones_like(said[-1][0]), np.zeros_like(said[-1][1])

    scores = closed_form.score(splats, views, **settings)
    look = Frustums.classify
    monkeypatch.setattr(Frustums, "classify", every)
    expected = closed_form.score(splats, views, **settings)

    np.testing.assert_allclose(scores.values, expected.values, rtol=2e-7)
    np.testing.assert_array_equal(scores.seen, expected.seen)
    some, whole = (np.concatenate(each, axis=1) for each in zip(*said, strict=True))
    assert some.mean() < 0.9
    assert whole.any()


def test_views_that_see_nothing_are_refused_with_a_sentence():
    """The splat stands behind the only camera."""
    with pytest.raises(RefineError, match="no camera sees the splats"):
        closed_form.score(splats_of([[0, 0, -1]], 0.0, 0.0), ViewSet((view_at(),)))


def test_no_splats_are_refused_with_a_sentence():
    """An empty file is somebody's mistake, not a result."""
    with pytest.raises(RefineError, match="no splats"):
        closed_form.score(splats_of([], 0.0, 0.0), ViewSet((view_at(),)))


def test_a_callback_that_answers_false_cancels():
    """At any of its calls."""
    from refine_addon.core import Cancelled

    splats, views = random_scene(0)
    for last in range(2):
        calls = itertools.count()

        def progress(_fraction, _what, calls=calls, last=last):
            return next(calls) < last

        with pytest.raises(Cancelled):
            closed_form.score(splats, views, progress=progress)
