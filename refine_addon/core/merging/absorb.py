"""Absorbing: reduce splats to a number by the cheapest merges and deletions.

`merging` computes what a merge costs, and `merge_graph` carries out the cheapest operations. What
is hidden changes as splats go, so the work is done in stages: before each, the splats left are
measured again. Survivors that absorb nothing stay as they were, to the bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import costs, spherical_harmonics
from ..execute import Progress, chunks, part, report, return_freed, run_all, silent
from ..pace import phases
from ..splats import ARRAYS, Splats, drawable
from ..views import ViewSet
from ..visibility.scene import Scene, scene_of, spatial_order, splat_fingerprint
from .field import Array, ColorOf, Field, Index, ViewSums, measured_field
from .graph import MergeGraph
from .pairs import axes, flattened

Measure = Callable[[Splats, "ViewSums | None", Progress], ViewSums]
"""``measure(splats, expected, progress)`` returns what the views see of each of these splats.

`expected` is what the stage before predicts: right, but for what is now hidden or no longer hidden
by others. It is None before the first stage.
"""

STAGE = 0.5
"""Share of its splats that each of very many stages leaves; fewer stages leave more.

At least a half: tiles count a splat whose cheapest operation is a merge as half a splat, and would
run out of splats to remove beyond that (`_staying` in `tiles/absorbing.py`).
"""

FINER = 0.8
"""By how many stages more the way is divided than if each left `STAGE`: with three instead of two
70 % of a park lose 1.4 dB less, with five instead of four 90 % gain nothing."""

ALONE = 0.55
"""Least share that a stage leaves where one is enough; at least a half, as `STAGE`.

