"""Splats transformed by affine matrices, such as an object's; maps found from moved points."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import spherical_harmonics
from .errors import RefineError
from .execute import chunks
from .splats import Splats, assign, rotation_matrices

QUARTER = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""A quarter turn about x: the y-down world of COLMAP to the z-up world of Blender."""

QUARTERS = {0: np.eye(3), 1: QUARTER, -1: QUARTER.T, 2: QUARTER @ QUARTER}
"""Turns about x by number of quarters."""

AXES = ("rub", "rdf")
"""Axes of an SPZ: right, up, back as SPZ documents them, or right, down, front as in a PLY."""
UNKNOWN_AXES = "?"  # neither the SPZ nor anybody else names its axes
_UNIFORM = 1e-4  # largest relative difference of the scales of a matrix that counts as uniform
_FLAT = 1e-9  # smallest over largest scale up to which a matrix counts as flat

_SMALLEST, _LARGEST = 1e-30, 1e30
"""Scales of a matrix that is applied: its determinant fits float64, usual splats float32."""

LEAST = 6  # fewest points of a map: one can be fitted to any four
_MOST = 32  # most maps that are found
_NOISE = 4e-6  # rounding of moved points, relative to a coordinate's terms: 32 units of float32
_PLANAR = 1e-5  # thickness over extent up to which points count as lying in a plane

_SAMPLE, _FITTED = 2048, 16384
"""Points, evenly spread, by which candidates are compared, and to which the best is fitted."""

_TRIES, _DRAWN = 240, 4
"""Candidates for each map, and points that each is fitted to: the fewest that determine one."""

_BLOCKS = (1.0, 0.1, 0.01)
"""Shares of the points, consecutive rows, from which a candidate draws its own: rows of a joined or
copied object lie together, those selected by hand do not."""

_CHUNK = 1 << 16  # splats whose covariances are computed together, which limits temporary memory


def scales_of(matrix: NDArray[Any]) -> NDArray[np.float64]:
    """Scales of a (4, 4) or (3, 3) matrix along its three axes, largest first."""
    linear = np.asarray(matrix, np.float64)[:3, :3]
    return np.asarray(np.linalg.svd(linear, compute_uv=False))


def is_uniform(matrix: NDArray[Any]) -> bool:
    """Whether a (4, 4) or (3, 3) matrix scales all directions alike; it may mirror."""
    scales = scales_of(matrix)
    return bool(scales[0] - scales[2] <= _UNIFORM * scales[0])


def is_flat(matrix: NDArray[Any]) -> bool:
    """Whether a (4, 4) or (3, 3) matrix maps space to a plane, a line or a point."""
    scales = scales_of(matrix)
    return not scales[2] > _FLAT * scales[0]


def moved(means: NDArray[Any], matrix: NDArray[Any]) -> NDArray[np.float64]:
    """Points, (N, 3), moved by an affine matrix, (4, 4): (N, 3) float64."""
    with np.errstate(invalid="ignore", over="ignore"):  # of what is not finite
        return np.asarray(means @ matrix[:3, :3].T.astype(np.float64) + matrix[:3, 3])


def transformed(splats: Splats, matrix: NDArray[Any], *, rotate_sh: bool = True) -> Splats:
    """Splats transformed by an invertible affine matrix; RefineError by `check_affine`.

    They are float64: rounded, other splats might be kept. Without `rotate_sh` harmonics stay those
    of the old frame, and the matrix may be non-uniform; the closed form needs no more.
    """
    matrix = np.asarray(matrix, np.float64)
    check_affine(matrix, with_sh=rotate_sh)
    means, linear = moved(splats.means, matrix), matrix[:3, :3]
    if not is_uniform(matrix):
        return _stretched(splats, means, linear)
    factor = np.cbrt(abs(np.linalg.det(linear)))
    rotation = linear / factor
    left, _, right = np.linalg.svd(rotation)
    rotation = left @ right
    # A splat is symmetric about its centre, so a reflection R acts on it like the rotation -R. Its
    # harmonics are not symmetric and follow R.
    proper = rotation if np.linalg.det(rotation) > 0 else -rotation
    w, x, y, z = quaternion(proper)
    product = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    sh_rest = splats.sh_rest
    with np.errstate(invalid="ignore", over="ignore"):  # of what is not finite
        if rotate_sh and splats.sh_degree:
            sh_rest = spherical_harmonics.rotate(sh_rest, rotation)
        log_scales = splats.log_scales + np.float64(np.log(factor))
        quats = np.asarray(splats.quaternions, np.float64) @ product.T
    return replace(splats, means=means, log_scales=log_scales, quaternions=quats, sh_rest=sh_rest)


