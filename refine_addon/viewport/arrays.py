"""Arrays of splats for the 3D view: order, colours, textures. Without Blender.
Opacities and cuts are those of the reference implementation (`core.splats`)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.formats.format import pieces
from ..core.images import srgb_of
from ..core.spherical_harmonics import colors as colors_along
from ..core.splats import ALPHA_CUT, MODELS, Splats, drawable, opacity, rotation_matrices, scales

WIDTH = 4096  # Columns of a texture with one value for each splat, row by row
MOST = 1 << 24  # Splats drawn at most: their order is stored as float32, exact up to this
STAYS, GOES = 1, 2  # Protected, and removed by the user, as in `mesh.edit.FORCE`

MARKS = {STAYS: (0.0, 0.9, 0.8), GOES: (0.45, 0.0, 1.0)}
"""Turquoise and violet tints. They show on white and black, and differ from the heat map, from the
tint of the budget, and from `SELECTED`."""

TINT, TINT_SHARE = (1.0, 0.15, 0.0), 0.55  # Tint of splats that the budget removes, and its share
SELECTED, SELECTED_SHARE = (1.0, 0.1, 0.75), 0.6  # Tint of selected splats, and its share
SHARES = {"HEAT": 0.55, "GOES": 0.75}  # Share of `MARKS` in a mode, in others `SHARE`
SHARE = 0.35
_LARGEST_KEY = 65535.0
_LARGEST_HALF = 65504.0

_OKLAB_TO_LMS = np.array(
    [
        [1.0, 0.3963377774, 0.2158037573],
        [1.0, -0.1055613458, -0.0638541728],
        [1.0, -0.0894841775, -1.2914855480],
    ]
)
_LMS_TO_RGB = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)


@dataclass(frozen=True, eq=False)
class Packed:
    """The M drawable splats of a mesh, in its order and frame.
    `vertices`: (M,) int32 into the mesh; `covariances`: (M, 8), xx, xy, xz, yy, yz, zz, the number
    of the model among `MODELS`, 0; `harmonics`: (M, K, 3), the constant first."""

    vertices: NDArray[np.int32]
    means: NDArray[np.float32]
    covariances: NDArray[np.float32]
    opacities: NDArray[np.float32]
    harmonics: NDArray[np.float16]

    def __len__(self) -> int:
        return len(self.means)


class Marks(NamedTuple):
    """Marks of a mesh's splats: arrays with a value for each splat, or None."""

    ranks: NDArray[Any] | None = None
    going: NDArray[Any] | None = None
    forced: NDArray[Any] | None = None
    selected: NDArray[Any] | None = None
    hidden: NDArray[Any] | None = None


class Eye(NamedTuple):
    """Eye of a view in a mesh's frame: the depth of p is ``row[:3] @ p + row[3]``.
    `place`: centre of projection, (3,); in an orthographic view its direction."""

    row: NDArray[np.float64]
    place: NDArray[np.float64]
    perspective: bool


def pack(splats: Splats) -> Packed:
    """The drawable splats of a mesh, as `Packed`."""
    opacities = opacity(splats.opacity_logits).astype(np.float32)  # (N,)
    shown = drawable(splats) & (opacities >= ALPHA_CUT)
    vertices = np.flatnonzero(shown).astype(np.int32)
    covariances = np.zeros((len(vertices), 8), np.float32)
    covariances[:, 6] = MODELS.index(splats.model)
    harmonics = np.empty((len(vertices), splats.sh_rest.shape[1] + 1, 3), np.float16)
    rows, columns = np.triu_indices(3)
    for chunk in pieces(len(vertices)):
        part = splats.take(vertices[chunk])
        with np.errstate(under="ignore", over="ignore"):
            axes = rotation_matrices(part.quaternions)
            axes *= scales(part.log_scales)[:, None, :]
            matrices = axes @ axes.transpose(0, 2, 1)
            covariances[chunk, :6] = matrices[:, rows, columns]
        coefficients = np.concatenate([part.sh_dc[:, None], part.sh_rest], axis=1)
        harmonics[chunk] = np.clip(coefficients, -_LARGEST_HALF, _LARGEST_HALF)
    means = np.ascontiguousarray(splats.means[vertices], np.float32)
    return Packed(vertices, means, covariances, opacities[vertices], harmonics)


def most_important_first(packed: Packed, ranks: NDArray[Any] | None = None) -> NDArray[np.int32]:
    """Rows of `packed` by importance, (M,), so that the first few look most like all.
    By ranks of scores, else by opacity times summed variances, which grows with the drawn area."""
    if ranks is None:
        sizes = packed.covariances[:, 0] + packed.covariances[:, 3] + packed.covariances[:, 5]
        worth = packed.opacities * sizes
    else:
        worth = np.nan_to_num(ranks)
    return np.argsort(-worth, kind="stable").astype(np.int32)


