"""Absorbing splats that no memory holds at once: region by region, stage by stage.

A stage divides all splats that are left into boxes of about equally many (`regions`), and absorbs
each by itself: what the views see of its splats, hidden by all others, is measured before. How many
of a region stay is decided by one ranking of all. The next stage divides along other planes, so
neighbours that a plane kept apart meet in the next stage. A splat is in one region in each stage.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from ..absorb_splats import PARTS
from ..absorbing import merge_field
from ..absorbing.absorb import ALONE, STAGE, Counts, mergeable, patience, reduced, stages
from ..absorbing.merge_field import Field, ViewSums
from ..absorbing.merge_graph import MergeGraph
from ..seeing.measuring import Measured
from ..splats import Splats, joined
from ..work import Progress, part, silent
from .seen import MeasuringTiles, StoredLines, place
from .workers import Call

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from numpy.typing import NDArray

    from ..scene import Scene
    from ..views import ViewSet
    from .folder import Folder
    from .scoring import Seen
    from .seen import SceneJob, Source
    from .workers import Workers

REGION = 1 << 20
"""Splats of a region at most; absorbing takes about 900 bytes of each."""

_FIELD = tuple(item.name for item in fields(Field))
_PRICED = ("allowed", "allowed_error", "first", "second", "cost")
_OVER = (*_FIELD, *_PRICED, "gathered", "whence", "stood", "may", "mass", "looks")
_SAMPLE = 1 << 14  # splats that decide along which axis a box is divided
_ASKEW = np.array([[2, -1, 2], [2, 2, -1], [-1, 2, 2]], np.float32) / np.float32(3.0)


@dataclass(frozen=True)
class Region:
    """The splats that are left in a region after a stage.

    Attributes
    ----------
    index : int
        Which one of all.
    count : int
    folder : Folder
        Of the stage.
    """

    index: int
    count: int
    folder: Folder

    def __len__(self) -> int:
        """Return the number of splats."""
        return self.count

    def splats(self) -> Splats:
        """Return its splats, in float64."""
        return unpacked(self.table())

    def table(self) -> NDArray[np.float64]:
        """Return its splats as one table, (n, 14 + 3 K), without reading it yet."""
        return self.folder.map(self.index, "splats")


@dataclass(frozen=True)
class AbsorbJob:
    """The steps of a stage; see `steps.Job`.

    Attributes
    ----------
    folder : Folder
        Of the stage.
    views : ViewSet
    scene : Scene
    sources : sequence of Source
        What the stage before left.
    starts : (sources + 1,) int64
        How many splats lie before each source, and all.
    factor : float
        On the cost of merging, see `absorb.patience`.
    """

    folder: Folder
    views: ViewSet
    scene: Scene
    sources: Sequence[Source]
    starts: NDArray[np.int64]
    factor: float

    def means(self, source: Source) -> None:
        """Write where the splats of a source are."""
        self.folder.save(source.index, {"means": np.asarray(source.splats().means, np.float32)})

    def gather(
        self, index: int, *, progress: Progress = silent, threads: int | None = 1
    ) -> NDArray[np.float64]:
        """Get a region ready to merge, but for the allowance, and write it.

        Parameters
        ----------
        index : int
            Which one. The folder has the rows of its splats among those of all sources, and what
            the views see of them.
        progress, threads

        Returns
        -------
        (2, 2) float64
            See `merge_field.Unallowed.seen_and_whole`.
        """
        name = f"{index:06d}.gather"
        return np.asarray(self.folder.once(name, lambda: self._ready(index, progress, threads)))

    def _ready(self, index: int, progress: Progress, threads: int | None) -> NDArray[np.float64]:
        rows, sums = self.folder.load(index, ("rows", "sums")).values()
        table, origin, members = self._gathered(rows)
        splats = unpacked(table)
        may = mergeable(splats, self.scene, np.zeros(len(rows), np.bool_))
        found = merge_field.unallowed(
            splats, may, self.views, self.scene, ViewSums(*sums),
            progress=progress, threads=threads,
        )  # fmt: skip
        arrays = {"gathered": table, "whence": origin, "stood": members, "may": may}
        arrays |= {"mass": found.mass, "looks": found.seen}
        self.folder.save(index, arrays | vars(found.field))
        return found.seen_and_whole()

    def price(
        self,
        index: int,
        whole: NDArray[np.float64],
        *,
        progress: Progress = silent,
        threads: int | None = 1,
    ) -> None:
        """Find what merging and deleting the splats of a region costs, and write it.

        Parameters
        ----------
        index : int
            Which one.
        whole : (2, 2) float64
            `seen_and_whole` of all regions together.
        progress, threads
        """
        name = f"{index:06d}.price"
        if self.folder.has(name):
            return
        own = self.folder.load(index, (*_FIELD, "mass", "looks"))
        field = Field(*(own[item] for item in _FIELD))
        bare = merge_field.Unallowed(field, own["mass"], own["looks"])
        graph = MergeGraph(bare.with_allowance(whole), self.scene, self.factor, threads=threads)
        graph.connect(progress)
        best, merges = graph.best()
        rows, may = self.folder.load(index, ("rows", "may")).values()
        costs, weights = np.full(len(rows), -1.0), np.ones(len(rows), np.float32)
        # What cannot be drawn goes first; of two splats that merge, one goes.
        costs[may], weights[may] = best, np.where(merges, np.float32(0.5), np.float32(1.0))
        arrays: dict[str, NDArray[Any]] = {"first": graph.first, "second": graph.second}
        arrays |= {"cost": graph.cost, "allowed": graph.field.contribution}
        arrays |= {"allowed_error": graph.field.error}
        self.folder.save(index, arrays | {"costs": costs, "weights": weights})
        self.folder.note(name, None)

    def absorb(
        self, index: int, count: int, *, progress: Progress = silent, threads: int | None = 1
    ) -> int:
        """Absorb a region down to `count` splats, and write it; return how many survived."""
        name = f"{index:06d}.absorb"
        left = self.folder.once(name, lambda: self._absorbed(index, count, progress, threads))
        self.folder.drop(index, _OVER)
        return int(left)

    def _absorbed(
        self, index: int, count: int, progress: Progress, threads: int | None
    ) -> NDArray[np.int64]:
        own = self.folder.load(index, ("gathered", "whence", "stood", "may", "sums"))

        def graph() -> MergeGraph:
            made = self.folder.load(index, (*_FIELD, *_PRICED)).values()
            *field, contribution, error, first, second, cost = made
            return MergeGraph.connected_by(
                replace(Field(*field), contribution=contribution, error=error),
                self.scene, self.factor, (first, second, cost), threads=threads,
            )  # fmt: skip

        with np.errstate(under="ignore"):
            left, keep, taken, expected = reduced(
                unpacked(own["gathered"]), ViewSums(*own["sums"]), own["may"], graph, count,
                protected=np.zeros(len(own["whence"]), np.bool_), progress=progress,
            )  # fmt: skip
        stands = taken >= 0
        total = np.bincount(taken[stands], own["stood"][stands], len(left)).astype(np.int64)
        made = {"splats": packed(left), "origin": own["whence"][keep], "members": total}
        made["expected"] = np.array([expected.contribution, expected.error])
        self.folder.save(index, made)
        return np.array(len(left))

    def _gathered(
        self, rows: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
        """Return the table of some rows, ascending, and of each its first row and its members."""
        parts, origins, members = [], [], []
        edges = np.searchsorted(rows, self.starts)
        for number, source in enumerate(self.sources):
            mine = rows[edges[number] : edges[number + 1]] - self.starts[number]
            if not len(mine):
                continue
            parts.append(source.splats().take(mine))
            if isinstance(source, Region):
                found = source.folder.load(source.index, ("origin", "members"))
                origins.append(found["origin"][mine])
                members.append(found["members"][mine])
            else:
                origins.append(mine + self.starts[number])
                members.append(np.ones(len(mine), np.int64))
        return packed(joined(parts)), np.concatenate(origins), np.concatenate(members)


@dataclass(frozen=True, eq=False)
class Survivors(Counts):
    """What is left of N splats.

    Attributes
    ----------
    regions : sequence of Region
    origin : (K,) int64
        Rows of the survivors among the N, region by region, in no order.
    changed : (K,) bool
        Which of them absorbed others.
    merged, deleted : int
        See `absorb.Absorbed`.
    """

    regions: Sequence[Region]
    origin: NDArray[np.int64]
    changed: NDArray[np.bool_]
    merged: int
    deleted: int


def absorb(
    found: Seen,
    rest: NDArray[np.bool_],
    goal: int,
    *,
    workers: Workers,
    progress: Progress = silent,
) -> Survivors:
    """Reduce splats to `goal` by the merges and deletions that cost the pictures least.

    Parameters
    ----------
    found : Seen
        What the views see of all N splats.
    rest : (N,) bool
        Which of them are left.
    goal : int
        How many survive.
    workers, progress : callable
        See `prune.prune_tiles`.

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.

    Notes
    -----
    Memory of this process: about 150 bytes a splat; of a worker: see `REGION`.
    """
    count, total = int(np.count_nonzero(rest)), len(rest)
    factor = patience(1.0 - goal / max(count, 1))
    # Several regions need another stage, with other borders, where a single one does not.
    left_after = stages(count, goal, ALONE if count <= REGION else STAGE)
    sources: Sequence[Source] = found.sources
    regions_left: list[Region] = []
    rows = np.flatnonzero(rest)  # (n,), among those of all sources
    origin, members = rows, np.ones(count, np.int64)
    now = found.measured.take(rows)
    for stage, left in enumerate(left_after):
        ahead = part(progress, stage / len(left_after), (stage + 1) / len(left_after))
        own = found.job.folder.inner(f"stage-{stage}")
        starts = np.cumsum([0, *map(len, sources)])
        if stage:
            seen = replace(found.job, folder=own.inner("seen"))
            now = _measure(seen, sources, now, stage - 1, workers, part(ahead, 0.0, 0.5))
        job = AbsorbJob(own, found.job.views, found.job.scene, sources, starts, factor)
        for _ in workers(job, [Call("means", (s,), 1 / len(sources)) for s in sources], silent, ""):
            pass
        means = np.concatenate([own.map(source.index, "means")[:] for source in sources])[rows]
        pieces = regions(means, REGION, stage)
        for index, piece in enumerate(pieces):
            sums = np.array([now.contribution[piece], now.error[piece]])
            own.save(index, {"rows": rows[piece], "sums": sums})
        stay = _staying(job, [len(piece) for piece in pieces], left, workers, part(ahead, 0.5, 0.8))
        calls = [
            Call("absorb", (index, count), count / left, chunked=True)
            for index, count in enumerate(stay)
        ]
        sizes = workers(job, calls, part(ahead, 0.8, 1.0), "absorbing")
        sources = regions_left = [Region(index, size, own) for index, size in enumerate(sizes)]
        origin, members = (
            np.concatenate([own.load(source.index, [name])[name] for source in sources])
            for name in ("origin", "members")
        )
        sums = np.concatenate([own.load(s.index, ["expected"])["expected"] for s in sources], 1)
        now = Measured(sums[0], sums[1], np.zeros(len(origin), np.int32))
        rows = np.arange(len(origin))
    merged = int(members.sum()) - len(origin)
    return Survivors(regions_left, origin, members > 1, merged, total - len(origin) - merged)


def _staying(
    job: AbsorbJob, sizes: Sequence[int], left: int, workers: Workers, progress: Progress
) -> list[int]:
    """Return how many splats of each region stay, of `left` that do of all.

    As many go as a region has among the cheapest merges and deletions of all.

    Parameters
    ----------
    job : AbsorbJob
    sizes : sequence of int
        Splats of each region.
    left : int
    workers, progress : callable
    """
    total = sum(sizes)
    calls = [Call("gather", (k,), n / total, chunked=True) for k, n in enumerate(sizes)]
    whole = np.sum([*workers(job, calls, part(progress, 0.0, 0.4), "absorbing")], axis=0)
    calls = [Call("price", (k, whole), n / total, chunked=True) for k, n in enumerate(sizes)]
    for _ in workers(job, calls, part(progress, 0.4, 1.0), "absorbing"):
        pass
    own = [job.folder.load(k, ("costs", "weights")) for k in range(len(sizes))]
    costs = np.concatenate([arrays["costs"] for arrays in own])
    weights = np.concatenate([arrays["weights"] for arrays in own])
    order = np.argsort(costs, kind="stable")
    last = int(np.searchsorted(np.cumsum(weights[order], dtype=np.float64), total - left))
    weights[order[last + 1 :]] = 0.0
    ends = np.cumsum(sizes)
    gone = np.cumsum([piece.sum(dtype=np.float64) for piece in np.split(weights, ends[:-1])])
    # Rounded so that the sum is exact: each gets what is added up to its end.
    gone = np.rint(gone * ((total - left) / gone[-1])).astype(np.int64)
    return [size - int(go) for size, go in zip(sizes, np.diff(gone, prepend=0), strict=True)]


def estimated(
    found: Seen, survivors: Survivors, workers: Workers, progress: Progress
) -> float | None:
    """Return the estimated PSNR of survivors, dB; None if too little is seen."""
    sights, last = found.scores.ray_sample, survivors.regions[0].folder
    assert isinstance(sights, StoredLines)  # noqa: S101 - as `Seen` has
    job = replace(found.job, folder=last.inner("after"))
    gaussians, _ = place(job, survivors.regions, workers, part(progress, 0.0, 0.5))
    after = StoredLines(job, workers, survivors.regions, gaussians)
    return sights.against_stored(after, part(progress, 0.5, 1.0))


def _measure(
    job: SceneJob,
    sources: Sequence[Source],
    expected: Measured,
    turn: int,
    workers: Workers,
    progress: Progress,
) -> Measured:
    """Measure all splats in a part of the views, and add what the others are expected to see.

    Parameters
    ----------
    job : SceneJob
    sources : sequence of Source
    expected : Measured
        Of all splats, as far as the measuring before tells.
    turn : int
        See `occlusion.measure_part`.
    workers, progress : callable
    """
    gaussians, good = place(job, sources, workers, part(progress, 0.0, 0.2))
    measuring = MeasuringTiles(job, workers)
    which = measuring.groups_of_part(turn, PARTS)
    found = measuring.measure(gaussians, which, part(progress, 0.2, 1.0))  # type: ignore[arg-type]
    every = Measured.sum(found.values()).for_all(gaussians.index, len(good))
    others = 1.0 - measuring.weight_share(which)
    every.contribution[:] += others * expected.contribution
    every.error[:] += others * expected.error
    return every


def regions(means: NDArray[np.float32], most: int, stage: int) -> list[NDArray[np.int64]]:
    """Divide splats into boxes of about equally many, by planes at right angles to where they vary.

    Parameters
    ----------
    means : (n, 3) float32
        Where they are; what is not finite counts as the origin.
    most : int
        How many there may be in a box.
    stage : int
        In every other stage the planes lie askew.

    Returns
    -------
    list of (m,) int64
        Rows of each box, ascending.
    """
    place = np.where(np.isfinite(means).all(axis=1, keepdims=True), means, np.float32(0.0))
    place = place @ (_ASKEW if stage % 2 else np.eye(3, dtype=np.float32))
    return _divided(place, np.arange(len(means)), -(-len(means) // most))


def _divided(
    place: NDArray[np.float32], rows: NDArray[np.int64], count: int
) -> list[NDArray[np.int64]]:
    """Divide some rows of places into `count` boxes."""
    if count <= 1:
        return [rows]
    some = place[rows[:: max(len(rows) // _SAMPLE, 1)]]
    low, high = np.quantile(some, (0.05, 0.95), axis=0)
    along = place[rows, int(np.argmax(high - low))]
    less = count // 2
    order = np.argpartition(along, len(rows) * less // count)
    cut = len(rows) * less // count
    one, other = np.sort(rows[order[:cut]]), np.sort(rows[order[cut:]])
    return _divided(place, one, less) + _divided(place, other, count - less)


def packed(splats: Splats) -> NDArray[np.float64]:
    """Return splats as one table, (n, 14 + 3 K)."""
    count = len(splats)
    columns = [splats.means, splats.log_scales, splats.quaternions]
    columns += [splats.opacity_logits[:, None], splats.sh_dc, splats.sh_rest.reshape(count, -1)]
    with np.errstate(invalid="ignore"):  # signalling NaN
        return np.concatenate([np.asarray(values, np.float64) for values in columns], axis=1)


def unpacked(table: NDArray[np.float64]) -> Splats:
    """Return the splats of a table."""
    means, scales, quaternions, logits, constant, rest = np.split(table, [3, 6, 10, 11, 14], axis=1)
    harmonics = rest.reshape(len(table), rest.shape[1] // 3, 3)
    return Splats(means, scales, quaternions, logits[:, 0], constant, harmonics)