Just below 5/9, so that one stage removes half of all splats of which a tenth was deleted before.
"""

PATIENCE = 2.0
"""Factor on the cost of merging if half of the splats go; see `patience`."""

_CHUNK = 1 << 14  # covariances turned into axes at a time: some MB of temporaries a thread


class Counts:
    """How many splats absorbing changed, merged and deleted; see `Absorbed`."""

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
        The K survivors, in the order of the N splats, in float64; harmonics in the type that they
        had.
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


def absorb(
    splats: Splats,
    views: ViewSet,
    measure: Measure,
    keep_count: int,
    *,
    began: int | None = None,
    deleted: NDArray[np.bool_] | None = None,
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
    deleted : (N,) bool, optional
        Splats that went before, and that nothing absorbs.
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
    count = len(splats)
    spared = np.zeros(count, np.bool_) if protected is None else np.array(protected, np.bool_)
    lineage = _Lineage(splats, np.arange(count) if deleted is None else np.flatnonzero(~deleted))
    goal = max(keep_count, int(np.count_nonzero(spared[lineage.origin])), 0)
    left_after = stages(len(lineage.origin), goal)
    factor = patience(1.0 - goal / max(began or len(lineage.origin), 1))
    return_freed()  # what scoring took: twice as much as is left of it
    bare = lineage.without_harmonics(progress, threads)
    scene = scene_of(bare.means, drawable(bare, threads=threads), views, threads=threads)
    sums: ViewSums | None = None
    images = costs.Images.of(views)
    steps = iter(phases(progress, *costs.absorbing(len(bare), left_after, images)))
    for left in left_after:
        measuring, merging_progress = next(steps), next(steps)
        sums = measure(bare, sums, measuring)
        stage = absorb_once(
            bare, views, scene, sums, left, protected=spared[lineage.origin],
            factor=factor, color_of=lineage.color_of,
            progress=merging_progress, threads=threads,
        )  # fmt: skip
        bare, sums = stage.splats, stage.expected
        lineage.follow(stage)
        del stage
        return_freed()  # views are measured next, by processes that need memory of their own
    report(progress, 1.0, "absorbing")
    return lineage.absorbed(bare, threads)


class _Lineage:
    """What became of splats, and their harmonics, which are never copied as a whole."""

    def __init__(self, splats: Splats, rows: Index) -> None:
        self.splats = splats
        self.rows = self.origin = rows
        # Of each of the M: which of those left it is or went into, and its share of the colour.
        self._owner, self._share = np.arange(len(rows), dtype=np.int32), np.ones(len(rows))
        self._colors: Array | None = None  # (K, 3), from the first stage on

    def without_harmonics(self, progress: Progress, threads: int | None) -> Splats:
        """Return the splats with their base colour alone, in float64; undrawable ones stay so."""
        base, count = self.splats.up_to_degree(0), len(self.rows)
        columns: dict[str, Any] = {
            name: np.empty((count, *getattr(base, name).shape[1:])) for name in ARRAYS
        }

        def fill(piece: slice) -> None:
            chunk = self.splats.take(self.rows[piece])
            for name, values in columns.items():
                values[piece] = getattr(chunk, name) if name != "sh_rest" else 0.0
            columns["sh_dc"][piece][~drawable(chunk)] = np.nan

        run_all(fill, chunks(count, _CHUNK), progress=part(progress, 0.0, 0.0), what="absorbing",
                   threads=threads)  # fmt: skip
        return replace(base, **columns)

    def color_of(self, rows: Index, direction: Array) -> Array:
        """Return the colours of some of the splats left, (n, 3), seen along directions, (n, 3).

        Those that splats had before the first stage, or got by merging.
        """
        if self._colors is not None:
            return self._colors[rows]
        own = self.origin[rows]
        return spherical_harmonics.colors(
            direction, self.splats.sh_dc[own], self.splats.sh_rest[own]
        )

    def follow(self, stage: Stage) -> None:
        """Note what a stage made of the splats left."""
        self.origin = self.origin[stage.keep]
        if stage.color is not None:
            self._colors = stage.color
        elif self._colors is not None:
            self._colors = self._colors[stage.keep]
        here = np.flatnonzero(self._owner >= 0)
        owner = self._owner[here]
        self._share[here] *= stage.share[owner]
        self._owner[here] = stage.survivor[owner]

    def absorbed(self, bare: Splats, threads: int | None) -> Absorbed:
        """Return the survivors with their harmonics, given what is left, without."""
        here = np.flatnonzero(self._owner >= 0)
        owner, total, left = self._owner[here], len(self.splats), len(self.origin)
        keep = np.zeros(total, np.bool_)
        keep[self.origin] = True
        changed = np.bincount(owner, minlength=left) > 1  # (K,)
        bare.sh_dc[~changed] = self.splats.sh_dc[self.origin[~changed]]
        rest = _rows(self.splats.sh_rest, self.origin, threads)
        of_changed = changed[owner]
        members = here[of_changed]
        blend = _Blend(self.rows[members], owner[of_changed], self._share[members])
        with np.errstate(under="ignore"):
            blend.put(self.splats.sh_rest, rest, silent, threads)
        merged = len(here) - left
        return Absorbed(replace(bare, sh_rest=rest), keep, changed, merged, total - len(here))


def in_float64(splats: Splats) -> Splats:
    """Return splats in float64: merged ones merge again, and rounding would depend on the frame."""
    columns: dict[str, Any] = {
        name: np.asarray(getattr(splats, name), np.float64) for name in ARRAYS
    }
    return replace(splats, **columns)


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
    number = 1 if share >= alone else math.ceil(math.log(share) / math.log(STAGE) + FINER)
    return [
        max(round(count * (goal / count) ** ((stage + 1) / number)), goal)
        for stage in range(number)
    ]


class Stage(NamedTuple):
    """What a stage makes of N splats.

    Attributes
    ----------
    splats : Splats
        The K survivors.
    keep : (N,) bool
        Which splats survive.
    survivor : (N,) int64
        Which of the K survivors each splat is, or was absorbed by; -1 if it was deleted.
    share : (N,) float64
        Of each splat in the colour of its survivor.
    expected : ViewSums
        Of the K survivors, predicted from the sums before the stage and the merges' own errors.
    color : (K, 3) float64 or None
        Of those that may merge, as the views see them; None where none did.
    """

    splats: Splats
    keep: NDArray[np.bool_]
    survivor: Index
    share: Array
    expected: ViewSums
    color: Array | None


def absorb_once(
    splats: Splats,
    views: ViewSet,
    scene: Scene,
    sums: ViewSums,
    keep_count: int,
    *,
    protected: NDArray[np.bool_],
    factor: float,
    color_of: ColorOf,
    progress: Progress = silent,
    threads: int | None = None,
) -> Stage:
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
    color_of : callable
        See `field.measured_field`.
    """
    sums = ViewSums(np.asarray(sums.contribution, np.float64), np.asarray(sums.error, np.float64))
    rows = mergeable(splats, scene, protected, threads=threads)
    report(progress, 0.0, "absorbing")

    def make_graph() -> MergeGraph:
        measured = measured_field(
            splats, rows, views, scene, sums, color_of,
            progress=part(progress, 0.0, 0.3), threads=threads,
        )  # fmt: skip
        field = measured.with_allowance(measured.seen_and_whole())
        return MergeGraph(field, scene, factor, threads=threads)

    return reduced(
        splats, sums, rows, make_graph, keep_count,
        protected=protected, progress=part(progress, 0.3, 1.0),
    )  # fmt: skip


