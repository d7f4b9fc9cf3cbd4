"""What views see of splats that no memory holds at once, hidden by one another.

The splats are activated unit by unit, and stored along a Z-shaped curve, so that a chunk of them is
a box in space. A view loads the chunks that may reach into its image, and looks at their footprints
together, as in memory: what it finds is the same to the bit, wherever the tiles were cut.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ..estimate.psnr import mean_psnr
from ..processes import for_each
from ..scene import code_order, moments, spatial_code, splat_fingerprint
from ..seeing import projection
from ..seeing.cast import cast
from ..seeing.measuring import SECONDS, Measured, Measuring, measure_footprints
from ..seeing.projection import Gaussians
from ..seeing.ray_sample import RaySample, cast_view
from ..seeing.rays import Rays
from ..splats import drawable, joined
from ..work import Progress, part, silent
from .workers import Call

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from ..scene import Scene
    from ..seeing.measuring import Sampling, ViewMeasurement
    from ..splats import Splats
    from ..views import View, ViewSet
    from .folder import Folder
    from .workers import Workers

CHUNK = 1 << 16
"""Splats of a chunk, 3.7 MB."""

_MEANS, _COVARIANCES, _LARGEST, _ALPHAS, _COLORS = slice(3), slice(3, 9), 9, 10, slice(11, 14)
"""Rows of a chunk, (14, n) float32: see `Gaussians`."""


class Source(Protocol):
    """A run of the rows of all splats."""

    @property
    def index(self) -> int:
        """Which one of all."""
        ...

    def __len__(self) -> int:
        """Return the number of rows."""
        ...

    def splats(self) -> Splats:
        """Return its splats."""
        ...


@dataclass(frozen=True)
class SceneJob:
    """Steps that find out what views see of all splats; see `steps.Job`.

    Attributes
    ----------
    folder : Folder
        Of its own.
    views : ViewSet
    sampling : Sampling
    scene : Scene
    """

    folder: Folder
    views: ViewSet
    sampling: Sampling
    scene: Scene

    def moments(self, source: Source) -> NDArray[np.float64]:
        """Return `scene.moments` of a source, (pieces, 4, 3)."""
        splats = source.splats()
        with np.errstate(under="ignore"):
            found = [*moments(splats.means, drawable(splats), self.scene)]
        return np.reshape(found, (-1, 4, 3))

    def place(
        self, source: Source, *, progress: Progress = silent, threads: int | None = 1
    ) -> tuple[int, int]:
        """Activate a source; return how many of it can be drawn, and how many any view may show."""
        good, near = self.folder.once(
            f"{source.index:06d}.place", lambda: self._placed(source, progress, threads)
        )
        return int(good), int(near)

    def _placed(self, source: Source, progress: Progress, threads: int | None) -> NDArray[np.int64]:
        splats = source.splats()
        good, opaque = projection.judge(splats, threads=threads)
        with np.errstate(under="ignore"):
            rows, place = projection.near(splats, opaque, self.scene)
            found = projection.activate(splats, rows, place, self.scene, progress, threads)
            code = spatial_code(place)
        packed = np.empty((len(rows), 14), np.float32)
        packed[:, _MEANS], packed[:, _COVARIANCES] = found.means.T, found.covariances.T
        packed[:, _LARGEST], packed[:, _ALPHAS] = found.largest, found.alphas
        packed[:, _COLORS] = found.colors
        arrays = {"good": good, "rows": rows, "code": code, "gaussians": packed}
        arrays["ties"] = splat_fingerprint(splats, rows)
        self.folder.save(source.index, arrays)
        return np.array([np.count_nonzero(good), len(rows)])

    def gather(self, number: int, starts: NDArray[np.int64]) -> NDArray[np.float32]:
        """Write a chunk.

        Parameters
        ----------
        number : int
            Which one.
        starts : (sources + 1,) int64
            How many Gaussians the sources before each have, and all.

        Returns
        -------
        (7,) float32
            Its box, see `projection.boxes_touch`.
        """
        box = self.folder.once(f"{number:06d}.gather", lambda: self._gathered(number, starts))
        return np.asarray(box, np.float32)

    def _gathered(self, number: int, starts: NDArray[np.int64]) -> NDArray[np.float32]:
        order = self.folder.mapped("order")[number * CHUNK : (number + 1) * CHUNK]
        source = np.searchsorted(starts, order, side="right") - 1
        packed = np.empty((14, len(order)), np.float32)
        for index in np.unique(source).tolist():
            here = np.flatnonzero(source == index)
            rows = self.folder.map(index, "gaussians")
            packed[:, here] = rows[order[here] - starts[index]].T
        self.folder.save(number, {"chunk": packed})
        means = packed[_MEANS]
        return np.concatenate([means.min(axis=1), means.max(axis=1), [packed[_LARGEST].max()]])

    def look(
        self,
        block: int,
        numbers: list[int],
        kinds: list[bool],
        *,
        progress: Progress = silent,
        threads: int | None = 1,
    ) -> None:
        """Measure what a block of views sees of the splats, and note what their lines meet.

        Parameters
        ----------
        block : int
            Its number.
        numbers : list of int
            Of its views, in the order of `ViewSet.by_distance`.
        kinds : list of bool
            Of the rays to cast: whether they are scoring rays, see `RaySample`.
        progress, threads
        """
        name = seen_name(block)
        if self.folder.has(name):
            return
        sample, count = self.folder.noted("sample")[1], int(self.folder.noted("count")[1])
        total, errors = Measured.zero(count), []
        found = for_each(
            _Looking(self, numbers, kinds), len(numbers), SECONDS * count * len(numbers),
            progress=progress, what="scoring", threads=threads,
        )  # fmt: skip
        for seen, weight in found:
            before = total.error[sample]
            total.add_view(seen, weight)
            errors.append(total.error[sample] - before)
        self.folder.note(name, (total.contribution, total.error, total.seen, np.array(errors)))

    def measure_view(self, number: int, kinds: list[bool]) -> tuple[ViewMeasurement, float]:
        """Return what a view sees of the splats, and its weight; note its lines."""
        view, weight = self.views.by_distance()[number]
        footprints, colors = self._footprints(view)
        for ranking in kinds:
            self._note_lines(number, footprints, scoring=ranking)
        return measure_footprints(footprints, colors, view, self.sampling), weight

    def meet(self, number: int, pixels: tuple[NDArray[np.int64], ...] | None = None) -> None:
        """Note what the lines of sight of a view meet.

        Parameters
        ----------
        number : int
            Of the view.
        pixels : (C,), (R,) int64, optional
            Columns and rows that the lines go through, if they are not to be chosen.
        """
        view, _ = self.views.by_distance()[number]
        self._note_lines(number, self._footprints(view)[0], pixels)

    def _note_lines(
        self,
        number: int,
        footprints: projection.Footprints,
        pixels: tuple[NDArray[np.int64], ...] | None = None,
        *,
        scoring: bool = False,
    ) -> None:
        name = lines_name(number, scoring=scoring)
        if self.folder.has(name):
            return
        with np.errstate(under="ignore"):
            if pixels is None:
                rays = cast_view(self.views.by_distance(), number, footprints, scoring=scoring)
            else:
                rays = cast(footprints, *pixels)
        self.folder.note(name, tuple(vars(rays).values()))

    def pick(self, source: Source, rows: NDArray[np.int64]) -> Splats:
        """Return some splats of a source."""
        return source.splats().take(rows)

    def _footprints(self, view: View) -> tuple[projection.Footprints, NDArray[np.float32]]:
        """Return the n footprints in a view, front to back, and their colours, (n, 3)."""
        found, colors = [], [np.empty((0, 3), np.float32)]
        boxes = self.folder.noted("boxes")[1]
        with np.errstate(under="ignore"):
            for number in np.flatnonzero(projection.boxes_touch(boxes, self.scene, view)).tolist():
                chunk = self._chunk(number)
                some, depth = projection.reaching(chunk, self.scene, view)
                found.append((replace(some, index=some.index + number * CHUNK), depth))
                colors.append(chunk.colors[some.index])
            footprints = projection.front_to_back(found)
        # Ascending, since chunks are.
        rows = np.concatenate([np.empty(0, np.int64), *(some.index for some, _ in found)])
        at = np.searchsorted(rows, footprints.index)
        return footprints, np.concatenate(colors)[at]

    def _chunk(self, number: int) -> Gaussians:
        """Return the Gaussians of a chunk."""
        whole = self.folder.load(number, ["chunk"])["chunk"]
        return Gaussians(
            np.arange(whole.shape[1]), whole[_MEANS], whole[_COVARIANCES], whole[_LARGEST],
            whole[_ALPHAS], np.ascontiguousarray(whole[_COLORS].T),
        )  # fmt: skip


def lines_name(number: int, *, scoring: bool = False) -> str:
    """Return under which name the lines of sight of a view are noted."""
    return f"{'scoring' if scoring else 'validation'}-rays-{number:06d}"


def seen_name(block: int) -> str:
    """Return under which name a block of views notes what it sees."""
    return f"{block}.seen"


class Stored(Mapping[int, Measured]):
    """Sums of blocks of views, in a folder.

    Parameters
    ----------
    folder : Folder
    blocks : iterable of int
        The numbers of those that lie there.
    """

    def __init__(self, folder: Folder, blocks: Iterable[int]) -> None:
        self._folder, self._blocks = folder, [*blocks]

    def __getitem__(self, block: int) -> Measured:
        """Return the sums of a block."""
        return Measured(*self._folder.noted(seen_name(block))[1][:3])

    def __iter__(self) -> Iterator[int]:
        """Return the numbers of the blocks."""
        return iter(self._blocks)

    def __len__(self) -> int:
        """Return how many blocks there are."""
        return len(self._blocks)


class Placed:
    """All splats as `Gaussians`, in a folder.

    Parameters
    ----------
    folder : Folder
    index : (M,) int64
        Rows of the splats, see `Gaussians`.

    Attributes
    ----------
    index : (M,) int64
    """

    def __init__(self, folder: Folder, index: NDArray[np.int64]) -> None:
        self.index, self._folder = index, folder
        folder.note("count", np.array(len(index)))

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self.index)

    @property
    def alphas(self) -> NDArray[np.float32]:
        """Opacities of all, (M,)."""
        return np.concatenate([chunk[_ALPHAS] for chunk in self._chunks()])

    @property
    def colors(self) -> NDArray[np.float32]:
        """Colours of all, (M, 3)."""
        return np.concatenate([chunk[_COLORS].T for chunk in self._chunks()])

    def _chunks(self) -> Iterator[NDArray[np.float32]]:
        yield np.empty((14, 0), np.float32)
        for number in range(-(-len(self) // CHUNK)):
            yield self._folder.map(number, "chunk")


@dataclass(frozen=True)
class _Looking:
    """Measures some views; any process can.

    Attributes
    ----------
    job : SceneJob
    numbers : list of int
    kinds : list of bool
        See `SceneJob.look`.
    """

    job: SceneJob
    numbers: list[int]
    kinds: list[bool]

    def __call__(self, place: int) -> tuple[ViewMeasurement, float]:
        """Return what a view sees, and its weight."""
        return self.job.measure_view(self.numbers[place], self.kinds)


class MeasuringTiles(Measuring):
    """The views of one scoring, which measure what a folder holds.

    Parameters
    ----------
    job : SceneJob
    workers : callable
        See `workers.Workers`.
    groups : list of list of int, optional
        See `Measuring`.
    """

    def __init__(
        self, job: SceneJob, workers: Workers, groups: list[list[int]] | None = None
    ) -> None:
        super().__init__(job.scene, job.views, job.sampling, None, groups)
        self._job, self._workers = job, workers

    def measure_groups(  # type: ignore[override]
        self,
        gaussians: Placed,  # noqa: ARG002 - as those in memory, and the folder holds them
        groups: Sequence[int],
        sample: NDArray[np.int64],
        progress: Progress,
        ray_samples: Sequence[RaySample] = (),
    ) -> tuple[Stored, dict[int, NDArray[np.float64]]]:
        """Return the sums over each group of views, and the errors of a sample in each view."""
        folder = self._job.folder
        folder.note("sample", sample)
        kinds = [rays.scoring for rays in ray_samples]
        calls = [
            Call("look", (group, self.groups[group], kinds), 1 / len(groups), chunked=True)
            for group in groups
        ]
        for _ in self._workers(self._job, calls, progress, "scoring"):
            pass
        for rays in ray_samples:
            assert isinstance(rays, StoredLines)  # noqa: S101 - as those of `_Scoring` are
            rays.noted.update(itertools.chain(*(self.groups[group] for group in groups)))
        errors = {group: folder.noted(seen_name(group))[1][3] for group in groups}
        return Stored(folder, groups), errors


class StoredLines(RaySample):
    """The lines of sight of all views into one scene, and the splats that they meet.

    Parameters
    ----------
    job : SceneJob
    workers : callable
        See `workers.Workers`.
    sources : sequence of Source
        All splats.
    gaussians : Placed
    scoring : bool
        See `RaySample`.

    Attributes
    ----------
    noted : set of int
        Views whose lines lie in the folder.
    """

    def __init__(
        self,
        job: SceneJob,
        workers: Workers,
        sources: Sequence[Source],
        gaussians: Placed,
        *,
        scoring: bool = False,
    ) -> None:
        self.views, self.scoring = job.views.by_distance(), scoring
        self.index = self.rows = gaussians.index
        self.rays = [None] * len(self.views)
        self._step = 1
        self.noted: set[int] = set()
        self._job, self._workers, self._sources = job, workers, sources

    def cast(
        self,
        numbers: Sequence[int],
        gaussians: Gaussians,  # noqa: ARG002 - as for splats in memory
        scene: Scene,  # noqa: ARG002
        progress: Progress,
        threads: int | None,  # noqa: ARG002
    ) -> None:
        """Project all splats into some views, and load what their lines meet."""
        self._look([(number,) for number in numbers], progress)

    def _look(self, given: Sequence[tuple[Any, ...]], progress: Progress) -> None:
        calls = [Call("meet", arguments, 1 / len(given)) for arguments in given]
        for _ in self._workers(self._job, calls, progress, "looking"):
            pass
        self.noted.update(number for number, *_ in given)
        self.load()

    def against_stored(self, other: StoredLines, progress: Progress) -> float | None:
        """Return the estimated PSNR with other splats instead; see `estimate.psnr.psnr_against`.

        Parameters
        ----------
        other : StoredLines
            Into those, by the same views; its lines have not been noted.
        progress : callable
        """
        rays = {number: self.rays[number] for number in self.validating()}
        other._look(
            [(k, (own.columns, own.rows)) for k, own in rays.items() if own is not None], progress
        )

        def stored(number: int, _rays: Rays) -> tuple[Rays, NDArray[np.float64]]:
            again = other.rays[number]
            assert again is not None  # noqa: S101 - just cast
            return again, other.colors(number, again)

        return mean_psnr(self, stored)

    def load(self) -> None:
        """Load the lines that were noted, and what they meet."""
        folder = self._job.folder
        for number in sorted(self.noted):
            columns, rows, line, owner, alpha, dark, owners = folder.noted(
                lines_name(number, scoring=self.scoring)
            )[1]
            self.rays[number] = Rays(columns, rows, line, owner, alpha, dark, owners)
        some = [rays.hit for rays in self.rays if rays is not None]
        rows = np.unique(np.concatenate([np.empty(0, np.int64), *(self.index[m] for m in some)]))
        begins = np.cumsum([0, *map(len, self._sources)])
        edges = itertools.pairwise(np.searchsorted(rows, begins).tolist())
        calls = [
            Call("pick", (source, rows[start:stop] - begin), 1 / len(rows))
            for source, begin, (start, stop) in zip(self._sources, begins, edges, strict=False)
            if stop > start
        ]
        picked = [*self._workers(self._job, calls, silent, "looking")]
        if picked:
            self.splats = joined(picked)
        # Of Gaussians that no line meets it is any number.
        self.rows = np.searchsorted(rows, self.index)


def place(
    job: SceneJob, sources: Sequence[Source], workers: Workers, progress: Progress
) -> tuple[Placed, NDArray[np.bool_]]:
    """Activate all splats and store them along the curve.

    Returns
    -------
    gaussians : Placed
    good : (N,) bool
        Which splats can be drawn.
    """
    folder, total = job.folder, sum(map(len, sources))
    calls = [Call("place", (source,), len(source) / total, chunked=True) for source in sources]
    found = [*workers(job, calls, part(progress, 0.0, 0.6), "reading")]
    starts = np.cumsum([0, *(count for _, count in found)])
    begin = np.cumsum([0, *map(len, sources)])

    def all_of(name: str) -> NDArray[Any]:
        return np.concatenate([folder.map(source.index, name) for source in sources])

    if not folder.has("order"):
        order = code_order(all_of("code"), lambda rows: all_of("ties")[rows])
        folder.note("order", order)
        del order
    order = folder.mapped("order")
    rows = np.repeat(begin[:-1], np.diff(starts)) + all_of("rows")
    index = rows[order]
    del rows
    chunks = -(-len(index) // CHUNK)
    calls = [Call("gather", (number, starts), 1 / chunks) for number in range(chunks)]
    boxes = [*workers(job, calls, part(progress, 0.6, 1.0), "reading")]
    folder.note("boxes", np.reshape(np.array(boxes, np.float32), (-1, 7)))
    good = all_of("good")
    for source in sources:
        folder.drop(source.index, ("code", "ties", "gaussians"))
    return Placed(folder, index), good
