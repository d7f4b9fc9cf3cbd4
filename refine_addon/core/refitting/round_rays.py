"""The rays of all rounds of refitting: what the unpruned splats look like on them, and survivors.

Each round learns from rays through other pixels. Validation rays, which no round learns from, tell
what a round has gained.

Views are cast in processes of their own, as they are measured (`processes`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np

from ..estimate.quality import PSNR_CAP
from ..processes import for_each
from ..seeing import projection
from ..seeing.cast import cast, depth_complexity, pixels
from ..seeing.ray_sample import MAX_HITS_OF_VIEW, MAX_RAYS_OF_VIEW, colors_from
from ..views import ViewSet
from ..work import Progress, part
from .linear import LEAST_WEIGHT, LinearView, Shapes, linear_view

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from ..seeing.projection import Footprints, Gaussians
    from ..seeing.scene import Scene
    from ..splats import Splats
    from ..views import View

Result = TypeVar("Result")

RAYS_OF_SPLAT = 8.0
"""Rays of a round for each survivor: with fewer, survivors learn them by heart."""

MIN_RAYS = 1 << 17
"""Rays of a round where that would be fewer."""

MAX_HITS = 3 << 21
"""About how many hits of a round may show in the unpruned splats (`linear.LEAST_WEIGHT`). Survivors
have fewer; each takes 48 bytes."""

SECONDS, SECONDS_OF_RAY = 2.5e-7, 4e-6
"""About how long one core takes to project a splat into a view, and to cast a ray, to tell what is
worth a process."""

_EVERY = 2  # validation rays go through every second column and row of a round's rays
_LEAST_ERROR = 10.0 ** (-PSNR_CAP / 10.0)


@dataclass(frozen=True, eq=False)
class Window:
    """Where rays go through a view, in each round.

    Attributes
    ----------
    view : View
    number : int
        Of the view, see `cast.pixels`.
    weight : float
        How much it counts for the PSNR.
    rays, hits : float
        About how many rays there are, and how many hits on the unpruned splats may show.
    left, top, width, height : int
        The part of the image that they go through, pixels; by default all of it.
    """

    view: View
    number: int
    weight: float
    rays: float
    hits: float
    left: int = 0
    top: int = 0
    width: int = 0
    height: int = 0

    @cached_property
    def part(self) -> View:
        """The part of the image as a view of its own."""
        view = self.view
        if not self.width:
            return view
        return replace(
            view, cx=view.cx - self.left, cy=view.cy - self.top,
            width=self.width, height=self.height,
        )  # fmt: skip

    def pixels(self, hits: float, number: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the columns and rows that the rays of a round go through.

        Rounds follow the rays that an estimate uses in the R2 sequence (`cast.pixels`), so that the
        rays of one are not next to those of another.

        Parameters
        ----------
        hits : float
            About how many hits on the unpruned splats a ray shows.
        number : int
            0 for validation rays, 1 for the first round.
        """
        count = min(self.rays, self.hits / max(hits, 1.0), MAX_RAYS_OF_VIEW)
        columns, rows = pixels(self.part, self.number + 1 + number, count)
        if not number:
            columns, rows = columns[::_EVERY], rows[::_EVERY]
        return columns + self.left, rows + self.top


class Target(Protocol):
    """Splats that rays are cast into. It is pickled, so that any process can."""

    def footprints(self, window: Window) -> Footprints:
        """Return the footprints in a view that may reach into a window of it.

        Their index says which of the splats they are.
        """
        ...

    def colors(self, hit: NDArray[np.int64], view: View) -> NDArray[np.float64]:
        """Return the colours in which a view sees some of the splats, (3, u)."""
        ...


@dataclass(frozen=True, eq=False)
class InMemory:
    """Splats in memory as a `Target`.

    Attributes
    ----------
    splats : Splats
    gaussians : Gaussians
        Made of these.
    scene : Scene
    """

    splats: Splats
    gaussians: Gaussians
    scene: Scene

    def footprints(self, window: Window) -> Footprints:
        """Return the footprints in a view that may reach into a window of it."""
        reaching = projection.footprints_and_depths(
            self.gaussians, self.scene, window.view, window.part
        )
        return projection.front_to_back([reaching])

    def colors(self, hit: NDArray[np.int64], view: View) -> NDArray[np.float64]:
        """Return the colours in which a view sees some of the Gaussians, (3, u)."""
        return colors_from(self.splats, self.gaussians.index[hit], view)


