"""Which reason a splat goes for, and by which evidence: one rule at a time."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from refine_addon.core import Cleaning, View, ViewSet, clean
from refine_addon.core.cleaning import search, support
from refine_addon.core.cleaning.clean import REASONS, judge
from refine_addon.core.cleaning.search import Search, is_slender
from refine_addon.core.execute import silent
from refine_addon.core.visibility import cast, projection

from .test_cleaning import FLOATER, SIDE, cameras, joined, made, wall

JUDGED = tuple(name for name in REASONS if name != "outside")
"""Of the wall, some is outside all views."""

ALL = Cleaning(JUDGED)


def stretched(place, scales, opacity=0.8, color=0.1):
    """Return one splat with a standard deviation along each axis."""
    return made([place], [scales], opacity, color)


VEIL = made([[0.0, 0.0, 2.0]], 1.5, 0.2, 0.1)


def reasons(*parts, count=1, views=6):
    """Return the reasons of the last splats before the wall, each once; the rest has none."""
    by_reason = clean(joined(wall(), *parts), cameras(views), ALL).by_reason
    told = np.stack([by_reason[name] for name in JUDGED])  # (6, N)

    assert told.sum(axis=0).max() <= 1
    assert not told[:, : SIDE**2].any()
    return {name: int(by_reason[name][-count:].sum()) for name in JUDGED if by_reason[name].any()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("splat", "expected"),
    [
        (stretched([0.1, 0, 2], [0.4, 0.01, 0.01]), "needle"),
        (stretched([0.1, 0, 2], [0.04, 0.003, 0.003]), "front"),
        (stretched([0.1, 0, 2], [0.3, 0.3, 0.003]), "front"),
        (made([[0.2, 0, 0.25]], 0.1, 0.8, 0.1), "front"),
        (made([[0.0, 0, 3.0]], 0.8, 0.5, 0.1), "front"),
        (VEIL, "giant"),
    ],
    ids=["needle", "short", "flake", "near", "far", "giant"],
)
def test_shapes_have_the_reason_of_their_kind(splat, expected):
    """At f = 60 and 80 px across; the scene's size is 4.76, so giants are longer than .71.

    A needle reaches 60 x .4 / 2 = 12 px, over 4; the short one 1.2. A flake is as wide as long.
    What is near reaches 24 px but is small; what is far is long but reaches 16 px, under 20."""
    assert reasons(splat, views=12) == {expected: 1}


@pytest.mark.slow
@pytest.mark.parametrize(("half", "expected"), [(0.7, {"giant": 1}), (1.4, {})])
def test_a_giant_may_lie_at_a_surface_by_less_than_half(monkeypatch, half, expected):
    """A solid square at its depth stops 25 % of the light near it; one of twice the side 89 %.

    In the colour of the wall it changes no pixel, and stays."""
    monkeypatch.setattr(search, "RAYS", 600)
    side = np.linspace(-half, half, 32)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    square = made(np.stack([x, y, np.full_like(x, 2.0)], axis=1), 0.07, 0.95, 0.5)
    assert reasons(square, VEIL, views=30) == expected
    assert reasons(made(VEIL.means, 1.5, 0.2, 0.9)) == {}


def clump(count=40):
    """Return splats that hold together in the air, and support each other, the inmost last."""
    places = np.random.default_rng(1).normal((0.0, 0.0, 2.0), 0.05, (count, 3))
    inmost_last = np.argsort(-np.linalg.norm(places - places.mean(axis=0), axis=1))
    return made(places[inmost_last], 0.06, 0.95, 0.1)


@pytest.mark.slow
def test_a_clump_is_isolated_and_each_splat_has_one_reason():
    """Those at its rim, which the others support little, are in front of the wall.

    Fog of opacity .05 that leads from it to the wall holds no cluster together.
    """
    depth = np.arange(2.3, 4.01, 0.1)
    fog = made(np.stack([0 * depth, 0 * depth, depth], axis=1), 0.06, 0.05, 0.1)
    told = reasons(clump(), count=40)
    assert told["isolated"] >= 36
    assert sum(told.values()) == 40
    assert not clean(joined(wall(), fog, clump()), cameras()).keep[-40:].any()


SUSPECTS = {"floater": FLOATER, "veil": VEIL, "nine": clump(9), "ten": clump(10)}


@cache
def searched(name):
    """Return Gaussians of a wall and what stands before it, what is found, the last one's row."""
    splats, views = joined(wall(), SUSPECTS[name]), cameras(2 if name == "veil" else 6)
    gaussians, scene, _ = projection.prepare(splats, views)
    slender = is_slender(splats.log_scales[gaussians.index])
    found = Search(gaussians, scene, list(views)).find(slender, silent)
    return gaussians, found, int(np.flatnonzero(gaussians.index == len(splats) - 1)[0])


