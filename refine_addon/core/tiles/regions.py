"""What a worker does to absorb: with a region of a stage, or at once with all that are left."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..merging.field import Field, MeasuredField, measured_field
from ..merging.graph import MergeGraph
from ..merging.merge import mergeable, reduced
from ..operation.run import Runtime
from ..pipeline.absorb_splats import absorb_removed
from ..rendering import MODELS
from ..scores import Scores
from ..splats import Splats, joined
from ..task import Settings
from ..views import ViewSet
from ..visibility.measuring import Measured
from ..visibility.scene import Scene
from .folder import Folder
from .selecting import save_kept
from .units import Source, Unit, packed, unpacked

SURVIVORS = ("survivors", "places", "changed")
"""Names of what is noted of survivors: their rows among all splats, ascending; where each is among
those of all regions; and whether it changed."""

_FIELD = tuple(item.name for item in fields(Field))
_PRICED = ("allowed", "allowed_error", "first", "second", "cost")
_GATHERED = ("gathered", "gathered_origin", "gathered_members", "mergeable")
_NEEDED_NO_MORE = (*_FIELD, *_PRICED, *_GATHERED, "mass", "seen_by")


@dataclass(frozen=True)
class Region:
    """The splats that are left in a region after a stage: a `Source` of the next."""

    index: int
    count: int
    folder: Folder

    def __len__(self) -> int:
        """Return the number of splats."""
        return self.count

    def splats(self) -> Splats:
        """Return its splats, without reading them yet."""
        return unpacked(self.table())

    def table(self) -> NDArray[np.float64]:
        """Return its splats as one table, (n, 14 + 3 K), without reading it yet."""
        return self.folder.map(self.index, "splats")


@dataclass(frozen=True)
class StageContext:
    """What all steps of a stage need.

    The folder is that of the stage. It has for each region ``rows``, those of its splats among the
    rows of all sources, ascending, and ``sums``, what the views see of them: see `Field`.
    """

    folder: Folder
    views: ViewSet
    scene: Scene
    sources: Sequence[Source]  # what the stage before left
    factor: float = 1.0  # on the cost of merging, priced by regions: see `merge.merge_penalty`

    def gathered(
        self, rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
        """Return the table of some rows, ascending, and of each splat its origin and its members.

        Those are the row of the original splat that it was, and how many originals it stands for.
        """
        tables, origins, members = [], [], []
        starts = np.cumsum([0, *map(len, self.sources)])
        edges = np.searchsorted(rows, starts)
        for number, source in enumerate(self.sources):
            places = rows[edges[number] : edges[number + 1]] - starts[number]
            if not len(places):
                continue
            tables.append(source.splats().take(places))
            if isinstance(source, Region):
                arrays = source.folder.load(source.index, ("origin", "members"))
                origins.append(arrays["origin"][places])
                members.append(arrays["members"][places])
            else:
                origins.append(places + starts[number])
                members.append(np.ones(len(places), np.int64))
        return packed(joined(tables)), np.concatenate(origins), np.concatenate(members)


MEANS = "source_means"
"""Means of a source; the field of a region has means too, and may have the same number."""


@dataclass(frozen=True)
class SaveMeans:
    """Saves where the splats of a source are."""

    source: Source

    def run(self, context: StageContext, _runtime: Runtime) -> None:
        """Save the means, in float32."""
        means = np.asarray(self.source.splats().means, np.float32)
        context.folder.save(self.source.index, {MEANS: means})


@dataclass(frozen=True)
class GatherRegion:
    """Gets a region ready to merge, but for the bias."""

    index: int

    def run(self, context: StageContext, runtime: Runtime) -> NDArray[np.float64]:
        """Save the region; return `MeasuredField.seen_and_whole`, (2, 2)."""
        name = f"{self.index:06d}.gathered"
        sums = context.folder.once(name, lambda: self._gathered(context, runtime))
        return np.asarray(sums)

    def _gathered(self, context: StageContext, runtime: Runtime) -> NDArray[np.float64]:
        rows, sums = context.folder.load(self.index, ("rows", "sums")).values()
        table, origin, members = context.gathered(rows)
        splats = unpacked(table)
        places = mergeable(splats, context.scene, np.zeros(len(rows), np.bool_))
        measured = measured_field(
            splats, places, context.views, context.scene, sums,
            progress=runtime.progress, threads=runtime.threads,
        )  # fmt: skip
        arrays = dict(zip(_GATHERED, (table, origin, members, places), strict=True))
        arrays |= {"mass": measured.mass, "seen_by": measured.seen}
        number = {"model": np.array(MODELS.index(splats.model))}
        context.folder.save(self.index, arrays | vars(measured.field) | number)
        return measured.seen_and_whole()


@dataclass(frozen=True)
class PriceRegion:
    """Finds what merging and deleting the splats of a region costs."""

    index: int
    whole: NDArray[np.float64]  # what `GatherRegion` returns, of all regions together

    def run(self, context: StageContext, runtime: Runtime) -> None:
        """Save the graph, and of each splat the cost of its cheapest operation and its weight."""
        name = f"{self.index:06d}.priced"
        context.folder.once(name, lambda: self._price(context, runtime))

    def _price(self, context: StageContext, runtime: Runtime) -> None:
        folder = context.folder
        arrays = folder.load(self.index, (*_FIELD, "mass", "seen_by", "rows", "mergeable"))
        field = _field(*(arrays[name] for name in _FIELD))
        measured = MeasuredField(field, arrays["mass"], arrays["seen_by"])
        graph = MergeGraph(
            measured.with_bias(self.whole), context.scene, context.factor,
            threads=runtime.threads,
        )  # fmt: skip
        graph.connect(runtime.progress)
        best, merges = graph.best()
        costs = np.full(len(arrays["rows"]), -1.0)  # what cannot be drawn goes first
        weights = np.ones(len(costs), np.float32)
        costs[arrays["mergeable"]] = best
        # Of two splats that merge, one goes.
        weights[arrays["mergeable"]] = np.where(merges, np.float32(0.5), np.float32(1.0))
        priced = (
            graph.field.contribution, graph.field.error, graph.first, graph.second, graph.cost
        )  # fmt: skip
        folder.save(self.index, dict(zip(_PRICED, priced, strict=True)))
        folder.save(self.index, {"costs": costs, "weights": weights})


@dataclass(frozen=True)
class AbsorbRegion:
    """Absorbs a region down to `count` splats."""

    index: int
    count: int

    def run(self, context: StageContext, runtime: Runtime) -> int:
        """Save the survivors, unless that is done; return how many there are."""
        name = f"{self.index:06d}.absorbed"
        left = context.folder.once(name, lambda: self._absorbed(context, runtime))
        context.folder.drop(self.index, _NEEDED_NO_MORE)
        return int(left)

    def _absorbed(self, context: StageContext, runtime: Runtime) -> NDArray[np.int64]:
        folder = context.folder
        arrays = folder.load(self.index, (*_GATHERED, "sums"))
        graph = self._graph(context, runtime.threads)
        protected = np.zeros(len(arrays["gathered"]), np.bool_)
        with np.errstate(under="ignore"):
            left, keep, members, expected = reduced(
                unpacked(arrays["gathered"]), arrays["gathered_members"],
                np.asarray(arrays["sums"], np.float64), arrays["mergeable"], graph, self.count,
                protected=protected, progress=runtime.progress,
            )  # fmt: skip
        survivors = {"splats": packed(left), "origin": arrays["gathered_origin"][keep]}
        folder.save(self.index, survivors | {"members": members, "expected": expected})
        return np.array(len(left))

    def _graph(self, context: StageContext, threads: int | None) -> MergeGraph:
        """Return the graph that `PriceRegion` saved."""
        priced = context.folder.load(self.index, (*_FIELD, *_PRICED)).values()
        *field, contribution, error, first, second, cost = priced
        return MergeGraph(
            replace(_field(*field), contribution=contribution, error=error),
            context.scene, context.factor, (first, second, cost), threads=threads,
        )  # fmt: skip


def _field(*arrays: NDArray[Any]) -> Field:
    """Return a field from its arrays as they are saved; the last is the number of the model."""
    *values, number = arrays
    named: dict[str, Any] = dict(zip(_FIELD, values, strict=False))
    return Field(**named, model=MODELS[int(number)])


@dataclass(frozen=True)
class AbsorbAtOnce:
    """Absorbs all splats that are left, of which there is one region, as in memory."""

    goal: int
    total: int  # before some of them were deleted
    settings: Settings

    def run(self, context: StageContext, runtime: Runtime) -> tuple[int, int]:
        """Save the survivors, unless that is done; return how many there are, and were merged."""
        once = context.folder.once
        left, merged = once("000000.absorbed", lambda: self._absorbed(context, runtime))
        return int(left), int(merged)

    def _absorbed(self, context: StageContext, runtime: Runtime) -> NDArray[np.int64]:
        rows, sums = context.folder.load(0, ("rows", "sums")).values()
        splats = unpacked(context.gathered(rows)[0])
        none = np.zeros(len(rows), np.int32)
        # Nothing is deleted by these scores any more: `total` says that it has been.
        values, views = none.astype(np.float32), context.views
        scores = Scores(values, none, len(views), 0, {}, method="occlusion")
        absorbed = absorb_removed(
            splats, views, self.goal, self.settings,
            known=(scores, Measured(sums[0], sums[1], none)), began=self.total,
            progress=runtime.progress, threads=runtime.threads,
        )  # fmt: skip
        arrays = {"splats": packed(absorbed.splats), "origin": rows[absorbed.keep]}
        context.folder.save(0, arrays | {"changed": absorbed.changed})
        return np.array([len(absorbed.splats), absorbed.merged])


@dataclass(frozen=True)
class SettleUnit:
    """Notes which splats of a unit survive absorbing, and what those became that changed."""

    unit: Unit
    begin: int  # how many splats lie before it
    regions: Sequence[Region]  # where the survivors are

    def run(self, folder: Folder, _runtime: Runtime) -> NDArray[np.int64]:
        """Note them; return what `save_kept` returns."""
        origin, place, changed = (folder.mapped(name) for name in SURVIVORS)
        end = self.begin + len(self.unit)
        here = slice(*np.searchsorted(origin, (self.begin, end)).tolist())
        rows, changed_here = origin[here] - self.begin, changed[here]
        keep = np.zeros(len(self.unit), np.bool_)
        keep[rows] = True
        became = packed(taken(self.regions, place[here][changed_here]))
        folder.save(self.unit.index, {"changed": rows[changed_here], "became": became})
        return save_kept(self.unit, folder, keep)


def taken(regions: Sequence[Region], rows: NDArray[np.int64]) -> Splats:
    """Return some splats of all regions, by their rows among those, (n,).

    Of a degree that holds the numbers of all regions that they lie in.
    """
    begins, order = np.cumsum([0, *map(len, regions)]), np.argsort(rows, kind="stable")
    edges = np.searchsorted(rows[order], begins)
    pieces = [
        unpacked(region.table()[rows[order[start:stop]] - begin])
        for region, begin, (start, stop) in zip(
            regions, begins.tolist(), itertools.pairwise(edges.tolist()), strict=False
        )
        if stop > start
    ]
    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    return joined(pieces).take(back) if pieces else unpacked(np.empty((0, 14)))
