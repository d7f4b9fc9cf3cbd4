"""What the 3D view is given agrees with what the reference renderer computes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.renderer.footprints import RED, camera_of, footprints_of, gaussians_of
from refine_addon.core.cameras.read import read_cameras
from refine_addon.core.formats.ply import read_ply
from refine_addon.viewport import arrays
from refine_addon.viewport.arrays import Eye

ROOM = Path(__file__).parents[1] / "data" / "room_small"


def test_the_view_draws_the_gaussians_and_colours_of_the_reference_renderer():
    """All covariances to float32; the colours of a view to float16's 2^-11, summed over 16."""
    room = read_ply(ROOM / "point_cloud.ply").splats()
    view = read_cameras(ROOM / "cameras.json")[20]
    scene, packed = gaussians_of(room), arrays.pack(room)
    drawn = footprints_of(scene, camera_of(view), near=0.2)
    eye = Eye(
        np.append(view.rotation[2], -view.rotation[2] @ view.center), view.center, perspective=True
    )
    shown, depths = arrays.in_front(packed.means, eye, 0.2)
    colors = np.zeros((len(room), 3))
    colors[packed.vertices] = arrays.colors(packed, eye)[:, :3]

    scale = np.abs(scene.covariances).max(axis=1, keepdims=True)[packed.vertices]
    assert (np.abs(packed.covariances - scene.covariances[packed.vertices]) <= 1e-6 * scale).all()
    assert set(drawn.index) <= set(packed.vertices[shown])
    assert (depths > 0.2).all()
    np.testing.assert_allclose(colors[drawn.index], drawn.table[:, RED : RED + 3], atol=4e-3)
