"""Rivals: the published formula, GHAP, removal in rounds, splat-transform as a program."""

import math
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("numba")

from benchmarks.baselines import merging, splat_transform
from benchmarks.baselines.refine import refine
from benchmarks.baselines.rendered import removed_in_rounds
from benchmarks.renderer.rasterizer import accumulate_statistics
from refine_addon.core.errors import RefineError
from refine_addon.core.formats.ply import read_ply
from refine_addon.core.splats import opacity, rotation_matrices
from refine_addon.core.views import View, ViewSet
from tests.benchmarks.scenes import cube_scene, round_scene
from tests.core.test_closed_form import three_splats
from tests.places import ROOM

CLOUD = ROOM / "point_cloud.ply"


@pytest.mark.parametrize(
    ("depth", "eta", "offset"), [("z", 0.05, 0.05), ("distance", 0.5, 1e-6)], ids=["paper", "code"]
)
def test_both_published_readings_give_the_numbers_worked_out_by_hand(depth, eta, offset):
    """On the axis depth and distance agree: d = 1, 2, 3 and H_i = (1/2) / (d^2 + eta).

    Geometry G = 1, 4, 3; colour luma^2 = 0, 1/4, 1; opacity 1/4 each.
    F_gem = (1/(1 + o) + 2/(1 + o) + 3/(1 + o)) / 3 = 2 / (1 + o); F_col = var(0, 1/2, 1) = 1/6;
    mean 4 a (1 - a) = 1. So lt = ln(2 / (1 + o) + o) / 10.73, 100 / 6 / 56.06, 100 / 100.67.
    """
    splats, views = three_splats()
    h = 0.5 / (np.array([1.0, 4.0, 9.0]) + eta)
    lt = [math.log(2 / (1 + offset) + offset) / 10.73, 100 / 6 / 56.06, 100 / 100.67]
    attributes = np.array([[1.0, 4.0, 3.0], [0.0, 0.25, 1.0], [0.25, 0.25, 0.25]]) * h
    shares = attributes / attributes.mean(axis=1, keepdims=True)

    np.testing.assert_allclose(refine(splats, views, depth), lt @ shares / sum(lt), rtol=1e-6)


def test_the_papers_ablations_leave_out_what_they_name():
    """Without all three, each term counts a third and every view the same for every splat."""
    splats, views = three_splats()
    luma = np.array([0.0, 0.25, 1.0])
    expected = (np.array([1.0, 4.0, 3.0]) / (8 / 3) + luma / luma.mean() + 1.0) / 3

    found = refine(splats, views, "z", visibility=False, projection=False, equal_weights=True)

    np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.parametrize("dress", ["nearest", "moments"])
def test_ghap_leaves_exactly_as_many_as_asked_for(dress, monkeypatch):
    """Also where blocks get fractions of a splat: 400 splats make 16 blocks of 25.

    What cannot be drawn goes first. Nearest members are rows of the original, in their old order.
    """
    monkeypatch.setattr(merging, "BLOCK", 30)
    splats = cube_scene()
    splats.means[7] = np.nan

    for keep in (1, 3, 40, 399):
        found = merging.reduce(splats, keep, dress)
        assert len(found) == keep
        assert np.isfinite(found.means).all()
        assert found.sh_rest.shape == (keep, 3, 3)
        if dress == "nearest":
            same = (splats.means[:, None] == found.means).all(axis=2)
            rows = np.argmax(same, axis=0)
            assert same.any(axis=0).all()
            assert (np.diff(rows) > 0).all()
            np.testing.assert_array_equal(found.sh_rest, splats.sh_rest[rows])


