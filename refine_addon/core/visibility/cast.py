"""Rays through a few hundred pixels of each view, evenly spread, and the footprints that they hit.

The colours of these pixels follow for any choice of splats, without projecting again. A choice made
by scoring rays looks too good on them, so validation rays go through other pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from .. import spherical_harmonics
from ..execute import Progress, checkpoint, chunks, part, run_all, silent
from ..splats import ALPHA_CUT, ALPHA_MAX, DISC_LOW_PASS, Splats
from ..views import View, ViewSet
from . import projection
from .projection import Footprints, Gaussians
from .rays import Rays
from .scene import Scene

Kind = Literal["validation", "scoring", "between"]
"""What rays are for: `between` are validation rays of views that do not decide."""

RAYS: dict[Kind, tuple[int, int]] = {
    "validation": (1 << 14, 1 << 24),
    "scoring": (1 << 16, 3 << 24),
    "between": (3 << 14, 3 << 22),
}
"""Rays of all views together, and about the most of their hits, 12 bytes each: dense scenes get
fewer rays. By a quarter of the rays in 12 views between, `park` was told 1 dB too high."""

MAX_HITS_OF_VIEW = 1 << 21
"""About the most hits of one view, which take 60 bytes each while views are cast side by side."""

MAX_RAYS_OF_VIEW = 60_000
"""Most rays of a view: their numbers fit into 16 bits."""

VALIDATION_VIEWS = 24  # about the most that merged splats and written files are compared in

MIN_RAYS_OF_VIEW = 16
"""Fewest rays of a view that has as many pixels."""

BEHIND = 1e-4
"""Rays miss a disc's plane behind the camera, and beyond 1 / this times the centre's depth."""

LOG_DIM = -6.9  # of the transmittance, 1e-3, where `cast_visible` ends rays

_PAIRS = 1 << 15  # pairs of footprint and pixel at a time: what the second-level cache holds
_FOOTPRINTS = 1 << 14  # whose boxes are held at a time
_SPLATS = 1 << 12  # whose colours are computed at a time, likewise
_MARGIN = 1e-6  # of a logarithm; far more than sums in float64 differ by their order
_MAX_TABLE = 1 << 14  # pixels; images up to this size are looked up in a table, see `_before`
_CROSSING = 1e-3  # least s of `_disc_extent`; with less, a disc is partly behind the camera
_NO_END = 1e9  # px; beyond any image

_STEPS = (0.7548776662466927, 0.5698402909980532)
"""1 / p and 1 / p^2, p the plastic number: multiples modulo 1 spread evenly (R2; Roberts 2018)."""


class RaySample:
    """Scoring or validation rays of all views into one scene, of M Gaussians made of splats.

    Views have the weights of `ViewSet.by_distance`. With `few_views` about `VALIDATION_VIEWS` are
    cast, enough to compare, not for a curve; `rays` holds None for the others. `splat_rows`, (M,),
    are the splats of the Gaussians; `truths` are the colours of rays with all splats.
    """

    def __init__(
        self,
        views: Sequence[tuple[View, float]],
        gaussians: Gaussians,
        splats: Splats,
        kind: Kind = "validation",
        *,
        few_views: bool = False,
    ) -> None:
        self.views, self.splats, self.kind = views, splats, kind
        self._step = max(math.ceil(len(views) / VALIDATION_VIEWS), 1) if few_views else 1
        self.splat_rows = np.asarray(gaussians.index)
        self.rays: list[Rays | None] = [None] * len(views)
        self.truths: dict[int, NDArray[np.float32]] = {}  # (3, P) by view, as far as known

    def extend(self, views: Sequence[tuple[View, float]]) -> None:
        """Cast rays of more views, too: of all `views`, the first of which are those so far."""
        self.rays += [None] * (len(views) - len(self.views))
        self.views = views

    def colors(self, number: int, rays: Rays) -> NDArray[np.float32]:
        """Colours in which view `number` sees the splats that its rays hit, (3, u)."""
        return colors_from(self.splats, self.splat_rows[rays.hit], self.views[number][0].center)

    def wants(self, number: int) -> bool:
        """Whether the rays of a view are wanted and not cast yet."""
        return self.rays[number] is None and number % self._step == 0

    def cast_all(self, gaussians: Gaussians, scene: Scene, progress: Progress) -> None:
        """Project all Gaussians into the views and cast the rays that are wanted."""

        def cast_one(number):
            footprints = projection.project(gaussians, scene, self.views[number][0])
            self.rays[number] = cast_view(self.views, number, footprints, self.kind)

        wanted = filter(self.wants, range(len(self.views)))
        run_all(cast_one, wanted, progress=progress, what="casting rays")

    def seeing(self) -> list[int]:
        """Numbers of the views whose rays hit a splat."""
        return [k for k, rays in enumerate(self.rays) if rays is not None and len(rays.ray)]

    def validating(self) -> list[int]:
        """Numbers of at most `VALIDATION_VIEWS` views that see splats, or of all in between."""
        seeing = self.seeing()
        step = math.ceil(len(seeing) / VALIDATION_VIEWS) or 1
        return seeing if self.kind == "between" else seeing[::step]

    def hits_of_ray(self) -> float:
        """Mean number of splats that a ray hits, hidden ones included."""
        every = [rays for rays in self.rays if rays is not None]
        return sum(len(rays.ray) for rays in every) / max(sum(rays.count for rays in every), 1)


def validation_rays(splats: Splats, views: ViewSet, *, progress: Progress = silent) -> RaySample:
    """Validation rays of all views into splats in their frame; `Cancelled` if progress says so."""
    gaussians, scene, _ = projection.prepare(splats, views, progress=part(progress, 0.0, 0.2))
    sample = RaySample(views.by_distance(), gaussians, splats)
    sample.cast_all(gaussians, scene, part(progress, 0.2, 1.0))
    return sample


def cast_view(
    views: Sequence[tuple[View, float]],
    number: int,
    footprints: Footprints,
    kind: Kind = "validation",
) -> Rays:
    """Rays of view `number` of the `views` of a sample, which share its rays equally."""
    view, (rays, hits) = views[number][0], RAYS[kind]
    most_rays = min(rays / len(views), MAX_RAYS_OF_VIEW)
    most_hits = min(hits / len(views), MAX_HITS_OF_VIEW)
    count = min(most_rays, most_hits / max(depth_complexity(footprints, view), 1.0))
    # Half a step of the sequence keeps the two samples apart in every view, however many there are.
    return cast(footprints, *pixels(view, number + 0.5 * (kind == "scoring"), count))


def colors_from(
    splats: Splats, rows: NDArray[np.int64], center: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Colours in which a place, (3,), sees splats by their rows, (3, n), 0 to `BRIGHTEST`.

    All harmonics count: by the constant alone the estimated PSNR was 1.2 dB too high outdoors.
    """
    result = np.empty((3, len(rows)), np.float32)
    for piece in chunks(len(rows), _SPLATS):
        some = rows[piece]
        direction = splats.means[some].astype(np.float64) - center
        length = np.linalg.norm(direction, axis=1)
        direction /= np.maximum(length, np.finfo(np.float64).tiny)[:, None]
        harmonics = splats.sh_dc[some], splats.sh_rest[some]
        result[:, piece] = spherical_harmonics.colors(direction, *harmonics).T
    return result.clip(0.0, projection.BRIGHTEST)


