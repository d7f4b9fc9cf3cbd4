"""3D Gaussian splats as 3DGS files store them, and their activation, which is done only here.

Constants are those of `diff-gaussian-rasterization` (Kerbl et al. 2023), except for the near plane.
Splats are trained for one way of drawing, their *model*, with the names of splat-transform and SOG.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from .errors import RefineError
from .execute import chunks, run_all

Model = Literal["default", "antialiased", "2dgs"]
"""How splats are drawn. ``default``: the footprint is widened by `LOW_PASS`, its opacity stays
(Kerbl et al. 2023). ``antialiased``: opacity falls by ``sqrt(det C / det(C + LOW_PASS I))``, C the
covariance in the image (Yu et al. 2024, "Mip-Splatting"). ``2dgs``: a flat disc without third
scale, hit where the ray meets its plane (Huang et al. 2024)."""

MODELS: tuple[Model, ...] = get_args(Model)  # the first is that of files that do not say
LOW_PASS = 0.3  # variance added to a footprint along both axes so that it covers a pixel, px^2

DISC_LOW_PASS = 0.5
"""Variance of a Gaussian around the centre of a disc, px^2. A pixel gets the larger alpha of both:
no disc is thinner (Huang et al. 2024, Eq. 11, sigma = sqrt(2) / 2)."""

ALPHA_MAX = 0.99  # largest alpha of one splat at a pixel: none hides everything behind it
ALPHA_CUT = 1.0 / 255.0  # least alpha that is drawn; a splat's footprint ends there

NEAR_RELATIVE = 0.01
"""Near plane over the size of the scene, for views without one. Unlike the 0.2 or 0.01 of renderers
it does not depend on the scene's unit."""

SH_C0 = 0.28209479177387814  # value of the constant spherical harmonic, 1 / (2 sqrt(pi))
_CHECKED = 1 << 15  # rows checked at a time by `drawable`

ARRAYS = ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest")
"""Attributes of `Splats` with a row for each splat."""


@dataclass(frozen=True, eq=False)
class Splats:
    """N splats with the values a 3DGS file stores: log scales, logit opacities, raw harmonics.

    The arrays are never changed. They may be read-only strided views of a memory-mapped file in any
    byte order: convert them one chunk at a time.

    Attributes
    ----------
    means : (N, 3) floating, centres in the frame and unit of the file or, transformed, of the world
    log_scales : (N, 3) floating, logarithm of the standard deviation along each axis of the splat
    quaternions : (N, 4) floating, w x y z from the splat's axes to the frame, of any length
    opacity_logits : (N,) floating
    sh_dc : (N, 3) floating, constant harmonic of red, green and blue
    sh_rest : (N, K, 3) floating, the other harmonics, K = (degree + 1)^2 - 1
    model : Model; for "2dgs" the third scale is `LOG_ZERO`, whatever a file holds (`with_model`)
    """

    means: NDArray[Any]
    log_scales: NDArray[Any]
    quaternions: NDArray[Any]
    opacity_logits: NDArray[Any]
    sh_dc: NDArray[Any]
    sh_rest: NDArray[Any]
    model: Model = "default"

    def __len__(self) -> int:
        return len(self.means)

    @property
    def sh_degree(self) -> int:
        """Highest band of spherical harmonics, 0 to 4."""
        return math.isqrt(self.sh_rest.shape[1] + 1) - 1

    def up_to_degree(self, degree: int) -> Splats:
        """Splats without harmonics above `degree`; the arrays are views."""
        return replace(self, sh_rest=self.sh_rest[:, : above_constant(degree)])

    def take(self, index: NDArray[Any] | slice) -> Splats:
        """Splats at `index` (a mask, integers or a slice), in that order."""
        return replace(self, **{name: getattr(self, name)[index] for name in ARRAYS})

    def by_columns(self) -> Splats:
        """Splats with contiguous columns, faster to compute with; `sh_rest` stays as it is."""
        columns: dict[str, Any] = {
            name: np.asfortranarray(getattr(self, name)) for name in ARRAYS if name != "sh_rest"
        }
        return replace(self, **columns)


