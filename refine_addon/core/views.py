"""Pinhole views in the OpenCV convention, one at a time and as a set."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import RefineError

ORTHONORMAL = 1e-3  # largest error of a rotation's entries: files may have only four decimals
FAR = 1000.0  # distance, in extents of the splats, of a view that stands in for parallel rays


@dataclass(frozen=True, eq=False)
class View:
    """One pinhole camera: x right, y down, z forward; pixels, origin at the image's upper left.

    A point ``p`` of the world lies at ``rotation @ (p - center)`` in the camera, and at ``(fx x / z
    + cx, fy y / z + cy)`` in the image; the centre of pixel k is at k + 0.5.

    Attributes
    ----------
    rotation : (3, 3) float64, world to camera, orthonormal; determinant -1 if mirrored
    center : (3,) float64, centre of projection, world units
    fx, fy, cx, cy : float, focal lengths and principal point, pixels
    width, height : int, pixels
    near, far : float, clip distances along z, world units; 0 and infinity if not known
    weight : float >= 0, how much the view counts among the others
    name : str, of image or camera, for messages
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
        try:
            rotation = np.array(self.rotation, np.float64)
            center = np.array(self.center, np.float64)
            self._check(rotation, center)
        except (TypeError, ValueError) as error:
            raise RefineError(f"view {self.name!r}: {error}") from error
        left, _, right = np.linalg.svd(rotation)
        object.__setattr__(self, "rotation", left @ right)  # exactly orthonormal again
        object.__setattr__(self, "center", center)

    def turned(self, rotation: NDArray[Any], shift: NDArray[Any] | float = 0.0) -> View:
        """View moved with the world: p goes to ``rotation @ p + shift``."""
        center = rotation @ self.center + shift
        return replace(self, rotation=self.rotation @ rotation.T, center=center)

    def _check(self, rotation, center):
        if rotation.shape != (3, 3) or center.shape != (3,):
            raise ValueError(
                f"expected rotation (3, 3) and center (3,), got {rotation.shape} and {center.shape}"
            )
        if not (np.isfinite(rotation).all() and np.isfinite(center).all()):
            raise ValueError("rotation and center must be finite numbers")
        if np.abs(center).max() > np.finfo(np.float32).max:
            raise ValueError(f"center {center.tolist()} is beyond the range of float32")
        if not is_orthonormal(rotation):
            raise ValueError(f"rotation is not orthonormal: {rotation.tolist()}")
        numbers = (self.fx, self.fy, self.cx, self.cy, self.near, self.weight)
        if not all(math.isfinite(number) for number in numbers) or math.isnan(self.far):
            raise ValueError(f"fx, fy, cx, cy, near and weight must be finite, got {numbers}")
        size = (self.width, self.height)
        if self.fx <= 0 or self.fy <= 0 or min(size) < 1 or size != tuple(map(int, size)):
            raise ValueError(
                "expected positive focal lengths and whole numbers of pixels, got "
                f"fx {self.fx}, fy {self.fy}, {self.width} x {self.height}"
            )
        if self.weight < 0 or self.near < 0 or self.far <= self.near:
            raise ValueError(
                f"expected weight >= 0 and 0 <= near < far, got weight {self.weight}, "
                f"near {self.near}, far {self.far}"
            )


def is_orthonormal(matrix: NDArray[np.float64]) -> bool:
    """Whether a matrix (3, 3) is a rotation or a reflection, up to `ORTHONORMAL`."""
    # Entries first: those of a rotation are at most 1, and squares of large ones could overflow.
    small = np.abs(matrix).max() <= 2.0
    return bool(small and np.abs(matrix @ matrix.T - np.eye(3)).max() <= ORTHONORMAL)


