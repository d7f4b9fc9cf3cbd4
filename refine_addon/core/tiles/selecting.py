"""Which splats of all units go, by scores that lie in the folder of the job."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import radix
from ..operation.run import Runtime
from ..scores import Scores
from ..selection import Budget, least_seen, lowest, quality_of, single
from .folder import Folder
from .units import Tile, Unit
from .workers import Runner


class Rule(NamedTuple):
    """Which splats go.

    Attributes
    ----------
    threshold : float or None
        Those with lower scores, in float32.
    least_seen : int or None
        Or those in fewer views.
    edge : int
        Or those whose scores have a lower key, and of those at it some of the first; see
        `selection.lowest`.
    left : tuple of int
        How many of those at the edge, or of their bytes, go in each unit.
    by_bytes : bool
        Whether each splat counts as many bytes as it takes in its file.
    """

    threshold: float | None = None
    least_seen: int | None = None
    edge: int = 0
    left: tuple[int, ...] = ()
    by_bytes: bool = False


class Removals(NamedTuple):
    """How much a budget removes: so many splats, or bytes of them."""

    amount: int
    by_bytes: bool = False


@dataclass(frozen=True)
class CountScores:
    """Counts the scores of a unit by a digit of their keys; see `radix.counts` and `Rule`."""

    unit: Unit
    prefixes: list[int]
    shift: int
    by_bytes: bool

    def run(self, folder: Folder, _runtime: Runtime) -> radix.Sparse:
        """Return the counts."""
        weights = self.unit.row_bytes() if self.by_bytes else None
        keys = _keys(self.unit, folder)
        return radix.Sparse.of(radix.counts(keys, self.prefixes, self.shift, weights))


@dataclass(frozen=True)
class CountTied:
    """Counts the splats of a unit, or their bytes, that score as much as the last that goes.

    See `Rule`.
    """

    unit: Unit
    edge: int
    by_bytes: bool

    def run(self, folder: Folder, _runtime: Runtime) -> int:
        """Return the count."""
        ties = _keys(self.unit, folder) == self.edge
        return int(self.unit.row_bytes()[ties].sum() if self.by_bytes else np.count_nonzero(ties))


@dataclass(frozen=True)
class ChooseByScore:
    """Decides which splats of a unit stay."""

    unit: Unit
    rule: Rule

    def run(self, folder: Folder, _runtime: Runtime) -> NDArray[np.int64]:
        """Note which stay; return what `save_kept` returns."""
        index, rule = self.unit.index, self.rule
        if rule.least_seen is not None:
            removed = folder.load(index, ["seen"])["seen"] < rule.least_seen
        else:
            values = folder.load(index, ["values"])["values"]
            if rule.threshold is not None:
                removed = values < np.float32(rule.threshold)
            else:
                weights = self.unit.row_bytes() if rule.by_bytes else None
                removed = lowest(radix.keys_of(values), rule.edge, rule.left[index], weights)
        return save_kept(self.unit, folder, ~removed)


def save_kept(unit: Unit, folder: Folder, keep: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Note which splats of a unit stay, (n,).

    Returns
    -------
    (parts, 2) int64
        Of each part, how many splats stay, and how many lie in no view.
    """
    folder.save(unit.index, {"keep": keep})
    unseen = folder.load(unit.index, ["seen"])["seen"] == 0
    counts = [
        [np.count_nonzero(keep[place]), np.count_nonzero(unseen[place])] for place in unit.slices()
    ]
    return np.array(counts, np.int64)


def removals(budget: Budget, tiles: Sequence[Tile]) -> Removals | None:
    """Return how much a budget removes; None if it does not tell without scores.

    Parameters
    ----------
    budget : Budget
    tiles : sequence of Tile
        Of which one has a splat.

    Raises
    ------
    RefineError
        See `Budget.removals`.
    """
    lengths = {tile.row_bytes for tile in tiles if tile.splats}
    total, fixed = sum(tile.splats for tile in tiles), sum(tile.fixed_bytes for tile in tiles)
    count = budget.removals(total, min(lengths), fixed)
    if budget.max_mb is None or len(lengths) == 1:
        return None if count is None else Removals(count)
    excess = sum(tile.splats * tile.row_bytes for tile in tiles) - budget.room(fixed)
    return Removals(max(excess, 0), by_bytes=True)


def rule_of(
    budget: Budget,
    scores: Scores,
    tiles: Sequence[Tile],
    units: Sequence[Unit],
    folder: Folder,
    runner: Runner,
) -> Rule:
    """Return which splats a budget removes by scores: those that it removes of one file.

    Parameters
    ----------
    budget : Budget
    scores : Scores
        Only those of all splats together; those of each lie in the folder.
    tiles, units : sequence of Tile, sequence of Unit
    folder : Folder
    runner : Runner
    """
    if budget.threshold is not None:
        return Rule(threshold=float(single(budget.threshold)))
    if budget.min_seen is not None:
        return Rule(least_seen=least_seen(budget.min_seen, scores.views_used))
    if budget.psnr is not None:
        share = quality_of(scores).share(budget.psnr)
        amount, by_bytes = math.floor(share * sum(map(len, units))), False
    else:
        amount, by_bytes = removals(budget, tiles) or Removals(0)
    if not amount:
        return Rule(left=(0,) * len(units))

    def count(prefixes: list[int], shift: int) -> NDArray[np.int64]:
        steps = [CountScores(unit, prefixes, shift, by_bytes) for unit in units]
        return radix.added(runner.run(folder, steps, "selecting"))

    edge, below = radix.find(count, 32, [amount - 1])[0]
    steps = [CountTied(unit, edge, by_bytes) for unit in units]
    tied = [*runner.run(folder, steps, "selecting")]
    before = np.cumsum([0, *tied[:-1]])
    return Rule(edge=edge, left=tuple((amount - below - before).tolist()), by_bytes=by_bytes)


def _keys(unit: Unit, folder: Folder) -> NDArray[np.unsignedinteger[Any]]:
    return radix.keys_of(folder.load(unit.index, ["values"])["values"])
