"""Absorbing: reduce splats to a number by the cheapest merges and deletions.

`merging` computes what a merge costs, and `merge_graph` carries out the cheapest operations. What
the views see of the survivors changes meanwhile, so the work is done in stages, and the splats left
are measured before each. Survivors that absorb nothing stay as they were, to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..scene import scene_of, spatial_order, splat_fingerprint
from ..splats import Splats, drawable
from ..work import Progress, for_chunks, part, report, silent
from . import merge_field, merging
from .merge_field import ViewSums
from .merge_graph import MergeGraph

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray

    from ..scene import Scene
    from ..views import ViewSet
    from .merge_field import Array, Index

Measure = Callable[[Splats, "ViewSums | None", Progress], ViewSums]
"""``measure(splats, expected, progress)`` returns what the views see of each of these splats.

`expected` is what they would see by the measuring before, if merging and deleting had not changed
what is hidden; None before the first stage.
"""

STAGE = 0.6
"""One of several stages leaves at least this share of its splats."""

ALONE = 0.55
"""A single stage leaves at least this share: half of all splats, once a tenth of all was deleted.
"""

PATIENCE = 2.0
"""Factor on the cost of merging if half of the splats go; see `patience`."""

_CHUNK = 1 << 14


class Counts:
    """How many splats absorbing changed, merged and deleted.

    Attributes
    ----------
    changed : (K,) bool
        Which survivors absorbed others.
    merged, deleted : int
        How many splats were absorbed by a survivor, and how many were deleted.
    """

    changed: NDArray[np.bool_]
    merged: int
    deleted: int

    def facts(self) -> dict[str, int]:
        """Return the counts, for a report."""
        changed = int(np.count_nonzero(self.changed))
        return {"changed": changed, "merged": self.merged, "deleted": self.deleted}

    def note(self) -> str:
        """Return the counts as a sentence, for the user."""
        return "{changed:,} survivors absorbed {merged:,} splats; {deleted:,} were deleted".format(
            **self.facts()
        )


@dataclass(frozen=True, eq=False)
class Absorbed(Counts):
    """The result of absorbing N splats.

    Attributes
    ----------
    splats : Splats
        The K survivors, in the order of the N splats, in float64.
    keep : (N,) bool
        Which splats survive.
    changed : (K,) bool
        Which survivors absorbed others; all others are equal to the bit to what they were.
    merged, deleted : int
        How many splats were absorbed by a survivor, and how many were deleted.
    """

    splats: Splats
    keep: NDArray[np.bool_]
    changed: NDArray[np.bool_]
    merged: int
    deleted: int


def patience(share: float) -> float:
    """Return the factor on the cost of merging, given the share of the splats that goes.

    It is `PATIENCE` times the square root of the odds of staying, (1 - share) / share.

    If few splats go, the squared errors of their deletions add up. If neighbours go together, their
    errors add up before they are squared, which costs more: a surface thins out. Merging keeps the
    mass, so it does not have this problem, and is made cheaper the more splats go. The result
    hardly depends on the factor: half or twice of it costs at most .3 dB on three scenes.

    Parameters
    ----------
    share : float
        Of the splats that go, 0 to 1.

    Examples
    --------
    >>> patience(0.5)
    2.0
    """
    share = min(max(share, 1e-3), 1.0 - 1e-3)
    return PATIENCE * math.sqrt((1.0 - share) / share)


def absorb(  # noqa: PLR0913 - three keywords are optional
    splats: Splats,
    views: ViewSet,
    measure: Measure,
    keep_count: int,
    *,
    began: int | None = None,
    protected: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Absorbed:
    """Reduce splats to `keep_count` by the merges and deletions that cost the pictures least.

    Parameters
    ----------
    splats : Splats
        In the frame and unit of the views.
    views : ViewSet
        From where the splats are seen.
    measure : callable
        See `Measure`; called once in each stage.
    keep_count : int
        How many survive, or more if more are protected. Undrawable splats go first.
    began : int, optional
        How many splats there were before some of them became these; `patience` goes by the share
        that has gone of those. By default these are the first.
    protected : (N,) bool, optional
        Splats that are neither removed nor changed.
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
    # In float64, since merged splats merge again, and rounding between would depend on the frame.
    columns = {}
    for name, values in vars(splats).items():
        report(progress, 0.0, "absorbing")
        columns[name] = np.asarray(values, np.float64)
    splats = Splats(**columns)
    scene = scene_of(splats.means, drawable(splats), views)
    # Of each splat left: its row among the N, and how many of the N it stands for.
    origin, members = np.arange(count), np.ones(count, np.int64)
    factor = patience(1.0 - goal / max(began or count, 1))
    left_after = stages(count, goal)
    sums: ViewSums | None = None
    for stage, left in enumerate(left_after):
        ahead = part(progress, stage / len(left_after), (stage + 1) / len(left_after))
        sums = measure(splats, sums, part(ahead, 0.0, 0.5))
        splats, kept, taken, sums = absorb_once(
            splats, views, scene, sums, left, protected=spared[origin],
            factor=factor, progress=part(ahead, 0.5, 1.0), threads=threads,
        )  # fmt: skip
        # A survivor now also stands for all that the splats it absorbed stood for.
        members = np.bincount(taken[taken >= 0], members[taken >= 0], len(splats)).astype(np.int64)
        origin = origin[kept]
    keep = np.zeros(count, np.bool_)
    keep[origin] = True
    merged = int(members.sum()) - len(origin)
    return Absorbed(splats, keep, members > 1, merged, count - len(origin) - merged)


