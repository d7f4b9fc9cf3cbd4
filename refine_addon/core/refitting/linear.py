"""How the colours of rays change with the parameters of the splats that they hit.

For a hit with transmittance T in front of it, alpha a, colour c and the colour B that arrives from
behind it, the colour C of its ray changes by::

    dC / dc = T a,    dC / da = T (c - B)

Alpha is ``o exp(-d' A d / 2)`` at the distance d, in pixels, from the footprint's centre, with
``A = (J W S W' J' + .3 I)^-1`` (`seeing.projection`). With ``g = W' J' A d``, and h_j its component
along the splat's axis j, whose scale is s_j and the longest of which is s::

    da / d logit(o)      = a (1 - o)
    da / d mean_j        = a s h_j                      the mean along axis j, in units of s
    da / d log s_j       = a (s_j h_j)^2
    da / d turn_1        = a (s_2^2 - s_3^2) h_2 h_3    a small turn about axis 1; others in turn

That J changes with the mean, the colour with the direction of view, and what antialiasing keeps of
the opacity with the scales, is left out. Of discs, d is scaled to their plane first. Parameters are
those of the splat's own axes, so results turn and grow with the scene.

With ``e = A d``, h_j is ``r_j e``, r_j the splat's axis in the image, in pixels. So the ten
derivatives of alpha are alpha times polynomials of degree 2 in the two numbers of e: a hit keeps
alpha and e, a splat the coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..rendering import ALPHA_CUT, ALPHA_MAX, DISC_LOW_PASS
from ..seeing import projection
from ..seeing.cast import BEHIND
from ..seeing.ray_sums import in_front
from ..seeing.rays import LEAST_LEFT, LOG_OPAQUE
from ..splats import SH_C0, rotation_matrices

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..seeing.projection import Footprints, Gaussians
    from ..seeing.rays import Rays
    from ..seeing.scene import Scene
    from ..splats import Splats
    from ..views import View

COLOR, OPACITY, MEAN, SCALE, TURN = (
    slice(0, 3), slice(3, 4), slice(4, 7), slice(7, 10), slice(10, 13)
)  # fmt: skip
"""Rows of the 13 parameters of a splat: the constant of the harmonics, the logit of the opacity,
the mean, the logarithms of the scales and a turn, the last three by its own axes."""

COUNT = 13

LEAST_WEIGHT = ALPHA_CUT
"""Hits that make up less of their pixel are left out: a quarter less to do than with 1e-3, and the
same results to .01 dB."""


@dataclass(frozen=True, eq=False)
class Shapes:
    """M Gaussians with what derivatives need of them.

    Attributes
    ----------
    gaussians : Gaussians
    scene : Scene
    axes : (M, 3, 3) float64
        Columns are the splat's axes in the scene's frame.
    scales : (M, 3) float64
        Standard deviations along these, scene sizes.
    geometry : bool
        Whether it is of interest how colours change with means, scales and turns.
    """

    gaussians: Gaussians
    scene: Scene
    axes: NDArray[np.float64]
    scales: NDArray[np.float64]
    geometry: bool

    @classmethod
    def of(
        cls, splats: Splats, gaussians: Gaussians, scene: Scene, *, geometry: bool = True
    ) -> Shapes:
        """Return the shapes of the splats that some Gaussians were made of."""
        chosen = splats.take(gaussians.index)
        axes = np.einsum("ij,njk->nik", scene.axes, rotation_matrices(chosen.quaternions))
        logs = chosen.log_scales.astype(np.float64) - np.log(scene.size)
        scales = np.exp(logs.clip(*projection.LOG_SCALE_RANGE))
        return cls(gaussians, scene, axes, scales, geometry)


@dataclass(frozen=True, eq=False)
class LinearView:
    """The colours of the P rays of one view as a linear function of what its u splats change.

    Attributes
    ----------
    rows : (u,) int64
        Rows of the splats that are hit, among all that are refitted.
    errors : (3, P) float32
        The colours that the rays should see, less those that they see now.
    ray : (h,) uint16
    owner : (h,) int32
        Of each hit: its ray, and the splat as a place in `rows`.
    weight : (h,) uint16
        T a, see `_halves`.
    by_log_alpha : (3, h) uint16
        How the colour changes with the logarithm of alpha, ``T a (c - B)``; 0 where alpha is
        clipped, and does not change.
    steepness : (2, h) or (3, h) uint16, optional
        ``A d`` across and down, 1/px; none if geometry does not change. Of discs also whether the
        disc is hit, 1, or its low-pass, 0, which no scale and no turn changes.
    slopes : Slopes
        Of the splats that are hit.
    """

    rows: NDArray[np.int64]
    errors: NDArray[np.float32]
    ray: NDArray[np.uint16]
    owner: NDArray[np.int32]
    weight: NDArray[np.uint16]
    by_log_alpha: NDArray[np.uint16]
    steepness: NDArray[np.uint16] | None
    slopes: Slopes

    def forward(self, change: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return by how much the colours change, (3, P), to first order.

        Parameters
        ----------
        change : (13, N) float32
            Of the parameters of all splats.
        """
        mine = change.take(self.rows, axis=1)
        ray, owner = self.ray.astype(np.intp), self.owner.astype(np.intp)
        log_alpha = (self.slopes.opacity * mine[OPACITY][0]).take(owner)
        if self.steepness is not None:
            x, y, *squares = (each.take(owner) for each in self.slopes.polynomials(mine))
            across, down, *on_plane = map(_floats, self.steepness)
            xx, xy, yy = (each * on_plane[0] for each in squares) if on_plane else squares
            log_alpha += across * (x + across * xx + down * xy)
            log_alpha += down * (y + down * yy)
        result, weight = np.empty_like(self.errors), _floats(self.weight)
        for channel in range(3):
            light = (self.slopes.light[channel] * mine[channel]).take(owner)
            light *= weight
            light += _floats(self.by_log_alpha[channel]) * log_alpha
            result[channel] = np.bincount(ray, light, self.errors.shape[1])
        return result

    def backward(self, errors: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the transpose of `forward` times some errors of the colours, (13, u).

        Parameters
        ----------
        errors : (3, P) float32
        """
        result = np.zeros((COUNT, len(self.rows)))
        ray, owner = self.ray.astype(np.intp), self.owner.astype(np.intp)
        value, weight = np.zeros(len(owner), np.float32), _floats(self.weight)
        for channel in range(3):
            error = errors[channel].take(ray)
            value += _floats(self.by_log_alpha[channel]) * error
            error *= weight
            result[channel] = self.slopes.light[channel] * self._sum(error, owner)
        result[OPACITY] = self.slopes.opacity * self._sum(value, owner)
        if self.steepness is not None:
            across, down, *on_plane = map(_floats, self.steepness)
            x, y = value * across, value * down
            moments = [x, y]
            if on_plane:
                x, y = x * on_plane[0], y * on_plane[0]
            moments += [x * across, x * down, y * down]
            sums = np.stack([self._sum(each, owner).astype(np.float32) for each in moments])
            result[MEAN.start :] = self.slopes.gradients(sums)
        return result

    def diagonal(self) -> NDArray[np.float64]:
        """Return the squared length of each column, that is of each parameter, (13, u)."""
        result = np.zeros((COUNT, len(self.rows)))
        owner = self.owner.astype(np.intp)
        result[COLOR] = np.square(self.slopes.light) * self._sum(
            np.square(_floats(self.weight)), owner
        )
        value = np.square(_floats(self.by_log_alpha)).sum(axis=0)
        result[OPACITY.start] = np.square(self.slopes.opacity) * self._sum(value, owner)
        if self.steepness is None:
            return result
        x, y, *on_plane = map(_floats, self.steepness)
        squares = (x * x, x * y, y * y)
        second = [value * each for each in squares]
        curved = [each * on_plane[0] for each in second] if on_plane else second
        fourth = [each * squares[0] for each in curved[:2]] + [each * squares[2] for each in curved]
        sums = [self._sum(each, owner) for each in (*second, *fourth)]
        result[MEAN] = self.slopes.squared_linear(sums[:3])
        result[SCALE.start :] = self.slopes.squared_quadratic(sums[3:])
        return result

    def _sum(self, values: NDArray[np.float32], owner: NDArray[np.intp]) -> NDArray[np.float64]:
        """Return the sum of values of hits over the hits of each splat, (u,)."""
        return np.asarray(np.bincount(owner, values, len(self.rows)), np.float64)


@dataclass(frozen=True, eq=False)
class Slopes:
    """How alpha of the hits of u splats changes with their parameters, as polynomials of ``A d``.

    Attributes
    ----------
    light : (3, u) float32
        How the colour changes with the constant of the harmonics; 0 where it is clipped.
    opacity : (u,) float32
        ``1 - o``.
    linear : (3, 2, u) float32
        Of the mean along each axis: coefficients of x and y.
    quadratic : (6, 3, u) float32
        Of scales and turns: coefficients of x^2, x y and y^2.
    """

    light: NDArray[np.float32]
    opacity: NDArray[np.float32]
    linear: NDArray[np.float32]
    quadratic: NDArray[np.float32]

    def polynomials(self, change: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        """Return the coefficients of x, y, x^2, x y, y^2 of changed geometry, (u,) each.

        Parameters
        ----------
        change : (13, u) float32
        """
        return [
            *np.einsum("kiu,ku->iu", self.linear, change[MEAN]),
            *np.einsum("kiu,ku->iu", self.quadratic, change[SCALE.start :]),
        ]

    def gradients(self, moments: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the transpose of `polynomials`: nine parameters, (9, u), of five sums, (5, u)."""
        return np.concatenate(
            [
                np.einsum("kiu,iu->ku", self.linear, moments[:2]),
                np.einsum("kiu,iu->ku", self.quadratic, moments[2:]),
            ]
        )

    def squared_linear(self, sums: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return the sums over hits of squared polynomials of the mean, (3, u).

        Parameters
        ----------
        sums : list of (u,) float64
            Of x^2, x y and y^2 over the hits of each splat.
        """
        a, b = np.moveaxis(self.linear.astype(np.float64), 1, 0)  # (3, u) each
        result = a * a * sums[0] + 2.0 * a * b * sums[1] + b * b * sums[2]
        return np.asarray(np.maximum(result, 0.0), np.float64)

    def squared_quadratic(self, sums: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Return the sums over hits of squared polynomials of scales and turns, (6, u).

        Parameters
        ----------
        sums : list of (u,) float64
            Of x^4, x^3 y, x^2 y^2, x y^3 and y^4 over the hits of each splat.
        """
        a, b, c = np.moveaxis(self.quadratic.astype(np.float64), 1, 0)  # (6, u) each
        weights = (a * a, 2.0 * a * b, b * b + 2.0 * a * c, 2.0 * b * c, c * c)
        result = np.zeros(a.shape)
        for weight, of_power in zip(weights, sums, strict=True):
            result += weight * of_power
        return np.maximum(result, 0.0)


def linear_view(
    rays: Rays,
    footprints: Footprints,
    truth: NDArray[np.float32],
    colors: NDArray[np.float64],
    shapes: Shapes,
    view: View,
) -> LinearView:
    """Return how the colours of the rays of a view change with the splats that they hit.

    Parameters
    ----------
    rays : Rays
        At most 2^16 of them.
    footprints : Footprints
        In the view.
    truth : (3, P) float32
        The colours that the rays should see.
    colors : (3, u) float64
        Of the splats that are hit.
    shapes : Shapes
        Of the first Gaussians; what else is hit does not change.
    view : View
    """
    movable = int(np.searchsorted(rays.hit, len(shapes.gaussians)))  # of those that are hit
    counts = rays.counts()
    log_front = in_front(rays.log_passed.astype(np.float64), counts)
    transmittance = np.exp(np.where(log_front > LOG_OPAQUE, log_front, -np.inf)).astype(np.float32)
    weight = transmittance * rays.alpha
    kept = np.flatnonzero((weight > LEAST_WEIGHT) & (rays.owner < movable))
    owner = rays.owner.take(kept)
    left = np.maximum((transmittance - weight)[kept], np.float32(LEAST_LEFT))
    ends = np.cumsum(counts)
    last = np.repeat(ends, counts)[kept]  # behind the last hit of the same ray
    hitting = rays.ray.take(ends - 1)
    alpha = rays.alpha[kept]
    changing = np.where(alpha < ALPHA_MAX, alpha, np.float32(0.0)) * transmittance[kept]
    seen, by_log_alpha = np.zeros((3, rays.count)), np.empty((3, len(kept)), np.float32)
    for channel, of_splats in enumerate(colors.astype(np.float32)):
        sums = np.zeros(len(weight) + 1)  # of what all hits in front have of the colours of rays
        np.cumsum(weight * of_splats.take(rays.owner), dtype=np.float64, out=sums[1:])
        seen[channel, hitting] = sums.take(ends) - sums.take(ends - counts)
        background = (sums.take(last) - sums.take(kept + 1)).astype(np.float32) / left
        by_log_alpha[channel] = changing * (of_splats.take(owner) - background)
    unclipped = (colors > 0.0) & (colors < projection.BRIGHTEST)
    hit = rays.hit[:movable]
    return LinearView(
        shapes.gaussians.index[hit], (truth - seen.clip(0.0, 1.0)).astype(np.float32),
        rays.ray.take(kept).astype(np.uint16), owner, _halves(weight[kept]), _halves(by_log_alpha),
        _halves(_steepness(replace(rays, hit=hit), kept, footprints)) if shapes.geometry else None,
        _slopes(hit, unclipped[:, :movable], shapes, view),
    )  # fmt: skip


def _halves(values: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Return the upper halves of the bits of some numbers, rounded: they keep them to 1 / 256."""
    return ((values.view(np.uint32) + np.uint32(1 << 15)) >> np.uint32(16)).astype(np.uint16)


def _floats(halves: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Return the numbers of `_halves`."""
    return (halves.astype(np.uint32) << np.uint32(16)).view(np.float32)


def _slopes(
    hit: NDArray[np.int64], unclipped: NDArray[np.bool_], shapes: Shapes, view: View
) -> Slopes:
    """Return how alpha changes with the parameters of the Gaussians hit; see the top of this file.

    `unclipped`, (3, u), is where their colours are not clipped.
    """
    gaussians, scales = shapes.gaussians.take(hit), shapes.scales[hit]  # (u, 3)
    light, opacity = unclipped * np.float32(SH_C0), np.float32(1.0) - gaussians.alphas
    if not shapes.geometry:
        return Slopes(
            light, opacity, np.empty((3, 2, 0), np.float32), np.empty((6, 3, 0), np.float32)
        )
    in_image = projection.jacobian(gaussians, shapes.scene, view)  # rows of J W, (u, 3) each
    x, y = (np.einsum("ui,uij->ju", each, shapes.axes[hit]) for each in in_image)  # (3, u) each
    longest, squared = scales.max(axis=1), np.square(scales).T  # (u,), (3, u)
    after, last = [1, 2, 0], [2, 0, 1]
    turned = squared[after] - squared[last]
    scaled = np.stack([squared * x * x, 2.0 * squared * x * y, squared * y * y], axis=1)
    turns = np.stack(
        [
            turned * x[after] * x[last],
            turned * (x[after] * y[last] + y[after] * x[last]),
            turned * y[after] * y[last],
        ],
        axis=1,
    )
    return Slopes(
        light,
        opacity,
        (longest * np.stack([x, y], axis=1)).astype(np.float32),
        np.concatenate([scaled, turns]).astype(np.float32),
    )


def _steepness_on_discs(
    discs: NDArray[np.float32], step: list[NDArray[np.float32]]
) -> NDArray[np.float32]:
    """Return `_steepness` of hits on discs, (7, h), at a step from their centres, (h,) each.

    With d scaled to the plane of the disc, ``d / (1 + g d)``, C of the disc is that of a Gaussian.
    Where its low-pass is what is drawn, only the mean matters; see `LinearView.steepness`.
    """
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


def _steepness(rays: Rays, kept: NDArray[np.int64], footprints: Footprints) -> NDArray[np.float32]:
    """Return `LinearView.steepness` of some hits, (2, h) or (3, h), as numbers."""
    place = np.empty(int(footprints.index.max(initial=-1)) + 1, np.intp)
    place[footprints.index] = np.arange(len(footprints.index))
    mine = footprints.take(place[rays.hit])
    owner, ray = rays.owner[kept].astype(np.intp), rays.ray[kept]
    pixel = (rays.columns[ray % len(rays.columns)], rays.rows[ray // len(rays.columns)])
    step = [
        (at + np.float32(0.5) - center.take(owner)).astype(np.float32)
        for at, center in zip(pixel, mine.centers, strict=True)
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
