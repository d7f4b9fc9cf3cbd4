"""What merging two splats costs the pictures, and the splat that comes of it.

Every splat i is an image signal: its footprint ``f_i = alpha_i exp(-q_i / 2)`` times its contrast
``s_i = c_i - B`` to what lies behind it. Two numbers say what the cameras see of it, summed over
the pixels of all views; T is the transmittance in front of it::

    contribution  W_i = sum of T alpha              error  E_i = sum of (T alpha)^2 |s_i|^2

E is what deleting the splat costs. Merging i and j to m costs the squared error of the picture,
in the plane that the cameras look at (across the mean viewing direction of the pair), with the
inner products ``<f, g>`` of Gaussians in closed form::

    p = f_i - l_i f_m,  q = f_j - l_j f_m                l: share of the colour, l_i + l_j = 1
    cost = tau (|s_i|^2 <p, p> + 2 s_i.s_j <p, q> + |s_j|^2 <q, q>)
    tau  = (W_i + W_j) / (A_i + A_j)                     A: mass, the integral of f
    |s_i|^2 = E_i / (tau_i <f_i, f_i>),   2 s_i.s_j = |s_i|^2 + |s_j|^2 - |c_i - c_j|^2

The merged splat has the mean and covariance of both (weights: mass), their colour (weights:
contribution) and, by its opacity, their mass less the overlap, which the eye counts once:
``A_m = A_i + A_j - <f_i, f_j>``. Where that would take an opacity above `OPACITY_MAX`, the splat
grows instead.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from . import spherical_harmonics
from .splats import SH_C0, opacity, rotation_matrices
from .transform import quaternion
from .work import for_chunks

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .splats import Splats
    from .views import ViewSet

    Array = NDArray[np.float64]
    Index = NDArray[np.int64]
    Footprint = tuple[Array, Array, Array]

OPACITY_MAX = 0.99
"""Largest opacity of a merged splat; renderers show no more."""

LOW_PASS = 0.3
"""Variance that renderers add to every footprint, pixels squared."""

NEAREST = 0.01
"""Share of the scene's size below which a camera comes no nearer to a splat."""

BESIDE = 1e-6
"""Weight of a view beside whose image a splat lies, so that every splat has a direction."""

FLATTEST = 1e-14
"""Least eigenvalue of a covariance over their sum: rounding leaves no less."""

CHANNELS = 3

_CHUNK = 1 << 14
_TINY = 1e-280
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
    direction : (N, 3) float64
        Mean viewing direction, length 1.
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
    color: Array
    blur: Array

    def put(self, rows: Index, other: Field) -> None:
        """Overwrite `rows` by those of `other`."""
        for item in fields(self):
            getattr(self, item.name)[rows] = getattr(other, item.name)

    def take(self, rows: Index) -> Field:
        """Return a copy of some rows."""
        return Field(*(getattr(self, item.name)[rows] for item in fields(self)))


class Pairs(NamedTuple):
    """Merges of M pairs: what they cost and what becomes of them.

    Attributes
    ----------
    cost : (M,) float64
        Added to the squared error of the pictures, in the unit of `Seen`.
    position, color : (M,) float64
        Share of the first splat in the mean and covariance, and in the colour.
    opacity, growth : (M,) float64
        Of the merged splat; growth is a factor on its covariance.
    error : (M,) float64
        What deleting the merged splat would cost.
    """

    cost: Array
    position: Array
    color: Array
    opacity: Array
    growth: Array
    error: Array


def look(splats: Splats, views: ViewSet, *, threads: int | None = None) -> tuple[Array, Array]:
    """Return from where the views look at splats, and how finely, whatever is between.

    A view weighs what its pixels see of the splat, 1 / distance^2, and next to nothing where the
    splat's centre lies beside the image.

    Returns
    -------
    direction : (N, 3) float64
        Mean viewing direction, length 1.
    pixel : (N,) float64
        Area of a pixel at the splat, world units squared.
    """
    count = len(splats)
    direction, pixel = np.empty((count, 3)), np.empty(count)
    seen_from = [(view, share) for view, share in zip(views, views.weights, strict=True) if share]
    offset = np.median(splats.means, axis=0) - views.centers if count else np.ones((1, 3))
    closest = (NEAREST**2 * float(np.median(np.sum(offset * offset, axis=1)))) or 1.0

    def measure(piece: slice) -> None:
        points = np.asarray(splats.means[piece], np.float64)
        total, finest, toward = (
            np.zeros(len(points)),
            np.zeros(len(points)),
            np.zeros((3, len(points))),
        )
        for view, share in seen_from:
            offset = (points - view.center).T
            x, y, z = view.rotation @ offset
            inside = np.abs(view.fx * x + (view.cx - view.width / 2) * z) <= view.width / 2 * z
            inside &= np.abs(view.fy * y + (view.cy - view.height / 2) * z) <= view.height / 2 * z
            squared = np.maximum(np.einsum("ij,ij->j", offset, offset), closest)
            weight = np.where(inside, share, share * BESIDE) / squared
            toward += weight / np.sqrt(squared) * offset
            total += weight
            finest += weight * (view.fx * view.fy / squared)
        direction[piece] = _normalized(toward.T)
        pixel[piece] = total / finest

    for_chunks(measure, count, _CHUNK, threads=threads)
    return direction, pixel


