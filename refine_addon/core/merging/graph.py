"""Merges and deletions of splats, cheapest first, on a graph of neighbouring splats.

Neighbours come from NumPy alone: points are sorted along a few turned and shifted space-filling
curves, and only near places on these are searched (Liao, Lopez and Leutenegger 2001). In trained
scenes that finds 87 to 89 % of the 8 nearest, and 97 to 98 % of the very nearest.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, chunks, part, report, return_freed, run_all, silent
from ..splats import rotation_matrices
from ..visibility.scene import MIX, Scene, spatial_order
from . import pairs as pricing
from .field import Array, Field, Index

Rows = NDArray[np.int32]
Costs = NDArray[np.float32]
NEIGHBOURS = 8  # neighbours that each splat may be merged with
BATCH = 0.1  # most that a round removes; a third of that takes longer and looks the same

LOOKED_AT = 0.03
"""A round considers at least twice this share of the splats, however few it may remove: otherwise
the last few splats of a stage would take as many rounds as all before."""

FILLED = 0.25
"""A round that removes less than this share of its quota also merges pairs that are not both
splats' cheapest operation: else, of many copies of a splat, one pair would merge in a round."""

DISC_PENALTY = 0.5
"""Factor on the merge cost of discs (2DGS): on `room_small` at 50 %, 1.0 is 1.6 dB worse, 0.25 or
0.7 is 0.1 dB worse."""

UNSEEN = 4.0
"""Factor on the cost of deleting what views hardly saw: that of neighbours deleted together adds up
before it is squared, and none is measured there. In four houses at 50 % the worst of 24 other
pictures gains 1.1 to 2.3 dB, their mean 0.2; with 16 it is the same."""

CONNECTING = 0.65  # share of a stage's time until its pairs are priced

CURVES = np.array(
    [[1.0, 0, 0, 0], [0.8, 0.3, 0.4, 0.3], [0.5, -0.6, 0.1, 0.6], [0.3, 0.5, -0.7, 0.4]]
)  # rotation of each curve, w x y z

SHIFTS = np.array([[0.0, 0, 0], [0.21, 0.13, 0.17], [-0.11, 0.23, -0.19], [0.15, -0.27, 0.07]])
"""Offset of each curve, scene sizes, so that their cells do not meet in one place."""

WINDOW = 6  # candidates: this many places before and behind, on each curve
SMALL = 128  # up to this many points, all are compared with all
_CHUNK = 1 << 14  # pairs or points at a time: some MB of temporary memory a thread
_SCANNED = 1 << 18  # pairs at a time that are only looked at
_NOBODY = np.uint64(2**64 - 1)  # sorts behind every candidate
_INDEX = np.uint64(2**32 - 1)  # the bits of a key that hold the index
_ROUNDED = np.uint32(4)  # last bits of a distance in float32, in which equal ones may differ


