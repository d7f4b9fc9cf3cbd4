"""The rays of all rounds of refitting, and the colours of unpruned and kept splats on them.

Each round, and validation, takes other pixels of views moved beside the given ones (`SHIFT`), since
fits to the given views alone do not hold in between. Processes cast the views.
"""

from __future__ import annotations

import os
import pickle
import tempfile
import threading
import weakref
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, in_file, part, return_freed, run, seconds
from ..mapped import folder_of
from ..quality.psnr import psnr_of
from ..splats import Splats
from ..views import View, ViewSet
from ..visibility import cast, projection
from ..visibility.projection import Footprints, Gaussians
from ..visibility.scene import Scene
from .linear import COUNT, LEAST_WEIGHT, LinearView, Shapes, Singles, linear_view

RAYS_OF_SPLAT = 7.0
"""Rays of a round for each kept splat. Fits to fewer do not hold on other rays, and two rounds of
half as many gain less than one."""

MIN_RAYS = 1 << 17  # of a round, if that is more than by `RAYS_OF_SPLAT`

HITS_OF_SPLAT, MIN_HITS = 112, 3 << 21
"""Most hits of a round on the unpruned splats (about; above `linear.LEAST_WEIGHT`), for each kept
splat, or in all if that is more. Each takes 14 bytes of a file (`Stored`)."""

MANY_HITS, FEWER_HITS = 1 << 24, 64
"""Rounds of more hits have at most this many for each kept splat, to bound that file."""

SHIFT, MAX_SHIFT = 0.7, 0.1
"""Move of a view in a round, about: in distances to the next view; at most in scene sizes."""

VALIDATION_VIEWS, APART = 12, 6
"""Validation rays go from about so many views, or from every sixth if these are more: near few
cameras a view can gain or lose 10 dB by chance."""

_SAME = 1e-6  # scene sizes; views nearer to each other stand in one place
_EVERY = 2  # validation rays go through every second row of a round's rays
_NOTHING = 1e-30  # hits of a ray; keeps a division finite


