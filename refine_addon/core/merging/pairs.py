"""Where two splats become one: what it costs the pictures, and the merged splat.

docs/method.md, section 7, derives the cost: ``tau (|s_i|^2 <p, p> + 2 s_i.s_j <p, q> +
|s_j|^2 <q, q>)`` with ``p = f_i - l_i f_m``, ``q = f_j - l_j f_m``; f are the footprints in a plane
across the viewing direction, s the contrasts, l the shares of the colour, m the merged splat.
`price` and `costs` give the cost, `merge` the merged splat, `as_splats` its values as stored; its
harmonics are those of `merge._blend`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ..affine import quaternion
from ..execute import Progress, chunks, run_all
from ..splats import ALPHA_MAX, LOG_ZERO, LOW_PASS, Model
from ..visibility.projection import disc_axes
from .field import Array, Field, Footprint, Index, Real, across, footprint, normalized, packed

FLATTEST = 1e-14  # least eigenvalue of a covariance over their sum; rounding hides smaller ones

ASIDE = 0.1
"""Least standard deviation, about radians, of the viewing directions that discs are flattened for,
since other views look from the side. Results hardly depend on it from 0.03 to 0.3."""

_CHUNK = 1 << 14  # splats at a time: some MB of temporary memory a thread
_CANCELLED = 1e-6  # a mean of two unit vectors with a smaller squared length counts as 0
_TINY = 1e-280  # replaces 0 as a divisor
# Bytes of a number -> what replaces 0 as a divisor, and the least determinant over xx yy: rounding
# leaves less of thinner footprints.
_LEAST = {4: (1e-37, 1e-6), 8: (_TINY, 1e-12)}
_FARTHEST = 160.0  # standard deviations, squared: exp(-80) is as good as 0 and does not underflow


class Pairs(NamedTuple):
    """Merges of M pairs, (M,) each."""

    cost: Array  # squared error of the pictures, unit of `Field.error`
    position: Array  # share of the first splat in mean and covariance
    color: Array  # share of the first splat in the colour
    opacity: Array  # of the merged splat
    growth: Array  # factor on its covariance that keeps its opacity at most `ALPHA_MAX`
    error: Array  # cost of deleting the merged splat


def price(splats: Field, first: Index, second: Index, tilt: float = 0.0) -> Pairs:
    """Costs and results of merging pairs, viewed `tilt` standard deviations off the mean."""
    return _price(_gather(splats, first, second, np.float64), tilt)


def costs(splats: Field, first: Index, second: Index, limit: Array | float) -> Real:
    """Costs of merges, (M,) float32: means over two directions; infinite from `limit` on."""
    # What leaves the range of float32 costs infinity, or NaN: it is not merged.
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        ends = _gather(splats, first, second, np.float64 if splats.model == "2dgs" else np.float32)
        cost = np.asarray(0.5 * _price(ends, -1.0).cost, np.float32)
        cheap = np.flatnonzero(cost < limit)
        others = ends if len(cheap) == len(cost) else ends.take(cheap)
        cost[cheap] += np.asarray(0.5 * _price(others, 1.0).cost, np.float32)
    cost[~(cost < limit)] = np.inf
    return cost


class _Side(NamedTuple):
    covariances: Real
    opacity: Real
    contribution: Real
    error: Real


class _Ends(NamedTuple):
    """The two splats of M pairs, and means over the two; all in float32, or all in float64.

    Lengths are over the root of the pair's summed variances: squares of areas fit into float32.
    """

    model: Model
    one: _Side
    two: _Side
    color: Real  # (M,), share of the first splat in the colour
    rest: Real  # (M,), that of the second
    step: Real  # (3, M), from the first mean to the second
    direction: Real  # (3, M), see `Field`, as are the next two
    deviation: Real  # (3, M)
    blur: Real  # (M,)
    apart: Real  # (M,), squared difference of the colours

    def take(self, rows: Index) -> _Ends:
        one, two = (
            _Side(*(values.take(rows, axis=-1) for values in side)) for side in (self.one, self.two)
        )
        return _Ends(self.model, one, two, *(values.take(rows, axis=-1) for values in self[3:]))


def _gather(splats: Field, first: Index, second: Index, kind: type[np.floating[Any]]) -> _Ends:
    """Ends of pairs as `kind`, float32 or float64."""

    def both(values: Real) -> list[Real]:
        return [
            values.take(rows, axis=0).T.astype(kind, order="C", copy=False)
            for rows in (first, second)
        ]

    seen = [splats.contribution.take(rows) for rows in (first, second)]  # (M,) each, as all these
    color, rest = _shares(*seen)
    blur = color * splats.blur.take(first) + rest * splats.blur.take(second)
    shapes = [splats.covariances.take(rows, axis=0).T for rows in (first, second)]  # (6, M) each
    spread = sum((xx + yy + zz for xx, _, _, yy, _, zz in shapes), blur)
    unit = 1.0 / np.maximum(spread, _TINY)  # (M,), over the squared unit of length
    step = (splats.means.take(second, axis=0) - splats.means.take(first, axis=0)).T * np.sqrt(unit)
    color, rest = color.astype(kind, copy=False), rest.astype(kind, copy=False)
    amounts = zip(*map(both, (splats.opacity, splats.contribution, splats.error)), strict=True)
    one, two = (
        _Side(np.multiply(shape, unit, dtype=kind, casting="same_kind", order="C"), *of_side)
        for shape, of_side in zip(shapes, amounts, strict=True)
    )
    directions, deviations, colors = map(both, (splats.direction, splats.deviation, splats.color))
    direction = color * directions[0] + rest * directions[1]  # (3, M)
    # Opposite directions cancel. Both define the same plane, so the first is used.
    lost = np.flatnonzero(_dot(direction, direction) < _CANCELLED)
    direction[:, lost] = directions[0][:, lost]
    apart = colors[0] - colors[1]
    return _Ends(
        splats.model, one, two, color, rest, step.astype(kind, order="C"), _unit(direction),
        _mean_deviation(deviations[0], deviations[1], color),
        (blur * unit).astype(kind, copy=False), _dot(apart, apart),
    )  # fmt: skip


def _price(ends: _Ends, tilt: float) -> Pairs:
    """Costs and results from one direction, (M,) each; masses are over 2 pi, which cancels."""
    color, rest, blur = ends.color, ends.rest, ends.blur
    direction = _unit(ends.direction + tilt * ends.deviation) if tilt else ends.direction
    plane = across(direction.T)
    x, y = (_dot(ends.step, axis) for axis in plane)
    step = (x * x, x * y, y * y)
    one, two = (
        _signal(side.covariances, side.opacity, plane, blur, ends.model)
        for side in (ends.one, ends.two)
    )
    mixed: Any
    position, other = _shares(one.mass, two.mass)
    ij = _inner(one, two, step, 1.0)
    # The estimated overlap of nearly opaque splats can exceed the smaller mass; the true one never.
    mass = one.mass + two.mass - np.minimum(ij, np.minimum(one.mass, two.mass))
    if ends.model == "2dgs":
        whole = _mixture(ends.one.covariances, ends.two.covariances, ends.step, position)
        mean, deviation = (np.asarray(each.T, np.float64, order="C") for each in ends[6:8])
        disc = footprint(flat_as_viewed(whole.T, mean, deviation), plane, np.zeros(len(blur)))
        growth = np.maximum(mass / (_area(_disc_as_drawn(disc, blur)) * ALPHA_MAX), 1.0)
        mixed = _disc_as_drawn((disc[0] * growth, disc[1] * growth, disc[2] * growth), blur)
        area = base = _area(mixed)
    else:
        rest_of_one, between = 1.0 - position, position * other
        mixed = tuple(
            position * a + rest_of_one * b + between * c
            for a, b, c in zip(one.footprint, two.footprint, step, strict=True)
        )
        area = _area(mixed)
        base = _base(mixed, area, blur, ends.model)
        growth = np.maximum(mass / (base * ALPHA_MAX), 1.0)
        mixed = tuple(each * growth for each in mixed)
        area, base = area * growth, base * growth
    merged = _Signal(mixed, area, mass)
    ii, jj, mm = (each.mass * each.mass / (2.0 * each.area) for each in (one, two, merged))
    # The merged centre lies between the two, away from each by the other's share of the step.
    im = _inner(one, merged, step, other * other)
    jm = _inner(two, merged, step, position * position)
    pp = ii - 2.0 * color * im + color * color * mm
    qq = jj - 2.0 * rest * jm + rest * rest * mm
    pq = ij - rest * im - color * jm
    pq += color * rest * mm
    s_i, s_j = (
        _squared_contrast(side.error, side.contribution / signal.mass * squared)
        for side, signal, squared in ((ends.one, one, ii), (ends.two, two, jj))
    )
    # By Cauchy-Schwarz |s_i.s_j| is at most this; measured errors and colours can contradict it.
    limit = np.sqrt(s_i * s_j)
    s_ij = np.clip(0.5 * (s_i + s_j - ends.apart), -limit, limit)
    cost = s_i * pp + 2.0 * s_ij * pq + s_j * qq
    # The contrast of the merged splat is l_i s_i + l_j s_j.
    contrast = color * color * s_i + 2.0 * color * rest * s_ij + rest * rest * s_j
    tau = (ends.one.contribution + ends.two.contribution) / (one.mass + two.mass)
    return Pairs(
        tau * np.maximum(cost, 0.0), position, color, mass / base, growth,
        tau * np.maximum(contrast, 0.0) * mm,
    )  # fmt: skip


class _Signal(NamedTuple):
    """M splats as seen in a plane: f in the equations, without their positions."""

    footprint: Footprint
    area: Real
    mass: Real


def _signal(covariances, opacity, plane, blur, model):
    """Splats in a plane, spanned by unit vectors, with a low-pass of variance `blur`."""
    if model == "2dgs":
        ellipse = _disc_as_drawn(footprint(covariances.T, plane, np.zeros(len(blur))), blur)
    else:
        ellipse = footprint(covariances.T, plane, blur)
    area = _area(ellipse)
    return _Signal(ellipse, area, opacity * _base(ellipse, area, blur, model))


def _inner(one: _Signal, other: _Signal, step: Footprint, factor: Real | float) -> Real:
    """Inner products ``<f, g>``, (M,), given xx, xy, yy of the step in between, times a factor."""
    xx, xy, yy = (a + b for a, b in zip(one.footprint, other.footprint, strict=True))
    determinant = _determinant((xx, xy, yy))
    square = (yy * step[0] - 2.0 * xy * step[1] + xx * step[2]) * factor / determinant
    density = np.exp(-0.5 * np.clip(square, 0.0, _FARTHEST)) / np.sqrt(determinant)
    return np.asarray(one.mass * other.mass * density)


def _base(ellipse: Footprint, area: Real, blur: Real, model: Model) -> Real:
    """Area that opacity is meant for, (M,): without the low-pass for antialiased splats."""
    if model != "antialiased":
        return area
    (xx, xy, yy), (tiny, _) = ellipse, _least(area)
    return _area((np.maximum(xx - blur, tiny), xy, np.maximum(yy - blur, tiny)))


def _disc_as_drawn(sharp: Footprint, blur: Array) -> Footprint:
    """Ellipses that cover as much as discs with a low-pass (`disc_axes`), from those without it."""
    xx, xy, yy = sharp
    pixel = blur / LOW_PASS
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    root = np.hypot(half, xy)
    first = np.maximum(mean + root, _TINY)
    drawn = np.square(disc_axes(np.stack([first, _determinant(sharp) / first]) / pixel)) * pixel
    middle = 0.5 * (drawn[0] + drawn[1])
    stretch = 0.5 * (drawn[0] - drawn[1]) / np.maximum(root, _TINY)
    return middle + stretch * half, stretch * xy, middle - stretch * half


def merge(splats: Field, first: Index, second: Index, pairs: Pairs) -> Field:
    """Merged splats, (M,), with mean and covariance of the mixture of each pair of `price`.

    ``mu = w mu_i + w' mu_j``, ``C = w C_i + w' C_j + w w' d d'``, w + w' = 1, d = mu_j - mu_i
    (docs/method.md, section 7); discs are made flat (`flat_as_viewed`).
    """
    one, two = splats.take(first), splats.take(second)
    position, color = pairs.position[:, None], pairs.color[:, None]
    step = two.means - one.means
    direction = normalized(color * one.direction + (1.0 - color) * two.direction)
    lost = ~direction.any(axis=1)
    direction[lost] = one.direction[lost]
    deviation = _mean_deviation(one.deviation.T, two.deviation.T, pairs.color).T
    covariances = _mixture(one.covariances.T, two.covariances.T, step.T, pairs.position).T
    if one.model == "2dgs":
        covariances = flat_as_viewed(covariances, direction, deviation)
    return Field(
        one.means + (1.0 - position) * step,
        covariances * pairs.growth[:, None],
        pairs.opacity,
        one.contribution + two.contribution,
        pairs.error,
        direction,
        deviation,
        color * one.color + (1.0 - color) * two.color,
        pairs.color * one.blur + (1.0 - pairs.color) * two.blur,
        model=one.model,
    )


def as_splats(merged: Field, progress: Progress) -> tuple[Array, Array, Array]:
    """Stored log scales, of discs with `LOG_ZERO`, quaternions w x y z, and opacity logits."""
    count = len(merged.opacity)
    stored = np.empty((count, 3)), np.empty((count, 4)), np.empty(count)

    def fill(piece: slice) -> None:
        some = merged.take(np.arange(piece.start, piece.stop))
        logs, vectors = axes(some.covariances)
        opacity = some.opacity
        if merged.model == "2dgs":
            vectors = vectors[:, :, [1, 2, 0]]
            logs = np.stack([logs[:, 1], logs[:, 2], np.full(len(logs), LOG_ZERO)], axis=1)
            plane, none = across(some.direction), np.zeros(len(logs))
            before, after = (
                _area(_disc_as_drawn(footprint(each, plane, none), some.blur))
                for each in (some.covariances, flat(some.covariances))
            )
            opacity = np.minimum(opacity * before / after, ALPHA_MAX)
        stored[0][piece], stored[1][piece] = logs, quaternion(vectors)
        stored[2][piece] = np.log(opacity) - np.log1p(-opacity)

    run_all(fill, chunks(count, _CHUNK), progress=progress, what="merging")
    return stored


def axes(covariances: Array) -> tuple[Array, Array]:
    """Log scales, (M, 3), ascending, and axes in columns, (M, 3, 3), from covariances, (M, 6)."""
    full = _full(covariances)
    total = np.maximum(np.trace(full, axis1=1, axis2=2), _TINY)
    values, vectors = np.linalg.eigh(full / total[:, None, None])
    logs = 0.5 * (np.log(np.maximum(values, FLATTEST)) + np.log(total)[:, None])
    vectors[np.linalg.det(vectors) < 0.0] *= -1.0
    return logs, vectors


def _mixture(one: Real, two: Real, step: Real, share: Real) -> Array:
    """Covariances of mixtures, (6, M); `step` (3, M) is between the means, `share` the first's."""
    rows, columns = np.triu_indices(3)
    between = step[rows] * step[columns] * (share * (1.0 - share))  # (6, M)
    return np.asarray(share * one + (1.0 - share) * two + between, np.float64)


