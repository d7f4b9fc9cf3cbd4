"""The rays of all rounds of refitting: what the unpruned splats look like on them, and survivors.

Each round learns from rays through other pixels. Validation rays, which no round learns from, tell
what a round has gained.

Views are cast in processes of their own, as they are measured (`processes`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, TypeVar

import numpy as np

from ..estimate.quality import PSNR_CAP
from ..processes import for_each
from ..seeing import projection
from ..seeing.cast import cast, pixels
from ..seeing.ray_sample import MAX_HITS_OF_VIEW, MAX_RAYS_OF_VIEW, colors_from
from ..work import Progress, part
from .linear import LinearView, Shapes, linear_view

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from ..seeing.projection import Footprints, Gaussians
    from ..seeing.scene import Scene
    from ..splats import Splats
    from ..views import View, ViewSet

Result = TypeVar("Result")

RAYS_OF_SPLAT = 4.0
"""Rays of a round for each survivor: with fewer, survivors learn them by heart."""

MIN_RAYS = 1 << 16
"""Rays of a round where that would be fewer."""

VALIDATION_RAYS = 1 << 15
"""Rays of all views together that nothing is learned from: they tell what a round gained."""

MAX_HITS = 1 << 25
"""About how many hits the rays of a round may have on the unpruned splats. Survivors have fewer,
and those that hardly show are left out: some 50 bytes are taken for at most every second."""

SECONDS, SECONDS_OF_RAY = 2.5e-7, 4e-6
"""About how long one core takes to project a splat into a view, and to cast a ray, to tell what is
worth a process."""

_OTHER_PIXELS = 2  # numbers of pixels that an estimate and scoring take, see `cast.pixels`
_LEAST_ERROR = 10.0 ** (-PSNR_CAP / 10.0)


class Target(Protocol):
    """Splats that rays are cast into. It is pickled, so that any process can."""

    def footprints(self, view: View) -> Footprints:
        """Return the footprints in a view; their index says which of the splats they are."""
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

    def footprints(self, view: View) -> Footprints:
        """Return the footprints in a view."""
        return projection.project(self.gaussians, self.scene, view)

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
    original : Splats
        The unpruned splats, in the frame of the views.
    views : ViewSet
    count : int
        How many survivors there are.
    rounds : int
        How many rounds rays are cast for.
    progress : callable
    threads : int, optional

    Attributes
    ----------
    scene : Scene
        Of the unpruned splats.
    views : list of (View, float)
        Views and their weights, see `ViewSet.by_distance`.
    """

    def __init__(
        self,
        original: Splats,
        views: ViewSet,
        count: int,
        rounds: int,
        progress: Progress,
        threads: int | None,
    ) -> None:
        self.views, self._chosen, self._threads = views.by_distance(), views, threads
        gaussians, self.scene, _ = projection.prepare(
            original, views, progress=part(progress, 0.0, 0.2), threads=threads
        )
        target = InMemory(original, gaussians, self.scene)
        rays = max(RAYS_OF_SPLAT * count, MIN_RAYS)
        work = _CastTruth(target, self.views, rays, MAX_HITS, rounds)
        seconds = SECONDS * len(original) * len(self.views) + SECONDS_OF_RAY * (
            rays * rounds + VALIDATION_RAYS
        )
        views_of_rounds = for_each(
            work, len(self.views), seconds,
            progress=part(progress, 0.2, 1.0), what="casting rays", threads=threads,
        )  # fmt: skip
        self._validation, *self._rounds = map(list, zip(*views_of_rounds, strict=True))

    def truths(self, number: int) -> list[Truth]:
        """Return the rays of a round, of each view."""
        return self._rounds[number]

    def linear(self, splats: Splats, number: int, progress: Progress) -> list[LinearView]:
        """Return how the colours of each view's rays change with survivors as they are now.

        Parameters
        ----------
        splats : Splats
            The survivors.
        number : int
            Of the round.
        progress : callable
        """
        target = self._prepared(splats, part(progress, 0.0, 0.1))
        shapes = Shapes.of(splats, target.gaussians, self.scene)
        truths = self.truths(number)
        work = _Linearize(target, self.views, truths, shapes)
        return self._each(work, truths, len(splats), part(progress, 0.1, 1.0))

    def psnr(self, splats: Splats, progress: Progress) -> float:
        """Return the mean PSNR of survivors on validation rays, weighted as the views are, dB."""
        target = self._prepared(splats, part(progress, 0.0, 0.1))
        work = _CastErrors(target, self.views, self._validation)
        errors = self._each(work, self._validation, len(splats), part(progress, 0.1, 1.0))
        weights = [weight for _, weight in self.views]
        return float(np.average(-10.0 * np.log10(errors), weights=weights))

    def _prepared(self, splats: Splats, progress: Progress) -> InMemory:
        gaussians, _, _ = projection.prepare(
            splats, self._chosen, self.scene, progress=progress, threads=self._threads
        )
        return InMemory(splats, gaussians, self.scene)

    def _each(
        self,
        work: Callable[[int], Result],
        truths: Sequence[Truth],
        count: int,
        progress: Progress,
    ) -> list[Result]:
        """Return what is found on the rays of each view, of `count` survivors."""
        rays = sum(truth.colors.shape[1] for truth in truths)
        seconds = SECONDS * count * len(self.views) + SECONDS_OF_RAY * rays
        return [
            *for_each(
                work, len(self.views), seconds,
                progress=progress, what="refitting", threads=self._threads,
            )
        ]  # fmt: skip


