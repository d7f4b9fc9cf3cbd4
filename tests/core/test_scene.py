"""The scene's own frame."""

import numpy as np

from refine_addon.core import ViewSet, execute
from refine_addon.core.visibility import scene
from refine_addon.core.visibility.scene import scene_of

from .test_views import view

CENTERS = [[13.0, 0, 0], [7, 0, 0], [10, 3, 0], [10, -3, 0]]
VIEWS = ViewSet(tuple(map(view, CENTERS)))


def test_places_and_their_order_do_not_depend_on_chunks_and_threads(monkeypatch):
    """In chunks of 64 as all at once; the last chunk has one row, which BLAS rounds otherwise.

    A third of the points are there three times: equal ones keep their order.
    """
    generator = np.random.default_rng(0)
    means = generator.normal(size=(1473, 3))[generator.integers(0, 491, 1473)]
    drawn, rows = generator.random(1473) < 0.9, np.arange(1473)
    whole = scene_of(means, drawn, VIEWS)
    places = (means - whole.origin) @ (whole.axes.T / whole.size)
    order = scene.spatial_order(places)
    monkeypatch.setattr(scene, "_CHUNK", 64)
    one, three = (execute.within(cores=n)(scene_of)(means, drawn, VIEWS) for n in (1, 3))
    assert one.size == three.size == whole.size
    np.testing.assert_array_equal(three.axes, one.axes)
    with execute.within(cores=3):
        np.testing.assert_array_equal(whole.positions(means), places)
        np.testing.assert_array_equal(whole.positions(means, rows[::2]), places[::2])
        np.testing.assert_array_equal(scene.spatial_order(places), order)
