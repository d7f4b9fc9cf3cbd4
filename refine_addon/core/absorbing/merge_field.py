"""Splats as merging sees them: what the views see of each, from where, and how finely."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .. import frustum, spherical_harmonics
from ..rendering import LOW_PASS
from ..splats import SH_C0, opacity, rotation_matrices
from ..work import for_chunks

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..scene import Scene
    from ..splats import Splats
    from ..views import View, ViewSet

    Array = NDArray[np.float64]
    Index = NDArray[np.int64] | NDArray[np.int32]
    Footprint = tuple[Array, Array, Array]

NEAREST = 0.01
"""Share of the scene's size below which a camera comes no nearer to a splat."""

LOOKS = 32
"""Views, spread out, that tell from where splats are looked at."""

BESIDE = 1e-6
"""Weight of a view beside whose image a splat lies, so that every splat has a direction."""

_CHUNK = 1 << 14
_LOG_RANGE = 80.0


class Seen(NamedTuple):
    """What the views see of each of N splats; both in one unit, such as pixels of all views.

    Attributes
    ----------
    contribution : (N,) floating
        W, the sum of T alpha, >= 0.
    error : (N,) floating
        E, the sum of (T alpha)^2 times the squared contrast, >= 0.
    """

    contribution: Array
    error: Array


@dataclass(eq=False)
class Field:
    """Splats as merging sees them; the rows of merged ones are overwritten.

    Attributes
    ----------
    means : (N, 3) float64
    covariances : (N, 6) float64
        xx, xy, xz, yy, yz, zz.
    opacity, contribution, error : (N,) float64
    direction, spread : (N, 3) float64
        See `Look`.
    color : (N, 3) float64
        Seen along `direction`.
    blur : (N,) float64
        Variance of the low-pass at the splat, world units squared.
    """

    means: Array
    covariances: Array
    opacity: Array
    contribution: Array
    error: Array
    direction: Array
    spread: Array
    color: Array
    blur: Array

    def put(self, rows: Index, other: Field) -> None:
        """Overwrite `rows` by those of `other`."""
        for item in fields(self):
            getattr(self, item.name)[rows] = getattr(other, item.name)

    def take(self, rows: Index) -> Field:
        """Return a copy of some rows."""
        # Twice as fast as square brackets.
        return Field(*(getattr(self, item.name).take(rows, axis=0) for item in fields(self)))


class Look(NamedTuple):
    """How the views look at each of N splats, whatever is between.

    Attributes
    ----------
    direction : (N, 3) float64
        Mean viewing direction, length 1.
    spread : (N, 3) float64
        The longest standard deviation of the directions across their mean, of either sign.
    pixel : (N,) float64
        Area of a pixel at the splat, world units squared.
    inside : (N,) float64
        In how many of the views the centre lies.
    """

    direction: Array
    spread: Array
    pixel: Array
    inside: Array


def look(means: NDArray[Any], views: ViewSet, scene: Scene, *, threads: int | None = None) -> Look:
    """Return how the views look at splats.

    A view weighs what its pixels see of the splat, 1 / distance^2, and next to nothing where the
    splat's centre lies beside the image.

    Parameters
    ----------
    means : (N, 3) floating
        Of drawable splats.
    views : ViewSet
        At most `LOOKS` of them are used.
    scene : Scene
        Its size says how near is too near.
    threads : int, optional
    """
    count = len(means)
    result = Look(np.empty((count, 3)), np.empty((count, 3)), np.empty(count), np.empty(count))
    some = views.spread(LOOKS)
    looks = [(view, share) for view, share in zip(some, some.weights, strict=True) if share]
    closest = (NEAREST * scene.size) ** 2

    def measure(piece: slice) -> None:
        points = np.asarray(means[piece], np.float64).T
        with np.errstate(under="ignore"):
            found = _look(points, looks, closest)
        for values, part_of in zip(result, found, strict=True):
            values[piece] = part_of

    for_chunks(measure, count, _CHUNK, threads=threads)
    return result


