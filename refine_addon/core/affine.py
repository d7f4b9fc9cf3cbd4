"""Transform splats by an affine matrix, such as a Blender object's."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import spherical_harmonics
from .errors import RefineError
from .execute import chunks
from .splats import Splats, rotation_matrices

QUARTER = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""A quarter turn about x: the y-down world of COLMAP to the z-up world of Blender."""

QUARTERS = {0: np.eye(3), 1: QUARTER, -1: QUARTER.T}
"""No turn, a quarter turn about x and one back, by how many quarters they are."""

_UNIFORM = 1e-4
"""Relative difference between the scales of a matrix that still counts as uniform scaling."""

_FLAT = 1e-9  # least over largest scale of a matrix that cannot be inverted in practice

_SMALLEST, _LARGEST = 1e-30, 1e30
"""Scales of a matrix that is applied: its determinant is in the range of float64, and usual splats
stay in that of float32."""

_CHUNK = 1 << 16  # splats whose covariances are computed together, which limits temporary memory


def scales_of(matrix: NDArray[Any]) -> NDArray[np.float64]:
    """By how much a (4, 4) or (3, 3) matrix scales along its three axes, largest first."""
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
    """Places, (N, 3), where an affine (4, 4) matrix moves them."""
    with np.errstate(invalid="ignore", over="ignore"):  # of what is not finite
        return np.asarray(means @ matrix[:3, :3].T.astype(np.float64) + matrix[:3, 3])


def transformed(splats: Splats, matrix: NDArray[Any], *, rotate_sh: bool = True) -> Splats:
    """Splats transformed by an affine matrix.

    Parameters
    ----------
    splats : Splats
    matrix : (4, 4) floating
        From the frame of the splats to the new one; any invertible affine matrix.
    rotate_sh : bool
        Whether harmonics are rotated with the splats. If not, they stay those of the old frame
        (enough for the closed form, which only uses the constant), and non-uniform matrices are
        allowed: means and covariances are transformed exactly.

    Returns
    -------
    Splats
        Transformed values are in float64. Rounded to float32 they would differ in the last digits
        from the splats in the old frame, and so might the kept set.

    Raises
    ------
    RefineError
        If the matrix is not finite, not invertible or not affine, or scales by less than 1e-30 or
        more than 1e30; or if, with `rotate_sh`, it scales directions differently, which harmonics
        cannot express.
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
    return replace(
        splats,
        means=means,
        log_scales=splats.log_scales + np.float64(np.log(factor)),
        quaternions=np.asarray(splats.quaternions, np.float64) @ product.T,
        sh_rest=(
            spherical_harmonics.rotate(splats.sh_rest, rotation)
            if rotate_sh and splats.sh_degree
            else splats.sh_rest
        ),
    )


def baked(splats: Splats, matrix: NDArray[Any]) -> Splats:
    """Splats transformed by any affine matrix that can be inverted, harmonics as well.

    As `transformed`, but where the matrix scales directions differently, harmonics become the
    nearest to what is seen (`spherical_harmonics.stretched`); the rest is exact.

    Raises
    ------
    RefineError
        See `transformed`.
    """
    uniform = is_uniform(matrix)
    result = transformed(splats, matrix, rotate_sh=uniform)
    if uniform or not splats.sh_degree:
        return result
    linear = np.asarray(matrix, np.float64)[:3, :3]
    sh_dc, sh_rest = spherical_harmonics.stretched(splats.sh_dc, splats.sh_rest, linear)
    return replace(result, sh_dc=sh_dc, sh_rest=sh_rest)


def check_affine(matrix: NDArray[np.float64], *, with_sh: bool = False) -> None:
    """Refuse a matrix that splats, or with `with_sh` their harmonics, cannot follow.

    Raises
    ------
    RefineError
        If it is not an affine (4, 4) matrix, or flat, or scales by what float32 does not hold; with
        `with_sh` also if it scales directions differently.
    """
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
    """Unit quaternion w x y z of rotation matrices, (..., 3, 3) -> (..., 4).

    It is the eigenvector of the largest eigenvalue of a symmetric 4 x 4 matrix (Bar-Itzhack 2000).
    This needs no case distinction and is as accurate for half a turn as for other angles.
    """
    m = np.asarray(rotation, np.float64)
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz = m[..., 1, 0] + m[..., 0, 1], m[..., 0, 2] + m[..., 2, 0]
    yz = m[..., 2, 1] + m[..., 1, 2]
    rows = [
        [xx + yy + zz, a, b, c],
        [a, xx - yy - zz, xy, xz],
        [b, xy, yy - xx - zz, yz],
        [c, xz, yz, zz - xx - yy],
    ]
    symmetric = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
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
