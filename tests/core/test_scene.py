"""The scene's own frame."""

from __future__ import annotations

import numpy as np
import pytest

from refine_addon.core import View, ViewSet
from refine_addon.core.visibility import scene
from refine_addon.core.visibility.scene import scene_of

LENS = {"fx": 50.0, "fy": 50.0, "cx": 50.0, "cy": 50.0, "width": 100, "height": 100}


def four_views():
    """Return views at distance 3 of (10, 0, 0)."""
    centers = np.array([[13.0, 0, 0], [7, 0, 0], [10, 3, 0], [10, -3, 0]])
    return ViewSet(tuple(View(np.eye(3), center, **LENS) for center in centers))


def test_the_size_is_that_of_splats_and_views_together():
    """Four views at distance 3 of their middle, splats at 0, 4 and 4: 5, the root of 3^2 + 4^2.

    A splat that cannot be drawn does not count, wherever it is.
    """
    views = four_views()
    means = np.array([[10, 0, 0], [10, 0, 4], [10, 4, 0], [1e6, 0, 0]])

    scene = scene_of(means, np.array([True, True, True, False]), views)

    assert scene.size == pytest.approx(5.0)
    np.testing.assert_allclose(scene.origin, [10.0, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("threads", [1, 3])
def test_places_and_their_order_do_not_depend_on_chunks_and_threads(monkeypatch, threads):
    """In chunks of 64 as all at once; the last chunk has one row, which BLAS rounds otherwise.

    A third of the points are there three times: equal ones keep their order.
    """
    generator = np.random.default_rng(0)
    means = generator.normal(size=(1473, 3))[generator.integers(0, 491, 1473)]
    drawn, views = generator.random(1473) < 0.9, four_views()
    whole = scene_of(means, drawn, views)
    places = (means - whole.origin) @ (whole.axes.T / whole.size)
    order = scene.spatial_order(places)

    monkeypatch.setattr(scene, "_CHUNK", 64)
    in_chunks = scene_of(means, drawn, views, threads=1)
    again = scene_of(means, drawn, views, threads=threads)

    assert in_chunks.size == again.size == whole.size
    np.testing.assert_array_equal(again.axes, in_chunks.axes)
    rows = np.arange(1473)
    np.testing.assert_array_equal(whole.positions(means, threads=threads), places)
    np.testing.assert_array_equal(whole.positions(means, rows[::2], threads=threads), places[::2])
    np.testing.assert_array_equal(scene.spatial_order(places, threads=threads), order)
