"""The rays of all rounds of refitting: what the unpruned splats look like on them, and survivors.

Each round learns from rays through other pixels, of views that stand a little beside the given ones
(`SHIFT`): what the given ones alone tell does not hold between them. So do validation rays, which
no round learns from: they tell what a round has gained.

Views are cast in processes of their own, as they are measured (`processes`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from .. import costs
from ..costs import Plan
from ..execute import Progress, chunks, part, return_freed, run
from ..quality.psnr import psnr_of
from ..spherical_harmonics import single_colors
from ..splats import Splats
from ..views import View, ViewSet
from ..visibility import projection
from ..visibility.cast import cast_visible, depth_complexity, pixels
from ..visibility.projection import Footprints, Gaussians
from ..visibility.ray_sample import MAX_HITS_OF_VIEW, MAX_RAYS_OF_VIEW, VALIDATION_VIEWS
from ..visibility.scene import Scene
from .linear import LEAST_WEIGHT, LinearRays, SeenView, Shapes, linear_view

Result = TypeVar("Result")

RAYS_OF_SPLAT = 7.0
"""Rays of a round for each survivor: with fewer, survivors learn them by heart, and two rounds of
half as many bring less than one."""

MIN_RAYS = 1 << 17
"""Rays of a round where that would be fewer."""

HITS_OF_SPLAT, MIN_HITS = 112, 3 << 21
"""About how many hits of a round may show in the unpruned splats (`linear.LEAST_WEIGHT`), for each
survivor, and where that would be fewer. Each takes 14 bytes of a file (`stored`)."""

MANY_HITS, FEWER_HITS = 1 << 24, 64
"""Rounds of more hits have no more than so many for each survivor, to bound that file."""

SHIFT, MAX_SHIFT = 0.7, 0.1
"""About how far a view is moved in a round: so many times as far as the view next to it is, at most
so many scene sizes."""

LARGEST = np.float32(1e36)
"""Coefficients of harmonics count as no larger: 25 of them add up to a float32."""

SECONDS, SECONDS_OF_RAY = 2.5e-7, 4e-6
"""About how long one core takes to project a splat into a view, and to cast a ray, to tell what is
worth a process."""

_SAME = 1e-6  # scene sizes; views nearer to each other stand in one place
_CHUNK = 1 << 14
_EVERY = 2  # validation rays go through every second row of a round's rays
_NOTHING = 1e-30  # hits of a ray; keeps a division finite


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
    step : float
        About how far the view is moved in a round, world units.
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
    step: float = 0.0

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

    def moved(self, number: int) -> Window:
        """Return the same window of the view as it stands in a round, from 1."""
        random = np.random.default_rng([self.number, number])
        shift = self.step * random.normal(size=3) / np.sqrt(3.0)  # along the camera's axes
        center = self.view.center + shift @ self.view.rotation
        return replace(self, view=replace(self.view, center=center))

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
            rows = rows[::_EVERY]
        return columns + self.left, rows + self.top


class Target(Protocol):
    """Splats that rays are cast into. It is pickled, so that any process can."""

    def footprints(self, window: Window) -> Footprints:
        """Return the footprints in a view that may reach into a window of it.

        Their index says which of the splats they are.
        """
        ...

    def colors(self, hit: NDArray[np.int64], view: View) -> NDArray[np.float32]:
        """Return the colours in which a view sees some of the splats, (3, u)."""
        ...


@dataclass(frozen=True, eq=False)
class InMemory:
    """Splats in memory as a `Target`. No array is copied but where it is pickled.

    Attributes
    ----------
    gaussians : Gaussians
    scene : Scene
    rows : (M,) int64
        Which of the splats these are.
    means, sh_dc, sh_rest
        Of the splats; see `Splats`.
    """

    gaussians: Gaussians
    scene: Scene
    rows: NDArray[np.int64]
    means: NDArray[Any]
    sh_dc: NDArray[Any]
    sh_rest: NDArray[Any]

    @classmethod
    def of(cls, splats: Splats, gaussians: Gaussians, scene: Scene) -> InMemory:
        """Return the splats that some Gaussians were made of."""
        colored = splats.means, splats.sh_dc, splats.sh_rest
        return cls(gaussians, scene, gaussians.index, *colored)

    def __getstate__(self) -> dict[str, Any]:
        """Return what is pickled: of the arrays, the rows that are wanted, one after the other.

        Processes map what is contiguous, and would have copies of their own of what is not.
        """
        colored = {
            name: np.ascontiguousarray(getattr(self, name)[self.rows])
            for name in ("means", "sh_dc", "sh_rest")
        }
        return {**vars(self), **colored, "rows": np.arange(len(self.rows))}

    def footprints(self, window: Window) -> Footprints:
        """Return the footprints in a view that may reach into a window of it."""
        return projection.project(self.gaussians, self.scene, window.view, window.part)

    def colors(self, hit: NDArray[np.int64], view: View) -> NDArray[np.float32]:
        """Return the colours in which a view sees some of the Gaussians, (3, u)."""
        return colors_of(self, self.rows.take(hit), view)


class _Colored(Protocol):
    """Splats, as far as their colours need them."""

    @property
    def means(self) -> NDArray[Any]: ...
    @property
    def sh_dc(self) -> NDArray[Any]: ...
    @property
    def sh_rest(self) -> NDArray[Any]: ...


def colors_of(splats: _Colored, rows: NDArray[np.int64], view: View) -> NDArray[np.float32]:
    """Return the colours in which a view sees some splats, (3, u), as far as they can be drawn."""
    result = np.empty((3, len(rows)), np.float32)
    for piece in chunks(len(rows), _CHUNK):
        chosen = rows[piece]
        harmonics = np.empty((len(chosen), 3, 1 + splats.sh_rest.shape[1]), np.float32)
        with np.errstate(over="ignore"):
            harmonics[:, :, 0] = splats.sh_dc[chosen]
            harmonics[:, :, 1:] = splats.sh_rest[chosen].transpose(0, 2, 1)
        np.clip(harmonics, -LARGEST, LARGEST, out=harmonics)
        from_view = splats.means[chosen].astype(np.float64) - view.center
        direction = np.ascontiguousarray(from_view.T, np.float32)
        length = np.sqrt(np.square(direction).sum(axis=0))
        direction /= np.maximum(length, np.finfo(np.float32).tiny)
        result[:, piece] = single_colors(direction, harmonics)
    return result.clip(0.0, projection.BRIGHTEST)


@dataclass(frozen=True, eq=False)
class Truth:
    """Rays of one view, and the colours that the unpruned splats have on them.

    Attributes
    ----------
    columns, rows : (C,), (R,) int64
        See `Rays`.
    colors : (3, P) float32
    shown : float
        How many hits a ray has that count for `Window.hits`, for each that the sizes of footprints
        foretell.
    """

    columns: NDArray[np.int64]
    rows: NDArray[np.int64]
    colors: NDArray[np.float32]
    shown: float


class RoundRays:
    """The rays of all rounds, of which it is known what the unpruned splats look like on them.

    Parameters
    ----------
    windows : sequence of Window
        Of the views that rays are cast from; also an attribute.
    scene : Scene
        Of the unpruned splats; also an attribute.
    original : Target
        The unpruned splats.
    count : int
        How many of these there are.
    threads : int, optional
    """

    around = 0
    """How many splats there are besides the survivors that are refitted."""

    def __init__(
        self,
        windows: Sequence[Window],
        scene: Scene,
        original: Target,
        count: int,
        threads: int | None,
    ) -> None:
        self.windows, self.scene = windows, scene
        self._original, self._count, self._threads = original, count, threads
        step = -(-len(windows) // VALIDATION_VIEWS)
        self._validating = [window.moved(0) for window in windows[::step]] if step else []
        self._validation: list[Truth] = []

    @classmethod
    def of(
        cls,
        original: Splats,
        views: ViewSet,
        count: int,
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
            For how many survivors there are to be rays, see `limits`.
        progress : callable
        threads : int, optional
        """
        gaussians, scene, _ = projection.prepare(
            original, views, progress=progress, threads=threads
        )
        chosen = views.by_distance()
        rays, hits = (each / len(chosen) for each in limits(count))
        steps = steps_of([view for view, _ in chosen], scene)
        windows = [
            Window(view, number, weight, rays, hits, step=steps[number])
            for number, (view, weight) in enumerate(chosen)
        ]
        target = InMemory.of(original, gaussians, scene)
        return_freed()
        return cls(windows, scene, target, len(original), threads)

    def costs(self, survivors: int) -> tuple[Plan, list[Plan]]:
        """Return what checking so many survivors for the first time, and a round, cost."""
        counts = self._count + self.around, survivors, len(self.windows)
        rays = sum(window.rays for window in self.windows)
        return costs.refitting(*counts, rays, 0)[1], costs.refit_round(*counts, rays)

    def linear(
        self, splats: Splats, number: int, *, geometry: bool, progress: Progress
    ) -> LinearRays:
        """Return how the colours of rays change with survivors as they are now.

        Parameters
        ----------
        splats : Splats
            The survivors; `psnr` has been asked for before, of these or others.
        number : int
            Of the round, from 1.
        geometry : bool
            Whether it is wanted how they change with means, scales and turns.
        progress : callable
        """
        gaussians = self._gaussians(splats, part(progress, 0.0, 0.05))
        shapes = Shapes.of(splats, gaussians, self.scene, geometry=geometry)
        windows = [window.moved(number) for window in self.windows]
        told = [truth.shown for truth in self._validation]
        shown = float(np.mean(told)) if told else None
        truth = CastTruth(self._original, windows, number, shown)
        work = _Linearize(truth, self.target(splats, gaussians), shapes)
        count = self._count + len(splats)
        seen = self._each(work, windows, count, part(progress, 0.05, 1.0))
        result = LinearRays.of(shapes, seen)
        return_freed()
        return result

    def psnr(self, splats: Splats, progress: Progress) -> float:
        """Return the mean PSNR of survivors on validation rays, weighted as the views are, dB."""
        windows = self._validating
        if not self._validation:
            truth = CastTruth(self._original, windows, 0)
            told = self._each(truth, windows, self._count, part(progress, 0.0, 0.5))
            self._validation = list(told)
        gaussians = self._gaussians(splats, part(progress, 0.5, 0.6))
        work = _CastPsnr(self.target(splats, gaussians), windows, self._validation)
        psnr = [*self._each(work, windows, len(splats), part(progress, 0.6, 1.0))]
        return_freed()
        return float(np.average(psnr, weights=[window.weight for window in windows]))

    def target(self, splats: Splats, gaussians: Gaussians) -> Target:
        """Return what rays are cast into: survivors, given also as Gaussians, the first of all."""
        return InMemory.of(splats, gaussians, self.scene)

    def _gaussians(self, splats: Splats, progress: Progress) -> Gaussians:
        views = ViewSet(tuple(window.view for window in self.windows))
        prepared = projection.prepare(
            splats, views, self.scene, progress=progress, threads=self._threads
        )
        return prepared[0]

    def _each(
        self,
        work: Callable[[int], Result],
        windows: Sequence[Window],
        count: int,
        progress: Progress,
    ) -> Iterator[Result]:
        """Yield what is found on the rays of windows, cast into `count` splats."""
        seconds = SECONDS * (count + self.around) * len(windows)
        seconds += SECONDS_OF_RAY * sum(window.rays for window in windows)
        return run(
            work, range(len(windows)), cost=seconds,
            progress=progress, what="refitting", threads=self._threads,
        )  # fmt: skip


