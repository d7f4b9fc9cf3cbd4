"""The cost of merging two splats, as an error of the pictures, and the merged splat.

Splat i changes the picture by its footprint ``f_i = alpha_i exp(-q_i / 2)`` times the contrast
``s_i = c_i - B`` between its colour and the colour behind it. The views measure two sums over all
of their pixels; T is the transmittance in front of the splat::

    contribution  W_i = sum of T alpha              error  E_i = sum of (T alpha)^2 |s_i|^2

E is the cost of deleting the splat. The cost of replacing i and j by m is the squared error of the
picture. The inner products ``<f, g>`` of Gaussians have a closed form, in a plane at right angles
to the direction that the pair is viewed along (derived in docs/method.md, section 7)::

    p = f_i - l_i f_m,  q = f_j - l_j f_m                l: share of the colour, l_i + l_j = 1
    cost = tau (|s_i|^2 <p, p> + 2 s_i.s_j <p, q> + |s_j|^2 <q, q>)
    tau  = (W_i + W_j) / (A_i + A_j)                     A: mass, the integral of f
    |s_i|^2 = E_i / (tau_i <f_i, f_i>),   2 s_i.s_j = |s_i|^2 + |s_j|^2 - |c_i - c_j|^2

The merged splat has the mean and covariance of the mixture of the two, weighted by mass, and their
mean colour, weighted by contribution. Its mass is ``A_m = A_i + A_j - <f_i, f_j>``, since the area
that both cover is covered only once; its opacity follows from that mass. Where the opacity would
exceed `ALPHA_MAX`, the covariance grows instead.

Seen along the mean viewing direction, merging two splats one behind the other costs nothing, though
views from aside see both. So the cost of a pair is the mean of its costs from two directions: one
standard deviation of the viewing directions to either side of their mean (`costs`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..affine import quaternion
from ..rendering import ALPHA_MAX
from .merge_field import Field, ViewSums, across, footprint, normalized

if TYPE_CHECKING:
    from .merge_field import Array, Footprint, Index

__all__ = ["Field", "Pairs", "ViewSums", "axes", "costs", "merge", "price"]

FLATTEST = 1e-14
"""Least eigenvalue of a covariance over the sum of the three; rounding hides smaller ones."""

CHANNELS = 3
"""Red, green and blue."""

_CANCELLED = 1e-6  # a mean of two unit vectors with a smaller squared length counts as 0
_TINY = 1e-280  # replaces 0 as a divisor
_THINNEST = 1e-12  # least determinant over xx yy; rounding leaves less of thinner footprints
_FARTHEST = 700.0  # standard deviations, squared: exp(-350) is as good as 0 and does not underflow


class Pairs(NamedTuple):
    """Merges of M pairs: their costs and results.

    Attributes
    ----------
    cost : (M,) float64
        Squared error of the pictures that the merge causes, in the unit of `ViewSums`.
    position, color : (M,) float64
        Share of the first splat in the mean and covariance, and in the colour.
    opacity, growth : (M,) float64
        Of the merged splat; growth is the factor on its covariance that keeps its opacity at most
        `ALPHA_MAX`.
    error : (M,) float64
        Cost of deleting the merged splat.
    """

    cost: Array
    position: Array
    color: Array
    opacity: Array
    growth: Array
    error: Array


def price(splats: Field, first: Index, second: Index, tilt: float = 0.0) -> Pairs:
    """Return costs and results of merges, by the equations at the top of this file.

    Parameters
    ----------
    splats : Field
    first, second : (M,) int
        Rows; all splats have a contribution above 0.
    tilt : float
        How many standard deviations of the viewing directions to add to their mean.
    """
    return _price(_gather(splats, first, second), tilt)


def costs(splats: Field, first: Index, second: Index, limit: Array | float) -> Array:
    """Return the costs of merges, (M,): the mean over two viewing directions.

    Parameters
    ----------
    splats, first, second
        See `price`.
    limit : (M,) float64, or float
        Costs of at least this much are given as infinity, which takes less time.
    """
    ends = _gather(splats, first, second)
    cost = 0.5 * _price(ends, -1.0).cost
    cheap = np.flatnonzero(cost < limit)
    cost[cheap] += 0.5 * _price(ends.take(cheap), 1.0).cost
    cost[~(cost < limit)] = np.inf
    return cost


class _Ends(NamedTuple):
    """The two splats of M pairs, and means over the two.

    Attributes
    ----------
    one, two : Field
        The first and the second splats.
    color, rest : (M,) float64
        Shares of the first and of the second splat in the colour.
    direction, deviation : (M, 3) float64
        From where the pair is viewed; see `merge_field.Viewing`.
    blur : (M,) float64
        Variance of the low-pass, world units squared.
    apart : (M,) float64
        Squared difference of their colours.
    """

    one: Field
    two: Field
    color: Array
    rest: Array
    direction: Array
    deviation: Array
    blur: Array
    apart: Array

    def take(self, rows: Index) -> _Ends:
        """Return the ends of some pairs."""
        return _Ends(
            self.one.take(rows),
            self.two.take(rows),
            self.color[rows],
            self.rest[rows],
            self.direction[rows],
            self.deviation[rows],
            self.blur[rows],
            self.apart[rows],
        )


def _gather(splats: Field, first: Index, second: Index) -> _Ends:
    """Return the ends of pairs."""
    one, two = splats.take(first), splats.take(second)
    color, rest = _shares(one.contribution, two.contribution)  # (M,) each
    direction = one.direction * color[:, None]  # (M, 3)
    direction += two.direction * rest[:, None]
    # Opposite directions cancel. Both define the same plane, so the first is used.
    lost = np.einsum("ij,ij->i", direction, direction) < _CANCELLED  # (M,)
    direction[lost] = one.direction[lost]
    step = one.color - two.color  # (M, 3)
    return _Ends(
        one,
        two,
        color,
        rest,
        normalized(direction),
        _mean_deviation(one.deviation, two.deviation, color),
        color * one.blur + rest * two.blur,
        np.einsum("ij,ij->i", step, step),
    )


def _price(ends: _Ends, tilt: float) -> Pairs:
    """Return costs and results of merges, viewed from one direction.

    All masses and inner products here are divided by 2 pi, a factor that cancels. All arrays are
    (M,).
    """
    signals = _signals(ends, tilt)
    products = _products(signals)
    contrasts = _contrasts(ends, signals.masses, products)
    tau = (ends.one.contribution + ends.two.contribution) / (signals.masses[0] + signals.masses[1])
    # The contrast of the merged splat is l_i s_i + l_j s_j.
    color, rest = ends.color, ends.rest
    mixed = color * color * contrasts.one + 2.0 * color * rest * contrasts.both
    mixed += rest * rest * contrasts.two
    return Pairs(
        tau * np.maximum(_change(ends, contrasts, products), 0.0),
        signals.position,
        color,
        signals.mass / signals.areas[2],
        signals.growth,
        tau * np.maximum(mixed, 0.0) * products.merged,
    )


def _change(ends: _Ends, contrasts: _Contrasts, products: _Products) -> Array:
    """Return the squared change of the picture by merges, unhidden: `cost` over tau, (M,)."""
    color, rest = ends.color, ends.rest
    pp = products.one - 2.0 * color * products.one_merged + color * color * products.merged
    qq = products.two - 2.0 * rest * products.two_merged + rest * rest * products.merged
    pq = products.overlap - rest * products.one_merged - color * products.two_merged
    pq += color * rest * products.merged
    change: Array = contrasts.one * pp + 2.0 * contrasts.both * pq + contrasts.two * qq
    return change


class _Signals(NamedTuple):
    """Footprints and masses of M pairs and of the merged splats, in the plane viewed.

    Attributes
    ----------
    one, two, merged : Footprint
        Covariances in the plane, low-pass included.
    x, y : (M,) float64
        Step from the centre of the first to that of the second.
    areas : tuple of (M,) float64
        Of the first, the second and the merged footprint; see `_area`.
    masses : tuple of (M,) float64
        Of the first and of the second.
    mass : (M,) float64
        Of the merged splat.
    position, other : (M,) float64
        Shares of the first and of the second in the mass.
    growth : (M,) float64
        Factor that `merged` contains, so that its opacity is at most `ALPHA_MAX`.
    overlap : (M,) float64
        Inner product of the two.
    """

    one: Footprint
    two: Footprint
    merged: Footprint
    x: Array
    y: Array
    areas: tuple[Array, Array, Array]
    masses: tuple[Array, Array]
    mass: Array
    position: Array
    other: Array
    growth: Array
    overlap: Array


def _signals(ends: _Ends, tilt: float) -> _Signals:
    """Return footprints and masses of pairs and of the merged splats."""
    one, two, x, y = _plane(ends, tilt)
    areas = _area(one), _area(two)
    masses = ends.one.opacity * areas[0], ends.two.opacity * areas[1]
    position, other = _shares(*masses)
    overlap = masses[0] * masses[1] * _product(one, two, x, y)
    between = position * other
    merged = _mixed(one, two, position, (between * x * x, between * x * y, between * y * y))
    # The estimated overlap of nearly opaque splats can exceed the smaller mass; the true one never.
    mass = masses[0] + masses[1] - np.minimum(overlap, np.minimum(*masses))
    growth = np.maximum(mass / (_area(merged) * ALPHA_MAX), 1.0)
    merged = (merged[0] * growth, merged[1] * growth, merged[2] * growth)
    return _Signals(
        one, two, merged, x, y, (*areas, _area(merged)), masses, mass, position, other, growth,
        overlap,
    )  # fmt: skip


class _Products(NamedTuple):
    """Inner products of the signals of M pairs, (M,) float64 each.

    Attributes
    ----------
    one, two, merged
        ``<f_i, f_i>``, ``<f_j, f_j>``, ``<f_m, f_m>``.
    overlap, one_merged, two_merged
        ``<f_i, f_j>``, ``<f_i, f_m>``, ``<f_j, f_m>``.
    """

    one: Array
    two: Array
    merged: Array
    overlap: Array
    one_merged: Array
    two_merged: Array


def _products(signals: _Signals) -> _Products:
    """Return the inner products of pairs and of the merged splats."""
    merged, mass, x, y = signals.merged, signals.mass, signals.x, signals.y
    mass_1, mass_2 = signals.masses
    area_1, area_2, area = signals.areas
    # The merged centre lies between the two, away from each by the other's share of the step.
    away_1, away_2 = signals.other, signals.position
    return _Products(
        mass_1 * mass_1 / (2.0 * area_1),
        mass_2 * mass_2 / (2.0 * area_2),
        mass * mass / (2.0 * area),
        signals.overlap,
        mass_1 * mass * _product(signals.one, merged, away_1 * x, away_1 * y),
        mass_2 * mass * _product(signals.two, merged, away_2 * x, away_2 * y),
    )


class _Contrasts(NamedTuple):
    """Products of the contrasts of M pairs, (M,) float64 each.

    Attributes
    ----------
    one, two, both
        ``|s_i|^2``, ``|s_j|^2``, ``s_i.s_j``.
    """

    one: Array
    two: Array
    both: Array


def _contrasts(ends: _Ends, masses: tuple[Array, Array], products: _Products) -> _Contrasts:
    """Return the contrasts that the measured errors of pairs imply."""
    first, second = ends.one, ends.two
    one = _squared_contrast(first.error, first.contribution / masses[0] * products.one)
    two = _squared_contrast(second.error, second.contribution / masses[1] * products.two)
    both = 0.5 * (one + two - ends.apart)
    # By Cauchy-Schwarz |s_i.s_j| is at most this; measured errors and colours can contradict it.
    limit = np.sqrt(one * two)
    both = np.clip(both, -limit, limit)
    return _Contrasts(one, two, both)


def merge(splats: Field, first: Index, second: Index, pairs: Pairs) -> Field:
    """Return the merged splats; each has the mean and covariance of the mixture of its pair.

    ``mu = w mu_i + w' mu_j`` and ``C = w C_i + w' C_j + w w' d d'``, w + w' = 1, d = mu_j - mu_i.
    """
    one, two = splats.take(first), splats.take(second)
    position, color = pairs.position[:, None], pairs.color[:, None]
    step = two.means - one.means
    rows, columns = np.triu_indices(3)
    between = step[:, rows] * step[:, columns] * (position * (1.0 - position))  # (M, 6)
    covariances = position * one.covariances + (1.0 - position) * two.covariances + between
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
        _mean_deviation(one.deviation, two.deviation, pairs.color),
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
    """Return the shares of two positive amounts in their sum, (M,) each."""
    total = one + two
    return one / total, two / total


def _squared_contrast(error: Array, whole: Array) -> Array:
    """Return |s|^2, (M,), the squared contrast that an error implies.

    Colours are in 0..1, so |s|^2 is limited to 1 for each channel.

    Parameters
    ----------
    error : (M,) float64
        As measured.
    whole : (M,) float64
        What it would be for |s| = 1.
    """
    squared: Array = np.minimum(error, CHANNELS * whole) / np.maximum(whole, _TINY)
    return squared


def _plane(ends: _Ends, tilt: float) -> tuple[Footprint, Footprint, Array, Array]:
    """Return both footprints and the step between them, in the plane that the pair is viewed in.

    Parameters
    ----------
    ends : _Ends
    tilt : float
        How many standard deviations of the viewing directions to add to their mean.

    Returns
    -------
    one, two : tuple of (M,) float64
        xx, xy, yy, low-pass included; world units squared.
    x, y : (M,) float64
    """
    normal = normalized(ends.direction + tilt * ends.deviation) if tilt else ends.direction
    u, v = across(normal)
    step = (ends.two.means - ends.one.means).T
    return (
        footprint(ends.one.covariances, (u, v), ends.blur),
        footprint(ends.two.covariances, (u, v), ends.blur),
        np.einsum("ji,ji->i", step, u),
        np.einsum("ji,ji->i", step, v),
    )


def _mean_deviation(one: Array, two: Array, share: Array) -> Array:
    """Return the mean of deviations, (M, 3), whose signs are arbitrary, so they are made alike."""
    sign = np.where(np.einsum("ij,ij->i", one, two) < 0.0, -1.0, 1.0)
    mean: Array = share[:, None] * one + ((1.0 - share) * sign)[:, None] * two
    return mean


def _mixed(one: Footprint, two: Footprint, share: Array, between: Footprint) -> Footprint:
    """Return the covariance of a mixture of two distributions.

    Parameters
    ----------
    one, two : Footprint
    share : (M,) float64
        Of the first.
    between : Footprint
        Covariance between the two centres, weighted by their shares.
    """
    rest = 1.0 - share
    return (
        share * one[0] + rest * two[0] + between[0],
        share * one[1] + rest * two[1] + between[1],
        share * one[2] + rest * two[2] + between[2],
    )


def _determinant(footprint: Footprint) -> Array:
    """Return the determinant, (M,), kept above 0 where rounding would leave 0 or less."""
    xx, xy, yy = footprint
    return np.maximum(xx * yy - xy * xy, _THINNEST * xx * yy + _TINY)


def _area(footprint: Footprint) -> Array:
    """Return the area of the ellipse of one standard deviation, divided by pi, (M,)."""
    return np.sqrt(_determinant(footprint))


def _product(one: Footprint, other: Footprint, x: Array, y: Array) -> Array:
    """Return 2 pi times the integral of the product of two normal densities, (M,).

    The integral is a normal density at the step `x`, `y` between their centres; its covariance is
    the sum of the two.
    """
    total = (one[0] + other[0], one[1] + other[1], one[2] + other[2])
    determinant = _determinant(total)
    square = (total[2] * x * x - 2.0 * total[1] * x * y + total[0] * y * y) / determinant
    product: Array = np.exp(-0.5 * np.clip(square, 0.0, _FARTHEST)) / np.sqrt(determinant)
    return product