def field(splats: Splats, views: ViewSet, seen: Seen, *, threads: int | None = None) -> Field:
    """Return drawable splats as merging sees them.

    Parameters
    ----------
    splats : Splats
        All drawable, in the frame and unit of the views.
    views : ViewSet
    seen : Seen
    threads : int, optional
    """
    count = len(splats)
    covariances, color = np.empty((count, 6)), np.empty((count, 3))
    direction, pixel = look(splats, views, threads=threads)
    rows, columns = np.triu_indices(3)

    def fill(piece: slice) -> None:
        logs = np.asarray(splats.log_scales[piece], np.float64).clip(-_LOG_RANGE, _LOG_RANGE)
        axes = rotation_matrices(splats.quaternions[piece]) * np.exp(logs)[:, None, :]
        covariances[piece] = (axes @ np.swapaxes(axes, 1, 2))[:, rows, columns]
        color[piece] = 0.5 + SH_C0 * np.asarray(splats.sh_dc[piece], np.float64)
        if splats.sh_degree:
            basis = spherical_harmonics.basis(direction[piece], splats.sh_degree)[:, 1:]
            color[piece] += np.einsum("nk,nkc->nc", basis, splats.sh_rest[piece])

    for_chunks(fill, count, _CHUNK, threads=threads)
    return Field(
        np.array(splats.means, np.float64),
        covariances,
        opacity(splats.opacity_logits),
        np.array(seen.contribution, np.float64),
        np.array(seen.error, np.float64),
        direction,
        np.maximum(color, 0.0, out=color),
        LOW_PASS * pixel,
    )


def price(splats: Field, first: Index, second: Index) -> Pairs:
    """Price merges by the equations at the top of this file.

    The factor 2 pi of masses and products cancels and is left out.

    Parameters
    ----------
    splats : Field
    first, second : (M,) int
        Rows; both splats of a pair contribute.
    """
    color, rest = _shares(splats.contribution[first], splats.contribution[second])
    one, two, x, y = _plane(splats, first, second, color)
    areas = _area(one), _area(two)
    mass_1, mass_2 = splats.opacity[first] * areas[0], splats.opacity[second] * areas[1]
    position, other = _shares(mass_1, mass_2)
    overlap = mass_1 * mass_2 * _product(one, two, x, y)
    spread = position * other
    merged = _mixed(one, two, position, (spread * x * x, spread * x * y, spread * y * y))
    # For nearly opaque splats the second order takes off more than one can hide of the other.
    mass = mass_1 + mass_2 - np.minimum(overlap, np.minimum(mass_1, mass_2))
    growth = np.maximum(mass / (_area(merged) * OPACITY_MAX), 1.0)
    merged = (merged[0] * growth, merged[1] * growth, merged[2] * growth)
    area = _area(merged)
    tau = (splats.contribution[first] + splats.contribution[second]) / (mass_1 + mass_2)
    own_1, own_2 = mass_1 * mass_1 / (2.0 * areas[0]), mass_2 * mass_2 / (2.0 * areas[1])
    own = mass * mass / (2.0 * area)
    with_1 = mass_1 * mass * _product(one, merged, other * x, other * y)
    with_2 = mass_2 * mass * _product(two, merged, position * x, position * y)
    contrast_1 = _contrast(splats.error[first], splats.contribution[first] / mass_1 * own_1)
    contrast_2 = _contrast(splats.error[second], splats.contribution[second] / mass_2 * own_2)
    step = splats.color[first] - splats.color[second]
    both = 0.5 * (contrast_1 + contrast_2 - np.einsum("ij,ij->i", step, step))
    limit = np.sqrt(contrast_1 * contrast_2)
    both = np.clip(both, -limit, limit)
    pp = own_1 - 2.0 * color * with_1 + color * color * own
    qq = own_2 - 2.0 * rest * with_2 + rest * rest * own
    pq = overlap - rest * with_1 - color * with_2 + color * rest * own
    cost = tau * np.maximum(contrast_1 * pp + 2.0 * both * pq + contrast_2 * qq, 0.0)
    contrast = color * color * contrast_1 + 2.0 * color * rest * both + rest * rest * contrast_2
    error = tau * np.maximum(contrast, 0.0) * own
    return Pairs(cost, position, color, mass / area, growth, error)


