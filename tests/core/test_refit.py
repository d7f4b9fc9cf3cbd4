"""Refitting, against differences of a plain renderer in float64, and its laws."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from refine_addon import core
from refine_addon.core import ViewSet, execute, methods, spherical_harmonics
from refine_addon.core.execute import silent
from refine_addon.core.refit import linear, refit, round_rays
from refine_addon.core.splats import (
    ARRAYS,
    DISC_LOW_PASS,
    LOW_PASS,
    drawable,
    rotation_matrices,
    with_model,
)
from refine_addon.core.visibility import cast as casting
from refine_addon.core.visibility import projection
from refine_addon.core.visibility.cast import cast, cast_visible, colors_from
from tests.core.test_invariance import moved, rotation
from tests.core.test_occlusion import cloud, ring

COLUMNS, ROWS = np.arange(3, 78, 8), np.arange(4, 58, 8)


def few():
    """Return 12 splats of unlike sizes, turned, half transparent, in doubles."""
    splats = cloud(12)
    random = np.random.default_rng(4)
    return replace(
        splats,
        means=splats.means.astype(np.float64),
        log_scales=random.uniform(-2.5, -0.7, (12, 3)),
        quaternions=random.normal(size=(12, 4)),
        opacity_logits=random.uniform(-1.0, 1.5, 12),
        sh_dc=random.uniform(-1.0, 1.0, (12, 3)),
        sh_rest=random.uniform(-0.2, 0.2, (12, 3, 3)),
    )


def alphas(splats, k, view, fixed, pixels):
    """Return alphas of a splat at some pixels, with J of `fixed`.

    A disc is where its plane is hit: m + u t_1 + v t_2 on the ray (x, y, 1) t, or its low-pass.
    """
    local = view.rotation @ (fixed.means[k] - view.center)
    step = view.rotation @ (splats.means[k] - fixed.means[k])
    axes = view.rotation @ rotation_matrices(splats.quaternions[k]) * np.exp(splats.log_scales[k])
    focal, middle = np.array([view.fx, view.fy]), np.array([view.cx, view.cy])
    if splats.model == "2dgs":
        rays = np.append((pixels - middle) / focal, np.ones((len(pixels), 1)), axis=1)
        left = np.stack([*(np.tile(-axes[:, i], (len(rays), 1)) for i in (0, 1)), rays], 2)
        u, v, _ = np.linalg.solve(left, np.tile(local + step, (len(rays), 1))[..., None])[..., 0].T
        away = pixels - (focal * (local + step)[:2] / (local + step)[2] + middle)
        squared = np.minimum(u * u + v * v, np.square(away).sum(axis=1) / DISC_LOW_PASS)
    else:
        jacobian = np.diag(focal) @ np.append(np.eye(2), -local[:2, None] / local[2], axis=1)
        jacobian /= local[2]
        shape = jacobian @ axes @ axes.T @ jacobian.T + LOW_PASS * np.eye(2)
        away = pixels - (focal * local[:2] / local[2] + middle + jacobian @ step)
        squared = np.einsum("pi,ij,pj->p", away, np.linalg.inv(shape), away)
    return np.exp(-squared / 2.0) / (1.0 + np.exp(-splats.opacity_logits[k]))


def drawn(splats, view, fixed, pixels):
    """Return the colours of the rays, (3, P), in float64, with J and the order of depth of `fixed`.

    The footprint ends nowhere, so that nothing jumps.
    """
    image, left = np.zeros((3, len(pixels))), np.ones(len(pixels))
    for k in np.argsort((fixed.means - view.center) @ view.rotation[2]):
        alpha = alphas(splats, k, view, fixed, pixels)
        direction = (fixed.means[[k]] - view.center) / np.linalg.norm(fixed.means[k] - view.center)
        color = spherical_harmonics.colors(direction, splats.sh_dc[[k]], splats.sh_rest[[k]])
        image += color[0].clip(0)[:, None] * left * alpha
        left *= 1.0 - alpha
    return image


@pytest.fixture
def squares(monkeypatch):
    """Have all rays count alike."""
    monkeypatch.setattr(linear, "_trust", lambda errors: np.ones(errors.shape[1], np.float32))


def linear_of(splats, view, *, pixels=(COLUMNS, ROWS)):
    """Return what `linear` says of a view."""
    gaussians, scene, _ = projection.prepare(splats, ViewSet((view,)))
    footprints = projection.project(gaussians, scene, view)
    order = np.argsort(gaussians.index)  # as rows
    gaussians, rank = gaussians.take(order), np.argsort(order)
    footprints = replace(footprints, index=rank[footprints.index])
    visible = cast(footprints, *pixels).visible()
    colors = round_rays.colors_of(splats, gaussians.index[visible[0].hit], view)
    shapes = linear.Shapes.of(splats, gaussians, scene)
    black = np.zeros((3, visible[0].count), np.float32)
    found, mine = linear.linear_view(visible, footprints, black, colors, shapes, view)
    seen = found, found.backward(found.errors), found.diagonal(mine)
    return round_rays.LinearRays(shapes, [seen])


def forward(found, change):
    """Return by how much the colours of the only view change with parameters, (13, N)."""
    return found.views[0].forward(found.shapes.in_scene(change))


def backward(found, errors):
    """Return the transpose of `forward` times some errors of the colours, (13, N)."""
    view = found.views[0]
    sums = np.zeros((len(view.backward(errors)), len(found.shapes)), np.float32)
    sums[:, view.hit] = view.backward(errors)
    return found.shapes.by_parameter(sums)


@pytest.mark.slow
@pytest.mark.usefixtures("squares")
@pytest.mark.parametrize("model", ["default", "2dgs"])
@pytest.mark.parametrize("parameter", range(linear.COUNT))
def test_derivatives_are_those_of_differences_in_float64(monkeypatch, model, parameter):
    """At the pixels that a splat hits: beyond, footprints are cut off.

    What is cut off of those behind changes the colour behind by up to 1 / 255 each. Discs are a
    third as large, as that nearer parts of one change more than farther ones is left out, so that
    half of the pixels count; the last is a tenth of a pixel wide, and drawn by its low-pass alone.
    """
    for name, limit in refit.MAX_STEP.items():
        monkeypatch.setitem(refit.MAX_STEP, name, max(limit, 1.0))
    splats, view, step, grid, discs = few(), ring()[0], 1e-5, (COLUMNS, ROWS), model == "2dgs"
    if discs:
        smaller = splats.log_scales - np.log(np.append(np.full(11, 3.0), 300.0))[:, None]
        splats = with_model(replace(splats, log_scales=smaller), model)
        step, grid = 1e-6, (np.arange(80), np.arange(60))
    found = linear_of(splats, view, pixels=grid)
    (seen,), errors = found.views, []
    ray = np.repeat(seen.hitting, seen.counts)
    pixels = np.stack([axis.ravel() + 0.5 for axis in np.meshgrid(*grid)], axis=1)
    for place, row in enumerate(seen.hit if discs else seen.hit[:4]):
        change, hit = np.zeros((linear.COUNT, 12)), ray[seen.owner == place]
        change[parameter, row] = step
        ahead, behind = (
            drawn(refit._moved(splats, way * change), view, splats, pixels[hit]) for way in (1, -1)
        )
        expected = (ahead - behind) / (2.0 * step)
        told = forward(found, (change / step).astype(np.float32))[:, hit]
        error = np.abs(told - expected).max(axis=0)
        scale = np.abs(expected).max()
        errors.append(np.median(error) / (scale + 1e-3) if discs else error.max() / (scale + 5e-3))

    assert len(errors) >= (7 if discs else 4)
    assert max(errors) < (0.05 if discs else 0.02)


@pytest.mark.parametrize("model", ["default", "2dgs"])
def test_backward_is_the_transpose_of_forward(model):
    """The inner products of J x with r and of x with J'r are the same number.

    The diagonal is the squared length of each column; of a channel's three harmonics their mean.
    """
    found = linear_of(with_model(few(), model), ring()[0])
    random = np.random.default_rng(1)
    change = random.normal(size=(linear.COUNT, 12)).astype(np.float32)
    errors = random.normal(size=found.views[0].errors.shape).astype(np.float32)
    one = float(np.vdot(forward(found, change), errors))
    other = float(np.vdot(backward(found, errors), change))
    twice = backward(found, forward(found, change))

    assert one == pytest.approx(other, rel=1e-4)
    np.testing.assert_array_equal(found.residual, backward(found, found.views[0].errors))
    np.testing.assert_allclose(found.normal(change, silent, 1), twice, atol=1e-6)
    squared = np.zeros(linear.COUNT)
    for parameter in range(linear.COUNT):
        unit = np.zeros((linear.COUNT, 12), np.float32)
        unit[parameter, 3] = 1.0
        squared[parameter] = (forward(found, unit) ** 2).sum()
    means = squared[linear.DEGREE_1].reshape(3, 3).mean(axis=0)
    squared[linear.DEGREE_1] = np.tile(means, 3)
    np.testing.assert_allclose(found.diagonal[:, 3], squared, rtol=1e-3)


def test_harmonics_of_the_first_degree_are_learned_and_those_above_stay():
    """Splats without view-dependent colour learn that of the unpruned ones; 1 dB more by it."""
    rest = np.random.default_rng(3).normal(scale=0.2, size=(200, 8, 3))
    rest[:, 3:] *= 0.01
    splats = replace(cloud(200), sh_rest=rest)
    flat = replace(splats, sh_rest=np.concatenate([np.zeros((200, 3, 3)), rest[:, 3:]], axis=1))
    every, constant = (
        refit.refit(kept, splats, ring(), 1) for kept in (flat, flat.up_to_degree(0))
    )
    found = every.splats.sh_rest
    np.testing.assert_array_equal(found[:, 3:], rest[:, 3:])
    assert np.corrcoef(found[:, :3].ravel(), rest[:, :3].ravel())[0, 1] > 0.7
    assert constant.splats.sh_rest.shape == (200, 0, 3)
    assert every.psnr > constant.psnr + 1.0


@pytest.mark.slow
@pytest.mark.parametrize("model", ["antialiased", "2dgs"])
def test_splats_of_other_models_gain_by_their_shapes_too(model):
    """Half of a cloud gains 1.5 dB at least in two rounds; colours and opacities alone, .7 or 1."""
    splats = with_model(cloud(300), model)
    kept = splats.take(np.arange(0, 300, 2))
    found = refit.refit(kept, splats, ring(), 2)

    assert found.psnr > found.psnr_before + 1.5
    assert found.splats.model == model
    assert not np.array_equal(found.splats.means, kept.means)
    assert np.array_equal(found.splats.log_scales[:, 2], kept.log_scales[:, 2]) == (model == "2dgs")


def test_a_round_that_loses_is_undone_and_rounds_end_where_little_is_gained(monkeypatch):
    """What the validation rays say is given: a gain, a loss, a gain, and one too small to go on."""
    said = iter([30.0, 31.0, 29.0, 32.0, 32.01])
    monkeypatch.setattr(round_rays.RoundRays, "psnr", lambda *_: next(said))
    splats = cloud(60)
    found = list(refit.refit_rounds(splats.take(np.arange(30)), splats, ring()))

    assert [(each.rounds, each.psnr) for each in found] == [
        (0, 30.0), (1, 31.0), (2, 32.0), (3, 32.01)
    ]  # fmt: skip


@pytest.mark.slow
def test_kept_splats_come_nearer_to_what_the_views_see_but_the_protected_and_unseen():
    """Half of a cloud: some dB on rays that nothing was fitted to. Quaternions have any length.

    A mean stays where a move would be worth less than a change of order. All kept, nothing does.
    """
    splats = cloud(400)
    kept = splats.take(np.arange(0, 400, 2))
    means = kept.means.copy()
    means[100:120] += 1e4  # no view sees them
    kept = replace(kept, means=means, quaternions=kept.quaternions * np.float32(3.0))
    protected = np.arange(200) < 20
    found = refit.refit(kept, splats, ring(), protected=protected)
    nothing = refit.refit(splats, splats, ring())
    still = protected.copy()
    still[100:120] = True
    assert found.psnr > found.psnr_before + 2.0
    assert not found.changed[still].any()
    assert found.changed[~still].mean() > 0.9
    for name in ARRAYS:
        old, new = getattr(kept, name), getattr(found.splats, name)
        np.testing.assert_array_equal(new[~found.changed], old[~found.changed])
        assert not np.array_equal(new, old)
        assert new.dtype == old.dtype
    assert (found.splats.means == kept.means).all(axis=1)[found.changed].any()
    assert nothing.psnr == nothing.psnr_before == 100.0
    assert not nothing.changed.any()


@pytest.mark.slow
@pytest.mark.parametrize("how", ["1 thread", "3 threads", "file", "processes"])
def test_threads_files_and_processes_change_no_bit(monkeypatch, how):
    """Derivatives of views may lie in a file; views may be cast elsewhere, and here none then."""
    splats, here = cloud(300), []
    kept = splats.take(np.arange(100))
    expected = refit.refit(kept, splats, ring(), 2, threads=2)
    if how == "file":
        monkeypatch.setattr(round_rays, "HELD", 0)
    if how == "processes":
        for name in ("WORTH", "WORTH_READY"):
            monkeypatch.setattr(execute, name, 0.0)
        monkeypatch.setattr(casting, "cast_visible", lambda *some: here.append(some))
    threads = int(how[0]) if "thread" in how else 2
    found = refit.refit(kept, splats, ring(), 2, threads=threads)

    assert not here
    assert (found.psnr, found.rounds) == (expected.psnr, 2)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(found.splats, name), getattr(expected.splats, name))


def test_what_a_file_has_no_room_for_stays_in_memory(monkeypatch):
    """The third write ends half-way, as on a full disk, and the next one begins behind it."""
    items = [{"one": np.arange(k, k + 7), "two": np.zeros((k, 0))} for k in range(3)]
    monkeypatch.setattr(round_rays, "HELD", 0)
    kept = round_rays.Stored()
    kept.append(items[0])
    file = kept._file
    kept._file = SimpleNamespace(
        seek=file.seek, read=file.read, write=lambda given: file.write(given[: len(given) - 3])
    )
    kept.append(items[1])
    kept._file = file
    kept.append(items[2])

    assert [isinstance(place, bytes) for place in kept._places] == [False, True, False]
    for found, expected in zip(kept, items, strict=True):
        for name, values in expected.items():
            np.testing.assert_array_equal(found[name], values)
            assert found[name].shape == values.shape


@pytest.mark.parametrize("pairs", [50, 1 << 15])
def test_rays_end_behind_what_is_opaque_and_see_the_same(monkeypatch, pairs):
    """To the bit what is visible of all hits, however many pairs are looked at together.

    Behind two opaque splats of alpha .99 no more than 1e-4 is left, and a third hides the rest.
    """
    monkeypatch.setattr(casting, "_PAIRS", pairs)
    splats, view = cloud(400), ring()[0]
    logs = splats.log_scales + 1.0
    splats = replace(splats, opacity_logits=np.full(400, 9.0), log_scales=logs)
    gaussians, scene, _ = projection.prepare(splats, ViewSet((view,)))
    every = cast(projection.project(gaussians, scene, view), COLUMNS, ROWS)
    seen, transmittance = every.visible()
    found, left = cast_visible(projection.project(gaussians, scene, view), COLUMNS, ROWS)
    for name in ("ray", "owner", "alpha", "log_passed", "hit"):
        np.testing.assert_array_equal(getattr(found, name), getattr(seen, name))
    np.testing.assert_array_equal(left, transmittance)
    assert len(seen.ray) < 0.8 * len(every.ray)
    colors, some = (
        rays.colors(colors_from(splats, gaussians.index[rays.hit], view)) for rays in (every, seen)
    )
    np.testing.assert_array_equal(some, colors)


@pytest.mark.parametrize("degree", range(5))
def test_colours_in_float32_are_those_in_float64(degree):
    """To a few roundings of sums of up to 25 products."""
    random = np.random.default_rng(degree)
    along = random.normal(size=(50, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    harmonics = random.normal(size=(50, 3, (degree + 1) ** 2)).astype(np.float32)
    dc, rest = harmonics[:, :, 0], harmonics[:, :, 1:].transpose(0, 2, 1)
    found = spherical_harmonics.single_colors(along.T, harmonics)

    np.testing.assert_allclose(found.T, spherical_harmonics.colors(along, dc, rest), atol=1e-5)


TURN = rotation([3, -1, 2], 111.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "turn", "step"),
    [
        (1e-6, np.eye(3), [0, 0, 0]),
        (1e6, np.eye(3), [0, 0, 0]),
        (1e30, np.eye(3), [0, 0, 0]),  # squares are no float32
        (1.0, TURN, [-3, 5, 9]),
        (1.0, TURN, [1e6, -1e6, 1e6]),  # doubles keep 1e-10 of it
    ],
)
def test_units_motions_and_the_order_of_splats_change_nothing(size, turn, step):
    """Positions, sizes and cameras under one similarity: what was learned goes along."""
    splats, kept = cloud(200), np.random.default_rng(5).permutation(200)[:100]
    one = refit.refit(splats.take(np.sort(kept)), splats, ring(), 1)
    there, views = moved(splats, ring(), turn, np.array(step))
    there = replace(there, means=there.means * size, log_scales=there.log_scales + np.log(size))
    views = ViewSet(tuple(replace(view, center=view.center * size) for view in views))
    other = refit.refit(there.take(kept), there.take(slice(None, None, -1)), views, 1)

    assert one.psnr > one.psnr_before + 0.5
    assert other.psnr == pytest.approx(one.psnr, abs=0.05)
    expected = one.splats.means[np.argsort(np.argsort(kept))] @ turn.T + step
    away = np.linalg.norm(other.splats.means / size - expected, axis=1)
    assert np.median(away) < 1e-4
    learned = np.linalg.norm(one.splats.means - splats.means[np.sort(kept)], axis=1)
    assert np.median(learned) > 0.005
    for name, most in (("log_scales", 0.3), ("opacity_logits", 1.0), ("sh_dc", 0.5)):
        change = getattr(one.splats, name) - getattr(splats, name)[np.sort(kept)]
        assert np.abs(change).max() <= most + 1e-6


VAST = np.tile([1e300, -1e300, np.finfo(np.float32).max], (3, 1))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("opacity_logits", np.inf),
        ("opacity_logits", -np.inf),
        ("log_scales", [-100.0, -2.0, -2.0]),
        ("log_scales", 30.0),
        ("means", 0.0),
        ("means", np.nan),
        ("sh_rest", VAST),
    ],
    ids=["opaque", "clear", "flat", "vast", "together", "undrawable", "harmonics"],
)
def test_extreme_splats_make_no_warning_and_nothing_worse(name, value):
    """Every second one; harmonics beyond what float32 holds, of either sign."""
    splats = cloud(200)
    strange = replace(splats, **{name: getattr(splats, name).copy()})
    getattr(strange, name)[::2] = value
    kept = strange.take(np.arange(100))
    found = refit.refit(kept, splats if name != "sh_rest" else strange, ring(), 2)

    assert found.psnr >= found.psnr_before
    assert np.isfinite(found.splats.sh_rest).all()
    np.testing.assert_array_equal(drawable(found.splats), drawable(kept))


@pytest.mark.parametrize("count", [1, 3])
def test_views_in_one_place_refit_nothing_and_the_note_says_so(count):
    """What fits them is worse from elsewhere: from one view 18.9 dB became 18.3 in the others.

    Two views of one pixel and one splat are enough.
    """
    splats, views = cloud(200), ViewSet((ring()[0],) * count)
    lens = {"width": 1, "height": 1, "cx": 0.5, "cy": 0.5}
    tiny = ViewSet(tuple(replace(view, **lens) for view in ring())[:2])
    found = refit.refit(splats.take(np.arange(100)), splats, views)
    pixel = refit.refit(splats.take(np.arange(1)), splats, tiny)

    assert (found.rounds, found.changed.any()) == (0, False)
    assert found.psnr == found.psnr_before
    assert found.note(1.0) == refit.ONE_PLACE
    assert pixel.psnr >= pixel.psnr_before


@pytest.mark.parametrize("rounds", [0, -1, refit.MOST_ROUNDS + 1, 1_000_000])
def test_rounds_out_of_range_are_refused(rounds):
    """With what was got and what was expected, by the function and by settings."""
    splats, words = cloud(10), f"rounds is {rounds}, expected 1 to {refit.MOST_ROUNDS}"

    with pytest.raises(core.RefineError, match=words):
        refit.refit(splats, splats, ring(), rounds)
    with pytest.raises(core.RefineError, match=words):
        methods.Refit(rounds=rounds)
