"""How the colours of rays change with the parameters of the splats that they hit.

docs/method.md, section 12, derives it. Per hit, ``dC / dc = T a`` and ``dC / da = T (c - B)``; the
geometry, a vector m and a symmetric matrix S in the scene's frame, changes ``log a`` by
``g' m + g' S g``, ``g = W' J' e``, ``e = A d``. Changes of J, of the view direction with the mean
and of the antialiasing factor with the scales are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..spherical_harmonics import basis
from ..splats import ALPHA_CUT, ALPHA_MAX, DISC_LOW_PASS, SH_C0, Splats, rotation_matrices
from ..views import View
from ..visibility import projection
from ..visibility.cast import BEHIND
from ..visibility.projection import Footprints, Gaussians
from ..visibility.rays import LEAST_LEFT, Rays
from ..visibility.scene import Scene

Singles = NDArray[np.float32]

COLOR, DEGREE_1, OPACITY, MEAN, SCALE, TURN = (
    slice(0, 3), slice(3, 12), slice(12, 13), slice(13, 16), slice(16, 19), slice(19, 22)
)  # fmt: skip
"""Rows of a splat's 22 parameters: constant and first degree (3 coefficients of 3 channels each) of
the harmonics, opacity logit; by its own axes mean, log scales and turn."""

COUNT = 22
PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # of a symmetric matrix

LEAST_WEIGHT = ALPHA_CUT
"""Hits of less weight T a are left out: a quarter less work than 1e-3, equal results to 0.01 dB."""

EVENLY = 0.2
"""Least chance of a ray to be learned from: others weigh little, as half of the squared error lies
in a hundredth of the pixels (drawn by error as by arXiv 2504.12905)."""

HUBER = 1.0  # root mean squares of a view above which errors count linearly, see `_trust`
BAND = 1 << 18  # hits
_LEAST_ERROR = 1e-10  # squared; keeps a division finite


@dataclass(frozen=True, eq=False)
class Shapes:
    """M Gaussians with what derivatives need of them."""

    gaussians: Gaussians
    scene: Scene
    axes: Singles  # (3, 3, M): components in the scene's frame of each of the splat's axes
    scales: Singles  # (3, M): standard deviations along these, scene sizes

    @classmethod
    def of(cls, splats: Splats, gaussians: Gaussians, scene: Scene) -> Shapes:
        """Shapes of Gaussians that were made of `splats`, in the scene's frame."""
        chosen = splats.take(gaussians.index)
        axes = np.einsum("ij,njk->kin", scene.axes, rotation_matrices(chosen.quaternions))
        logs = chosen.log_scales.astype(np.float64).T - np.log(scene.size)
        scales = np.exp(logs.clip(*projection.LOG_SCALE_RANGE))
        axes = np.ascontiguousarray(axes, np.float32)
        return cls(gaussians, scene, axes, scales.astype(np.float32))

    def __len__(self) -> int:
        return len(self.gaussians)

    def take(self, hit: NDArray[np.integer[Any]]) -> Shapes:
        """Shapes of the Gaussians at `hit`."""
        axes, scales = self.axes.take(hit, axis=2), self.scales.take(hit, axis=1)
        return Shapes(self.gaussians.take(hit), self.scene, axes, scales)

    def in_scene(self, change: Singles) -> Singles:
        """Changed parameters, (22, M), as colour, degree 1, log opacity, m, S (`PAIRS`)."""
        result = np.zeros((COUNT, len(self)), np.float32)
        result[COLOR] = np.float32(SH_C0) * change[COLOR]
        if change[DEGREE_1].any():  # else no memory is touched
            result[DEGREE_1] = change[DEGREE_1]
        result[OPACITY] = (np.float32(1.0) - self.gaussians.alphas) * change[OPACITY]
        moved = self.scales.max(axis=0) * change[MEAN]
        np.einsum("kin,kn->in", self.axes, moved, out=result[MEAN])
        for parameter, strength, one, other in self._quadratic():
            by = strength * change[parameter]
            for row, (i, k) in enumerate(PAIRS, SCALE.start):
                result[row] += by * (one[i] * other[k] + one[k] * other[i])
        return result

    def by_parameter(self, sums: Singles) -> Singles:
        """Apply the transpose of `in_scene` to sums of `LinearView.backward`, (22, M), in place."""
        sums[COLOR] *= np.float32(SH_C0)
        sums[OPACITY] *= np.float32(1.0) - self.gaussians.alphas
        sums[MEAN] = np.einsum("kin,in->kn", self.axes, sums[MEAN]) * self.scales.max(axis=0)
        result = np.zeros((COUNT - SCALE.start, len(self)), np.float32)
        for parameter, strength, one, other in self._quadratic():
            row = result[parameter - SCALE.start]
            for of_pair, (i, k) in zip(sums[SCALE.start :], PAIRS, strict=True):
                row += of_pair * (one[i] * other[k] + one[k] * other[i])
            row *= strength
        sums[SCALE.start :] = result
        return sums

    def _quadratic(self) -> Iterator[tuple[int, Any, Any, Any]]:
        """Yield row, half factor (M,) and two axes (3, M) of S for each scale and turn."""
        squared, half = np.square(self.scales), np.float32(0.5)
        for axis in range(3):
            after, last = (axis + 1) % 3, (axis + 2) % 3
            yield SCALE.start + axis, half * squared[axis], self.axes[axis], self.axes[axis]
            turned = half * (squared[after] - squared[last])
            yield TURN.start + axis, turned, self.axes[after], self.axes[last]


