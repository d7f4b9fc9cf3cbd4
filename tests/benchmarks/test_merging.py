"""Block merging: counts, moments, and what is not touched."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.baselines import merging
from refine_addon.core.splats import Splats, opacity, rotation_matrices


def scene_of(count: int = 400, seed: int = 0) -> Splats:
    """Return small splats spread over a cube."""
    rng = np.random.default_rng(seed)
    return Splats(
        rng.random((count, 3)).astype(np.float32),
        rng.normal(-4, 0.5, (count, 3)).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
        rng.normal(size=count).astype(np.float32),
        rng.normal(size=(count, 3)).astype(np.float32),
        rng.normal(size=(count, 3, 3)).astype(np.float32),
    )


@pytest.mark.parametrize("dress", ["nearest", "moments"])
@pytest.mark.parametrize("keep", [1, 3, 40, 399, 400])
def test_exactly_as_many_remain_as_asked_for(
    dress: str, keep: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where blocks get fractions of a splat: 400 splats make 16 blocks of 25."""
    monkeypatch.setattr(merging, "BLOCK", 30)

    reduced = merging.reduce(scene_of(), keep, dress)

    assert len(reduced) == keep
    assert np.isfinite(reduced.means).all()
    assert reduced.sh_rest.shape == (keep, 3, 3)


def test_the_nearest_members_are_splats_of_the_scene() -> None:
    """Every row that stays is a row of the original, in its old order."""
    splats = scene_of()
    found = merging.reduce(splats, 100, "nearest")

    rows = [int(np.flatnonzero((splats.means == mean).all(axis=1))[0]) for mean in found.means]

    assert rows == sorted(set(rows))
    np.testing.assert_array_equal(found.sh_rest, splats.sh_rest[rows])


def test_two_splats_become_one_with_the_moments_of_both() -> None:
    """Balls of scale 0.1 at x = -0.3 and 0.3, opacity 1/2 each.

    Mean 0; variance along x 0.01 + 0.09, across 0.01; the areas 0.01 each become 0.0316 x 0.1,
    so the opacity is 2 x 0.5 x 0.01 / (sqrt(0.1) x 0.1) = 0.316; the colours are averaged.
    """
    two = Splats(
        np.array([[-0.3, 0, 0], [0.3, 0, 0]]),
        np.full((2, 3), np.log(0.1)),
        np.tile([1.0, 0, 0, 0], (2, 1)),
        np.zeros(2),
        np.array([[1.0, 0, 0], [0, 1.0, 0]]),
        np.zeros((2, 0, 3)),
    )

    one = merging.reduce(two, 1, "moments")

    axes = rotation_matrices(one.quaternions)[0] * np.exp(one.log_scales[0])
    np.testing.assert_allclose(one.means, [[0, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(axes @ axes.T, np.diag([0.1, 0.01, 0.01]), atol=1e-12)
    np.testing.assert_allclose(opacity(one.opacity_logits), 0.01 / (np.sqrt(0.1) * 0.1))
    np.testing.assert_allclose(one.sh_dc, [[0.5, 0.5, 0]])


def test_two_far_clusters_are_found_whatever_the_start() -> None:
    """Two knots of ten splats become one each, though both centres may start in the same."""
    splats = scene_of(20)
    splats.means[:] = splats.means * 0.01 + np.repeat([[0, 0, 0], [10, 0, 0]], 10, axis=0)

    for seed in range(5):
        found = merging.reduce(splats, 2, "moments", seed=seed)

        assert np.sort(np.round(found.means[:, 0])).tolist() == [0, 10]


def test_splats_that_cannot_be_drawn_go_first() -> None:
    """A NaN among them must not spread."""
    splats = scene_of()
    splats.means[7] = np.nan

    reduced = merging.reduce(splats, 399, "moments")

    assert np.isfinite(reduced.means).all()
