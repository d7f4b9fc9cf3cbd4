"""Merges and deletions of splats, cheapest first, on a graph of neighbouring splats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, chunks, concatenated, part, report, run_all, silent
from ..visibility.scene import MIX, Scene
from . import pairs as pricing
from .field import Array, Field, Index
from .neighbours import nearest

Rows = NDArray[np.int32]
Costs = NDArray[np.float32]

NEIGHBOURS = 8
"""How many nearest neighbours each splat may be merged with."""

BATCH = 0.1
"""Share of the splats that one round removes at most; then costs are computed again. Rounds of a
third of that leave pictures as close, and take longer."""

LOOKED_AT = 0.03
"""A round looks at the cheapest operations of at least twice this share of the splats, however few
it may remove: else the last few splats of a stage would take as many rounds as all before."""

FILLED = 0.25
"""A round that removes less than this share of its quota, or of `LOOKED_AT`, also merges pairs that
are not the cheapest operation for both of their splats. Ordinary scenes remove more. Of copies of a
splat, each costs less than the one before it, so that only one pair would merge in a round."""

DISC_PATIENCE = 0.5
"""Factor on the cost of merging discs (2DGS): on `room_small` half of them removed by merging at
full cost is 1.6 dB worse, and a quarter or .7 of it .1 dB."""

CONNECTING = 0.65
"""Share of the time of a stage's graph until its pairs are priced; the rest are its rounds."""

_CHUNK = 1 << 14  # pairs at a time: some MB of temporary memory a thread
_SCANNED = 1 << 18  # pairs at a time that are only looked at
_UNSIGNED, _HALF = np.uint32(0x7FFFFFFF), np.uint32(16)  # of the bits of a number


