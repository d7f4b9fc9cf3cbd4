"""Merges and deletions carried out in order of their cost, on a graph of near splats."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..work import Progress, for_chunks, part, report, silent
from . import merging
from .neighbours import nearest

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..scene import Scene
    from .merge_field import Array, Field, Index

    Rows = NDArray[np.int32]

NEIGHBOURS = 8
"""Nearest neighbours of each splat that it may be merged with."""

BATCH = 0.03
"""Largest share of the splats that goes before costs are computed again."""

_CHUNK = 1 << 14


class MergeGraph:
    """Splats, the pairs of them that may be merged, and what each operation costs.

    Attributes
    ----------
    field : Field
        Its rows change as splats absorb others.
    alive : (N,) bool
        Which splats have not gone.
    merges : list of (survivor, absorbed, share)
        Rows, (M,), and the survivor's share of the colour, (M,), of each round.
    deleted : int
        How many splats went without being absorbed.
    """

    def __init__(
        self, field: Field, scene: Scene, patience: float, *, threads: int | None = None
    ) -> None:
        """Take over a field.

        Parameters
        ----------
        field : Field
            Is changed.
        scene : Scene
            In whose frame near splats are looked for.
        patience : float
            Factor on the cost of merging.
        threads : int, optional
        """
        self.field, self.scene, self.patience, self.threads = field, scene, patience, threads
        self.alive = np.ones(len(field.means), np.bool_)
        self.merges: list[tuple[Index, Index, Array]] = []
        self.deleted = 0
        self.first = self.second = np.empty(0, np.int32)
        self.cost = np.empty(0)

    def reduce(self, goal: int, progress: Progress = silent) -> None:
        """Merge and delete until `goal` splats are alive.

        Raises
        ------
        Cancelled
            If `progress` answers ``False``.
        """
        start = count = connected = len(self.alive)
        self._connect(part(progress, 0.0, 0.3))
        while count > goal:
            report(progress, 0.3 + 0.7 * (start - count) / (start - goal), "absorbing")
            if count < connected / 2:
                self._connect(silent)
                connected = count
            count -= self._round(min(max(int(BATCH * count), 1), count - goal))
        # Nobody needs the pairs any more, and there are ten million of them in a large scene.
        self.first = self.second = np.empty(0, np.int32)
        self.cost = np.empty(0)

    def _connect(self, progress: Progress) -> None:
        """Find the pairs of near splats, and price them."""
        rows = np.flatnonzero(self.alive & (self.field.contribution > 0.0))
        place = self.scene.place(self.field.means[rows])
        near = nearest(place, NEIGHBOURS, progress=progress, threads=self.threads)

        def pairs(piece: slice) -> tuple[Rows, Rows]:
            own, others = np.arange(piece.start, piece.stop)[:, None], near[piece]
            # A pair that is near from both sides counts once.
            once = (own < others) | ~(near[others] == own[:, :, None]).any(axis=2)
            own = np.broadcast_to(own, others.shape)
            return rows[own[once]].astype(np.int32), rows[others[once]].astype(np.int32)

        found = for_chunks(pairs, len(rows), _CHUNK, threads=self.threads)
        none = np.empty(0, np.int32)
        # Half the memory of other integers: no file holds two billion splats.
        self.first = np.concatenate([none, *(first for first, _ in found)])
        self.second = np.concatenate([none, *(second for _, second in found)])
        self.cost = np.empty(len(self.first))
        self._price(np.arange(len(self.first), dtype=np.int32))

    def _price(self, edges: Index) -> None:
        """Compute the cost of some pairs; infinite where deleting one of the two costs less."""

        def price(piece: slice) -> None:
            mine = edges[piece]
            first, second = self.first[mine], self.second[mine]
            with np.errstate(under="ignore"):
                cost = self.patience * merging.costs(self.field, first, second)
            least = np.minimum(self.field.error[first], self.field.error[second])
            self.cost[mine] = np.where(cost < least, cost, np.inf)

        for_chunks(price, len(edges), _CHUNK, threads=self.threads)

    def _round(self, quota: int) -> int:
        """Carry out at most `quota` of the cheapest disjoint operations; return how many."""
        error = np.where(self.alive, self.field.error, np.inf)
        costs = np.concatenate([error[self.alive], self.cost[np.isfinite(self.cost)]])
        # More than can go, so that the best partner of a splat is among them.
        last = min(2 * quota, len(costs)) - 1
        limit = np.partition(costs, last)[last]
        edges = np.flatnonzero(self.cost <= limit)
        first, second, cost = self.first[edges], self.second[edges], self.cost[edges]
        best = error.copy()
        np.minimum.at(best, first, cost)
        np.minimum.at(best, second, cost)
        mutual = (cost == best[first]) & (cost == best[second])
        edges = edges[mutual][_disjoint(first[mutual], second[mutual])]
        alone = self.alive & (best == error) & (error <= limit)
        alone[self.first[edges]] = False
        alone[self.second[edges]] = False
        doomed = np.flatnonzero(alone)
        costs = np.concatenate([error[doomed], self.cost[edges]])
        order = np.argsort(costs, kind="stable")[:quota]
        is_merge = order >= len(doomed)
        self._carry_out(doomed[order[~is_merge]], edges[order[is_merge] - len(doomed)])
        return len(order)

    def _carry_out(self, doomed: Index, edges: Index) -> None:
        """Delete splats, merge pairs, and price again what touches a merged splat."""
        field, first, second = self.field, self.first[edges], self.second[edges]
        with np.errstate(under="ignore"):
            pairs = merging.price(field, first, second)
            merged = merging.merge(field, first, second, pairs)
        swap = field.contribution[second] > field.contribution[first]
        into, gone = np.where(swap, second, first), np.where(swap, first, second)
        self.merges.append((into, gone, np.where(swap, 1.0 - pairs.color, pairs.color)))
        field.put(into, merged)
        self.alive[doomed] = False
        self.alive[gone] = False
        self.deleted += len(doomed)
        # The pairs of the absorbed splat are now pairs of the one that absorbed it.
        heir = np.arange(len(self.alive), dtype=np.int32)
        heir[gone] = into
        first, second = heir[self.first], heir[self.second]
        valid = self.alive[first] & self.alive[second] & (first != second)
        self.first, self.second, self.cost = first[valid], second[valid], self.cost[valid]
        touched = np.zeros(len(self.alive), np.bool_)
        touched[into] = True
        self._price(np.flatnonzero(touched[self.first] | touched[self.second]))


def _disjoint(first: Index, second: Index) -> Index:
    """Return which pairs share no splat with an earlier one (those left are equally cheap)."""
    own = np.arange(len(first))
    _, ends = np.unique(np.concatenate([first, second]), return_inverse=True)
    one, two = ends[: len(first)], ends[len(first) :]
    earliest = np.full(len(ends), len(first))
    np.minimum.at(earliest, one, own)
    np.minimum.at(earliest, two, own)
    return np.flatnonzero((earliest[one] == own) & (earliest[two] == own))