@dataclass(frozen=True, eq=False)
class Truth:
    """Rays of one view and round, and the colours that the unpruned splats have on them.

    Attributes
    ----------
    columns, rows : (C,), (R,) int64
        See `Rays`.
    colors : (3, P) float32
    """

    columns: NDArray[np.int64]
    rows: NDArray[np.int64]
    colors: NDArray[np.float32]


class RoundRays:
    """The rays of all rounds, with the colours that the unpruned splats have on them.

    Parameters
    ----------
    windows : sequence of Window
        Of the views that rays are cast from; also an attribute.
    scene : Scene
        Of the unpruned splats; also an attribute.
    truths : sequence of sequence of Truth
        Of each window, the validation rays and the rays of each round.
    threads : int, optional
    """

    around = 0
    """How many splats there are besides the survivors that are refitted."""

    def __init__(
        self,
        windows: Sequence[Window],
        scene: Scene,
        truths: Sequence[Sequence[Truth]],
        threads: int | None,
    ) -> None:
        self.windows, self.scene, self._truths = windows, scene, truths
        self._threads = threads

    @classmethod
    def of(
        cls,
        original: Splats,
        views: ViewSet,
        count: int,
        rounds: int,
        progress: Progress,
        threads: int | None,
    ) -> RoundRays:
        """Return the rays of all views into splats in memory.

        Parameters
        ----------
        original : Splats
            The unpruned splats, in the frame of the views.
        views : ViewSet
        count : int
            How many survivors there are.
        rounds : int
            How many rounds are refitted.
        progress : callable
        threads : int, optional
        """
        gaussians, scene, _ = projection.prepare(
            original, views, progress=part(progress, 0.0, 0.2), threads=threads
        )
        chosen = views.by_distance()
        rays = max(RAYS_OF_SPLAT * count, MIN_RAYS) / len(chosen)
        windows = [
            Window(view, number, weight, rays, MAX_HITS / len(chosen))
            for number, (view, weight) in enumerate(chosen)
        ]
        target = InMemory(original, gaussians, scene)
        truths = cast_truths(
            CastTruth(target, windows, range(rounds + 1)), len(original),
            part(progress, 0.2, 1.0), threads,
        )  # fmt: skip
        return cls(windows, scene, truths, threads)

    def truths(self, number: int) -> list[Truth]:
        """Return the rays of a round, of each view; those of round 0 validate."""
        return [of_rounds[number] for of_rounds in self._truths]

    def count(self, number: int) -> int:
        """Return how many rays a round has."""
        return sum(truth.colors.shape[1] for truth in self.truths(number))

    def linear(
        self, splats: Splats, number: int, *, geometry: bool, progress: Progress
    ) -> list[LinearView]:
        """Return how the colours of each view's rays change with survivors as they are now.

        Parameters
        ----------
        splats : Splats
            The survivors.
        number : int
            Of the round, from 1.
        geometry : bool
            Whether it is wanted how they change with means, scales and turns.
        progress : callable
        """
        gaussians = self._gaussians(splats, part(progress, 0.0, 0.1))
        shapes = Shapes.of(splats, gaussians, self.scene, geometry=geometry)
        truths = self.truths(number)
        work = _Linearize(self.target(splats, gaussians), self.windows, truths, shapes)
        return self._each(work, truths, len(splats), part(progress, 0.1, 1.0))

    def psnr(self, splats: Splats, progress: Progress) -> float:
        """Return the mean PSNR of survivors on validation rays, weighted as the views are, dB."""
        gaussians = self._gaussians(splats, part(progress, 0.0, 0.1))
        truths = self.truths(0)
        work = _CastErrors(self.target(splats, gaussians), self.windows, truths)
        errors = self._each(work, truths, len(splats), part(progress, 0.1, 1.0))
        weights = [window.weight for window in self.windows]
        return float(np.average(-10.0 * np.log10(errors), weights=weights))

    def target(self, splats: Splats, gaussians: Gaussians) -> Target:
        """Return what rays are cast into: survivors, given also as Gaussians, the first of all."""
        return InMemory(splats, gaussians, self.scene)

    def _gaussians(self, splats: Splats, progress: Progress) -> Gaussians:
        views = ViewSet(tuple(window.view for window in self.windows))
        prepared = projection.prepare(
            splats, views, self.scene, progress=progress, threads=self._threads
        )
        return prepared[0]

    def _each(
        self,
        work: Callable[[int], Result],
        truths: Sequence[Truth],
        count: int,
        progress: Progress,
    ) -> list[Result]:
        """Return what is found on the rays of each view, of `count` survivors."""
        rays = sum(truth.colors.shape[1] for truth in truths)
        seconds = SECONDS * (count + self.around) * len(self.windows) + SECONDS_OF_RAY * rays
        return [
            *for_each(
                work, len(self.windows), seconds,
                progress=progress, what="refitting", threads=self._threads,
            )
        ]  # fmt: skip