def limits(count: int) -> tuple[float, float]:
    """Return about how many rays and hits a round of `count` survivors may have."""
    hits = min(max(HITS_OF_SPLAT * count, MIN_HITS), max(FEWER_HITS * count, MANY_HITS))
    return max(RAYS_OF_SPLAT * count, MIN_RAYS), hits


def steps_of(views: Sequence[View], scene: Scene) -> list[float]:
    """Return how far each view is moved, world units; see `SHIFT`."""
    centers = np.stack([view.center for view in views])
    steps = []
    for center in centers:
        away = np.linalg.norm(centers - center, axis=1)
        apart = away[away > _SAME * scene.size]
        nearest = SHIFT * apart.min() if len(apart) else 0.0
        steps.append(float(min(nearest, MAX_SHIFT * scene.size)))
    return steps


@dataclass(frozen=True, eq=False)
class CastTruth:
    """Casts the rays of a round of a view into the unpruned splats; any process can.

    Attributes
    ----------
    target : Target
        The unpruned splats.
    windows : sequence of Window
    round : int
        Its number; 0 for the validation rays.
    shown : float or None
        Of the validation rays, see `Truth`; None before these are cast.
    """

    target: Target
    windows: Sequence[Window]
    round: int
    shown: float | None = None

    def __call__(self, place: int) -> Truth:
        """Return the rays of a view."""
        window = self.windows[place]
        with np.errstate(under="ignore"):
            footprints = self.target.footprints(window)
            # Casting takes memory for all hits, also faint ones, but for one view at a time.
            share = window.hits / MAX_HITS_OF_VIEW
            foretold = depth_complexity(footprints, window.part)
            each = (share if self.shown is None else self.shown) * foretold
            columns, rows = window.pixels(each, self.round)
            rays, transmittance = cast_visible(footprints, columns, rows)
            most = share * len(rays.ray)
            weight = transmittance * rays.alpha
            colors = rays.composited(weight, self.target.colors(rays.hit, window.view))
        each = max(np.count_nonzero(weight > LEAST_WEIGHT), most) / max(rays.count, 1)
        return Truth(columns, rows, colors, each / max(foretold, _NOTHING))


