"""The estimate of the pictures' quality against pictures by hand, and a PSNR as budget."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import (
    Budget,
    Cancelled,
    ClosedForm,
    Merge,
    Occlusion,
    RefineError,
    Scores,
    View,
    ViewSet,
    prune,
    score,
    select,
)
from refine_addon.core.quality.curve import PSNR_CAP, SHARES, Quality, merged_from
from refine_addon.core.quality.psnr import psnr_against, psnr_kept, psnr_of, quality_curve
from refine_addon.core.visibility import cast, projection
from refine_addon.core.visibility.cast import validation_rays
from refine_addon.core.visibility.rays import Rays
from tests.core.test_invariance import MOTIONS, moved
from tests.core.test_levels import merges  # noqa: F401 - a fixture
from tests.core.test_occlusion import cloud, look_along_z, ring, splats_of

FAST = ClosedForm()
CURVE = Quality(*np.array([[0.2, 0.5, 0.8], [50.0, 40.0, 30.0], [52.0, 47.0, 38.0]]))
CUT = 1.0 / 255.0


def picture(splats, view: View, views: ViewSet) -> np.ndarray:
    """Draw every pixel of a view, splat by splat, front to back."""
    gaussians, scene, _ = projection.prepare(splats, views)
    footprints = projection.project(gaussians, scene, view)
    across, down = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    image, through = np.zeros((view.height, view.width, 3)), np.ones((view.height, view.width))
    for k, row in enumerate(footprints.index):
        dx, dy = across - footprints.centers[0, k], down - footprints.centers[1, k]
        squared = sum(
            ((dx * half[0, k] + dy * half[1, k]) / length[k] ** 2) ** 2
            for half, length in zip(
                (footprints.major, footprints.minor), footprints.sigmas, strict=True
            )
        )
        alpha = gaussians.alphas[row] * np.exp(-squared / 2)
        alpha = np.where(alpha < CUT, 0.0, np.minimum(alpha, 0.99))
        image += (through * alpha)[..., None] * color(splats, gaussians.index[row], view)
        through *= 1.0 - alpha
    return image.clip(0.0, 1.0)


def color(splats, row: int, view: View) -> np.ndarray:
    """Return the colour of a splat: bands 0 and 1, 1 / 2 sqrt(1 / pi) and 1 / 2 sqrt(3 / pi).

    0.5 + C0 f_0 - C1 y f_1 + C1 z f_2 - C1 x f_3, as the reference implementation has it.
    """
    x, y, z = (splats.means[row] - view.center) / np.linalg.norm(splats.means[row] - view.center)
    found = 0.5 + 0.28209479 * splats.sh_dc[row]
    if splats.sh_rest.shape[1]:
        found = found + 0.48860251 * np.array([-y, z, -x]) @ splats.sh_rest[row]
    return np.maximum(found, 0.0)


def psnr(splats, keep, views: ViewSet) -> float:
    """Return the mean PSNR of whole pictures."""
    found = []
    for view in views:
        whole = picture(splats, view, views)
        error = np.mean((picture(splats.take(keep), view, views) - whole) ** 2)
        found.append(min(-10 * math.log10(error), PSNR_CAP) if error else PSNR_CAP)
    return float(np.mean(found))


def half(count: int) -> np.ndarray:
    return np.random.default_rng(5).random(count) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize(("rays", "within"), [(1 << 20, 0.01), (1 << 13, 0.25)])
def test_rays_tell_the_psnr_of_the_picture(monkeypatch, rays, within):
    """Five views of 80 x 60 have 24,000 pixels; with as many rays nothing is left to chance.

    With a third, of an error that is smooth over many pixels, a quarter of a dB is.
    """
    splats, views, keep = cloud(), ring(), half(300)
    monkeypatch.setattr(cast, "VALIDATION_RAYS", rays)

    found = validation_rays(splats, views)

    count = sum(len(rays.columns) * len(rays.rows) for rays in found.rays)
    assert count == 24_000 if rays > 24_000 else count < 8800
    assert psnr_kept(found, keep) == pytest.approx(psnr(splats, keep, views), abs=within)


def test_few_rays_are_right_on_average():
    """Minus the logarithm of a mean is too high, by half the mean's relative variance, on average.

    The square of an exponential variable has 5 times its squared mean as variance (24 - 4 over 4),
    so the mean of 50 rays is too high by 10 / ln 10 * 5 / 50 / 2 = .22 dB, and mended. An error
    that rises evenly from one end of the picture to the other is no chance, and well sampled.
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

    Both splats are much wider than the picture, so all pixels change by .25 c = .125.
    """
    splats = splats_of([[0, 0, 2.0], [0, 0, 3.0]], alphas=0.5, scales=100.0, gray=0.5)
    found = validation_rays(splats, ViewSet((look_along_z(),)))

    for keep in ([True, False], [False, True]):
        assert psnr_kept(found, np.array(keep)) == pytest.approx(-20 * math.log10(0.125), abs=0.01)


def test_views_count_by_their_weights_and_those_that_see_nothing_do_not():
    """A view of weight 3 counts three times; one that looks away is no equal picture."""
    splats, (one, other, *_), keep = cloud(), ring(), half(300)
    each = [psnr_kept(validation_rays(splats, ViewSet((view,))), keep) for view in (one, other)]
    away = replace(one, rotation=np.diag([-1.0, 1.0, -1.0]) @ one.rotation, name="away")
    weighted = ViewSet((replace(one, weight=3.0, name="one"), replace(other, name="other"), away))

    found = psnr_kept(validation_rays(splats, weighted), keep)

    assert found == pytest.approx((3 * each[0] + each[1]) / 4, abs=0.3)


def test_where_too_few_rays_meet_a_splat_nothing_is_estimated():
    """One small splat in the picture is hit by a few dozen of 4,800 rays: too few to say."""
    splats = splats_of([[0, 0, 2.0]] * 4, scales=0.02)
    views = ViewSet((look_along_z(),))

    result = prune(splats, views, Budget(ratio=0.5), Occlusion())

    assert result.report["estimated_psnr"] is None
    assert any("too little" in note for note in result.report["notes"])


def test_in_dense_scenes_there_are_fewer_rays(monkeypatch):
    """300 splats wider than the picture: each ray hits all of them."""
    splats = splats_of(np.tile([[0, 0, 2.0]], (300, 1)), scales=100.0)
    views = ViewSet((look_along_z(),))
    monkeypatch.setattr(cast, "MAX_VALIDATION_HITS", 300 * 500)

    (rays,) = validation_rays(splats, views).rays

    assert len(rays.ray) == pytest.approx(300 * 500, rel=0.1)


@pytest.mark.parametrize("count", [0, 1, 16, 200])
def test_a_view_has_rays_whatever_its_shape(count):
    """Between one and all of its pixels, each once."""
    for width, height in ((1, 1), (1, 5000), (5000, 1), (17, 3)):
        view = look_along_z(width=width, height=height)
        columns, rows = cast.pixels(view, 0, float(count))
        assert 1 <= len(columns) * len(rows) <= width * height
        assert len(set(columns.tolist())) == len(columns)
        assert set(columns.tolist()) <= set(range(width))
        assert set(rows.tolist()) <= set(range(height))


@pytest.mark.slow
def test_the_curve_is_what_each_share_reaches():
    """Each point is the estimate for the lowest scores removed, as `select` removes them.

    It is the mean of those of single views by their weights: one counts three times the others.
    """
    first, *others = ring()
    views = ViewSet((replace(first, weight=3.0), *others))
    scores = score(cloud(), views, Occlusion())
    curve, sample = scores.quality, scores.ray_sample

    assert curve is not None
    assert sample is not None
    assert curve.shares.tolist() == list(SHARES)
    for share, value in zip(SHARES, curve.psnr, strict=True):
        keep = select(scores, Budget(ratio=share))
        assert psnr_kept(sample, keep) == pytest.approx(value, abs=1e-9)
    mean = sum(view.weight * curve.views[view.name] for view in views) / 7.0
    assert np.allclose(mean, curve.psnr, atol=1e-9)
    assert len({tuple(of_view) for of_view in curve.views.values()}) == 5
    assert all(np.all(np.diff(of_view) <= 0.0) for of_view in curve.views.values())


def test_a_view_whose_splats_stay_is_not_changed():
    """Ten splats before each of two cameras; the lowest half is what one of them sees."""
    away = 40.0 * np.arange(2)[:, None] * np.array([1.0, 0.0, 0.0])
    grid = np.random.default_rng(2).normal(size=(2, 10, 3)) * 0.3 + [0.0, 0.0, 4.0]
    splats = splats_of((grid + away[:, None]).reshape(-1, 3), gray=0.9, scales=0.2)
    views = ViewSet(tuple(
        replace(look_along_z(), center=center, name=name)
        for center, name in zip(away, "ab", strict=True)
    ))  # fmt: skip
    found = validation_rays(splats, views)

    curve = quality_curve(found, np.arange(20, dtype=np.float32))

    assert curve.of_views(0.5) == {"a": pytest.approx(curve.views["a"][4]), "b": PSNR_CAP}
    assert curve.of_views(0.5)["a"] < 30.0


@pytest.mark.slow
@pytest.mark.parametrize("method", [FAST, Occlusion()])
def test_the_estimate_depends_on_nothing_but_the_scene(method):
    """Order of splats and of views, frame, and threads: only the last digits may differ.

    Scores do not change by being asked for it.
    """
    splats, views = cloud(), ring()
    order = np.random.default_rng(1).permutation(len(splats))
    there = moved(splats.take(order), tuple(views)[::-1], *MOTIONS["a turn and a move"])

    one = score(splats, views, method, quality=True, threads=1)
    other = score(*there, method, quality=True, threads=3)
    without = score(splats, views, method, quality=False)

    assert one.quality is not None
    assert other.quality is not None
    assert np.allclose(one.quality.psnr, other.quality.psnr, atol=0.05)
    assert np.array_equal(one.values, without.values)


def test_a_curve_is_read_between_its_points_and_back():
    """Linear in the logarithm of the odds; at the points what was put in.

    Nothing removed is the cap; beyond the last share nothing more is removed, and where points are
    equal as much as can.
    """
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


def test_merging_is_expected_to_be_better_and_never_worse():
    """Up to a tenth it is deletion; at half removed 4.5 + .55 * 2 dB better; never above 100.

    From 40,000 splats on it is the same; 10,000 are two halvings, of .4 dB each at half removed.
    """
    psnr, half, two = np.linspace(80.0, 10.0, len(SHARES)), SHARES.index(0.5), np.full(4, 2.0)

    found = merged_from(psnr, two, 40_000)

    assert found[0] == psnr[0]
    assert found[half] == pytest.approx(psnr[half] + 5.6)
    assert np.all(np.diff(found) <= 0.0)
    assert np.all(found >= psnr)
    assert np.array_equal(merged_from(psnr, two, 10**6), found)
    assert merged_from(psnr, two, 10_000)[half] == pytest.approx(found[half] - 0.8)
    assert merged_from(np.full(len(SHARES), 99.0), np.full(4, 9.0), 10**6).max() <= PSNR_CAP
    assert np.array_equal(merged_from(psnr, np.full(4, -50.0), 40_000), psnr)


def test_on_a_ray_the_nearest_kept_hit_stands_in():
    """Red, green, blue, one behind the other, alpha .5: weights .5, .25, .125 of what is seen.

    Without green, red or blue is as near: the one behind takes over. Without red and green, blue.
    Without all, nothing does.
    """
    line, alpha = np.zeros(3, np.int32), np.full(3, 0.5, np.float32)
    rays = Rays(
        np.arange(1), np.arange(1), line, np.arange(3, dtype=np.int32), alpha, np.log1p(-alpha),
        np.arange(3),
    )  # fmt: skip

    def seen(*keep):
        return rays.colors_by_nearest_kept(np.eye(3), np.array(keep))[:, 0].tolist()

    assert seen(True, True, True) == pytest.approx([0.5, 0.25, 0.125])
    assert seen(True, False, True) == pytest.approx([0.5, 0.0, 0.375])
    assert seen(False, False, True) == pytest.approx([0.0, 0.0, 0.875])
    assert seen(True, False, False) == pytest.approx([0.875, 0.0, 0.0])
    assert seen(False, False, False) == [0.0, 0.0, 0.0]


def test_a_curve_comes_back_from_json():
    """As the mesh and the report keep it; what is none gives none."""
    views = {"a": np.array([51.0, 41.0, 31.004])}
    facts = json.loads(json.dumps(replace(CURVE, views=views).facts()))
    again = Quality.from_facts(facts)

    assert again is not None
    assert np.array_equal(again.shares, CURVE.shares)
    assert np.array_equal(again.psnr, CURVE.psnr)
    assert np.array_equal(again.merged, CURVE.merged)
    assert again.views["a"].tolist() == [51.0, 41.0, 31.0]
    for wrong in (None, {}, {"shares": [0.5]}, facts | {"psnr": [1.0]}, facts | {"psnr": ["x"]},
                  {name: [] for name in facts}, 3,
                  facts | {"views": {"a": [1.0]}}, facts | {"views": 1}):  # fmt: skip
        assert Quality.from_facts(wrong) is None


@pytest.mark.slow
@pytest.mark.parametrize("method", [FAST, Occlusion()])
@pytest.mark.parametrize("goal", [20.0, 35.0])
def test_every_method_reaches_a_psnr(method, goal):
    """To half a dB by its own estimate; nearly, where many are protected and others must go."""
    protected = np.arange(300) % 3 == 0
    for shield, near in ((None, 0.6), (protected, 1.0)):
        result = prune(cloud(), ring(), Budget(psnr=goal), method, protected=shield)

        assert result.report["estimated_psnr"] == pytest.approx(goal, abs=near)
        assert result.report["budget"] == {"psnr": goal}
        assert not result.keep.all()
        assert shield is None or result.keep[protected].all()


@pytest.mark.slow
@pytest.mark.parametrize("goal", [25.0, 40.0])
def test_merging_reaches_a_psnr_with_fewer(merges, goal):
    """By its own estimate, to `prune.CLOSE` or as near as three tries come."""
    plain, merged = (
        prune(cloud(1000), ring(), Budget(psnr=goal), method) for method in (Occlusion(), Merge())
    )

    assert merged.report["estimated_psnr"] == pytest.approx(goal, abs=1.5)
    assert merged.report["method"]["psnr"]["merge"] == merged.report["estimated_psnr"]
    assert merged.keep.sum() <= plain.keep.sum()  # three tries need not tell them apart


def test_the_report_has_the_estimate_and_the_curve():
    """Plain numbers: of the result and of all shares. The closed form would take longer by it."""
    done, plain = (
        prune(cloud(), ring(), Budget(ratio=0.5), method).report for method in (Occlusion(), FAST)
    )

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
    """With few it was off by up to 7 dB. What it did reach is always told."""
    few = score(cloud(), ring(), Occlusion())
    many = replace(few, quality=replace(few.quality, foretold=True))

    few_told, many_told = (
        prune(None, None, Budget(ratio=0.5), Occlusion(), scores=scores).report["method"]
        for scores in (few, many)
    )
    done = prune(cloud(), ring(), Budget(ratio=0.5), Merge()).report

    assert few_told["psnr"]["merge"] is None
    assert "fewer than 20,000 splats" in few_told["note"]
    told = many_told["psnr"]
    assert told["delete"] < told["merge"] < told["refit"]
    assert many_told["note"] is None
    assert done["method"]["psnr"]["merge"] == done["estimated_psnr"]
    facts = few.quality.facts()
    assert not Quality.from_facts(facts).foretold
    del facts["foretold"]  # as of older versions
    assert Quality.from_facts(facts).foretold


def test_merged_splats_are_compared_with_the_original():
    """Equal pictures count as 100 dB; those with other harmonics differ."""
    splats, views = cloud(), ring()
    found = validation_rays(splats, views)
    other = replace(splats, sh_rest=splats.sh_rest + 0.5)

    assert psnr_kept(found, np.ones(300, np.bool_)) == PSNR_CAP
    assert psnr_against(found, splats, views) == PSNR_CAP
    assert psnr_against(found, other, views) < 40.0


@pytest.mark.parametrize(
    "work",
    [
        lambda _, **stop: validation_rays(cloud(), ring(), **stop),
        lambda found, **stop: quality_curve(found, np.arange(300, dtype=np.float32), **stop),
        lambda found, **stop: psnr_against(found, cloud(), ring(), **stop),
    ],
)
def test_estimating_can_be_cancelled(work):
    found = validation_rays(cloud(), ring())

    with pytest.raises(Cancelled):
        work(found, progress=lambda _fraction, _what: False)


@pytest.mark.slow
def test_extreme_splats_make_no_warning():
    """Opaque, invisible, vast, tiny, far, behind, brighter than white."""
    splats = cloud()
    splats.log_scales[:20], splats.log_scales[20:40] = 30.0, -60.0
    # An opacity just above 1 / 255.
    splats.opacity_logits[40:60], splats.opacity_logits[60:80] = np.inf, -5.54
    splats.sh_dc[80:100] = 1e6
    splats.means[100:120] *= 1e5

    found = score(splats, ring(), quality=True).quality

    assert found is not None
    assert np.isfinite(found.psnr).all()


def test_images_of_millions_of_pixels_a_side_are_looked_at_as_small_ones(monkeypatch):
    """Which rays hit a footprint is told by a table or by searching, with one result."""
    splats, views = cloud(), ring()
    found = validation_rays(splats, views).rays
    lens = {"fx": 1e7, "fy": 1e7, "cx": 4e6, "cy": 3e6, "width": 8_000_000, "height": 6_000_000}
    wide = validation_rays(splats, ViewSet((replace(views[0], **lens),)))

    monkeypatch.setattr(cast, "_MAX_TABLE", 0)
    for one, other in zip(found, validation_rays(splats, views).rays, strict=True):
        np.testing.assert_array_equal(one.ray, other.ray)
        np.testing.assert_array_equal(one.owner, other.owner)
    assert psnr_kept(wide, np.ones(300, np.bool_)) == PSNR_CAP
    assert psnr_kept(wide, half(300)) < PSNR_CAP
