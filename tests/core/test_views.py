"""Views, view sets, their even subsets, and the frame of a scene that they see."""

from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import RefineError, View, ViewSet, execute
from refine_addon.core.visibility import scene
from refine_addon.core.visibility.frustum import census
from refine_addon.core.visibility.scene import scene_of


def view(center=(0.0, 0.0, 0.0), **changes) -> View:
    values = {"fx": 50.0, "fy": 50.0, "cx": 50.0, "cy": 50.0, "width": 100, "height": 100}
    rotation = changes.pop("rotation", np.eye(3))
    return View(rotation, np.array(center, float), **values | changes)


def ring(count: int, radius=3.0, start=0.0, **lens) -> ViewSet:
    """Views on a circle around z, looking inwards, named by their numbers."""
    views = []
    for index, angle in enumerate(np.arange(count) * 2 * np.pi / count + start):
        c, s = np.cos(angle), np.sin(angle)
        rotation = np.array([[-s, c, 0], [0, 0, -1], [-c, -s, 0]])
        center = [radius * c, radius * s, 0]
        views.append(view(center, rotation=rotation, name=f"{index:02}", **lens))
    return ViewSet(tuple(views))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx": 0.0}, "positive focal lengths"),
        ({"width": 1.5}, "whole numbers"),
        ({"cx": np.nan}, "must be finite"),
        ({"near": 2.0, "far": 1.0}, "0 <= near < far"),
        ({"weight": -1.0}, "weight >= 0"),
        ({"rotation": np.ones((3, 3))}, "not orthonormal"),
        ({"rotation": np.full((3, 3), np.inf)}, "must be finite"),
        ({"rotation": np.eye(2)}, r"expected rotation \(3, 3\)"),
        ({"center": (1e39, 0, 0)}, "float32"),
        ({"fx": "wide"}, ""),
        ({"rotation": [[1, 0], [0]]}, ""),
        ({"rotation": np.full((3, 3), 1e200)}, ""),
    ],
)
def test_a_view_that_cannot_be_is_refused_by_name(changes, message):
    with np.errstate(all="raise"), pytest.raises(RefineError, match=rf"view 'left'.*{message}"):
        view(name="left", **changes)


def test_a_set_needs_a_view_that_counts():
    """Weights sum to one even where their sum overflows; an unknown name is named."""
    with pytest.raises(RefineError, match="no cameras"):
        ViewSet(())
    with pytest.raises(RefineError, match="weight 0"):
        ViewSet((view(weight=0.0),))
    with pytest.raises(RefineError, match="no view named 'x' among 4 views"):
        ring(4).select(["02", "x"])
    with np.errstate(all="raise"):
        np.testing.assert_allclose(ViewSet((view(weight=1e308),) * 3).weights, [1 / 3] * 3)


def test_a_subset_of_a_ring_is_a_ring_and_nested():
    """Farthest-point sampling takes every second of 8 views, or every fourth; 0 means all."""
    some = [sorted(int(v.name) for v in ring(8).spread(count)) for count in (0, 4, 2, 9)]
    assert some[0] == some[3] == list(range(8))
    assert some[1] in ([0, 2, 4, 6], [1, 3, 5, 7])
    assert set(some[2]) < set(some[1])
    assert some[2][1] - some[2][0] == 4


def test_views_of_weight_zero_are_never_used():
    """They would cost time and change nothing."""
    views = ViewSet((view(weight=0.0, name="off"), view([1, 0, 0], name="on")))
    assert [v.name for v in views.spread(0)] == ["on"]


def test_cameras_in_one_place_are_spread_by_direction():
    """A panorama's cameras share their centre."""
    rotations = [np.eye(3), np.diag([1.0, -1, -1]), np.eye(3)]
    views = ViewSet(tuple(view(rotation=r, name=str(i)) for i, r in enumerate(rotations)))
    assert len({tuple(v.rotation[2]) for v in views.spread(2)}) == 2