def _look(points: Array, looks: list[tuple[View, float]], closest: float) -> Look:
    """Return how views, each of a weight, look at `points`, (3, M).

    Parameters
    ----------
    closest : float
        Least squared distance of a camera.
    """
    rows, columns = np.triu_indices(3)
    total, finest, seen = np.zeros((3, points.shape[1]))
    toward, second = np.zeros((3, points.shape[1])), np.zeros((6, points.shape[1]))
    for view, share in looks:
        ray = points - view.center[:, None]
        planes = frustum.clip_planes(view, closest**0.5)
        inside = frustum.contains(view, view.rotation @ ray, planes)
        seen += inside
        squared = np.maximum(np.einsum("ij,ij->j", ray, ray), closest)
        weight = np.where(inside, share, share * BESIDE) / squared
        ray /= np.sqrt(squared)
        weighted = ray * weight
        toward += weighted
        second += weighted[rows] * ray[columns]
        total += weight
        finest += weight * (view.fx * view.fy / squared)
    direction = normalized(toward.T)
    u, v = across(direction)
    xx, xy, yy = footprint((second / total).T, (u, v), np.zeros(len(direction)))
    # The longer axis of a 2 x 2 covariance.
    half, angle = np.hypot(0.5 * (xx - yy), xy), 0.5 * np.arctan2(2.0 * xy, xx - yy)
    longest = np.sqrt(np.maximum(0.5 * (xx + yy) + half, 0.0))
    spread = longest * (np.cos(angle) * u + np.sin(angle) * v)
    return Look(direction, spread.T, total / finest, seen)


def field(
    splats: Splats,
    rows: Index,
    views: ViewSet,
    scene: Scene,
    seen: Seen,
    *,
    threads: int | None = None,
) -> Field:
    """Return some splats as merging sees them.

    What these views do not show may be plain to see from elsewhere: each splat gets a floor, what
    it would be worth to one more view if nothing hid anything (`_floored`).

    Parameters
    ----------
    splats : Splats
        In the frame and unit of the views.
    rows : (M,) int
        Which of them; drawable ones.
    views : ViewSet
    scene : Scene
        Of splats and views.
    seen : Seen
        Of all splats.
    threads : int, optional
    """
    count = len(rows)
    covariances, color = np.empty((count, 6)), np.empty((count, 3))
    seen_from = look(splats.means[rows], views, scene, threads=threads)
    upper = np.triu_indices(3)

    def fill(piece: slice) -> None:
        chunk = splats.take(rows[piece])
        logs = np.asarray(chunk.log_scales, np.float64).clip(-_LOG_RANGE, _LOG_RANGE)
        axes = rotation_matrices(chunk.quaternions) * np.exp(logs)[:, None, :]
        covariances[piece] = (axes @ np.swapaxes(axes, 1, 2))[:, upper[0], upper[1]]
        color[piece] = 0.5 + SH_C0 * np.asarray(chunk.sh_dc, np.float64)
        if chunk.sh_degree:
            basis = spherical_harmonics.basis(seen_from.direction[piece], chunk.sh_degree)[:, 1:]
            color[piece] += np.einsum("nk,nkc->nc", basis, chunk.sh_rest)

    for_chunks(fill, count, _CHUNK, threads=threads)
    alpha, blur = opacity(splats.opacity_logits[rows]), LOW_PASS * seen_from.pixel
    with np.errstate(under="ignore"):
        xx, xy, yy = footprint(covariances, across(seen_from.direction), blur)
        mass = alpha * np.sqrt(np.maximum(xx * yy - xy * xy, 0.0)) / seen_from.pixel
        contribution = _floored(seen.contribution[rows], mass, seen_from.inside)
        error = _floored(seen.error[rows], mass * alpha, seen_from.inside)
    return Field(
        np.asarray(splats.means[rows], np.float64),
        covariances,
        alpha,
        contribution,
        error,
        seen_from.direction,
        seen_from.spread,
        np.maximum(color, 0.0, out=color),
        blur,
    )


def _floored(values: Array, worth: Array, inside: Array) -> Array:
    """Return `values` and, on top, what one more view may see of each splat, (M,).

    Were nothing hidden, a splat would give its `worth` to each view that its centre lies in; of all
    that, the views saw some share. Of n views that might have shown a splat none did, at worst: by
    the rule of succession the next one does with a chance of about 1 / (n + 1).
    """
    shown = inside @ worth
    if not shown > 0.0:
        return values
    floored: Array = values + worth * (values.sum() / shown) / (1.0 + inside)
    return floored


def across(normal: Array) -> tuple[Array, Array]:
    """Return two unit vectors, (3, M), across `normal` and each other (Duff et al. 2017)."""
    x, y, z = normal.T
    sign = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    u = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    v = np.stack([b, sign + y * y * a, -y])
    return u, v


def footprint(covariances: Array, plane: tuple[Array, Array], blur: Array) -> Footprint:
    """Return xx, xy, yy of ``(u, v)' C (u, v) + blur I``."""
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
    """Return unit vectors, (M, 3); 0 stays 0."""
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))[:, None]
    unit: Array = vectors / np.where(length > 0.0, length, 1.0)
    return unit
