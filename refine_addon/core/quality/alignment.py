"""Whether cameras and splats belong together: pictures are finest where the capture was made.

    fineness = mean over pixels of the sum of  T_i alpha_i / (1 + (s_i / (FINE side))^2)

s and side, px, are geometric means of a footprint's standard deviations and of the image's sides.
From far away all pictures are fine, so beyond a distance d, a share of the cameras' distances from
their middle, splats count as large as they would be there. Much finer pictures after a turn
about x mean that only one of the files was turned. Distant views are named, too (`SMALL`).
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..affine import QUARTERS
from ..execute import run_all
from ..splats import Splats
from ..views import View, ViewSet
from ..visibility import frustum, projection
from ..visibility.cast import cast, pixels

SAMPLE = 4096
"""About this many splats stand for all, each enlarged to the area of those it stands for."""

POINTS = 512
"""About this many splats show which views are distant."""

VIEWS = 12
"""Most views that are turned."""

RAYS = 1024
"""Rays of all of them together."""

FINE = 0.015
"""Standard deviation at which a splat is half as fine as a point, as a share of the image."""

NEAR = 0.3
"""The distance d over the median distance of the views from their middle."""

BETTER = 1.5
"""Factor by which turned cameras must see finer pictures."""

_FARTHEST = 1e9  # largest depth over d: its square fits float32

LEAST = 0.005
"""Pictures less fine show too little to decide by."""

ONE_WAY = 0.95
"""Views whose mean direction is this long look one way: turned, they would see another part."""

WHOLE = 0.8
"""Mean share of splats in the picture if views see the whole from outside, turned or not."""

FEW = 8
"""A view with fewer splats of the sample is never called distant."""

SMALL = 0.02
"""A view is distant if its splats, without a tenth on each side, fill less of width and height."""


class Alignment(NamedTuple):
    """Whether the views are to be turned, and which are far away from the splats."""

    turn: int = 0  # quarters about x (`affine.QUARTERS`) to turn the views by: 0, 1, -1 or 2
    known: bool = False  # by the import; else it was measured
    fineness: tuple[float, ...] = ()  # turned by each of `affine.QUARTERS`; or ()
    far: tuple[str, ...] = ()  # names of the views that see the splats from far away

    def notes(self) -> list[str]:
        """Notes for the user, in sentences."""
        return [note for note in (self.turned(), self.distant()) if note]

    def turned(self) -> str:
        """A sentence if the views are to be turned, else ""."""
        if not self.turn:
            return ""
        angle = "half" if self.turn == 2 else "a quarter"
        if self.known:
            return (
                "cameras and splats do not share an up axis: only one of them was imported "
                f"upright; turn the cameras {angle} about X"
            )
        now, turned = self.fineness[0], self.fineness[list(QUARTERS).index(self.turn)]
        return (
            f"cameras and splats do not seem to share an up axis: turned {angle} about X, the "
            f"cameras would see pictures {min(turned / max(now, 1e-9), 99.0):.1f} times as fine"
        )

    def distant(self) -> str:
        """A sentence if views see the splats from far away, else ""."""
        if not self.far:
            return ""
        count = "1 camera sees" if len(self.far) == 1 else f"{len(self.far):,} cameras see"
        return (
            f"{count} the splats from so far away that they fill less than {SMALL:.0%} of a picture"
        )

    def facts(self) -> dict[str, Any]:
        """Its fields as plain JSON values."""
        rounded = [round(value, 4) for value in self.fineness]
        return {**self._asdict(), "fineness": rounded, "far": list(self.far)}

    @classmethod
    def from_facts(cls, facts: Mapping[str, Any] | None) -> Alignment:
        """Inverse of `facts`; an empty alignment if they are malformed."""
        try:
            stored = dict(facts or {})
            turn, known = int(stored.get("turn", 0)), bool(stored.get("known", False))
            fineness = tuple(float(value) for value in stored.get("fineness", ()))
            far = tuple(str(name) for name in stored.get("far", ()))
        except (TypeError, ValueError):
            return cls()
        whole = turn in QUARTERS and len(fineness) in {0, len(QUARTERS)} and (known or fineness)
        return cls(turn if whole else 0, known, fineness, far)


def alignment(splats: Splats, views: ViewSet, used: ViewSet | None = None) -> Alignment:
    """Whether views are to be turned, by some of `used`, and which are far (docs/method.md, 10)."""
    with np.errstate(under="ignore", invalid="ignore"):  # signalling NaN
        means = splats.means[_spread_rows(splats, POINTS)].astype(np.float64)  # (n, 3)
        seen = [(view, in_picture(means, view)) for view in views if view.weight]
        unturned = Alignment(far=tuple(view.name for view, points in seen if _is_far(points, view)))
        if views.turn is not None:
            return unturned._replace(turn=views.turn, known=True)
        one_way = np.linalg.norm(views.rotations[:, 2].mean(axis=0)) >= ONE_WAY
        in_pictures = sum(points.shape[1] for _, points in seen)
        if used is None or one_way or in_pictures >= WHOLE * (len(means) * len(seen)):
            return unturned
        fineness = _fineness(splats, used.spread(VIEWS))
    best = list(QUARTERS)[int(np.argmax(fineness))]
    turn = best if max(fineness) > max(BETTER * fineness[0], LEAST) else 0
    return unturned._replace(turn=turn, fineness=fineness)


def _spread_rows(splats, count):
    """Rows of at least `count` splats, if there are as many, evenly spread."""
    return np.arange(0, len(splats), max(len(splats) // count, 1))


def in_picture(means: NDArray[np.float64], view: View) -> NDArray[np.float64]:
    """Points, (n, 3), that lie in a view's picture, in the axes of the view, (3, m)."""
    with np.errstate(over="ignore", invalid="ignore"):
        local = view.rotation @ (means - view.center).T  # (3, n)
        planes = frustum.clip_planes(view, float(np.finfo(np.float64).tiny))
        return local[:, frustum.contains(view, local, planes)]