@dataclass(frozen=True, eq=False)
class LinearView:
    """The colours of P rays of one view, linear in the changes of the u splats that they hit."""

    hit: NDArray[np.int64]  # (u,): Gaussians that are hit, ascending
    errors: Singles  # (3, P): colours of the unpruned splats less those seen now, see `_trust`
    hitting: NDArray[np.int64]  # (p,): rays with hits
    counts: NDArray[np.int64]  # (p,): hits of each
    owner: NDArray[Any]  # (h,), ray by ray: the splat's place in `hit`; uint16 or int32
    weight: NDArray[np.uint16]  # (h,): T a, see `_halves`
    by_log_alpha: NDArray[np.uint16]  # (3, h): T a (c - B); 0 where alpha is clipped
    steepness: NDArray[np.uint16]  # (2, h): A d, 1/px; of discs a third row, 0 on the low-pass
    unclipped: NDArray[np.bool_]  # (3, u): where the colour changes with the harmonics
    jacobian: Singles  # (2, 3, u): rows of J W, pixels a scene size
    basis: Singles  # (3, u): harmonics of the first degree in the view direction

    def forward(self, change: Singles, hits: tuple[Any, ...] | None = None) -> Singles:
        """First-order change of the colours, (3, P), by changes (22, M) of `Shapes.in_scene`."""
        owner, weight, by_log_alpha, (across, down, *on_plane) = hits or self.hits()
        mine = [row.take(self.hit) for row in change]
        log_alpha = mine[OPACITY.start].take(owner)
        x, y, xx, xy, yy = (each.take(owner) for each in self._polynomials(mine))
        for where in on_plane:
            xx, xy, yy = xx * where, xy * where, yy * where
        xx *= across
        x += xx
        xy *= down
        x += xy
        x *= across
        log_alpha += x
        yy *= down
        y += yy
        y *= down
        log_alpha += y
        result = np.zeros_like(self.errors)
        if not len(self.counts):
            return result
        first = np.cumsum(self.counts) - self.counts
        for channel, (row, unclipped, seen, slope) in enumerate(
            zip(result, self.unclipped, mine[COLOR], by_log_alpha, strict=True)
        ):
            turning = _dot([*self.basis], mine[_of_channel(channel)])
            light = ((seen + turning) * unclipped).take(owner)
            light *= weight
            light += slope * log_alpha
            row[self.hitting] = np.add.reduceat(light, first)
        return result

    def backward(self, errors: Singles, hits: tuple[Any, ...] | None = None) -> Singles:
        """The transpose of `forward`, applied to errors of the colours, (3, P): sums, (22, u)."""
        owner, weight, by_log_alpha, (across, down, *on_plane) = hits or self.hits()
        result = np.zeros((COUNT, len(self.hit)), np.float32)
        value = np.zeros(len(owner), np.float32)
        for channel, slope in enumerate(by_log_alpha):
            error = np.repeat(errors[channel].take(self.hitting), self.counts)
            value += slope * error
            error *= weight
            result[channel] = self._sum(error, owner)
        result[COLOR] *= self.unclipped
        for channel, total in enumerate(result[COLOR]):
            result[_of_channel(channel)] = self.basis * total
        result[OPACITY] = self._sum(value, owner)
        x, y = value * across, value * down
        moments = [x, y]
        for where in on_plane:
            x, y = x * where, y * where
        moments += [x * across, x * down, y * down]
        sums = [self._sum(each, owner) for each in moments]
        one, other = self.jacobian
        result[MEAN] = one * sums[0] + other * sums[1]
        for row, (i, k) in enumerate(PAIRS, SCALE.start):
            result[row] = (
                one[i] * one[k] * sums[2]
                + (one[i] * other[k] + one[k] * other[i]) * sums[3]
                + other[i] * other[k] * sums[4]
            )
            if i != k:
                result[row] *= np.float32(2.0)
        return result

    def normal(self, change: Singles) -> Singles:
        """`backward` of `forward`."""
        hits = self.hits()
        return self.backward(self.forward(change, hits), hits)

    def bands(self) -> Iterator[LinearView]:
        """Yield parts of about `BAND` hits, which take less memory and hit splats that are near."""
        ends, every = np.cumsum(self.counts), len(self.owner)
        cuts = np.unique(np.searchsorted(ends, [*range(0, every, BAND), every], side="right"))
        for start, end in pairwise(cuts.tolist()):
            rays, hits = slice(start, end), slice(ends[start] - self.counts[start], ends[end - 1])
            used = np.zeros(len(self.hit), np.bool_)
            used[self.owner[hits]] = True
            place = np.cumsum(used) - 1
            owner = place.take(self.owner[hits]).astype(np.min_scalar_type(place[-1]))
            first, last = self.hitting[start], self.hitting[end - 1]
            yield LinearView(
                self.hit[used], self.errors[:, first : last + 1], self.hitting[rays] - first,
                self.counts[rays], owner, self.weight[hits], self.by_log_alpha[:, hits],
                self.steepness[:, hits], self.unclipped[:, used], self.jacobian[:, :, used],
                self.basis[:, used],
            )  # fmt: skip

    def hits(self) -> tuple[Any, ...]:
        """Owner, weight, derivatives and steepness of the hits as numbers, (h,) each."""
        halves = ([_floats(row) for row in rows] for rows in (self.by_log_alpha, self.steepness))
        return self.owner.astype(np.intp), _floats(self.weight), *halves

    def _polynomials(self, change: list[Singles]) -> list[Singles]:
        """Coefficients of x, y, x^2, x y, y^2 of changed geometry, (u,) each."""
        xx, xy, xz, yy, yz, zz = change[SCALE.start :]
        one, other = self.jacobian
        rows = (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)
        turned = [[_dot(each, row) for row in rows] for each in (one, other)]  # S W' J'
        return [
            _dot(one, change[MEAN]), _dot(other, change[MEAN]),
            _dot(one, turned[0]), np.float32(2.0) * _dot(other, turned[0]), _dot(other, turned[1]),
        ]  # fmt: skip

    def diagonal(self, shapes: Shapes) -> Singles:
        """Squared derivatives by each parameter, summed over rays, (22, u).

        Those by the first degree of the harmonics are means, which do not depend on the axes.
        """
        owner, weight, by_log_alpha, (x, y, *on_plane) = self.hits()
        result = np.zeros((COUNT, len(self.hit)), np.float32)
        result[COLOR] = np.float32(SH_C0**2) * self._sum(np.square(weight), owner, np.float64)
        result[COLOR] *= self.unclipped
        if self.basis.any():
            # Squared harmonics of a degree are on average those of the constant (Unsoeld 1927).
            for channel, squared in enumerate(result[COLOR]):
                result[_of_channel(channel)] = squared
        value = np.square(by_log_alpha[0])
        for slope in by_log_alpha[1:]:
            value += np.square(slope)
        result[OPACITY] = self._sum(value, owner)
        result[OPACITY] *= np.square(np.float32(1.0) - shapes.gaussians.alphas)
        products = (x, x), (x, y), (y, y)
        second = [value * one * other for one, other in products]
        of_second = [self._sum(each, owner) for each in second]
        for where in on_plane:
            second = [each * where for each in second]
        # One at a time: all these arrays together would be a view's peak of memory.
        of_fourth = [
            self._sum(second[k] * (one * other), owner)
            for k, (one, other) in [*((0, each) for each in products), (1, (y, y)), (2, (y, y))]
        ]
        in_image = [[_dot(row, axis) for axis in shapes.axes] for row in self.jacobian]
        longest, squared = np.square(shapes.scales.max(axis=0)), np.square(shapes.scales)
        for axis in range(3):
            after, last = (axis + 1) % 3, (axis + 2) % 3
            (a, c, e), (b, d, f) = ([row[k] for k in (axis, after, last)] for row in in_image)
            linear = a * a * of_second[0] + 2.0 * a * b * of_second[1] + b * b * of_second[2]
            result[MEAN.start + axis] = np.maximum(longest * linear, 0.0)
            scaled = squared[axis] * np.stack([a * a, 2.0 * a * b, b * b])
            result[SCALE.start + axis] = _squared(scaled, of_fourth)
            turned = (squared[after] - squared[last]) * np.stack([c * e, c * f + d * e, d * f])
            result[TURN.start + axis] = _squared(turned, of_fourth)
        return result

    def _sum(self, values, owner, kind=np.float32):
        return np.bincount(owner, values, len(self.hit)).astype(kind, copy=False)


