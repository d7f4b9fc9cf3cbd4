"""Merging: reduce splats to a number by the cheapest merges and deletions.

Before each stage but the first the kept splats are measured again, as visibility changes. Splats in
files are divided into boxes, along other planes in each stage; one ranking of the operations of all
boxes decides how many go of each. Splats that merge nothing keep their bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, chunks, part, report, return_freed, run_all, seconds, silent, stages
from ..mapped import divided, in_one, in_regions, new_folder, note, noted, on_disk, pieces
from ..splats import ARRAYS, Splats, assign, drawable
from ..views import ViewSet
from ..visibility.scene import Scene, scene_of, spatial_order, splat_fingerprint
from .field import Array, measured_field
from .graph import MergeGraph
from .pairs import as_splats

Measure = Callable[[Splats, Array, Progress], Array]
"""``measure(splats, expected, progress)``: contribution and error, (2, n), of n kept splats, of
degree 0; `expected` is what they would be if visibility had not changed."""

STAGE = 0.5
"""Share that each of very many stages leaves. At least a half: regions count a splat whose cheapest
operation is a merge as half a splat, and would run out of splats to remove."""

FINER = 0.8
"""Added to the number of stages that leave `STAGE` each: three instead of two for 70 % of a park
gain 1.4 dB, five instead of four for 90 % nothing."""

ALONE, ALONE_BY_REGIONS = 0.55, 0.6
"""Least share that a single stage leaves, at least a half. The first is below 5/9: once a tenth is
deleted, one stage reaches half of all splats. Regions take two: one of four regions lost 0.5 dB."""

PENALTY = 2.0  # merge penalty if half of the splats are removed
_CHUNK = 1 << 14  # splats copied at a time: some MB


@dataclass(frozen=True, eq=False)
class Merged:
    """Result of merging N splats to K."""

    splats: Splats  # the K kept, in order; float64, but `sh_rest` in its old type
    keep: NDArray[np.bool_]  # (N,)
    changed: NDArray[np.bool_]  # (K,): others were merged into these; the rest keep their bits
    merged: int  # how many were merged into others
    deleted: int

    def facts(self) -> dict[str, int]:
        """The counts, for a report."""
        changed = int(np.count_nonzero(self.changed))
        return {"changed": changed, "merged": self.merged, "deleted": self.deleted}

    def note(self) -> str:
        """The counts as a sentence, for the user."""
        return (
            "{merged:,} splats were merged into {changed:,} others; "
            "{deleted:,} were deleted".format(**self.facts())
        )


def merge_penalty(share: float) -> float:
    """Factor on the cost of merging by the share removed, 0 to 1 (docs/method.md, section 7).

    Errors of neighbours deleted together add up before they are squared, so merging gets cheaper
    the more are removed. Half or twice the factor costs at most 0.3 dB on three scenes.
    """
    share = min(max(share, 1e-3), 1.0 - 1e-3)
    return PENALTY * math.sqrt((1.0 - share) / share)


def merge(
    splats: Splats,
    views: ViewSet,
    sums: Array,
    measure: Measure,
    keep_count: int,
    *,
    began: int | None = None,
    deleted: NDArray[np.bool_] | None = None,
    protected: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
) -> Merged:
    """Reduce splats to a number at the least cost to the pictures (docs/method.md, section 7).

    `sums` are contribution and error, (2, N), px^2. `deleted` splats go first, then undrawable
    ones; `protected` ones stay, even if more than `keep_count` are left. `merge_penalty` takes the
    share removed of `began`: by default those not `deleted`, more after earlier merges.
    """
    total, left = len(splats), splats
    # Of each splat left: which of the N it is, and for how many of them it stands, 0 if deleted.
    origin = np.arange(total)
    members = np.ones(total, np.int64) if deleted is None else (~deleted).astype(np.int64)
    spared = np.zeros(total, np.bool_) if protected is None else protected
    rows = np.flatnonzero(members)
    goal = max(keep_count, int(np.count_nonzero(spared[rows])), 0)
    regions = in_regions(splats, len(rows))
    counts = stage_counts(len(rows), goal, ALONE_BY_REGIONS if regions else ALONE)
    penalty = merge_penalty(1.0 - goal / max(began or len(rows), 1))
    return_freed()  # what scoring took: twice as much as is left of it
    drawn = drawable(splats)
    # By regions those that were deleted count for the frame, too.
    counting = np.arange(total) if regions else rows
    scene = scene_of(splats.means[counting], drawn[counting], views)
    del rows, drawn, counting
    steps = iter(stages(progress, *stage_seconds(total, counts, len(views))))
    for number, count in enumerate(counts):
        measuring, merging = next(steps), next(steps)
        if left is not splats:
            sums = measure(left.up_to_degree(0), sums, measuring)
        sums = np.asarray(sums, np.float64)
        stage = _Stage(left, members, sums, spared[origin], views, scene, penalty)
        if in_regions(left, int(np.count_nonzero(members))):
            left, keep, members, sums = _by_regions(stage, count, number % 2 == 1, merging)
        else:
            left, keep, members, sums = stage.at_once(count, merging)
        origin = origin[keep]
        del stage
        return_freed()  # views are measured next, by processes that need memory of their own
    if left is splats:
        origin = np.flatnonzero(members)
        left, members = copied(splats, origin), members[origin]
    report(progress, 1.0, "merging")
    kept = np.zeros(total, np.bool_)
    kept[origin] = True
    lasting = int(members.sum())
    return Merged(left, kept, members > 1, lasting - len(left), total - lasting)


def stage_counts(count: int, goal: int, alone: float = ALONE) -> list[int]:
    """Splats left after each stage, `goal` after the last; one stage if that leaves `alone`.

    >>> stage_counts(900, 500), stage_counts(900, 450), stage_counts(900, 900)
    ([500], [636, 450], [])
    """
    if goal >= count:
        return []
    share = max(goal, 1) / count
    number = 1 if share >= alone else math.ceil(math.log(share) / math.log(STAGE) + FINER)
    shares = [(goal / count) ** ((stage + 1) / number) for stage in range(number)]
    return [max(round(count * share), goal) for share in shares]


def stage_seconds(count: int, counts: list[int], views: int) -> list[float]:
    """Expected seconds of measuring and of merging in each stage; the first need not measure."""
    expected: list[float] = []
    for entering in [count, *counts][: len(counts)]:
        again = seconds("measure", entering, views / 2) if expected else 0.0
        expected += [again, seconds("merge", entering)]
    return expected


@dataclass(frozen=True, eq=False)
class _Stage:
    """Input of a stage: N splats, or those of a region; see `merge`."""

    splats: Splats
    members: NDArray[np.int64]  # (N,), for how many of the first splats each stands, 0 if deleted
    sums: Array  # (2, N)
    protected: NDArray[np.bool_]
    views: ViewSet
    scene: Scene
    penalty: float

    def at_once(self, keep_count, progress):
        rows, measured = self.measured(part(progress, 0.0, 0.3))
        graph = self.graph(measured, measured.seen_and_whole())
        del measured
        return_freed()
        return self.reduced(rows, graph, keep_count, part(progress, 0.3, 1.0))

    def measured(self, progress):
        """Rows that may merge, (M,), and their field, in spatial order: ties ignore file order."""
        splats, excluded = self.splats, self.protected | (self.members == 0)
        rows = np.flatnonzero(drawable(splats) & ~excluded)
        place = self.scene.positions(splats.means, rows)
        rows = rows[spatial_order(place, lambda tied: splat_fingerprint(splats, rows[tied]))]
        report(progress, 0.0, "merging")
        return rows, measured_field(
            splats, rows, self.views, self.scene, self.sums, progress=progress
        )

    def graph(self, measured, whole):
        """Graph of measured splats; `whole` is `MeasuredField.seen_and_whole` of all splats."""
        field = measured.with_bias(whole)
        hardly = field.contribution > 2.0 * measured.field.contribution  # more than half is bias
        unseen = hardly & (not self.views.exact)
        return MergeGraph(field, self.scene, self.penalty, unseen)

    def reduced(self, rows, graph, keep_count, progress):
        """Kept splats, at least `keep_count`; which they are, (N,); members; predicted sums."""
        splats, keep = self.splats, self.members > 0
        excess = max(int(np.count_nonzero(keep)) - keep_count, 0)
        others = keep & ~self.protected
        others[rows] = False
        undrawable = np.flatnonzero(others)[:excess]
        keep[undrawable] = False
        graph.reduce(max(len(rows) - (excess - len(undrawable)), 0), part(progress, 0.0, 0.95))
        keep[rows[~graph.alive]] = False
        # Of each splat: the one that it becomes part of, or is, and its share of the colour there.
        owner, share = np.arange(len(rows)), np.ones(len(rows))
        # From the last round to the first: a splat merged into may itself be merged in a later one.
        for into, gone, kept_share in reversed(graph.merges):
            owner[gone] = owner[into]
            share[gone] = share[into] * (1.0 - kept_share)
            share[into] *= kept_share
        changed = graph.alive & (np.bincount(owner, minlength=len(rows)) > 1)
        # Drop the rest of the field before the kept splats are copied, to save memory.
        field = graph.field = graph.field.take(np.flatnonzero(changed))
        kept = np.flatnonzero(keep)
        left, target = copied(splats, kept), np.searchsorted(kept, rows[changed])
        shapes = as_splats(field, part(progress, 0.95, 0.97))
        for name, values in zip(ARRAYS, (field.means, *shapes), strict=False):
            getattr(left, name)[target] = values
        inside = np.flatnonzero(changed[owner])
        order = inside[np.argsort(owner[inside], kind="stable")]
        into = np.searchsorted(kept, rows[owner[order]])
        _blend(splats, rows[order], share[order], left, into, part(progress, 0.97, 1.0))
        members = self.members.copy()
        members[rows] = np.bincount(owner, members[rows], len(rows))
        expected = self.sums[:, keep]
        expected[:, target] = field.contribution, field.error
        return left, keep, members[keep], expected


def _blend(splats, members, share, left, into, progress):
    """Write means of members' harmonics into rows `into` of `left`, float32: tiles equal files."""
    starts, largest = np.flatnonzero(np.diff(into, prepend=-1)), np.finfo(np.float32).max

    def fill(harmonic):  # one at a time, to save memory; -1 is the constant one
        name, of = ("sh_dc", ()) if harmonic < 0 else ("sh_rest", (harmonic,))
        weighted = getattr(splats, name)[(members, *of)] * share[:, None]  # (m, 3)
        means = np.add.reduceat(weighted, starts).clip(-largest, largest)
        getattr(left, name)[(into[starts], *of)] = means.astype(np.float32)

    harmonics = range(-1, splats.sh_rest.shape[1]) if len(starts) else ()
    run_all(fill, harmonics, progress=progress, what="merging")


