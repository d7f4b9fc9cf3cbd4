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

That J changes with the mean, and the colour with the direction of view, is left out. Parameters are
those of the splat's own axes, so results turn and grow with the scene.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ..rendering import ALPHA_MAX
from ..seeing import projection
from ..seeing.ray_sums import behind, in_front
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

_LEAST_WEIGHT = 1e-3  # hits that make up less of their pixel are left out


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
    """

    gaussians: Gaussians
    scene: Scene
    axes: NDArray[np.float64]
    scales: NDArray[np.float64]

    @classmethod
    def of(cls, splats: Splats, gaussians: Gaussians, scene: Scene) -> Shapes:
        """Return the shapes of the splats that some Gaussians were made of."""
        chosen = splats.take(gaussians.index)
        axes = np.einsum("ij,njk->nik", scene.axes, rotation_matrices(chosen.quaternions))
        logs = chosen.log_scales.astype(np.float64) - np.log(scene.size)
        return cls(gaussians, scene, axes, np.exp(logs.clip(*projection.LOG_SCALE_RANGE)))


@dataclass(frozen=True, eq=False)
class LinearView:
    """The colours of the P rays of one view as a linear function of what its u splats change.

    Attributes
    ----------
    rows : (u,) int64
        Rows of the splats that are hit, among all that are refitted.
    colors : (3, P) float64
        What the rays see now, 0..1.
    ray, owner : (h,) int64
        Of each hit: its ray, and the splat as a place in `rows`.
    by_color : (3, h) float32
        How each channel changes with the same channel of the constant of the harmonics.
    by_alpha : (3, h) float32
        How the colour changes with alpha, ``T (c - B)``.
    alpha_by : (10, h) float32
        How alpha changes with the parameters behind the first three.
    """

    rows: NDArray[np.int64]
    colors: NDArray[np.float64]
    ray: NDArray[np.int64]
    owner: NDArray[np.int64]
    by_color: NDArray[np.float32]
    by_alpha: NDArray[np.float32]
    alpha_by: NDArray[np.float32]

    def forward(self, change: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return by how much the colours change, (3, P), to first order.

        Parameters
        ----------
        change : (13, N) float32
            Of the parameters of all splats.
        """
        mine = change[:, self.rows]
        alpha = np.zeros(len(self.owner), np.float32)
        for by, values in zip(self.alpha_by, mine[OPACITY.start :], strict=True):
            alpha += by * values.take(self.owner)
        result = np.empty((3, self.colors.shape[1]), np.float32)
        for channel in range(3):
            light = self.by_color[channel] * mine[channel].take(self.owner)
            light += self.by_alpha[channel] * alpha
            result[channel] = np.bincount(self.ray, light, self.colors.shape[1])
        return result

    def backward(self, errors: NDArray[np.float32]) -> NDArray[np.float64]:
        """Return the transpose of `forward` times some errors of the colours, (13, u).

        Parameters
        ----------
        errors : (3, P) float32
        """
        count = len(self.rows)
        result = np.empty((COUNT, count))
        alpha = np.zeros(len(self.owner), np.float32)
        for channel in range(3):
            error = errors[channel].take(self.ray)
            alpha += self.by_alpha[channel] * error
            result[channel] = np.bincount(self.owner, self.by_color[channel] * error, count)
        for row, by in enumerate(self.alpha_by, OPACITY.start):
            result[row] = np.bincount(self.owner, by * alpha, count)
        return result

    def diagonal(self) -> NDArray[np.float64]:
        """Return the squared length of each column, that is of each parameter, (13, u)."""
        count = len(self.rows)
        squares = np.square(self.by_alpha).sum(axis=0)
        return np.stack(
            [np.bincount(self.owner, np.square(by), count) for by in self.by_color]
            + [np.bincount(self.owner, np.square(by) * squares, count) for by in self.alpha_by]
        )


