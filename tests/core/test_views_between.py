"""Views between neighbouring ones, and what the estimate tells of them."""

from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import Budget, Merge, Occlusion, ViewSet, prune, select
from refine_addon.core.quality.psnr import psnr_against, psnr_kept
from refine_addon.core.scoring import occlusion
from refine_addon.core.visibility import projection
from refine_addon.core.visibility.between import (
    transmittance,
    views_beside,
    views_between,
    with_views_between,
)
from tests.core.test_invariance import MOTIONS, moved
from tests.core.test_levels import merges  # noqa: F401 - a fixture
from tests.core.test_occlusion import splats_of
from tests.core.test_views import ring, view


def line(*places: float, **how) -> ViewSet:
    return ViewSet(tuple(view([x, 0.0, 0.0], name=f"at {x}", **how) for x in places))


def test_a_view_between_two_stands_halfway_and_looks_halfway():
    """Neighbours of a ring of eight are 45 degrees apart: theirs is at 22.5, and looks inwards."""
    between = views_between(ring(8), 8)
    first = min(between, key=lambda view: abs(np.degrees(np.arctan2(*view.center[1::-1])) - 22.5))
    direction = -np.array([np.cos(np.pi / 8), np.sin(np.pi / 8), 0.0])
    assert len(between) == 8
    np.testing.assert_allclose(first.center, -3.0 * np.cos(np.pi / 8) * direction, atol=1e-12)
    np.testing.assert_allclose(first.rotation[2], direction, atol=1e-12)


def test_only_neighbours_have_a_view_between_them():
    """Of views at 0, 1 and 3 those at 0 and 3 have another in the middle.

    More than pairs go between those between: 5 are the middle, two quarters, two of four eighths.
    None stands behind the wall at 2, nor do 30 beside each view, which do not face it near by.
    """
    views = line(0.0, 8.0, rotation=np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]))
    walls = [splats_of([(x, 0.0, 0.0)], 0.99, [(0.01, 9.0, 9.0)]) for x in (99.0, 2.0)]
    free, shut = (projection.prepare(wall, views)[:2] for wall in walls)
    five = {view.center[0] for view in with_views_between(views, 5, *free)}
    beside = views_beside(views, *shut, 3.5, 60, 0)
    assert sorted(view.center[0] for view in views_between(line(0.0, 1.0, 3.0), 9)) == [0.5, 2.0]
    assert (len(five), len(beside)) == (5, 60)
    assert {2.0, 4.0, 6.0} < five < set(np.arange(9.0))
    assert transmittance(*shut, *views.centers) == pytest.approx(0.01, abs=1e-3)
    assert with_views_between(views, 5, *shut) == []
    clear = []
    for one, near in ((each, views[each.name.endswith("8.0")].center) for each in beside):
        moved_by = np.linalg.norm(one.center - near) * one.rotation[2]
        assert (one.center[0] < 2.0) == (near[0] < 2.0)
        ahead = (one.center + share * moved_by for share in (0.5, 1.0))
        clear.append([transmittance(*shut, one.center, place) > 0.5 for place in ahead])
    assert np.all(clear, axis=0)[0]
    assert np.sum(clear, axis=0)[1] >= 57  # the last of two steps counts, not both


@pytest.mark.parametrize(
    "views",
    [
        line(1.0),
        line(1.0, 1.0, 1.0),
        ViewSet((view(), view([1, 0, 0], rotation=np.diag([-1.0, 1, -1]), name="back"))),
        ViewSet((view(), view([1, 0, 0], rotation=np.diag([-1.0, 1, 1]), name="glass"))),
    ],
)
def test_where_nothing_is_between_there_is_no_view(views):
    """One view, views in one place, views that look away from each other, and a mirrored one."""
    assert views_between(views, 9) == []


def test_views_between_depend_on_nothing_but_the_scene():
    """Neither the order of the views nor a motion of the world changes which there are."""
    views = ring(9)
    wanted = {view.name: view for view in views_between(views, 4)}
    shuffled = views_between(views.take([4, 8, 0, 2, 7, 1, 3, 6, 5]), 4)
    assert {view.name for view in shuffled} == set(wanted)
    for motion in MOTIONS.values():
        _, turned = moved(splats_of([(0.0, 0.0, 0.0)]), views, *motion)
        assert {view.name for view in views_between(turned, 4)} == set(wanted)