def judged(name, near, behind, contrast, views, past, denied=()):
    """Return which splats float and show, and which only float, if views saw that of the last."""
    gaussians, found, row = searched(name)
    evidence = support.Evidence(*(values.copy() for values in found.evidence))
    seen = (near, behind, contrast * behind, views, past)
    for values, value in zip(evidence, seen, strict=True):
        values[row] = value
    by_part = found.by_part.copy()
    by_part[1, list(denied)] = 0.0
    back = np.argsort(gaussians.index)
    shows, faint, _ = judge(gaussians, found._replace(evidence=evidence, by_part=by_part))
    return shows[back], faint[back]


@pytest.mark.parametrize(
    ("name", "evidence", "expected"),
    [
        ("floater", (0.0, 1.0, 0.8, 20, 2), "shows"),
        ("floater", (0.0, 1.0, 0.8, 21, 2), ""),
        ("floater", (0.0, 1.0, 0.8, 2, 1), ""),
        ("floater", (0.49, 0.51, 0.8, 6, 6), "shows"),
        ("floater", (0.51, 0.49, 0.8, 6, 6), ""),
        ("floater", (0.0, 1.0, 0.0011, 6, 6), "shows"),
        ("floater", (0.0, 1.0, 0.0010, 6, 6), "faint"),
        ("floater", (0.0, 1.0, 0.0038, 2, 2), "shows"),
        ("floater", (0.0, 1.0, 0.0037, 2, 2), "faint"),
        ("veil", (0.49, 0.51, 0.8, 90, 0), "shows"),
        ("veil", (0.51, 0.49, 0.8, 90, 0), ""),
        ("veil", (0.3, 0.7, 0.8, 31, 0), "shows"),
        ("veil", (0.3, 0.7, 0.8, 29, 0), ""),
        ("veil", (0.0, 1.0, 0.50, 10, 10), "shows"),
        ("veil", (0.0, 1.0, 0.48, 10, 10), ""),
    ],
)
def test_evidence_decides_of_what_is_suspect(name, evidence, expected):
    """Light near and behind, contrast, views, views that see past: support is below .5.

    The floater needs two views at least that see past it, and one in ten. It changes a pixel by .8
    of its contrast: 4/255 over 7^1.5, .00085, where six do, and over 3^1.5, .0030, where two do.

    Past the veil no view need see; the light that passes counts, .7 x 31 views. Its standard
    deviation is 45 to 50 of 80 px, from the sides, up to 12.6 times .05. It touches 8 splats of the
    wall: 8 x 4/255 / 11^1.5 x 8^sqrt(8) is needed, 1.23, which is .098 x 12.6, and .098 is .2 of a
    contrast of .49. With .3 of the light near it 150^.3 times as much is needed: 1.93 of 31 views,
    2.13 of 29; .157, where the change ends, x 12.6 is 1.98.
    """
    shows, faint = judged(name, *evidence)
    assert shows[-1] == (expected == "shows")
    assert name == "veil" or faint[-1] == (expected == "faint")


@pytest.mark.slow
def test_a_clump_goes_as_one_unless_a_group_of_views_denies_it():
    """Of ten splats, the last has .051 of the light near it, and goes only with its clump.

    The six views are in four groups by turns: two views each in the first two, one in the others.
    Nine are no clump: what is only isolated must have less than .05 of the light near it.
    """
    _, found, row = searched("ten")
    assert found.by_part[1, :, row].tolist() == [2.0, 2.0, 1.0, 1.0]
    for denied in ((), (0,), (3,)):
        shows, _ = judged("ten", 0.051, 0.949, 0.8, 6, 6, denied)
        assert shows[-10:].tolist() == [True] * 9 + [not denied]
        assert not shows[: SIDE**2].any()
    for near, expected in ((0.049, True), (0.051, False)):
        assert judged("nine", near, 1.0 - near, 0.8, 6, 6)[0][-1] == expected


