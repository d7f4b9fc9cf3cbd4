"""What views see of each splat: how much of the picture it makes up, and the error without it.

    contribution_i = sum over views of  integral of alpha_i  x  mean T        MesonGS, LightGaussian
    error_i        = sum over views of  integral of alpha_i^2  x  mean of T^2 |c_i - B_i|^2

T is the transmittance in front of the splat, c_i its colour and B_i the colour behind it; T and B
come from `froxels`. The error is the squared change of the pictures when this one splat is removed,
which is what REFINE's Hessian stands for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import RefineError
from ..processes import for_each
from . import froxels, projection
from .sight_lines import met

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from ..scene import Scene
    from ..views import View, ViewSet
    from ..work import Progress
    from .projection import Footprints, Gaussians
    from .sight_lines import Lines, SightLines

BLOCKS = 8
"""Of views; sums are added block by block, so they do not depend on threads."""

SECONDS = 1.2e-6
"""About how long one core measures a splat in one view, to tell what is worth a process."""


@dataclass(frozen=True)
class Sampling:
    """How finely images are divided and splats sampled.

    Attributes
    ----------
    cell : float
        Least side of a cell, pixels; `froxels.cell_size` chooses a larger one where the splats need
        no finer cells.
    density : float
        Points per standard deviation for a splat whose standard deviation is as long as a cell.
    """

    cell: float = 4.0
    density: float = 3.7

    def __post_init__(self) -> None:
        """Check the values.

        Raises
        ------
        RefineError
            If a value is not a positive number.
        """
        for name in ("cell", "density"):
            value = getattr(self, name)
            if not 0.0 < value < np.inf:
                msg = f"{name} is {value}, expected a positive number"
                raise RefineError(msg)


@dataclass(frozen=True, eq=False)
class Measured:
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
        """Return sums of no views."""
        return cls(np.zeros(count), np.zeros(count), np.zeros(count, np.int32))

    @classmethod
    def sum(cls, parts: Iterable[Measured]) -> Measured:
        """Return the sums of all parts, one at least."""
        total: Measured | None = None
        for other in parts:
            total = total or cls.zero(len(other.seen))
            total.add(other)
        assert total is not None  # noqa: S101 - as promised
        return total

    def for_all(self, index: NDArray[np.int64], count: int) -> Measured:
        """Return the sums of `count` splats: these ones at `index`, 0 for all others."""
        every = Measured.zero(count)
        every.contribution[index] = self.contribution
        every.error[index] = self.error
        every.seen[index] = self.seen
        return every

    def take(self, rows: NDArray[np.int64]) -> Measured:
        """Return the sums of some Gaussians."""
        return Measured(self.contribution[rows], self.error[rows], self.seen[rows])

    def add(self, other: Measured) -> None:
        """Add the sums of other views."""
        self.contribution[:] += other.contribution
        self.error[:] += other.error
        self.seen[:] += other.seen

    def add_view(self, seen: Seen, weight: float) -> None:
        """Add what one view sees, times its weight."""
        self.seen[seen.rows[seen.inside]] += 1
        with np.errstate(under="ignore"):
            self.contribution[seen.rows] += weight * seen.contribution
            self.error[seen.rows] += weight * seen.error


class Seen(NamedTuple):
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


class Measuring:
    """The views of one scoring, ready to measure Gaussians.

    Parameters
    ----------
    scene : Scene
    views : ViewSet
    sampling : Sampling
    threads : int, optional
    members : list of list of int, optional
        By default each block has every eighth view.

    Attributes
    ----------
    views : list of (View, float)
        Views and their weights, see `ViewSet.by_distance`.
    members : list of list of int
        The numbers of the views of each block.
    """

    def __init__(
        self,
        scene: Scene,
        views: ViewSet,
        sampling: Sampling,
        threads: int | None,
        members: list[list[int]] | None = None,
    ) -> None:
        self.scene, self.sampling, self.threads = scene, sampling, threads
        self.views = views.by_distance()
        total = len(self.views)
        count = min(BLOCKS, total)
        self.members = members or [list(range(k, total, count)) for k in range(count)]

    @property
    def count(self) -> int:
        """Number of blocks."""
        return len(self.members)

    def part(self, turn: int, parts: int) -> range:
        """Return the blocks of one of `parts` parts of the views; see `occlusion.measure_part`."""
        parts = min(parts, self.count)
        return range(turn % parts, self.count, parts)

    def share(self, which: Sequence[int]) -> float:
        """Return the share of the weights of all views that some blocks have."""
        weights = [weight for _, weight in self.views]
        mine = (weights[number] for k in which for number in self.members[k])
        return math.fsum(mine) / math.fsum(weights)

    def measure(
        self, gaussians: Gaussians, which: Sequence[int], progress: Progress
    ) -> Mapping[int, Measured]:
        """Return the sums over some blocks of views; see `blocks`."""
        none = np.empty(0, np.int64)
        return self.blocks(gaussians, none, progress, which=which)[0]

    def blocks(
        self,
        gaussians: Gaussians,
        sample: NDArray[np.int64],
        progress: Progress,
        which: Sequence[int] | None = None,
        sights: Sequence[SightLines] = (),
    ) -> tuple[Mapping[int, Measured], dict[int, NDArray[np.float64]]]:
        """Return the sums over each block of views, and the errors of a sample in each view.

        Parameters
        ----------
        gaussians : Gaussians
        sample : (m,) int64
            Rows of the Gaussians.
        progress : callable
        which : sequence of int, optional
            The blocks to measure; by default all `count` of them.
        sights : sequence of SightLines
            Note what their lines meet.

        Returns
        -------
        dict of int to Measured, dict of int to (views, m) float64
            Of each of these blocks.
        """
        chosen = range(self.count) if which is None else which
        numbers = [number for k in chosen for number in self.members[k]]
        missing = [
            (each.ranking, {number for number in numbers if each.lacks(number)}) for each in sights
        ]
        found = for_each(
            _Looking(gaussians, self.scene, self.views, self.sampling, numbers, missing),
            len(numbers), SECONDS * len(gaussians) * len(numbers),
            progress=progress, what="scoring", threads=self.threads,
        )  # fmt: skip
        sums: dict[int, Measured] = {}
        errors: dict[int, NDArray[np.float64]] = {}
        for k in chosen:
            total = sums[k] = Measured.zero(len(gaussians))
            grown = []
            for number in self.members[k]:
                seen, lines = next(found)
                before = total.error[sample]  # (m,)
                total.add_view(seen, self.views[number][1])
                grown.append(total.error[sample] - before)
                for each, noted in zip(sights, lines, strict=True):
                    if noted is not None:
                        each.lines[number] = noted
            errors[k] = np.array(grown)
        for _ in found:
            pass  # lets it end
        return sums, errors


@dataclass(frozen=True, eq=False)
class _Looking:
    """Measures some views; any process can.

    Attributes
    ----------
    gaussians : Gaussians
    scene : Scene
    views : list of (View, float)
        All of them.
    sampling : Sampling
    numbers : list of int
        Of those that measure.
    missing : list of (bool, set of int)
        Of several kinds of lines of sight: whether they order splats, and the numbers of the views
        of which they are wanted.
    """

    gaussians: Gaussians
    scene: Scene
    views: list[tuple[View, float]]
    sampling: Sampling
    numbers: list[int]
    missing: list[tuple[bool, set[int]]]

    def __call__(self, place: int) -> tuple[Seen, list[Lines | None]]:
        """Return what a view sees, and what its lines of sight meet."""
        number = self.numbers[place]
        footprints, seen = measure_view(
            self.gaussians, self.scene, self.views[number][0], self.sampling
        )
        with np.errstate(under="ignore"):
            return seen, [
                met(self.views, number, footprints, ranking=ranking) if number in wanted else None
                for ranking, wanted in self.missing
            ]


def measure_view(
    gaussians: Gaussians, scene: Scene, view: View, sampling: Sampling
) -> tuple[Footprints, Seen]:
    """Return the footprints in a view, and what it sees of them."""
    with np.errstate(under="ignore"):
        footprints = projection.project(gaussians, scene, view)
    colors = gaussians.colors[footprints.index]  # (n, 3)
    return footprints, of_view(footprints, colors, view, sampling)


def of_view(
    footprints: Footprints,
    colors: NDArray[np.float32],
    view: View,
    sampling: Sampling,
) -> Seen:
    """Return what a view sees of n footprints.

    Parameters
    ----------
    footprints : Footprints
    colors : (n, 3) float32
    view : View
    sampling : Sampling
    """
    rows, inside = footprints.index, footprints.inside
    if not len(rows):
        return Seen(rows, inside, np.empty(0), np.empty(0))
    with np.errstate(under="ignore"):
        side = froxels.cell_size(footprints, view, sampling.cell, sampling.density)
        points = froxels.scatter(footprints, view, side, sampling.density)
        mass, mass_squared = froxels.masses(footprints)  # (n,) each
        traits = froxels.traits(footprints, mass, colors, points.area)  # (n, 6)
        visible, errors = np.empty((2, len(points.owners)))  # (m,) each
        for cells, place in points.pieces():
            shares, mine = points.shares[place], traits.take(points.owners[place], axis=0)
            seen, squared_contrast = froxels.look(shares, mine, points.columns[cells])
            seen *= shares
            visible[place] = seen
            seen *= seen
            errors[place] = seen * squared_contrast
        visible, errors = froxels.mean_visible(points, visible, errors)
        return Seen(rows, inside, mass * visible, mass_squared * errors)
