"""The pictures of core against the reference renderer."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.renderer.rasterizer import render
from refine_addon.core import read_cameras, read_splats
from refine_addon.core.pictures import CAMERAS, compare

ROOM = Path(__file__).parents[1] / "data/room_small"


def test_pictures_are_those_of_the_reference_renderer():
    """Rounding to 8 bits alone, errors even within +-.5 / 255, makes 10 log10(12 255^2) = 58.9 dB.

    The measured PSNR of a half removed at random is that of two renders to .01 dB.
    """
    splats = read_splats(ROOM / "point_cloud.ply").splats()
    half = splats.take(np.random.default_rng(0).random(len(splats)) < 0.5)

    for found in compare(splats, half, read_cameras(ROOM / "cameras.json").spread(CAMERAS)):
        near = found.view.near
        one, other = (render(s, found.view, near=near).clip(0.0, 1.0) for s in (splats, half))
        assert -10.0 * np.log10(np.mean((found.before / 255.0 - one) ** 2)) > 58.5
        assert abs(found.psnr + 10.0 * np.log10(np.mean((other - one) ** 2))) < 0.01