class MergeGraph:
    """Splats, the pairs of them that may be merged, and the cost of each operation.

    Attributes
    ----------
    field : Field
        A splat that absorbs another is overwritten by the merged splat.
    alive : (N,) bool
        Which splats are neither deleted nor absorbed.
    merges : list of (survivor, absorbed, share)
        For each round: rows of the survivors and of the splats they absorbed, (M,) each, and the
        survivor's share of the colour, (M,).
    deleted : int
        How many splats were deleted.
    first, second : (E,) int32
        Rows of the pairs that may be merged.
    cost : (E,) float32
        Of merging each pair; infinite where it is not less than that of deleting one of the two.
    connected : int
        How many splats were alive when neighbours were last searched; 0 before.
    """

    def __init__(
        self, field: Field, scene: Scene, patience: float, *, threads: int | None = None
    ) -> None:
        """Take over a field, which is changed in place; neighbours are those in the scene's frame.

        `patience` is the factor on the cost of merging, of discs times `DISC_PATIENCE`.
        """
        self.field, self.scene, self.threads = field, scene, threads
        self.patience = patience * (DISC_PATIENCE if field.model == "2dgs" else 1.0)
        # A splat of unknown error is not merged: without contribution it gets no pairs.
        field.contribution[~np.isfinite(field.error)] = 0.0
        self.alive = np.ones(len(field.means), np.bool_)
        self.merges: list[tuple[Index, Index, Array]] = []
        self.deleted = 0
        self.first = self.second = np.empty(0, np.int32)
        self.cost = np.empty(0, np.float32)
        self.connected = 0

    @classmethod
    def connected_by(
        cls,
        field: Field,
        scene: Scene,
        patience: float,
        pairs: tuple[Rows, Rows, Costs],
        *,
        threads: int | None = None,
    ) -> MergeGraph:
        """Return a graph that has its pairs already: `first`, `second` and `cost`."""
        graph = cls(field, scene, patience, threads=threads)
        graph.first, graph.second, graph.cost = pairs
        graph.connected = len(graph.alive)
        return graph

    def best(self) -> tuple[Costs, NDArray[np.bool_]]:
        """Return the cost of each splat's cheapest operation, (N,), and whether it is a merge."""
        error = self._errors()
        best = error.copy()
        np.minimum.at(best, self.first, self.cost)
        np.minimum.at(best, self.second, self.cost)
        return best, best < error

    def reduce(self, goal: int, progress: Progress = silent) -> None:
        """Merge and delete until `goal` splats are alive; call it once.

        Raises
        ------
        Cancelled
            If `progress` answers ``False``.
        """
        start = count = len(self.alive)
        if not self.connected:
            self.connect(part(progress, 0.0, CONNECTING))
        while count > goal:
            done = CONNECTING + (1.0 - CONNECTING) * (start - count) / (start - goal)
            of_round = part(progress, done, done)
            report(of_round, 0.0, "absorbing")
            if count < self.connected / 2:
                self.connect(of_round)
            count -= self._round(min(max(int(BATCH * count), 1), count - goal), of_round)
        # The pairs are no longer needed; a large scene has ten million of them.
        self.first = self.second = np.empty(0, np.int32)
        self.cost = np.empty(0, np.float32)

    def connect(self, progress: Progress = silent) -> None:
        """Find the pairs of neighbouring splats, and price them."""
        rows = np.flatnonzero(self.alive & (self.field.contribution > 0.0))  # (R,)
        place = self.scene.positions(self.field.means, rows, threads=self.threads)  # (R, 3)
        near = nearest(
            place, NEIGHBOURS, progress=part(progress, 0.0, 0.5), threads=self.threads
        )  # (R, k)

        def pairs(piece: slice) -> tuple[Rows, Rows]:
            of_piece, others = np.arange(piece.start, piece.stop)[:, None], near[piece]  # (n, 1)
            # Two splats that are neighbours of each other make one pair, not two.
            once = (of_piece < others) | ~(near[others] == of_piece[:, :, None]).any(axis=2)
            first = np.broadcast_to(of_piece, others.shape)[once]
            return rows[first].astype(np.int32), rows[others[once]].astype(np.int32)

        found = run_all(
            pairs, chunks(len(rows), _CHUNK),
            progress=part(progress, 0.5, 0.6), what="absorbing", threads=self.threads,
        )  # fmt: skip
        none = np.empty(0, np.int32)
        # int32 takes half the memory of int64, and no file holds two billion splats.
        self.first = concatenated([none, *(first for first, _ in found)], self.threads)
        self.second = concatenated([none, *(second for _, second in found)], self.threads)
        self.cost = np.empty(len(self.first), np.float32)
        self._price(np.arange(len(self.first), dtype=np.int32), part(progress, 0.6, 1.0))
        self.connected = int(np.count_nonzero(self.alive))

    def _price(self, edges: Index, progress: Progress) -> None:
        """Set the costs of some pairs; infinite where deleting one of the two costs less."""

        def price(piece: slice) -> None:
            rows = edges[piece]
            first, second = self.first[rows], self.second[rows]
            least = np.minimum(self.field.error.take(first), self.field.error.take(second))
            with np.errstate(under="ignore"):
                cost = pricing.costs(self.field, first, second, least / self.patience)
            self.cost[rows] = self.patience * cost

        run_all(
            price,
            chunks(len(edges), _CHUNK),
            progress=progress,
            what="absorbing",
            threads=self.threads,
        )

    def _round(self, quota: int, progress: Progress = silent) -> int:
        """Carry out the cheapest operations that share no splat; return how many, 1 to `quota`.

        A pair is merged if it is the cheapest operation for both of its splats. A splat is deleted
        if that is cheaper than all of its pairs. If these are few, see `FILLED`.
        """
        error = self._errors()  # (N,)
        least = max(int(LOOKED_AT * np.count_nonzero(self.alive)), 1)
        limit = self._limit(error, max(quota, least))
        edges = np.flatnonzero(self.cost <= limit)  # (e,)
        alone, chosen = self._cheapest(error, edges, limit)
        if np.count_nonzero(alone) + len(chosen) < FILLED * min(quota, least):
            chosen = self._completed(chosen, edges)
        alone[self.first[chosen]] = alone[self.second[chosen]] = False
        doomed = np.flatnonzero(alone)  # (d,)
        costs = np.concatenate([error[doomed], self.cost[chosen]])  # (d + m,)
        order = np.argsort(costs, kind="stable")[:quota]
        is_merge = order >= len(doomed)
        self._carry_out(doomed[order[~is_merge]], chosen[order[is_merge] - len(doomed)], progress)
        return len(order)

    def _limit(self, error: Costs, count: int) -> float:
        """Return the cost of the most expensive operation that a round looks at.

        These are twice `count`, since operations that share a splat exclude each other.
        """
        operations = np.count_nonzero(self.alive) + np.count_nonzero(np.isfinite(self.cost))
        return _smallest((error, self.cost), min(2 * count, operations) - 1, self.threads)

    def _cheapest(
        self, error: Costs, edges: Index, limit: float
    ) -> tuple[NDArray[np.bool_], Index]:
        """Return which splats cost least by deleting them, (N,), and which pairs by merging, (m,).

        `error`, (N,), is the cost of deleting; the pairs `edges`, (e,), cost at most `limit`.
        """
        first, second, cost = self.first[edges], self.second[edges], self.cost[edges]  # (e,) each
        best = error.copy()  # (N,), the cost of each splat's cheapest operation
        np.minimum.at(best, first, cost)
        np.minimum.at(best, second, cost)
        mutual = (cost == best[first]) & (cost == best[second])  # (e,)
        chosen = edges[mutual][_disjoint(first[mutual], second[mutual])]
        return self.alive & (best == error) & (error <= limit), chosen

    def _completed(self, chosen: Index, edges: Index) -> Index:
        """Return the chosen pairs, and of the others as many as share no splat with any, (m,)."""
        taken = np.zeros(len(self.alive), np.bool_)
        taken[self.first[chosen]] = taken[self.second[chosen]] = True
        free = edges[~(taken[self.first[edges]] | taken[self.second[edges]])]
        others = free[_disjoint(self.first[free], self.second[free])]
        every: Index = np.concatenate([chosen, others])
        return every

    def _errors(self) -> Costs:
        """Return the costs of deleting splats, (N,) float32; infinite where unknown.

        So the cheapest operation is always carried out, and every round removes a splat; a
        comparison with NaN would choose none.
        """
        with np.errstate(over="ignore", under="ignore"):
            error = self.field.error.astype(np.float32)
        error[~self.alive | np.isnan(error)] = np.inf
        return error

    def _carry_out(self, doomed: Index, edges: Index, progress: Progress) -> None:
        """Delete splats, merge pairs, and price the pairs of the merged splats again."""
        into, gone = self._merge(edges)  # (m,) each
        self.alive[doomed] = False
        self.alive[gone] = False
        self.deleted += len(doomed)
        changed = np.zeros(len(self.alive), np.bool_)
        changed[doomed] = changed[gone] = changed[into] = True

        def concerning(piece: slice) -> Index:
            either = changed.take(self.first[piece]) | changed.take(self.second[piece])
            return np.asarray(np.flatnonzero(either) + piece.start)

        # Few pairs are concerned; the rest are not looked at again.
        concerned = self._joined(concerning)[0]  # (e,)
        # Pairs of an absorbed splat become pairs of the splat that absorbed it.
        survivor = np.arange(len(self.alive), dtype=np.int32)  # (N,)
        survivor[gone] = into
        first = survivor.take(self.first[concerned])
        second = survivor.take(self.second[concerned])
        self.first[concerned], self.second[concerned] = first, second
        remain = self.alive[first] & self.alive[second] & (first != second)
        self._price(concerned[remain], progress)
        valid = np.ones(len(self.first), np.bool_)
        valid[concerned[~remain]] = False

        def left(piece: slice) -> tuple[NDArray[Any], ...]:
            stays = valid[piece]
            return tuple(each[piece][stays] for each in (self.first, self.second, self.cost))

        self.first, self.second, self.cost = self._joined(left)

    def _joined(self, of_pairs: Callable[[slice], Any]) -> list[NDArray[Any]]:
        """Return what a function returns for slices of the pairs, one array or more, joined."""
        parts = run_all(of_pairs, chunks(max(len(self.first), 1), _SCANNED), threads=self.threads)
        several = [part if isinstance(part, tuple) else (part,) for part in parts]
        return [concatenated(each, self.threads) for each in zip(*several, strict=True)]

    def _merge(self, edges: Index) -> tuple[Index, Index]:
        """Merge pairs; return the survivors and the splats they absorbed, (m,) each.

        Of each pair the splat of which the views see more survives. No two pairs share a splat.
        """
        field, first, second = self.field, self.first[edges], self.second[edges]
        swap = field.contribution[second] > field.contribution[first]
        into, gone = np.where(swap, second, first), np.where(swap, first, second)
        share = np.empty(len(edges))

        def merge(piece: slice) -> None:
            with np.errstate(under="ignore"):
                pairs = pricing.price(field, first[piece], second[piece])
                field.put(into[piece], pricing.merge(field, first[piece], second[piece], pairs))
            share[piece] = np.where(swap[piece], 1.0 - pairs.color, pairs.color)

        run_all(merge, chunks(len(edges), _CHUNK), threads=self.threads)
        self.merges.append((into, gone, share))
        return into, gone


