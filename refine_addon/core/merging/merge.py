"""Merging: reduce splats to a number by the cheapest merges and deletions.

`pairs` prices a merge and makes the merged splat, `graph` carries out the cheapest operations. What
is hidden changes as splats go, so the work is done in stages: before each but the first, the splats
left are measured again. Kept splats that nothing is merged into stay as they were, to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, report, return_freed, seconds, silent, stages
from ..regions import in_regions
from ..splats import Splats, drawable
from ..views import ViewSet
from ..visibility.scene import scene_of
from .field import Array
from .regions import stage_by_regions
from .stage import Stage, copied, reduced_at_once

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
    expected: list[float] = []
    for entering in [total, *counts][: len(counts)]:
        again = seconds("measure", entering, len(views) / 2) if expected else 0.0
        expected += [again, seconds("merge", entering)]
    steps = iter(stages(progress, *expected))
    for number, count in enumerate(counts):
        measuring, merging = next(steps), next(steps)
        if left is not splats:
            sums = measure(left.up_to_degree(0), sums, measuring)
        stage = Stage(
            left, members, np.asarray(sums, np.float64), spared[origin], views, scene, penalty,
            number, threads,
        )  # fmt: skip
        many = in_regions(left, int(np.count_nonzero(members)))
        reduced = stage_by_regions if many else reduced_at_once
        left, keep, members, sums = reduced(stage, count, merging)
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
