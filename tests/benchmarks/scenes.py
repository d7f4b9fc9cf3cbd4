"""The scenes that several tests render."""

from dataclasses import replace

import numpy as np

from refine_addon.core.splats import Splats, opacity
from refine_addon.core.views import View
from tests.core.test_occlusion import splats_of

BACKGROUND = (0.2, 0.5, 0.9)
VIEW = View(np.eye(3), np.array([0.1, -0.2, 0.3]), 31.0, 27.0, 17.0, 16.0, 37, 29, name="a")
AWAY = replace(VIEW, center=np.array([-0.3, 0.2, -0.1]), name="b")


def soft_scene(count: int = 12) -> Splats:
    """Return large soft splats ahead of the views, the first of them opaque, the second dark."""
    rng = np.random.default_rng(0)
    splats = Splats(
        rng.normal([0, 0, 4.0], 0.9, (count, 3)),
        rng.normal(-0.6, 0.4, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(0, 1, count),
        rng.normal(0, 1, (count, 3)),
        rng.normal(0, 0.4, (count, 15, 3)),
    )
    splats.opacity_logits[0] = 9.0
    splats.sh_dc[1] = -9.0
    return splats


def round_scene(places: list[list[float]], logits: list[float], size: float = 0.1) -> Splats:
    """Return round white splats."""
    return splats_of(places, opacity(np.array(logits)), size, 0.98)


def cube_scene(count: int = 400) -> Splats:
    """Return small splats spread over a cube, of degree 1, in float32."""
    rng = np.random.default_rng(0)
    columns = (
        rng.random((count, 3)),
        rng.normal(-4, 0.5, (count, 3)),
        rng.normal(size=(count, 4)),
        rng.normal(size=count),
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 3, 3)),
    )
    return Splats(*(values.astype(np.float32) for values in columns))