def copied(splats: Splats, rows: NDArray[np.int64]) -> Splats:
    """Copies of some splats in float64, but `sh_rest`; of more than a region, on disk."""
    if in_regions(splats, len(rows)):
        some = pieces(splats, rows)
        return on_disk(new_folder(splats), (copied(each, np.arange(len(each))) for each in some))
    columns: dict[str, Any] = {}
    for name in ARRAYS:
        values = getattr(splats, name)
        kind = values.dtype if name == "sh_rest" else np.float64
        columns[name] = np.empty((len(rows), *values.shape[1:]), kind)
    result = replace(splats, **columns)

    def copy(piece: slice) -> None:
        with np.errstate(invalid="ignore"):  # signalling NaN converted to float64
            assign(result.take(piece), splats.take(rows[piece]))

    run_all(copy, chunks(len(rows), _CHUNK))
    return result


def _by_regions(stage, keep_count, askew, progress):
    """`_Stage.reduced` of splats in files, region by region; the kept ones stay in files."""
    folder, there = new_folder(stage.splats), np.flatnonzero(stage.members)
    boxes = [there[box] for box in divided(stage.splats.means[there], askew=askew)]
    for number, rows in enumerate(boxes):
        members, sums, protected = stage.members[rows], stage.sums[:, rows], stage.protected[rows]
        region = replace(stage, members=members, sums=sums, protected=protected)
        note(folder, f"region-{number}", (rows, region))
    measuring, pricing, merging = stages(progress, 0.3, 0.3, 0.4)
    # Each uses all threads by itself.
    how = {"what": "merging", "threads": 1, "cost": seconds("merge", len(there))}
    numbers = range(len(boxes))
    whole = np.sum(run_all(partial(_measure, folder), numbers, progress=measuring, **how), axis=0)
    priced = run_all(partial(_price, folder, whole), numbers, progress=pricing, **how)
    removals = _removals(priced, len(there) - keep_count)
    del priced
    reduced = run_all(partial(_merge, folder), [*enumerate(removals)], progress=merging, **how)
    kept, members, sums, regions = zip(*reduced, strict=True)
    left, order = in_one(folder, regions, kept)
    keep = np.zeros(len(stage.members), np.bool_)
    keep[np.concatenate(kept)] = True
    return left, keep, np.concatenate(members)[order], np.concatenate(sums, axis=1)[:, order]