@dataclass(frozen=True, eq=False)
class CastTruth:
    """Casts the rays of all rounds of a view into the unpruned splats; any process can.

    Attributes
    ----------
    target : Target
        The unpruned splats.
    windows : sequence of Window
    rounds : sequence of int
        Their numbers; 0 for the validation rays.
    """

    target: Target
    windows: Sequence[Window]
    rounds: Sequence[int]

    def __call__(self, place: int) -> list[Truth]:
        """Return the rays of a view, of each round."""
        window = self.windows[place]
        truths = []
        with np.errstate(under="ignore"):
            footprints = self.target.footprints(window)
            # Casting takes memory for all hits, also hidden ones, but for one view at a time.
            share = window.hits / MAX_HITS_OF_VIEW
            hits = share * depth_complexity(footprints, window.part)
            for number in self.rounds:
                columns, rows = window.pixels(hits, number)
                rays = cast(footprints, columns, rows)
                colors = rays.colors(self.target.colors(rays.hit, window.view))
                truths.append(Truth(columns, rows, colors.astype(np.float32)))
                shown = np.count_nonzero(rays.contributions()[2] > LEAST_WEIGHT)
                hits = max(shown, share * len(rays.ray)) / max(rays.count, 1)
        return truths


def cast_truths(
    work: CastTruth, count: int, progress: Progress, threads: int | None
) -> list[list[Truth]]:
    """Return the rays of each view and round into `count` unpruned splats."""
    rays = sum(window.rays for window in work.windows) * len(work.rounds)
    seconds = SECONDS * count * len(work.windows) + SECONDS_OF_RAY * rays
    return [
        *for_each(
            work, len(work.windows), seconds,
            progress=progress, what="casting rays", threads=threads,
        )
    ]  # fmt: skip


@dataclass(frozen=True, eq=False)
class _CastErrors:
    """Casts rays of a view into survivors, and compares colours; any process can."""

    target: Target
    windows: Sequence[Window]
    truths: Sequence[Truth]

    def __call__(self, number: int) -> float:
        """Return the mean squared error of the colours that the rays of a view see."""
        window, truth = self.windows[number], self.truths[number]
        with np.errstate(under="ignore"):
            rays = cast(self.target.footprints(window), truth.columns, truth.rows)
            seen = rays.colors(self.target.colors(rays.hit, window.view))
        return float(max(np.mean(np.square(truth.colors - seen)), _LEAST_ERROR))


@dataclass(frozen=True, eq=False)
class _Linearize:
    """Casts the rays of a round of a view, and finds how their colours change; any process can."""

    target: Target
    windows: Sequence[Window]
    truths: Sequence[Truth]
    shapes: Shapes

    def __call__(self, number: int) -> LinearView:
        """Return how the colours of a view's rays change with the survivors."""
        window, truth = self.windows[number], self.truths[number]
        with np.errstate(under="ignore"):
            footprints = self.target.footprints(window)
            rays = cast(footprints, truth.columns, truth.rows)
            colors = self.target.colors(rays.hit, window.view)
            return linear_view(rays, footprints, colors, self.shapes, window.view)
