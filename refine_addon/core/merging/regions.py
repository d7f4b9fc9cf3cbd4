"""A stage of merging of splats in files, larger than memory: region by region.

Splats are divided into boxes of about equally many, and each box is merged by itself. How many of a
region stay is decided by one ranking of the cheapest merges and deletions of all. The next stage
divides along other planes, so neighbours that a plane separates can merge then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, run_all, seconds, stages
from ..mapped import note, noted
from ..regions import divided, in_one, look, new_folder, pieces
from ..splats import Splats, on_disk
from .field import Array, Index
from .stage import Reduced, Stage, copied, reduced


def stage_by_regions(stage: Stage, keep_count: int, progress: Progress) -> Reduced:
    """Reduce splats to `keep_count`, region by region; the kept ones lie in files."""
    folder, there = new_folder(stage.splats), np.flatnonzero(stage.members)
    boxes = [there[box] for box in divided(stage.splats.means[there], askew=stage.number % 2 == 1)]
    for number, rows in enumerate(boxes):
        region = replace(
            stage, members=stage.members[rows], sums=stage.sums[:, rows],
            protected=stage.protected[rows],
        )  # fmt: skip
        note(folder, f"region-{number}", (rows, region))
    measuring, pricing, merging = stages(progress, 0.3, 0.3, 0.4)
    # Each uses all threads by itself.
    how = {"what": "merging", "threads": 1, "cost": seconds("merge", len(there))}
    numbers = range(len(boxes))
    whole = np.sum(run_all(partial(_measure, folder), numbers, progress=measuring, **how), axis=0)
    priced = run_all(partial(_price, folder, whole), numbers, progress=pricing, **how)
    costs, weights = (np.concatenate(each) for each in zip(*priced, strict=True))
    counts = _staying(costs, weights, [*map(len, boxes)], keep_count)
    del priced, costs, weights
    made = run_all(partial(_merge, folder), [*enumerate(counts)], progress=merging, **how)
    kept, members, sums, regions = zip(*made, strict=True)
    rows = np.concatenate(kept)
    order = np.argsort(rows)
    left, keep = in_one(folder, regions, rows), np.zeros(len(stage.members), np.bool_)
    keep[rows] = True
    return left, keep, np.concatenate(members)[order], np.concatenate(sums, axis=1)[:, order]


# The steps of a region. Any process can do them; between them it lies in the folder.


def _measure(folder: Path, number: int) -> Array:
    """`MeasuredField.seen_and_whole` of a region."""
    rows, stage = noted(folder, f"region-{number}")[1]
    stage = replace(stage, splats=copied(stage.splats, rows, stage.threads))
    measured = note(folder, f"measured-{number}", stage.measured(look))[1]
    return measured.seen_and_whole()


def _price(folder: Path, whole: Array, number: int) -> tuple[Array, NDArray[np.float32]]:
    """Of each splat's cheapest operation its cost, and how many splats go by it."""
    _, stage = noted(folder, f"region-{number}")[1]
    rows, measured = noted(folder, f"measured-{number}")[1]
    graph = stage.graph(measured, whole)
    graph.connect(look)
    best, merges = graph.best()
    note(folder, f"graph-{number}", (rows, graph))
    costs = np.full(len(stage.members), -1.0)  # what cannot be drawn goes first
    weights = np.ones(len(costs), np.float32)
    # Of two splats that merge, one goes.
    costs[rows], weights[rows] = best, np.where(merges, np.float32(0.5), np.float32(1.0))
    return costs, weights


def _merge(folder: Path, item: tuple[int, int]) -> tuple[Index, NDArray[np.int64], Array, Splats]:
    """Rows kept of a region that is merged down to a count, and `Reduced` of them."""
    number, count = item
    origin, stage = noted(folder, f"region-{number}")[1]
    stage = replace(stage, splats=copied(stage.splats, origin, stage.threads))
    rows, graph = noted(folder, f"graph-{number}")[1]
    with np.errstate(under="ignore"):
        left, keep, members, sums = reduced(stage, rows, graph, count, look)
    return origin[keep], members, sums, on_disk(folder / f"left-{number}", pieces(left))


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