def mergeable(
    splats: Splats, scene: Scene, protected: NDArray[np.bool_], *, threads: int | None = 1
) -> Index:
    """Return the rows of the splats that may merge, (M,), by their place in the scene.

    So ties do not depend on the order of the file.
    """
    rows = np.flatnonzero(drawable(splats, threads=threads) & ~protected)
    place = scene.positions(splats.means, rows, threads=threads)
    return rows[
        spatial_order(place, lambda tied: splat_fingerprint(splats, rows[tied]), threads=threads)
    ]


def reduced(
    splats: Splats,
    sums: ViewSums,
    rows: Index,
    make_graph: Callable[[], MergeGraph],
    keep_count: int,
    *,
    protected: NDArray[np.bool_],
    progress: Progress = silent,
) -> Stage:
    """Reduce splats by a graph: undrawable ones go first, then the graph's cheapest operations.

    Parameters
    ----------
    splats, sums, keep_count, protected, progress
        See `absorb_once`.
    rows : (M,) int64
        Rows of the splats that the graph holds, see `mergeable`.
    make_graph : callable
        Returns the graph; called only if some of its splats go.
    """
    excess = max(len(splats) - keep_count, 0)
    in_graph = np.zeros(len(splats), np.bool_)
    in_graph[rows] = True
    keep = np.ones(len(splats), np.bool_)
    undrawable = np.flatnonzero(~protected & ~in_graph)[:excess]
    keep[undrawable] = False
    excess = min(excess - len(undrawable), len(rows))
    if excess <= 0:
        survivor = np.where(keep, np.cumsum(keep) - 1, -1)
        return Stage(splats.take(keep), keep, survivor, np.ones(len(keep)), sums.take(keep), None)
    graph = make_graph()
    graph.reduce(len(rows) - excess, part(progress, 0.0, 0.95))
    keep[rows[~graph.alive]] = False
    return _with_merged(splats, sums, keep, rows, graph, part(progress, 0.95, 1.0))


def _with_merged(
    splats: Splats,
    sums: ViewSums,
    keep: NDArray[np.bool_],
    rows: Index,
    graph: MergeGraph,
    progress: Progress,
) -> Stage:
    """Return what a stage makes of splats, with the merged splats in place of survivors.

    `keep`, (N,) bool, says which of them survive; the reduced graph's field shrinks to the changed
    survivors. The rest as `reduced`.
    """
    owner, share = _owners(graph.merges, len(rows))  # (M,) each
    changed = np.zeros(len(rows), np.bool_)  # (M,), survivors that absorbed others
    changed[owner[owner != np.arange(len(rows))]] = True
    changed &= graph.alive
    new_row = np.cumsum(keep) - 1  # (N,), of each survivor among the K
    survivor = np.where(keep, new_row, -1)
    survivor[rows] = np.where(graph.alive[owner], new_row[rows[owner]], -1)
    members = np.flatnonzero(changed[owner])  # all that went into one of them, themselves included
    harmonics = _Blend(rows[members], survivor[rows[members]], share[members])
    color = np.zeros((np.count_nonzero(keep), 3))
    color[new_row[rows[graph.alive]]] = graph.field.color[graph.alive]
    shares = np.ones(len(keep))
    shares[rows] = share
    # Drop the rest of the field before the survivors are copied, to save memory.
    merged = graph.field = graph.field.take(np.flatnonzero(changed))
    report(progress, 0.0, "absorbing")
    left, target = _taken(splats, np.flatnonzero(keep), graph.threads), new_row[rows[changed]]
    _put_shapes(left, target, merged, part(progress, 0.0, 0.3), graph.threads)
    with np.errstate(under="ignore"):
        for values, kept in ((splats.sh_dc[:, None], left.sh_dc[:, None]),
                             (splats.sh_rest, left.sh_rest)):  # fmt: skip
            harmonics.put(values, kept, part(progress, 0.3, 1.0), graph.threads)
    expected = sums.take(keep)
    expected.contribution[target], expected.error[target] = merged.contribution, merged.error
    return Stage(left, keep, survivor, shares, expected, color)