def test_two_splats_become_one_with_the_moments_of_both():
    """Balls of scale 0.1 at x = -0.3 and 0.3, opacity 1/2 each.

    Mean 0; variance along x 0.01 + 0.09, across 0.01; the areas 0.01 each become 0.0316 x 0.1,
    so the opacity is 2 x 0.5 x 0.01 / (sqrt(0.1) x 0.1) = 0.316; the colours are averaged.
    """
    two = round_scene([[-0.3, 0, 0], [0.3, 0, 0]], [0.0, 0.0])
    two.sh_dc[:] = [[1.0, 0, 0], [0, 1.0, 0]]

    one = merging.reduce(two, 1, "moments")

    axes = rotation_matrices(one.quaternions)[0] * np.exp(one.log_scales[0])
    np.testing.assert_allclose(one.means, [[0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(axes @ axes.T, np.diag([0.1, 0.01, 0.01]), atol=1e-12)
    np.testing.assert_allclose(opacity(one.opacity_logits), 0.01 / (np.sqrt(0.1) * 0.1))
    np.testing.assert_allclose(one.sh_dc, [[0.5, 0.5, 0]])


def test_two_far_clusters_are_found_whatever_the_start():
    """Two knots of ten splats become one each, though both centres may start in the same."""
    splats = cube_scene(20)
    splats.means[:] = splats.means * 0.01 + np.repeat([[0, 0, 0], [10, 0, 0]], 10, axis=0)

    for seed in range(5):
        found = merging.reduce(splats, 2, "moments", seed=seed)
        assert np.sort(np.round(found.means[:, 0])).tolist() == [0, 10]


VIEWS = ViewSet((View(np.eye(3), np.zeros(3), 40.0, 40.0, 20.0, 15.0, 40, 30),))


def test_of_two_splats_that_stand_for_each_other_one_stays():
    """Errors follow from alpha u, u the footprint's Gaussian, by ``integral of change^2 / u du``.

    Removing one of two twins of opacity 1 changes a pixel by u (1 - u): 1/12. Removing one of two
    others, of opacity .6, by .6 u: .18. Removing the last of the twins, by u: 1/2. So at once both
    twins go; in rounds, one of them and the fainter of the others.
    """
    places = [[0, 0, 2], [0, 0, 2.01], [0.5, 0, 2], [-0.5, 0, 2]]
    splats = round_scene(places, [4.6, 4.6, 0.4, 0.45])

    in_rounds = removed_in_rounds(splats, VIEWS, 2, rounds=2)

    np.testing.assert_array_equal(removed_in_rounds(splats, VIEWS, 2, rounds=1), [2, 3])
    assert np.count_nonzero(in_rounds < 2) == 1
    assert in_rounds[1] == 3


@pytest.mark.parametrize("keep_count", [1, 7, 12])
def test_as_many_stay_as_asked_for_and_one_round_is_the_order_of_the_error(keep_count):
    """Whether or not the number removed is a multiple of the rounds; ascending indices."""
    rng = np.random.default_rng(0)
    places = rng.normal([0, 0, 3], 0.3, (12, 3)).tolist()
    splats = round_scene(places, rng.normal(0, 1, 12).tolist())
    error = accumulate_statistics(splats, VIEWS).removal_error

    once = removed_in_rounds(splats, VIEWS, keep_count, rounds=1)

    np.testing.assert_array_equal(once, np.sort(np.argsort(-error, kind="stable")[:keep_count]))
    assert len(removed_in_rounds(splats, VIEWS, keep_count)) == keep_count


def test_splat_transform_is_called_with_the_number_that_stays_and_says_why_it_fails(
    monkeypatch, tmp_path: Path
):
    """On the CPU, quietly, the flag and the count last; exit code and message where it fails."""
    target = tmp_path / "a.ply"
    say = f"import sys; open({str(target)!r}, 'w').write(' '.join(sys.argv[1:]))"
    monkeypatch.setattr(splat_transform, "find", lambda: [sys.executable, "-c", say])
    assert splat_transform.decimate(CLOUD, target, "--decimate", 123).seconds > 0.0
    assert target.read_text() == f"-g cpu -q -w {CLOUD} {target} --decimate 123"

    fail = "import sys; sys.exit('no adapter')"
    monkeypatch.setattr(splat_transform, "find", lambda: [sys.executable, "-c", fail])
    with pytest.raises(RefineError, match="ended with 1: no adapter"):
        splat_transform.decimate(CLOUD, target, "--decimate", 10)

    monkeypatch.setattr(splat_transform, "find", lambda: None)
    with pytest.raises(RefineError, match=r"python -m benchmarks\.baselines\.splat_transform"):
        splat_transform.decimate(CLOUD, target, "--decimate", 10)


@pytest.mark.skipif(splat_transform.find() is None, reason=splat_transform.MISSING)
def test_the_real_splat_transform_leaves_as_many_as_asked_for(tmp_path: Path):
    splat_transform.decimate(CLOUD, tmp_path / "a.ply", "--decimate", 20000)

    assert len(read_ply(tmp_path / "a.ply").splats()) == 20000
