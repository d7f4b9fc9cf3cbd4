"""Nearest neighbours of every point of a cloud, with NumPy alone.

A balanced tree halves the points along their longest side until leaves of a few points are left,
so that dense and sparse regions cost the same. The points of a leaf are compared with those of the
`VISITED` leaves whose boxes are nearest, which a beam finds from the root down. Fixed work for
every point, whatever the cloud: a search to the last neighbour would cost a far outlier the whole
cloud. Exact for small clouds; of trained scenes it finds 98 to 99 % of the 8 nearest.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..work import Progress, for_chunks, silent

if TYPE_CHECKING:
    from numpy.typing import NDArray

VISITED = 20
"""Leaves that the points of one leaf are compared with, itself among them."""

_LEAF = 8
"""Points in a leaf, at least half as many."""

_MIDDLE = 1e-3
"""Weight of the squared distance of the middles of two boxes, which decides among those that
touch."""

_BATCH = 256
"""Leaves that search at once; bounds the memory."""


class _Tree(NamedTuple):
    """A balanced tree in arrays: node n of a level has the nodes 2n and 2n + 1 below it.

    Attributes
    ----------
    which : (leaves, size) int64
        Which point it is; N and more where a leaf has been filled up.
    points : (leaves, size, 3) float64
    boxes : list of (2, 3, nodes) float64
        Lower and upper corner, from the root down to the leaves.
    """

    which: NDArray[np.int64]
    points: NDArray[np.float64]
    boxes: list[NDArray[np.float64]]


def nearest(
    points: NDArray[np.float64],
    count: int,
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> NDArray[np.int32]:
    """Return near neighbours of every point, nearly always the nearest.

    Parameters
    ----------
    points : (N, 3) float64
        Finite, of a size whose square is finite.
    count : int
        How many neighbours, up to 16; fewer where there are not as many other points.
    progress : callable, optional
        See `refine_addon.core.work.Progress`.
    threads : int, optional

    Returns
    -------
    (N, min(count, N - 1)) int32
        Nearest first, equal distances by index; a point is not its own neighbour.

    Examples
    --------
    >>> nearest(np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]), 1).ravel().tolist()
    [1, 0, 1]
    """
    total = len(points)
    count = min(count, total - 1)
    if count <= 0:
        return np.empty((total, 0), np.int32)
    tree = _build(np.asarray(points, np.float64))
    found = np.empty((total, count), np.int32)

    def search(piece: slice) -> None:
        own = tree.which[piece]
        real = own < total
        found[own[real]] = _search(tree, piece, count, total)[real]

    for_chunks(
        search, len(tree.which), _BATCH,
        progress=progress, what="finding neighbours", threads=threads,
    )  # fmt: skip
    return found


def _build(points: NDArray[np.float64]) -> _Tree:
    """Halve the points until a leaf holds `_LEAF` at most."""
    total = len(points)
    depth = 0
    while total > _LEAF << depth:
        depth += 1
    size = -(-total // 2**depth)
    # Leaves are filled up with copies of points, which change no box, and are told by their index.
    order = np.arange(size * 2**depth)
    copies = np.where(order < total, order, (order - total) % total)
    for level in range(depth):
        nodes = order.reshape(2**level, -1)
        inside = points.take(copies.take(nodes), axis=0)
        axis = np.argmax(inside.max(axis=1) - inside.min(axis=1), axis=1)
        along = np.take_along_axis(inside, axis[:, None, None], axis=2)[..., 0]
        halves = np.argpartition(along, nodes.shape[1] // 2, axis=1)
        order = np.take_along_axis(nodes, halves, axis=1).ravel()
    which = order.reshape(2**depth, size)
    leaves = points[copies[which]]
    boxes = [np.stack([leaves.min(axis=1).T, leaves.max(axis=1).T])]
    while boxes[0].shape[2] > 1:
        low, high = boxes[0].reshape(2, 3, -1, 2)
        boxes.insert(0, np.stack([low.min(axis=2), high.max(axis=2)]))
    return _Tree(which, leaves, boxes)


def _search(tree: _Tree, rows: slice, count: int, total: int) -> NDArray[np.int64]:
    """Return the neighbours, (leaves, size, count), of all points of some leaves."""
    nodes = _near_leaves(tree, rows)
    own = tree.points[rows]
    others = tree.points.take(nodes, axis=0).reshape(len(own), -1, 3)
    index = tree.which.take(nodes, axis=0).reshape(len(own), 1, -1)
    squared = np.zeros((*own.shape[:2], others.shape[1]))
    for axis in range(3):
        step = own[:, :, None, axis] - others[:, None, :, axis]
        squared += np.multiply(step, step, out=step)
    squared[(index == tree.which[rows][:, :, None]) | (index >= total)] = np.inf
    index = np.broadcast_to(index, squared.shape)
    chosen = np.argpartition(squared, count - 1, axis=2)[..., :count]
    index = np.take_along_axis(index, chosen, axis=2)
    order = np.lexsort((index, np.take_along_axis(squared, chosen, axis=2)), axis=-1)
    return np.take_along_axis(index, order, axis=2)


def _near_leaves(tree: _Tree, rows: slice) -> NDArray[np.int64]:
    """Return the leaves nearest to some leaves, (leaves, `VISITED`) or all where there are fewer.

    A level at a time, only the `VISITED` nearest nodes are followed down.
    """
    low, high = tree.boxes[-1][:, :, rows, None]
    nodes = np.zeros((low.shape[1], 1), np.int64)
    for boxes in tree.boxes[1:]:
        nodes = np.concatenate([2 * nodes, 2 * nodes + 1], axis=1)
        if nodes.shape[1] <= VISITED:
            continue
        distance = np.zeros(nodes.shape)
        for axis in range(3):
            lower, upper = boxes[0, axis].take(nodes), boxes[1, axis].take(nodes)
            gap = np.maximum(lower - high[axis], low[axis] - upper)
            middle = 0.5 * (lower + upper - low[axis] - high[axis])
            distance += np.maximum(gap, 0.0) ** 2 + _MIDDLE * middle * middle
        nearest_nodes = np.argpartition(distance, VISITED - 1, axis=1)[:, :VISITED]
        nodes = np.take_along_axis(nodes, nearest_nodes, axis=1)
    return nodes
