"""Merging: reduce splats to a number by the cheapest merges and deletions.

`pairs` prices a merge and makes the merged splat, `graph` carries out the cheapest operations. What
is hidden changes as splats go, so the work is done in stages: before each but the first, the splats
left are measured again. Kept splats that nothing is merged into stay as they were, to the bit.

Of splats in files, larger than memory, a stage goes region by region: they are divided into boxes
of about equally many, and each box is merged by itself. How many of a region stay is decided by one
ranking of the cheapest merges and deletions of all. The next stage divides along other planes, so
neighbours that a plane separates can merge then.
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
from ..mapped import divided, in_one, in_regions, look, new_folder, note, noted, on_disk, pieces
from ..splats import ARRAYS, Splats, drawable
from ..views import ViewSet
from ..visibility.scene import Scene, scene_of, spatial_order, splat_fingerprint
from .field import Array, measured_field
from .graph import MergeGraph
from .pairs import as_splats

Measure = Callable[[Splats, Array, Progress], Array]
"""``measure(splats, expected, progress)`` returns the sums of the splats left, (2, n).

Their harmonics have degree 0. `expected`, (2, n), is what the stage before predicts: right, but for
what is now hidden or no longer hidden by others.
"""

STAGE = 0.5
"""Share of its splats that each of very many stages leaves; fewer stages leave more.

At least a half: regions count a splat whose cheapest operation is a merge as half a splat, and
would run out of splats to remove beyond that.
"""

FINER = 0.8
"""By how many stages more the way is divided than if each left `STAGE`: with three instead of two
70 % of a park lose 1.4 dB less, with five instead of four 90 % gain nothing."""

ALONE, ALONE_BY_REGIONS = 0.55, 0.6
"""Least share that a stage leaves where one is enough; at least a half, as `STAGE`.

