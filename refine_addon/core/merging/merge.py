"""Merging: reduce splats to a number by the cheapest merges and deletions.

`pairs` prices a merge and makes the merged splat, `graph` carries out the cheapest operations. What
is hidden changes as splats go, so the work is done in stages: before each but the first, the splats
left are measured again. Kept splats that nothing is merged into stay as they were, to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, chunks, part, report, return_freed, run_all, seconds, silent, stages
from ..splats import ARRAYS, Splats, drawable
from ..views import ViewSet
from ..visibility.scene import Scene, scene_of, spatial_order, splat_fingerprint
from .field import Array, Index, measured_field
from .graph import MergeGraph
from .pairs import as_splats, blend, groups

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

ALONE = 0.55
"""Least share that a stage leaves where one is enough; at least a half, as `STAGE`.

Just below 5/9, so that one stage removes half of all splats of which a tenth was deleted before.
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
        return "{changed:,} survivors absorbed {merged:,} splats; {deleted:,} were deleted".format(
            **self.facts()
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
    counts = stage_counts(len(rows), goal)
    penalty = merge_penalty(1.0 - goal / max(began or len(rows), 1))
    return_freed()  # what scoring took: twice as much as is left of it
    drawn = drawable(splats, threads=threads)[rows]
    scene = scene_of(splats.means[rows], drawn, views, threads=threads)
    expected: list[float] = []
    for entering in [total, *counts][: len(counts)]:
        again = seconds("measure", entering, len(views) / 2) if expected else 0.0
        expected += [again, seconds("merge", entering)]
    steps = iter(stages(progress, *expected))
    for count in counts:
        measuring, merging = next(steps), next(steps)
        if left is not splats:
            sums = measure(left.up_to_degree(0), sums, measuring)
        sums, fixed = np.asarray(sums, np.float64), spared[origin]
        rows = mergeable(left, scene, fixed | (members == 0), threads=threads)
        report(merging, 0.0, "merging")
        measured = measured_field(
            left, rows, views, scene, sums, progress=part(merging, 0.0, 0.3), threads=threads
        )
        field = measured.with_bias(measured.seen_and_whole())
        graph = MergeGraph(field, scene, penalty, threads=threads)
        del measured, field
        left, keep, members, sums = reduced(
            left, members, sums, rows, graph, count,
            protected=fixed, progress=part(merging, 0.3, 1.0),
        )  # fmt: skip
        origin = origin[keep]
        del graph
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


def mergeable(
    splats: Splats, scene: Scene, excluded: NDArray[np.bool_], *, threads: int | None = 1
) -> Index:
    """Rows of the splats that may merge, (M,) int64, by their place in the scene.

    So ties do not depend on the order of the file.
    """
    rows = np.flatnonzero(drawable(splats, threads=threads) & ~excluded)
    place = scene.positions(splats.means, rows, threads=threads)
    return rows[
        spatial_order(place, lambda tied: splat_fingerprint(splats, rows[tied]), threads=threads)
    ]


def reduced(
    splats: Splats,
    members: NDArray[np.int64],
    sums: Array,
    rows: Index,
    graph: MergeGraph,
    keep_count: int,
    *,
    protected: NDArray[np.bool_],
    progress: Progress = silent,
) -> tuple[Splats, NDArray[np.bool_], NDArray[np.int64], Array]:
    """Reduce splats by a graph: undrawable ones go first, then the graph's cheapest operations.

    Parameters
    ----------
    splats, sums, keep_count, protected, progress
        See `merge`.
    members : (N,) int64
        For how many of the first splats each stands; 0 if it was deleted.
    rows : (M,) int64
        Rows of the splats that the graph holds, see `mergeable`.
    graph : MergeGraph
        Its field is dropped.

    Returns
    -------
    splats : Splats
        The K kept splats, see `Merged`.
    keep : (N,) bool
    members : (K,) int64
    sums : (2, K) float64
        Predicted from the sums before and the merges' own errors.
    """
    keep, threads = members > 0, graph.threads
    excess = max(int(np.count_nonzero(keep)) - keep_count, 0)
    others = keep & ~protected
    others[rows] = False
    undrawable = np.flatnonzero(others)[:excess]
    keep[undrawable] = False
    graph.reduce(max(len(rows) - (excess - len(undrawable)), 0), part(progress, 0.0, 0.95))
    keep[rows[~graph.alive]] = False
    owner, share = groups(graph.merges, len(rows))
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
    for before, after in ((splats.sh_dc[:, None], left.sh_dc[:, None]),
                          (splats.sh_rest, left.sh_rest)):  # fmt: skip
        blend(before, rows[order], share[order], after, into, part(progress, 0.97, 1.0), threads)
    members = members.copy()
    members[rows] = np.bincount(owner, members[rows], len(rows))
    expected = sums[:, keep]
    expected[:, target] = field.contribution, field.error
    return left, keep, members[keep], expected


def copied(splats: Splats, rows: Index, threads: int | None = None) -> Splats:
    """Copies of some splats as `Merged` has them: merged ones merge again, in float64."""
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