def pixels(view: View, number: float, count: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Ascending columns and rows of about `count` even pixels; `number` shifts them (R2)."""
    count = max(count, MIN_RAYS_OF_VIEW)
    columns = max(round(math.sqrt(count * view.width / view.height)), 1)
    columns = min(columns, view.width, max(int(count), 1))
    rows = min(max(round(count / columns), 1), view.height)
    return (
        spread(view.width, columns, (number * _STEPS[0]) % 1.0),
        spread(view.height, rows, (number * _STEPS[1]) % 1.0),
    )


def spread(size: int, count: int, start: float) -> NDArray[np.int64]:
    """Indices of `count` of `size` pixels, evenly spread; `start`, 0 to 1, shifts them."""
    places = (np.arange(count) + start) * (size / count)
    return np.floor(places).astype(np.int64)


def depth_complexity(footprints: Footprints, view: View) -> float:
    """About how many footprints a ray hits on average, at most all of them."""
    size = float(view.width * view.height)
    area = _squared_radius(footprints.alphas)  # (n,), px^2
    area *= np.float32(math.pi) * footprints.sigmas[0] * footprints.sigmas[1]
    return float(np.minimum(area, np.float32(size)).sum(dtype=np.float64)) / size


def aimed(
    view: View, columns: NDArray[np.int64], rows: NDArray[np.int64], targets: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Column and row of the pixel of each of P rays, (2, P), aimed at targets, (2, t) px.

    Ascending columns and rows divide the image into cells of one ray each. A ray goes through the
    first target in its cell, or where column and row cross.
    """
    row, column = np.divmod(np.arange(len(columns) * len(rows)), len(columns))
    aims = np.stack([columns[column], rows[row]])
    pixel = np.floor(targets).astype(np.int64)
    inside = (pixel >= [[columns[0]], [rows[0]]]) & (pixel < [[view.width], [view.height]])
    pixel = pixel[:, inside.all(axis=0)]
    across, down = (
        np.searchsorted(places, of_targets, side="right") - 1
        for places, of_targets in zip((columns, rows), pixel, strict=True)
    )
    ray, first = np.unique(down * len(columns) + across, return_index=True)
    aims[:, ray] = pixel[:, first]
    return aims


def cast(
    footprints: Footprints,
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    aims: NDArray[np.int64] | None = None,
) -> Rays:
    """Rays through some pixels, see `hits`, with all hits of alpha `ALPHA_CUT` or more, sorted."""
    pieces = hits(footprints, columns, rows, _PAIRS, aims=aims)
    return _front_to_back(footprints, columns, rows, aims, pieces)


def cast_visible(
    footprints: Footprints, columns: NDArray[np.int64], rows: NDArray[np.int64]
) -> tuple[Rays, NDArray[np.float32]]:
    """`Rays.visible` of what `cast` gives, up to `LOG_DIM`, in less time."""
    log_left = np.zeros(len(columns) * len(rows))

    def visible_hits():
        for piece in hits(footprints, columns, rows, _PAIRS, log_left, LOG_DIM - _MARGIN):
            yield piece
            log_left[:] += np.bincount(piece[1], np.log1p(-piece[2]), len(log_left))

    return _front_to_back(footprints, columns, rows, None, visible_hits()).visible(LOG_DIM)


def _front_to_back(footprints, columns, rows, aims, of_hits):
    """Rays with the hits that `hits` yields, sorted by ray."""
    # The smallest types hold them. A view has fewer than 2^16 rays: NumPy sorts numbers of 16 bits
    # by radix, in linear time.
    types = np.int32, np.uint16, np.float32
    pieces = [[np.empty(0, kind) for kind in types]]
    pieces += [[*map(np.ndarray.astype, piece, types)] for piece in of_hits]
    footprint, ray, alpha = (np.concatenate(arrays) for arrays in zip(*pieces, strict=True))
    del pieces
    order = np.argsort(ray, kind="stable")  # footprints are front to back, and so stay hits
    used = np.zeros(len(footprints.index), np.bool_)
    used[footprint] = True
    members = np.flatnonzero(used)
    members = members[np.argsort(footprints.index[members])]  # (u,)
    place = np.empty(len(used), np.int32)  # of each footprint among those that are hit
    place[members] = np.arange(len(members))
    return Rays(
        columns, rows, ray.take(order).astype(np.int32), place.take(footprint.take(order)),
        alpha.take(order), footprints.index[members], aims,
    )  # fmt: skip


def hits(
    footprints: Footprints,
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    limit: int,
    log_left: NDArray[np.float64] | None = None,
    least: float = 0.0,
    *,
    aims: NDArray[np.int64] | None = None,
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]]:
    """Yield hits of some footprints at a time: ascending rows of these, rays, alphas, (h,) each.

    Columns, rows and aims are those of `Rays`. About `limit` pairs of footprint and pixel in its
    bounding box are held at once. Rays of which `log_left`, (P,), is at most `least` get no more.
    """
    for piece in chunks(len(footprints.index), _FOOTPRINTS):
        some = footprints.part(piece)
        squared_radius = _squared_radius(some.alphas)  # (n,)
        # Of each footprint: the first column and row in its bounding box, and how many lie in it.
        across, down = (
            _bounding_boxes(some, squared_radius, axis, places)
            for axis, places in enumerate((columns, rows))
        )
        if aims is not None:  # the cell before may reach into the box
            across, down = (
                (np.maximum(first - 1, 0), count + (first > 0)) for first, count in (across, down)
            )
        reached = across[1] * down[1]
        if log_left is not None:
            lit = (log_left > least).reshape(len(rows), len(columns))
            reached *= _reached(lit, across, down)
        boxed = np.flatnonzero(reached > 0)  # (r,)
        ends = np.cumsum(reached[boxed])
        cuts = np.searchsorted(ends, np.arange(0, int(ends[-1:].sum()), limit)).tolist()
        for start, end in pairwise([*cuts, len(boxed)]):
            checkpoint()
            owner, column, row = _boxed_pixels(boxed[start:end], across, down)
            pixel = row * np.int32(len(columns)) + column
            if log_left is not None:
                left = np.flatnonzero((log_left > least).take(pixel))
                if len(left) < len(owner):
                    owner, pixel = owner.take(left), pixel.take(left)
                    column, row = column.take(left), row.take(left)
            if aims is None:
                place = columns.take(column), rows.take(row)
            else:
                place = aims[0].take(pixel), aims[1].take(pixel)
            squared = _squared_distances(some, owner, *place)
            inside = np.flatnonzero(squared < squared_radius.take(owner))
            owner = owner.take(inside)
            alpha = some.alphas.take(owner) * np.exp(squared.take(inside) / np.float32(-2.0))
            yield owner + piece.start, pixel.take(inside), np.minimum(alpha, np.float32(ALPHA_MAX))