def colors(packed: Packed, eye: Eye | None = None) -> NDArray[np.float32]:
    """Display-referred colours with opacity, (M, 4), seen from `eye`; without it, harmonics of
    degree 0 alone."""
    rgba = np.empty((len(packed), 4), np.float32)
    rgba[:, 3] = packed.opacities
    harmonics = packed.harmonics if eye else packed.harmonics[:, :1]
    for chunk in pieces(len(packed)):
        coefficients, means = harmonics[chunk].astype(np.float32), packed.means[chunk]
        directions = _directions(means, eye) if eye else means
        rgb = colors_along(directions, coefficients[:, 0], coefficients[:, 1:])
        rgba[chunk, :3] = np.clip(rgb, 0.0, _LARGEST_HALF)
    return rgba


def ramp() -> NDArray[np.float64]:
    """Heat map, dark blue (removed first) to yellow (removed last), (256, 3) sRGB in 0..1.
    Lightness rises evenly in OKLab (Ottosson 2020) from 0.25 to 0.93, readable without hue."""
    t = np.linspace(0.0, 1.0, 256)
    lightness = 0.25 + 0.68 * t
    hue = np.radians(265.0 + 200.0 * t)
    chroma = 0.11 + 0.07 * np.sin(np.pi * t)
    lab = np.stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1)
    linear = np.clip((lab @ _OKLAB_TO_LMS.T) ** 3 @ _LMS_TO_RGB.T, 0.0, 1.0)
    return srgb_of(linear)


def heat(packed: Packed, ranks: NDArray[Any], ramp: NDArray[np.float64]) -> NDArray[np.float32]:
    """Colours of ranks in 0..1 with opacity, (M, 4); `ramp`: (C, 3) colours from rank 0 to 1."""
    index = np.nan_to_num(ranks) * (len(ramp) - 1) + 0.5
    rgba = np.empty((len(packed), 4), np.float32)
    rgba[:, :3] = ramp[np.clip(index, 0, len(ramp) - 1).astype(np.int64)]
    rgba[:, 3] = packed.opacities
    return rgba


def tinted(
    rgba: NDArray[np.float32], tint: tuple[float, float, float], share: float
) -> NDArray[np.float32]:
    """Colours, (M, 4), of which `share` is the tint."""
    mixed = rgba.copy()
    mixed[:, :3] = (1.0 - share) * np.clip(rgba[:, :3], 0.0, 1.0) + share * np.array(tint)
    return mixed


def colored(packed: Packed, eye: Eye | None, mode: str, marks: Marks) -> NDArray[np.float32]:
    """Colours in a mode with opacity, (M, 4); see `colors`. `marks`: of the M splats."""
    heated = mode == "HEAT" and marks.ranks is not None
    rgba = heat(packed, marks.ranks, ramp()) if heated else colors(packed, eye)
    if mode == "GOES":
        goes, forced = tinted(rgba, TINT, TINT_SHARE), marks.forced
        rgba = goes if forced is None else np.where((forced == GOES)[:, None], rgba, goes)
    for mark, tint in MARKS.items() if marks.forced is not None else ():
        rows = marks.forced == mark
        rgba[rows] = tinted(rgba[rows], tint, SHARES.get(mode, SHARE))
    return rgba


def in_front(
    means: NDArray[np.float32], eye: Eye, near: float
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Rows of the means, (M, 3), beyond the near plane, (V,), and their depths, (V,)."""
    with np.errstate(over="ignore", invalid="ignore"):
        depths = means @ eye.row[:3].astype(np.float32) + np.float32(eye.row[3])
    shown = np.flatnonzero((depths > near) & (depths < np.inf))
    return shown, depths[shown]


def farthest_first(depths: NDArray[np.float32], *, perspective: bool) -> NDArray[np.int64]:
    """Indices that sort finite depths, (V,), largest first; nearly equal ones stay in order.
    Depths (in perspective their logarithms, in steps of about 1e-4) are rounded to 16 bits, since
    NumPy's radix sort of these is 8 times as fast as its sort of float32."""
    if not len(depths):
        return np.empty(0, np.int64)
    values = np.log(depths) if perspective else depths
    low, high = values.min(), values.max()
    extent = high - low
    scale = np.float32(_LARGEST_KEY / extent if extent > 0.0 else 0.0)
    keys = ((high - values) * scale).astype(np.uint16)
    return np.argsort(keys, kind="stable")


def as_texture(values: NDArray[Any]) -> NDArray[np.float32]:
    """Values, (M,) or (M, C), as rows of `WIDTH` texels, (R, WIDTH * C) float32.
    The last row is padded with zeros; there is at least one."""
    columns = 1 if values.ndim == 1 else values.shape[1]
    rows = max(1, math.ceil(len(values) / WIDTH))
    texels = np.zeros((rows, WIDTH * columns), np.float32)
    texels.reshape(-1)[: values.size] = values.reshape(-1)
    return texels


def first_of_each(counts: list[int], most: int = MOST) -> list[int]:
    """Splats drawn of each object if at most `most` are drawn in all: equal shares."""
    total = max(sum(counts), most)
    return [count * most // total for count in counts]


def _directions(means: NDArray[np.float32], eye: Eye) -> NDArray[np.float32]:
    if not eye.perspective:
        toward = eye.place / np.linalg.norm(eye.place)
        return np.broadcast_to(toward.astype(np.float32), means.shape)
    away = means - eye.place.astype(np.float32)
    lengths = np.linalg.norm(away, axis=1, keepdims=True)
    away /= np.where(lengths > 0.0, lengths, np.float32(1.0))
    return away