@dataclass(frozen=True, eq=False)
class _CastPsnr:
    """Casts rays of a view into survivors, and compares colours; any process can."""

    target: Target
    windows: Sequence[Window]
    truths: Sequence[Truth]

    def __call__(self, number: int) -> float:
        """PSNR of the colours that the rays of a view see, dB."""
        window, truth = self.windows[number], self.truths[number]
        with np.errstate(under="ignore"):
            footprints = self.target.footprints(window)
            rays, transmittance = cast_visible(footprints, truth.columns, truth.rows)
            colors = self.target.colors(rays.hit, window.view)
            seen = rays.composited(transmittance * rays.alpha, colors)
        return psnr_of(seen, truth.colors, window.part)


@dataclass(frozen=True, eq=False)
class _Linearize:
    """Casts the rays of a round of a view, and finds how their colours change; any process can."""

    truth: CastTruth
    target: Target
    shapes: Shapes

    def __call__(self, number: int) -> SeenView:
        """Return how the colours of a view's rays change with the survivors."""
        window, truth = self.truth.windows[number], self.truth(number)
        with np.errstate(under="ignore"):
            footprints = self.target.footprints(window)
            seen = cast_visible(footprints, truth.columns, truth.rows)
            colors = self.target.colors(seen.rays.hit, window.view)
            return linear_view(seen, footprints, truth.colors, colors, self.shapes, window.view)