def hidden_from_the_sides() -> tuple:
    """Return a red patch that posts hide from two cameras, and that one between them sees.

    From x = -1 and 1 the rays to (0, 0, 4) pass z = 2 at x = -.5 and .5, where the posts are. The
    first 225 splats are the wall behind all, then comes the patch, then the posts.
    """
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 15)] * 2), axis=-1).reshape(-1, 2)
    parts = [(4.0 * grid, 6.0, 0.4), (0.3 * grid, 4.0, 0.03)]
    parts += [(0.3 * grid + (x, 0.0), 2.0, 0.05) for x in (-0.55, 0.55)]
    means = np.concatenate([np.column_stack([xy, np.full(len(xy), z)]) for xy, z, _ in parts])
    scales = np.repeat([size for _, _, size in parts], len(grid))
    splats = splats_of(means, 0.99, scales[:, None])
    patch = slice(len(grid), 2 * len(grid))
    colors = np.zeros((len(means), 3), np.float32)
    colors[patch] = (1.5, -1.5, -1.5)
    views = [view([x, 0.0, 0.0], fx=80.0, fy=80.0, name=str(x)) for x in (-1.0, 1.0)]
    return replace(splats, sh_dc=colors), ViewSet(tuple(views)), patch


@pytest.mark.slow
@pytest.mark.parametrize("method", [Occlusion(exact=True), Merge(exact=True)])
def test_what_only_views_between_see_is_told_and_warned_of(merges, method):
    """A quarter of the splats is the patch and goes: the two cameras see no change.

    At the middle the patch fills a seventh of the width and a fifth of the height: .03 of the
    picture. Where it is gone gray stands for red, .4 off in each channel: -10 log(.03 .16) = 23 dB,
    and more where a part of it stays. Twelve cameras, six in each place, tell it; two do not.
    """
    splats, two, patch = hidden_from_the_sides()
    views = ViewSet(tuple(replace(each, name=f"{each.name} {k}") for each in two for k in range(6)))
    result, few = (prune(splats, each, Budget(ratio=0.25), method) for each in (views, two))
    said, rays = (" ".join(each.report["notes"]) for each in (result, few)), result.scores.between
    told, untold = (each.report["estimated_psnr_between"] for each in (result, few))
    assert np.mean(result.keep[patch]) < 0.1
    assert result.report["estimated_psnr"] > 80.0
    assert 23.0 < told < 32.0
    assert untold is None
    endings = "about", "how much is not known"
    assert all(f"lose more, {end}" in words for end, words in zip(endings, said, strict=True))
    assert {view.center[0] for view, _ in rays.views} == {0.0}
    if isinstance(method, Occlusion):
        assert told == pytest.approx(psnr_kept(rays, result.keep), abs=0.01)
        kept = select(result.scores, Budget(ratio=0.3))  # a share that the curve has
        curve = result.scores.quality
        assert psnr_kept(rays, kept) == pytest.approx(curve.at_between(0.3), abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("method", [Occlusion(), Merge()])
def test_views_between_few_cameras_decide_and_keep_what_they_see(merges, method):
    """The patch stays, or splats that stand for it, unless the cameras are exact; it is said."""
    splats, views, _ = hidden_from_the_sides()
    shot = replace(views, exact=True)
    result, exact = (prune(splats, each, Budget(ratio=0.25), method) for each in (views, shot))
    one = prune(splats, views.take([0]), Budget(ratio=0.3))
    rays = exact.scores.between
    assert psnr_against(rays, result.splats, views) > 35.0
    assert len(result.scores.between.validating()) > 24
    assert psnr_against(rays, exact.splats, views) < 32.0
    assert result.report["views"] == {"given": 2, "used": 2, "between": 10}
    assert "few cameras: 10 views near them decide, too" in " ".join(result.report["notes"])
    assert result.scores.seen.max() == 2
    assert exact.report["views"]["between"] == one.report["views"]["between"] == 0


@pytest.mark.parametrize("between", [0, 4])
def test_rounds_after_one_give_the_scores_of_all_rounds(between):
    """To the bit, whether views between decide or not, though no view is measured again."""
    given = hidden_from_the_sides()[:2]
    how = {"few_views": True, "most_between": between}
    once, measured = occlusion.score(*given, rounds=1, **how)
    scores, _ = occlusion.score(*given, **how)
    found = occlusion.in_rounds(given[0], once, measured).values
    assert scores.views_between == (10 if between else 0)
    np.testing.assert_array_equal(found, scores.values)
    assert (found != once.values).any()