Just below 5/9, so that one stage removes half of all splats of which a tenth was deleted before. By
regions half goes in two stages: four regions in one stage lost 0.5 dB.
"""

PENALTY = 2.0
"""Factor on the cost of merging if half of the splats go; see `merge_penalty`."""

_CHUNK = 1 << 14  # splats copied at a time: some MB


@dataclass(frozen=True, eq=False)
class Merged:
    """The result of merging N splats.

    Attributes
    ----------
    splats : Splats
        The K kept splats, in the order of the N splats, in float64; harmonics above the constant
        one in the type that they had.
    keep : (N,) bool
        Which splats are kept.
    changed : (K,) bool
        Which of them others were merged into; all others are equal to the bit to what they were.
    merged, deleted : int
        How many splats were merged into a kept one, and how many were deleted.
    """

    splats: Splats
    keep: NDArray[np.bool_]
    changed: NDArray[np.bool_]
    merged: int
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
    """Factor on the cost of merging, given the share of the splats that goes.

    It is `PENALTY` times the square root of the odds of staying, (1 - share) / share.

    If few splats go, the squared errors of their deletions add up. If neighbours go together, their
    errors add up before they are squared, which costs more: a surface thins out. Merging keeps the
    mass, so it does not have this problem, and is made cheaper the more splats go. The result
    hardly depends on the factor: half or twice of it costs at most 0.3 dB on three scenes.

    Parameters
    ----------
    share : float
        Of the splats that go, 0 to 1.

    Examples
    --------
    >>> merge_penalty(0.5)
    2.0
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
    threads: int | None = None,
) -> Merged:
    """Reduce splats to `keep_count` by the merges and deletions that cost the pictures least.

    Parameters
    ----------
    splats : Splats
        In the frame and unit of the views.
    views : ViewSet
        From where the splats are seen.
    sums : (2, N) floating
        What the views see of each splat: contribution and error, see `field.Field`.
    measure : callable
        Returns the same of the splats left, see `Measure`; called before each stage but the first.
    keep_count : int
        How many are kept, or more if more are protected. Undrawable splats go first.
    began : int, optional
        How many splats there were before some of them became these; `merge_penalty` goes by the
        share that has gone of those. By default these are the first.
    deleted : (N,) bool, optional
        Splats that are deleted before anything is merged.
    protected : (N,) bool, optional
        Splats that are neither removed nor changed.
    progress : callable, optional
        See `refine_addon.core.execute.Progress`.
    threads : int, optional

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
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
    drawn = drawable(splats, threads=threads)
    # By regions those that were deleted count for the frame, too.
    counting = np.arange(total) if regions else rows
    scene = scene_of(splats.means[counting], drawn[counting], views, threads=threads)
    del rows, drawn, counting
    steps = iter(stages(progress, *stage_seconds(total, counts, len(views))))
    for number, count in enumerate(counts):
        measuring, merging = next(steps), next(steps)
        if left is not splats:
            sums = measure(left.up_to_degree(0), sums, measuring)
        stage = _Stage(
            left, members, np.asarray(sums, np.float64), spared[origin], views, scene, penalty,
            threads,
        )  # fmt: skip
        if in_regions(left, int(np.count_nonzero(members))):
            left, keep, members, sums = _by_regions(stage, count, number % 2 == 1, merging)
        else:
            left, keep, members, sums = stage.at_once(count, merging)
        origin = origin[keep]
        del stage
        return_freed()  # views are measured next, by processes that need memory of their own
    if left is splats:
        origin = np.flatnonzero(members)
        left, members = copied(splats, origin, threads), members[origin]
    report(progress, 1.0, "merging")
    kept = np.zeros(total, np.bool_)
    kept[origin] = True
    lasting = int(members.sum())
    return Merged(left, kept, members > 1, lasting - len(left), total - lasting)


def stage_counts(count: int, goal: int, alone: float = ALONE) -> list[int]:
    """How many of `count` splats are left after each stage; `goal` after the last.

    If at least the share `alone` is left, one stage does.

    Examples
    --------
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
    """What a stage begins with: N splats, or those of a region; the rest is as in `merge`."""

    splats: Splats
    members: NDArray[np.int64]  # (N,), for how many of the first splats each stands, 0 if deleted
    sums: Array  # (2, N)
    protected: NDArray[np.bool_]
    views: ViewSet
    scene: Scene
    penalty: float
    threads: int | None

    def at_once(self, keep_count, progress):
        """What `reduced` makes of all splats together."""
        rows, measured = self.measured(part(progress, 0.0, 0.3))
        graph = self.graph(measured, measured.seen_and_whole())
        del measured
        return self.reduced(rows, graph, keep_count, part(progress, 0.3, 1.0))

    def measured(self, progress):
        """Rows of the splats that may merge, (M,), and these as merging needs them.

        By their place in the scene, so that ties do not depend on the order of the file.
        """
        splats, threads = self.splats, self.threads
        excluded = self.protected | (self.members == 0)
        rows = np.flatnonzero(drawable(splats, threads=threads) & ~excluded)
        place = self.scene.positions(splats.means, rows, threads=threads)
        order = spatial_order(
            place, lambda tied: splat_fingerprint(splats, rows[tied]), threads=threads
        )
        rows = rows[order]
        report(progress, 0.0, "merging")
        return rows, measured_field(
            splats, rows, self.views, self.scene, self.sums, progress=progress, threads=threads
        )

    def graph(self, measured, whole):
        """Graph of measured splats; `whole` is `MeasuredField.seen_and_whole` of all splats."""
        return MergeGraph(measured.with_bias(whole), self.scene, self.penalty, threads=self.threads)

    def reduced(self, rows, graph, keep_count, progress):
        """The K kept splats, at least `keep_count`; which these are, (N,); their members and sums.

        Undrawable splats go first, then the cheapest operations of the graph of the splats in
        `rows`, (M,), are carried out. Sums, (2, K), are predicted from those before and the errors
        of the merges.
        """
        splats, threads = self.splats, self.threads
        keep = self.members > 0
        excess = max(int(np.count_nonzero(keep)) - keep_count, 0)
        others = keep & ~self.protected
        others[rows] = False
        undrawable = np.flatnonzero(others)[:excess]
        keep[undrawable] = False
        graph.reduce(max(len(rows) - (excess - len(undrawable)), 0), part(progress, 0.0, 0.95))
        keep[rows[~graph.alive]] = False
        # The splat that each went into, or is, and its share of the colour of that one.
        owner, share = np.arange(len(rows)), np.ones(len(rows))
        # From the last round to the first: what one merges into may go into another in a later one.
        for into, gone, kept_share in reversed(graph.merges):
            owner[gone] = owner[into]
            share[gone] = share[into] * (1.0 - kept_share)
            share[into] *= kept_share
        changed = graph.alive & (np.bincount(owner, minlength=len(rows)) > 1)
        # Drop the rest of the field before the kept splats are copied, to save memory.
        field = graph.field = graph.field.take(np.flatnonzero(changed))
        kept = np.flatnonzero(keep)
        left, target = copied(splats, kept, threads), np.searchsorted(kept, rows[changed])
        shapes = as_splats(field, part(progress, 0.95, 0.97), threads)
        for name, values in zip(ARRAYS, (field.means, *shapes), strict=False):
            getattr(left, name)[target] = values
        inside = np.flatnonzero(changed[owner])
        order = inside[np.argsort(owner[inside], kind="stable")]
        into = np.searchsorted(kept, rows[owner[order]])
        blended = part(progress, 0.97, 1.0)
        _blend(splats, rows[order], share[order], left, into, blended, threads)
        members = self.members.copy()
        members[rows] = np.bincount(owner, members[rows], len(rows))
        expected = self.sums[:, keep]
        expected[:, target] = field.contribution, field.error
        return left, keep, members[keep], expected


