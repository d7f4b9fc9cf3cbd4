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
from ..rendering import ALPHA_CUT, ALPHA_MAX
from .points import Points
from .projection import Footprints
from .ray_sums import behind, in_front, paired

GAMMA_SHAPE = 2.3
"""Shape of the gamma distribution of the thickness in front of a point. The larger it is, the
narrower the distribution: `transmittance` tends to exp(-mean)."""

_MAX_THICKNESS = 60.0
"""Behind a larger optical thickness nothing is seen; keeps exponentials in float32's range."""

_LEAST_LEFT = 1e-4
"""The colour behind a point is divided by the transmittance behind it, and at least by this: less
cannot be seen. Thicknesses of cells are means, so hidden points are not left out before as those of
rays are."""


def traits(
    footprints: Footprints,
    mass: NDArray[np.float32],
    colors: NDArray[np.float32],
    area: float,
) -> NDArray[np.float32]:
    """Return what points take from their splats, in one table: one look-up is faster than six.

    Parameters
    ----------
    footprints : Footprints
    mass : (n,) float32
    colors : (n, 3) float32
    area : float
        Of a cell, px^2.

    Returns
    -------
    (n, 6) float32
        Red, green, blue; the mass over the cell's area; the largest share of a cell that the splat
        covers, which is its opacity; `evenness`.
    """
    table = np.empty((len(mass), 6), np.float32)
    table[:, :3] = colors
    table[:, 3] = mass / np.float32(area)
    np.minimum(footprints.alphas, np.float32(ALPHA_MAX), out=table[:, 4])
    table[:, 5] = evenness(footprints, area)
    return table


def composite(
    shares: NDArray[np.float32], traits: NDArray[np.float32], counts: NDArray[np.int64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the transmittance in front of points and their squared contrast, (m,) each.

    Parameters
    ----------
    shares : (m,) float32
        Of the splat's mass.
    traits : (m, 6) float32
        Of each point's splat, see `traits`.
    counts : (C,) int64
        How many points each column has.
    """
    covered = shares * traits[:, 3]
    np.minimum(covered, traits[:, 4], out=covered)
    thick = thickness(covered)
    sums = in_front(paired(thick, thick * traits[:, 5]), counts)
    front, even = sums.real.astype(np.float32), sums.imag.astype(np.float32)
    return transmittance(front, even), squared_contrast(front, covered, traits[:, :3], counts)


def thickness(covered: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the optical thickness of points, ``-log(1 - a)``, (m,).

    Parameters
    ----------
    covered : (m,) float32
        a, the share of its cell that each point covers: its mass over the cell's area, at most the
        splat's opacity.
    """
    left = np.subtract(np.float32(1.0), covered)
    np.log(left, out=left)
    return np.asarray(np.negative(left, out=left))


def evenness(footprints: Footprints, area: float) -> NDArray[np.float32]:
    """Return the share of each splat's thickness that counts as uniform over the cell, (n,).

    It is ``s^2 / (s^2 + area)``, with s the shorter sigma and the area of the cell: near 0 for a
    splat much narrower than a cell, which leaves gaps, and near 1 for a much wider one.
    """
    narrow = footprints.sigmas[1] ** 2
    return np.asarray(narrow / (narrow + np.float32(area)))


def transmittance(front: NDArray[np.float32], even: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the transmittance in front of each point, (m,), given the mean thickness of its cell.

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


def squared_contrast(
    front: NDArray[np.float32],
    covered: NDArray[np.float32],
    colors: NDArray[np.float32],
    counts: NDArray[np.int64],
) -> NDArray[np.float32]:
    """Return the squared contrast of each point, (m,).

    Point j adds ``T_j a_j c_j`` to the picture; T_j is the transmittance in front of it and a_j the
    share of the cell that it covers. The colour behind point k, over black, is
    ``B_k = (sum over j > k of T_j a_j c_j) / T_{k+1}``. The contrast ``c_k - B_k`` is squared and
    summed over the channels.

    Parameters
    ----------
    front, covered : (m,) float32
        Optical thickness in front of each point, and a.
    colors : (m, 3) float32
    counts : (C,) int64
        How many points each column has.
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


def means_over_footprints(
    points: Points, visible: NDArray[np.float64], errors: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the means over each footprint of T and of ``T^2 |c - B|^2``, both (n,).

    The first is weighted by alpha, the second by alpha^2; both are 0 outside the image.

    Parameters
    ----------
    points : Points
    visible, errors : (m,) float64
        Of each point: its share times T, and the square of that times ``|c - B|^2``.
    """
    checkpoint()
    count = len(points.share_inside)
    owners = points.owners.astype(np.int64)
    total = np.asarray(np.bincount(owners, errors, count), np.float64)
    # The factors alpha^2 do not sum to 1: divide by their sum, and multiply by the share of the
    # footprint that lies in the image.
    total *= points.share_inside / np.maximum(points.squares, 1e-30)
    return np.asarray(np.bincount(owners, visible, count), np.float64), total


def masses(footprints: Footprints) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the integrals of alpha and of alpha^2 over each footprint, (n,) each, px^2.

    S is the product of the two sigmas, A the opacity, and q the squared Mahalanobis distance. The
    footprint ends where alpha falls to `ALPHA_CUT`::

        integral of A exp(-q / 2) = 2 pi S (A - cut)
        integral of A^2 exp(-q)   =   pi S (A^2 - cut^2)
    """
    alphas = footprints.alphas
    area = np.float32(2.0 * math.pi) * footprints.sigmas[0] * footprints.sigmas[1]
    excess = alphas - np.float32(ALPHA_CUT)
    return area * excess, np.float32(0.5) * area * excess * (alphas + np.float32(ALPHA_CUT))
