"""Clusters of splats that touch, each searched among its near neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, silent
from ..merging.neighbours import nearest
from ..visibility.projection import Gaussians

NEIGHBOURS = 8
"""How many near neighbours of a splat are tested for whether they touch it."""

REACH = 2.0
"""Two splats touch within this many standard deviations of both, along the step between them."""

APART = 0.01
"""They touch as well if they are this close: a share of the scene's size plus the distance to its
middle."""


def cluster_sizes(
    gaussians: Gaussians, *, progress: Progress = silent, threads: int | None = None
) -> NDArray[np.int64]:
    """Return how many splats there are in the cluster of each, (M,).

    Two are in one cluster if they touch, or if a chain of others that touch leads from one to the
    other.
    """
    points = gaussians.means.T.astype(np.float64)  # (M, 3)
    near = nearest(points, NEIGHBOURS, progress=progress, threads=threads)
    one = np.repeat(np.arange(len(points)), near.shape[1])
    other = near.ravel().astype(np.int64)
    touch = _touch(gaussians, points, one, other)
    labels = connected(len(points), one[touch], other[touch])
    return np.bincount(labels, minlength=len(points))[labels]


def touching(
    gaussians: Gaussians,
    rows: NDArray[np.int64],
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return near neighbours of some splats, and which of them each touches, (r, k) each.

    Parameters
    ----------
    gaussians : Gaussians
    rows : (r,) int64
        Which splats.
    """
    points = gaussians.means.T.astype(np.float64)  # (M, 3)
    near = nearest(points, NEIGHBOURS, progress=progress, threads=threads)[rows].astype(np.int64)
    touch = _touch(gaussians, points, np.repeat(rows, near.shape[1]), near.ravel())
    return near, touch.reshape(near.shape)


def _touch(
    gaussians: Gaussians,
    points: NDArray[np.float64],
    one: NDArray[np.int64],
    other: NDArray[np.int64],
) -> NDArray[np.bool_]:
    """Return which pairs of splats touch, (E,); points are their means, (M, 3)."""
    step = points[other] - points[one]
    length = np.sqrt(np.einsum("ij,ij->i", step, step))
    unit = (step / np.maximum(length, np.finfo(np.float64).tiny)[:, None]).T
    reach = sum(_deviation(gaussians.covariances[:, rows], unit) for rows in (one, other)) * REACH
    reach += APART * (1.0 + np.sqrt(np.einsum("ij,ij->i", points, points)))[one]
    return np.asarray(length <= reach)


def _deviation(covariances: NDArray[np.float32], unit: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the standard deviation of splats along directions, (n,), of (6, n) and (3, n)."""
    x, y, z = unit
    xx, xy, xz, yy, yz, zz = covariances.astype(np.float64)
    squared = xx * x * x + yy * y * y + zz * z * z + 2.0 * (xy * x * y + xz * x * z + yz * y * z)
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


def connected(count: int, one: NDArray[np.int64], other: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the lowest number in the connected part of a graph that each node is in, (count,).

    Parameters
    ----------
    count : int
        How many nodes there are.
    one, other : (E,) int64
        The ends of the edges.

    Examples
    --------
    >>> connected(5, np.array([3, 1]), np.array([1, 4])).tolist()
    [0, 1, 2, 1, 1]
    """
    labels = np.arange(count)
    while True:
        low = np.minimum(labels[one], labels[other])
        before = labels.copy()
        for ends in (one, other):
            lower = low < labels[ends]
            # The root of a part that touches a lower one, and the node itself, move there.
            np.minimum.at(labels, before[ends[lower]], low[lower])
            np.minimum.at(labels, ends[lower], low[lower])
        while True:
            jumped = labels[labels]
            if np.array_equal(jumped, labels):
                break
            labels = jumped
        if np.array_equal(labels, before):
            return labels