def _blend(splats, members, share, left, into, progress, threads):
    """Write the harmonics of merged splats: means of those of all that went into one, by shares.

    `members`, (m,), are the rows of these, group by group; `into` are those of the merged splats in
    `left`. Rounded to float32, whatever type they have, so that tiles and files give the same.
    """
    starts, largest = np.flatnonzero(np.diff(into, prepend=-1)), np.finfo(np.float32).max

    def fill(harmonic):  # one at a time, to save memory; -1 is the constant one
        name, of = ("sh_dc", ()) if harmonic < 0 else ("sh_rest", (harmonic,))
        with np.errstate(under="ignore"):
            weighted = getattr(splats, name)[(members, *of)] * share[:, None]  # (m, 3)
            means = np.add.reduceat(weighted, starts).clip(-largest, largest)
            getattr(left, name)[(into[starts], *of)] = means.astype(np.float32)

    harmonics = range(-1, splats.sh_rest.shape[1]) if len(starts) else ()
    run_all(fill, harmonics, progress=progress, what="merging", threads=threads)


def copied(splats: Splats, rows: NDArray[np.int64], threads: int | None = None) -> Splats:
    """Copies of some splats as `Merged` has them: merged ones merge again, in float64.

    Of splats in files, more than a region go into files again.
    """
    if in_regions(splats, len(rows)):
        some = pieces(splats, rows)
        return on_disk(new_folder(splats), (copied(each, np.arange(len(each))) for each in some))
    columns: dict[str, Any] = {}
    for name in ARRAYS:
        values = getattr(splats, name)
        kind = values.dtype if name == "sh_rest" else np.float64
        columns[name] = np.empty((len(rows), *values.shape[1:]), kind)

    def copy(piece: slice) -> None:
        for name, column in columns.items():
            column[piece] = getattr(splats, name)[rows[piece]]

    run_all(copy, chunks(len(rows), _CHUNK), threads=threads)
    return replace(splats, **columns)


def _by_regions(stage, keep_count, askew, progress):
    """What `_Stage.reduced` makes of splats in files, region by region; the kept ones lie there."""
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
    counts = _staying(priced, keep_count)
    del priced
    made = run_all(partial(_merge, folder), [*enumerate(counts)], progress=merging, **how)
    kept, members, sums, regions = zip(*made, strict=True)
    left, order = in_one(folder, regions, kept)
    keep = np.zeros(len(stage.members), np.bool_)
    keep[np.concatenate(kept)] = True
    return left, keep, np.concatenate(members)[order], np.concatenate(sums, axis=1)[:, order]


# The steps of a region. Any process can do them; between them it lies in the folder.


def _measure(folder, number):
    """`MeasuredField.seen_and_whole` of a region."""
    rows, stage = noted(folder, f"region-{number}")[1]
    stage = replace(stage, splats=copied(stage.splats, rows, stage.threads))
    measured = note(folder, f"measured-{number}", stage.measured(look))[1]
    return measured.seen_and_whole()


def _price(folder, whole, number):
    """Of each splat's cheapest operation its cost, and how many splats go by it, 1 or .5."""
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


def _merge(folder, item):
    """Rows kept of a region that is merged down to a count, their members and sums, and they."""
    number, count = item
    origin, stage = noted(folder, f"region-{number}")[1]
    stage = replace(stage, splats=copied(stage.splats, origin, stage.threads))
    rows, graph = noted(folder, f"graph-{number}")[1]
    with np.errstate(under="ignore"):
        left, keep, members, sums = stage.reduced(rows, graph, count, look)
    return origin[keep], members, sums, on_disk(folder / f"left-{number}", [left])


def _staying(priced, left):
    """How many splats of each region stay, of `left` that do of all, by what `_price` says of each.

    As many go as a region has among the cheapest merges and deletions of all. All merges together
    count half of the splats; so a stage has to leave half of them, or there would not be enough to
    go.
    """
    ends = np.cumsum([len(costs) for costs, _ in priced])
    costs, weights = (np.concatenate(each) for each in zip(*priced, strict=True))
    order, goal = np.argsort(costs, kind="stable"), len(costs) - left
    last = int(np.searchsorted(np.cumsum(weights[order], dtype=np.float64), goal))
    weights[order[last + 1 :]] = 0.0
    gone = np.cumsum(weights, dtype=np.float64)[ends - 1]
    # Rounded so that the sum is exact: each gets what is added up to its end.
    gone = np.rint(gone * (goal / gone[-1])).astype(np.int64)
    return np.diff(ends - gone, prepend=0).tolist()