def merge(splats: Field, first: Index, second: Index, pairs: Pairs) -> Field:
    """Return the merged splats: their moments are those of the two, weighted.

    ``mu = w mu_i + w' mu_j`` and ``C = w C_i + w' C_j + w w' d d'``, w + w' = 1, d = mu_j - mu_i.
    """
    one, two = splats.take(first), splats.take(second)
    position, color = pairs.position[:, None], pairs.color[:, None]
    step = two.means - one.means
    rows, columns = np.triu_indices(3)
    spread = step[:, rows] * step[:, columns] * (position * (1.0 - position))
    covariances = position * one.covariances + (1.0 - position) * two.covariances + spread
    direction = _normalized(color * one.direction + (1.0 - color) * two.direction)
    lost = ~direction.any(axis=1)
    direction[lost] = one.direction[lost]
    return Field(
        one.means + (1.0 - position) * step,
        covariances * pairs.growth[:, None],
        pairs.opacity,
        one.contribution + two.contribution,
        pairs.error,
        direction,
        color * one.color + (1.0 - color) * two.color,
        pairs.color * one.blur + (1.0 - pairs.color) * two.blur,
    )


def axes(covariances: Array) -> tuple[Array, Array]:
    """Return log scales, (M, 3), and quaternions, (M, 4), of covariances, (M, 6)."""
    full = covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    total = np.maximum(np.trace(full, axis1=1, axis2=2), _TINY)
    values, vectors = np.linalg.eigh(full / total[:, None, None])
    logs = 0.5 * (np.log(np.maximum(values, FLATTEST)) + np.log(total)[:, None])
    vectors[np.linalg.det(vectors) < 0.0] *= -1.0
    return logs, quaternion(vectors)


def _shares(one: Array, two: Array) -> tuple[Array, Array]:
    """Return the shares of two positive amounts in their sum."""
    total = one + two
    return one / total, two / total


def _contrast(error: Array, whole: Array) -> Array:
    """Return |s|^2, E over what it would be at a contrast of 1; colours differ by 1 at most."""
    contrast: Array = np.minimum(error, CHANNELS * whole) / np.maximum(whole, _TINY)
    return contrast


def _plane(
    splats: Field, first: Index, second: Index, share: Array
) -> tuple[Footprint, Footprint, Array, Array]:
    """Return both footprints and the step between them, across the pair's viewing direction.

    Parameters
    ----------
    share : (M,) float64
        Of the first in the direction.

    Returns
    -------
    first, second : tuple of (M,) float64
        xx, xy, yy, low-pass included; world units squared.
    x, y : (M,) float64
    """
    normal = splats.direction[first] * share[:, None]
    normal += splats.direction[second] * (1.0 - share)[:, None]
    # Seen from opposite sides alike: the plane across the first one's direction is as good.
    lost = np.einsum("ij,ij->i", normal, normal) < BESIDE
    normal[lost] = splats.direction[first[lost]]
    across = _across(_normalized(normal))
    blur = share * splats.blur[first]
    blur += (1.0 - share) * splats.blur[second]
    step = (splats.means[second] - splats.means[first]).T
    return (
        _footprint(splats.covariances[first], across, blur),
        _footprint(splats.covariances[second], across, blur),
        np.einsum("ji,ji->i", step, across[0]),
        np.einsum("ji,ji->i", step, across[1]),
    )


def _across(normal: Array) -> tuple[Array, Array]:
    """Return two unit vectors, (3, M), across `normal` and each other (Duff et al. 2017)."""
    x, y, z = normal.T
    sign = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    u = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x])
    v = np.stack([b, sign + y * y * a, -y])
    return u, v


def _footprint(covariances: Array, across: tuple[Array, Array], blur: Array) -> Footprint:
    """Return xx, xy, yy of ``(u, v)' C (u, v) + blur I``."""
    u, v = across
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


def _mixed(one: Footprint, two: Footprint, share: Array, spread: Footprint) -> Footprint:
    """Return the footprint of the mixture of two."""
    rest = 1.0 - share
    return (
        share * one[0] + rest * two[0] + spread[0],
        share * one[1] + rest * two[1] + spread[1],
        share * one[2] + rest * two[2] + spread[2],
    )


def _determinant(footprint: Footprint) -> Array:
    """Return the determinant, a little above 0 where rounding leaves none of a thin one."""
    xx, xy, yy = footprint
    return np.maximum(xx * yy - xy * xy, 1e-12 * xx * yy + _TINY)


def _area(footprint: Footprint) -> Array:
    return np.sqrt(_determinant(footprint))


def _product(one: Footprint, other: Footprint, x: Array, y: Array) -> Array:
    """Return 2 pi times the integral of the product of two normal densities, `x`, `y` apart."""
    total = (one[0] + other[0], one[1] + other[1], one[2] + other[2])
    determinant = _determinant(total)
    square = (total[2] * x * x - 2.0 * total[1] * x * y + total[0] * y * y) / determinant
    product: Array = np.exp(-0.5 * np.clip(square, 0.0, 700.0)) / np.sqrt(determinant)
    return product


def _normalized(vectors: Array) -> Array:
    """Return unit vectors, (M, 3); 0 stays 0."""
    length = np.sqrt(np.einsum("ij,ij->i", vectors, vectors))[:, None]
    unit: Array = vectors / np.where(length > 0.0, length, 1.0)
    return unit
