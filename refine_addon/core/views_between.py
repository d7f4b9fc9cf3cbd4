"""Views halfway between neighbouring ones: what a viewer sees who walks from camera to camera.

Nobody took a picture there, and none is needed: what these views see of the unpruned splats is the
truth that pruned ones are compared with.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from .errors import RefineError
from .views import View, ViewSet

WIDEST = math.radians(90.0)
"""Views that are turned farther than that from each other have nothing between them."""

MOST = 1000
"""So many may be added at most: each is compared with all others, so more would take minutes."""

_CANDIDATES = 64
"""So many of the nearest views of each are looked at for neighbours."""


def views_between(views: ViewSet, most: int) -> list[View]:
    """At most `most` views, each halfway between two neighbours, evenly from all there are.

    Two views are neighbours if no third is nearer to the place halfway between them than they are
    (the Gabriel graph, Gabriel and Sokal 1969), by `ViewSet.places`. A view between them has the
    mean of their positions and rotations, and the lens of one of them.

    Parameters
    ----------
    views : ViewSet
    most : int

    Returns
    -------
    list of View
        Empty where all views stand in one place or there is but one. Neither the frame of the views
        nor, as far as names differ, their order changes it.
    """
    ordered = [view for view, _ in views.by_distance()]
    if most < 1 or len(ordered) < 2:
        return []
    centers = np.array([view.center for view in ordered])
    place = ViewSet(tuple(ordered)).places()
    halfway = [
        view
        for first, second in _neighbours(place)
        if (centers[first] != centers[second]).any()
        and (view := _halfway(ordered[first], ordered[second])) is not None
    ]
    return list(ViewSet(tuple(halfway)).spread(most)) if halfway else []


def with_views_between(views: ViewSet, count: int) -> ViewSet:
    """Views with about `count` more between them: all at first, then again between these.

    Parameters
    ----------
    views : ViewSet
    count : int
        How many to add, 0 to `MOST`; fewer where there are none left.

    Raises
    ------
    RefineError
        If `count` is out of range.
    """
    if not 0 <= count <= MOST:
        raise RefineError(f"views in between are {count:,}, expected 0 to {MOST:,}")
    while count > 0:
        more = views_between(views, count)
        if not more:
            break
        views, count = replace(views, views=(*views, *more)), count - len(more)
    return views


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
    """Squares of how far places are from one, (V,), rounded: equal ones stay equal."""
    return np.asarray(np.round(np.sum((place - here) ** 2, axis=1), 9))


def _halfway(one, other):
    """View halfway between two; None where they look too far apart, or one is mirrored.

    The rotation is the one nearest to the mean of both. The singular values of this mean are 1 and
    the cosine of half the angle between them, so they also tell how far apart they look.
    """
    one, other = sorted((one, other), key=lambda view: view.name)
    left, size, right = np.linalg.svd((one.rotation + other.rotation) / 2.0)
    if size[-1] < math.cos(WIDEST / 2.0):
        return None
    return replace(
        one,
        rotation=left @ right,
        center=(one.center + other.center) / 2.0,
        weight=one.weight / 2.0 + other.weight / 2.0,
        name=f"{one.name} - {other.name}",
    )