@dataclass(frozen=True, eq=False)
class Window:
    """Part of a view that rays go through, and how many do in each round."""

    view: View
    number: int  # of the view, see `cast.pixels`
    weight: float  # in the PSNR
    rays: float  # about
    hits: float  # about, on the unpruned splats
    box: tuple[int, int, int, int]  # left, top, width and height of the part, px
    step: float  # about how far the view moves in a round, world units

    @cached_property
    def part(self) -> View:
        """The part of the image as a view of its own."""
        view, (left, top, width, height) = self.view, self.box
        return replace(view, cx=view.cx - left, cy=view.cy - top, width=width, height=height)

    def moved(self, number: int) -> Window:
        """The same window of the view as it stands in a round, from 1."""
        random = np.random.default_rng([self.number, number])
        shift = self.step * random.normal(size=3) / np.sqrt(3.0)  # along the camera's axes
        center = self.view.center + shift @ self.view.rotation
        return replace(self, view=replace(self.view, center=center))

    def pixels(self, hits: float, number: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Columns and rows of a round's rays (0: validation), `hits` each, as an R2 sequence."""
        count = min(self.rays, self.hits / max(hits, 1.0), cast.MAX_RAYS_OF_VIEW)
        columns, rows = cast.pixels(self.part, self.number + 1 + number, count)
        if not number:
            rows = rows[::_EVERY]
        return columns + self.box[0], rows + self.box[1]


@dataclass(frozen=True, eq=False)
class Target:
    """Splats that rays are cast into, in files."""

    splats: Splats  # as the Gaussians are ordered, if they were in memory
    gaussians: Gaussians
    scene: Scene

    @classmethod
    def of(cls, splats: Splats, gaussians: Gaussians, scene: Scene, **more: Any) -> Target:
        """Splats that were in memory or in files, and the Gaussians made of them."""
        if folder_of(splats) is None:
            splats = in_file(splats.take(gaussians.index))
        return cls(splats, gaussians, scene, **more)

    def footprints(self, window: Window) -> Footprints:
        """Footprints in a view that may reach into a window, with the rows of the Gaussians."""
        footprints = projection.project(self.gaussians, self.scene, window.view, window.part)
        return_freed(mapped_only=True)
        return footprints

    def colors(self, hit: NDArray[np.int64], view: View) -> Singles:
        """Colours in which a view sees the Gaussians `hit`, (3, u)."""
        rows = hit if folder_of(self.splats) is None else self.gaussians.index[hit]
        return cast.colors_from(self.splats, rows, view.center)


class Truth(NamedTuple):
    """Rays of one view, and the colours of the unpruned splats on them."""

    columns: NDArray[np.int64]  # (C,), see `Rays`
    rows: NDArray[np.int64]  # (R,)
    colors: Singles  # (3, P)
    shown: float  # hits that count for `Window.hits`, over those that footprint sizes predict


class RoundRays:
    """The rays of all rounds, with the colours of the unpruned splats on them."""

    def __init__(
        self,
        windows: Sequence[Window],
        original: Target,
        kind: Callable[..., Target] = Target.of,
    ) -> None:
        self.windows, self.original, self._kind = windows, original, kind
        self._validation: list[tuple[Window, Truth]] = []

    @classmethod
    def of(cls, original: Splats, views: ViewSet, count: int, progress: Progress) -> RoundRays:
        """Rays of all views into `original`, as many as `limits` of `count` kept splats."""
        gaussians, scene, _ = projection.prepare(original, views, progress=progress)
        chosen = views.by_distance()
        rays, hits = (each / len(chosen) for each in limits(count))
        steps = steps_of([view for view, _ in chosen], scene)
        windows = [
            Window(view, number, weight, rays, hits, (0, 0, view.width, view.height), step)
            for number, ((view, weight), step) in enumerate(zip(chosen, steps, strict=True))
        ]
        return cls(windows, Target.of(original, gaussians, scene))

    def linear(self, splats: Splats, number: int, progress: Progress) -> LinearRays:
        """The rays of a round, from 1, linearized at the kept splats; call `psnr` before."""
        target = self.target(splats, part(progress, 0.0, 0.05))
        shapes = Shapes.of(splats, target.gaussians, target.scene)
        shares = [truth.shown for _, truth in self._validation]
        shown = float(np.mean(shares)) if shares else None
        truth_of = partial(cast_truth, self.original, number, shown)
        work = partial(_linearized, truth_of, target, shapes)
        windows = [window.moved(number) for window in self.windows]
        return LinearRays(shapes, self._each(work, windows, splats, part(progress, 0.05, 1.0)))

    def psnr(self, splats: Splats, progress: Progress) -> float:
        """Mean PSNR of kept splats on validation rays, weighted as the views are, dB."""
        if not self._validation:
            step = min(-(-len(self.windows) // VALIDATION_VIEWS), APART)
            windows = [window.moved(0) for window in self.windows[::step]]
            truth_of = partial(cast_truth, self.original, 0, None)
            truths = self._each(truth_of, windows, splats, part(progress, 0.0, 0.5))
            self._validation = [*zip(windows, truths, strict=True)]
        work = partial(_psnr, self.target(splats, part(progress, 0.5, 0.6)))
        psnr = [*self._each(work, self._validation, splats, part(progress, 0.6, 1.0))]
        return float(np.average(psnr, weights=[window.weight for window, _ in self._validation]))

    def target(self, splats: Splats, progress: Progress) -> Target:
        """What rays are cast into: these kept splats, and any others that `kind` adds."""
        views, scene = ViewSet(tuple(window.view for window in self.windows)), self.original.scene
        gaussians, *_ = projection.prepare(splats, views, scene, progress=progress)
        return self._kind(splats, gaussians, scene)

    def _each(self, work, items, splats, progress):
        cost = seconds("refit", len(self.original.splats) + len(splats), len(items))
        return run(work, items, cost=cost, progress=progress, what="refitting")


def limits(count: int) -> tuple[float, float]:
    """About how many rays and hits a round has, for `count` kept splats (docs/method.md, 12)."""
    hits = min(max(HITS_OF_SPLAT * count, MIN_HITS), max(FEWER_HITS * count, MANY_HITS))
    return max(RAYS_OF_SPLAT * count, MIN_RAYS), hits


def steps_of(views: Sequence[View], scene: Scene) -> list[float]:
    """About how far each view moves in a round, world units; see `SHIFT`."""
    centers = np.stack([view.center for view in views])
    steps = []
    for center in centers:
        away = np.linalg.norm(centers - center, axis=1)
        apart = away[away > _SAME * scene.size]
        nearest = SHIFT * apart.min() if len(apart) else 0.0
        steps.append(float(min(nearest, MAX_SHIFT * scene.size)))
    return steps


def cast_truth(target: Target, number: int, shown: float | None, window: Window) -> Truth:
    """Rays of a window in a round (0: validation), and the unpruned splats' colours.

    `shown` is the mean of `Truth.shown` over validation rays; None while these are cast.
    """
    footprints = target.footprints(window)
    # Casting takes memory for all hits, also faint ones, but for one view at a time.
    share = window.hits / cast.MAX_HITS_OF_VIEW
    predicted = cast.depth_complexity(footprints, window.part)
    each = (share if shown is None else shown) * predicted
    columns, rows = window.pixels(each, number)
    rays, transmittance = cast.cast_visible(footprints, columns, rows)
    all_hits = share * len(rays.ray)  # faint ones too, in units of `Window.hits`
    weight = transmittance * rays.alpha
    colors = rays.composited(weight, target.colors(rays.hit, window.view))
    each = max(np.count_nonzero(weight > LEAST_WEIGHT), all_hits) / max(rays.count, 1)
    return Truth(columns, rows, colors, each / max(predicted, _NOTHING))


def _psnr(target, window_and_truth):
    window, truth = window_and_truth
    footprints = target.footprints(window)
    rays, transmittance = cast.cast_visible(footprints, truth.columns, truth.rows)
    colors = target.colors(rays.hit, window.view)
    seen = rays.composited(transmittance * rays.alpha, colors)
    return psnr_of(seen, truth.colors, window.part)


def _linearized(truth_of, target, shapes, window):
    """How the colours of a view's rays change with the kept splats, see `LinearRays`."""
    truth = truth_of(window)
    footprints = target.footprints(window)
    seen: list[Any] = [*cast.cast_visible(footprints, truth.columns, truth.rows)]
    colors = target.colors(seen[0].hit, window.view)
    view, mine = linear_view(seen, footprints, truth.colors, colors, shapes, window.view)
    del footprints
    view.basis[:] *= target.splats.sh_rest.shape[1] > 0
    return view, view.backward(view.errors), view.diagonal(mine)


class LinearRays:
    """The colours of all rays, as a linear function of changes of M Gaussians.

    `seen` yields each view with its part of the gradient G'd and of the diagonal of G'G, (22, u).
    """

    def __init__(self, shapes: Shapes, seen: Iterable[tuple[LinearView, Singles, Singles]]) -> None:
        self.shapes, self.views, self.count = shapes, Stored(), 0  # count of rays
        residual, self.diagonal = np.zeros((2, COUNT, len(shapes)), np.float32)
        for view, of_residual, of_diagonal in seen:  # each as soon as it is there
            for band in view.bands():
                self.views.append(band)
            self.count += view.errors.shape[1]
            _add(residual, view.hit, of_residual)
            _add(self.diagonal, view.hit, of_diagonal)
            return_freed()
        self.residual = shapes.by_parameter(residual)

    def normal(self, change: Singles, progress: Progress) -> Singles:
        """G'G times a change of the parameters, (22, M)."""
        return_freed()
        in_scene = self.shapes.in_scene(change)
        total = np.zeros_like(in_scene)

        def of_view(number: int) -> tuple[NDArray[np.int64], Singles]:
            view = self.views[number]
            return view.hit, view.normal(in_scene)

        every = range(len(self.views))
        for of_hit in run(of_view, every, progress=progress, what="refitting"):
            _add(total, *of_hit)
        return self.shapes.by_parameter(total)


def _add(total, hit, values):
    """Add the values of the u Gaussians of a view, (k, u), to a sum over views, (k, M)."""
    for row, of_row in zip(total, values, strict=True):  # four times as fast as all at once
        if of_row.any():  # else no memory is touched
            row[hit] += of_row


class Stored:
    """A list of objects, in a temporary file as far as the disk has room."""

    def __init__(self) -> None:
        self._places: list[Any] = []  # what is pickled, or its start and end in the file
        self._file: Any = None
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._places)

    def append(self, item: Any) -> None:
        """Add an object, which may be changed afterwards."""
        place: Any = (data := pickle.dumps(item, 5))
        with suppress(OSError):
            if self._file is None:
                # Without a buffer, so that nothing is left to be written when it closes.
                self._file = tempfile.TemporaryFile("w+b", 0, prefix="refine-")  # noqa: SIM115
                weakref.finalize(self, self._file.close)
            start = self._file.seek(0, os.SEEK_END)
            if self._file.write(data) == len(data):
                place = start, start + len(data)
        self._places.append(place)

    def __getitem__(self, number: int) -> Any:
        """A copy of an object, equal to the bit, for any thread."""
        place = self._places[number]
        if isinstance(place, tuple):
            start, end = place
            with self._lock:
                self._file.seek(start)
                place = self._file.read(end - start)
        return pickle.loads(place)