def _reached(lit, across, down):
    """Whether boxes of footprints, (n,), hold any of the rays that are lit, (R, C)."""
    sums = np.zeros((lit.shape[0] + 1, lit.shape[1] + 1), np.int32)
    np.cumsum(lit, axis=0, out=sums[1:, 1:])
    np.cumsum(sums, axis=1, out=sums)
    (left, wide), (top, tall) = across, down
    right, bottom = left + wide, top + tall
    return sums[bottom, right] - sums[top, right] > sums[bottom, left] - sums[top, left]


def _boxed_pixels(chosen, across, down):
    """Pairs of footprints and pixels in their boxes: footprint, column and row, (p,) each."""
    (left, wide), (top, tall) = ([each[chosen] for each in axis] for axis in (across, down))
    count = wide * tall
    box = np.repeat(np.arange(len(chosen)), count)  # (p,), as all that follows
    number = np.arange(len(box), dtype=np.int32)  # of the pixel in its box, row by row
    number -= np.repeat((np.cumsum(count) - count).astype(np.int32), count)
    row, column = np.divmod(number, wide.astype(np.int32).take(box))
    column += left.astype(np.int32).take(box)
    row += top.astype(np.int32).take(box)
    return chosen.take(box), column, row


def _bounding_boxes(footprints, squared_radius, axis, places):
    """First of the columns or rows in each footprint's bounding box, and how many."""
    center = footprints.centers[axis] - np.float32(0.5)
    if footprints.discs is None:
        half = np.sqrt(squared_radius * (footprints.major[axis] ** 2 + footprints.minor[axis] ** 2))
        low, high = center - half, center + half
    else:
        low, high = (center + edge for edge in _disc_extent(footprints.discs, squared_radius, axis))
    first, end = (_before(places, np.ceil(edge)) for edge in (low, high))
    return first, end - first


