"""Floaters and outliers: what cameras see past goes, what is a surface stays."""

from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import Cleaning, RefineError, Splats, ViewSet, clean
from refine_addon.core.splats import ARRAYS
from refine_addon.core.splats import joined as core_joined

from .test_occlusion import look_along_z, splats_of

SIDE = 24
"""Splats along each side of the wall."""


def made(means, scale, opacity, color):
    """Return round splats of one kind, in float32."""
    splats = splats_of(means, opacity, scale, np.full(3, color)[None])
    return Splats(*(np.float32(getattr(splats, name)) for name in ARRAYS))


def joined(*parts):
    return core_joined(parts)


def wall():
    """Return a dense, opaque, white wall at z = 4: neighbours overlap at 1.5 sigmas."""
    line = np.linspace(-3.0, 3.0, SIDE)
    x, y = (axis.ravel() for axis in np.meshgrid(line, line))
    return made(np.stack([x, y, np.full_like(x, 4.0)], axis=1), 0.17, 0.95, 0.9)


def cameras(count=6):
    """Return views that stand side by side and look at the wall."""
    places = np.linspace(-1.0, 1.0, count)
    views = [look_along_z((x, 0.1 * x, 0.0), fx=60.0, fy=60.0) for x in places]
    return ViewSet(tuple(replace(view, name=str(k)) for k, view in enumerate(views)))


FLOATER = made([[0.1, 0.0, 2.0]], 0.06, 0.8, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("model", "goes"), [("default", 1), ("antialiased", 0), ("2dgs", 1)])
def test_a_floater_is_judged_as_its_model_draws_it(model, goes):
    """One that is .015 px wide: antialiased it changes a pixel by .1 of 255, else it fills one."""
    dot = made(FLOATER.means, 0.0005, 0.8, 0.1)
    splats = replace(joined(wall(), dot), model=model)
    assert clean(splats, cameras()).counts()["front"] == goes


@pytest.mark.parametrize(("count", "stays"), [(1, True), (2, False)])
def test_what_one_view_alone_sees_past_stays(count, stays):
    """With that view left out nothing tells; of two, each confirms the other."""
    cleaned = clean(joined(wall(), FLOATER), cameras(count))
    assert cleaned.keep[-1] == stays
    assert cleaned.keep[: SIDE**2].all()


def test_extreme_and_undrawable_splats_are_survived():
    """No warning, which would be an error here; what no renderer draws is nobody's floater."""
    odd = made(np.zeros((6, 3)), 0.1, 0.5, 0.5)
    odd.means[:4] = [[np.nan, 0, 0], [3e38, 0, 0], [0, 0, 1e-30], [0, 0, 2]]
    odd.log_scales[3:] = [[80, 80, 80], [-np.inf, -np.inf, -np.inf], [-90, 3, -90]]
    odd.opacity_logits[2] = np.inf
    assert clean(joined(wall(), odd), cameras()).keep[: SIDE**2 + 2].all()


CLUMP = made(np.random.default_rng(1).normal((0.0, 0.0, 2.0), 0.1, (130, 3)), 0.06, 0.95, 0.1)
DOME = made([[0.0, 0.0, 9.0], [4.0, 0.0, 9.0]], 3.0, 0.9, 0.5)


@pytest.mark.parametrize(
    "splats",
    [FLOATER.take(slice(0)), FLOATER, wall(), joined(wall(), CLUMP), joined(DOME, wall())],
    ids=["none", "one", "wall", "clump", "dome"],
)
def test_where_nothing_floats_nothing_is_cleaned_away(splats):
    """None, or one with nothing behind it; a wall, whose splats support each other.

    A cluster of 100 splats or more is a thing, wherever it is, and what is vast and lies behind all
    is the last that the light meets."""
    cleaned = clean(splats, cameras())
    assert cleaned.keep.all()
    assert cleaned.in_words() == "nothing to clean away"


def test_settings_that_the_command_cannot_give_and_cameras_that_see_nothing_are_refused():
    """They look the other way: nothing can be told, which is not the same as nothing to do."""
    for message, settings in (
        ("reason is none, expected", ((),)),
        ("views is -1", (("giant",), -1)),
    ):
        with pytest.raises(RefineError, match=message):
            Cleaning(*settings)
    turned = np.diag([-1.0, 1.0, -1.0])
    away = ViewSet(tuple(replace(view, rotation=turned) for view in cameras().views))
    with pytest.raises(RefineError, match="no camera sees the splats"):
        clean(wall(), away)


@pytest.mark.slow
def test_a_cloud_of_faint_splats_stays_but_for_what_is_solid_in_it():
    """Twelve views see past all: 4 / 13^1.5 = .085 of 255 is needed of what touches nothing.

    Each of the cloud changes pixels by .09 x .03, .69 of 255, and eight faint ones touch it: 1.35^8
    times .085 is .94. The dark splat changes them by 40 of 255 or more; held by eight that stay it
    needs 8^sqrt(8) x .085 = 31."""
    places = np.random.default_rng(1).normal((0.0, 0.0, 2.0), 0.03, (9, 3))
    alone = made(places[:1], 0.06, 0.09, 0.87)
    cloud = made(places, 0.06, 0.09, 0.87)
    cleaned = clean(joined(wall(), cloud, FLOATER), cameras(12))
    assert not clean(joined(wall(), alone), cameras(12)).keep[-1]
    assert np.flatnonzero(~cleaned.keep).tolist() == [SIDE**2 + 9]
    assert cleaned.by_reason["transparent"][SIDE**2 : -1].all()


def test_floaters_in_a_veil_are_found_once_it_is_gone():
    """A veil of opacity .9 through the dark splat stops the light near it, until it is absent."""
    veil = made([[0.0, 0.0, 2.1]], 1.5, 0.9, 0.4)
    cleaned = clean(joined(wall(), veil, FLOATER), cameras())
    assert cleaned.counts() == {"front": 1, "isolated": 0, "giant": 1, "needle": 0}


@pytest.mark.slow
def test_faint_splats_near_a_camera_are_haze_and_stay_unless_asked():
    """Each changes a pixel by .006 x .1, .15 of 255, less than the .22 that six views ask for.

    One is .1 scene sizes off the cameras, the other .4."""
    fog = made([[0.1, 0.0, 0.5], [-0.1, 0.0, 2.0]], 0.012, 0.006, 0.8)
    asked = clean(joined(wall(), fog), cameras(), Cleaning(("front", "haze")))
    assert asked.counts() == {"front": 0, "haze": 1}
    assert np.flatnonzero(~asked.keep).tolist() == [SIDE**2]
    assert asked.by_reason["transparent"][-1]
    assert clean(joined(wall(), fog), cameras()).keep.all()


@pytest.mark.parametrize("views", [0, 2])
def test_what_no_view_shows_is_outside_and_stays_unless_asked(views):
    """Behind the cameras and beside all pictures; views that were not used are asked, too."""
    shell = made([[0.0, 0.0, -9.0], [30.0, 0.0, 4.0]], 0.5, 0.8, 0.1)
    splats = joined(made([[-1.0, -0.1, 4.0], [1.0, 0.1, 4.0]], 0.3, 0.9, 0.9), shell)
    asked = clean(splats, cameras(), Cleaning(("outside",), views=views))
    assert asked.keep.tolist() == [True, True, False, False]
    assert asked.in_words() == "2 outside all views"
    assert asked.facts()["sure"] == {"outside": None}
    assert clean(splats, cameras()).keep.all()
