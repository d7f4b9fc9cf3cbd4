"""Whether splats, and the attributes of a splat, act on the pictures independently.

REFINE scores each splat and each attribute alone, as if the Hessian of the pictures' squared error
were block diagonal. Measured here: the Gauss-Newton Hessian ``H = sum of J' J`` over pixels,
channels and views, J exact (see `jacobians`), of splats drawn at random from those seen, each with
its nearest neighbours. The diagonal energy ratio is the squared Frobenius norm of the blocks on the
diagonal over that of all of H; 1 means independent.

- primitives: blocks of one splat (14 parameters: mean, log scales, quaternion, opacity's logit,
  constant colour) in the Hessian of it and its neighbours;
- attributes: blocks geometry (10), opacity (1) and colour (3) in the Hessian of one splat;
- removals: of the matrix of inner products of what removing each splat alone would do to the
  pictures, its diagonal: what adding up single removal errors relies on.

Since a Hessian's entries carry the units of the parameters, the first two are given twice: as they
are, and with every parameter in the unit that makes its own diagonal entry 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from refine_addon.core.splats import SH_C0, Splats, opacity, rotation_matrices
from refine_addon.core.views import ViewSet

from ..renderer.compositing import bins_of
from ..renderer.footprints import RED, Camera, Gaussians, camera_of, footprints_of, gaussians_of
from ..renderer.jacobians import (
    CONTRAST,
    E_X,
    E_Y,
    MOVES,
    SHAPE,
    WEIGHT,
    color_gradient,
    hits_of,
    image_rows,
    shape_gradient,
)
from ..renderer.rasterizer import accumulate_statistics

PARAMETERS = 14
MEAN, SCALE, ROTATION, LOGIT, COLOR = 0, 3, 6, 10, 11
_PIXELS = 10_000  # of a dense Jacobian at once: about 100 MB
ATTRIBUTES = (slice(0, 10), slice(10, 11), slice(11, 14))


@dataclass(frozen=True)
class Energies:
    """Mean diagonal energy ratios over the groups.

    Attributes
    ----------
    groups, neighbours, views : int
        What they were measured on.
    primitives, primitives_unitless, attributes, attributes_unitless, removals : float
    """

    groups: int
    neighbours: int
    views: int
    primitives: float
    primitives_unitless: float
    attributes: float
    attributes_unitless: float
    removals: float


class _Scene(NamedTuple):
    """What stays the same over the views."""

    gaussians: Gaussians
    axes: NDArray[np.float64]
    turns: NDArray[np.float64]
    opacities: NDArray[np.float64]


def measure(
    splats: Splats, views: ViewSet, *, groups: int = 100, neighbours: int = 30, most_views: int = 8
) -> Energies:
    """Measure all ratios on `groups` random splats that are seen, each with its neighbours."""
    used = views.spread(most_views)
    scene = _prepare(splats)
    drawn = accumulate_statistics(splats, used).hits > 0
    members = _groups(splats, scene.opacities > 1.0 / 255.0, drawn, (groups, neighbours))
    size = members.shape[1]
    hessians = np.zeros((len(members), size * PARAMETERS, size * PARAMETERS))
    removals = np.zeros((len(members), size, size))
    for view in used:
        rows = rows_of(scene, camera_of(view), np.unique(members))
        for k, group in enumerate(members):
            for jacobian, changes in _dense(rows, group):
                hessians[k] += jacobian.T @ jacobian
                removals[k] += changes.T @ changes
    seen = [k for k in range(len(members)) if hessians[k, :PARAMETERS, :PARAMETERS].any()]
    unitless = [_unitless(hessians[k]) for k in seen]
    return Energies(
        len(seen),
        size - 1,
        len(used),
        _mean([block_energy(hessians[k], PARAMETERS) for k in seen]),
        _mean([block_energy(matrix, PARAMETERS) for matrix in unitless]),
        _mean([attribute_energy(hessians[k]) for k in seen]),
        _mean([attribute_energy(matrix) for matrix in unitless]),
        _mean([block_energy(removals[k], 1) for k in seen]),
    )


def block_energy(matrix: NDArray[np.float64], size: int) -> float:
    """Return the energy in the diagonal blocks of a size over that of all, 0 to 1."""
    starts = range(0, len(matrix), size)
    inside = sum(float(np.sum(matrix[s : s + size, s : s + size] ** 2)) for s in starts)
    return inside / float(np.sum(matrix**2))


def attribute_energy(matrix: NDArray[np.float64]) -> float:
    """Return the same of the attributes' blocks in the first splat's Hessian."""
    own = matrix[:PARAMETERS, :PARAMETERS]
    return sum(float(np.sum(own[a, a] ** 2)) for a in ATTRIBUTES) / float(np.sum(own**2))


def _unitless(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale rows and columns so that the diagonal is 1, or 0 where nothing was seen."""
    diagonal = np.diag(matrix)
    scale = np.zeros(len(diagonal))
    # What is only rounding beside the rest is nothing: a quaternion's length has no effect.
    np.divide(1.0, np.sqrt(np.abs(diagonal)), out=scale, where=diagonal > 1e-14 * diagonal.max())
    return matrix * scale[:, None] * scale[None, :]


