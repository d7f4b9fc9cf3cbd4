"""Splats as merging needs them: covariance, what the views see of each, and from which side."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import spherical_harmonics
from ..execute import Progress, chunks, part, run_all, silent
from ..rendering import LOW_PASS, NEAR_RELATIVE, Model
from ..splats import Splats, opacity, rotation_matrices
from ..views import View, ViewSet
from ..visibility import frustum
from ..visibility.scene import Scene

Array = NDArray[np.float64]
Index = NDArray[np.int64] | NDArray[np.int32]
Footprint = tuple[Array, Array, Array]
ColorOf = Callable[[Index, Array], Array]

DIRECTION_VIEWS = 32
"""At most so many views, spread evenly, decide from which directions splats are viewed."""

BESIDE = 1e-6
"""Factor on the weight of views that a splat's centre does not lie in. Such views decide the
viewing direction only of splats that lie in no view."""

LARGEST_LENS = 1e18
"""Largest product of the focal lengths of a view, px^2, and one over the smallest."""

_CHUNK = 1 << 14  # splats at a time: some MB of temporary memory a thread
_LOG_RANGE = 80.0  # of log scales, either way, so that squares of scales stay finite


class ViewSums(NamedTuple):
    """What the views see of each of N splats; both sums in the same unit, such as pixels.

    Attributes
    ----------
    contribution : (N,) floating
        W, the sum of T alpha, >= 0.
    error : (N,) floating
        E, the sum of (T alpha)^2 times the squared contrast, >= 0.
    """

    contribution: Array
    error: Array

    def take(self, rows: NDArray[Any]) -> ViewSums:
        """Return a copy of some rows (a mask or integers)."""
        return ViewSums(self.contribution[rows], self.error[rows])


@dataclass(eq=False)
class Field:
    """Splats as merging needs them. A splat that absorbs another becomes the merged splat.

    Attributes
    ----------
    means : (N, 3) float64
        World units.
    covariances : (N, 6) float64
        xx, xy, xz, yy, yz, zz; world units squared.
    opacity : (N,) float64
        0..1.
    contribution, error : (N,) float64
        See `ViewSums`.
    direction, deviation : (N, 3) float64
        See `Viewing`.
    color : (N, 3) float64
        As viewed along `direction`.
    blur : (N,) float64
        Variance of the low-pass at the splat, world units squared.
    model : {"default", "antialiased", "2dgs"}
        How they are drawn, see `rendering.Model`.
    """

    means: Array
    covariances: Array
    opacity: Array
    contribution: Array
    error: Array
    direction: Array
    deviation: Array
    color: Array
    blur: Array
    model: Model = "default"

    def put(self, rows: Index, other: Field) -> None:
        """Overwrite `rows` with the rows of `other`."""
        for item in fields(self)[:-1]:
            getattr(self, item.name)[rows] = getattr(other, item.name)

    def take(self, rows: Index) -> Field:
        """Return a copy of some rows."""
        # ndarray.take is twice as fast as indexing.
        arrays: dict[str, Any] = {
            item.name: getattr(self, item.name).take(rows, axis=0) for item in fields(self)[:-1]
        }
        return replace(self, **arrays)


class Viewing(NamedTuple):
    """From where the views see each of N splats, hidden or not.

    Attributes
    ----------
    direction : (N, 3) float64
        Mean viewing direction, length 1.
    deviation : (N, 3) float64
        Standard deviation of the viewing directions along the axis where they vary most; its sign
        is arbitrary.
    pixel : (N,) float64
        Area of a pixel at the splat, world units squared.
    seen : (N,) float64
        In how many of the views the centre lies.
    """

    direction: Array
    deviation: Array
    pixel: Array
    seen: Array


def viewing(
    means: NDArray[Any],
    views: ViewSet,
    scene: Scene,
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> Viewing:
    """Return from where the views see splats.

    Each view has the weight 1 / distance^2, in proportion to the pixels that a splat covers in it,
    and nearly none where the splat's centre does not lie in it (`frustum`).

    Parameters
    ----------
    means : (N, 3) floating
        Of drawable splats.
    views : ViewSet
        At most `DIRECTION_VIEWS` of them are used.
    scene : Scene
        A camera is at least `NEAR_RELATIVE` of its size away from a splat.
    progress : callable, optional
    threads : int, optional
    """
    count = len(means)
    result = Viewing(np.empty((count, 3)), np.empty((count, 3)), np.empty(count), np.empty(count))
    spread = views.spread(DIRECTION_VIEWS)
    weighted = [pair for pair in zip(spread, spread.weights, strict=True) if pair[1]]
    closest = NEAR_RELATIVE * scene.size

    def fill(piece: slice) -> None:
        points = np.asarray(means[piece], np.float64).T
        with np.errstate(under="ignore"):
            of_piece = _viewing(points, weighted, closest)
        for values, chunk in zip(result, of_piece, strict=True):
            values[piece] = chunk

    run_all(fill, chunks(count, _CHUNK), progress=progress, what="absorbing", threads=threads)
    return result


def _viewing(points: Array, views: list[tuple[View, float]], closest: float) -> Viewing:
    """Return from where views, with their weights, see M points, (3, M).

    A camera counts as at least `closest` away.
    """
    rows, columns = np.triu_indices(3)
    # Sums over views: of the weights, of pixels per squared world unit, of views; (M,) each.
    total, density, seen = np.zeros((3, points.shape[1]))
    first, second = np.zeros((3, points.shape[1])), np.zeros((6, points.shape[1]))
    for view, counts in views:
        inside, ray, squared = _seen_from(view, points, closest)
        seen += inside
        weight = np.where(inside, counts, counts * BESIDE) / squared  # (M,)
        weighted = ray * weight  # (3, M)
        first += weighted
        second += weighted[rows] * ray[columns]  # xx, xy, xz, yy, yz, zz
        total += weight
        # Limited, so that the area of a pixel is neither 0 nor infinite.
        pixels = min(max(view.fx * view.fy, 1.0 / LARGEST_LENS), LARGEST_LENS)
        density += weight * (pixels / squared)
    direction = normalized(first.T)
    return Viewing(direction, _deviation(direction, (second / total).T), total / density, seen)


def _seen_from(view: View, points: Array, closest: float) -> tuple[NDArray[np.bool_], Array, Array]:
    """Return which points lie in a view, the rays to them, and their squared distances.

    (M,), (3, M) and (M,). Points nearer than `closest` count as that far away, and their rays are
    shorter than 1.
    """
    ray = points - view.center[:, None]
    planes = frustum.clip_planes(view, closest)
    inside = frustum.contains(view, view.rotation @ ray, planes)
    squared = np.maximum(np.einsum("ij,ij->j", ray, ray), closest**2)
    return inside, ray / np.sqrt(squared), squared


def _deviation(direction: Array, second: Array) -> Array:
    """Return the largest standard deviation of viewing directions as a vector, (M, 3).

    Given their mean, (M, 3), and their mean products xx, xy, xz, yy, yz, zz, (M, 6). In the plane
    at right angles to the mean these are variances.
    """
    u, v = across(direction)
    xx, xy, yy = footprint(second, (u, v), np.zeros(len(direction)))
    # The larger eigenvalue of a symmetric 2 x 2 matrix, and the angle of its eigenvector.
    half, angle = np.hypot(0.5 * (xx - yy), xy), 0.5 * np.arctan2(2.0 * xy, xx - yy)
    longest = np.sqrt(np.maximum(0.5 * (xx + yy) + half, 0.0))
    deviation: Array = longest * (np.cos(angle) * u + np.sin(angle) * v)
    return deviation.T


def measured_field(
    splats: Splats,
    rows: Index,
    views: ViewSet,
    scene: Scene,
    sums: ViewSums,
    color_of: ColorOf | None = None,
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> MeasuredField:
    """Return some splats as merging needs them, but for the allowance.

    Parameters
    ----------
    splats : Splats
        In the frame and unit of the views.
    rows : (M,) int
        Which of them; all must be drawable.
    views : ViewSet
    scene : Scene
        Of splats and views.
    sums : ViewSums
        Of all splats.
    color_of : callable, optional
        ``color_of(rows, directions)`` returns the colours of some splats, seen along directions; by
        default those of their harmonics.
    progress : callable, optional
        See `refine_addon.core.execute.Progress`.
    threads : int, optional

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """
    viewed = viewing(
        splats.means[rows], views, scene, progress=part(progress, 0.0, 0.5), threads=threads
    )
    covariances, color = np.empty((len(rows), 6)), np.empty((len(rows), 3))
    alphas, mass = opacity(splats.opacity_logits[rows]), np.empty(len(rows))
    blur = LOW_PASS * viewed.pixel

    def fill(piece: slice) -> None:
        chunk = splats.take(rows[piece])
        covariances[piece] = _covariances(chunk)
        direction = viewed.direction[piece]
        color[piece] = (
            spherical_harmonics.colors(direction, chunk.sh_dc, chunk.sh_rest)
            if color_of is None
            else color_of(rows[piece], direction)
        )
        with np.errstate(under="ignore"):
            # Antialiasing keeps the mass that splats have without the low-pass.
            wider = np.zeros(len(direction)) if splats.model == "antialiased" else blur[piece]
            xx, xy, yy = footprint(covariances[piece], across(direction), wider)  # (n,) each
            # In pixels of a view, over 2 pi; a constant factor does not matter here.
            area = np.sqrt(np.maximum(xx * yy - xy * xy, 0.0))
            mass[piece] = alphas[piece] * area / viewed.pixel[piece]

    run_all(
        fill, chunks(len(rows), _CHUNK), progress=part(progress, 0.5, 1.0), what="absorbing",
        threads=threads,
    )  # fmt: skip
    field = Field(
        np.asarray(splats.means[rows], np.float64),
        covariances,
        alphas,
        sums.contribution[rows],
        sums.error[rows],
        viewed.direction,
        viewed.deviation,
        np.maximum(color, 0.0, out=color),
        blur,
        splats.model,
    )
    return MeasuredField(field, mass, viewed.seen)


def _covariances(splats: Splats) -> Array:
    """Return the covariances of splats, (n, 6): xx, xy, xz, yy, yz, zz; world units squared."""
    rows, columns = np.triu_indices(3)
    logs = np.asarray(splats.log_scales, np.float64).clip(-_LOG_RANGE, _LOG_RANGE)
    axes = rotation_matrices(splats.quaternions) * np.exp(logs)[:, None, :]  # (n, 3, 3)
    full: Array = axes @ np.swapaxes(axes, 1, 2)
    return full[:, rows, columns]


class MeasuredField(NamedTuple):
    """Splats as merging needs them, but without the allowance for views that were not given.

    If nothing were hidden, each view would see the whole mass of every splat whose centre lies in
    it. The given views saw a share of that, summed over all splats, and another view is expected to
    see the same share. If none of the n views that a splat lies in showed it, the next one shows it
    with a probability of about 1 / (n + 1), by the rule of succession. So the allowance of a splat
    is what a view sees of it if nothing hides it, times that share, over n + 1.

    Attributes
    ----------
    field : Field
        Contribution and error are as measured, summed over views.
    mass : (M,) float64
        What one view adds to a splat's contribution if nothing hides it. To its error it adds
        ``mass opacity``, for a contrast of 1.
    seen : (M,) float64
        In how many views each centre lies.
    """

    field: Field
    mass: Array
    seen: Array

    def seen_and_whole(self) -> Array:
        """Return the sums over all splats of contribution and error, as seen and if none is hidden.

        Returns
        -------
        (2, 2) float64
            ``[[contribution, its sum if nothing hid anything], [error, the same of it]]``. The sums
            of the parts of a scene add up to those of the scene.
        """
        unhidden = self.mass * self.field.opacity
        return np.array(
            [
                [self.field.contribution.sum(), self.seen @ self.mass],
                [self.field.error.sum(), self.seen @ unhidden],
            ]
        )

    def with_allowance(self, scene: Array) -> Field:
        """Return the field with the allowance; `scene`: `seen_and_whole` of the whole scene."""
        shares = [seen / whole if whole > 0.0 else 0.0 for seen, whole in scene.tolist()]
        unhidden = self.mass * self.field.opacity
        with np.errstate(under="ignore"):
            contribution = self.mass * shares[0] / (1.0 + self.seen)
            error = unhidden * shares[1] / (1.0 + self.seen)
            return replace(
                self.field,
                contribution=self.field.contribution + contribution,
                error=self.field.error + error,
            )


def across(normal: Array) -> tuple[Array, Array]:
    """Return two unit vectors, (3, M), at right angles to `normal`, (M, 3), and to each other.

    Duff et al. 2017, "Building an Orthonormal Basis, Revisited".
    """
    x, y, z = normal.T
    sign = np.where(z >= 0.0, z.dtype.type(1.0), z.dtype.type(-1.0))
    a = -1.0 / (sign + z)
    b = x * y * a
    u = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    v = np.stack([b, sign + y * y * a, -y])
    return u, v


def footprint(covariances: Array, plane: tuple[Array, Array], blur: Array) -> Footprint:
    """Return xx, xy, yy of ``(u, v)' C (u, v) + blur I``, (M,) each: C projected to a plane.

    `plane` holds the unit vectors u and v, (3, M) each.
    """
    u, v = plane
    xx, xy, xz, yy, yz, zz = covariances.T
    cu = (xx * u[0] + xy * u[1] + xz * u[2], xy * u[0] + yy * u[1] + yz * u[2],
          xz * u[0] + yz * u[1] + zz * u[2])  # fmt: skip
    cv = (xx * v[0] + xy * v[1] + xz * v[2], xy * v[0] + yy * v[1] + yz * v[2],
          xz * v[0] + yz * v[1] + zz * v[2])  # fmt: skip
    return (
        u[0] * cu[0] + u[1] * cu[1] + u[2] * cu[2] + blur,
        v[0] * cu[0] + v[1] * cu[1] + v[2] * cu[2],
        v[0] * cv[0] + v[1] * cv[1] + v[2] * cv[2] + blur,
    )


def normalized(vectors: NDArray[Any]) -> Array:
    """Return unit vectors, (M, 3); zero vectors stay 0."""
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))[:, None]
    unit: Array = vectors / np.where(length > 0.0, length, 1.0)
    return unit
