"""What hides the points of one view: transmittance in front of them, and colour behind them.

A froxel is a cell of the image times a slab of depth. Points sorted by depth within their cell
(`points`) are slabs without thickness, so no grid of depths has to be chosen or stored: running
sums down the column of points of a cell give the optical thickness in front of each point and the
colour behind it.

A point of mass m covers the share ``a = m / A`` of a cell of area A. Points that are independent of
each other transmit ``prod (1 - a)``, so each has the optical thickness ``-log(1 - a)``.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..execute import checkpoint
from ..splats import ALPHA_CUT, ALPHA_MAX
from .points import Points, runs
from .projection import Footprints
from .rays import behind, in_front, paired

GAMMA_SHAPE = 2.3
"""Shape of the gamma distribution of the thickness in front of a point. The larger it is, the
narrower the distribution: `transmittance` tends to exp(-mean)."""

_MAX_THICKNESS = 60.0
"""Behind a larger optical thickness nothing is seen; keeps exponentials in float32's range."""

_LEAST_LEFT = 1e-4
"""The colour behind a point is divided by the transmittance behind it, and at least by this: less
cannot be seen. Thicknesses of cells are means, so hidden points are not left out before as those of
rays are."""


def integrals(
    footprints: Footprints, colors: NDArray[np.float32], points: Points
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Integrals over the image of ``alpha T`` and of ``alpha^2 T^2 |c - B|^2``, (n,) each, px^2.

    Of each the integral of alpha or alpha^2 over the whole footprint is exact, times the mean over
    its points in the image, weighted alike. S is the product of the two sigmas, A the opacity, and
    q the squared Mahalanobis distance. The footprint ends where alpha falls to `ALPHA_CUT`::

        integral of A exp(-q / 2) = 2 pi S (A - cut)
        integral of A^2 exp(-q)   =   pi S (A^2 - cut^2)

    Parameters
    ----------
    footprints : Footprints
    colors : (n, 3) float32
    points : Points
        Over the footprints.
    """
    alphas, count = footprints.alphas, len(footprints.alphas)
    area = np.float32(2.0 * math.pi) * footprints.sigmas[0] * footprints.sigmas[1]
    excess = alphas - np.float32(ALPHA_CUT)
    mass = area * excess
    mass_squared = np.float32(0.5) * area * excess * (alphas + np.float32(ALPHA_CUT))
    # What points take from their splats, in one table: one look-up is faster than six.
    traits = np.empty((count, 6), np.float32)
    traits[:, :3] = colors
    traits[:, 3] = mass / np.float32(points.area)
    np.minimum(alphas, np.float32(ALPHA_MAX), out=traits[:, 4])
    traits[:, 5] = evenness(footprints, points.area)
    visible, errors = np.empty((2, len(points.owners)))  # (m,) each
    for cells, members in runs(points.counts):
        shares, counts = points.shares[members], points.counts[cells]
        of_points = traits.take(points.owners[members], axis=0)
        covered = shares * of_points[:, 3]  # of the cell; at most the splat's opacity
        np.minimum(covered, of_points[:, 4], out=covered)
        thick = -np.log(np.float32(1.0) - covered)
        sums = in_front(paired(thick, thick * of_points[:, 5]), counts)
        front, even = sums.real.astype(np.float32), sums.imag.astype(np.float32)
        weight = transmittance(front, even)
        weight *= shares
        visible[members] = weight
        weight *= weight
        errors[members] = weight * _squared_contrast(front, covered, of_points[:, :3], counts)
    checkpoint()
    owners = points.owners.astype(np.int64)
    error = np.bincount(owners, errors, count).astype(float)
    # The factors alpha^2 do not sum to 1: divide by their sum, and multiply by the share of the
    # footprint that lies in the image.
    error *= points.share_inside / np.maximum(points.squares, 1e-30)
    return mass * np.bincount(owners, visible, count), mass_squared * error


def evenness(footprints: Footprints, area: float) -> NDArray[np.float32]:
    """Share of each splat's thickness that counts as uniform over the cell, (n,).

    It is ``s^2 / (s^2 + area)``, with s the shorter sigma and the area of the cell: near 0 for a
    splat much narrower than a cell, which leaves gaps, and near 1 for a much wider one.
    """
    narrow = footprints.sigmas[1] ** 2
    return np.asarray(narrow / (narrow + np.float32(area)))


def transmittance(front: NDArray[np.float32], even: NDArray[np.float32]) -> NDArray[np.float32]:
    """Transmittance in front of each point, (m,), given the mean thickness of its cell.

    Splats narrower than a cell leave gaps, so the thickness in front of a point differs from the
    cell's mean. It is modelled as gamma distributed with shape k, and the transmittance is the
    expectation ``E[exp(-tau)] = (1 + mean / k)^-k``. (With ``exp(-mean)``, splats that show through
    foliage would count as hidden and be removed.) The even part has no gaps: ``exp(-even)``.

    Parameters
    ----------
    front : (m,) float32
        Mean thickness in front of each point.
    even : (m,) float32
        The part of it that is uniform over the cell; see `evenness`.
    """
    shape = np.float32(GAMMA_SHAPE)
    gaps = np.maximum(front - even, np.float32(0.0))
    return np.asarray(np.exp(-even) * (np.float32(1.0) + gaps / shape) ** -shape)


def _squared_contrast(front, covered, colors, counts):
    """Squared contrast of each point, (m,), given the thickness in front and the share it covers.

    Point j adds ``T_j a_j c_j`` to the picture; T_j is the transmittance in front of it and a_j the
    share of the cell that it covers. The colour behind point k, over black, is
    ``B_k = (sum over j > k of T_j a_j c_j) / T_{k+1}``. The contrast ``c_k - B_k`` is squared and
    summed over the channels. `counts`, (C,), is how many points each column has.
    """
    weight = np.exp(-np.minimum(front, np.float32(_MAX_THICKNESS)))  # T_k
    left = np.maximum(weight * (np.float32(1.0) - covered), np.float32(_LEAST_LEFT))  # T_{k+1}
    weight *= covered  # T_k a_k
    red_green = behind(paired(weight * colors[:, 0], weight * colors[:, 1]), counts)
    blue = behind((weight * colors[:, 2]).astype(np.float64), counts)
    squared = np.zeros_like(front)
    for channel, light in enumerate((red_green.real, red_green.imag, blue)):
        contrast = light.astype(np.float32)
        contrast /= left
        contrast -= colors[:, channel]
        contrast *= contrast
        squared += contrast
    return squared
