"""What views see of each splat, with T the transmittance in front and B the colour behind it:

    contribution_i = sum over views of  integral of alpha_i  x  mean T        MesonGS, LightGaussian
    error_i        = sum over views of  integral of alpha_i^2  x  mean of T^2 |c_i - B_i|^2

Nothing is rendered. Points stand for the splats, sorted by depth in cells of the image (`points`):
one of mass m has the optical depth ``-log(1 - m / A)`` in a cell of area A, and running sums down a
cell give T and B. docs/method.md, section 4, derives it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, checkpoint, chunks, return_freed, run, silent
from ..splats import ALPHA_CUT, ALPHA_MAX
from ..views import View
from . import projection
from .cast import RaySample, cast_view
from .points import cell_size, runs, scatter
from .projection import Gaussians
from .rays import contrasts, in_front, paired
from .scene import Scene

VIEW_GROUPS = 8
"""Groups of views: sums are added group by group, so they do not depend on threads."""

SECONDS = 1.2e-6
"""Seconds of one core for a splat in a view, about; decides whether processes are worth it."""

GAMMA_SHAPE = 2.3
"""Shape of the gamma distribution in `_transmittance`; the larger, the nearer to exp(-mean)."""

_MAX_DEPTH = 60.0
"""Nothing is seen behind a larger optical depth; keeps exponentials in float32's range."""

_LEAST_LEFT = 1e-4
"""Least transmittance behind a point, by which the colour behind is divided; less shows nothing."""

_SUMMED = 1 << 20  # points summed at a time


Measured = NDArray[np.float64]
"""Sums over views, times their weights, for M Gaussians or splats, (3, M): contribution and error,
px^2, and the number of views that hold the centre."""


def view_groups(count: int) -> list[range]:
    """Numbers of the views of each group: every eighth of `count` views."""
    groups = min(VIEW_GROUPS, count)
    return [range(k, count, groups) for k in range(groups)]


def measure(
    gaussians: Gaussians,
    scene: Scene,
    views: Sequence[tuple[View, float]],
    groups: Sequence[range],
    *,
    sample: Sequence[int] | NDArray[np.int64] = (),
    ray_samples: Sequence[RaySample] = (),
    progress: Progress = silent,
) -> tuple[Measured, list[Measured], list[NDArray[np.float64]]]:
    """Measure Gaussians in groups of views (`view_groups`), and cast rays with their footprints.

    `ray_samples` get the rays of these views that they lack. Returned are the sums of all Gaussians
    over all groups, those of the rows `sample` over each group, and for each group the errors of
    the sample in each view, (views, m).
    """
    chosen, numbers = np.asarray(sample, np.int64), [n for group in groups for n in group]
    lacking = [[rays for rays in ray_samples if rays.wants(n)] for n in numbers]
    measured = run(
        partial(_measure_and_cast, gaussians, scene, views),
        [(n, [rays.kind for rays in some]) for n, some in zip(numbers, lacking, strict=True)],
        cost=SECONDS * len(gaussians) * len(numbers), progress=progress, what="scoring",
    )  # fmt: skip
    total, of_groups, errors = np.zeros((3, len(gaussians))), [], []
    each = zip(measured, lacking, strict=True)
    for group in groups:
        sums, of_views = np.zeros_like(total), []
        for number, ((measurement, cast), some) in zip(group, each, strict=False):
            (rows, inside, contribution, error), weight = measurement, views[number][1]
            before = sums[1, chosen]  # (m,)
            sums[0, rows] += weight * contribution
            sums[1, rows] += weight * error
            sums[2, rows[inside]] += 1.0  # no row is there twice
            of_views.append(sums[1, chosen] - before)
            for ray_sample, rays in zip(some, cast, strict=True):
                ray_sample.rays[number] = rays
        total += sums
        of_groups.append(sums.take(chosen, axis=1))
        errors.append(np.array(of_views))
    next(each, None)  # so that `run` ends
    return total, of_groups, errors


def _measure_and_cast(gaussians, scene, views, number_and_kinds):
    """What a view sees of the splats, and its rays of some kinds, in any process."""
    number, kinds = number_and_kinds
    footprints, measurement = _measure_view(gaussians, scene, views[number][0])
    return measurement, [cast_view(views, number, footprints, kind) for kind in kinds]