@pytest.mark.parametrize("away", [1e6, 1e38])
def test_the_middle_of_views_ignores_a_stray_one(away):
    """Of a ring of radius 3 it is the axis, 9 the squared distance; a stray view moves it little.

    One of nine: the median moves toward it by about 3 / 8, where the mean would move by a ninth of
    the way.
    """
    views = ring(8)
    middle, spread = views.middle()
    stray = ViewSet((*views, view([away, 0, 0]))).middle()
    np.testing.assert_allclose(middle, [0, 0, 0], atol=1e-12)
    assert spread == pytest.approx(9.0)
    assert np.linalg.norm(stray[0]) < 1.0
    assert stray[1] < 16.0


@pytest.mark.parametrize("away", [1e2, 1e5])
def test_stray_cameras_do_not_open_gaps_between_the_others(away):
    """A corridor of 30 m, 300 cameras that look anywhere, a few more far outside of it.

    64 views spread along it leave gaps of about 2 m; a mean and a root mean square let the strays
    set the unit, so that directions decided alone and gaps grew to twice that.
    """

    def largest_gap(strays: int) -> float:
        rng = np.random.default_rng(0)
        views = [
            view((0.1 * k, 0.0, 1.6), rotation=np.linalg.qr(rng.normal(size=(3, 3)))[0])
            for k in range(300)
        ]
        views += [view((away * (k + 1), 0.0, 0.0)) for k in range(strays)]
        along = ViewSet(tuple(views)).spread(64).centers[:, 0]
        return float(np.diff(np.sort(along[along < 30.0])).max())

    assert largest_gap(3) <= 1.15 * largest_gap(0)


@pytest.mark.parametrize("count", [24, 64])
def test_of_a_regular_rig_the_same_views_are_chosen_however_it_lies(count):
    """A ring of 72 is full of equal distances: the name decides, not a coordinate."""
    quarter = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    views = ring(72)
    turned = [
        replace(view, rotation=view.rotation @ quarter.T, center=1e3 * quarter @ view.center)
        for view in views
    ]
    names = [view.name for view in views.spread(count)]
    assert [view.name for view in ViewSet(tuple(turned)).spread(count)] == names
    shuffled = views.take(np.random.default_rng(3).permutation(72)).spread(count)
    assert sorted(view.name for view in shuffled) == sorted(names)


def test_points_are_counted_in_each_view():
    """Along +z at (0, 0, 2): in the view from 0, not in one that begins at 3, nor in one behind.

    A point 2.1 to the side at depth 2 is outside: the image ends at 50 px, 1 a unit at depth 1.
    """
    points = np.array([[0, 0, 2], [2.1, 0, 2], [np.nan, 0, 2], [0, np.inf, 2]], np.float32)
    views = ViewSet((view(), view(near=3.0), view([0, 0, 2.5]), view([2.1, 0, 0])))
    assert census(points, views).tolist() == [1, 0, 0, 1]
    assert census(points, views.take([0, 0, 3])).tolist() == [1, 1, 1]


def test_places_and_their_order_do_not_depend_on_chunks_and_threads(monkeypatch):
    """In chunks of 64 as all at once; the last chunk has one row, which BLAS rounds otherwise.

    A third of the points are there three times: equal ones keep their order.
    """
    generator = np.random.default_rng(0)
    means = generator.normal(size=(1473, 3))[generator.integers(0, 491, 1473)]
    drawn, rows = generator.random(1473) < 0.9, np.arange(1473)
    views = ViewSet((view([13.0, 0, 0]), view([7, 0, 0]), view([10, 3, 0]), view([10, -3, 0])))
    whole = scene_of(means, drawn, views)
    places = (means - whole.origin) @ (whole.axes.T / whole.size)
    order = scene.spatial_order(places)
    monkeypatch.setattr(scene, "_CHUNK", 64)
    one, three = (execute.within(cores=n)(scene_of)(means, drawn, views) for n in (1, 3))
    assert one.size == three.size == whole.size
    np.testing.assert_array_equal(three.axes, one.axes)
    with execute.within(cores=3):
        np.testing.assert_array_equal(whole.positions(means), places)
        np.testing.assert_array_equal(whole.positions(means, rows[::2]), places[::2])
        np.testing.assert_array_equal(scene.spatial_order(places), order)
