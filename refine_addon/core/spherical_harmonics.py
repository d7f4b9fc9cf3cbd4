"""Real spherical harmonics with the signs and order that 3DGS files use, degrees 0 to 4."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from .execute import chunks
from .images import srgb_of
from .splats import SH_C0

Harmonics: TypeAlias = "tuple[NDArray[Any], NDArray[Any]]"
"""Coefficients of the constant harmonic, (N, 3), and of the others, (N, K, 3)."""

LARGEST = np.float32(1e36)  # coefficient that counts: 25 of them add up to a float32

_CHUNK = 1 << 16  # splats whose coefficients are widened to float64 at a time
_LUMA = (0.2126, 0.7152, 0.0722)  # shares of red, green and blue in a grey (ITU-R BT.709)
_GAMMA = 2.2  # of the power that the curve of sRGB is near

_DIRECTIONS = np.random.default_rng(0).normal(size=(4096, 3))
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)
"""Over which stretched harmonics are fitted; degree 4 has 25 coefficients."""


def basis(directions: NDArray[Any], degree: int) -> NDArray[np.float64]:
    """Values of all harmonics up to `degree` along directions, (..., (degree + 1)^2) float64.

    `directions`, (..., 3), are unit vectors from the view to the splat, in the frame of the
    harmonics. The constant comes first, then each band l with m = -l .. l, with the Condon-Shortley
    phase as in 3DGS (Kerbl et al. 2023). A harmonic is its polynomial in x, y, z times
    sqrt((2l + 1) / 4 pi (l - |m|)! / (l + |m|)!), and for m != 0 times sqrt(2).
    """
    return np.stack(_values(np.moveaxis(np.asarray(directions, np.float64), -1, 0), degree), -1)


def _values(directions, degree):
    """List of the values of `basis`, (...) each, along directions, (3, ...), in their dtype."""
    x, y, z = directions
    values: list[Any] = [None] * (degree + 1) ** 2
    # Real and imaginary part of (x + i y)^m, and the factor of the first band that has this m.
    cosine, sine, factor = np.ones_like(x), np.zeros_like(x), math.sqrt(0.25 / math.pi)
    for m in range(degree + 1):
        before, here = 0.0, factor
        for band in range(m, degree + 1):
            if band > m:  # the recurrence of Legendre's functions of z over (1 - z^2)^(m / 2)
                step = math.sqrt((4 * band * band - 1) / (band * band - m * m))
                before, here = here / step, step * (z * here - before)
            middle = band * (band + 1)
            values[middle + m] = here * cosine
            if m:
                values[middle - m] = here * sine
        cosine, sine = x * cosine - y * sine, x * sine + y * cosine
        factor *= -math.sqrt((2 * m + 3) / (2 * m + 2) * (1 if m else 2))
    return values


def colors(
    directions: NDArray[Any], sh_dc: NDArray[Any], sh_rest: NDArray[Any]
) -> NDArray[np.float32]:
    """Colour of each splat along a direction as in `basis`, (N, 3) float32, not clipped.

    ``0.5 + sum of harmonics times coefficients`` (Kerbl et al. 2023), display-referred;
    `directions` and `sh_dc` are (N, 3), `sh_rest` is (N, K, 3), each at most `LARGEST`.
    """
    degree = math.isqrt(sh_rest.shape[1] + 1) - 1  # one alone stands for all: no colour
    values = _values(np.ascontiguousarray(directions.T, np.float32), degree)
    # In one memory layout, since einsum sums in an order that depends on it.
    dc, rest = (
        np.ascontiguousarray(each.clip(-LARGEST, LARGEST), np.float32) for each in (sh_dc, sh_rest)
    )
    result = values[0] * dc.T
    if degree:
        result += np.einsum("nk,nkc->cn", np.stack(values[1:], axis=1), rest)
    return np.asarray(result.T + np.float32(0.5))


def rotate(sh_rest: NDArray[Any], rotation: NDArray[np.float64]) -> NDArray[Any]:
    """Coefficients, (N, K, 3), whose colour along ``rotation @ d`` is the old one along d.

    They are float64, unless only signs change.
    """
    degree = math.isqrt(sh_rest.shape[1] + 1) - 1
    signs = np.diag(rotation)
    if np.array_equal(rotation, np.diag(signs)):  # half turns and mirrors: exact
        point = np.array([0.6, 0.48, 0.64])  # no harmonic is 0 there
        flips = np.rint(basis(signs * point, degree) / basis(point, degree))
        return np.asarray(sh_rest * flips[1:, None].astype(np.float32))
    rotated = np.empty_like(sh_rest, np.float64)
    # A rotation maps each band to itself. Its matrix is fitted to more directions than it has rows.
    some = _DIRECTIONS[:64]
    here, before = basis(some, degree), basis(some @ rotation, degree)
    for band in range(1, degree + 1):
        columns = slice(band * band, (band + 1) ** 2)
        matrix = np.linalg.lstsq(here[:, columns], before[:, columns], rcond=None)[0]
        stored = slice(columns.start - 1, columns.stop - 1)
        _map(matrix, sh_rest[:, stored], rotated[:, stored])
    return rotated


def grading(exposure: float, tint: Sequence[float], saturation: float) -> NDArray[np.float64]:
    """Matrix, (3, 3), that grades colours encoded for display (sRGB), as splats hold them.

    Parameters
    ----------
    exposure : stops; each doubles the light, by the power 2.2, and black stays black
    tint : (3,), factors of red, green and blue
    saturation : 0 is grey of the same luma, 1 leaves colours as they are; it comes before the tint
    """
    grey = np.outer(np.ones(3), _LUMA)
    saturated = saturation * np.eye(3) + (1.0 - saturation) * grey
    return np.asarray(2.0 ** (exposure / _GAMMA) * np.diag(tint) @ saturated)


def recolored(sh_dc: NDArray[Any], sh_rest: NDArray[Any], matrix: NDArray[Any]) -> Harmonics:
    """Coefficients, (N, 3) and (N, K, 3), of colours that are `matrix`, (3, 3), times the old ones.

    This is exact in all directions, but that `colors` are clipped later. Splats whose old or new
    coefficients are not finite, in the type of the old ones, keep theirs.
    """
    result = np.concatenate([sh_dc[:, None], sh_rest], axis=1)
    constant = (0.5 * matrix.sum(axis=1) - 0.5) / SH_C0  # black is -0.5 / SH_C0
    for rows in chunks(len(result), _CHUNK):
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):
            new = result[rows] @ matrix.T
            new[:, 0] += constant
            new = new.astype(result.dtype)
        good = np.isfinite(new).all(axis=(1, 2))
        result[rows][good] = new[good]
    return result[:, 0], result[:, 1:]


def encoded(sh_dc: NDArray[Any], sh_rest: NDArray[Any]) -> Harmonics:
    """Coefficients, (N, 3) and (N, K, 3) float64, in sRGB of those of linear colours.

    The constant is exact. The others are multiplied by the curve's slope there: to first order.
    """
    linear = 0.5 + SH_C0 * np.asarray(sh_dc, np.float64)
    bright = np.maximum(linear, 0.0031308)
    slope = np.where(linear > 0.0031308, 1.055 / 2.4 * bright ** (1.0 / 2.4 - 1.0), 12.92)
    return (srgb_of(linear) - 0.5) / SH_C0, sh_rest * slope[:, None]


def _map(matrix, coefficients, result):
    """Write a matrix, (B, B), times the coefficients of each splat and channel, (N, B, 3)."""
    for rows in chunks(len(coefficients), _CHUNK):
        planes = np.ascontiguousarray(coefficients[rows].transpose(2, 1, 0), np.float64)
        result[rows] = (matrix @ planes).transpose(2, 1, 0)


def stretched(sh_dc: NDArray[Any], sh_rest: NDArray[Any], linear: NDArray[Any]) -> Harmonics:
    """Coefficients, (N, 3) and (N, K, 3) float64, fitted to a non-uniform map.

    The colour along ``linear @ d`` approximates the old colour along d, by least squares over
    directions d: harmonics of the same degree cannot equal it. `linear`, (3, 3), is invertible.
    """
    degree = math.isqrt(sh_rest.shape[1] + 1) - 1
    before = _DIRECTIONS @ np.linalg.inv(linear).T
    before /= np.linalg.norm(before, axis=1, keepdims=True)
    matrix = np.linalg.lstsq(basis(_DIRECTIONS, degree), basis(before, degree), rcond=None)[0]
    result = np.concatenate([sh_dc[:, None], sh_rest], axis=1, dtype=np.float64)
    _map(matrix, result, result)
    return result[:, 0], result[:, 1:]