class MergeGraph:
    """N splats, the pairs of near ones that may merge, and the costs of merges and deletions.

    `field`, (N,), is changed: merged splats replace one of their two. `penalty` is
    `merge.merge_penalty`; for discs it is multiplied by `DISC_PENALTY`. Deleting `unseen` splats,
    (N,), costs `UNSEEN` times as much.
    """

    def __init__(
        self, field: Field, scene: Scene, penalty: float, unseen: NDArray[np.bool_]
    ) -> None:
        self.field, self.scene, self.unseen = field, scene, unseen
        self.penalty = penalty * (DISC_PENALTY if field.model == "2dgs" else 1.0)
        # A splat of unknown error is not merged: without contribution it gets no pairs.
        field.contribution[~np.isfinite(field.error)] = 0.0
        self.alive = np.ones(len(field.means), np.bool_)  # (N,): neither deleted nor merged
        # Of each round: rows merged into, rows merged, share of the former in the colour.
        self.merges: list[tuple[Index, Index, Array]] = []
        self.first = self.second = np.empty(0, np.int32)  # (E,), rows of the pairs
        self.cost = np.empty(0, np.float32)  # (E,), infinite where deleting one costs no more
        self.connected = 0  # splats alive when neighbours were last searched

    def best(self) -> tuple[Costs, NDArray[np.bool_]]:
        """Cost of each splat's cheapest operation, (N,) float32, and whether it is a merge."""
        error = self._errors()
        best = _least_costs(error, self.first, self.second, self.cost)
        return best, best < error

    def reduce(self, goal: int, progress: Progress = silent) -> None:
        """Merge and delete until `goal` splats are alive; call it once."""
        start = count = len(self.alive)
        if count > goal and not self.connected:
            self.connect(part(progress, 0.0, CONNECTING))
        while count > goal:
            done = CONNECTING + (1.0 - CONNECTING) * (start - count) / (start - goal)
            of_round = part(progress, done, done)
            report(of_round, 0.0, "merging")
            return_freed()
            if count < self.connected / 2:
                self.connect(of_round)
            count -= self._round(min(max(int(BATCH * count), 1), count - goal), of_round)
        # The pairs are no longer needed; a large scene has ten million of them.
        del self.first, self.second, self.cost

    def connect(self, progress: Progress = silent) -> None:
        """Find the pairs of neighbouring splats, and price them."""
        self.first, self.second = self._neighbours(part(progress, 0.0, 0.6))
        return_freed()
        self.cost = np.empty(len(self.first), np.float32)
        self._price(np.arange(len(self.first), dtype=np.int32), part(progress, 0.6, 1.0))
        self.connected = int(np.count_nonzero(self.alive))

    def _neighbours(self, progress: Progress) -> tuple[Rows, Rows]:
        """Rows of pairs of neighbouring splats, (E,) each."""
        rows = np.flatnonzero(self.alive & (self.field.contribution > 0.0))  # (R,)
        place = self.scene.positions(self.field.means, rows)  # (R, 3)
        near = nearest(place, NEIGHBOURS, progress=part(progress, 0.0, 0.8))  # (R, k)
        del place

        def pairs(piece: slice) -> tuple[Rows, Rows]:
            of_piece, others = np.arange(piece.start, piece.stop)[:, None], near[piece]  # (n, 1)
            # Two splats that are neighbours of each other make one pair, not two.
            once = (of_piece < others) | ~(near[others] == of_piece[:, :, None]).any(axis=2)
            first = np.broadcast_to(of_piece, others.shape)[once]
            return rows[first].astype(np.int32), rows[others[once]].astype(np.int32)

        pieces, later = chunks(max(len(rows), 1), _CHUNK), part(progress, 0.8, 1.0)
        edges = run_all(pairs, pieces, progress=later, what="merging")
        # int32 takes half the memory of int64, and no file holds two billion splats.
        first, second = map(np.concatenate, zip(*edges, strict=True))
        return first, second

    def _price(self, edges: Index, progress: Progress) -> None:
        """Set the costs of some pairs; infinite where deleting one of the two costs less."""

        def price(piece: slice) -> None:
            rows = edges[piece]
            first, second = self.first[rows], self.second[rows]
            deleting = (
                self.field.error.take(each) * np.where(self.unseen.take(each), UNSEEN, 1.0)
                for each in (first, second)
            )
            cost = pricing.costs(self.field, first, second, np.minimum(*deleting) / self.penalty)
            self.cost[rows] = self.penalty * cost

        pieces = chunks(len(edges), _CHUNK)
        run_all(price, pieces, progress=progress, what="merging")

    def _round(self, quota: int, progress: Progress = silent) -> int:
        """Carry out the cheapest operations that share no splat; their number is 1 to `quota`.

        A merge must be the cheapest operation of both splats, unless few are (`FILLED`).
        """
        error = self._errors()  # (N,)
        least = max(int(LOOKED_AT * np.count_nonzero(self.alive)), 1)
        # Twice as many operations are looked at, since those that share a splat exclude each other.
        costs = np.concatenate([error, self.cost])
        possible = np.count_nonzero(self.alive) + np.count_nonzero(np.isfinite(self.cost))
        rank = min(2 * max(quota, least), possible) - 1
        costs.partition(rank)
        limit = costs[rank]
        edges = np.flatnonzero(self.cost <= limit)  # (e,)
        first, second, cost = self.first[edges], self.second[edges], self.cost[edges]
        best = _least_costs(error, first, second, cost)
        mutual = (cost == best[first]) & (cost == best[second])  # (e,)
        chosen = edges[mutual][_disjoint(first[mutual], second[mutual])]
        alone = self.alive & (best == error) & (error <= limit)
        if np.count_nonzero(alone) + len(chosen) < FILLED * min(quota, least):
            # Of the other pairs as many as share no splat with any chosen.
            taken = np.zeros(len(self.alive), np.bool_)
            taken[self.first[chosen]] = taken[self.second[chosen]] = True
            free = edges[~(taken[first] | taken[second])]
            free = free[_disjoint(self.first[free], self.second[free])]
            chosen = np.concatenate([chosen, free])
        alone[self.first[chosen]] = alone[self.second[chosen]] = False
        doomed = np.flatnonzero(alone)  # (d,)
        costs = np.concatenate([error[doomed], self.cost[chosen]])  # (d + m,)
        order = np.argsort(costs, kind="stable")[:quota]
        is_merge = order >= len(doomed)
        self._carry_out(doomed[order[~is_merge]], chosen[order[is_merge] - len(doomed)], progress)
        return len(order)

    def _errors(self) -> Costs:
        """Costs of deleting splats, (N,) float32; infinite for NaN, which no comparison chooses."""
        with np.errstate(over="ignore", under="ignore"):
            error = self.field.error.astype(np.float32)
            error[self.unseen] *= np.float32(UNSEEN)
        error[~self.alive | np.isnan(error)] = np.inf
        return error

    def _carry_out(self, doomed: Index, edges: Index, progress: Progress) -> None:
        """Delete splats, merge pairs, and price the pairs of the merged splats again."""
        field, first, second = self.field, self.first[edges], self.second[edges]
        # Of each pair the splat of which the views see more stays. No two pairs share a splat.
        swap = field.contribution[second] > field.contribution[first]
        into, gone = np.where(swap, second, first), np.where(swap, first, second)  # (m,) each
        share = np.empty(len(edges))

        def merge(piece: slice) -> None:
            pairs = pricing.price(field, first[piece], second[piece])
            field.put(into[piece], pricing.merge(field, first[piece], second[piece], pairs))
            share[piece] = np.where(swap[piece], 1.0 - pairs.color, pairs.color)

        run_all(merge, chunks(len(edges), _CHUNK))
        self.merges.append((into, gone, share))
        self.alive[doomed] = self.alive[gone] = False
        changed = np.zeros(len(self.alive), np.bool_)
        changed[doomed] = changed[gone] = changed[into] = True

        def concerning(piece: slice) -> Index:
            either = changed.take(self.first[piece]) | changed.take(self.second[piece])
            return np.asarray(np.flatnonzero(either) + piece.start)

        # Few pairs are concerned; the rest are not looked at again.
        pieces = chunks(max(len(self.first), 1), _SCANNED)
        concerned = np.concatenate(run_all(concerning, pieces))  # (e,)
        # Pairs of a splat that went into another become pairs of that one.
        now = np.arange(len(self.alive), dtype=np.int32)  # (N,)
        now[gone] = into
        one, two = now.take(self.first[concerned]), now.take(self.second[concerned])
        self.first[concerned], self.second[concerned] = one, two
        remain = self.alive[one] & self.alive[two] & (one != two)
        self._price(concerned[remain], progress)
        valid = np.ones(len(self.first), np.bool_)
        valid[concerned[~remain]] = False

        def left(values: NDArray[Any]) -> NDArray[Any]:
            return np.concatenate(run_all(lambda piece: values[piece][valid[piece]], pieces))

        self.first = left(self.first)  # one at a time, to save memory
        self.second = left(self.second)
        self.cost = left(self.cost)


