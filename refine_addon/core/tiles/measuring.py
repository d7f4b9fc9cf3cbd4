"""Measuring splats that no memory holds at once: `seeing.measuring`, with the sums on a disk."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..processes import for_each
from ..seeing.measuring import SECONDS, Measured, Measuring, measure_footprints
from .rays import StoredRays, note_rays

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from ..seeing.measuring import ViewMeasurement
    from ..seeing.ray_sample import RaySample
    from ..work import Progress
    from .folder import Folder
    from .gaussians import SceneContext, StoredGaussians
    from .workers import Runner


@dataclass(frozen=True)
class MeasureViews:
    """Measures what a group of views sees of all splats, and casts rays of these views."""

    group: int
    numbers: list[int]  # of its views, in the order of `ViewSet.by_distance`
    kinds: list[bool]  # of the rays to cast: whether they are scoring rays, see `RaySample`

    def run(self, context: SceneContext, progress: Progress, threads: int | None) -> None:
        """Note the sums and the rays, unless that is done."""
        folder, name = context.folder, _name(self.group)
        if folder.noted(name)[0]:
            return
        sample, count = folder.noted("sample")[1], int(folder.noted("count")[1])
        total, errors = Measured.zero(count), []
        measurements = for_each(
            _OneView(context, self.numbers, self.kinds), len(self.numbers),
            SECONDS * count * len(self.numbers),
            progress=progress, what="scoring", threads=threads,
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

    def __call__(self, place: int) -> tuple[ViewMeasurement, float]:
        """Return what a view sees, and its weight."""
        number, context = self.numbers[place], self.context
        view, weight = context.views.by_distance()[number]
        footprints, colors = context.footprints(view)
        for scoring in self.kinds:
            note_rays(context, number, footprints, scoring=scoring)
        return measure_footprints(footprints, colors, view, context.sampling), weight


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
        return Measured(*self._folder.noted(_name(group))[1][:3])

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
    groups : list of list of int, optional
        See `Measuring`.
    """

    def __init__(
        self, context: SceneContext, runner: Runner, groups: list[list[int]] | None = None
    ) -> None:
        super().__init__(context.scene, context.views, context.sampling, None, groups)
        self._context, self._runner = context, runner

    def measure_groups(  # type: ignore[override]
        self,
        gaussians: StoredGaussians,  # noqa: ARG002 - the folder holds them
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
            assert isinstance(rays, StoredRays)  # noqa: S101 - as those of `_TileScoring` are
            rays.noted.update(itertools.chain(*(self.groups[group] for group in groups)))
        errors = {group: folder.noted(_name(group))[1][3] for group in groups}
        return StoredSums(folder, groups), errors


def _name(group: int) -> str:
    """Return under which name the sums of a group of views are noted."""
    return f"{group}.measured"