def stages(count: int, goal: int, alone: float = ALONE) -> list[int]:
    """Return how many of `count` splats are left after each stage; `goal` after the last.

    If at least the share `alone` is left, one stage does.

    Examples
    --------
    >>> stages(900, 500), stages(900, 450), stages(900, 900)
    ([500], [636, 450], [])
    """
    if goal >= count:
        return []
    share = max(goal, 1) / count
    number = 1 if share >= alone else math.ceil(math.log(share) / math.log(STAGE))
    return [
        max(round(count * (goal / count) ** ((stage + 1) / number)), goal)
        for stage in range(number)
    ]


def absorb_once(  # noqa: PLR0913 - the parameters of `absorb`
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
) -> tuple[Splats, NDArray[np.bool_], Index, ViewSums]:
    """Do one stage of `absorb`.

    Parameters
    ----------
    splats, views, keep_count, protected, progress, threads
        See `absorb`.
    scene : Scene
    sums : ViewSums
        Of these splats.
    factor : float
        On the cost of merging, see `patience`.

    Returns
    -------
    splats : Splats
        The K survivors of N.
    keep : (N,) bool
        Which splats survive.
    taken : (N,) int64
        Which of the K survivors each splat is, or was absorbed by; -1 if it was deleted.
    expected : ViewSums
        Of the K survivors, as far as these sums and the costs of the merges tell.
    """
    sums = ViewSums(np.asarray(sums.contribution, np.float64), np.asarray(sums.error, np.float64))
    rows = mergeable(splats, scene, protected)
    report(progress, 0.0, "absorbing")

    def graph() -> MergeGraph:
        ahead = part(progress, 0.0, 0.1)
        found = merge_field.field(splats, rows, views, scene, sums, progress=ahead, threads=threads)
        return MergeGraph(found, scene, factor, threads=threads)

    ahead = part(progress, 0.1, 1.0)
    return reduced(splats, sums, rows, graph, keep_count, protected=protected, progress=ahead)


def mergeable(splats: Splats, scene: Scene, protected: NDArray[np.bool_]) -> Index:
    """Return the rows of the splats that may merge, (M,), by their place in the scene.

    So ties do not depend on the order of the file.
    """
    rows = np.flatnonzero(drawable(splats) & ~protected)
    place = scene.place(splats.means[rows])
    return rows[spatial_order(place, lambda some: splat_fingerprint(splats, rows[some]))]


def reduced(  # noqa: PLR0913 - as `absorb_once`
    splats: Splats,
    sums: ViewSums,
    rows: Index,
    graph: Callable[[], MergeGraph],
    keep_count: int,
    *,
    protected: NDArray[np.bool_],
    progress: Progress = silent,
) -> tuple[Splats, NDArray[np.bool_], Index, ViewSums]:
    """Reduce splats by a graph; parameters and results as `absorb_once`.

    Parameters
    ----------
    rows : (M,) int64
        Rows of the splats that the graph holds, see `mergeable`.
    graph : callable
        Returns the graph; called only if some of these go.
    """
    excess = max(len(splats) - keep_count, 0)
    may = np.zeros(len(splats), np.bool_)
    may[rows] = True
    keep = np.ones(len(splats), np.bool_)
    hopeless = np.flatnonzero(~protected & ~may)[:excess]
    keep[hopeless] = False
    excess = min(excess - len(hopeless), len(rows))
    if excess <= 0:
        return splats.take(keep), keep, np.where(keep, np.cumsum(keep) - 1, -1), sums.take(keep)
    found = graph()
    found.reduce(len(rows) - excess, part(progress, 0.0, 0.95))
    keep[rows[~found.alive]] = False
    return _written(splats, sums, keep, rows, found, part(progress, 0.95, 1.0))


