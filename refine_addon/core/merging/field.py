"""What merging needs of each splat: covariance, visibility, mean viewing direction, colour."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass, fields, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import spherical_harmonics
from ..execute import Progress, chunks, run_all, silent
from ..splats import LOW_PASS, NEAR_RELATIVE, Model, Splats, opacity, rotation_matrices
from ..views import ViewSet
from ..visibility import frustum
from ..visibility.scene import Scene

Array = NDArray[np.float64]
Real = NDArray[np.floating[Any]]
Index = NDArray[np.int64] | NDArray[np.int32]
Footprint = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]
"""Covariances in a plane: xx, xy and yy, (M,) each."""

DIRECTION_VIEWS = 32  # most views, spread evenly, that decide the viewing directions
BESIDE = 1e-6  # weight of views without the splat's centre: they count only if no view has it
LARGEST_LENS = 1e18  # largest product of a view's focal lengths, px^2; the smallest is its inverse
_CHUNK = 1 << 14  # splats at a time: some MB of temporary memory a thread
_LOG_RANGE = 80.0  # of log scales, either way, so that squares of scales stay finite
_BRIGHTEST = 1e18  # its square is a float32


@dataclass(eq=False)
class Field:
    """N splats as merging needs them; merged splats replace one of their two."""

    means: Array  # (N, 3), world units
    covariances: Array  # (N, 6): xx, xy, xz, yy, yz, zz; world units squared
    opacity: Array  # (N,), 0..1
    contribution: Array  # (N,): W, the sum of T alpha over pixels, >= 0
    error: Array  # (N,): E, the sum of (T alpha)^2 times the squared contrast, >= 0
    direction: Real  # (N, 3) float32: mean in which views look at it, hidden or not; length 1
    deviation: Real  # (N, 3) float32: standard deviation along their widest axis; sign arbitrary
    color: Real  # (N, 3) float32, as viewed along `direction`
    blur: Array  # (N,): variance of the low-pass at the splat, world units squared
    _: KW_ONLY
    model: Model = "default"

    def put(self, rows: Index | slice, other: Field) -> None:
        """Overwrite rows."""
        for item in fields(self)[:-1]:
            getattr(self, item.name)[rows] = getattr(other, item.name)

    def take(self, rows: Index) -> Field:
        """Copy of some rows."""
        # ndarray.take is twice as fast as indexing.
        arrays: dict[str, Any] = {
            item.name: getattr(self, item.name).take(rows, axis=0) for item in fields(self)[:-1]
        }
        return replace(self, **arrays)


class MeasuredField(NamedTuple):
    """A field of M splats, and what its bias for views that were not given needs.

    The bias (docs/method.md, section 7) is the mass that one more view would show unhidden, times
    the share of such mass that the views did see, over n + 1 for n views with the splat's centre.
    """

    field: Field  # contribution and error as measured, summed over views
    mass: Array  # (M,): contribution to one view if nothing hid it; times opacity, its error
    seen: Array  # (M,): number of views that the centre lies in

    def seen_and_whole(self) -> Array:
        """Sums over splats, (2, 2): of contribution and error, each as measured and unhidden."""
        seen = self.field.contribution.sum(), self.field.error.sum()
        whole = self.seen @ self.mass, self.seen @ (self.mass * self.field.opacity)
        return np.stack([seen, whole], axis=1)

    def with_bias(self, scene: Array) -> Field:
        """Field with the bias; `scene`, (2, 2), is `seen_and_whole` of all splats that merge."""
        shares = [seen / whole if whole > 0.0 else 0.0 for seen, whole in scene.tolist()]
        unhidden = self.mass * self.field.opacity
        return replace(
            self.field,
            contribution=self.field.contribution + self.mass * shares[0] / (1.0 + self.seen),
            error=self.field.error + unhidden * shares[1] / (1.0 + self.seen),
        )


def measured_field(
    splats: Splats,
    rows: Index,
    views: ViewSet,
    scene: Scene,
    sums: Array,
    *,
    progress: Progress = silent,
) -> MeasuredField:
    """Some drawable splats as merging needs them; `sums` are contribution and error, (2, N), px^2.

    A view counts for a splat by 1 / distance^2, of at least `NEAR_RELATIVE` scene sizes, and by
    `BESIDE` of that if it does not hold the centre.
    """
    count = len(rows)
    kinds = "3f8", "6f8", "f8", "f8", "f8", "3f4", "3f4", "3f4", "f8"
    result = Field(*(np.empty(count, kind) for kind in kinds), model=splats.model)
    mass, seen = np.empty((2, count))
    spread = views.spread(DIRECTION_VIEWS)
    weighted = [pair for pair in zip(spread, spread.weights, strict=True) if pair[1]]
    closest = NEAR_RELATIVE * scene.size

    def fill(piece: slice) -> None:
        some = splats.take(rows[piece])
        means = np.ascontiguousarray(some.means, np.float64)
        logs = np.asarray(some.log_scales, np.float64).clip(-_LOG_RANGE, _LOG_RANGE)
        axes = rotation_matrices(some.quaternions) * np.exp(logs)[:, None, :]  # (n, 3, 3)
        covariances = packed(axes @ np.swapaxes(axes, 1, 2))
        direction, deviation, pixel, seen[piece] = _viewing(means, weighted, closest)
        color = spherical_harmonics.colors(direction, some.sh_dc, some.sh_rest)
        alpha, blur = opacity(some.opacity_logits), LOW_PASS * pixel
        # Antialiasing keeps the mass that splats have without the low-pass.
        wider = np.zeros(len(blur)) if splats.model == "antialiased" else blur
        xx, xy, yy = footprint(covariances, across(direction), wider)  # (n,) each
        # In pixels of a view, over 2 pi; a constant factor does not matter here.
        mass[piece] = alpha * np.sqrt(np.maximum(xx * yy - xy * xy, 0.0)) / pixel
        rest = *sums[:, rows[piece]], direction, deviation, np.clip(color, 0.0, _BRIGHTEST), blur
        result.put(piece, Field(means, covariances, alpha, *rest))

    run_all(fill, chunks(count, _CHUNK), progress=progress, what="merging")
    return MeasuredField(result, mass, seen)


def _viewing(means, views, closest):
    """Mean direction, its deviation, area of a pixel at the splat, number of views that hold it."""
    points = means.T
    rows, columns = np.triu_indices(3)
    # Sums over views: of the weights, of pixels per squared world unit, of views; (M,) each.
    total, density, seen = np.zeros((3, points.shape[1]))
    first, second = np.zeros((3, points.shape[1])), np.zeros((6, points.shape[1]))
    for view, view_weight in views:
        ray = points - view.center[:, None]
        planes = frustum.clip_planes(view, closest)
        inside = frustum.contains(view, view.rotation @ ray, planes)
        squared = np.maximum(np.einsum("ij,ij->j", ray, ray), closest**2)
        ray /= np.sqrt(squared)  # shorter than 1 if nearer than `closest`
        seen += inside
        weight = np.where(inside, view_weight, view_weight * BESIDE) / squared  # (M,)
        weighted = ray * weight  # (3, M)
        first += weighted
        second += weighted[rows] * ray[columns]  # xx, xy, xz, yy, yz, zz
        total += weight
        # Limited, so that the area of a pixel is neither 0 nor infinite.
        pixels = min(max(view.fx * view.fy, 1.0 / LARGEST_LENS), LARGEST_LENS)
        density += weight * (pixels / squared)
    direction = normalized(first.T)
    # In the plane at right angles to the mean direction, mean products are variances.
    u, v = across(direction)
    xx, xy, yy = footprint((second / total).T, (u, v), np.zeros(len(direction)))
    # The larger eigenvalue of a symmetric 2 x 2 matrix, and the angle of its eigenvector.
    half, angle = np.hypot(0.5 * (xx - yy), xy), 0.5 * np.arctan2(2.0 * xy, xx - yy)
    longest = np.sqrt(np.maximum(0.5 * (xx + yy) + half, 0.0))
    deviation = longest * (np.cos(angle) * u + np.sin(angle) * v)
    return direction, deviation.T, total / density, seen


def packed(matrices: Array) -> Array:
    """Upper halves xx, xy, xz, yy, yz, zz, (M, 6), of symmetric matrices, (M, 3, 3)."""
    upper: Array = matrices[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return upper


def across(normal: Real) -> tuple[Real, Real]:
    """Orthogonal unit vectors, (3, M), at right angles to `normal`, (M, 3) (Duff et al. 2017)."""
    x, y, z = normal.T
    sign = np.where(z >= 0.0, z.dtype.type(1.0), z.dtype.type(-1.0))
    a = -1.0 / (sign + z)
    b = x * y * a
    u = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    v = np.stack([b, sign + y * y * a, -y])
    return u, v


def footprint(covariances: Array, plane: tuple[Real, Real], blur: Array) -> Footprint:
    """Covariances in planes, ``(u, v)' C (u, v) + blur I``; u and v are orthogonal, (3, M) each."""
    u, v = plane
    xx, xy, xz, yy, yz, zz = covariances.T
    cu, cv = (
        (xx * w[0] + xy * w[1] + xz * w[2], xy * w[0] + yy * w[1] + yz * w[2],
         xz * w[0] + yz * w[1] + zz * w[2])
        for w in plane
    )  # fmt: skip
    return (
        u[0] * cu[0] + u[1] * cu[1] + u[2] * cu[2] + blur,
        v[0] * cu[0] + v[1] * cu[1] + v[2] * cu[2],
        v[0] * cv[0] + v[1] * cv[1] + v[2] * cv[2] + blur,
    )


def normalized(vectors: NDArray[Any]) -> Array:
    """Unit vectors, (M, 3); zero vectors stay 0."""
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))[:, None]
    unit: Array = vectors / np.where(length > 0.0, length, 1.0)
    return unit
