"""Exact nearest neighbours of every point of a cloud, with NumPy alone.

A balanced tree halves the points along their longest side until leaves of a few points are left,
so dense and sparse regions cost the same. All the points of a leaf search together: leaves whose
box is nearer than the farthest neighbour found so far, nearest box first, many leaves at a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from .work import Progress, for_chunks, silent

if TYPE_CHECKING:
    from numpy.typing import NDArray

_LEAF = 12
"""Points in a leaf, at least half as many: few enough that most of a visited leaf is near."""

_BATCH = 4096
"""Leaves that search at once; bounds the memory."""


class _Tree(NamedTuple):
    """A balanced tree in arrays: node n of a level has the nodes 2n and 2n + 1 below it.

    Attributes
    ----------
    which : (leaves, size) int64
        Which point it is; N and more where a leaf has been filled up.
    points : (leaves, size, 3) float64
    boxes : list of (2, nodes, 3) float64
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
    """Return the nearest neighbours of every point.

    Parameters
    ----------
    points : (N, 3) float64
        Finite, of a size whose square is finite.
    count : int
        How many neighbours, fewer where there are not as many other points.
    progress : callable, optional
        See `refine_addon.core.work.Progress`.
    threads : int, optional

    Returns
    -------
    (N, min(count, N - 1)) int32
        Nearest first, equal distances by index; a point is not its own neighbour. Which of several
        points at the same distance is the last is not defined, but always the same.

    Examples
    --------
    >>> nearest(np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]]), 1).ravel().tolist()
    [1, 0, 1]
    """
    total = len(points)
    count = min(count, total - 1)
    if count <= 0:
        return np.empty((total, 0), np.int32)
    tree = _build(np.asarray(points, np.float64), count)
    found = np.empty((total, count), np.int32)

    def search(piece: slice) -> None:
        neighbours = _search(tree, np.arange(piece.start, piece.stop), count, total)
        own = tree.which[piece]
        found[own[own < total]] = neighbours[own < total]

    for_chunks(
        search, len(tree.which), _BATCH,
        progress=progress, what="finding neighbours", threads=threads,
    )  # fmt: skip
    return found


def _build(points: NDArray[np.float64], count: int) -> _Tree:
    """Halve the points until a leaf holds `_LEAF` at most, but more than `count` with its twin."""
    total = len(points)
    depth = 0
    while total / 2 ** (depth + 1) >= max(_LEAF / 2, (count + 1) / 2 + 1):
        depth += 1
    size = -(-total // 2**depth)
    # Leaves are filled up with copies of points, which change no box, and are told by their index.
    order = np.arange(size * 2**depth)
    copies = np.where(order < total, order, (order - total) % total)
    for level in range(depth):
        nodes = order.reshape(2**level, -1)
        inside = points[copies[nodes]]
        axis = np.argmax(inside.max(axis=1) - inside.min(axis=1), axis=1)
        along = np.take_along_axis(inside, axis[:, None, None], axis=2)[..., 0]
        halves = np.argpartition(along, nodes.shape[1] // 2, axis=1)
        order = np.take_along_axis(nodes, halves, axis=1).ravel()
    index = order.reshape(2**depth, size)
    leaves = points[copies[index]]
    boxes = [np.stack([leaves.min(axis=1), leaves.max(axis=1)])]
    while boxes[0].shape[1] > 1:
        low, high = boxes[0].reshape(2, -1, 2, 3)
        boxes.insert(0, np.stack([low.min(axis=1), high.max(axis=1)]))
    return _Tree(index, leaves, boxes)


def _search(tree: _Tree, leaves: NDArray[np.int64], count: int, total: int) -> NDArray[np.int32]:
    """Return the neighbours, (leaves, size, count), of all points of some leaves."""
    shape = (len(leaves), tree.which.shape[1], count)
    best = np.full(shape, np.inf), np.full(shape, total, np.int64)
    everyone = np.arange(len(leaves))
    # The leaf itself and its twin hold enough points for a first bound on the distance.
    for twin in (0, 1) if len(tree.which) > 1 else (0,):
        _visit(tree, leaves, everyone, leaves ^ twin, best, total)
    starts, others, gaps = _candidates(tree, leaves, best[0].max(axis=(1, 2)))
    alive, step = everyone, 0
    while len(alive):
        place = starts[alive] + step
        inside = place < starts[alive + 1]
        alive, place = alive[inside], place[inside]
        near = gaps[place] < best[0][alive].max(axis=(1, 2))
        alive, place = alive[near], place[near]
        _visit(tree, leaves, alive, others[place], best, total)
        step += 1
    order = np.lexsort((best[1], best[0]), axis=-1)
    return np.take_along_axis(best[1], order, axis=-1).astype(np.int32)


def _visit(
    tree: _Tree,
    leaves: NDArray[np.int64],
    rows: NDArray[np.int64],
    others: NDArray[np.int64],
    best: tuple[NDArray[np.float64], NDArray[np.int64]],
    total: int,
) -> None:
    """Compare the points of ``leaves[rows]`` with those of `others`; keep the nearest in `best`."""
    count = best[0].shape[2]
    here, there = tree.points[leaves[rows]], tree.points[others]
    squared = np.zeros((*here.shape[:2], there.shape[1]))
    for axis in range(3):
        step = here[:, :, None, axis] - there[:, None, :, axis]
        squared += step * step
    index = tree.which[others][:, None, :]
    squared[(index >= total) | (index == tree.which[leaves[rows]][:, :, None])] = np.inf
    distances = np.concatenate([best[0][rows], squared], axis=2)
    indices = np.concatenate([best[1][rows], np.broadcast_to(index, squared.shape)], axis=2)
    chosen = np.argpartition(distances, count - 1, axis=2)[..., :count]
    best[0][rows] = np.take_along_axis(distances, chosen, axis=2)
    best[1][rows] = np.take_along_axis(indices, chosen, axis=2)


def _candidates(
    tree: _Tree, leaves: NDArray[np.int64], bounds: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return which other leaves lie within `bounds` (squared) of each of `leaves`.

    Returns
    -------
    starts : (leaves + 1,) int64
        Those of row r are ``starts[r]:starts[r + 1]``, nearest box first.
    others : (candidates,) int64
    gaps : (candidates,) float64
        Squared distance of the boxes.
    """
    rows, nodes = np.arange(len(leaves)), np.zeros(len(leaves), np.int64)
    gaps = np.zeros(len(leaves))
    low, high = tree.boxes[-1][:, leaves]
    for boxes in tree.boxes[1:]:
        rows = np.repeat(rows, 2)
        nodes = np.stack([2 * nodes, 2 * nodes + 1], axis=1).ravel()
        gaps = np.zeros(len(rows))
        for axis in range(3):
            apart = np.maximum(
                boxes[0, nodes, axis] - high[rows, axis], low[rows, axis] - boxes[1, nodes, axis]
            )
            gaps += np.maximum(apart, 0.0) ** 2
        near = gaps < bounds[rows]
        rows, nodes, gaps = rows[near], nodes[near], gaps[near]
    other = nodes >> 1 != leaves[rows] >> 1
    rows, nodes, gaps = rows[other], nodes[other], gaps[other]
    order = np.lexsort((nodes, gaps, rows))
    starts = np.searchsorted(rows, np.arange(len(leaves) + 1))
    return starts, nodes[order], gaps[order]