def _written(
    splats: Splats,
    sums: ViewSums,
    keep: NDArray[np.bool_],
    rows: Index,
    graph: MergeGraph,
    progress: Progress,
) -> tuple[Splats, NDArray[np.bool_], Index, ViewSums]:
    """Return the results of `absorb_once`, with the merged splats in place of the survivors.

    Parameters
    ----------
    splats, sums : Splats, ViewSums
        The N splats of the stage, and what the views see of them.
    keep : (N,) bool
        Which of them survive.
    rows : (M,) int64
        Rows of the splats that the graph holds.
    graph : MergeGraph
        Reduced; its field shrinks to the changed survivors.
    progress : callable
    """
    own, threads = np.arange(len(rows)), graph.threads
    # (M,) each: the survivor that each splat went into, and its share of the survivor's colour.
    owner, share = own.copy(), np.ones(len(rows))
    # From the last round to the first: a survivor of one round may be absorbed in a later one.
    for into, gone, kept_share in reversed(graph.merges):
        owner[gone] = owner[into]
        share[gone] = share[into] * (1.0 - kept_share)
        share[into] *= kept_share
    changed = np.zeros(len(rows), np.bool_)  # (M,), survivors that absorbed others
    changed[owner[owner != own]] = True
    changed &= graph.alive
    place = np.cumsum(keep) - 1  # (N,), row of each survivor among the K
    target = place[rows[changed]]  # (C,)
    members = np.flatnonzero(changed[owner])  # all that went into one of them, themselves included
    harmonics = _Blend(rows[members], place[rows[owner[members]]], share[members])
    # Drop the rest of the field before the survivors are copied, to save memory.
    merged = graph.field = graph.field.take(np.flatnonzero(changed))
    report(progress, 0.0, "absorbing")
    with np.errstate(under="ignore"):
        logs, quaternions = _axes(merged.covariances, part(progress, 0.0, 0.3), threads)
        ahead = part(progress, 0.3, 1.0)
        result = Splats(
            _put(splats.means[keep], target, merged.means),
            _put(splats.log_scales[keep], target, logs),
            _put(splats.quaternions[keep], target, quaternions),
            _put(splats.opacity_logits[keep], target, _logit(merged.opacity)),
            harmonics.put(splats.sh_dc[:, None], splats.sh_dc[keep][:, None], ahead, threads)[:, 0],
            harmonics.put(splats.sh_rest, splats.sh_rest[keep], ahead, threads),
        )
    taken = np.where(keep, place, -1)
    taken[rows] = np.where(graph.alive[owner], place[rows[owner]], -1)
    expected = sums.take(keep)
    expected.contribution[target], expected.error[target] = merged.contribution, merged.error
    return result, keep, taken, expected


class _Blend:
    """Means of rows in groups, weighted by shares that sum to 1 in each group.

    Parameters
    ----------
    members : (m,) int64
        Rows to take means of.
    targets : (m,) int64
        To which row the mean is written that each member belongs to.
    share : (m,) float64
    """

    def __init__(self, members: Index, targets: Index, share: Array) -> None:
        order = np.argsort(targets, kind="stable")
        self.members, self.share = members[order], share[order]
        self.starts = np.flatnonzero(np.diff(targets[order], prepend=-1))
        self.targets = targets[order][self.starts]

    def put(
        self, values: NDArray[Any], kept: NDArray[Any], progress: Progress, threads: int | None
    ) -> NDArray[Any]:
        """Write the means of `values`, (N, K, 3), to the target rows of `kept`; return `kept`."""

        def fill(piece: slice) -> None:
            # One column at a time, to save memory.
            own = np.asarray(values[self.members, piece.start], np.float64)
            means = np.add.reduceat(own * self.share[:, None], self.starts)
            kept[self.targets, piece.start] = means

        columns = values.shape[1] if len(self.starts) else 0
        for_chunks(fill, columns, 1, progress=progress, what="absorbing", threads=threads)
        return kept


def _axes(covariances: Array, progress: Progress, threads: int | None) -> tuple[Array, Array]:
    """Return `merging.axes` of M covariances, computed in chunks."""
    logs, quaternions = np.empty((len(covariances), 3)), np.empty((len(covariances), 4))

    def fill(piece: slice) -> None:
        logs[piece], quaternions[piece] = merging.axes(covariances[piece])

    for_chunks(fill, len(covariances), _CHUNK, progress=progress, what="absorbing", threads=threads)
    return logs, quaternions


def _logit(opacity: Array) -> Array:
    """Return the logit of an opacity, (M,): the inverse of `splats.opacity`."""
    logit: Array = np.log(opacity) - np.log1p(-opacity)
    return logit


def _put(kept: NDArray[Any], rows: Index, values: Array) -> NDArray[Any]:
    """Write `values` to some rows of `kept`, which is a copy already; return it."""
    kept[rows] = values
    return kept