def _measure_view(gaussians, scene, view):
    """Footprints in a view; rows, whether centres are inside, contributions, errors, (n,) each."""
    footprints = projection.project(gaussians, scene, view)
    return_freed(mapped_only=True)
    integrals = np.empty(0), np.empty(0)
    if len(footprints.index):
        points = scatter(footprints, view, cell_size(footprints, view))
        integrals = _integrals(gaussians, footprints, points)
    return footprints, (footprints.index.astype(np.int32), footprints.inside, *integrals)


def _integrals(gaussians, footprints, points):
    """Integrals over the image of ``alpha T`` and of ``alpha^2 T^2 |c - B|^2``, (n,) each, px^2.

    Those of alpha and alpha^2 are exact, times the mean over the points in the image. S is the
    product of the sigmas, A the opacity and q the squared Mahalanobis distance, up to `ALPHA_CUT`::

        integral of A exp(-q / 2) = 2 pi S (A - cut)
        integral of A^2 exp(-q)   =   pi S (A^2 - cut^2)
    """
    alphas, count = footprints.alphas, len(footprints.alphas)
    mass = np.float32(2.0 * math.pi) * footprints.sigmas[0] * footprints.sigmas[1]
    mass *= alphas - np.float32(ALPHA_CUT)
    # What points take from their splats, in one table: one look-up is faster than six, and rows of
    # 32 bytes, two of these columns unused, are copied twice as fast as rows of 24.
    traits = np.empty((count, 8), np.float32)
    traits[:, :3] = gaussians.colors.take(footprints.index, axis=0)
    traits[:, 3] = mass / np.float32(points.area)
    np.minimum(alphas, np.float32(ALPHA_MAX), out=traits[:, 4])
    # The share of each optical depth that is even over a cell, near 0 for narrow splats.
    narrow = footprints.sigmas[1] ** 2
    traits[:, 5] = narrow / (narrow + np.float32(points.area))
    seen = np.empty((2, len(points.owners)), np.float32)  # of visible contributions, of errors
    for cells, members in runs(points.counts):
        shares, counts = points.shares[members], points.counts[cells]
        of_points = traits.take(points.owners[members], axis=0)
        covered = shares * of_points[:, 3]  # of the cell; at most the splat's opacity
        np.minimum(covered, of_points[:, 4], out=covered)
        depth = -np.log(np.float32(1.0) - covered)  # optical
        sums = in_front(paired(depth, depth * of_points[:, 5]), counts)
        front, even = sums.real.astype(np.float32), sums.imag.astype(np.float32)
        weight = _transmittance(front, even)
        weight *= shares
        seen[0, members] = weight
        weight *= weight
        seen[1, members] = weight * _squared_contrast(front, covered, of_points[:, :3], counts)
    checkpoint()
    del traits
    visible, error = np.zeros((2, count))
    for piece in chunks(len(points.owners), _SUMMED):
        owners = points.owners[piece].astype(np.int64)
        for total, of_points in zip((visible, error), seen[:, piece], strict=True):
            total += np.bincount(owners, of_points, count)
    # The factors alpha^2 do not sum to 1: divide by their sum, and multiply by the share of the
    # footprint that lies in the image.
    error *= points.share_inside
    error /= np.maximum(points.squares, np.float32(1e-30))
    visible *= mass
    mass *= np.float32(0.5) * (alphas + np.float32(ALPHA_CUT))
    error *= mass
    return visible.astype(np.float32), error.astype(np.float32)


def _transmittance(front, even):
    """Transmittance in front of points, (m,), of mean optical depth `front`, `even` without gaps.

    The rest, gamma distributed with shape k, lets ``E[exp(-tau)] = (1 + mean / k)^-k`` through.
    With exp(-mean) instead, splats that show through foliage would count as hidden.
    """
    shape = np.float32(GAMMA_SHAPE)
    gaps = np.maximum(front - even, np.float32(0.0))
    return np.exp(-even) * (np.float32(1.0) + gaps / shape) ** -shape


def _squared_contrast(front, covered, colors, counts):
    """``|c_k - B_k|^2`` of points, (m,), ``B_k = (sum over j > k of T_j a_j c_j) / T_{k+1}``."""
    weight = np.exp(-np.minimum(front, np.float32(_MAX_DEPTH)))  # T_k
    left = np.maximum(weight * (np.float32(1.0) - covered), np.float32(_LEAST_LEFT))  # T_{k+1}
    weight *= covered  # T_k a_k
    return sum(contrast * contrast for contrast in contrasts(weight, left, colors.T, counts))