def _taken(splats: Splats, rows: Index, threads: int | None) -> Splats:
    """Return some splats, by their rows, copied on several threads."""
    columns: dict[str, Any] = {name: _rows(getattr(splats, name), rows, threads) for name in ARRAYS}
    return replace(splats, **columns)


def _rows(values: NDArray[Any], rows: Index, threads: int | None) -> NDArray[Any]:
    """Return some rows of an array, copied on several threads."""
    taken = np.empty((len(rows), *values.shape[1:]), values.dtype)

    def copy(piece: slice) -> None:
        taken[piece] = values[rows[piece]]

    run_all(copy, chunks(len(rows), _CHUNK), threads=threads)
    return taken


def _owners(merges: Sequence[tuple[Index, Index, Array]], count: int) -> tuple[Index, Array]:
    """Return the splat that each of `count` went into, or is, and its share of that one's colour.

    `merges`: see `MergeGraph.merges`.
    """
    owner, share = np.arange(count), np.ones(count)
    # From the last round to the first: a survivor of one round may be absorbed in a later one.
    for into, gone, kept_share in reversed(merges):
        owner[gone] = owner[into]
        share[gone] = share[into] * (1.0 - kept_share)
        share[into] *= kept_share
    return owner, share


def _put_shapes(
    left: Splats, target: Index, merged: Field, progress: Progress, threads: int | None
) -> None:
    """Write place, shape and opacity of merged splats to some rows of `left`."""
    logs, quaternions = np.empty((len(target), 3)), np.empty((len(target), 4))

    def fill(piece: slice) -> None:
        logs[piece], quaternions[piece] = axes(merged.covariances[piece])

    opacity = merged.opacity
    with np.errstate(under="ignore"):
        run_all(
            fill, chunks(len(target), _CHUNK), progress=progress, what="absorbing", threads=threads
        )
        if left.model == "2dgs":
            logs, quaternions, opacity = flattened(merged, logs, quaternions)
        left.means[target], left.log_scales[target] = merged.means, logs
        left.quaternions[target] = quaternions
        left.opacity_logits[target] = np.log(opacity) - np.log1p(-opacity)


class _Blend:
    """Weighted means of rows in groups.

    `members`, (m,), are the rows; `targets`, (m,), the row that the mean of a member's group is
    written to; `share`, (m,), their weights, which sum to 1 in a group.
    """

    def __init__(self, members: Index, targets: Index, share: Array) -> None:
        order = np.argsort(targets, kind="stable")
        self.members, self.share = members[order], share[order]
        self.starts = np.flatnonzero(np.diff(targets[order], prepend=-1))
        self.targets = targets[order][self.starts]

    def put(
        self, values: NDArray[Any], kept: NDArray[Any], progress: Progress, threads: int | None
    ) -> None:
        """Write the means of `values`, (N, n, 3), to the target rows of `kept`, (K, n, 3)."""

        def fill(piece: slice) -> None:
            # One harmonic at a time, to save memory.
            weighted = values[self.members, piece.start] * self.share[:, None]  # (m, 3)
            kept[self.targets, piece.start] = np.add.reduceat(weighted, self.starts)

        harmonics = values.shape[1] if len(self.starts) else 0
        run_all(fill, chunks(harmonics, 1), progress=progress, what="absorbing", threads=threads)