def _disc_extent(discs, squared_radius, axis):
    """Ends of discs along an axis from their centres, (n,) each, px.

    The edge ``d' C^-1 d = r^2 (1 + g d)^2``, see `projection._discs`, r^2 the squared radius, is an
    ellipse about ``r^2 C g / s``, ``s = 1 - r^2 g' C g``, and reaches ``sqrt(r^2 / s (C_xx + r^2 (C
    g)_x^2 / s))`` from there. The low-pass is a circle; a disc partly behind the camera has no end.
    """
    one, two, tilt = discs[:2], discs[2:4], discs[4:6]
    axes = [each / np.square(each).sum(axis=0) for each in (one, two)]  # half axes, (2, n) each
    along = [(each * tilt).sum(axis=0) for each in axes]  # of g, in standard deviations
    left = 1.0 - squared_radius * (along[0] ** 2 + along[1] ** 2)
    bounded = left > _CROSSING
    share = squared_radius / np.where(bounded, left, 1.0)
    shift = along[0] * axes[0][axis] + along[1] * axes[1][axis]  # (C g) along the axis
    half = np.sqrt(share * (axes[0][axis] ** 2 + axes[1][axis] ** 2 + share * shift**2))
    least = np.sqrt(squared_radius * np.float32(DISC_LOW_PASS))
    low, high = np.minimum(share * shift - half, -least), np.maximum(share * shift + half, least)
    end = np.float32(_NO_END)
    return np.where(bounded, low, -end), np.where(bounded, high, end)