def linear_view(
    rays: Rays,
    footprints: Footprints,
    colors: NDArray[np.float64],
    shapes: Shapes,
    view: View,
) -> LinearView:
    """Return how the colours of the rays of a view change with the splats that they hit.

    Parameters
    ----------
    rays : Rays
    footprints : Footprints
        In the view.
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
    left = np.maximum(transmittance - weight, np.float32(LEAST_LEFT))
    kept = np.flatnonzero((weight > _LEAST_WEIGHT) & (rays.owner < movable))
    owner, ray = rays.owner[kept].astype(np.intp), rays.ray[kept].astype(np.intp)
    by_color, by_alpha = np.empty((2, 3, len(kept)), np.float32)
    for channel, of_splats in enumerate(colors):
        mine = of_splats.astype(np.float32).take(rays.owner)
        light = weight * mine
        background = behind(light.astype(np.float64), counts).astype(np.float32) / left
        by_alpha[channel] = (transmittance * (mine - background))[kept]
        unclipped = (of_splats > 0.0) & (of_splats < projection.BRIGHTEST)
        by_color[channel] = weight[kept] * unclipped.take(owner) * np.float32(SH_C0)
    rows = shapes.gaussians.index[rays.hit[:movable]]
    alpha_by = _alpha_by(replace(rays, hit=rays.hit[:movable]), kept, footprints, shapes, view)
    return LinearView(rows, rays.colors(colors), ray, owner, by_color, by_alpha, alpha_by)


def _alpha_by(
    rays: Rays,
    kept: NDArray[np.int64],
    footprints: Footprints,
    shapes: Shapes,
    view: View,
) -> NDArray[np.float32]:
    """Return how alpha of some hits changes with ten parameters, (10, h); see the top of this file.

    Parameters
    ----------
    rays, footprints, shapes, view
        See `linear_view`.
    kept : (h,) int64
        Which hits.
    """
    owner = rays.owner[kept].astype(np.intp)
    alpha = rays.alpha[kept]
    alpha = np.where(alpha < ALPHA_MAX, alpha, np.float32(0.0))  # clipped: it does not change
    across, down = _steepness(rays, kept, footprints)  # (h,) each, A d
    hit = shapes.gaussians.take(rays.hit)
    rows, columns = projection.jacobian(
        hit, shapes.scene, view
    )  # (u, 3) each, of J W in the scene's frame
    axes = shapes.axes[rays.hit]  # (u, 3, 3)
    scales = shapes.scales[rays.hit].astype(np.float32)  # (u, 3)
    along_row, along_column = (
        np.einsum("ui,uij->uj", each, axes).astype(np.float32) for each in (rows, columns)
    )
    slope = [  # (h,) each, h_j
        along_row[:, axis].take(owner) * across + along_column[:, axis].take(owner) * down
        for axis in range(3)
    ]
    longest, squared = scales.max(axis=1), scales * scales
    result = np.empty((COUNT - OPACITY.start, len(owner)), np.float32)
    result[0] = alpha * (np.float32(1.0) - hit.alphas).take(owner)
    for axis in range(3):
        after, last = (axis + 1) % 3, (axis + 2) % 3
        result[1 + axis] = alpha * longest.take(owner) * slope[axis]
        result[4 + axis] = alpha * np.square(scales[:, axis].take(owner) * slope[axis])
        difference = (squared[:, after] - squared[:, last]).take(owner)
        result[7 + axis] = alpha * difference * slope[after] * slope[last]
    return result


def _steepness(
    rays: Rays, kept: NDArray[np.int64], footprints: Footprints
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return ``A d`` of some hits, across and down, (h,) each, 1/px."""
    place = np.empty(int(footprints.index.max(initial=-1)) + 1, np.intp)
    place[footprints.index] = np.arange(len(footprints.index))
    mine = footprints.take(place[rays.hit])
    owner, ray = rays.owner[kept].astype(np.intp), rays.ray[kept]
    pixel = (rays.columns[ray % len(rays.columns)], rays.rows[ray // len(rays.columns)])
    step = [
        (at + np.float32(0.5) - center.take(owner)).astype(np.float32)
        for at, center in zip(pixel, mine.centers, strict=True)
    ]
    across, down = np.zeros((2, len(owner)), np.float32)
    for axes, sigma in zip((mine.major, mine.minor), mine.sigmas, strict=True):
        inverse = (1.0 / np.square(np.square(sigma.astype(np.float64)))).astype(np.float32)
        along = step[0] * axes[0].take(owner) + step[1] * axes[1].take(owner)
        along *= inverse.take(owner)
        across += along * axes[0].take(owner)
        down += along * axes[1].take(owner)
    return across, down
