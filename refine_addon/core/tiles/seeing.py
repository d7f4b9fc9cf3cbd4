"""What views see of splats that no memory holds at once, with its sums on a disk.

The sums of groups of views and the hits of rays lie in the folder of the job.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, run
from ..operation.run import Runtime
from ..quality.psnr import mean_psnr
from ..splats import Splats, joined
from ..visibility.cast import cast
from ..visibility.measuring import SECONDS, Measured, Measuring, ViewMeasurement, measure_footprints
from ..visibility.projection import Footprints, Gaussians
from ..visibility.ray_sample import RaySample, cast_view
from ..visibility.rays import Rays
from ..visibility.scene import Scene
from .folder import Folder
from .gaussians import SceneContext, StoredGaussians
from .units import Source, unpacked
from .workers import Runner

Pixels = tuple[NDArray[np.int64], NDArray[np.int64]]


@dataclass(frozen=True)
class MeasureViews:
    """Measures what a group of views sees of all splats, and casts rays of these views."""

    group: int
    numbers: list[int]  # of its views, in the order of `ViewSet.by_distance`
    kinds: list[bool]  # of the rays to cast: whether they are scoring rays, see `RaySample`

    def run(self, context: SceneContext, runtime: Runtime) -> None:
        """Note the sums and the rays, unless that is done."""
        folder, name = context.folder, _sums_name(self.group)
        if folder.noted(name)[0]:
            return
        sample, count = folder.noted("sample")[1], int(folder.noted("count")[1])
        total, errors = Measured.zero(count), []
        measurements = run(
            _OneView(context, self.numbers, self.kinds), range(len(self.numbers)),
            cost=SECONDS * count * len(self.numbers),
            progress=runtime.progress, what="scoring", threads=runtime.threads,
        )  # fmt: skip
        for measurement, weight in measurements:
            before = total.error[sample]
            total.add_view(measurement, weight)
            errors.append(total.error[sample] - before)
        folder.note(name, (total.contribution, total.error, total.seen, np.array(errors)))


@dataclass(frozen=True)
class _OneView:
    """Measures one of some views and notes its rays; any process can. See `MeasureViews`."""

    context: SceneContext
    numbers: list[int]
    kinds: list[bool]

    def __call__(self, index: int) -> tuple[ViewMeasurement, float]:
        """Return what a view sees, and its weight."""
        number, context = self.numbers[index], self.context
        view, weight = context.views.by_distance()[number]
        footprints, colors = context.footprints(view)
        for scoring in self.kinds:
            note_rays(context, number, footprints, scoring=scoring)
        return measure_footprints(footprints, colors, view, context.sampling), weight


@dataclass(frozen=True)
class CastRays:
    """Casts the validation rays of a view; for what it holds see `note_rays`."""

    number: int
    pixels: Pixels | None = None

    def run(self, context: SceneContext, _runtime: Runtime) -> None:
        """Note the rays, unless that is done."""
        view, _ = context.views.by_distance()[self.number]
        note_rays(context, self.number, context.footprints(view)[0], self.pixels)


@dataclass(frozen=True)
class TakeSplats:
    """Reads some splats of a source."""

    source: Source
    rows: NDArray[np.int64]

    def run(self, _context: SceneContext, _runtime: Runtime) -> Splats:
        """Return the splats."""
        return self.source.splats().take(self.rows)


def note_rays(
    context: SceneContext,
    number: int,
    footprints: Footprints,
    pixels: Pixels | None = None,
    *,
    scoring: bool = False,
) -> None:
    """Cast rays of a view through its footprints, and note them, unless that is done.

    Parameters
    ----------
    context : SceneContext
    number : int
        Of the view, in the order of `ViewSet.by_distance`.
    footprints : Footprints
    pixels : (C,), (R,) int64, optional
        Columns and rows that the rays go through; by default they are chosen as in memory.
    scoring : bool
        Whether these are scoring rays, see `RaySample`.
    """
    name = _rays_name(number, scoring=scoring)
    if context.folder.noted(name)[0]:
        return
    with np.errstate(under="ignore"):
        if pixels is None:
            rays = cast_view(context.views.by_distance(), number, footprints, scoring=scoring)
        else:
            rays = cast(footprints, *pixels)
    arrays = (values for values in vars(rays).values() if values is not None)  # not aimed
    context.folder.note(name, tuple(arrays))


class StoredSums(Mapping[int, Measured]):
    """Sums of groups of views, in a folder.

    Parameters
    ----------
    folder : Folder
    groups : iterable of int
        The numbers of those that lie there.
    """

    def __init__(self, folder: Folder, groups: Iterable[int]) -> None:
        self._folder, self._groups = folder, [*groups]

    def __getitem__(self, group: int) -> Measured:
        """Return the sums of a group."""
        return Measured(*self._folder.noted(_sums_name(group))[1][:3])

    def __iter__(self) -> Iterator[int]:
        """Return the numbers of the groups."""
        return iter(self._groups)

    def __len__(self) -> int:
        """Return how many groups there are."""
        return len(self._groups)


class TileMeasuring(Measuring):
    """The views of one scoring, which measure the splats that a folder holds.

    Parameters
    ----------
    context : SceneContext
    runner : Runner
        Only its workers count.
    """

    def __init__(self, context: SceneContext, runner: Runner) -> None:
        super().__init__(context.scene, context.views, context.sampling, None)
        self._context, self._runner = context, runner

    def measure_groups(  # type: ignore[override]
        self,
        gaussians: StoredGaussians,
        groups: Sequence[int],
        sample: NDArray[np.int64],
        progress: Progress,
        ray_samples: Sequence[RaySample] = (),
    ) -> tuple[StoredSums, dict[int, NDArray[np.float64]]]:
        """Return the sums over each group of views, and the errors of a sample in each view."""
        folder = self._context.folder
        folder.note("sample", sample)
        kinds = [rays.scoring for rays in ray_samples]
        steps = [MeasureViews(group, self.groups[group], kinds) for group in groups]
        replace(self._runner, progress=progress).run_all(self._context, steps, "scoring")
        for rays in ray_samples:
            assert isinstance(rays, StoredRays)
            rays.noted.update(itertools.chain(*(self.groups[group] for group in groups)))
        errors = {group: folder.noted(_sums_name(group))[1][3] for group in groups}
        return StoredSums(folder, groups), errors


class StoredRays(RaySample):
    """Rays of all views into one scene, whose hits lie in a folder until `load`.

    Parameters
    ----------
    context : SceneContext
    runner : Runner
        Only its workers count.
    sources : sequence of Source
        All splats.
    gaussians : StoredGaussians
    scoring : bool
        See `RaySample`.

    Attributes
    ----------
    noted : set of int
        Numbers of the views whose rays lie in the folder.
    """

    def __init__(
        self,
        context: SceneContext,
        runner: Runner,
        sources: Sequence[Source],
        gaussians: StoredGaussians,
        *,
        scoring: bool = False,
    ) -> None:
        # Splats are read when it is known which are hit; of the Gaussians only their rows matter.
        none = unpacked(np.empty((0, 14)))
        super().__init__(context.views.by_distance(), gaussians, none, scoring=scoring)  # type: ignore[arg-type]
        self.noted: set[int] = set()
        self._context, self._sources = context, sources
        self._runner = Runner(runner.workers)

    def wants(self, number: int) -> bool:
        """Return whether the rays of a view are wanted and have not been cast yet."""
        return number not in self.noted and super().wants(number)

    def cast(
        self,
        numbers: Sequence[int],
        gaussians: Gaussians,
        scene: Scene,
        progress: Progress,
        threads: int | None,
    ) -> None:
        """Cast the rays of some views, and load what they hit."""
        runner = replace(self._runner, progress=progress)
        self._cast([CastRays(number) for number in numbers], runner)

    def _cast(self, steps: Sequence[CastRays], runner: Runner) -> None:
        runner.run_all(self._context, steps, "casting rays")
        self.noted.update(step.number for step in steps)
        self.load()

    def psnr_against(self, other: StoredRays, runner: Runner) -> float | None:
        """Return the estimated PSNR with other splats instead; see `estimate.psnr.psnr_against`.

        Parameters
        ----------
        other : StoredRays
            Into those, of the same views, none of whose rays have been cast.
        runner : Runner
        """
        truth = ((number, self.rays[number]) for number in self.validating())
        steps = [CastRays(number, (rays.columns, rays.rows)) for number, rays in truth if rays]
        other._cast(steps, runner)

        def cast_again(number: int, _rays: Rays) -> tuple[Rays, NDArray[np.float64]]:
            rays = other.rays[number]
            assert rays is not None
            return rays, other.colors(number, rays)

        return mean_psnr(self, cast_again)

    def load(self) -> None:
        """Load the rays that were noted, and the splats that they hit."""
        for number in sorted(self.noted):
            name = _rays_name(number, scoring=self.scoring)
            self.rays[number] = Rays(*self._context.folder.noted(name)[1])
        hit = [self.splat_rows[rays.hit] for rays in self.rays if rays is not None]
        rows = np.unique(np.concatenate([np.empty(0, np.int64), *hit]))
        begins = np.cumsum([0, *map(len, self._sources)])
        edges = itertools.pairwise(np.searchsorted(rows, begins).tolist())
        steps = [
            TakeSplats(source, rows[start:stop] - begin)
            for source, begin, (start, stop) in zip(self._sources, begins, edges, strict=False)
            if stop > start
        ]
        if steps:
            self.splats = joined([*self._runner.run(self._context, steps, "reading")])
        # Any number for Gaussians that no ray hits.
        self.stored_rows = np.searchsorted(rows, self.splat_rows)


def _sums_name(group: int) -> str:
    """Return under which name the sums of a group of views are noted."""
    return f"{group}.measured"


def _rays_name(number: int, *, scoring: bool) -> str:
    """Return under which name the rays of a view are noted."""
    return f"{'scoring' if scoring else 'validation'}-rays-{number:06d}"
