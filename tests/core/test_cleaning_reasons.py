"""Which reason a splat goes for, and by which evidence: one rule at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import Cleaning, View, ViewSet, clean
from refine_addon.core.cleaning import search, support
from refine_addon.core.cleaning.clean import REASONS
from refine_addon.core.seeing import projection

from .test_cleaning import FLOATER, SIDE, cameras, joined, made, wall

JUDGED = tuple(name for name in REASONS if name != "outside")
"""Of the wall, some is outside all views."""

ALL = Cleaning(JUDGED)


def stretched(place, scales, opacity=0.8, color=0.1):
    """Return one splat with a standard deviation along each axis."""
    return replace(
        made([place], 1.0, opacity, color), log_scales=np.log(np.array([scales], np.float32))
    )


def reasons(*parts, count=1, views=6):
    """Return the reasons of the last splats before the wall, each once; the rest has none."""
    by_reason = clean(joined(wall(), *parts), cameras(views), ALL).by_reason
    told = np.stack([by_reason[name] for name in JUDGED])  # (6, N)

    assert told.sum(axis=0).max() <= 1
    assert not told[:, : SIDE**2].any()
    return {name: int(by_reason[name][-count:].sum()) for name in JUDGED if by_reason[name].any()}


@pytest.mark.parametrize(
    ("splat", "expected"),
    [
        (stretched([0.1, 0, 2], [0.4, 0.01, 0.01]), "needle"),
        (stretched([0.1, 0, 2], [0.04, 0.003, 0.003]), "front"),
        (stretched([0.1, 0, 2], [0.3, 0.3, 0.003]), "front"),
        (made([[0.2, 0, 0.25]], 0.1, 0.8, 0.1), "front"),
        (made([[0.0, 0, 3.0]], 0.8, 0.5, 0.1), "front"),
        (made([[0.0, 0, 2.0]], 1.5, 0.2, 0.1), "giant"),
    ],
    ids=["needle", "short", "flake", "near", "far", "giant"],
)
def test_shapes_have_the_reason_of_their_kind(splat, expected):
    """At f = 60 and 80 px across; the scene's size is 4.76, so giants are longer than .71.

    A needle reaches 60 x .4 / 2 = 12 px, over 4; the short one 1.2. A flake is as wide as long.
    What is near reaches 24 px but is small; what is far is long but reaches 16 px, under 20.
    """
    assert reasons(splat) == {expected: 1}


def test_a_veil_in_the_colour_of_the_wall_stays():
    """It changes no pixel: its contrast to what lies behind is 0."""
    assert reasons(made([[0.0, 0.0, 2.0]], 1.5, 0.2, 0.9)) == {}


@pytest.mark.parametrize(("views", "expected"), [(6, {}), (40, {"giant": 1})])
def test_a_giant_may_lie_at_a_surface_by_half_if_many_views_see_past(views, expected):
    """A solid square at its depth stops 30 to 50 % of the light: 6 views are too few, 40 enough."""
    side = np.linspace(-0.7, 0.7, 16)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    square = made(np.stack([x, y, np.full_like(x, 2.0)], axis=1), 0.07, 0.95, 0.5)

    assert reasons(square, made([[0.0, 0.0, 2.0]], 1.5, 0.1, 0.1), views=views) == expected


def clump():
    """Return 40 splats that hold together in the air, and support each other."""
    places = np.random.default_rng(1).normal((0.0, 0.0, 2.0), 0.05, (40, 3))
    return made(places, 0.06, 0.95, 0.1)


def test_a_clump_is_isolated_and_each_splat_has_one_reason():
    """Those at its rim, which the others support little, are in front of the wall."""
    told = reasons(clump(), count=40)

    assert told["isolated"] >= 36
    assert sum(told.values()) == 40


def test_fog_holds_no_cluster_together():
    """A clump in the air stays isolated where splats of opacity .05 lead from it to the wall."""
    depth = np.arange(2.0, 4.01, 0.1)
    fog = made(np.stack([0 * depth, 0 * depth, depth], axis=1), 0.06, 0.05, 0.1)

    assert not clean(joined(wall(), fog, clump()), cameras()).keep[-40:].any()


def seen_as(monkeypatch, near, behind, contrast, views, past):
    """Let the views have seen that of every suspect, whatever they see."""
    suspected = search.Search._suspects

    def find(self, progress):
        suspects = suspected(self, progress)
        self.seen[-1] = views
        for name, value in (
            ("near", near), ("behind", behind), ("contrast", contrast * behind),
            ("views", views), ("past", past),
        ):  # fmt: skip
            getattr(self.evidence, name)[-1] = value
        return suspects

    monkeypatch.setattr(search.Search, "_suspects", find)
    # The splat put in last is the last Gaussian, too.
    monkeypatch.setattr(
        projection, "spatial_order", lambda place, _ties=None: np.arange(len(place))
    )


@pytest.mark.parametrize(
    ("evidence", "expected"),
    [
        ((0.0, 1.0, 0.8, 6, 6), {"front": 1}),
        ((0.0, 1.0, 0.8, 6, 4), {"front": 1}),
        ((0.0, 1.0, 0.8, 6, 3), {}),
        ((0.0, 1.0, 0.8, 20, 6), {"front": 1}),
        ((0.0, 1.0, 0.8, 20, 5), {}),
        ((0.0, 1.0, 0.04, 20, 6), {}),
        ((0.0, 1.0, 0.8, 3, 2), {}),
        ((0.0, 1.0, 0.8, 2, 2), {"front": 1}),
        ((0.0, 1.0, 0.8, 0, 0), {}),
        ((0.19, 0.81, 0.8, 6, 6), {"front": 1}),
        ((0.21, 0.79, 0.8, 6, 6), {}),
        ((0.34, 0.66, 0.8, 30, 24), {"front": 1}),
        ((0.34, 0.66, 0.8, 30, 20), {}),
        ((0.36, 0.64, 0.8, 30, 24), {}),
        ((0.0, 1.0, 0.021, 6, 6), {"front": 1}),
        ((0.0, 1.0, 0.018, 6, 6), {"transparent": 1}),
        ((0.0, 1.0, 0.018, 16, 16), {"front": 1}),
        ((0.0, 1.0, 0.009, 16, 16), {"transparent": 1}),
    ],
)
def test_evidence_decides_of_what_is_doubted(monkeypatch, evidence, expected):
    """Support below .2; two views at least and three in five; .8 of a contrast of .0196 (4/255).

    Half of that is enough of what 16 views see past.
    Of 3 views 2 are not enough: 2 x 2/3 are clear, which is under 1.6.
    What changes a pixel by 10/255, .8 of a contrast of .049, goes if 6 and three in ten see past,
    and up to a support of .35 if 16 views are clear: 20 of 20, or 24 of 30 (19.2), not 20 of 30.
    In this order: light near, light behind, contrast, views, views that see past it.
    """
    seen_as(monkeypatch, *evidence)

    assert reasons(FLOATER, views=4) == expected


@pytest.mark.parametrize(
    ("evidence", "expected"),
    [
        ((0.25, 0.75, 0.8, 6, 0), {"giant": 1}),
        ((0.35, 0.65, 0.8, 6, 0), {}),
        ((0.55, 0.45, 0.8, 36, 0), {"giant": 1}),
        ((0.55, 0.45, 0.8, 35, 0), {}),
        ((0.65, 0.35, 0.8, 60, 0), {}),
        ((0.0, 1.0, 0.0075, 6, 6), {"giant": 1}),
        ((0.0, 1.0, 0.0055, 6, 6), {}),
        ((0.0, 1.0, 0.8, 0, 0), {}),
    ],
)
def test_evidence_decides_of_giants(monkeypatch, evidence, expected):
    """Support below .3, or below .6 where 16 views' worth of light passes: .45 x 36 = 16.2.

    Its standard deviation is 45 to 50 of 80 px, from the sides, up to 12.6 times .05, so that
    4/255 / 12.6 = .00125 is enough: .2 of a contrast of .0062.
    """
    seen_as(monkeypatch, *evidence)

    assert reasons(made([[0.0, 0.0, 2.0]], 1.5, 0.2, 0.1), views=2) == expected


def hits(keys, alphas, *, absent=()):
    """Return hits of one ray, each splat once; those absent take no light."""
    alpha = np.array(alphas)
    present = np.array([place not in absent for place in range(len(alpha))], float)
    transmittance = np.cumprod(np.append(1.0, 1.0 - alpha * present))[:-1]
    every, width = np.arange(len(alpha)), np.zeros(len(alpha), np.float32)
    return support.Hits(
        every, width, every, alpha, transmittance, transmittance * alpha * present,
        0.0 * alpha, np.array(keys), np.full(len(alpha), 0.05),
    )  # fmt: skip


def test_support_is_what_others_would_stop_if_the_splat_were_gone():
    """Three of alpha .5: they take .5, .25 and .125. The second is near the first.

    Without the first, twice as much reaches the others: .5 near it and .25 behind, a support of
    2/3. Without the second, the first takes .5 and the third .25: 2/3. Nothing is behind the third.
    """
    light, held = support.own_support(hits([0.1, 0.12, 0.5], [0.5, 0.5, 0.5]), np.ones(3, np.bool_))

    np.testing.assert_allclose(light, [0.5, 0.25, 0.125])
    np.testing.assert_allclose(held / light, [2 / 3, 2 / 3, 1.0])


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
    evidence, suspects = support.Evidence.zero(3), np.array([True, False, False])
    colors = np.array([[0.0, 0.0, 0.0], [0.5, 0.5, 0.5], [0.3, 0.6, 0.9]], np.float32)

    evidence.add(hits([0.1, 0.12, 0.5], alphas, absent=(0,)), suspects, colors)

    behind = (1.0 - near) * alphas[2]
    assert evidence.near[0] == pytest.approx(0.5 * near)
    assert evidence.behind[0] == pytest.approx(0.5 * behind)
    contrast = 0.5 * behind * np.sqrt((0.09 + 0.36 + 0.81) / 3)
    assert evidence.contrast[0] == pytest.approx(contrast)
    assert (evidence.views[0], evidence.past[0]) == (views, past)


def test_a_splat_lies_where_it_is_densest_on_a_ray(monkeypatch):
    """A large flat splat turned by 45 degrees: z = 4 + x, so 4 (1 + u) on the ray x = u z.

    To first order in u; at 7.5 px from the centre and f = 60, u = .125 and the next order 1.6 %.
    """
    turn = np.array([[np.cos(np.pi / 8), 0.0, -np.sin(np.pi / 8), 0.0]], np.float32)
    splats = replace(stretched([0.0, 0.0, 4.0], [2.0, 2.0, 0.001]), quaternions=turn)
    views = ViewSet((View(np.eye(3), np.zeros(3), 60, 60, 8, 8, 16, 16, name="a"),))
    gaussians, scene, _ = projection.prepare(splats, views)
    footprints = projection.project(gaussians, scene, views.views[0])
    told, depths = [], support._depths

    def noted(gaussians, footprints, scene, view, rays, reached):
        told.append(rays.columns[rays.ray[reached] % len(rays.columns)])
        told.append(depths(gaussians, footprints, scene, view, rays, reached))
        return told[-1]

    monkeypatch.setattr(support, "_depths", noted)
    support.hits_of_view(gaussians, footprints, scene, views.views[0], 0, np.zeros(1, np.bool_))

    columns, measured = told
    expected = 4.0 / scene.size * (1.0 + (columns + 0.5 - 8.0) / 60.0)
    np.testing.assert_allclose(measured, expected, rtol=0.001)
    assert np.ptp(columns) == 15
