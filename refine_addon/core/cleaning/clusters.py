"""Clusters of splats that touch, each searched among its near neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, part
from ..merging.neighbours import nearest
from ..visibility.projection import Gaussians

SMALL = 100
"""A cluster of fewer splats is suspect."""

SOLID = (0.1, 0.3)
"""Splats of lower opacity do not hold clusters together: by each of these, since faint ones between
a dense cluster and a bush make one of the two."""

NEIGHBOURS = 8
"""How many near neighbours of a splat are tested for whether they touch it."""

REACH = 2.0
"""Two splats touch within this many standard deviations of both, along the step between them."""

APART = 0.01
"""They touch as well if they are this close: a share of the scene's size plus the distance to its
middle."""


def small_clusters(
    gaussians: Gaussians, solid: NDArray[np.bool_], progress: Progress, threads: int | None
) -> NDArray[np.bool_]:
    """Gaussians of a small cluster, (M,) bool, of those that are solid, (M,) bool.

    Two are in one cluster if they touch, or if a chain of others that touch leads from one to the
    other.
    """
    small = np.zeros(len(solid), np.bool_)
    for number, least in enumerate(SOLID):
        rows = np.flatnonzero(solid & (gaussians.alphas >= least))
        half = part(progress, number / len(SOLID), (number + 1) / len(SOLID))
        near, touch = touching(gaussians.take(rows), np.arange(len(rows)), half, threads)
        one, other = np.nonzero(touch)
        labels = connected(len(rows), one, near[one, other])
        small[rows[np.bincount(labels, minlength=len(rows))[labels] < SMALL]] = True
    return small


def touching(
    gaussians: Gaussians, rows: NDArray[np.int64], progress: Progress, threads: int | None
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Near neighbours of some splats, and which of them each touches, (r, k) each.

    Parameters
    ----------
    gaussians : Gaussians
    rows : (r,) int64
        Which splats.
    """
    points = gaussians.means.T.astype(np.float64)  # (M, 3)
    near = nearest(points, NEIGHBOURS, progress=progress, threads=threads)[rows].astype(np.int64)
    one, other = np.repeat(rows, near.shape[1]), near.ravel()
    step = points[other] - points[one]
    length = np.sqrt(np.einsum("ij,ij->i", step, step))
    unit = (step / np.maximum(length, np.finfo(np.float64).tiny)[:, None]).T
    x, y, z = unit
    reach = np.zeros(len(one))
    for ends in (one, other):  # by their standard deviations along the step
        xx, xy, xz, yy, yz, zz = gaussians.covariances[:, ends].astype(np.float64)
        mixed = xy * x * y + xz * x * z + yz * y * z
        reach += np.sqrt(np.maximum(xx * x * x + yy * y * y + zz * z * z + 2.0 * mixed, 0.0))
    away = APART * (1.0 + np.sqrt(np.einsum("ij,ij->i", points, points)))[one]
    return near, (length <= reach * REACH + away).reshape(near.shape)


def connected(count: int, one: NDArray[np.int64], other: NDArray[np.int64]) -> NDArray[np.int64]:
    """Lowest number in the connected part of a graph that each node is in, (count,).

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
        while not np.array_equal(jumped := labels[labels], labels):
            labels = jumped
        if np.array_equal(labels, before):
            return labels