# The steps of a region. Any process can do them; between them it lies in the folder.


def _measure(folder, number):
    rows, stage = noted(folder, f"region-{number}")[1]
    stage = replace(stage, splats=copied(stage.splats, rows))
    measured = note(folder, f"measured-{number}", stage.measured(silent))[1]
    return measured.seen_and_whole()


def _price(folder, whole, number):
    """Costs and weights for `_removals` of the splats of a region that are not protected."""
    _, stage = noted(folder, f"region-{number}")[1]
    rows, measured = noted(folder, f"measured-{number}")[1]
    graph = stage.graph(measured, whole)
    graph.connect()
    best, merges = graph.best()
    note(folder, f"graph-{number}", (rows, graph))
    costs = np.full(len(stage.members), -1.0)  # what cannot be drawn goes first
    weights = np.ones(len(costs), np.float32)
    # Of two splats that merge, one goes.
    costs[rows], weights[rows] = best, np.where(merges, np.float32(0.5), np.float32(1.0))
    return costs[~stage.protected], weights[~stage.protected]


def _merge(folder, item):
    """Kept rows of a region after its removals, their members, sums and splats."""
    number, removals = item
    origin, stage = noted(folder, f"region-{number}")[1]
    stage = replace(stage, splats=copied(stage.splats, origin))
    rows, graph = noted(folder, f"graph-{number}")[1]
    left, keep, members, sums = stage.reduced(rows, graph, len(origin) - removals, silent)
    return origin[keep], members, sums, on_disk(folder / f"left-{number}", [left])


def _removals(priced, goal):
    """Number removed of each region, `goal` in all, by one ranking of (costs, weights) of all."""
    ends = np.cumsum([len(costs) for costs, _ in priced])
    costs, weights = (np.concatenate(each) for each in zip(*priced, strict=True))
    # Where more than half go, most splats that merge go, too.
    weights, order = np.maximum(weights, goal / len(costs)), np.argsort(costs, kind="stable")
    last = int(np.searchsorted(np.cumsum(weights[order], dtype=np.float64), goal))
    weights[order[last + 1 :]] = 0.0
    removed = np.append(0.0, np.cumsum(weights, dtype=np.float64))[ends]
    # Rounded so that the sum is exact: each gets what is added up to its end.
    removed = np.rint(removed * (goal / removed[-1])).astype(np.int64)
    return np.diff(removed, prepend=0).tolist()
