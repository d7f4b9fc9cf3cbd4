"""Absorbing splats that no memory holds at once: region by region, stage by stage.

A stage divides all splats that are left into boxes of about equally many (`regions`), and absorbs
each by itself: what the views see of its splats, hidden by all others, is measured before. How many
of a region stay is decided by one ranking of all. The next stage divides along other planes, so
neighbours that a plane kept apart meet in the next stage. A splat is in one region in each stage.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..absorbing.absorb import Counts, absorb_once, patience, stages
from ..absorbing.merging import ViewSums
from ..pipeline import PARTS
from ..scoring.measuring import Measured
from ..splats import Splats
from ..work import Progress, part, silent
from .seen import MeasuringTiles, StoredLines, place
from .workers import Call

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from ..scene import Scene
    from ..views import ViewSet
    from .folder import Folder
    from .scoring import Seen
    from .seen import SceneJob, Source
    from .workers import Workers

REGION = 1 << 20
"""Splats of a region at most; absorbing takes about 900 bytes of each."""

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

    def absorb(
        self, index: int, count: int, *, progress: Progress = silent, threads: int | None = 1
    ) -> int:
        """Absorb a region, and write it.

        Parameters
        ----------
        index : int
            Which one. The folder has the rows of its splats among those of all sources, and what
            the views see of them.
        count : int
            How many are to survive.
        progress, threads

        Returns
        -------
        int
            How many survived.
        """
        name = f"{index:06d}.absorb"
        done, result = self.folder.noted(name)
        if not done:
            rows, sums = self.folder.load(index, ("rows", "sums")).values()
            splats, origin, members = self._gathered(rows)
            with np.errstate(under="ignore"):
                left, keep, taken, expected = absorb_once(
                    splats, self.views, self.scene, ViewSums(*sums), count,
                    protected=np.zeros(len(rows), np.bool_), factor=self.factor,
                    progress=progress, threads=threads,
                )  # fmt: skip
            stands = taken >= 0
            total = np.bincount(taken[stands], members[stands], len(left)).astype(np.int64)
            made = {"splats": _packed(left), "origin": origin[keep], "members": total}
            made["expected"] = np.array([expected.contribution, expected.error])
            self.folder.save(index, made)
            result = np.array(len(left))
            self.folder.note(name, result)
        return int(result)

    def _gathered(
        self, rows: NDArray[np.int64]
    ) -> tuple[Splats, NDArray[np.int64], NDArray[np.int64]]:
        """Return the splats of some rows, ascending, and of each its first row and its members."""
        parts, origins, members = [], [], []
        edges = np.searchsorted(rows, self.starts)
        for number, source in enumerate(self.sources):
            mine = rows[edges[number] : edges[number + 1]] - self.starts[number]
            if not len(mine):
                continue
            parts.append(_packed(source.splats().take(mine)))
            if isinstance(source, Region):
                found = source.folder.load(source.index, ("origin", "members"))
                origins.append(found["origin"][mine])
                members.append(found["members"][mine])
            else:
                origins.append(mine + self.starts[number])
                members.append(np.ones(len(mine), np.int64))
        width = max(array.shape[1] for array in parts)
        whole = np.concatenate([_widened(array, width) for array in parts])
        return unpacked(whole), np.concatenate(origins), np.concatenate(members)


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
    factor, left_after = patience(1.0 - goal / max(count, 1)), stages(count, goal)
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
        go = np.argsort(found.worth(now, origin), kind="stable")[: len(rows) - left]
        gone = np.zeros(len(rows), np.bool_)
        gone[go] = True
        calls = []
        for index, piece in enumerate(pieces):
            sums = np.array([now.contribution[piece], now.error[piece]])
            own.save(index, {"rows": rows[piece], "sums": sums})
            stay = len(piece) - int(np.count_nonzero(gone[piece]))
            calls.append(Call("absorb", (index, stay), len(piece) / len(rows), chunked=True))
        sizes = workers(job, calls, part(ahead, 0.5, 1.0), "absorbing")
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


def estimated(
    found: Seen, survivors: Survivors, workers: Workers, progress: Progress
) -> float | None:
    """Return the estimated PSNR of survivors, dB; None if too little is seen."""
    sights, last = found.scores.sights, survivors.regions[0].folder
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
    parts = min(PARTS, measuring.count)
    which = range(turn % parts, measuring.count, parts)
    nobody = np.empty(0, np.int64)
    found, _ = measuring.blocks(gaussians, nobody, part(progress, 0.2, 1.0), which)
    every = Measured.sum(found.values()).for_all(gaussians.index, len(good))
    others = 1.0 - measuring.share(which)
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


def _packed(splats: Splats) -> NDArray[np.float64]:
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


def _widened(table: NDArray[np.float64], width: int) -> NDArray[np.float64]:
    """Return a table with zeros for the harmonics that it lacks."""
    return np.pad(table, ((0, 0), (0, width - table.shape[1])))