def test_aimed_rays_hit_what_rays_through_their_pixels_hit():
    """Of rays through all pixels, those that are aimed at: the same splats with the same alpha."""
    views = cameras()
    view = views.views[0]
    gaussians, scene, _ = projection.prepare(joined(wall(), FLOATER), views)
    footprints = projection.project(gaussians, scene, view)
    columns, rows = cast.pixels(view, 3, 50)
    aims = cast.aimed(view, columns, rows, footprints.centers[:, ::7])

    rays = cast.cast(footprints, columns, rows, aims)

    every = cast.cast(footprints, np.arange(view.width), np.arange(view.height))
    pixels = aims[1] * view.width + aims[0]

    def told(rays, pixel_of):
        """Return the alpha of each pixel and splat that is hit."""
        hits = zip(pixel_of[rays.ray].tolist(), rays.hit[rays.owner].tolist(), strict=True)
        return dict(zip(hits, rays.alpha.tolist(), strict=True))

    through = told(every, np.arange(view.width * view.height))
    expected = {key: alpha for key, alpha in through.items() if key[0] in pixels}
    assert told(rays, pixels) == pytest.approx(expected)
    assert np.any(aims != cast.aimed(view, columns, rows, aims[:, :0]))


@pytest.mark.parametrize(
    ("alphas", "near", "views", "past"),
    [
        ([0.5, 0.1, 0.9], 0.1, 1, 1),
        ([0.5, 0.2, 0.9], 0.2, 1, 0),
        ([0.5, 0.05, 0.04], 0.05, 0, 0),
        ([0.5, 0.05, 0.06], 0.05, 1, 0),
    ],
)
def test_a_view_sees_past_what_little_light_stops_near(alphas, near, views, past):
    """The first is a suspect and takes none. Past it: less than .15 of all stops near.

    .1 and .9 of the rest: .1 / .91. .2 and .9: .2 / .92. Of .05 and .04 only .088 stops at all, and
    from .1 on a view sees what is there.
    """
    suspects = np.array([True, False, False])
    colors = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.5], [0.3, 0.6, 0.9]], np.float32)
    every, alpha, reached = np.arange(3), np.array(alphas), np.array([1.0, 1.0, 1.0 - near])
    light = support.Light(
        every, every, alpha, reached, reached * alpha * ~suspects,
        np.array([0.1, 0.12, 0.5]), np.full(3, 0.05),
    )  # fmt: skip
    evidence = support.Evidence(*support.evidence_of(light, suspects, colors))
    behind = (1.0 - near) * alphas[2]
    assert evidence.near[0] == pytest.approx(0.5 * near)
    assert evidence.behind[0] == pytest.approx(0.5 * behind)
    contrast = 0.5 * behind * np.sqrt((0.09 + 0.36 + 0.81) / 3)
    assert evidence.contrast[0] == pytest.approx(contrast)
    assert (evidence.views[0], evidence.past[0]) == (views, past)


def test_a_splat_lies_where_it_is_densest_on_a_ray():
    """A large flat splat turned by 45 degrees: z = 4 + x, so 4 (1 + u) on the ray x = u z.

    To first order in u; at 7.5 px from the centre and f = 60, u = .125 and the next order 1.6 %.
    """
    turn = np.array([[np.cos(np.pi / 8), 0.0, -np.sin(np.pi / 8), 0.0]], np.float32)
    splats = replace(stretched([0.0, 0.0, 4.0], [2.0, 2.0, 0.001]), quaternions=turn)
    views = ViewSet((View(np.eye(3), np.zeros(3), 60, 60, 8, 8, 16, 16, name="a"),))
    gaussians, scene, _ = projection.prepare(splats, views)
    footprints = projection.project(gaussians, scene, views.views[0])

    one = Search(gaussians, scene, list(views))
    seen = one.hits_of_view(0, footprints, np.zeros(1, np.bool_))

    columns = np.floor(seen.key) % 16  # rays go through all 16 x 16 pixels
    nearness = (np.floor(seen.key) + 0.999 - seen.key) / seen.scale
    expected = 4.0 / scene.size * (1.0 + (columns + 0.5 - 8.0) / 60.0)
    np.testing.assert_allclose(1.0 / nearness, expected, rtol=0.001)
    assert np.ptp(columns) == 15
