"""A stage of merging of splats in files, larger than memory: region by region.

Splats are divided into boxes of about equally many, and each box is merged by itself. How many of a
region stay is decided by one ranking of the cheapest merges and deletions of all. The next stage
divides along other planes, so neighbours that a plane separates can merge then.
"""

from __future__ import annotations

import secrets
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, checkpoint, chunks, run_all, seconds, stages
from ..mapped import note, noted
from ..regions import divided
from ..splats import Splats, folder_of, on_disk
from .field import Array, Index
from .stage import Reduced, Stage, copied, reduced

_ROWS = 1 << 16  # splats copied at a time


def stage_by_regions(stage: Stage, keep_count: int, progress: Progress) -> Reduced:
    """Reduce splats to `keep_count`, region by region; the kept ones lie in files."""
    job, splats = folder_of(stage.splats), stage.splats
    assert job is not None
    folder = job / f"regions-{secrets.token_hex(4)}"
    there = np.flatnonzero(stage.members)
    askew = stage.number % 2 == 1
    boxes = [there[box] for box in divided(splats.means[there], askew=askew)]
    numbers = range(len(boxes))
    for number, rows in enumerate(boxes):
        region = replace(
            stage, members=stage.members[rows], sums=stage.sums[:, rows],
            protected=stage.protected[rows],
        )  # fmt: skip
        folder.mkdir(exist_ok=True)
        note(folder, f"region-{number}", (rows, region))
    work, cost = _Regions(folder), seconds("merge", len(there))
    measuring, pricing, merging = stages(progress, 0.3, 0.3, 0.4)
    how = {"what": "merging", "threads": 1, "cost": cost}  # each uses all threads by itself
    whole = np.sum(run_all(work.measure, numbers, progress=measuring, **how), axis=0)
    priced = run_all(work.price, [(k, whole) for k in numbers], progress=pricing, **how)
    costs, weights = (np.concatenate(each) for each in zip(*priced, strict=True))
    counts = _staying(costs, weights, [*map(len, boxes)], keep_count)
    del priced, costs, weights
    items = [*zip(numbers, counts, strict=True)]
    made = run_all(work.merge, items, progress=merging, **how)
    rows = np.concatenate([each[0] for each in made])
    order = np.argsort(rows)
    members = np.concatenate([each[1] for each in made])[order]
    sums = np.concatenate([each[2] for each in made], axis=1)[:, order]
    every = on_disk(folder / "merged", (part for each in made for part in _pieces(each[3])))
    left = on_disk(
        job / f"merged-{secrets.token_hex(4)}",
        (every.take(order[piece]) for piece in chunks(len(order), _ROWS)),
    )
    shutil.rmtree(folder, ignore_errors=True)
    keep = np.zeros(len(stage.members), np.bool_)
    keep[rows] = True
    return left, keep, members, sums


def _pieces(splats: Splats) -> list[Splats]:
    return [splats.take(piece) for piece in chunks(len(splats), _ROWS)]


@dataclass(frozen=True)
class _Regions:
    """The steps of a region; any process can do them. Between them it lies in the folder."""

    folder: Path

    def measure(self, number: int) -> Array:
        """Measure a region; return `MeasuredField.seen_and_whole`."""
        rows, measured = self._region(number)[1].measured(_look)
        note(self.folder, f"measured-{number}", (rows, measured))
        return measured.seen_and_whole()

    def price(self, item: tuple[int, Array]) -> tuple[Array, NDArray[np.float32]]:
        """Find neighbours; return of each splat's cheapest operation its cost and how many go."""
        number, whole = item
        stage = self._region(number)[1]
        rows, measured = noted(self.folder, f"measured-{number}")[1]
        graph = stage.graph(measured, whole)
        graph.connect(_look)
        best, merges = graph.best()
        note(self.folder, f"graph-{number}", (rows, graph))
        costs = np.full(len(stage.members), -1.0)  # what cannot be drawn goes first
        weights = np.ones(len(costs), np.float32)
        costs[rows] = best
        # Of two splats that merge, one goes.
        weights[rows] = np.where(merges, np.float32(0.5), np.float32(1.0))
        return costs, weights

    def merge(self, item: tuple[int, int]) -> tuple[Index, NDArray[np.int64], Array, Splats]:
        """Merge a region down to a count; return the rows kept, and `Reduced` of them."""
        number, count = item
        origin, stage = self._region(number)
        rows, graph = noted(self.folder, f"graph-{number}")[1]
        graph.threads = stage.threads
        with np.errstate(under="ignore"):
            left, keep, members, sums = reduced(stage, rows, graph, count, _look)
        stored = on_disk(self.folder / f"left-{number}", _pieces(left))
        return origin[keep], members, sums, stored

    def _region(self, number: int) -> tuple[Index, Stage]:
        """Rows of a region, and its splats as a stage begins with them."""
        rows, stage = noted(self.folder, f"region-{number}")[1]
        return rows, replace(stage, splats=copied(stage.splats, rows, stage.threads))


def _look(_fraction: float, _what: str) -> None:
    checkpoint()


def _staying(
    costs: Array, weights: NDArray[np.float32], sizes: Sequence[int], left: int
) -> list[int]:
    """How many splats of each region stay, of `left` that do of all.

    As many go as a region has among the cheapest merges and deletions of all, given of each splat's
    cheapest operation its cost, (n,), and how many splats go by it, 1 or .5, region by region. All
    merges together count half of the splats; so a stage has to leave half of them, or there would
    not be enough to go.
    """
    order, goal = np.argsort(costs, kind="stable"), len(costs) - left
    last = int(np.searchsorted(np.cumsum(weights[order], dtype=np.float64), goal))
    goes, chosen = np.zeros_like(weights), order[: last + 1]
    goes[chosen] = weights[chosen]
    gone = np.cumsum(np.add.reduceat(goes, np.cumsum([0, *sizes[:-1]]), dtype=np.float64))
    # Rounded so that the sum is exact: each gets what is added up to its end.
    gone = np.rint(gone * (goal / gone[-1])).astype(np.int64)
    return [size - int(go) for size, go in zip(sizes, np.diff(gone, prepend=0), strict=True)]