def _mean(values: list[float]) -> float:
    return float(np.mean(values)) if values else float("nan")


def _groups(
    splats: Splats,
    visible: NDArray[np.bool_],
    drawn: NDArray[np.bool_],
    sizes: tuple[int, int],
) -> NDArray[np.int64]:
    """Draw splats; return each with its visible neighbours, (count, 1 + neighbours)."""
    count, neighbours = sizes
    usable, hit = np.flatnonzero(visible), np.flatnonzero(visible & drawn)
    chosen = np.random.default_rng(0).choice(hit, min(count, len(hit)), replace=False)
    means = np.asarray(splats.means, np.float64)[usable]
    rows = []
    for index in chosen:
        distance = np.sum((means - splats.means[index]) ** 2, axis=1)
        rows.append(usable[np.argsort(distance, kind="stable")[: neighbours + 1]])
    return np.array(rows)


def _prepare(splats: Splats) -> _Scene:
    scene = gaussians_of(splats)
    good = scene.opacities > 0.0
    logs = np.where(good[:, None], splats.log_scales, 0.0).astype(np.float64)
    scales = np.exp(logs)[:, None, :]
    quaternions = np.where(good[:, None], splats.quaternions, 1.0).astype(np.float64)
    axes = rotation_matrices(quaternions) * scales
    turns = _rotation_gradient(quaternions) * scales[:, None]
    return _Scene(scene, axes, turns, opacity(np.where(good, splats.opacity_logits, 0.0)))