def _smallest(arrays: Sequence[Costs], rank: int, threads: int | None) -> float:
    """Return the number of a rank, from 0, among all numbers of some arrays, each >= 0.

    The upper halves of such numbers, as integers, sort as they do: they are counted first, and only
    numbers that share the upper half of the one looked for are compared.
    """
    pieces = [values[each] for values in arrays for each in chunks(len(values), _SCANNED)]

    def in_pieces(of_piece: Callable[[Costs], NDArray[Any]]) -> list[NDArray[Any]]:
        def work(number: slice) -> NDArray[Any]:
            return of_piece(pieces[number.start])

        return run_all(work, chunks(len(pieces), 1), threads=threads)

    def upper(values: Costs) -> NDArray[np.uint32]:
        return np.asarray((values.view(np.uint32) & _UNSIGNED) >> _HALF)

    counts = sum(in_pieces(lambda values: np.bincount(upper(values), minlength=1 << 16)))
    ends = np.cumsum(counts)
    half = int(np.searchsorted(ends, rank, side="right"))
    alike = np.concatenate(in_pieces(lambda values: values[upper(values) == half]))
    place = rank - (int(ends[half - 1]) if half else 0)
    return float(np.partition(alike, place)[place])


def _disjoint(first: Index, second: Index) -> Index:
    """Return the indices of pairs that share no splat, ascending, (k,); each other pair shares one.

    The rows of the pairs are `first` and `second`, (m,) each.
    """
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
