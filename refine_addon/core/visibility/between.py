"""Views between the cameras: what they alone see, no camera tells of."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, run_all, silent
from ..splats import rotation_matrices, unit_quaternions
from ..views import View, ViewSet
from . import projection
from .cast import cast
from .projection import Gaussians
from .scene import Scene

WIDEST = math.radians(90.0)  # views turned farther from each other get no view in between
CLEAR = 0.5  # least transmittance between two views that stand in the same free space
BESIDE = 0.3  # how far a step of `views_beside` is at most, scene sizes
FAR, TURNED = 0.31, 0.05
"""Steps of `views_beside`, times `far`, in distances to the third view, and turns in radians."""
_STEPS, _TRIES = 2, 16  # around corners, too; tries for both
_CANDIDATES = 64  # nearest views of each that may be its neighbours
_FOCAL = 1000.0  # px of `transmittance`: a ray is a thousandth of its length wide


def views_between(
    views: ViewSet,
    most: int,
    within: tuple[Gaussians, Scene] | None = None,
) -> list[View]:
    """At most `most` views halfway between neighbours, chosen as by `ViewSet.spread`.

    By `ViewSet.places`, neighbours have no third view nearer to their middle than they are (Gabriel
    graph, Gabriel and Sokal 1969). Centres and rotations are means, the lens is that of one of the
    two. Neither the frame matters, nor the order of views whose names differ. `within` a scene
    neighbours are not hidden from each other by its splats.
    """
    ordered = [view for view, _ in views.by_distance()]
    if most < 1 or len(ordered) < 2:
        return []

    def halfway(numbers: tuple[int, int]) -> View | None:
        pair = [ordered[number] for number in numbers]
        one, two = sorted(pair, key=lambda view: view.name)
        # Singular values of the mean are 1 and the cosine of half the angle between both.
        left, size, right = np.linalg.svd((one.rotation + two.rotation) / 2.0)
        start, end = (view.center for view in pair)
        if (start == end).all() or size[-1] < math.cos(WIDEST / 2.0):
            return None  # also if one is mirrored
        if within and transmittance(*within, start, end) < CLEAR:
            return None
        return replace(
            one, rotation=left @ right, center=(one.center + two.center) / 2.0,
            weight=one.weight / 2.0 + two.weight / 2.0, name=f"{one.name} - {two.name}",
        )  # fmt: skip

    pairs = _neighbours(ViewSet(tuple(ordered)).places())
    threads = None if within else 1  # on one it takes little time
    found = [view for view in run_all(halfway, pairs, threads=threads) if view is not None]
    return list(ViewSet(tuple(found)).spread(most)) if found else []


def with_views_between(
    views: ViewSet, count: int, gaussians: Gaussians, scene: Scene
) -> list[View]:
    """Up to `count` views between neighbours in free space, between those, and so on."""
    found: list[View] = []
    while more := views_between(
        replace(views, views=(*views, *found)), count - len(found), (gaussians, scene)
    ):
        found += more
    return found


def views_beside(
    views: ViewSet,
    gaussians: Gaussians,
    scene: Scene,
    far: float,
    most: int,
    seed: int,
    *,
    progress: Progress = silent,
) -> list[View]:
    """At most `most` views two steps and turns away from `views`, several each, in free space.

    Steps and turns are `far` times `FAR` and `TURNED`. They face no wall near.
    """
    centers = views.centers
    starts = [view for view, _ in views.spread(most).by_distance()]

    def beside(numbered: tuple[int, View]) -> View | None:
        number, view = numbered
        away = np.sort(np.linalg.norm(centers - view.center, axis=1))[1:4]
        longest = min([BESIDE * scene.size, *(far * FAR * away[-1:])])
        random, taken = np.random.default_rng([seed, number]), 0
        for _ in range(_TRIES):
            step = longest * random.normal(size=3) * (1.0, 0.4, 1.0) / math.sqrt(3.0)
            turn = far * TURNED * random.normal(size=3) * (0.4, 1.0, 0.1)
            turned = rotation_matrices(unit_quaternions(np.array([[1.0, *turn]])))[0]
            moved = replace(
                view, center=view.center + step @ view.rotation, rotation=turned @ view.rotation
            )
            ahead = moved.center + np.linalg.norm(step) * moved.rotation[2]
            paths = [(view.center, moved.center), (moved.center, ahead)]
            if all(transmittance(gaussians, scene, *path) > CLEAR for path in paths[: taken + 1]):
                view, taken = moved, taken + 1
                if taken == _STEPS:
                    return replace(view, name=f"{number} beside {view.name}")
        return None

    numbered = enumerate((starts * most)[:most])
    return [*filter(None, run_all(beside, numbered, progress=progress, what="scoring"))]


def transmittance(
    gaussians: Gaussians, scene: Scene, start: NDArray[np.float64], end: NDArray[np.float64]
) -> float:
    """Share of the light that passes from `start` to another place, `end`, (3,) world units."""
    step = end - start
    if not (length := float(np.linalg.norm(step))):
        return 1.0
    along = step / length
    across = np.cross(np.eye(3)[np.argmin(np.abs(along))], along)
    across /= np.linalg.norm(across)
    rotation, pixel = np.stack([across, np.cross(along, across), along]), np.zeros(1, np.int64)
    ray = View(rotation, start, _FOCAL, _FOCAL, 0.5, 0.5, 1, 1, far=length)
    hits = cast(projection.project(gaussians, scene, ray), pixel, pixel)
    return float(np.exp(np.log1p(-hits.alpha).sum(dtype=np.float64)))


def _neighbours(place):
    """Pairs of neighbours among places, (V, 6), the smaller number first, ascending."""
    pairs = []
    for number, here in enumerate(place):
        distance = _distances(place, here)  # (V,)
        nearest = np.argsort(distance, kind="stable")[: _CANDIDATES + 1]
        for other in nearest[nearest > number].tolist():
            # A place is nearer to the middle if and only if it sees the two at an obtuse angle.
            squares = distance + _distances(place, place[other])
            squares[[number, other]] = np.inf
            if squares.min() >= distance[other]:
                pairs.append((number, other))
    return sorted(pairs)


def _distances(place, here):
    """Squared distances of places from one, (V,), rounded: equal ones stay equal."""
    return np.round(np.sum((place - here) ** 2, axis=1), 9)