@dataclass(frozen=True, eq=False)
class _CastTruth:
    """Casts the rays of all rounds of a view; any process can.

    All views together have about `rays` rays in each of so many rounds, and at most about `hits`
    hits on the unpruned splats.
    """

    target: Target
    views: Sequence[tuple[View, float]]
    rays: float
    hits: float
    rounds: int

    def __call__(self, number: int) -> list[Truth]:
        """Return the rays of a view that validate, and those of each round."""
        view, count = self.views[number][0], len(self.views)
        places = [number + (_OTHER_PIXELS + other) * count for other in range(self.rounds + 1)]
        with np.errstate(under="ignore"):
            footprints = self.target.footprints(view)
            validation, hits = self._cast(
                view, footprints, pixels(view, places[0], VALIDATION_RAYS / count)
            )
            limit = min(self.hits / count, MAX_HITS_OF_VIEW) / max(hits, 1.0)
            rays = min(self.rays / count, limit, MAX_RAYS_OF_VIEW)
            of_rounds = (
                self._cast(view, footprints, pixels(view, place, rays)) for place in places[1:]
            )
            return [validation, *(truth for truth, _ in of_rounds)]

    def _cast(
        self,
        view: View,
        footprints: Footprints,
        chosen: tuple[NDArray[np.int64], NDArray[np.int64]],
    ) -> tuple[Truth, float]:
        """Return the rays through some columns and rows of pixels, and how many hits one has."""
        rays = cast(footprints, *chosen)
        colors = rays.colors(self.target.colors(rays.hit, view))
        return Truth(*chosen, colors.astype(np.float32)), len(rays.ray) / max(rays.count, 1)


@dataclass(frozen=True, eq=False)
class _CastErrors:
    """Casts rays of a view into survivors, and compares colours; any process can."""

    target: Target
    views: Sequence[tuple[View, float]]
    truths: Sequence[Truth]

    def __call__(self, number: int) -> float:
        """Return the mean squared error of the colours that the rays of a view see."""
        view, truth = self.views[number][0], self.truths[number]
        with np.errstate(under="ignore"):
            rays = cast(self.target.footprints(view), truth.columns, truth.rows)
            seen = rays.colors(self.target.colors(rays.hit, view))
        return float(max(np.mean(np.square(truth.colors - seen)), _LEAST_ERROR))


@dataclass(frozen=True, eq=False)
class _Linearize:
    """Casts the rays of a round of a view, and finds how their colours change; any process can."""

    target: Target
    views: Sequence[tuple[View, float]]
    truths: Sequence[Truth]
    shapes: Shapes

    def __call__(self, number: int) -> LinearView:
        """Return how the colours of a view's rays change with the survivors."""
        view, truth = self.views[number][0], self.truths[number]
        with np.errstate(under="ignore"):
            footprints = self.target.footprints(view)
            rays = cast(footprints, truth.columns, truth.rows)
            colors = self.target.colors(rays.hit, view)
            return linear_view(rays, footprints, colors, self.shapes, view)