def _least_costs(error: Costs, first: Rows, second: Rows, cost: Costs) -> Costs:
    best = error.copy()
    np.minimum.at(best, first, cost)
    np.minimum.at(best, second, cost)
    return best


def _disjoint(first: Index, second: Index) -> Index:
    """Ascending indices of pairs that share no splat; each other pair shares one with these."""
    count = len(first)
    chosen = np.zeros(count, np.bool_)
    _, ends = np.unique(np.concatenate([first, second]), return_inverse=True)  # (2 m,)
    # Of the pairs left, (l,) each: index, both splats, and a rank by which they are chosen.
    left, one, two = np.arange(count), ends[:count], ends[count:]
    rank = left.astype(np.uint64)
    while len(left):
        lowest = np.full(2 * count, 2**64 - 1, np.uint64)  # of the pairs of each splat
        np.minimum.at(lowest, one, rank)
        np.minimum.at(lowest, two, rank)
        leads = (lowest[one] == rank) & (lowest[two] == rank)
        chosen[left[leads]] = True
        taken = np.zeros(2 * count, np.bool_)
        taken[one[leads]] = taken[two[leads]] = True
        free = ~(taken[one] | taken[two])
        left, one, two = left[free], one[free], two[free]
        # Shuffled, since a chain of pairs in the order of their ranks would give one at a time.
        rank = rank[free] * MIX
    return np.flatnonzero(chosen)


