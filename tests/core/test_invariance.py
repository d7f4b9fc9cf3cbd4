"""What is kept, or cleaned away, depends on no frame, no unit and no order of the splats."""

from dataclasses import replace

import numpy as np
import pytest

from refine_addon.core import (
    METHODS,
    Budget,
    Merge,
    Splats,
    ViewSet,
    clean,
    prune,
    read_cameras,
    read_ply,
    score,
    select,
)
from refine_addon.core.affine import transformed
from tests.places import ROOM

from .test_cleaning import FLOATER, cameras, joined, wall
from .test_levels import merges  # noqa: F401 - a fixture
from .test_views import ring

pytestmark = pytest.mark.slow

STILL = np.eye(3)
QUARTER = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # about x, as *Upright* turns


def rotation(axis, degrees):
    """Rodrigues' formula."""
    x, y, z = np.array(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.deg2rad(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def moved(splats, views, turn=STILL, step=0.0, unit=1.0):
    """Move splats and views by the same rigid motion, and tell lengths in another unit."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = unit * turn, unit * step
    poses = (
        replace(
            view, rotation=view.rotation @ turn.T, center=unit * (turn @ view.center + step),
            near=unit * view.near, far=unit * view.far,
        )
        for view in views
    )  # fmt: skip
    return transformed(splats, matrix, rotate_sh=True), ViewSet(tuple(poses))


MOTIONS = {
    "a quarter about x": (QUARTER, np.zeros(3)),
    "a turn and a move": (rotation([3, -1, 2], 111.0), np.array([-3.0, 5.0, 9.0])),
    "another unit": (STILL, np.zeros(3), 1e6),
}


def kept(splats, views, method, ratio=0.9, most=64):
    if method == "merge":
        return prune(splats, views, Budget(ratio=ratio), Merge(most)).keep
    scores = score(splats, views, METHODS[method](most))
    return np.stack([select(scores, Budget(ratio=share)) for share in (0.5, 0.9)])


def jaccard(one, other):
    """Return the least over the budgets of the share that both keep in what either keeps."""
    return np.min((one & other).sum(axis=-1) / (one | other).sum(axis=-1))


@pytest.mark.parametrize(
    "how", [("closed-form",), ("occlusion",), ("merge", 0.5), ("merge", 0.9)], ids=str
)
def test_neither_motions_nor_another_order_change_what_is_kept(how):
    """Coordinates differ in their last digits of float64; nothing else may.

    No two splats of the room are alike, so no tie is decided by place in the file.
    """
    splats = read_ply(ROOM / "point_cloud.ply").splats().take(slice(None, None, 8))
    views, random = read_cameras(ROOM / "cameras.json"), np.random.default_rng(0)
    expected, order = kept(splats, views, *how), random.permutation(len(splats))

    for motion in MOTIONS.values():
        assert jaccard(kept(*moved(splats, views, *motion), *how), expected) >= 0.9999
    found = kept(splats.take(order), views.take(random.permutation(len(views))), *how)
    assert jaccard(found, expected[..., order]) >= 0.9999


def scene_of_ties(kind):
    """1000 splats that differ in all but place, in a ring of 40 cameras: most places are tied."""
    rng = np.random.default_rng(4)
    means = rng.uniform(-1.0, 1.0, size=(1000, 3))
    if kind == "coincident":
        means[:10] = means[0]
    if kind == "lattice":
        means = np.round(means * 7.0) / 7.0
    splats = Splats(
        means,
        rng.normal(-3.0, 0.4, size=(1000, 3)).astype(np.float32),
        rng.normal(size=(1000, 4)).astype(np.float32),
        rng.normal(size=1000).astype(np.float32),
        rng.normal(size=(1000, 3)).astype(np.float32),
        np.zeros((1000, 0, 3), np.float32),
    )
    lens = {"fx": 200.0, "fy": 200.0, "cx": 120.0, "cy": 80.0, "width": 240, "height": 160}
    return splats, ring(40, **lens)


@pytest.mark.parametrize("kind", ["ring", "coincident", "lattice"])
@pytest.mark.parametrize("method", ["occlusion", "merge"])
def test_ties_are_decided_by_what_does_not_move(merges, kind, method):
    """Equal distances of views by their names, equal places of splats by opacity and colour."""
    splats, views = scene_of_ties(kind)
    expected = kept(splats, views, method, most=24)
    order = np.random.default_rng(1).permutation(len(splats))
    turned = moved(splats, views, *MOTIONS["a quarter about x"])
    permuted = splats.take(order), views.take(range(len(views) - 1, -1, -1))

    assert jaccard(kept(*turned, method, most=24), expected) >= 0.9999
    assert jaccard(kept(*permuted, method, most=24), expected[..., order]) >= 0.9999


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_neither_order_nor_unit_nor_frame_decides_what_is_cleaned_away(unit):
    splats, views = joined(wall(), FLOATER), cameras()
    other = moved(splats.take(slice(None, None, -1)), tuple(views)[::-1], QUARTER, 5.0, unit)
    assert np.array_equal(clean(*other).keep[::-1], clean(splats, views).keep)
