"""A stage of merging: all splats at once, or only those of a region."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, chunks, part, report, run_all, silent
from ..regions import in_regions, new_folder
from ..splats import ARRAYS, Splats, drawable, on_disk
from ..views import ViewSet
from ..visibility.scene import Scene, spatial_order, splat_fingerprint
from .field import Array, Index, MeasuredField, measured_field
from .graph import MergeGraph
from .pairs import as_splats, blend, groups

_CHUNK = 1 << 14  # splats copied at a time: some MB

Reduced = tuple[Splats, "NDArray[np.bool_]", "NDArray[np.int64]", Array]
"""What a stage makes of N splats: the K kept ones, which these are, (N,) bool, for how many of the
first splats each of them stands, (K,), and sums predicted from those before and the merges' own
errors, (2, K)."""


@dataclass(frozen=True, eq=False)
class Stage:
    """What a stage of merging begins with.

    Attributes
    ----------
    splats : Splats
        N of them.
    members : (N,) int64
        For how many of the first splats each stands; 0 if it was deleted.
    sums : (2, N) float64
        See `merge.merge`.
    protected : (N,) bool
    views : ViewSet
    scene : Scene
    penalty : float
        See `merge.merge_penalty`.
    number : int
        Which stage it is, from 0.
    threads : int or None
    """

    splats: Splats
    members: NDArray[np.int64]
    sums: Array
    protected: NDArray[np.bool_]
    views: ViewSet
    scene: Scene
    penalty: float
    number: int
    threads: int | None

    def measured(self, progress: Progress) -> tuple[Index, MeasuredField]:
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

    def graph(self, measured: MeasuredField, whole: Array) -> MergeGraph:
        """Graph of measured splats; `whole` is `MeasuredField.seen_and_whole` of all splats."""
        return MergeGraph(measured.with_bias(whole), self.scene, self.penalty, threads=self.threads)


def reduced_at_once(stage: Stage, keep_count: int, progress: Progress) -> Reduced:
    """Reduce all splats to `keep_count`, or to more if more are protected."""
    rows, measured = stage.measured(part(progress, 0.0, 0.3))
    graph = stage.graph(measured, measured.seen_and_whole())
    del measured
    return reduced(stage, rows, graph, keep_count, part(progress, 0.3, 1.0))


def reduced(
    stage: Stage, rows: Index, graph: MergeGraph, keep_count: int, progress: Progress = silent
) -> Reduced:
    """Reduce splats by a graph: undrawable ones go first, then the graph's cheapest operations.

    Parameters
    ----------
    stage : Stage
    rows : (M,) int64
        Rows of the splats that the graph holds.
    graph : MergeGraph
        Its field is dropped.
    keep_count : int
    progress : callable
    """
    splats, members, sums = stage.splats, stage.members, stage.sums
    keep, threads = members > 0, graph.threads
    excess = max(int(np.count_nonzero(keep)) - keep_count, 0)
    others = keep & ~stage.protected
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
    """Copies of some splats as `Merged` has them: merged ones merge again, in float64.

    Of splats in files, more than a region go into files again.
    """
    if in_regions(splats, len(rows)):
        parts = chunks(len(rows), min(_CHUNK, len(rows) // 2))
        return on_disk(new_folder(splats), (copied(splats, rows[part]) for part in parts))
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