def turned(splats: Splats, axes: str) -> Splats:
    """Splats, in their own types, turned from axes x, y, z with letters of "rdflub" to "rdf".

    Half turns change no digit, and are their own inverses.
    """
    matrix, result = np.eye(4), splats.take(np.arange(len(splats)))
    matrix[:3, :3] = np.vstack([np.eye(3), -np.eye(3)])[["rdflub".index(a) for a in axes]].T
    for piece in chunks(len(splats), _CHUNK):
        assign(result.take(piece), transformed(splats.take(piece), matrix))
    return result


def baked(splats: Splats, matrix: NDArray[Any]) -> Splats:
    """Like `transformed`; if the matrix is not uniform, harmonics are fitted.

    See `spherical_harmonics.stretched`.
    """
    uniform = is_uniform(matrix)
    result = transformed(splats, matrix, rotate_sh=uniform)
    if uniform or not splats.sh_degree:
        return result
    linear = np.asarray(matrix, np.float64)[:3, :3]
    sh_dc, sh_rest = spherical_harmonics.stretched(splats.sh_dc, splats.sh_rest, linear)
    return replace(result, sh_dc=sh_dc, sh_rest=sh_rest)


def check_affine(matrix: NDArray[np.float64], *, with_sh: bool = False) -> None:
    """Raise `RefineError` unless a matrix is affine, not flat, in range and, `with_sh`, uniform."""
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise RefineError(f"expected a finite (4, 4) matrix, got {matrix.tolist()}")
    scales = scales_of(matrix)
    if is_flat(matrix) or not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise RefineError(
            f"the transform is flat or not affine (scales {scales.tolist()}): it cannot be applied"
        )
    if not _SMALLEST <= scales[2] <= scales[0] <= _LARGEST:
        raise RefineError(
            f"the transform scales by {scales[0]:g}, expected {_SMALLEST:g} to {_LARGEST:g}"
        )
    if with_sh and not is_uniform(matrix):
        raise RefineError(
            f"the transform scales directions differently ({scales.round(6).tolist()}); splat "
            "colours cannot follow that exactly: bake the object's transform (Bake Transform), or "
            "make its scale uniform first"
        )


