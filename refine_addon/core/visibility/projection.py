"""The footprints of splats in a view: depth, centre and principal axes, in pixels."""

from __future__ import annotations

import itertools
import secrets
import shutil
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..execute import Progress, checkpoint, chunks, in_file, part, report, run, run_all, silent
from ..mapped import folder_of, write
from ..splats import (
    ALPHA_CUT,
    DISC_LOW_PASS,
    LOW_PASS,
    NEAR_RELATIVE,
    SH_C0,
    Model,
    Splats,
    drawable,
    opacity,
    rotation_matrices,
)
from ..views import View, ViewSet
from . import frustum
from .scene import Scene, scene_of, spatial_order, splat_fingerprint

FloatT = TypeVar("FloatT", np.float32, np.float64)

CUT_SIGMAS = 3.3
"""Standard deviations to which a footprint reaches: alpha = 1 falls to `ALPHA_CUT` at 3.33."""

BRIGHTEST = 16.0
"""Largest colour, white being 1: others are clipped, to keep sums finite."""

LOG_SCALE_RANGE = (-16.0, 5.0)
"""Logarithms of scales over the scene's size are clipped to it: beyond, float32 would overflow."""

CHUNK = 1 << 16
"""Gaussians of a box in files, 3.7 MB; a multiple of those projected at a time."""