def _of_channel(channel: int) -> slice:
    """Rows of the first-degree harmonics of a channel."""
    return slice(DEGREE_1.start + channel, DEGREE_1.stop, 3)


def _basis(shapes: Shapes, view: View) -> Singles:
    """First-degree harmonics in the view direction, (3, u)."""
    scene = shapes.scene
    from_view = shapes.gaussians.means.astype(np.float64)
    from_view -= scene.positions(view.center[None])[0][:, None]
    from_view /= np.maximum(np.sqrt(np.square(from_view).sum(axis=0)), np.finfo(np.float32).tiny)
    in_world = np.einsum("in,ij->nj", from_view, scene.axes)
    return np.ascontiguousarray(basis(in_world, 1)[:, 1:].T, np.float32)


def _dot(one: Sequence[NDArray[Any]], other: Sequence[NDArray[Any]]) -> NDArray[Any]:
    return np.asarray(one[0] * other[0] + one[1] * other[1] + one[2] * other[2])


def _squared(polynomial: Singles, sums: Sequence[Singles]) -> Singles:
    a, b, c = polynomial
    result = a * a * sums[0] + (b * b + 2.0 * a * c) * sums[2] + c * c * sums[4]
    result += 2.0 * b * (a * sums[1] + c * sums[3])
    return np.asarray(np.maximum(result, np.float32(0.0)))