def with_model(splats: Splats, model: Model) -> Splats:
    """Splats with another model; "2dgs" sets the third scale to `LOG_ZERO`."""
    if model != "2dgs":
        return replace(splats, model=model)
    flat = np.array(splats.log_scales)
    flat[:, 2] = LOG_ZERO
    return replace(splats, log_scales=flat, model=model)


def joined(parts: Sequence[Splats]) -> Splats:
    """Splats joined in order, of the highest degree; `RefineError` if their models differ."""
    if len(parts) == 1:
        return parts[0]
    models = dict.fromkeys(part.model for part in parts)
    if len(models) > 1:
        raise RefineError(
            f"splats of different models ({', '.join(models)}), expected one: say how all are drawn"
        )
    most = max(part.sh_rest.shape[1] for part in parts)
    columns: dict[str, Any] = {name: [getattr(part, name) for part in parts] for name in ARRAYS}
    columns["sh_rest"] = [
        np.pad(rest, ((0, 0), (0, most - rest.shape[1]), (0, 0))) for rest in columns["sh_rest"]
    ]
    with np.errstate(invalid="ignore"):  # signalling NaN converted to float64
        columns = {name: np.concatenate(arrays) for name, arrays in columns.items()}
    return replace(parts[0], **columns)


def assign(target: Splats, source: Splats) -> None:
    """Set the arrays of `target`, new ones that are being filled, to those of `source`."""
    for name in ARRAYS:
        getattr(target, name)[:] = getattr(source, name)


def above_constant(degree: int) -> int:
    """Number of harmonics of a channel above the constant one."""
    return (degree + 1) ** 2 - 1


def opacity(logits: NDArray[Any]) -> NDArray[np.float64]:
    """Opacities (...) float64 in 0..1 of any logits, ``1 / (1 + exp(-logit))``; NaN stays."""
    logits = np.asarray(logits, np.float64)
    # The limit avoids underflow: exp(-700) is 1e-304.
    decay = np.exp(-np.minimum(np.abs(logits), 700.0))
    return np.asarray(np.where(logits >= 0.0, 1.0, decay) / (1.0 + decay))


OPACITY_MARGIN = 1e-6
"""Least distance from 0 and 1, whose logits are infinite, of opacities from formats that round: a
4,000th of a step of 8 bits."""

SINGLE_MARGIN = 2.0**-26  # least distance from 1 of opacities read from float32: half its step

LOG_ZERO = -104.0
"""Log scale and logit of 0 in float32: ``exp(-104)`` rounds to 0, ``exp(-103)`` does not."""


def opacity_logits(
    opacities: NDArray[Any], least: float = OPACITY_MARGIN, most: float = 1.0 - OPACITY_MARGIN
) -> NDArray[np.float64]:
    """Inverse of `opacity`, (...) float64, values clipped to ``least..most``; NaN stays."""
    inside = np.clip(np.asarray(opacities, np.float64), least, most)
    return np.asarray(np.log(inside) - np.log1p(-inside))


def single_logits(opacities: NDArray[Any]) -> NDArray[np.float64]:
    """Logits (...) float64 of float32 opacities; `opacity`, rounded to float32, inverts it."""
    return opacity_logits(opacities, math.exp(LOG_ZERO), 1.0 - SINGLE_MARGIN)


def scales(log_scales: NDArray[Any]) -> NDArray[np.float64]:
    """Standard deviations (...) float64 of log scales; 0 or infinite beyond its range."""
    with np.errstate(over="ignore", under="ignore"):
        return np.asarray(np.exp(np.asarray(log_scales, np.float64)))


def single_log_scales(scales: NDArray[Any]) -> NDArray[np.float64]:
    """Log scales (...) float64 of the absolute values of float32 scales; of 0 `LOG_ZERO`."""
    sizes = np.abs(np.asarray(scales, np.float64))
    return np.asarray(np.log(np.maximum(sizes, math.exp(LOG_ZERO))))