@dataclass(frozen=True, eq=False)
class ViewSet:
    """V views to score by.

    Attributes
    ----------
    views : tuple of View, at least one of positive weight
    note : str, for the user: what their source says and is ignored, such as lens distortion
    turn : int, optional; quarter turns about x (`affine.QUARTER`) from their frame to the splats'
    exact : bool, whether no views between these decide, see `Method`: those of a locked shot
    """

    views: tuple[View, ...]
    note: str = ""
    turn: int | None = None
    exact: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "views", tuple(self.views))
        if not self.views:
            raise RefineError("no cameras: scoring needs at least one view")
        if not any(view.weight > 0 for view in self.views):
            raise RefineError(f"all {len(self.views)} views have weight 0: at least one must count")

    def __len__(self) -> int:
        return len(self.views)

    def __iter__(self) -> Iterator[View]:
        return iter(self.views)

    def __getitem__(self, index: int) -> View:
        return self.views[index]

    def take(self, indices: Sequence[int] | NDArray[Any]) -> ViewSet:
        """Views at `indices`, in that order."""
        return replace(self, views=tuple(self.views[int(index)] for index in indices))

    def select(self, names: Sequence[str]) -> ViewSet:
        """Views by name, in the order of `names`; of equal names the last.

        `RefineError` if there is none of that name.
        """
        by_name = {view.name: view for view in self.views}
        missing = [name for name in names if name not in by_name]
        if missing:
            raise RefineError(f"no view named {missing[0]!r} among {len(self)} views")
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
        with np.errstate(under="ignore"):  # a weight of 1e-300 beside one of 1e300 becomes 0
            weights /= weights.max()  # first, so that weights of 1e308 do not sum to infinity
            return np.asarray(weights / weights.sum())

    def middle(self) -> tuple[NDArray[np.float64], float]:
        """Weighted geometric median of the centres, (3,), by Weiszfeld's iteration (1937), and the
        weighted median of their squared distances to it. Outliers hardly change either.
        """
        centers, weights = self.centers, self.weights
        with np.errstate(under="ignore"):
            middle = weights @ centers
            for _ in range(100):
                distance = np.linalg.norm(centers - middle, axis=1)
                # A median, so that outliers do not change it.
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
        """At most `count` views of positive weight, spread evenly, in their order; 0 keeps all.

        Farthest-point sampling (Gonzalez 1985) of `places`, beginning with the view farthest from
        the middle. The choice does not depend on frame and unit, nor on the order of views whose
        names differ. A stray view is one of those chosen.
        """
        # Of views equally far away, of which regular rigs have many, the first by name is taken.
        usable = np.array([index for index in self.by_name() if self.views[index].weight > 0])
        if count <= 0 or len(usable) <= count:
            return self if len(usable) == len(self) else self.take(np.sort(usable))
        place = self.places()[usable]
        chosen = [int(np.argmax(np.round(np.sum(place * place, axis=1), 9)))]
        distance = np.full(len(place), np.inf)
        while len(chosen) < count:
            step = np.sum((place - place[chosen[-1]]) ** 2, axis=1)
            distance = np.minimum(distance, step)
            distance[chosen] = -1.0
            chosen.append(int(np.argmax(np.round(distance, 9))))
        return self.take(np.sort(usable[chosen]))

    def places(self) -> NDArray[np.float64]:
        """Centres relative to `middle`, over their median distance, and directions, (V, 6)."""
        middle, variance = self.middle()
        offset = (self.centers - middle) / (np.sqrt(variance) or 1.0)
        return np.hstack([offset, self.rotations[:, 2]])

    def by_name(self) -> list[int]:
        """Indices in the order of names; views of one name stay in the order of the set."""
        return sorted(range(len(self)), key=lambda index: self.views[index].name)

    def by_distance(self) -> list[tuple[View, float]]:
        """Views of positive weight with their weights, in an order that does not depend on the
        set's: by distance from the middle, ties by distance from the farthest view, then by name.
        """
        centers = self.centers - self.middle()[0]
        order = np.array(self.by_name())
        for _ in range(2):
            distance = np.einsum("ij,ij->i", centers, centers)
            largest = float(distance.max()) or 1.0
            # Rounded: distances that differ only by rounding count as equal and keep their order.
            order = order[np.argsort(np.round(distance[order] / largest, 9), kind="stable")]
            centers = centers - centers[order[-1]]
        weights = self.weights
        return [(self.views[k], float(weights[k])) for k in order.tolist() if weights[k] > 0]


def _median(values, weights):
    """Weighted median of values, (V,); the smaller of two."""
    order = np.argsort(values, kind="stable")
    return float(values[order[np.searchsorted(np.cumsum(weights[order]), 0.5 - 1e-9)]])


def refuse_other(views: object) -> None:
    """Raise `RefineError` if `views` is no `ViewSet`."""
    if not isinstance(views, ViewSet):
        raise RefineError(
            f"views is a {type(views).__name__}, expected a ViewSet: ViewSet((view, ...))"
        )


def pinhole(
    matrix: NDArray[Any], projection: NDArray[Any], size: tuple[int, int], means: NDArray[Any]
) -> View:
    """View of a camera by OpenGL's matrices, y up, z back; RefineError as of `View`.

    Without perspective the view stands `FAR` extents of the splats away: rays are nearly parallel.
    """
    flip = np.diag([1.0, -1.0, -1.0])
    axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=1, keepdims=True)  # float32
    rotation = flip @ axes
    center = -rotation.T @ flip @ matrix[:3, 3]
    if projection[3, 3] == 0.0:
        return view_through(projection, (rotation, center), size)
    finite, middle, extent = means[np.isfinite(means).all(axis=1)], center, 1.0
    if len(finite):
        middle = np.median(finite, axis=0)
        extent = float(max([*np.ptp(finite, axis=0), 2.0 / projection[0, 0]]))
    depth = float((rotation @ (middle - center))[2])
    return view_through(projection, (rotation, center), size, (depth, FAR * extent))


def view_through(
    projection: NDArray[np.float64],
    pose: tuple[NDArray[np.float64], NDArray[np.float64]],
    size: tuple[int, int],
    parallel: tuple[float, float] = (0.0, 1.0),
) -> View:
    """View of a camera with one of OpenGL's projection matrices and a pose in the axes of `View`.

    Without perspective `parallel` is the depth at which pixels have their exact size, and the
    distance of the view from there, world units.
    """
    p, (width, height), (rotation, center) = projection, size, pose
    fx, fy = p[0, 0] * width / 2.0, p[1, 1] * height / 2.0
    # The image is shifted by the third column of a matrix with perspective, else by the fourth.
    cx = (1.0 - p[0, 2] + p[0, 3]) * width / 2.0
    cy = (1.0 + p[1, 2] - p[1, 3]) * height / 2.0
    if p[3, 3] == 0.0:
        near = max(float(p[2, 3] / (p[2, 2] - 1.0)), 0.0)
        return View(rotation, center, fx, fy, cx, cy, width, height, near)
    depth, away = parallel
    center = center + rotation[2] * (depth - away)
    near = float((p[2, 3] + 1.0) / p[2, 2])  # along the axis, from the camera; may be behind it
    near = max(near - depth + away, 0.0)
    return View(rotation, center, fx * away, fy * away, cx, cy, width, height, near)
