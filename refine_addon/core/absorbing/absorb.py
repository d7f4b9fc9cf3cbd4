"""Survivors take over what is removed: the cheapest merges and deletions, until the budget is met.

`merging` says what merging two splats costs the pictures, and `merge_graph` carries out the
cheapest operations. What the views see of the survivors changes on the way, so the work is done
in stages, and measured anew before each. Splats that absorb nothing stay as they were to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..scene import scene_of, spatial_order
from ..splats import Splats, drawable
from ..work import Progress, part, report, silent
from . import merge_field, merging
from .merge_field import ViewSums
from .merge_graph import MergeGraph

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray

    from ..scene import Scene
    from ..views import ViewSet
    from .merge_field import Array, Index

Measure = Callable[[Splats, Progress], ViewSums]
"""Called with splats, as they are by then; says what the views see of each."""

STAGE = 0.6
"""Share of the splats that a stage leaves at least."""

PATIENCE = 2.0
"""Factor on the cost of merging where half of the splats go. See `patience`."""


@dataclass(frozen=True, eq=False)
class Absorbed:
    """What is left of N splats.

    Attributes
    ----------
    splats : Splats
        The K survivors, in their old order.
    keep : (N,) bool
        Which they are.
    changed : (K,) bool
        Which of them absorbed others; the rest are what they were, to the bit.
    merged, deleted : int
        How many splats went into a survivor, and how many are gone altogether.
    """

    splats: Splats
    keep: NDArray[np.bool_]
    changed: NDArray[np.bool_]
    merged: int
    deleted: int

    def facts(self) -> dict[str, int]:
        """Return the counts, for a report."""
        changed = int(np.count_nonzero(self.changed))
        return {"changed": changed, "merged": self.merged, "deleted": self.deleted}

    def note(self) -> str:
        """Return the counts as a sentence: absorbing is never silent."""
        return "{changed:,} survivors absorbed {merged:,} splats; {deleted:,} were deleted".format(
            **self.facts()
        )


def patience(share: float) -> float:
    """Return how much dearer merging is made, by the share of the splats that is to go.

    The errors of deletions add up as long as few splats go. The more of its neighbours go with
    it, the more their errors become one, whose square grows faster: a surface thins. Merging keeps
    the mass, so that its errors stay apart. By the odds of staying; the result hardly depends on it
    (half of it or twice cost .3 dB or less on three scenes).

    Examples
    --------
    >>> patience(0.5)
    2.0
    """
    share = min(max(share, 1e-3), 1.0 - 1e-3)
    return PATIENCE * math.sqrt((1.0 - share) / share)


def absorb(  # noqa: PLR0913 - what, seen how, how much, what is spared
    splats: Splats,
    views: ViewSet,
    measure: Measure,
    keep_count: int,
    *,
    protected: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Absorbed:
    """Reduce splats to `keep_count` by merging and deleting, whatever costs the views least.

    Parameters
    ----------
    splats : Splats
        In the frame and unit of the views.
    views : ViewSet
        They tell from where each splat is looked at.
    measure : callable
        ``measure(splats, progress)`` returns a `ViewSums`; called once a stage.
    keep_count : int
        How many survive; more where more are protected. Splats that no renderer can draw go first.
    protected : (N,) bool, optional
        Splats that neither vanish nor change.
    progress : callable, optional
        See `refine_addon.core.work.Progress`.
    threads : int, optional

    Returns
    -------
    Absorbed

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """
    count = len(splats)
    spared = np.zeros(count, np.bool_) if protected is None else np.array(protected, np.bool_)
    goal = max(keep_count, int(np.count_nonzero(spared)), 0)
    scene = scene_of(splats.means, drawable(splats), views)
    origin, members = np.arange(count), np.ones(count, np.int64)
    factor = patience(1.0 - goal / max(count, 1))
    stages = math.ceil(math.log(max(goal, 1) / count) / math.log(STAGE)) if goal < count else 0
    for stage in range(stages):
        ahead = part(progress, stage / stages, (stage + 1) / stages)
        left = round(count * (goal / count) ** ((stage + 1) / stages))
        sums = measure(splats, part(ahead, 0.0, 0.5))
        splats, kept, taken = _absorb_once(
            splats, views, scene, sums, max(left, goal), protected=spared[origin],
            factor=factor, progress=part(ahead, 0.5, 1.0), threads=threads,
        )  # fmt: skip
        # A survivor stands for all that those it took stood for.
        members = np.bincount(taken[taken >= 0], members[taken >= 0], len(splats)).astype(np.int64)
        origin = origin[kept]
    keep = np.zeros(count, np.bool_)
    keep[origin] = True
    merged = int(members.sum()) - len(origin)
    return Absorbed(splats, keep, members > 1, merged, count - len(origin) - merged)


def _absorb_once(  # noqa: PLR0913 - what, seen how, how much, what is spared
    splats: Splats,
    views: ViewSet,
    scene: Scene,
    sums: ViewSums,
    keep_count: int,
    *,
    protected: NDArray[np.bool_],
    factor: float,
    progress: Progress = silent,
    threads: int | None = None,
) -> tuple[Splats, NDArray[np.bool_], Index]:
    """Do one stage of `absorb`; `factor` is on the cost of merging.

    Returns
    -------
    splats : Splats
        The K survivors of N.
    keep : (N,) bool
        Which they are.
    taken : (N,) int64
        Into which survivor each splat went; -1 where it was deleted.
    """
    sums = ViewSums(np.asarray(sums.contribution, np.float64), np.asarray(sums.error, np.float64))
    good, free = drawable(splats), ~protected
    keep = np.ones(len(splats), np.bool_)
    excess = max(len(splats) - keep_count, 0)
    hopeless = np.flatnonzero(free & ~good)[:excess]
    keep[hopeless] = False
    excess -= len(hopeless)
    rows = np.flatnonzero(keep & good & free)
    excess = min(excess, len(rows))
    report(progress, 0.0, "absorbing")
    if excess <= 0:
        return splats.take(keep), keep, np.where(keep, np.cumsum(keep) - 1, -1)
    # In an order of the scene's own, so that ties do not depend on that of the file.
    rows = rows[spatial_order(scene.place(splats.means[rows]))]
    found = merge_field.field(splats, rows, views, scene, sums, threads=threads)
    graph = MergeGraph(found, scene, factor, threads=threads)
    graph.reduce(len(rows) - excess, part(progress, 0.1, 0.95))
    keep[rows[~graph.alive]] = False
    return _written(splats, keep, rows, graph)


def _written(
    splats: Splats, keep: NDArray[np.bool_], rows: Index, graph: MergeGraph
) -> tuple[Splats, NDArray[np.bool_], Index]:
    """Return what `_absorb_once` does, the merged splats written over those that absorbed."""
    own = np.arange(len(rows))
    owner, share = own.copy(), np.ones(len(rows))
    # Backwards, so that a splat absorbed early follows its survivor to the last one.
    for into, gone, kept_share in reversed(graph.merges):
        owner[gone] = owner[into]
        share[gone] = share[into] * (1.0 - kept_share)
        share[into] *= kept_share
    changed = np.zeros(len(rows), np.bool_)
    changed[owner[owner != own]] = True
    changed &= graph.alive
    place = np.cumsum(keep) - 1
    target = place[rows[changed]]
    members = np.flatnonzero(changed[owner])
    harmonics = _Blend(rows[members], place[rows[owner[members]]], share[members])
    # The rest of the field makes room for the survivors.
    merged = graph.field = graph.field.take(np.flatnonzero(changed))
    with np.errstate(under="ignore"):
        logs, quaternions = merging.axes(merged.covariances)
        result = Splats(
            _put(splats.means[keep], target, merged.means),
            _put(splats.log_scales[keep], target, logs),
            _put(splats.quaternions[keep], target, quaternions),
            _put(splats.opacity_logits[keep], target, _logit(merged.opacity)),
            harmonics.put(splats.sh_dc[:, None], splats.sh_dc[keep][:, None])[:, 0],
            harmonics.put(splats.sh_rest, splats.sh_rest[keep]),
        )
    taken = np.where(keep, place, -1)
    taken[rows] = np.where(graph.alive[owner], place[rows[owner]], -1)
    return result, keep, taken


class _Blend:
    """Weighted means of rows, group by group; the weights of a group sum to 1."""

    def __init__(self, members: Index, targets: Index, share: Array) -> None:
        order = np.argsort(targets, kind="stable")
        self.members, self.share = members[order], share[order]
        self.starts = np.flatnonzero(np.diff(targets[order], prepend=-1))
        self.targets = targets[order][self.starts]

    def put(self, values: NDArray[Any], kept: NDArray[Any]) -> NDArray[Any]:
        """Write the means of `values`, (N, K, 3), over the target rows of `kept`; return it."""
        if len(self.starts):
            for column in range(values.shape[1]):
                # A column at a time bounds the memory.
                own = np.asarray(values[self.members, column], np.float64)
                means = np.add.reduceat(own * self.share[:, None], self.starts)
                kept[self.targets, column] = means
        return kept


def _logit(opacity: Array) -> Array:
    """Return what `splats.opacity` makes `opacity` of."""
    logit: Array = np.log(opacity) - np.log1p(-opacity)
    return logit


def _put(kept: NDArray[Any], rows: Index, values: Array) -> NDArray[Any]:
    """Write `values` over some rows of a copy; return it."""
    kept[rows] = values
    return kept