def _is_far(points, view):
    """Whether all that a view sees, (3, m) as of `in_picture`, lies in a small part of it."""
    if points.shape[1] < FEW:
        return False
    ordered, tenth = np.sort(points[:2] / points[2], axis=1), points.shape[1] // 10
    widths = ordered[:, -1 - tenth] - ordered[:, tenth]  # (2,)
    return (widths * (view.fx / view.width, view.fy / view.height)).max() < SMALL


def _fineness(splats, views):
    """Fineness of the pictures of views, turned by each of `QUARTERS`."""
    rows = _spread_rows(splats, SAMPLE)
    stand_for = len(splats) / len(rows)
    sample = splats.take(rows)
    larger = np.asarray(sample.log_scales, np.float64) + 0.5 * np.log(stand_for)
    sample = replace(sample, log_scales=larger, sh_rest=sample.sh_rest[:, :0])
    gaussians, scene, _ = projection.prepare(sample, views)
    ordered = [view for view, _ in views.by_distance()]
    near = NEAR * views.middle()[1] ** 0.5 / scene.size

    def of_turned(item):
        rotation, (number, view) = item
        with np.errstate(over="ignore", under="ignore"):
            view = view.turned(rotation)
            footprints = projection.project(gaussians, scene, view)
            rays = cast(footprints, *pixels(view, number, RAYS / len(ordered)))
            square = np.zeros(len(gaussians))  # px^2
            square[footprints.index] = footprints.sigmas[0] * footprints.sigmas[1] / stand_for
            square /= FINE**2 * view.width * view.height
            if near:
                depths = projection.coordinates(gaussians.means, scene, view)[2]
                square *= np.clip(depths / near, 1.0, _FARTHEST) ** 2
            fine = rays.weights() / (1.0 + square[rays.hit[rays.owner]])
            return float(fine.sum()) / rays.count

    turned = itertools.product(QUARTERS.values(), enumerate(ordered))
    fineness = run_all(of_turned, turned)
    return tuple(np.reshape(fineness, (len(QUARTERS), -1)).mean(axis=1).tolist())