def nearest(
    points: NDArray[np.float64], count: int, *, progress: Progress = silent
) -> NDArray[np.int32]:
    """Neighbours of N points, most of them the nearest, (N, min(count, N - 1)), nearest first."""
    total = len(points)
    count = min(count, total - 1)
    if count <= 0:
        return np.empty((total, 0), np.int32)
    window = max((count + 1) // 2, WINDOW)
    width, turns = 2 * window + 1, rotation_matrices(CURVES)

    def along(curve: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        order = spatial_order(points @ turns[curve].T + SHIFTS[curve]).astype(np.int32)
        place = np.empty(total, np.int32)
        place[order] = np.arange(total, dtype=np.int32)
        # At either end of a curve the window lies to one side.
        return order, np.clip(place - window, 0, total - width)

    what = "finding neighbours"
    if total <= max(SMALL, width):  # the window holds all
        width, curves = total, [(np.arange(total, dtype=np.int32), np.zeros(total, np.int32))]
    else:
        curves = run_all(along, range(len(CURVES)), progress=part(progress, 0.0, 0.2), what=what)
    steps, columns = np.arange(width, dtype=np.int32), np.ascontiguousarray(points.T)
    near = np.empty((total, count), np.int32)

    def search(piece: slice) -> None:
        # Candidates, (n, C), of n points; they repeat, and hold the point.
        candidates = np.concatenate(
            [order.take(first[piece, None] + steps) for order, first in curves], axis=1
        )
        squared = np.zeros(candidates.shape)
        for coordinate in columns:
            step = coordinate.take(candidates) - coordinate[piece, None]
            squared += np.multiply(step, step, out=step)
        distance = np.minimum(squared, np.finfo(np.float32).max).astype(np.float32)
        # The bits of numbers >= 0 sort as they do; the index behind them decides equal ones.
        key = (distance.view(np.uint32) >> _ROUNDED).astype(np.uint64) << np.uint64(32)
        key |= candidates.astype(np.uint64)
        key[candidates == np.arange(piece.start, piece.stop)[:, None]] = _NOBODY
        key.sort(axis=1)
        # A candidate of several curves stands there as often.
        key[:, 1:][key[:, 1:] == key[:, :-1]] = _NOBODY
        key.sort(axis=1)
        near[piece] = (key[:, :count] & _INDEX).astype(np.int32)

    run_all(search, chunks(total, _CHUNK), progress=part(progress, 0.2, 1.0), what=what)
    return near
