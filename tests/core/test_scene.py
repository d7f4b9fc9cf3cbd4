"""The scene's own frame."""

from __future__ import annotations

import numpy as np
import pytest

from refine_addon.core import View, ViewSet
from refine_addon.core.seeing.scene import scene_of

LENS = {"fx": 50.0, "fy": 50.0, "cx": 50.0, "cy": 50.0, "width": 100, "height": 100}


def test_the_size_is_that_of_splats_and_views_together():
    """Four views at distance 3 of their middle, splats at 0, 4 and 4: 5, the root of 3^2 + 4^2.

    A splat that cannot be drawn does not count, wherever it is.
    """
    centers = np.array([[13.0, 0, 0], [7, 0, 0], [10, 3, 0], [10, -3, 0]])
    views = ViewSet(tuple(View(np.eye(3), center, **LENS) for center in centers))
    means = np.array([[10, 0, 0], [10, 0, 4], [10, 4, 0], [1e6, 0, 0]])

    scene = scene_of(means, np.array([True, True, True, False]), views)

    assert scene.size == pytest.approx(5.0)
    np.testing.assert_allclose(scene.origin, [10.0, 0.0, 0.0], atol=1e-9)
