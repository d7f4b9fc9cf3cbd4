"""The closed form against numbers by hand, a plain reference, and its laws."""

import itertools
import math
from collections import defaultdict
from dataclasses import replace

import mpmath
import numpy as np
import pytest

from refine_addon.core import Splats, ViewSet, execute
from refine_addon.core.scoring import closed_form
from refine_addon.core.visibility.frustum import Frustums
from refine_addon.core.visibility.scene import principal_axes

from .test_occlusion import cloud, splats_of
from .test_views import view


def random_scene(seed: int, count: int = 300) -> tuple[Splats, ViewSet]:
    splats, rng = cloud(count, seed), np.random.default_rng(seed)
    splats = replace(
        splats,
        means=(2.0 * splats.means).astype(np.float32),
        log_scales=(1.5 * splats.log_scales).astype(np.float32),
    )
    views = [
        view(
            rng.normal(size=3) * 3,
            rotation=np.linalg.qr(rng.normal(size=(3, 3)))[0],
            cx=rng.uniform(20, 80),
            fy=rng.uniform(30, 70),
            cy=rng.uniform(10, 50),
            height=60,
            weight=rng.uniform(0.1, 2),
            near=rng.choice([0.0, 0.5]),
            far=rng.choice([4.0, math.inf]),
            name=str(index),
        )
        for index in range(4)
    ]
    return splats, ViewSet((*views, view([0, 0, -6])))  # which sees nearly all


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