def linear_view(
    visible: list[Any],
    footprints: Footprints,
    truth: Singles,
    colors: Singles,
    shapes: Shapes,
    view: View,
) -> tuple[LinearView, Shapes]:
    """The colours of a view's rays, linear in the splats that they hit, and these splats' shapes.

    `visible`, which is emptied, holds at most 2^16 rays and the transmittance in front of each hit;
    `truth` are their colours with the unpruned splats, `colors`, (3, u), those of the splats hit.
    The splats of `shapes`, which can change, are the first of all that can be hit.
    """
    rays, transmittance = visible
    visible.clear()  # all its hits take more memory than those that are drawn
    errors = truth - rays.composited(transmittance * rays.alpha, colors)
    trust = _trust(errors)
    drawn = np.flatnonzero(trust.take(rays.ray))
    every, rays, transmittance = rays.hit, rays.of_hits(drawn), transmittance.take(drawn)
    colors = colors.take(np.searchsorted(every, rays.hit), axis=1)
    movable = int(np.searchsorted(rays.hit, len(shapes)))  # of those that are hit
    weight, counts = transmittance * rays.alpha, rays.counts()
    kept = np.flatnonzero((weight > LEAST_WEIGHT) & (rays.owner < movable))
    owner, ray = rays.owner.take(kept), rays.ray.take(kept)
    left = np.maximum((transmittance - weight)[kept], np.float32(LEAST_LEFT))
    last = np.repeat(np.cumsum(counts), counts)[kept]  # behind the last hit of the same ray
    alpha, of_hits = rays.alpha[kept], trust.take(ray)
    changing = np.where(alpha < ALPHA_MAX, alpha, np.float32(0.0)) * transmittance[kept] * of_hits
    by_log_alpha = np.empty((3, len(kept)), np.float32)
    for channel, of_splats in enumerate(colors):
        sums = np.zeros(len(weight) + 1)  # running sums of what hits add to the colours of rays
        np.cumsum(weight * of_splats.take(rays.owner), dtype=np.float64, out=sums[1:])
        background = (sums.take(last) - sums.take(kept + 1)).astype(np.float32) / left
        by_log_alpha[channel] = changing * (of_splats.take(owner) - background)
    hit, shapes = rays.hit[:movable], shapes.take(rays.hit[:movable])
    first = np.flatnonzero(np.diff(ray, prepend=-1))
    steepness = _steepness(replace(rays, hit=hit), kept, footprints)
    rows = np.stack(projection.jacobian(shapes.gaussians, shapes.scene, view))
    jacobian = np.ascontiguousarray(rows.transpose(0, 2, 1), np.float32)
    linear = LinearView(
        hit, trust * errors, ray.take(first).astype(np.int64), np.diff(first, append=len(ray)),
        owner.astype(np.uint16 if movable < 1 << 16 else np.int32),
        _halves(of_hits * weight[kept]), _halves(by_log_alpha), _halves(steepness),
        ((colors > 0.0) & (colors < projection.BRIGHTEST))[:, :movable], jacobian,
        _basis(shapes, view),
    )  # fmt: skip
    return linear, shapes