def quaternion(rotation: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit quaternions w x y z, w >= 0, of rotation matrices, (..., 3, 3) -> (..., 4) float64.

    The eigenvector of the largest eigenvalue (Bar-Itzhack 2000): as accurate for half a turn.
    """
    m = np.asarray(rotation, np.float64)
    inverse, trace = np.swapaxes(m, -1, -2), np.trace(m, axis1=-2, axis2=-1)
    symmetric = np.zeros((*trace.shape, 4, 4))  # its lower half
    symmetric[..., 0, 0] = trace
    symmetric[..., 1:, 0] = (m - inverse)[..., [2, 0, 1], [1, 2, 0]]
    symmetric[..., 1:, 1:] = m + inverse - trace[..., None, None] * np.eye(3)
    q = np.linalg.eigh(symmetric)[1][..., -1]
    return np.where(q[..., :1] < 0.0, -q, q)


def _stretched(splats, means, linear):
    """Splats with these means and the covariances ``M S M'``, M being `linear`."""
    logs, quaternions = np.empty((len(splats), 3)), np.empty((len(splats), 4))
    for piece in chunks(len(splats), _CHUNK):
        stored = np.asarray(splats.log_scales[piece], np.float64)
        usable = np.isfinite(stored).all(axis=1)
        largest = np.where(usable, stored.max(axis=1), 0.0)
        # Relative to the longest axis, so that scales such as 1e30 and 1e-30 stay in range.
        relative = np.exp(np.where(usable[:, None], stored - largest[:, None], 0.0).clip(-300, 0))
        axes = linear @ (rotation_matrices(splats.quaternions[piece]) * relative[:, None, :])
        # Singular values of M A are more accurate than the eigenvalues of the covariance.
        left, sizes, _ = np.linalg.svd(axes)
        flip = np.where(np.linalg.det(left) < 0.0, -1.0, 1.0)
        quaternions[piece] = quaternion(left * flip[:, None, None])
        with np.errstate(divide="ignore"):  # the log scale of a flat splat is -inf
            logs[piece] = np.where(usable[:, None], np.log(sizes) + largest[:, None], stored)
    return replace(splats, means=means, log_scales=logs, quaternions=quaternions)


class Move(NamedTuple):
    """Rows, (M,), of points that one affine map, (4, 4), moved.

    The linear part of a translation, or of no move at all, is exactly the identity.
    """

    rows: NDArray[np.int64]
    matrix: NDArray[np.float64]


def affine_moves(before: NDArray[Any], after: NDArray[Any]) -> list[Move]:
    """Affine maps that explain how points, (N, 3), moved, by RANSAC (Fischler and Bolles 1981).

    A map is fitted to all points, and to random draws of a few, the same at each call; the one that
    most points agree with is kept, and the search goes on with the others. First come the points
    that did not move, then at most 32 maps. Points moved one by one, or into a plane, are in none.
    """
    before, after = np.asarray(before, np.float64), np.asarray(after, np.float64)
    finite = np.isfinite(before).all(axis=1) & np.isfinite(after).all(axis=1)
    same = finite & (before == after).all(axis=1)
    moves = [Move(np.flatnonzero(same), np.eye(4))] if same.any() else []
    left = np.flatnonzero(finite & ~same)
    random = np.random.default_rng(0)
    for _ in range(_MOST):
        matrix = _agreed(before[left], after[left], random) if len(left) >= LEAST else None
        if matrix is None:
            break
        fits = _fits(matrix, before[left], after[left])
        moves.append(Move(left[fits], matrix))
        left = left[~fits]
    return moves


def _agreed(before, after, random):
    """Map, (4, 4), that most points agree with; None if fewer than `LEAST` agree with any."""
    everything = np.arange(len(before))
    some = _spread(everything, _SAMPLE)
    start, end = before[some], after[some]
    best, most = None, LEAST - 1
    for number in range(-1, _TRIES):
        drawn = some  # at first, one map for all
        if number >= 0:
            size = max(min(len(before), 8), int(len(before) * _BLOCKS[number % len(_BLOCKS)]))
            first = random.integers(0, len(before) - size + 1)
            drawn = first + random.choice(size, min(size, _DRAWN), replace=False)
        matrix = _fitted(before[drawn], after[drawn])
        if matrix is None:
            continue
        # A map fitted to few points is less exact than one fitted to all that agree with it.
        agree = _fits(matrix, start, end, slack=100.0)
        if np.count_nonzero(agree) >= LEAST:
            better = _fitted(start[agree], end[agree])
            matrix = matrix if better is None else better
        agreeing = int(np.count_nonzero(_fits(matrix, start, end)))
        if agreeing > most:
            best, most = matrix, agreeing
        if most > len(some) // 2:
            break
    if best is None:
        return None
    rows = _spread(np.flatnonzero(_fits(best, before, after)), _FITTED)
    return _fitted(before[rows], after[rows])


def _spread(rows, most):
    """At most `most` of some rows, evenly spread."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, most).astype(np.int64))]


def _fits(matrix, before, after, *, slack=1.0):
    """Points that a map moves as they moved, up to `slack` times rounding, (N,) bool."""
    turn, shift = np.abs(matrix[:3, :3]).T, np.abs(matrix[:3, 3])
    allowed = slack * _NOISE * (np.abs(before) @ turn + shift + np.abs(after)).max(axis=1)
    return np.abs(moved(before, matrix) - after).max(axis=1) <= allowed


def _fitted(before, after):
    """Affine least-squares map, (4, 4); None for points on a line, or moved into a plane."""
    shift = np.eye(4)
    shift[:3, 3] = (after - before).mean(axis=0)
    if _fits(shift, before, after).all():
        return shift
    # Relative to their size: far points are rounded more coarsely.
    extents = np.abs(before).max(axis=1) + np.abs(after).max(axis=1)
    weights = 1.0 / (extents + (np.median(extents) or 1.0))
    middle, target = (np.average(points, axis=0, weights=weights) for points in (before, after))
    source, goal = (before - middle) * weights[:, None], (after - target) * weights[:, None]
    linear, _, rank, _ = np.linalg.lstsq(source, goal, rcond=_PLANAR)
    left, scales, right = np.linalg.svd(linear.T)
    if rank == 2:  # points in a plane leave the axis across it free: their mean scale, unmirrored
        scales[2] = np.sqrt(scales[0] * scales[1])
        left[:, 2] *= np.linalg.det(left @ right)
    matrix = np.eye(4)
    matrix[:3, :3] = (left * scales) @ right
    matrix[:3, 3] = target - matrix[:3, :3] @ middle
    return matrix if rank > 1 and scales[1:].min() > _PLANAR * scales[0] else None
