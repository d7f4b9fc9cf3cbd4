"""Merging: the moments by hand, the laws, and what must not happen."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core.execute import Cancelled
from refine_addon.core.merging import field as merge_field
from refine_addon.core.merging import graph as merge_graph
from refine_addon.core.merging import pairs as merging
from refine_addon.core.merging.field import Field
from refine_addon.core.merging.graph import MergeGraph
from refine_addon.core.merging.merge import merge
from refine_addon.core.spherical_harmonics import colors
from refine_addon.core.splats import ALPHA_MAX, ARRAYS, LOW_PASS, Splats, drawable, opacity
from refine_addon.core.views import View, ViewSet
from refine_addon.core.visibility.scene import Scene, scene_of

from .test_views import ring

SCENE = Scene(np.zeros(3), 1.0, np.eye(3))


def flat(opacities, means, variances, *, colors=None, error=None):
    """Splats without a low-pass, seen along z; contribution is opacity times area."""
    means, variances = np.array(means, float), np.array(variances, float)
    count, opacities = len(means), np.array(opacities, float)
    covariances = np.zeros((count, 6))
    covariances[:, [0, 3, 5]] = variances
    contribution = opacities * np.sqrt(variances[:, 0] * variances[:, 1])
    error = contribution * opacities / 2 if error is None else np.array(error, float)
    along, zeros = np.tile([0.0, 0.0, 1.0], (count, 1)), np.zeros((count, 3))
    colors = zeros + 0.5 if colors is None else np.array(colors, float)
    return Field(
        means, covariances, opacities, contribution, error,
        along, zeros, colors, np.zeros(count),
    )  # fmt: skip


def measured_from(splats, views, seen):
    scene = scene_of(splats.means, drawable(splats), views)
    return merge_field.measured_field(splats, np.arange(len(splats)), views, scene, seen)


def merged_of(field, first=0, second=1):
    one, two = np.array([first]), np.array([second])
    pairs = merging.price(field, one, two)
    return pairs, merging.merge(field, one, two, pairs)


def cloud(count, seed=0, degree=1, spread=1.0):
    rng = np.random.default_rng(seed)
    return Splats(
        rng.normal(size=(count, 3)) * spread,
        rng.normal(-2.0, 0.5, size=(count, 3)).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.normal(0.0, 2.0, size=count).astype(np.float32),
        rng.normal(0.0, 0.5, size=(count, 3)).astype(np.float32),
        rng.normal(0.0, 0.1, size=(count, (degree + 1) ** 2 - 1, 3)).astype(np.float32),
    )


LENS = {"fx": 200.0, "fy": 250.0, "cx": 160.0, "cy": 120.0, "width": 320, "height": 240}


def looking(at, center, **changes):
    """Return a view from `center` to `at`, 320 x 240 px, y down."""
    forward = np.array(at, float) - center
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return View(rotation, np.array(center, float), **LENS | changes)


def around(count=4, distance=6.0):
    """Look from a circle towards the origin."""
    return ring(count, distance, **LENS | {"fy": 200.0})


def measure(splats, _expected=None, _progress=None):
    """Stand in for rendering: alpha times the geometric-mean area, of no unit, one contrast."""
    logs = np.asarray(splats.log_scales, np.float64)
    size = np.exp(2 / 3 * np.sum(logs - np.median(logs), axis=1))
    alpha = opacity(splats.opacity_logits)
    return np.array([alpha * size, 0.05 * alpha**2 * size])


def reduced_to(splats, views, measured, keep_count, **how):
    return merge(splats, views, measured(splats, None, None), measured, keep_count, **how)


def test_two_splats_apart_have_the_moments_of_their_mixture():
    """Masses 1 : 3, a step of 4: mean 3/4 of the way; variance 1 + 3/16 16 = 4 along x.

    Seen from opposite sides they keep the line; left of the one is right of the other.
    """
    field = flat([0.1, 0.3], [[0.0, 0, 0], [4, 0, 0]], [[1.0, 1, 1]] * 2)
    field.direction[:], field.deviation[:] = [[0, 0, 1], [0, 0, -1]], [[0.5, 0, 0], [-0.5, 0, 0]]
    pairs, merged = merged_of(field)
    np.testing.assert_allclose(pairs.position, [0.25])
    np.testing.assert_allclose(merged.means, [[3, 0, 0]])
    np.testing.assert_allclose(merged.covariances, [[4, 0, 0, 1, 0, 1]])
    # <f_i, f_j> / 2 pi = .1 .3 exp(-16 / 4) / 2; the area is 2.
    np.testing.assert_allclose(merged.opacity, (0.4 - 0.03 * np.exp(-4) / 2) / 2, rtol=1e-12)
    np.testing.assert_allclose(np.abs(merged.direction), [[0, 0, 1]])
    np.testing.assert_allclose(np.abs(merged.deviation), [[0.5, 0, 0]])


def test_the_cost_is_the_squared_error_of_the_pictures():
    """Against the three footprints summed on a fine grid, colour by colour."""
    background = np.array([0.2, 0.5, 0.3])
    colors = np.random.default_rng(1).uniform(size=(2, 3))
    alphas, means = np.array([0.3, 0.6]), np.array([[0.0, 0, 0], [0.8, 0.5, 0.3]])
    variances = np.array([[0.5, 1.0, 0.1], [1.2, 0.3, 0.2]])
    x, y = np.meshgrid(np.arange(-9, 9, 0.05), np.arange(-9, 9, 0.05))

    def picture(alpha, mean, covariance, color):
        dx, dy = x - mean[0], y - mean[1]
        xx, xy, _, yy, *_ = covariance
        det = xx * yy - xy * xy
        shape = alpha * np.exp(-0.5 * (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / det)
        return shape[..., None] * (color - background)

    def squared(image):
        return (image**2).sum() * 0.05**2 / (2 * np.pi)

    shapes = flat(alphas, means, variances).covariances
    before = [picture(*each) for each in zip(alphas, means, shapes, colors, strict=True)]
    error = [squared(image) for image in before]
    pairs, merged = merged_of(flat(alphas, means, variances, colors=colors, error=error))
    after = picture(merged.opacity[0], merged.means[0], merged.covariances[0], merged.color[0])
    np.testing.assert_allclose(pairs.cost[0], squared(sum(before) - after), rtol=1e-9)
    np.testing.assert_allclose(pairs.error[0], squared(after), rtol=1e-9)


def test_a_merge_along_the_viewing_direction_costs_what_views_from_aside_see():
    """One behind the other: alike from the front; from the side as two that lie side by side."""
    field = flat([0.01, 0.01], [[0.0, 0, 0], [0, 0, 4]], [[1.0, 1, 1]] * 2)
    turned = flat([0.01, 0.01], [[0.0, 0, 0], [4, 0, 0]], [[1.0, 1, 1]] * 2)
    field.deviation[:] = [1e9, 0, 0]
    pair = np.array([0]), np.array([1])
    front, aside = (merging.price(field, *pair, tilt).cost for tilt in (0.0, 1.0))
    assert front < 1e-4 * aside
    np.testing.assert_allclose(aside, merging.price(turned, *pair).cost, rtol=1e-6)


def test_no_mass_is_created_and_none_is_lost_but_the_overlap():
    rng, shape = np.random.default_rng(2), (2000, 3)
    field = flat(rng.uniform(0, 1, 2000), rng.normal(size=shape), np.exp(rng.normal(0, 2, shape)))
    first, second = np.arange(0, 2000, 2), np.arange(1, 2000, 2)
    pairs = merging.price(field, first, second)
    merged = merging.merge(field, first, second, pairs)

    def mass(of):
        c = of.covariances
        return of.opacity * np.sqrt(c[:, 0] * c[:, 3] - c[:, 1] ** 2)

    whole = mass(field)
    after, before = mass(merged), whole[first] + whole[second]
    assert (after <= before * (1 + 1e-9)).all()
    assert (after >= np.maximum(whole[first], whole[second]) * (1 - 1e-9)).all()
    assert merged.opacity.max() <= ALPHA_MAX * (1 + 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("goal", [550, 500, 499, 350, 50, 1])
def test_as_many_survive_as_asked_and_the_unchanged_keep_their_bits(goal):
    """Through all stages; input is only read. Harmonics equal to base colours stay so."""
    splats = cloud(500)
    splats = replace(splats, sh_rest=np.repeat(splats.sh_dc[:, None], 3, axis=1))
    for name in ARRAYS:
        getattr(splats, name).flags.writeable = False
    result = reduced_to(splats, around(), measure, goal)
    keep_count = min(goal, 500)
    assert len(result.splats) == keep_count == result.keep.sum() == len(result.changed)
    assert result.merged + result.deleted == 500 - keep_count
    assert result.merged >= np.count_nonzero(result.changed)
    assert result.changed.any() == (keep_count < 499)
    for name in ARRAYS:
        old, new = getattr(splats, name)[result.keep], getattr(result.splats, name)
        np.testing.assert_array_equal(new[~result.changed], old[~result.changed])
    expected = np.repeat(result.splats.sh_dc[:, None], 3, axis=1)
    np.testing.assert_allclose(result.splats.sh_rest, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4), (2, 4, 1, 0, 3), (1, 3, 2, 0, 4)])
def test_a_kept_splat_has_the_colours_of_all_merged_into_it_by_what_is_seen_of_each(order):
    """Three at one place seen as 1, 2 and 5; the one that is seen most stays.

    Of all that would be seen were nothing hidden 26 were; that share of a mass counts with a
    chance of 1 / (n + 1) after n views. Opacity is three times .01, less what they hide.
    """
    splats = cloud(5)
    splats.means[:] = [[0, 0, 0], [1e-6, 0, 0], [2e-6, 0, 0], [0, 3, 0], [0, 0, 3]]
    splats.log_scales[:], splats.quaternions[:] = -2.0, [1, 0, 0, 0]
    splats.opacity_logits[:] = np.log(0.01 / 0.99)
    splats.sh_dc[:] = np.array([0.0, 0.1, 0.2, 0.5, -0.5])[:, None] + [0.0, 0.03, 0.05]
    splats.sh_rest[:] = np.arange(5)[:, None, None] * 0.1
    contribution = np.array([1.0, 2, 5, 9, 9])
    seen = np.array([contribution, contribution * 0.005])
    result = reduced_to(splats.take(np.array(order)), around(), lambda *_: seen[:, order], 3)
    assert (result.merged, result.deleted) == (2, 0)
    assert result.keep.tolist() == [index > 1 for index in order]
    (row,) = np.flatnonzero(result.changed)
    assert order[np.flatnonzero(result.keep)[row]] == 2
    viewed, _, views = measured_from(splats, around(), seen)
    pixel = viewed.blur / LOW_PASS
    mass = 0.01 * (np.exp(-4.0) + 0.3 * pixel) / pixel
    shares = (contribution + mass * 26 / (views @ mass) / (views + 1))[:3]
    shares /= shares.sum()
    for name in ("sh_dc", "sh_rest"):
        expected = np.tensordot(shares, getattr(splats, name)[:3].astype(float), 1)
        np.testing.assert_allclose(getattr(result.splats, name)[row], expected, rtol=1e-5)
    assert 0.0298 < opacity(result.splats.opacity_logits[row]) < 0.03
    np.testing.assert_allclose(result.splats.log_scales[row], -2.0, atol=1e-4)
    np.testing.assert_allclose(result.splats.means[row], [1e-6, 0, 0], atol=1e-9)


FAR_OFF = looking([0, 0, 1], [-3, 0, 1.0])
NEAR_BY = {"at": [0, 0, 1], "center": [0, 0, 0]}


@pytest.mark.parametrize(
    ("one", "other", "point", "expected"),
    [
        # From 45 degrees either side: along the bisector; from distances 1 and 2 as 4 to 1.
        (looking([0, 0, 0], [2, 0, -2]), looking([0, 0, 0], [-2, 0, -2]), [0, 0, 0], [0, 0, 1]),
        (looking([0, 0, 0], [1, 0, 0]), looking([0, 0, 0], [0, 0, -2]), [0, 0, 0], [-4, 0, 1]),
        # Beside the image, which reaches .8 to the side and .48 down.
        (looking(**NEAR_BY), FAR_OFF, [0.85, 0, 1], [3.85, 0, 0]),
        (looking(**NEAR_BY), FAR_OFF, [0, 0.5, 1], [3, 0.5, 0]),
        # Before the near plane and behind the far one.
        (looking(**NEAR_BY, near=1.1), FAR_OFF, [0, 0, 1], [1, 0, 0]),
        (looking(**NEAR_BY, far=0.9), FAR_OFF, [0, 0, 1], [1, 0, 0]),
    ],
)
def test_a_splat_is_viewed_along_the_mean_direction_of_what_sees_it(one, other, point, expected):
    """But for 1e-4 where a view sees as good as nothing."""
    splats = replace(cloud(1), means=np.array([point], float))
    field, *_ = measured_from(splats, ViewSet((one, other)), measure(splats))
    near = 1e-4 if other is FAR_OFF else 1e-12
    np.testing.assert_allclose(field.direction, [expected / np.linalg.norm(expected)], atol=near)
    color = colors(field.direction, splats.sh_dc, splats.sh_rest).clip(0.0)
    np.testing.assert_allclose(field.color, color, rtol=1e-6)
    if one.center[0] == 2.0:  # a deviation of sin 45 to the side, a third of a pixel at sqrt 8
        np.testing.assert_allclose(np.abs(field.deviation), [[np.sqrt(0.5), 0, 0]], atol=1e-12)
        np.testing.assert_allclose(field.blur, 0.3 * 8 / (200 * 250))


@pytest.mark.parametrize("goal", [60, 0])
def test_protected_splats_neither_vanish_nor_change_though_nobody_sees_or_can_draw_them(goal):
    """A third stays; undrawable ones that are not protected go first."""
    splats = cloud(100)
    splats.means[[5, 6], 0] = np.nan
    protected = np.arange(100) % 3 == 2

    def partly(left, _expected, _progress):
        seen = np.nan_to_num(measure(left))
        return seen * (np.arange(len(left)) < 45) * [[1.0], [0.0]]

    result = reduced_to(splats, around(), partly, goal, protected=protected)

    assert len(result.splats) == max(goal, 33)
    assert result.keep[protected].all()
    assert not result.keep[6]
    assert not result.changed[protected[result.keep]].any()
    if not goal:
        assert (result.merged, result.deleted) == (0, 67)


def test_where_nothing_is_seen_merging_is_deleting_the_lowest_errors():
    splats = cloud(200, spread=1e-3)
    splats.log_scales[:], splats.opacity_logits[:] = -2.0, 0.0
    error = np.random.default_rng(5).permutation(200).astype(float)
    table = dict(zip(map(tuple, splats.means), error, strict=True))

    def unseen(left, _expected, _progress):
        return np.array([np.zeros(len(left)), [table[tuple(mean)] for mean in left.means]])

    result = reduced_to(splats, around(), unseen, 120)

    np.testing.assert_array_equal(result.keep, error >= 80)
    for name in ARRAYS:
        found, kept = getattr(result.splats, name), getattr(splats, name)[result.keep]
        np.testing.assert_array_equal(found, kept)


def cheapest_first(field, penalty, unseen, goal):
    """Who goes into whom, None for nobody, one operation at a time, every pair priced."""
    alive, done = list(range(len(field.means))), []
    while len(alive) > goal:
        dearer = np.where(unseen, merge_graph.UNSEEN, 1.0) * field.error
        operations = [(dearer[row], row, None) for row in alive]
        for pair in itertools.combinations(alive, 2):
            cost = merging.price(field, *(np.array([row]) for row in pair)).cost[0]
            operations.append((penalty * cost, *pair))
        _, gone, into = min(operations, key=lambda operation: operation[0])
        if into is not None:
            if field.contribution[gone] > field.contribution[into]:
                gone, into = into, gone
            field.put(np.array([into]), merged_of(field, into, gone)[1])
        alive.remove(gone)
        done.append((gone, into))
    return done


@pytest.mark.parametrize("penalty", [1.0, 0.2])
@pytest.mark.parametrize("seed", range(8))
def test_the_cheapest_of_all_operations_is_next_each_time(seed, penalty, monkeypatch):
    """Seven splats are all neighbours, some unseen; rounds are of one operation each."""
    monkeypatch.setattr(merge_graph, "BATCH", 0.0)
    rng = np.random.default_rng(seed)
    field = flat(
        rng.uniform(0.1, 0.6, 7), rng.normal(size=(7, 3)), rng.uniform(0.5, 2, size=(7, 3)),
        colors=rng.uniform(size=(7, 3)),
    )  # fmt: skip
    field.error *= rng.uniform(0.02, 1.0, 7)
    unseen = rng.uniform(size=7) < 0.5
    graph = MergeGraph(field.take(np.arange(7)), SCENE, penalty, unseen)
    graph.reduce(2)
    expected = cheapest_first(field, penalty, unseen, 2)
    merges = [(gone[0], into[0]) for into, gone, _ in graph.merges if len(into)]
    assert merges == [(gone, into) for gone, into in expected if into is not None]
    assert set(np.flatnonzero(~graph.alive).tolist()) == {gone for gone, _ in expected}


@pytest.mark.parametrize("seen", [1.0, 1e-9])
def test_what_no_view_shows_is_rather_merged_than_deleted(seen, monkeypatch):
    """Those hidden count by their bias; where all are seen, nothing changes."""
    splats, views = cloud(400), around()
    sums = measure(splats) * np.where(np.arange(400) % 2, seen, 1.0)
    merged = merge(splats, views, sums, measure, 300)
    monkeypatch.setattr(merge_graph, "UNSEEN", 1.0)
    plain = merge(splats, views, sums, measure, 300)
    assert (merged.deleted < plain.deleted) == (seen < 1.0)
    assert (merged.keep == plain.keep).all() == (seen == 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("hidden", [0.0, 0.001])
def test_copies_of_a_splat_do_not_merge_one_by_one(monkeypatch, hidden):
    """Rounds that remove a quarter of 3 % halve them in 92, and half as many for the last."""
    rounds, one = [], MergeGraph._round
    monkeypatch.setattr(MergeGraph, "_round", lambda *given: rounds.append(1) or one(*given))
    field = flat([0.2] * 2000, np.zeros((2000, 3)), np.ones((2000, 3)))
    seen = (1.0 - hidden) ** np.arange(2000)
    field = replace(field, contribution=field.contribution * seen, error=field.error * seen)
    graph = MergeGraph(field, SCENE, 1.0, np.zeros(2000, np.bool_))
    graph.reduce(1000)
    assert np.count_nonzero(graph.alive) == 1000
    assert len(rounds) <= 92 + 46


@pytest.mark.parametrize("unknown", [np.nan, np.inf])
@pytest.mark.parametrize("goal", [0, 1, 3, 5])
def test_splats_of_unknown_error_go_last_and_exactly_as_many_as_asked_stay(unknown, goal):
    """Errors .01 and .02 are known: rows 3 and 1 go first, then the rest in their order."""
    places = np.outer(np.arange(6) * 100.0, [1, 0, 0])
    error = [unknown, 0.02, unknown, 0.01, unknown, unknown]
    field = flat([0.5] * 6, places, np.ones((6, 3)), error=error)
    graph = MergeGraph(field, SCENE, 1.0, np.zeros(6, np.bool_))
    graph.reduce(goal)
    assert np.flatnonzero(graph.alive).tolist() == sorted([3, 1, 0, 2, 4, 5][6 - goal :])
    assert (~graph.alive).sum() - sum(len(gone) for _, gone, _ in graph.merges) >= 4 - goal


@pytest.mark.parametrize("focal", [1e-200, 1e200])
def test_absurd_focal_lengths_do_no_harm_and_merging_can_be_cancelled(focal):
    """Those whose square leaves float64 count as 1e-9 or 1e9 px."""
    views = ViewSet((*around(), replace(around()[0], fx=focal, fy=focal)))
    merged = reduced_to(cloud(100), views, measure, 50).splats
    assert len(merged) == 50
    assert all(np.isfinite(getattr(merged, name)).all() for name in ARRAYS)
    with pytest.raises(Cancelled):
        reduced_to(cloud(100), views, measure, 50, progress=lambda fraction, _: fraction < 0.5)


@pytest.mark.slow
def test_extreme_splats_raise_no_warning_and_stay_drawable():
    """Needles, dust, walls, opacity 0 and 1, all at one place or far away."""
    rng = np.random.default_rng(7)
    splats = cloud(600)
    splats.log_scales[:] = rng.choice([-100.0, -20.0, -5.0, 0.0, 5.0, 20.0], size=(600, 3))
    splats.opacity_logits[:] = rng.choice([-100.0, -10.0, 0.0, 10.0, 100.0, np.inf], size=600)
    splats.means[:100] = 0.0
    splats.means[100:110] = 1e15
    splats.quaternions[::7] = 0.0

    def wild(left, _expected, _progress):
        return np.exp([np.linspace(-300, 300, len(left)), np.linspace(300, -300, len(left))])

    with np.errstate(all="raise"):
        for seen in (wild, lambda left, *_: np.ones((2, len(left)))):
            result = reduced_to(splats, around(), seen, 150)
            changed = result.splats.take(result.changed)
            assert all(np.isfinite(getattr(changed, name)).all() for name in ARRAYS)
            assert (opacity(changed.opacity_logits) < 1.0).all()


def test_a_flattened_covariance_is_the_covariance_without_its_shortest_axis():
    """The other two axes alone, from near spheres to discs and needles, over 24 decades of size."""
    generator = np.random.default_rng(5)
    deviations = 10.0 ** np.sort(generator.uniform(-3.0, 0.0, (200, 3)), axis=1)
    deviations[:20, 0] = 1e-12
    size = 10.0 ** generator.uniform(-12.0, 12.0, (200, 1))
    roots = np.linalg.qr(generator.normal(size=(200, 3, 3)))[0] * deviations[:, None, :]
    upper = (slice(None), *np.triu_indices(3))
    whole = (roots @ roots.transpose(0, 2, 1))[upper]
    expected = (roots[:, :, 1:] @ roots[:, :, 1:].transpose(0, 2, 1))[upper]
    found = merging.flat(np.vstack([whole * size, np.full(6, np.nan)]))  # a NaN harms no other
    np.testing.assert_allclose(found[:-1] / size, expected, atol=1e-8)
