"""What views see of each splat: how much of the picture it makes up, and the error without it.

    contribution_i = sum over views of  integral of alpha_i  x  mean T        MesonGS, LightGaussian
    error_i        = sum over views of  integral of alpha_i^2  x  mean of T^2 |c_i - B_i|^2

T is the transmittance in front of the splat, c_i its colour and B_i the colour behind it; T and B
come from `froxels`. The error is the squared change of the pictures when this one splat is removed,
which REFINE's Hessian approximates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..execute import Progress, chunks, run, run_all, silent
from ..views import View
from . import froxels, projection
from .points import cell_size, scatter
from .projection import Footprints, Gaussians
from .ray_sample import RaySample, cast_view
from .scene import Scene

VIEW_GROUPS = 8
"""Views are measured in so many groups; sums are added group by group, so they do not depend on
threads."""

SECONDS = 1.2e-6
"""About how long one core takes to measure a splat in one view, to tell what is worth a process."""

_ADDED = 1 << 16  # splats of a view that are added to the sums at a time


@dataclass(frozen=True)
class Sampling:
    """How finely images are divided and splats sampled.

    Attributes
    ----------
    cell : float
        Least side of a cell, pixels; `points.cell_size` chooses a larger one where the splats need
        no finer cells.
    density : float
        Points per standard deviation for a splat whose standard deviation is as long as a cell.
    """

    cell: float = 4.0
    density: float = 3.7

    def __post_init__(self) -> None:
        """Check the values."""
        for name, value in vars(self).items():
            if not 0.0 < value < np.inf:
                raise RefineError(f"{name} is {value}, expected a positive number")


class Measured(NamedTuple):
    """Sums over views, for M Gaussians.

    Attributes
    ----------
    contribution, error : (M,) float64
        As defined at the top of this file; px^2, each view multiplied by its weight.
    seen : (M,) int32
        In how many views the centre lies.
    """

    contribution: NDArray[np.float64]
    error: NDArray[np.float64]
    seen: NDArray[np.int32]

    @classmethod
    def zero(cls, count: int) -> Measured:
        """Sums of no views."""
        return cls(np.zeros(count), np.zeros(count), np.zeros(count, np.int32))

    def for_all(self, index: NDArray[np.int64], count: int) -> Measured:
        """Sums of `count` splats: these ones at `index`, 0 for all others."""
        every = Measured.zero(count)
        for name in self._fields:
            getattr(every, name)[index] = getattr(self, name)
        return every

    def take(self, rows: NDArray[np.int64]) -> Measured:
        """Sums of some Gaussians."""
        return Measured(self.contribution[rows], self.error[rows], self.seen[rows])

    def add(self, other: Measured) -> None:
        """Add the sums of other views."""
        for name in self._fields:
            getattr(self, name)[:] += getattr(other, name)

    def add_view(
        self, measurement: ViewMeasurement, weight: float, threads: int | None = 1
    ) -> None:
        """Add what one view sees, times its weight."""

        def add(piece):
            rows = measurement.rows[piece]  # no row is there twice
            self.seen[rows[measurement.inside[piece]]] += 1
            with np.errstate(under="ignore"):
                self.contribution[rows] += weight * measurement.contribution[piece]
                self.error[rows] += weight * measurement.error[piece]

        run_all(add, chunks(len(measurement.rows), _ADDED), threads=threads)


class ViewMeasurement(NamedTuple):
    """What one view sees of n Gaussians.

    Attributes
    ----------
    rows : (n,) int64
    inside : (n,) bool
        Which centres lie in the view's frustum.
    contribution, error : (n,) float64
        Integrals over its image, px^2; see the top of this file.
    """

    rows: NDArray[np.int64]
    inside: NDArray[np.bool_]
    contribution: NDArray[np.float64]
    error: NDArray[np.float64]


def view_groups(count: int) -> list[range]:
    """Numbers of the views of each group: of eight groups, every eighth of so many views.

    Examples
    --------
    >>> view_groups(9)[:2], len(view_groups(3))
    ([range(0, 9, 8), range(1, 9, 8)], 3)
    """
    groups = min(VIEW_GROUPS, count)
    return [range(k, count, groups) for k in range(groups)]


def measure(
    gaussians: Gaussians,
    scene: Scene,
    views: Sequence[tuple[View, float]],
    groups: Sequence[range],
    sampling: Sampling,
    *,
    sample: Sequence[int] | NDArray[np.int64] = (),
    ray_samples: Sequence[RaySample] = (),
    progress: Progress = silent,
    threads: int | None = None,
) -> tuple[Measured, list[Measured], list[NDArray[np.float64]]]:
    """Sums over views, and of a sample those over each group and the errors in each view.

    Parameters
    ----------
    gaussians : Gaussians
    scene : Scene
    views : sequence of (View, float)
        Views and their weights, see `ViewSet.by_distance`.
    groups : sequence of range
        Those to measure, see `view_groups`.
    sampling : Sampling
    sample : (m,) int64
        Rows of the Gaussians.
    ray_samples : sequence of RaySample
        They are given those rays of these views that they lack.
    progress : callable
    threads : int, optional

    Returns
    -------
    Measured
        Added group by group.
    list of Measured, list of (views, m) float64
        Of each group, for the sample.
    """
    rows, numbers = np.asarray(sample, np.int64), [n for group in groups for n in group]
    lacking = [[rays for rays in ray_samples if rays.wants(n)] for n in numbers]
    measured = run(
        partial(_measure_and_cast, gaussians, scene, views, sampling),
        [(n, [rays.scoring for rays in some]) for n, some in zip(numbers, lacking, strict=True)],
        cost=SECONDS * len(gaussians) * len(numbers),
        progress=progress, what="scoring", threads=threads,
    )  # fmt: skip
    total, of_groups, errors = Measured.zero(len(gaussians)), [], []
    each = zip(measured, lacking, strict=True)
    for group in groups:
        sums, of_views = Measured.zero(len(gaussians)), []
        for number, ((measurement, cast), some) in zip(group, each, strict=False):
            before = sums.error[rows]  # (m,)
            sums.add_view(measurement, views[number][1], threads)
            of_views.append(sums.error[rows] - before)
            for ray_sample, rays in zip(some, cast, strict=True):
                ray_sample.rays[number] = rays
        total.add(sums)
        of_groups.append(sums.take(rows))
        errors.append(np.array(of_views))
    next(each, None)  # lets it end
    return total, of_groups, errors


def _measure_and_cast(gaussians, scene, views, sampling, number_and_kinds):
    """What a view sees of the splats, and its scoring or validation rays; any process can."""
    number, kinds = number_and_kinds
    footprints, measurement = measure_view(gaussians, scene, views[number][0], sampling)
    with np.errstate(under="ignore"):
        return measurement, [
            cast_view(views, number, footprints, scoring=scoring) for scoring in kinds
        ]


def measure_view(
    gaussians: Gaussians, scene: Scene, view: View, sampling: Sampling
) -> tuple[Footprints, ViewMeasurement]:
    """Footprints in a view, and what it sees of them."""
    with np.errstate(under="ignore"):
        footprints = projection.project(gaussians, scene, view)
        integrals = np.empty(0), np.empty(0)
        if len(footprints.index):
            side = cell_size(footprints, view, sampling.cell, sampling.density)
            points = scatter(footprints, view, side, sampling.density)
            colors = gaussians.colors[footprints.index]  # (n, 3)
            integrals = froxels.integrals(footprints, colors, points)
    return footprints, ViewMeasurement(footprints.index, footprints.inside, *integrals)