def base_color(sh_dc: NDArray[Any]) -> NDArray[np.float64]:
    """Colour from all directions, (..., 3) float64 in 0..1, ``clip(SH_C0 * f_dc + 0.5, 0, 1)``."""
    return np.clip(SH_C0 * np.asarray(sh_dc, np.float64) + 0.5, 0.0, 1.0)


def unit_quaternions(quaternions: NDArray[Any]) -> NDArray[np.float64]:
    """Quaternions w x y z of length 1, (..., 4) float64; the identity for 0 and non-finite ones."""
    q = np.asarray(quaternions, np.float64)
    largest = np.max(np.abs(q), axis=-1, keepdims=True)
    usable = np.isfinite(largest) & (largest > 0.0)
    # Divide by the largest component first: squares of 1e200 or 1e-200 would leave the range.
    with np.errstate(under="ignore"):  # components far smaller than the largest become 0
        q = np.where(usable, q, [1.0, 0.0, 0.0, 0.0]) / np.where(usable, largest, 1.0)
        return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def single_unit_quaternions(quaternions: NDArray[Any]) -> NDArray[np.float32]:
    """Unit quaternions, (N, 4) float32, as Blender's: zero is the identity, unit ones keep bits."""
    with np.errstate(all="ignore"):  # doubles beyond float32, and what is not finite
        q = np.array(quaternions, np.float32)
        wide = q.astype(np.float64)
        off = np.abs(np.einsum("ij,ij->i", wide, wide) - 1.0) > _UNIT_TOLERANCE
    off &= np.isfinite(q).all(axis=1)
    q[off] = unit_quaternions(q[off])
    return q


def rotation_matrices(quaternions: NDArray[Any]) -> NDArray[np.float64]:
    """Rotations (..., 3, 3) float64 of quaternions w x y z; columns are the splat's axes."""
    w, x, y, z = np.moveaxis(unit_quaternions(quaternions), -1, 0)
    with np.errstate(under="ignore"):  # products of components near 0
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def drawable(splats: Splats) -> NDArray[np.bool_]:
    """Which splats a renderer can draw, (N,) bool.

    Its numbers are finite, but a logit may be infinite and a log scale minus infinite. In float32
    its opacity and its largest scale are not 0, and nothing overflows.
    """
    good = np.empty(len(splats), np.bool_)

    def fill(piece: slice) -> None:
        some = splats.take(piece)
        s0, s1, s2 = some.log_scales.T
        largest = np.maximum(np.maximum(s0, s1), s2)
        # Comparisons with NaN are False and np.maximum returns NaN, so every line also rejects NaN.
        here = some.opacity_logits >= _LOG_SMALLEST
        here &= (largest <= _LOG_LARGEST) & (largest >= _LOG_SMALLEST)
        for axis in range(3):
            here &= np.abs(some.means[:, axis]) <= _LARGEST
        for values in (some.quaternions, some.sh_dc, some.sh_rest):
            finite = np.isfinite(values)
            if not finite.all():  # rare; testing each row costs ten times as much
                here &= finite.reshape(len(here), -1).all(axis=1)
        good[piece] = here

    run_all(fill, chunks(len(splats), _CHECKED))
    return good


def refuse_undrawable(good: int, total: int) -> None:
    """Raise `RefineError` if none of `total` splats can be drawn."""
    if not good:
        raise RefineError(
            f"none of the {total} splats can be drawn: each is transparent or not finite"
        )


_UNIT_TOLERANCE = 5e-7  # of the squared length: four squares, each rounded to float32
# Of type float32: with a Python float of this size, NumPy 1 would convert the column to float64,
# which takes time and warns about signalling NaN.
_LARGEST = np.finfo(np.float32).max
_LOG_LARGEST = float(np.log(np.float64(_LARGEST)))
_LOG_SMALLEST = float(np.log(np.float64(np.finfo(np.float32).smallest_subnormal)))


def among_all(values: NDArray[Any], rest: NDArray[np.bool_]) -> NDArray[Any]:
    """Values, (N,), for all splats from `values`, (n,), of those in `rest`, (N,) bool; else 0."""
    of_all = np.zeros(len(rest), values.dtype)
    of_all[rest] = values
    return of_all