def reference(splats, views, middle, prior=False, real=float) -> list:
    """Evaluate the formulas of docs/method.md, but for neighbourhoods, splat by splat.

    `middle` is that of the views and their spread, `real` makes the numbers that are reckoned with.
    """
    maths, count = math if real is float else mpmath, len(splats)
    weights = [real(one.weight) / sum(real(each.weight) for each in views) for one in views]

    def offset(index, place):
        return [
            real(float(a)) - real(float(b)) for a, b in zip(splats.means[index], place, strict=True)
        ]

    squared = [sum(x * x for x in offset(i, middle[0])) + real(middle[1]) for i in range(count)]
    ordered = sorted(squared)
    size2 = (ordered[(count - 1) // 2] + ordered[count // 2]) / 2  # of the median's root
    eta = real("0.005") * size2
    terms, lumas, alphas, ratios = [], [], [], []
    for i in range(count):
        s = sorted(maths.exp(real(float(x))) for x in splats.log_scales[i])
        total = real(0)
        for weight, one in zip(weights, views, strict=True):
            step = offset(i, one.center)
            x, y, z = (sum(real(float(r)) * d for r, d in zip(row, step, strict=True))
                       for row in one.rotation)  # fmt: skip
            share, across = real(1), z
            if not prior:
                near = one.near if one.near > 0 else real("0.01") * maths.sqrt(size2)
                half_x, half_y = real(one.width) / 2, real(one.height) / 2
                fx, fy = real(one.fx), real(one.fy)
                edge_x = abs(fx * x + (real(one.cx) - half_x) * z) / half_x
                edge_y = abs(fy * y + (real(one.cy) - half_y) * z) / half_y
                across = max(edge_x, edge_y, z)
                share -= (across - z) / (2 * s[2] * maths.sqrt(1 + fx * fy / (half_x * half_y)))
                if not near <= z <= one.far or share <= 0:
                    continue
            d2 = sum(d * d for d in step) if prior else across * across
            total += weight * share / (d2 + eta)
        alpha = 1 / (1 + maths.exp(-real(float(splats.opacity_logits[i]))))
        total = alpha * (total or real("1e-6") / (squared[i] + eta))
        colors = [
            real(float(c)) / (2 * maths.sqrt(maths.pi)) + real("0.5") for c in splats.sh_dc[i]
        ]
        luma = sum(real(k) * min(max(c, 0), 1)
                   for k, c in zip(("0.299", "0.587", "0.114"), colors, strict=True))  # fmt: skip
        terms.append((total * s[1] * s[2], total * luma**2, total * alpha**2))
        lumas.append(luma)
        alphas.append(alpha)
        ratios.append(min(s[2] / s[0], real(10) ** 6))
    gray = sum(lumas) / count
    raw = [
        maths.log(sum(ratios) / count) / real("10.73"),
        100 * sum((luma - gray) ** 2 for luma in lumas) / count / real("56.06"),
        100 * sum(4 * a * (1 - a) for a in alphas) / count / real("100.67"),
    ]
    means = [sum(column) / count for column in zip(*terms, strict=True)]
    return [
        sum(raw[k] / sum(raw) * term[k] / means[k] if means[k] else 0 for k in range(3))
        for term in terms
    ]


def beside_their_neighbours(scores, offset, spread) -> np.ndarray:
    """Divide each score by a power of the mean in its cell, of 64 along each axis of a ball."""
    squared = np.sum(offset**2, axis=1) + spread
    weighted = offset / squared[:, None]
    axes = principal_axes(np.vstack([weighted.T @ offset, weighted.sum(axis=0)]))
    place = offset @ axes.T / math.sqrt(np.median(squared))
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


@pytest.mark.parametrize("prior", [False, True])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_scores_equal_a_plain_reference(seed, prior):
    """The stored score is float32, so 1e-5 leaves room for its rounding (6e-8) and no more."""
    splats, views = random_scene(seed)
    middle, spread = middle_of(views)
    expected = np.array(reference(splats, views, (middle, spread), prior))
    if not prior:
        expected = beside_their_neighbours(expected, splats.means.astype(float) - middle, spread)
    scores = closed_form.score(splats, views, prior=prior)
    np.testing.assert_allclose(scores.values, expected, rtol=1e-5)


def three_splats() -> tuple[Splats, ViewSet]:
    """Three splats on the axis of one view at depths 1, 2 and 3, opacity 1/2, black, grey, white.

    Scales 1 along each axis of the first, so that area 1; 2, 2, 1 of the second: area 4; 3, 1, 1 of
    the third: area 3."""
    scales = [[1, 1, 1], [2, 2, 1], [3, 1, 1]]
    splats = splats_of([[0, 0, 1], [0, 0, 2], [0, 0, 3]], 0.5, scales, [0.0, 0.5, 1.0])
    return splats, ViewSet((view(),))


@pytest.mark.parametrize(("chunk", "threads", "block"), [(7, 1, 64), (64, 3, 2)])
def test_chunks_threads_and_view_blocks_change_nothing(monkeypatch, chunk, threads, block):
    """Chunks and blocks split sums of float64 differently; threads change no bit.

    Of runs of a few splats most are seen by some views alone, or wholly, where one run of all is
    partly in each view.
    """
    splats, views = random_scene(5)
    expected = execute.within(cores=1)(closed_form.score)(splats, views)
    monkeypatch.setattr(closed_form, "_CHUNK", chunk)
    monkeypatch.setattr(closed_form, "_VIEW_BLOCK", block)
    monkeypatch.setattr(closed_form, "_RUN", 1 + chunk // 5)
    monkeypatch.setattr(closed_form, "ROWS", 100)
    scores = execute.within(cores=threads)(closed_form.score)(splats, views)
    np.testing.assert_allclose(scores.values, expected.values, rtol=1e-6)
    np.testing.assert_array_equal(scores.seen, expected.seen)
    alone = execute.within(cores=1)(closed_form.score)(splats, views)
    np.testing.assert_array_equal(scores.values, alone.values)


def test_a_box_that_touches_an_edge_is_neither_left_out_nor_whole_for_certain():
    """Edges are inside, by sums that round: a point at the edge is decided by `project` alone."""
    cameras = ViewSet((view(),))
    edge = np.array([[1.0], [0.0], [1.0]])
    some, whole = Frustums(cameras, np.zeros(3), 0.01).classify(edge, edge, np.zeros(1) + 1e-9)
    assert some.all()
    assert not whole.any()