def _trust(errors: Singles) -> Singles:
    """Roots of the weights of rays, (P,), from errors (3, P): Huber's loss, reweighted once.

    Rays of small error are drawn by it, and weigh the more the less likely that was, or nothing.
    """
    squared = np.mean(np.square(errors), axis=0, dtype=np.float64)
    size = np.sqrt(squared + _LEAST_ERROR)
    most = HUBER * np.sqrt(squared.mean() + _LEAST_ERROR)
    chance = np.minimum(EVENLY + (1.0 - EVENLY) * size / size.mean(), 1.0)
    drawn = np.diff(np.floor(np.cumsum(chance)), prepend=0.0) > 0.0
    weight = np.divide(most, np.maximum(size, most) * chance, out=np.zeros_like(size), where=drawn)
    return np.sqrt(weight).astype(np.float32)


def _halves(values: Singles) -> NDArray[np.uint16]:
    """Upper halves of the bits, rounded: good to 1 / 256."""
    return ((values.view(np.uint32) + np.uint32(1 << 15)) >> np.uint32(16)).astype(np.uint16)


def _floats(halves: NDArray[np.uint16]) -> Singles:
    return (halves.astype(np.uint32) << np.uint32(16)).view(np.float32)


def _steepness_on_discs(discs: Singles, step: list[Singles]) -> Singles:
    """`_steepness` (7, h) of hits on discs, with d in the disc's plane: ``d / (1 + g d)``."""
    across, down = step
    depth = 1.0 + discs[4] * across + discs[5] * down
    ahead = depth > BEHIND
    first, second = (
        (discs[k] * across + discs[k + 1] * down) / np.where(ahead, depth, 1.0) for k in (0, 2)
    )
    low_pass = np.float32(1.0 / DISC_LOW_PASS)
    blob = (across * across + down * down) * low_pass
    plane = ahead & (first * first + second * second <= blob)
    result = np.empty((3, len(across)), np.float32)
    result[2] = plane
    for k, of_blob in enumerate((across, down)):
        result[k] = np.where(plane, discs[k] * first + discs[2 + k] * second, low_pass * of_blob)
    return result


def _steepness(rays: Rays, kept: NDArray[np.int64], footprints: Footprints) -> Singles:
    """`LinearView.steepness` of some hits, (2, h) or (3, h), as numbers."""
    place = np.empty(int(footprints.index.max(initial=-1)) + 1, np.intp)
    place[footprints.index] = np.arange(len(footprints.index))
    mine = footprints.take(place[rays.hit])
    owner, ray = rays.owner.take(kept).astype(np.intp), rays.ray.take(kept)
    columns, rows = (
        each.astype(np.float32) + np.float32(0.5) for each in (rays.columns, rays.rows)
    )
    pixels = np.tile(columns, len(rows)), np.repeat(rows, len(columns))  # of all rays
    step = [
        at.take(ray) - center.take(owner) for at, center in zip(pixels, mine.centers, strict=True)
    ]
    if mine.discs is not None:
        return _steepness_on_discs(mine.discs.take(owner, axis=1), step)
    result = np.zeros((2, len(owner)), np.float32)
    for axes, sigma in zip((mine.major, mine.minor), mine.sigmas, strict=True):
        inverse = (1.0 / np.square(np.square(sigma.astype(np.float64)))).astype(np.float32)
        along = step[0] * axes[0].take(owner) + step[1] * axes[1].take(owner)
        along *= inverse.take(owner)
        result[0] += along * axes[0].take(owner)
        result[1] += along * axes[1].take(owner)
    return result
