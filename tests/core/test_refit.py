"""Refitting: what it learns, and its laws."""

import contextlib
from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import ViewSet, execute, spherical_harmonics
from refine_addon.core.refit import refit, round_rays
from refine_addon.core.splats import ARRAYS, MODELS, drawable, rotation_matrices, with_model
from refine_addon.core.visibility import cast as casting
from refine_addon.core.visibility import projection
from refine_addon.core.visibility.cast import cast, cast_visible
from tests.core.test_invariance import moved, rotation
from tests.core.test_levels import equal
from tests.core.test_occlusion import cloud, ring
from tests.hostile import files_of_at_most

NOISE = [*zip(ARRAYS, (0.02, 0.1, 0.1, 0.3, 0.1, 0.05), strict=True)]
TURN = rotation([3, -1, 2], 111.0)
COLUMNS, ROWS = np.arange(3, 78, 8), np.arange(4, 58, 8)


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(("name", "noise"), NOISE)
def test_splats_that_are_off_in_one_attribute_come_back(name, noise, model):
    """Two rounds undo 40 % of it at least; a derivative of the wrong sign gains 4 dB at most.

    Discs turn in less than all else, and have no third scale to learn.
    """
    splats = with_model(cloud(60), model)
    values = rotation_matrices if name == "quaternions" else np.asarray
    old = getattr(splats, name)
    change = np.random.default_rng(1).normal(0.0, noise, old.shape)
    kept = replace(splats, **{name: old + change})
    *_, found = refit.refit_rounds(kept, splats, ring(), 2)
    before, after = (
        np.median(np.abs(values(getattr(each, name)) - values(old)))
        for each in (kept, found.splats)
    )
    assert found.psnr > found.psnr_before + (2.5 if model == "2dgs" else 9.0)
    assert after < 0.6 * before
    assert found.splats.model == model
    third = found.splats.log_scales[:, 2]
    assert np.array_equal(third, kept.log_scales[:, 2]) == (model == "2dgs")


def test_harmonics_above_the_first_degree_stay_and_none_are_added():
    rest = np.random.default_rng(3).normal(scale=0.1, size=(200, 8, 3))
    splats = replace(cloud(200), sh_rest=rest)
    some, none = (
        [*refit.refit_rounds(whole.take(np.arange(100)), splats, ring(), 1)][-1].splats.sh_rest
        for whole in (splats, splats.up_to_degree(0))
    )
    np.testing.assert_array_equal(some[:, 3:], rest[:100, 3:])
    assert not np.array_equal(some[:, :3], rest[:100, :3])
    assert none.shape == (100, 0, 3)


@pytest.mark.parametrize("last", [30.5, 31.01])
def test_a_round_that_loses_is_undone_and_rounds_end_where_little_is_gained(monkeypatch, last):
    """Validation rays say: a gain, and a loss or a gain too small to go on."""
    said, best = iter([30.0, 31.0, last]), max(31.0, last)
    monkeypatch.setattr(round_rays.RoundRays, "psnr", lambda *_: next(said))
    splats = cloud(60)
    found = list(refit.refit_rounds(splats.take(np.arange(30)), splats, ring()))
    assert [each.psnr for each in found] == sorted({30.0, 31.0, best})
    assert [each.rounds for each in found] == list(range(len(found)))


