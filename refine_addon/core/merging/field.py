"""Splats as merging needs them: covariance, what the views see of each, and from which side."""

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
Index = NDArray[np.int64] | NDArray[np.int32]
Footprint = tuple[NDArray[Any], NDArray[Any], NDArray[Any]]

DIRECTION_VIEWS = 32
"""At most so many views, spread evenly, decide from which directions splats are viewed."""

BESIDE = 1e-6
"""Factor on the weight of views that a splat's centre does not lie in. Such views decide the
viewing direction only of splats that lie in no view."""

LARGEST_LENS = 1e18
"""Largest product of the focal lengths of a view, px^2, and one over the smallest."""

_CHUNK = 1 << 14  # splats at a time: some MB of temporary memory a thread
_LOG_RANGE = 80.0  # of log scales, either way, so that squares of scales stay finite

_BRIGHTEST = 1e18  # its square is a float32


@dataclass(eq=False)
class Field:
    """Splats as merging needs them; a splat that another is merged into becomes the merged splat.

    Attributes
    ----------
    means : (N, 3) float64
        World units.
    covariances : (N, 6) float64
        xx, xy, xz, yy, yz, zz; world units squared.
    opacity : (N,) float64
        0..1.
    contribution : (N,) float64
        W, the sum over pixels of T alpha, >= 0.
    error : (N,) float64
        E, the sum of (T alpha)^2 times the squared contrast, >= 0; in the same unit, such as
        pixels.
    direction : (N, 3) float64
        Mean direction along which the views see each splat, hidden or not; length 1.
    deviation : (N, 3) float64
        Standard deviation of the viewing directions along the axis where they vary most; its sign
        is arbitrary.
    color : (N, 3) float64
        As viewed along `direction`.
    blur : (N,) float64
        Variance of the low-pass at the splat, world units squared.
    model : {"default", "antialiased", "2dgs"}
        How they are drawn, see `Model`.
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
    _: KW_ONLY
    model: Model = "default"

    def put(self, rows: Index, other: Field) -> None:
        """Overwrite `rows` with the rows of `other`."""
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
    """Splats as merging needs them, but without the bias for views that were not given.

    If nothing were hidden, each view would see the whole mass of every splat whose centre lies in
    it. The given views saw a share of that, summed over all splats, and another view is expected to
    see the same share. If none of the n views that a splat lies in showed it, the next one shows it
    with a probability of about 1 / (n + 1), by the rule of succession. So the bias of a splat is
    what a view sees of it if nothing hides it, times that share, over n + 1.

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
        """Sums over all splats of contribution and error, as seen and if none is hidden.

        Returns
        -------
        (2, 2) float64
            ``[[contribution, its sum if nothing hid anything], [error, the same of it]]``. The sums
            of the parts of a scene add up to those of the scene.
        """
        seen = self.field.contribution.sum(), self.field.error.sum()
        whole = self.seen @ self.mass, self.seen @ (self.mass * self.field.opacity)
        return np.stack([seen, whole], axis=1)

    def with_bias(self, scene: Array) -> Field:
        """The field with the bias; `scene`, (2, 2), is `seen_and_whole` of the whole scene."""
        shares = [seen / whole if whole > 0.0 else 0.0 for seen, whole in scene.tolist()]
        unhidden = self.mass * self.field.opacity
        with np.errstate(under="ignore"):
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
    threads: int | None = None,
) -> MeasuredField:
    """Some splats as merging needs them, but for the bias.

    Each view has the weight 1 / distance^2, in proportion to the pixels that a splat covers in it,
    and nearly none where the splat's centre does not lie in it (`frustum`).

    Parameters
    ----------
    splats : Splats
        In the frame and unit of the views.
    rows : (M,) int
        Which of them; all must be drawable.
    views : ViewSet
        At most `DIRECTION_VIEWS` of them tell from where splats are viewed.
    scene : Scene
        Of splats and views. A camera is at least `NEAR_RELATIVE` of its size away from a splat.
    sums : (2, N) float64
        Contribution and error of all splats.
    progress : callable, optional
        See `refine_addon.core.execute.Progress`.
    threads : int, optional

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """
    count = len(rows)
    shapes = (3,), (6,), (), (), (), (3,), (3,), (3,), ()
    result = Field(*(np.empty((count, *shape)) for shape in shapes), model=splats.model)
    mass, seen = np.empty((2, count))
    spread = views.spread(DIRECTION_VIEWS)
    weighted = [pair for pair in zip(spread, spread.weights, strict=True) if pair[1]]
    closest = NEAR_RELATIVE * scene.size

    def fill(piece: slice) -> None:
        with np.errstate(under="ignore"):
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
        seen_from = direction, deviation, np.clip(color, 0.0, _BRIGHTEST), blur
        values = means, covariances, alpha, *sums[:, rows[piece]], *seen_from
        for item, of_piece in zip(fields(Field), values, strict=False):
            getattr(result, item.name)[piece] = of_piece

    run_all(fill, chunks(count, _CHUNK), progress=progress, what="merging", threads=threads)
    return MeasuredField(result, mass, seen)


def _viewing(means, views, closest):
    """From where views, with their weights, see splats, hidden or not; all (M,) or (M, 3).

    Direction and deviation (`Field`), the area of a pixel at the splat, world units squared, and in
    how many of the views the centre lies. A camera counts as at least `closest` away.
    """
    points = means.T
    rows, columns = np.triu_indices(3)
    # Sums over views: of the weights, of pixels per squared world unit, of views; (M,) each.
    total, density, seen = np.zeros((3, points.shape[1]))
    first, second = np.zeros((3, points.shape[1])), np.zeros((6, points.shape[1]))
    for view, counts in views:
        ray = points - view.center[:, None]
        planes = frustum.clip_planes(view, closest)
        inside = frustum.contains(view, view.rotation @ ray, planes)
        squared = np.maximum(np.einsum("ij,ij->j", ray, ray), closest**2)
        ray /= np.sqrt(squared)  # shorter than 1 if nearer than `closest`
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
    # In the plane at right angles to the mean direction, mean products are variances.
    u, v = across(direction)
    xx, xy, yy = footprint((second / total).T, (u, v), np.zeros(len(direction)))
    # The larger eigenvalue of a symmetric 2 x 2 matrix, and the angle of its eigenvector.
    half, angle = np.hypot(0.5 * (xx - yy), xy), 0.5 * np.arctan2(2.0 * xy, xx - yy)
    longest = np.sqrt(np.maximum(0.5 * (xx + yy) + half, 0.0))
    deviation = longest * (np.cos(angle) * u + np.sin(angle) * v)
    return direction, deviation.T, total / density, seen


def packed(matrices: Array) -> Array:
    """Upper halves, (M, 6), of symmetric matrices, (M, 3, 3): xx, xy, xz, yy, yz, zz."""
    upper: Array = matrices[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return upper


def across(normal: Array) -> tuple[Array, Array]:
    """Two unit vectors, (3, M), at right angles to `normal`, (M, 3), and to each other.

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
    """xx, xy, yy of ``(u, v)' C (u, v) + blur I``, (M,) each: C projected to a plane.

    `plane` holds the unit vectors u and v, (3, M) each.
    """
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