def _rotation_gradient(quaternions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Differentiate the rotation matrices by w, x, y, z, (N, 4, 3, 3), by an imaginary step."""
    step, parts = 1e-30, []
    for k in range(4):
        moved = quaternions.astype(np.complex128)
        moved[:, k] += 1j * step
        w, x, y, z = (moved / np.sqrt(np.sum(moved * moved, axis=1, keepdims=True))).T
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        parts.append(np.moveaxis(np.array(rows), -1, 0).imag / step)
    return np.stack(parts, axis=1)


class Rows(NamedTuple):
    """The hits of some splats in one view, sorted by splat, and how they move.

    Attributes
    ----------
    splats, pixels : (hits,) int64
    values : (hits, 7) float64
        See `jacobians.Hits`.
    wanted : (M,) int64
        The splats.
    shape, color : (M, 6, 14), (M, 3, 14) float64
        See `gradients`.
    """

    splats: NDArray[np.int64]
    pixels: NDArray[np.int64]
    values: NDArray[np.float64]
    wanted: NDArray[np.int64]
    shape: NDArray[np.float64]
    color: NDArray[np.float64]

    def jacobian(self, hits: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the Jacobian of some hits, (hits, 3, 14), by channel and parameter."""
        value, place = self.values[hits], np.searchsorted(self.wanted, self.splats[hits])
        x, y = value[:, E_X], value[:, E_Y]
        w = np.stack([x, y, 0.5 * x * x, x * y, 0.5 * y * y, np.ones_like(x)], axis=1)
        along = np.einsum("hs,hsp->hp", w * value[:, MOVES, None], self.shape[place])
        result = value[:, CONTRAST : CONTRAST + 3, None] * along[:, None, :]
        result += value[:, WEIGHT, None, None] * self.color[place]
        return result


def rows_of(
    scene: _Scene, camera: Camera, wanted: NDArray[np.int64], near: float = 0.2,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Rows:  # fmt: skip
    """Find the hits of the splats `wanted`, which are sorted."""
    footprints = footprints_of(scene.gaussians, camera, near)
    bins = bins_of(footprints.boxes, camera.width, camera.height)
    marked = np.isin(footprints.index, wanted)
    owners, pixels, values = [], [], []
    for tile in range(len(bins.starts) - 1):
        size = (camera.width, camera.height)
        hits = hits_of(tile, bins, footprints, size, np.array(background))
        entries = bins.entries[bins.starts[tile] : bins.starts[tile + 1]][hits.owners]
        mine = marked[entries]
        owners.append(entries[mine])
        pixels.append(hits.pixels[mine])
        values.append(hits.values[mine])
    splat = footprints.index[np.concatenate(owners)]
    order = np.argsort(splat, kind="stable")
    pixel = np.concatenate(pixels)[order].astype(np.int64)
    colors = footprints.table[:, RED:]
    shape, color = gradients(scene, camera, wanted, footprints.index, colors)
    return Rows(splat[order], pixel, np.concatenate(values)[order], wanted, shape, color)


def gradients(
    scene: _Scene,
    camera: Camera,
    wanted: NDArray[np.int64],
    shown: NDArray[np.int64],
    colors: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return d shape / d parameters, (M, 6, 14), and d colour / d parameters, (M, 3, 14)."""
    shape = np.zeros((len(wanted), SHAPE + 1, PARAMETERS))
    color = np.zeros((len(wanted), 3, PARAMETERS))
    visible = np.flatnonzero(np.isin(wanted, shown))
    _fill(scene, camera, wanted, visible, (shape, color))
    shape[:, SHAPE, LOGIT] = 1.0 - scene.opacities[wanted]
    by_splat = np.zeros((len(scene.opacities), 3))
    by_splat[shown] = colors
    positive = by_splat[wanted] > 0.0
    color[:, np.arange(3), COLOR + np.arange(3)] = SH_C0 * positive
    return shape, color


@numba.njit(cache=True)
def _fill(
    scene: _Scene,
    camera: Camera,
    wanted: NDArray[np.int64],
    visible: NDArray[np.int64],
    out: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> None:
    """Fill the columns of mean, scale and rotation."""
    shape, color = out
    for k in visible:
        i = wanted[k]
        mean, axes = scene.gaussians.means[i], scene.axes[i]
        shape_gradient(mean, axes, camera, shape[k, :SHAPE, :ROTATION])
        color_gradient(mean, camera, scene.gaussians.harmonics[i], color[k, :, :SCALE])
        p, q, _, _ = image_rows(mean, camera)
        for turn in range(4):
            moved = scene.turns[i, turn]
            for axis in range(3):
                pa, qa = np.sum(p * axes[:, axis]), np.sum(q * axes[:, axis])
                dp, dq = np.sum(p * moved[:, axis]), np.sum(q * moved[:, axis])
                shape[k, 2, ROTATION + turn] += 2.0 * pa * dp
                shape[k, 3, ROTATION + turn] += pa * dq + qa * dp
                shape[k, 4, ROTATION + turn] += 2.0 * qa * dq


def _dense(
    rows: Rows, group: NDArray[np.int64]
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Yield a group's Jacobian, (3 pixels, 14 members), and changes, (3 pixels, members)."""
    starts = np.searchsorted(rows.splats, group)
    ends = np.searchsorted(rows.splats, group, side="right")
    picked = np.concatenate([np.arange(s, e) for s, e in zip(starts, ends, strict=True)])
    column = np.repeat(np.arange(len(group)), ends - starts)
    pixels, place = np.unique(rows.pixels[picked], return_inverse=True)
    for first in range(0, len(pixels), _PIXELS):
        here = (place >= first) & (place < first + _PIXELS)
        hits, row, member = picked[here], place[here] - first, column[here]
        height = min(_PIXELS, len(pixels) - first)
        jacobian = np.zeros((height, 3, len(group), PARAMETERS))
        changes = np.zeros((height, 3, len(group)))
        jacobian[row, :, member] = rows.jacobian(hits)
        changes[row, :, member] = rows.values[hits, CONTRAST : CONTRAST + 3]
        yield jacobian.reshape(3 * height, -1), changes.reshape(3 * height, -1)