def flat_as_viewed(covariances: Array, direction: Array, deviation: Array) -> Array:
    """Covariances, (M, 6), of discs that look like given ones from where they are viewed (`Field`).

    The normal n has ``C n = l M n``, l least, M the mean of ``v v'`` over viewing directions v;
    what is left is ``C - l M n (M n)'``. For M = I that is `flat`.
    """
    beside = deviation - np.einsum("ij,ij->i", deviation, direction)[:, None] * direction
    size = np.maximum(np.sqrt(np.einsum("ij,ij->i", beside, beside)), ASIDE)
    lengths, units = (np.ones(len(size)), size), (direction, normalized(beside))
    scaled, back = (
        sum(
            ((length**power - ASIDE**power)[:, None] * unit)[:, :, None] * unit[:, None, :]
            for length, unit in zip(lengths, units, strict=True)
        )
        + ASIDE**power * np.eye(3)
        for power in (-1, 1)
    )
    return packed(back @ _full(flat(packed(scaled @ _full(covariances) @ scaled))) @ back)


def _full(covariances: Array) -> Array:
    full: Array = covariances[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    return full


def flat(covariances: Array) -> Array:
    """Covariances, (M, 6), without their shortest axis."""
    # Of what is not finite LAPACK gives an error; such pairs have no mass, and are not merged.
    values, vectors = np.linalg.eigh(np.nan_to_num(_full(covariances)))
    sides = vectors[:, :, 1:] * np.sqrt(np.maximum(values[:, None, 1:], 0.0))
    return packed(sides @ np.swapaxes(sides, 1, 2))


def _dot(one: Real, other: Real) -> Real:
    """Inner products (M,) of (3, M), written out: rounding must not depend on the memory layout."""
    return np.asarray(one[0] * other[0] + one[1] * other[1] + one[2] * other[2])


def _unit(vectors: Real) -> Real:
    length = np.sqrt(_dot(vectors, vectors))
    length[length == 0.0] = 1.0
    return np.asarray(vectors / length)


def _shares(one: Real, two: Real) -> tuple[Real, Real]:
    total = one + two
    return one / total, two / total


def _squared_contrast(error: Real, whole: Real) -> Real:
    """Squared contrast of a measured error, at most 3; `whole` is the error for |s| = 1."""
    return np.asarray(np.minimum(error, 3 * whole) / np.maximum(whole, _least(whole)[0]))


def _mean_deviation(one: Real, two: Real, share: Real) -> Real:
    """Mean of deviations, (3, M), with their arbitrary signs made alike."""
    rest = 1.0 - share
    np.negative(rest, where=_dot(one, two) < 0.0, out=rest)
    return np.asarray(share * one + rest * two)


def _least(values: Real) -> tuple[float, float]:
    """Least divisor, and least determinant over xx yy: see `_LEAST`."""
    return _LEAST[values.dtype.itemsize]


def _determinant(footprint: Footprint) -> Real:
    """Determinant, (M,), kept above 0 where rounding would leave 0 or less."""
    xx, xy, yy = footprint
    tiny, thinnest = _least(xx)
    squared = xx * yy
    return np.asarray(np.maximum(squared - xy * xy, thinnest * squared + tiny))


def _area(footprint: Footprint) -> Real:
    """Area of the ellipse of one standard deviation over pi, (M,)."""
    return np.asarray(np.sqrt(_determinant(footprint)))