def _before(places, edges):
    """How many of some ascending pixels lie before each edge, (n,)."""
    size = int(places[-1]) + 1
    if size > _MAX_TABLE:
        return np.searchsorted(places.astype(np.float64), edges.astype(np.float64))
    table = np.searchsorted(places, np.arange(size + 1))  # four times as fast as searching each
    return table.take(edges.clip(0.0, size).astype(np.int64))


def _squared_distances(footprints, owner, column, row):
    """Squared Mahalanobis distance of pixels, centres at + 0.5, to the footprints `owner`, (p,)."""
    across = column.astype(np.float32) + np.float32(0.5) - footprints.centers[0].take(owner)
    down = row.astype(np.float32) + np.float32(0.5) - footprints.centers[1].take(owner)
    if footprints.discs is not None:
        return _on_discs(footprints.discs.take(owner, axis=1), across, down)
    squared = np.zeros(len(owner), np.float32)
    for axes, sigma in zip((footprints.major, footprints.minor), footprints.sigmas, strict=True):
        along = across * axes[0].take(owner) + down * axes[1].take(owner)
        along /= np.square(sigma.take(owner))
        squared += along * along
    return squared


def _on_discs(discs, across, down):
    """The same on discs, (7, p), where the ray meets them, at most that of their low-pass."""
    depth = 1.0 + discs[4] * across + discs[5] * down  # of the centre over that of the hit
    first, second = (discs[k] * across + discs[k + 1] * down for k in (0, 2))
    ahead = depth > BEHIND
    squared = (first * first + second * second) / np.square(np.where(ahead, depth, 1.0))
    low_pass = (across * across + down * down) * np.float32(1.0 / DISC_LOW_PASS)
    on_plane = ahead & (squared <= low_pass)
    squared = np.where(on_plane, squared, low_pass)
    squared[on_plane & (depth > discs[6])] = np.inf  # nearer than the near plane
    return squared.astype(np.float32)


def _squared_radius(alphas):
    """Squared Mahalanobis distance at which alpha falls to `ALPHA_CUT`, (n,)."""
    ratio = alphas * np.float32(1.0 / ALPHA_CUT)
    return np.float32(2.0) * np.log(np.maximum(ratio, np.float32(1.0)))
