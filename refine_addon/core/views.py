"""Pinhole views in the OpenCV convention, one at a time and as a set."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .errors import RefineError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

ORTHONORMAL = 1e-3
"""How far from orthonormal a rotation may be: what four decimals in a text file leave."""


@dataclass(frozen=True, eq=False)
class View:
    """One pinhole camera: x right, y down, z forward; pixels, origin at the image's upper left.

    A point ``p`` of the world lies at ``rotation @ (p - center)`` in the camera, and at
    ``(fx x / z + cx, fy y / z + cy)`` in the image; the centre of pixel k is at k + 0.5.

    Attributes
    ----------
    rotation : (3, 3) float64
        World to camera, orthonormal; determinant -1 where the camera is mirrored.
    center : (3,) float64
        Centre of projection, world units.
    fx, fy, cx, cy : float
        Focal lengths and principal point, pixels.
    width, height : int
        Image size, pixels.
    near, far : float
        Clip distances along z, world units; 0 and infinity where the source knows none.
    weight : float
        How much this view counts among the others, >= 0.
    name : str
        Image or camera name, for messages.
    """

    rotation: NDArray[np.float64]
    center: NDArray[np.float64]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float = 0.0
    far: float = math.inf
    weight: float = 1.0
    name: str = ""

    def __post_init__(self) -> None:
        """Check everything: what is wrong here would surface as a wrong picture much later.

        Raises
        ------
        RefineError
            With the view's name and the value that cannot be.
        """
        try:
            rotation = np.array(self.rotation, np.float64)
            center = np.array(self.center, np.float64)
            _check_pose(rotation, center)
            self._check_image()
        except (TypeError, ValueError) as error:
            msg = f"view {self.name!r}: {error}"
            raise RefineError(msg) from error
        left, _, right = np.linalg.svd(rotation)
        object.__setattr__(self, "rotation", left @ right)  # files round; make it exactly rigid
        object.__setattr__(self, "center", center)

    def _check_image(self) -> None:
        numbers = (self.fx, self.fy, self.cx, self.cy, self.near, self.weight)
        if not all(math.isfinite(number) for number in numbers) or math.isnan(self.far):
            msg = f"fx, fy, cx, cy, near and weight must be finite, got {numbers}"
            raise ValueError(msg)
        size = (self.width, self.height)
        if self.fx <= 0 or self.fy <= 0 or min(size) < 1 or size != tuple(map(int, size)):
            msg = (
                "expected positive focal lengths and whole numbers of pixels, got "
                f"fx {self.fx}, fy {self.fy}, {self.width} x {self.height}"
            )
            raise ValueError(msg)
        if self.weight < 0 or self.near < 0 or self.far <= self.near:
            msg = (
                f"expected weight >= 0 and 0 <= near < far, got weight {self.weight}, "
                f"near {self.near}, far {self.far}"
            )
            raise ValueError(msg)


def _check_pose(rotation: NDArray[np.float64], center: NDArray[np.float64]) -> None:
    if rotation.shape != (3, 3) or center.shape != (3,):
        msg = f"expected rotation (3, 3) and center (3,), got {rotation.shape} and {center.shape}"
        raise ValueError(msg)
    if not (np.isfinite(rotation).all() and np.isfinite(center).all()):
        msg = "rotation and center must be finite numbers"
        raise ValueError(msg)
    if np.abs(center).max() > np.finfo(np.float32).max:
        msg = f"center {center.tolist()} is beyond the range of float32"
        raise ValueError(msg)
    # Entries first: those of a rotation are at most 1, and squares of others might overflow.
    largest = np.abs(rotation).max()
    if largest > 2 or np.abs(rotation @ rotation.T - np.eye(3)).max() > ORTHONORMAL:  # noqa: PLR2004
        msg = f"rotation is not orthonormal: {rotation.tolist()}"
        raise ValueError(msg)


@dataclass(frozen=True, eq=False)
class ViewSet:
    """The views that decide, as arrays.

    Attributes
    ----------
    views : tuple of View
        At least one, at least one with a positive weight.
    note : str
        What the source of the views had that is not modelled (lens distortion), or "".
    """

    views: tuple[View, ...]
    note: str = ""

    def __post_init__(self) -> None:
        """Refuse an empty set.

        Raises
        ------
        RefineError
            If there is no view, or none with a positive weight.
        """
        object.__setattr__(self, "views", tuple(self.views))
        if not self.views:
            msg = "no cameras: scoring needs at least one view"
            raise RefineError(msg)
        if not any(view.weight > 0 for view in self.views):
            msg = f"all {len(self.views)} views have weight 0: at least one must count"
            raise RefineError(msg)

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.views)

    def __iter__(self) -> Iterator[View]:
        """Iterate over the views in order."""
        return iter(self.views)

    def __getitem__(self, index: int) -> View:
        """Return one view."""
        return self.views[index]

    def take(self, indices: Sequence[int] | NDArray[Any]) -> ViewSet:
        """Return the views at `indices`, in that order."""
        return replace(self, views=tuple(self.views[int(index)] for index in indices))

    def select(self, names: Sequence[str]) -> ViewSet:
        """Return the views of these names, in the order of `names`; of equal names, the last.

        Raises
        ------
        RefineError
            If a name is not there.
        """
        by_name = {view.name: view for view in self.views}
        missing = [name for name in names if name not in by_name]
        if missing:
            msg = f"no view named {missing[0]!r} among {len(self)} views"
            raise RefineError(msg)
        return replace(self, views=tuple(by_name[name] for name in names))

    @property
    def centers(self) -> NDArray[np.float64]:
        """Centres of projection, (V, 3), world units."""
        return np.array([view.center for view in self.views])

    @property
    def rotations(self) -> NDArray[np.float64]:
        """World-to-camera rotations, (V, 3, 3)."""
        return np.array([view.rotation for view in self.views])

    @property
    def weights(self) -> NDArray[np.float64]:
        """Weights scaled to sum to 1, (V,)."""
        weights = np.array([view.weight for view in self.views], np.float64)
        with np.errstate(under="ignore"):  # a weight of 1e-300 beside one of 1e300 is none
            weights /= weights.max()  # first, so that weights of 1e308 do not sum to infinity
            return np.asarray(weights / weights.sum())

    def middle(self) -> tuple[NDArray[np.float64], float]:
        """Return where the views are, and how far from there, whatever a few stray ones do.

        Returns
        -------
        middle : (3,) float64
            Weighted geometric median of the centres (Weiszfeld's iteration).
        variance : float
            Weighted median of the centres' squared distances to it.
        """
        centers, weights = self.centers, self.weights
        with np.errstate(under="ignore"):
            middle = weights @ centers
            for _ in range(100):
                distance = np.linalg.norm(centers - middle, axis=1)
                # Half of the views are nearer than this, however far the farthest strays.
                reach = _median(distance, weights)
                if reach == 0.0:
                    break
                pull = weights / np.maximum(distance, 1e-9 * reach)
                before, middle = middle, (pull @ centers) / pull.sum()
                if np.linalg.norm(middle - before) <= 1e-12 * reach:
                    break
            squared = np.sum((centers - middle) ** 2, axis=1)
        return middle, _median(squared, weights)

    def spread(self, count: int) -> ViewSet:
        """Return at most `count` views that cover the set evenly, in their old order.

        Farthest-point sampling over position, in units of the root of `middle`'s variance, and
        viewing direction, from the view farthest from the middle of the set. Deterministic, and
        independent of the order and the unit of the set; a stray view takes one place, no more.

        Parameters
        ----------
        count : int
            How many to keep; 0 keeps all.
        """
        usable = np.array([index for index, view in enumerate(self.views) if view.weight > 0])
        if count <= 0 or len(usable) <= count:
            return self if len(usable) == len(self) else self.take(usable)
        middle, variance = self.middle()
        offset = self.centers[usable] - middle
        place = np.hstack([offset / (np.sqrt(variance) or 1.0), self.rotations[usable][:, 2]])
        # Equal distances are decided by place, never by index, so the order of views is nothing.
        order = np.lexsort(place.T)
        place = place[order]
        chosen = [int(np.argmax(np.round(np.sum(place * place, axis=1), 9)))]
        distance = np.full(len(place), np.inf)
        while len(chosen) < count:
            step = np.sum((place - place[chosen[-1]]) ** 2, axis=1)
            distance = np.minimum(distance, step)
            distance[chosen] = -1.0
            chosen.append(int(np.argmax(np.round(distance, 9))))
        return self.take(np.sort(usable[order[chosen]]))


def _median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Return the weighted median; of two in the middle the smaller."""
    order = np.argsort(values, kind="stable")
    return float(values[order[np.searchsorted(np.cumsum(weights[order]), 0.5 - 1e-9)]])
