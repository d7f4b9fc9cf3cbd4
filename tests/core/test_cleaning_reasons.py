"""Which reason a splat goes for, and by which evidence: one rule at a time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import Cleaning, View, ViewSet, clean
from refine_addon.core.cleaning import clean as cleaning
from refine_addon.core.cleaning import support
from refine_addon.core.cleaning.clean import REASONS
from refine_addon.core.seeing import projection

from .test_cleaning import FLOATER, SIDE, cameras, joined, made, wall

ALL = Cleaning(tuple(REASONS))


def stretched(place, scales, opacity=0.8, color=0.1):
    """Return one splat with a standard deviation along each axis."""
    return replace(
        made([place], 1.0, opacity, color), log_scales=np.log(np.array([scales], np.float32))
    )


def reasons(*parts, count=1, views=6):
    """Return the reasons of the last splats before the wall, each once; the rest has none."""
    by_reason = clean(joined(wall(), *parts), cameras(views), ALL).by_reason
    told = np.stack([by_reason[name] for name in REASONS])  # (5, N)

    assert told.sum(axis=0).max() <= 1
    assert not told[:, : SIDE**2].any()
    return {name: int(by_reason[name][-count:].sum()) for name in REASONS if by_reason[name].any()}


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


@pytest.mark.parametrize(("opacity", "expected"), [(0.1, {"giant": 1}), (0.2, {})])
def test_a_giant_may_lie_at_a_surface_by_half_if_it_is_a_veil(opacity, expected):
    """A solid square at its depth stops 30 to 50 % of the light: enough for opaque ones."""
    side = np.linspace(-0.7, 0.7, 16)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    square = made(np.stack([x, y, np.full_like(x, 2.0)], axis=1), 0.07, 0.95, 0.5)

    assert reasons(square, made([[0.0, 0.0, 2.0]], 1.5, opacity, 0.1)) == expected


def clump():
    """Return 40 splats that hold together in the air, and support each other."""
    places = np.random.default_rng(1).normal((0.0, 0.0, 2.0), 0.05, (40, 3))
    return made(places, 0.06, 0.95, 0.1)


def test_a_clump_is_isolated_and_nothing_else():
    """It is in front of the wall as well, but has one reason."""
    assert reasons(clump(), count=40) == {"isolated": 40}


def test_fog_holds_no_cluster_together():
    """A clump in the air stays isolated where splats of opacity .05 lead from it to the wall."""
    depth = np.arange(2.0, 4.01, 0.1)
    fog = made(np.stack([0 * depth, 0 * depth, depth], axis=1), 0.06, 0.05, 0.1)

    by_reason = clean(joined(wall(), fog, clump()), cameras()).by_reason

    assert by_reason["isolated"][-40:].all()


def seen_as(monkeypatch, near, behind, contrast, views, past):
    """Let the views have seen that of every suspect, whatever they see."""

    def find(self, _suspects, _progress):
        for name, value in (
            ("near", near), ("behind", behind), ("contrast", contrast * behind),
            ("views", views), ("past", past),
        ):  # fmt: skip
            getattr(self.evidence, name)[-1] = value

    monkeypatch.setattr(cleaning._Search, "_find_evidence", find)
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
        ((0.0, 1.0, 0.021, 6, 6), {"front": 1}),
        ((0.0, 1.0, 0.018, 6, 6), {"transparent": 1}),
    ],
)
def test_evidence_decides_of_what_is_doubted(monkeypatch, evidence, expected):
    """Support below .2; three views at least and three in five; .8 of a contrast of .0196 (4/255).

    What changes a pixel by 10/255, .8 of a contrast of .049, goes if 6 and three in ten see past.
    In this order: light near, light behind, contrast, views, views that see past it.
    """
    seen_as(monkeypatch, *evidence)

    assert reasons(FLOATER, views=2) == expected


@pytest.mark.parametrize(
    ("opacity", "evidence", "expected"),
    [
        (0.1, (0.45, 0.55, 0.8, 6, 0), {"giant": 1}),
        (0.1, (0.55, 0.45, 0.8, 6, 0), {}),
        (0.2, (0.25, 0.75, 0.8, 6, 0), {"giant": 1}),
        (0.2, (0.35, 0.65, 0.8, 6, 0), {}),
        (0.2, (0.0, 1.0, 0.0075, 6, 6), {"giant": 1}),
        (0.2, (0.0, 1.0, 0.0055, 6, 6), {}),
        (0.2, (0.0, 1.0, 0.8, 0, 0), {}),
    ],
)
def test_evidence_decides_of_giants(monkeypatch, opacity, evidence, expected):
    """Support below .5 for veils, .3 for others.

    Its standard deviation is 45 to 50 of 80 px, from the sides, up to 12.6 times .05, so that
    4/255 / 12.6 = .00125 is enough: .2 of a contrast of .0062.
    """
    seen_as(monkeypatch, *evidence)

    assert reasons(made([[0.0, 0.0, 2.0]], 1.5, opacity, 0.1), views=2) == expected


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
    light, held = support.own_support(hits([0.1, 0.12, 0.5], [0.5, 0.5, 0.5]))

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
