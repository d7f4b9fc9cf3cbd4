"""What merging two splats costs the pictures, and the splat that comes of it.

Every splat i is an image signal: its footprint ``f_i = alpha_i exp(-q_i / 2)`` times its contrast
``s_i = c_i - B`` to what lies behind it. Two numbers say what the cameras see of it, summed over
the pixels of all views; T is the transmittance in front of it::

    contribution  W_i = sum of T alpha              error  E_i = sum of (T alpha)^2 |s_i|^2

E is what deleting the splat costs. Merging i and j to m costs the squared error of the picture,
in the plane that the cameras look at (across the viewing direction of the pair), with the inner
products ``<f, g>`` of Gaussians in closed form::

    p = f_i - l_i f_m,  q = f_j - l_j f_m                l: share of the colour, l_i + l_j = 1
    cost = tau (|s_i|^2 <p, p> + 2 s_i.s_j <p, q> + |s_j|^2 <q, q>)
    tau  = (W_i + W_j) / (A_i + A_j)                     A: mass, the integral of f
    |s_i|^2 = E_i / (tau_i <f_i, f_i>),   2 s_i.s_j = |s_i|^2 + |s_j|^2 - |c_i - c_j|^2

The merged splat has the mean and covariance of both (weights: mass), their colour (weights:
contribution) and, by its opacity, their mass less the overlap, which the eye counts once:
``A_m = A_i + A_j - <f_i, f_j>``. Where that would take an opacity above `ALPHA_MAX`, the splat
grows instead.

What lies one behind the other along the mean direction would merge for nothing, but other views
look past it: costs are taken from two directions, a standard deviation to either side (`tilt`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..affine import quaternion
from ..rendering import ALPHA_MAX
from .merge_field import Field, Seen, across, footprint, normalized

if TYPE_CHECKING:
    from .merge_field import Array, Footprint, Index

__all__ = ["Field", "Pairs", "Seen", "axes", "costs", "merge", "price"]

FLATTEST = 1e-14
"""Least eigenvalue of a covariance over their sum: rounding leaves no less."""

CHANNELS = 3

_CANCELLED = 1e-6
_TINY = 1e-280


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


def price(splats: Field, first: Index, second: Index, tilt: float = 0.0) -> Pairs:
    """Price merges by the equations at the top of this file.

    Parameters
    ----------
    splats : Field
    first, second : (M,) int
        Rows; both splats of a pair contribute.
    tilt : float
        From where: the mean viewing direction plus so many standard deviations of the directions.
    """
    return _price(_gather(splats, first, second), tilt)


def costs(splats: Field, first: Index, second: Index) -> Array:
    """Return the costs of merges, (M,): the mean of those from two directions."""
    ends = _gather(splats, first, second)
    return 0.5 * (_price(ends, -1.0).cost + _price(ends, 1.0).cost)


class _Ends(NamedTuple):
    """Both splats of each pair, and what they have in common.

    Attributes
    ----------
    one, two : Field
    color, rest : (M,) float64
        Shares of the first and of the second in the colour.
    direction, spread : (M, 3) float64
    blur : (M,) float64
    apart : (M,) float64
        Squared difference of their colours.
    """

    one: Field
    two: Field
    color: Array
    rest: Array
    direction: Array
    spread: Array
    blur: Array
    apart: Array


def _gather(splats: Field, first: Index, second: Index) -> _Ends:
    """Return what pricing needs of pairs."""
    one, two = splats.take(first), splats.take(second)
    color, rest = _shares(one.contribution, two.contribution)
    direction = one.direction * color[:, None]
    direction += two.direction * rest[:, None]
    # Seen from opposite sides alike: the plane across the first one's direction is as good.
    lost = np.einsum("ij,ij->i", direction, direction) < _CANCELLED
    direction[lost] = one.direction[lost]
    step = one.color - two.color
    return _Ends(
        one,
        two,
        color,
        rest,
        normalized(direction),
        _spread(one.spread, two.spread, color),
        color * one.blur + rest * two.blur,
        np.einsum("ij,ij->i", step, step),
    )


def _price(ends: _Ends, tilt: float) -> Pairs:
    """Price merges seen from one direction; the factor 2 pi of masses and products cancels."""
    first, second, color, rest = ends.one, ends.two, ends.color, ends.rest
    one, two, x, y = _plane(ends, tilt)
    areas = _area(one), _area(two)
    mass_1, mass_2 = first.opacity * areas[0], second.opacity * areas[1]
    position, other = _shares(mass_1, mass_2)
    overlap = mass_1 * mass_2 * _product(one, two, x, y)
    spread = position * other
    merged = _mixed(one, two, position, (spread * x * x, spread * x * y, spread * y * y))
    # For nearly opaque splats the second order takes off more than one can hide of the other.
    mass = mass_1 + mass_2 - np.minimum(overlap, np.minimum(mass_1, mass_2))
    growth = np.maximum(mass / (_area(merged) * ALPHA_MAX), 1.0)
    merged = (merged[0] * growth, merged[1] * growth, merged[2] * growth)
    area = _area(merged)
    tau = (first.contribution + second.contribution) / (mass_1 + mass_2)
    own_1, own_2 = mass_1 * mass_1 / (2.0 * areas[0]), mass_2 * mass_2 / (2.0 * areas[1])
    own = mass * mass / (2.0 * area)
    with_1 = mass_1 * mass * _product(one, merged, other * x, other * y)
    with_2 = mass_2 * mass * _product(two, merged, position * x, position * y)
    contrast_1 = _contrast(first.error, first.contribution / mass_1 * own_1)
    contrast_2 = _contrast(second.error, second.contribution / mass_2 * own_2)
    both = 0.5 * (contrast_1 + contrast_2 - ends.apart)
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
    direction = normalized(color * one.direction + (1.0 - color) * two.direction)
    lost = ~direction.any(axis=1)
    direction[lost] = one.direction[lost]
    return Field(
        one.means + (1.0 - position) * step,
        covariances * pairs.growth[:, None],
        pairs.opacity,
        one.contribution + two.contribution,
        pairs.error,
        direction,
        _spread(one.spread, two.spread, pairs.color),
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


def _plane(ends: _Ends, tilt: float) -> tuple[Footprint, Footprint, Array, Array]:
    """Return both footprints and the step between them, across the pair's viewing direction.

    Returns
    -------
    one, two : tuple of (M,) float64
        xx, xy, yy, low-pass included; world units squared.
    x, y : (M,) float64
    """
    normal = normalized(ends.direction + tilt * ends.spread) if tilt else ends.direction
    u, v = across(normal)
    step = (ends.two.means - ends.one.means).T
    return (
        footprint(ends.one.covariances, (u, v), ends.blur),
        footprint(ends.two.covariances, (u, v), ends.blur),
        np.einsum("ji,ji->i", step, u),
        np.einsum("ji,ji->i", step, v),
    )


def _spread(one: Array, two: Array, share: Array) -> Array:
    """Return the mean of spreads, whose sign means nothing, (M, 3)."""
    sign = np.where(np.einsum("ij,ij->i", one, two) < 0.0, -1.0, 1.0)
    mean: Array = share[:, None] * one + ((1.0 - share) * sign)[:, None] * two
    return mean


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