_CHUNK = 1 << 14
_FARTHEST = 1e6  # scene sizes; splats farther from the middle count as in no view
_LARGEST_VARIANCE = 1e12  # px^2; a footprint a million pixels wide is flat over any image
_FARTHEST_VIEW = 1e18  # scene sizes; a view farther away sees the scene as one point
_LARGEST_LENS = 1e9  # px; beyond this or `_FARTHEST_VIEW` float32 would overflow
_NEAREST = 1e-5  # scene sizes; nearer footprints could overflow float32, and no renderer draws them
_NO_END = 1e30  # scene sizes; farther than any splat, and still in float32's range
_SLACK = 1e-4  # of a coordinate; far more than rounding moves a mean by
_BEYOND = 0.15  # of the image's size; farther outside, the projection is linearised at this edge
_THINNEST_DISC = 1e-3  # px; seen from the edge a disc is a line, which covers no pixel's centre
_EDGE_ON = 1e-6  # cosine; a plane seen from the edge has no depths
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, eq=False)
class Gaussians:
    """The M splats that can contribute to a picture, by `spatial_order`.

    Lengths are scene sizes, in the scene's frame. In files, means, covariances and normals are (C,
    k, CHUNK) instead of (k, M): a view reads the boxes that it may show.
    """

    index: NDArray[np.int64]  # (M,), rows of the splats
    means: NDArray[np.float32]  # (3, M)
    covariances: NDArray[np.float32]  # (6, M): xx, xy, xz, yy, yz, zz
    largest: NDArray[np.float32]  # (M,), longest standard deviation
    alphas: NDArray[np.float32]  # (M,), 0..1
    colors: NDArray[np.float32]  # (M, 3), of the constant of the harmonics, >= 0
    normals: NDArray[np.float32] | None = None  # (3, M), unit normals of discs
    model: Model = "default"
    boxes: NDArray[np.float32] | None = None  # (C, 7), in files, see `boxes_touch`

    def __len__(self) -> int:
        return len(self.index)

    def parts(self, scene: Scene, view: View, window: View) -> Iterator[tuple[int, Gaussians]]:
        """Yield first row, and Gaussians in memory, of parts that may reach into a window."""
        if self.boxes is None:
            yield 0, self
            return
        size = self.means.shape[2]
        for number in np.flatnonzero(boxes_touch(self.boxes, scene, view, window)).tolist():
            rows = slice(number * size, (number + 1) * size)
            largest = self.largest[rows]
            # What is not projected stays in its file.
            arrays: dict[str, Any] = {
                name: None if (values := getattr(self, name)) is None
                else values[number][:, : len(largest)]
                for name in ("means", "covariances", "normals")
            }  # fmt: skip
            yield rows.start, replace(
                self, index=np.arange(len(largest)), largest=largest, alphas=self.alphas[rows],
                boxes=None, **arrays,
            )  # fmt: skip

    def most(self, scene: Scene, view: View, window: View) -> int:
        """Number of Gaussians in `parts`, or a few more, without reading them."""
        if self.boxes is None:
            return len(self)
        touched = boxes_touch(self.boxes, scene, view, window)
        return self.means.shape[2] * int(np.count_nonzero(touched))

    def take(self, keep: NDArray[Any]) -> Gaussians:
        """Gaussians at `keep`, a mask or rows."""
        return Gaussians(
            self.index[keep], self.means[:, keep], self.covariances[:, keep], self.largest[keep],
            self.alphas[keep], self.colors[keep],
            None if self.normals is None else self.normals[:, keep], self.model,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Footprints:
    """The n splats that may reach into an image, front to back; lengths in pixels."""

    index: NDArray[np.int64]  # (n,), rows of the `Gaussians`
    centers: NDArray[np.float32]  # (2, n), column and row
    major: NDArray[np.float32]  # (2, n), a standard deviation long; for discs see `disc_axes`
    minor: NDArray[np.float32]  # (2, n)
    sigmas: NDArray[np.float32]  # (2, n), lengths of both
    inside: NDArray[np.bool_]  # (n,), whether the centre lies in the frustum
    alphas: NDArray[np.float32]  # (n,), at the centre
    discs: NDArray[np.float32] | None = None  # (7, n), for exact hits, see `_discs`

    def take(self, rows: NDArray[np.int64]) -> Footprints:
        """Some footprints, in that order."""
        return self._each(lambda values: np.take(values, rows, axis=-1))

    def part(self, piece: slice) -> Footprints:
        """Some footprints, not copied."""
        return self._each(lambda values: values[..., piece])

    def _each(self, change: Callable[[Any], Any]) -> Footprints:
        changed: dict[str, Any] = {
            name: None if values is None else change(values) for name, values in vars(self).items()
        }
        return Footprints(**changed)


def prepare(
    splats: Splats,
    views: ViewSet,
    scene: Scene | None = None,
    *,
    progress: Progress = silent,
) -> tuple[Gaussians, Scene, NDArray[np.bool_]]:
    """Gaussians, in the frame of a scene, of drawable splats more opaque than `ALPHA_CUT`.

    Also the scene, by default that of splats and views, and which splats are drawable, (N,).
    """
    good, opaque = np.empty((2, len(splats)), np.bool_)

    def classify(piece):
        chunk = splats.take(piece)
        good[piece] = drawable(chunk)
        logits = np.where(good[piece], chunk.opacity_logits, -np.inf)
        opaque[piece] = opacity(logits) > ALPHA_CUT

    pieces, earlier = chunks(len(splats), 4 * _CHUNK), part(progress, 0.0, 0.4)
    run_all(classify, pieces, progress=earlier, what="reading")
    scene = scene or scene_of(splats.means, good, views)
    report(progress, 0.4, "reading")
    index = np.flatnonzero(opaque)
    positions = scene.positions(splats.means, index)
    close = np.max(np.abs(positions), axis=1, initial=0.0) <= _FARTHEST
    index, positions = index[close], positions[close]
    report(progress, 0.4, "reading")
    order = spatial_order(positions, lambda rows: splat_fingerprint(splats, index[rows]))
    make = _activate if folder_of(splats) is None or not len(order) else _activate_on_disk
    later = part(progress, 0.4, 1.0)
    return make(splats, index[order], positions[order], scene, later), scene, good


def _activate_on_disk(splats, index, positions, scene, progress):
    """Gaussians in files beside those of the splats; the files go when these Gaussians do."""
    bare = splats.up_to_degree(0)

    def columns(piece):
        part = _activate(bare, index[piece], positions[piece], scene, silent)
        low, high = part.means.min(axis=1), part.means.max(axis=1)
        arrays = {name: getattr(part, name) for name in ("index", "largest", "alphas", "colors")}
        arrays["boxes"] = np.concatenate([low, high, [part.largest.max()]])[None]
        for name in ("means", "covariances", "normals"):
            if (values := getattr(part, name)) is not None:
                arrays[name] = np.zeros((1, len(values), CHUNK), np.float32)
                arrays[name][0, :, : len(part)] = values
        return arrays

    parts = run(columns, chunks(len(index), CHUNK), progress=progress, what="reading")
    folder = folder_of(splats) / f"gaussians-{secrets.token_hex(4)}"  # type: ignore[operator]
    arrays = write(folder, parts)
    arrays["boxes"] = arrays["boxes"][...]
    gaussians = Gaussians(**arrays, model=splats.model)
    weakref.finalize(gaussians, shutil.rmtree, folder, ignore_errors=True)
    return gaussians


def _activate(splats, index, positions, scene, progress):
    """Splats at `index`, (M,), as Gaussians; positions, (M, 3), are in the scene's frame."""
    count = len(index)
    with np.errstate(under="ignore"):
        means = np.ascontiguousarray(positions.T, np.float32)
    result = Gaussians(
        index,
        means,
        np.empty((6, count), np.float32),
        np.empty(count, np.float32),
        np.empty(count, np.float32),
        np.empty((count, 3), np.float32),
        np.empty((3, count), np.float32) if splats.model == "2dgs" else None,
        splats.model,
    )

    def fill(piece):
        chunk = splats.take(index[piece])
        relative = np.asarray(chunk.log_scales, np.float64) - np.log(scene.size)
        scales = np.exp(relative.clip(*LOG_SCALE_RANGE))
        axes = scene.axes @ rotation_matrices(chunk.quaternions)  # (n, 3, 3)
        if result.normals is not None:
            result.normals[:, piece] = axes[:, :, 2].T
        axes *= scales[:, None, :]
        for row, (a, b) in enumerate(_PAIRS):
            result.covariances[row, piece] = np.einsum("ij,ij->i", axes[:, a], axes[:, b])
        result.largest[piece] = scales.max(axis=1)
        result.alphas[piece] = opacity(chunk.opacity_logits)
        colors = SH_C0 * np.asarray(chunk.sh_dc, np.float64) + 0.5
        result.colors[piece] = colors.clip(0.0, BRIGHTEST)

    run_all(fill, chunks(count, _CHUNK), progress=progress, what="reading")
    return in_file(result)


def project(
    gaussians: Gaussians, scene: Scene, view: View, window: View | None = None
) -> Footprints:
    """Footprints that may reach into the image of a view, or its part `window`, front to back.

    The covariance is ``C + 0.3 I``, ``C = J W S W' J'`` (Zwicker et al., "EWA splatting", 2002, Eq.
    31), J the Jacobian at the mean; antialiased opacity is ``o sqrt(det C / det(C + 0.3 I))``.
    Splats with centres off the near or far plane have no footprint. Equal depths keep their order.
    """
    planes, discs = clip_planes(scene, view), gaussians.normals is not None
    turned = (view.rotation @ scene.axes.T).astype(np.float32)
    rotation = _rotation6(view.rotation @ scene.axes.T)
    views, low_pass = (view, window or view), DISC_LOW_PASS if discs else LOW_PASS
    # Depths, and what footprints hold: more room than is filled takes no memory.
    count, filled = gaussians.most(scene, *views) if _computable(scene, view) else 0, 0
    shapes = (), (), (2,), (2,), (2,), (2,), (), (), *([(7,)] if discs else ())
    kinds = np.float32, np.int64, *[np.float32] * 4, np.bool_, np.float32, np.float32
    arrays = [np.empty((*shape, count), kind) for shape, kind in zip(shapes, kinds, strict=False)]
    starts = (
        (first, chunk, start)
        for first, chunk in (gaussians.parts(scene, *views) if count else ())
        for start in range(0, len(chunk), _CHUNK)
    )
    for first, chunk, start in starts:
        checkpoint()
        piece = slice(start, start + _CHUNK)
        local = coordinates(chunk.means[:, piece], scene, view)  # (3, n of the piece)
        touching = np.flatnonzero(_touches(local, chunk.largest[piece], views, planes, low_pass))
        if len(touching):
            local = np.take(local, touching, axis=1)  # (3, n), as all that follows
            covariances = np.take(chunk.covariances[:, piece], touching, axis=1)
            shape, rows = _product(rotation, covariances), touching + start  # (6, n), (n,)
            alphas, (across, down) = chunk.alphas.take(rows), local[:2] / local[2]
            centers = np.stack([view.fx * across + view.cx, view.fy * down + view.cy])
            hit = []
            if chunk.normals is not None:
                normals = _product(turned, np.take(chunk.normals, rows, axis=1))
                axes, *hit = _discs(across, down, local[2], shape, normals, view, planes[0])
            else:
                axes, kept = _ellipses(across, down, local[2], shape, view)
                if gaussians.model == "antialiased":
                    alphas *= kept
            inside = frustum.contains(view, local, planes)
            found = local[2], rows + first, centers, *axes, inside, alphas, *hit
            for array, values in zip(arrays, found, strict=True):
                array[..., filled : filled + len(rows)] = values
            filled += len(rows)
    checkpoint()
    order = _by_depth(arrays.pop(0)[:filled])
    if gaussians.model == "antialiased":  # some are now too faint to be drawn
        order = order[arrays[6].take(order) > ALPHA_CUT]
    # One by one: all in both orders would be the most memory that a view takes.
    return Footprints(
        *(arrays.pop(0)[..., :filled].take(order, axis=-1) for _ in range(len(arrays)))
    )


def in_camera(
    gaussians: Gaussians, scene: Scene, view: View
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Centres, (3, M), and covariances, (6, M), in camera coordinates and scene sizes, float32."""
    turned = _product(_rotation6(view.rotation @ scene.axes.T), gaussians.covariances)
    return coordinates(gaussians.means, scene, view), turned


def _computable(scene, view):
    """Whether float32 can hold this view's coordinates; if not, the view counts as empty."""
    away = float(np.abs(view.center - scene.origin).max())
    lens = (view.fx, view.fy, abs(view.cx), abs(view.cy), view.width, view.height)
    usual = min(view.fx, view.fy) >= 1.0 / _LARGEST_LENS and max(lens) <= _LARGEST_LENS
    return usual and away <= _FARTHEST_VIEW * scene.size


def clip_planes(scene: Scene, view: View) -> tuple[float, float]:
    """Near and far plane in scene sizes."""
    near, far = frustum.clip_planes(view, NEAR_RELATIVE * scene.size)
    return min(max(near / scene.size, _NEAREST), _NO_END), min(far / scene.size, _NO_END)


def coordinates(means: NDArray[np.float32], scene: Scene, view: View) -> NDArray[np.float32]:
    """Camera coordinates, (3, M) float32 scene sizes, of means in the scene's frame, (3, M)."""
    shift = (view.rotation @ ((view.center - scene.origin) / scene.size)).astype(np.float32)
    local = _product((view.rotation @ scene.axes.T).astype(np.float32), means)
    local -= shift[:, None]
    return local


def _product(matrix, columns):
    """A matrix times columns, (n, M), each summed in the same order.

    BLAS rounds by a column's place: a splat would differ between its tile and one file.
    """
    result = np.multiply.outer(matrix[:, 0], columns[0])
    for factors, row in zip(matrix.T[1:], columns[1:], strict=True):
        result += np.multiply.outer(factors, row)
    return result


def _touches(local, largest, views, planes, low_pass):
    """Which footprints may reach into both `views`, image and window, (M,), on the safe side."""
    x, y, z = local
    touching = (z >= planes[0]) & (z <= planes[1])
    drawn, sides = map(frustum.image_sides, views)
    for coordinate, whole, side in zip((x, y), drawn, sides, strict=True):
        margin = _margin(whole) * largest  # (M,), px times depth
        pixels = side.half + CUT_SIGMAS * low_pass**0.5
        touching &= np.abs(side.focal * coordinate + side.offset * z) <= pixels * z + margin
    return touching


def boxes_touch(
    boxes: NDArray[np.float32], scene: Scene, view: View, window: View | None = None
) -> NDArray[np.bool_]:
    """Which of B boxes may hold a Gaussian that reaches into a view or its part `window`, (B,).

    A box is least and greatest mean and longest standard deviation, (7,), in the scene's frame.
    """
    if not _computable(scene, view):
        return np.zeros(len(boxes), np.bool_)
    near, far = clip_planes(scene, view)
    columns = itertools.product((0, 3), (1, 4), (2, 5))
    corners = np.stack([boxes[:, corner] for corner in columns], axis=-1)  # (B, 3, 8)
    local = coordinates(np.moveaxis(corners, 1, 0).reshape(3, -1), scene, view)
    x, y, z = local.reshape(3, len(boxes), 8).astype(np.float64)
    slack = _SLACK * (1.0 + np.abs(local).max(axis=0).reshape(len(boxes), 8).max(axis=1))
    touching: NDArray[np.bool_] = (z.max(axis=1) + slack >= near) & (z.min(axis=1) - slack <= far)
    drawn, sides = map(frustum.image_sides, (view, window or view))
    for coordinate, whole, side in zip((x, y), drawn, sides, strict=True):
        margin = _margin(whole) * (boxes[:, 6].astype(np.float64) + slack)
        shown = (side.half + CUT_SIGMAS * max(LOW_PASS, DISC_LOW_PASS) ** 0.5) * z
        across = side.focal * coordinate + side.offset * z
        for way in (1.0, -1.0):
            # It is linear in the position, so it is least in a corner.
            touching &= (way * across - shown).min(axis=1) <= margin
    return touching


def _margin(side):
    """How far a footprint reaches, px times depth, for a longest standard deviation of 1."""
    # A footprint is longest where its ray is most oblique; beyond `_BEYOND` it grows no further.
    slope = (abs(side.offset) + (1.0 + 2.0 * _BEYOND) * side.half) / side.focal
    return CUT_SIGMAS * side.focal * float(np.hypot(1.0, slope))


def _rotation6(r):
    """The (6, 6) matrix from the 6 numbers of S to those of ``R S R'``, R a rotation."""
    return np.array(
        [
            [r[a, i] * r[b, j] + (r[a, j] * r[b, i] if i != j else 0.0) for i, j in _PAIRS]
            for a, b in _PAIRS
        ],
        np.float32,
    )


def _ellipses(across, down, z, shape, view):
    """Axes of the footprints of Gaussians, and the share of opacity that antialiasing keeps."""
    across, down = _near_image(across, down, view)
    variances, direction = _principal(across, down, z, shape, view)
    sigmas = np.sqrt(variances + LOW_PASS)
    kept = np.sqrt(variances[0] * variances[1]) / (sigmas[0] * sigmas[1])
    return _half_axes(sigmas, direction), kept


def _near_image(across, down, view):
    """``x / z`` and ``y / z``, (n,), at most `_BEYOND` outside: J grows without bound."""
    beyond = _BEYOND * view.width / view.fx, _BEYOND * view.height / view.fy
    return (
        across.clip(-view.cx / view.fx - beyond[0], (view.width - view.cx) / view.fx + beyond[0]),
        down.clip(-view.cy / view.fy - beyond[1], (view.height - view.cy) / view.fy + beyond[1]),
    )


def jacobian(
    gaussians: Gaussians, scene: Scene, view: View
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rows of J W of Gaussians, (M, 3) each: px, across and down, per scene size along its axes."""
    x, y, z = coordinates(gaussians.means, scene, view).astype(np.float64)
    across, down = _near_image(x / z, y / z, view)
    turned = view.rotation @ scene.axes.T  # W
    return (
        (view.fx / z)[:, None] * (turned[0] - across[:, None] * turned[2]),
        (view.fy / z)[:, None] * (turned[1] - down[:, None] * turned[2]),
    )


def _principal(across, down, z, shape, view):
    """Eigenvalues of C, (2, n), the larger first, and direction of the major axis, (2, n).

    ``C = J S J'``, without the low-pass; S is `shape`, (6, n). The smaller is ``det C`` over the
    larger, which keeps its digits; of two formulas for the axis the one that does not cancel is
    taken. It points right, and is (1, 0) for a circle.
    """
    fx, fy = view.fx / z, view.fy / z
    xx = fx * fx * (shape[0] + across * (across * shape[5] - 2 * shape[2]))
    yy = fy * fy * (shape[3] + down * (down * shape[5] - 2 * shape[4]))
    xy = fx * fy * (shape[1] + across * (down * shape[5] - shape[4]) - down * shape[2])
    factor = np.minimum(1.0, _LARGEST_VARIANCE / np.maximum(xx + yy, 1.0))
    xx, xy, yy = xx * factor, xy * factor, yy * factor
    mean, half = (xx + yy) / 2, (xx - yy) / 2
    root = np.sqrt(half * half + xy * xy)
    first = np.maximum(mean + root, 0.0)
    second = np.maximum(xx * yy - xy * xy, 0.0) / np.maximum(mean + root, 1e-30)
    wide = half >= 0.0
    c, s = np.where(wide, half + root, np.abs(xy)), np.where(wide, xy, root - half)
    s = np.where(wide | (xy >= 0.0), s, -s)
    length = np.hypot(c, s)
    c = np.where(length > 1e-30, c / np.maximum(length, 1e-30), 1.0)
    s = np.where(length > 1e-30, s / np.maximum(length, 1e-30), 0.0)
    return np.stack([first, second]), np.stack([c, s])


def _half_axes(sigmas, direction):
    c, s = direction
    return sigmas[0] * direction, sigmas[1] * np.stack([-s, c]), sigmas


def _discs(across, down, z, shape, normals, view, near):
    """Footprints of discs: their axes, and what rays hit (docs/method.md, section 4).

    Alpha at (u, v) is ``o exp(-(u^2 + v^2) / 2)``, at least ``o exp(-|d|^2 / (2 DISC_LOW_PASS))``,
    d px from the centre (Huang et al. 2024, Eq. 8-11).
    """
    variances, direction = _principal(across, down, z, shape, view)
    sigmas = np.sqrt(np.maximum(variances, _THINNEST_DISC**2))
    c, s = direction
    facing = normals[0] * across + normals[1] * down + normals[2]
    facing = np.where(np.abs(facing) > _EDGE_ON, facing, np.float32(np.inf))
    discs = np.stack(
        [
            *(c / sigmas[0], s / sigmas[0], -s / sigmas[1], c / sigmas[1]),
            normals[0] / facing / np.float32(view.fx),
            normals[1] / facing / np.float32(view.fy),
            z / np.float32(near),
        ]
    )
    return _half_axes(disc_axes(variances), direction), discs.astype(np.float32)


def disc_axes(variances: NDArray[FloatT]) -> NDArray[FloatT]:
    """Half axes, (2, n), of ellipses that cover as much as discs of variances a >= b, px^2.

    The larger of disc and low-pass of variance l has the integral ``2 pi l`` if ``a < l``,
    ``2 pi sqrt(a b)`` if ``b > l``, else ``4 sqrt(a b) atan(sqrt(a / b) tan t) + l (2 pi - 4 t)``
    with t the angle from the major axis at which they are equal.
    """
    low = variances.dtype.type(DISC_LOW_PASS)
    first = np.maximum(variances[0], low)
    thin = np.maximum(variances[1], variances.dtype.type(_THINNEST_DISC**2))
    second = np.minimum(thin, variances.dtype.type(0.999 * DISC_LOW_PASS))
    square = (1.0 / low - 1.0 / first) / (1.0 / second - 1.0 / first)  # of the sine of t
    angle = np.arcsin(np.sqrt(np.clip(square, 0.0, 1.0)))
    product = np.sqrt(first * second)
    covered = 4.0 * product * np.arctan(np.sqrt(first / second) * np.tan(angle))
    covered += low * (2.0 * np.pi - 4.0 * angle)
    whole = np.where(variances[1] >= low, np.sqrt(first * thin), covered / (2.0 * np.pi))
    major = np.sqrt(first)
    return np.stack([major, np.minimum(whole / major, major)]).astype(variances.dtype)


def _by_depth(depth):
    """Order of positive float32 numbers, (n,), by their bits as integers: a linear radix sort."""
    bits = np.ascontiguousarray(depth).view(np.uint32)
    order = np.argsort((bits & 0xFFFF).astype(np.uint16), kind="stable")
    high = (bits >> 16).astype(np.uint16)
    return order[np.argsort(high[order], kind="stable")]