@pytest.mark.slow
def test_kept_splats_come_nearer_to_what_the_views_see_but_the_protected_and_unseen():
    """On rays that nothing was fitted to; some means stay. All kept, nothing changes."""
    splats = cloud(400)
    kept = splats.take(np.arange(0, 400, 2))
    means = kept.means.copy()
    means[100:120] += 1e4  # no view sees them
    kept = replace(kept, means=means, quaternions=kept.quaternions * np.float32(3.0))
    protected = np.arange(200) < 20
    *_, found = refit.refit_rounds(kept, splats, ring(), protected=protected)
    *_, nothing = refit.refit_rounds(splats, splats, ring())
    still = protected | (np.arange(200) // 20 == 5)
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
@pytest.mark.parametrize("how", ["1 thread", "3 threads", "full disk", "processes"])
def test_threads_files_and_processes_change_no_bit(monkeypatch, how):
    """Derivatives of views lie in a file, as far as it has room; in processes views are cast."""
    splats, here = cloud(300), []
    kept = splats.take(np.arange(100))
    expected = execute.within(cores=2)(list)(refit.refit_rounds(kept, splats, ring(), 2))[-1]
    if how == "processes":
        for name in ("WORTH", "WORTH_READY"):
            monkeypatch.setattr(execute, name, 0.0)
        monkeypatch.setattr(casting, "cast_visible", lambda *some: here.append(some))
    threads = int(how[0]) if "thread" in how else 2
    with files_of_at_most(600_000) if how == "full disk" else contextlib.nullcontext():
        found = execute.within(cores=threads)(list)(refit.refit_rounds(kept, splats, ring(), 2))[-1]
    assert not here
    assert (found.psnr, found.rounds) == (expected.psnr, 2)
    assert equal(found.splats, expected.splats)


@pytest.mark.parametrize("pairs", [50, 1 << 15])
def test_rays_end_behind_what_is_opaque_and_see_the_same(monkeypatch, pairs):
    """To the bit what is visible of all hits: two of alpha .99 let less than 1e-3 through."""
    monkeypatch.setattr(casting, "_PAIRS", pairs)
    splats, view = cloud(400), ring()[0]
    logs = splats.log_scales + 1.0
    splats = replace(splats, opacity_logits=np.full(400, 9.0), log_scales=logs)
    gaussians, scene, _ = projection.prepare(splats, ViewSet((view,)))
    every = cast(projection.project(gaussians, scene, view), COLUMNS, ROWS)
    seen, transmittance = every.visible(casting.LOG_DIM)
    found, left = cast_visible(projection.project(gaussians, scene, view), COLUMNS, ROWS)
    for name in ("ray", "owner", "alpha", "hit"):
        np.testing.assert_array_equal(getattr(found, name), getattr(seen, name))
    np.testing.assert_array_equal(left, transmittance)
    assert len(seen.ray) < 0.8 * len(every.ray)


@pytest.mark.parametrize("degree", range(5))
def test_colours_in_float32_are_those_in_float64(degree):
    """To a few roundings of sums of up to 25 products. One that stands for all has no colour."""
    random = np.random.default_rng(degree)
    along = random.normal(size=(50, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    harmonics = random.normal(size=(50, (degree + 1) ** 2, 3)).astype(np.float32)
    found = spherical_harmonics.colors(along, harmonics[:, 0], harmonics[:, min(degree, 1) :])
    expected = 0.5 + np.einsum("nk,nkc->nc", spherical_harmonics.basis(along, degree), harmonics)
    np.testing.assert_allclose(found, expected, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("size", "turn", "step"),
    [
        (1e-6, np.eye(3), [0, 0, 0]),
        (1e6, np.eye(3), [0, 0, 0]),
        (1e29, np.eye(3), [0, 0, 0]),  # squares are no float32
        (1.0, TURN, [-3, 5, 9]),
        (1.0, TURN, [1e6, -1e6, 1e6]),  # doubles keep 1e-10 of it
    ],
)
def test_units_motions_and_the_order_of_splats_change_nothing(size, turn, step):
    splats, kept = cloud(200), np.random.default_rng(5).permutation(200)[:100]
    *_, one = refit.refit_rounds(splats.take(np.sort(kept)), splats, ring(), 1)
    there, views = moved(splats, ring(), turn, np.array(step), size)
    *_, other = refit.refit_rounds(there.take(kept), there.take(slice(None, None, -1)), views, 1)
    assert one.psnr > one.psnr_before + 0.5
    assert other.psnr == pytest.approx(one.psnr, abs=0.05)
    expected = one.splats.means[np.argsort(np.argsort(kept))] @ turn.T + step
    away = np.linalg.norm(other.splats.means / size - expected, axis=1)
    assert np.median(away) < 1e-4
    learned = np.linalg.norm(one.splats.means - splats.means[np.sort(kept)], axis=1)
    assert np.median(learned) > 0.005


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("log_scales", [-100.0, -2.0, -2.0]),
        ("log_scales", 30.0),
        ("means", np.nan),
        ("sh_rest", np.tile([1e300, -1e300, np.finfo(np.float32).max], (3, 1))),
    ],
    ids=["flat", "vast", "undrawable", "harmonics"],
)
def test_extreme_splats_make_no_warning_and_nothing_worse(name, value):
    """Every second one; harmonics beyond what float32 holds."""
    splats = cloud(200)
    strange = replace(splats, **{name: getattr(splats, name).copy()})
    getattr(strange, name)[::2] = value
    kept = strange.take(np.arange(100))
    *_, found = refit.refit_rounds(kept, splats if name != "sh_rest" else strange, ring(), 2)
    assert found.psnr >= found.psnr_before
    assert np.isfinite(found.splats.sh_rest).all()
    np.testing.assert_array_equal(drawable(found.splats), drawable(kept))


@pytest.mark.parametrize("count", [1, 3])
def test_views_in_one_place_refit_nothing_and_the_note_says_so(count):
    """What fits them is worse from elsewhere. Two views of one pixel and one splat are enough."""
    splats, views = cloud(200), ViewSet((ring()[0],) * count)
    lens = {"width": 1, "height": 1, "cx": 0.5, "cy": 0.5}
    tiny = ViewSet(tuple(replace(view, **lens) for view in ring())[:2])
    *_, found = refit.refit_rounds(splats.take(np.arange(100)), splats, views)
    *_, pixel = refit.refit_rounds(splats.take(np.arange(1)), splats, tiny)
    assert (found.rounds, found.changed.any()) == (0, False)
    assert found.psnr == found.psnr_before
    assert found.note(1.0) == refit.ONE_PLACE
    assert pixel.psnr >= pixel.psnr_before
