"""Compaction by blocks, after GHAP: splats as a Gaussian mixture, reduced by optimal transport.

Wang, Li et al., "Gaussian Herding across Pens: An Optimal Transport Perspective on Global Gaussian
Reduction for 3DGS", 2025. What is taken from it (the paper, and facts of its public code):

- The scene is cut at the median of one axis after the other (x, y, z, x, ...) into blocks of at
  most about 3000 splats; every block is reduced by the same share.
- In a block, the composite transport divergence between the mixture and a smaller one is minimised
  by turns: every splat goes to its cheapest centre, every centre becomes the mean of its splats,
  weighted by opacity. The cost is ``|mu_i - mu_j|^2 + |S_i - S_j|_F^2``, so this is k-means in nine
  dimensions. It starts at splats drawn at random and ends when nothing moves.
- The authors then train opacity and colour anew. Here nothing is trained, so there are two ways to
  dress the centres, and both are measured:

  `nearest`  the splat nearest to each centre stays as it is: what the public code trains on.
  `moments`  the cluster becomes one splat: mean and covariance of the mixture (scatter of the means
             included), colour by opacity x area, opacity so that the sum of opacity x area is kept
             and at most 0.99; area is the product of the two largest scales.

A centre that loses all its splats takes the one that is farthest from its own centre, so that
exactly as many remain as the budget asks for.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from refine_addon.core.affine import quaternion
from refine_addon.core.splats import Splats, drawable, opacity, rotation_matrices

BLOCK = 3000
"""Largest number of splats of a block."""

ROUNDS = 30
"""Most rounds of assigning and averaging; clusters move little after a few."""

OPACITY_MAX = 0.99

_ROWS = 512  # of the cost matrix at once


def reduce(
    splats: Splats, keep_count: int, dress: Literal["nearest", "moments"], *, seed: int = 0
) -> Splats:
    """Return `keep_count` splats in place of all.

    - splats: Those that cannot be drawn go first.
    - keep_count: 1 to N.
    - dress, {"nearest", "moments"}: See the module's docstring.
    - seed: Of the draw of the first centres.
    """
    rows = np.flatnonzero(drawable(splats))
    if keep_count >= len(rows):
        return splats.take(rows)
    good = splats.take(rows)
    alpha = opacity(good.opacity_logits)
    means = np.asarray(good.means, np.float64)
    covariances = _covariances(good)
    features = _features(means, covariances)
    rng = np.random.default_rng(seed)
    labels = np.empty(len(good), np.int64)
    kept, first = [], 0
    for block, count in _blocks(means, keep_count):
        centers, own = _cluster(features[block], alpha[block], count, rng)
        labels[block] = own + first
        first += count
        kept.append(block[_nearest_members(features[block], centers, own)])
    representatives = np.concatenate(kept)
    if dress == "nearest":
        return good.take(np.sort(representatives))
    return _merged(good, (means, covariances, alpha), labels, representatives)


def _blocks(means: NDArray[np.float64], keep_count: int) -> list[tuple[NDArray[np.int64], int]]:
    """Cut at medians; return each block's splats and how many of them stay."""
    blocks, axis = [np.arange(len(means))], 0
    # No more blocks than splats that stay: each needs at least one.
    while max(map(len, blocks)) > BLOCK and 2 * len(blocks) <= keep_count:
        halves = []
        for block in blocks:
            order = block[np.argsort(means[block, axis % 3], kind="stable")]
            halves += [order[: len(order) // 2], order[len(order) // 2 :]]
        blocks, axis = halves, axis + 1
    # Shares are rounded so that their sum is the budget.
    edges = np.cumsum([0, *map(len, blocks)]) * keep_count // len(means)
    return [(block, int(count)) for block, count in zip(blocks, np.diff(edges), strict=True)]


def _features(means: NDArray[np.float64], covariances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return points, (N, 9), whose squared distances are the cost."""
    weights = np.sqrt([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])  # off-diagonal entries count twice
    return np.hstack([means, covariances[:, *np.triu_indices(3)] * weights])


def _cluster(
    points: NDArray[np.float64], weights: NDArray[np.float64], count: int, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the centres, (count, 9), and each point's centre; none of them is empty."""
    centers = points[rng.choice(len(points), count, replace=False)]
    own = np.full(len(points), -1)
    for _ in range(ROUNDS):
        before = own
        own, cost = _assign(points, centers)
        _fill_empty(own, cost, count)
        if np.array_equal(own, before):
            break
        total = np.bincount(own, weights, count)
        sums = [np.bincount(own, weights * column, count) for column in points.T]
        centers = np.stack(sums, axis=1) / total[:, None]
    return centers, own


def _assign(
    points: NDArray[np.float64], centers: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return each point's nearest centre and its squared distance."""
    own, cost = np.empty(len(points), np.int64), np.empty(len(points))
    squares = np.einsum("ij,ij->i", centers, centers)
    for start in range(0, len(points), _ROWS):
        piece = slice(start, start + _ROWS)
        matrix = squares - 2.0 * (points[piece] @ centers.T)
        own[piece] = np.argmin(matrix, axis=1)
        cost[piece] = np.sum((points[piece] - centers[own[piece]]) ** 2, axis=1)
    return own, cost


def _fill_empty(own: NDArray[np.int64], cost: NDArray[np.float64], count: int) -> None:
    """Give each empty centre the costliest point of a centre that has others."""
    members = np.bincount(own, minlength=count)
    candidates = iter(np.argsort(-cost, kind="stable"))
    for empty in np.flatnonzero(members == 0):
        point = next(point for point in candidates if members[own[point]] > 1)
        members[own[point]] -= 1
        own[point], members[empty] = empty, 1


def _nearest_members(
    points: NDArray[np.float64], centers: NDArray[np.float64], own: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return for each centre the nearest of its own points."""
    cost = np.sum((points - centers[own]) ** 2, axis=1)
    order = np.lexsort((cost, own))
    return order[np.unique(own[order], return_index=True)[1]]


def _merged(
    splats: Splats,
    geometry: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]],
    labels: NDArray[np.int64],
    representatives: NDArray[np.int64],
) -> Splats:
    """Return one splat for each label by matching moments; alone, a splat stays as it is."""
    means, covariances, alpha = geometry
    count = len(representatives)
    total = np.bincount(labels, alpha, count)

    def averaged(values: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
        flat = values.reshape(len(values), -1)
        sums = [np.bincount(labels, weights * column, count) for column in flat.T]
        summed = np.stack(sums, axis=1) / np.bincount(labels, weights, count)[:, None]
        return summed.reshape(count, *values.shape[1:])

    mean = averaged(means, alpha)
    offset = means - mean[labels]
    covariance = averaged(covariances + offset[:, :, None] * offset[:, None, :], alpha)
    variances, axes = np.linalg.eigh(covariance)
    axes[np.linalg.det(axes) < 0.0, :, 0] *= -1.0
    log_scales = 0.5 * np.log(np.maximum(variances, 1e-30))
    mass = alpha * _area(np.asarray(splats.log_scales, np.float64))
    share = np.bincount(labels, mass, count) / _area(log_scales)
    share = np.clip(share, 1e-6, OPACITY_MAX)
    merged = splats.take(representatives)
    several = (np.bincount(labels, minlength=count) > 1) & (total > 0.0)
    changes = {
        "means": mean,
        "log_scales": log_scales,
        "quaternions": quaternion(axes),
        "opacity_logits": np.log(share / (1.0 - share)),
        "sh_dc": averaged(np.asarray(splats.sh_dc, np.float64), mass),
        "sh_rest": averaged(np.asarray(splats.sh_rest, np.float64), mass)
        if splats.sh_rest.size
        else np.empty((count, *splats.sh_rest.shape[1:])),
    }
    for name, values in changes.items():
        old = getattr(merged, name)
        keep = several.reshape(-1, *[1] * (old.ndim - 1))
        changes[name] = np.where(keep, values, old).astype(old.dtype.newbyteorder("="))
    return replace(merged, **changes)


def _covariances(splats: Splats) -> NDArray[np.float64]:
    """Return the covariances, (N, 3, 3)."""
    scales = np.exp(np.asarray(splats.log_scales, np.float64))
    axes = rotation_matrices(np.asarray(splats.quaternions)) * scales[:, None, :]
    return axes @ np.swapaxes(axes, 1, 2)


def _area(log_scales: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the product of the two largest scales, (N,)."""
    return np.exp(np.sum(log_scales, axis=1) - np.min(log_scales, axis=1))
