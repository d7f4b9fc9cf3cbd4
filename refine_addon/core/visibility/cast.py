"""Where rays go, which footprints they hit, and a sample of the rays of all views.

Of a few hundred pixels of each view, spread evenly, it is noted which splats their rays hit. What
these pixels show follows from that, with all splats or with any choice of them, without projecting
splats again. Two samples are taken, of different pixels: what is chosen by the *scoring rays* would
look better on them than it is, so the *validation rays* tell how good the pictures are.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .. import spherical_harmonics
from ..execute import Progress, checkpoint, part, run_all, silent
from ..splats import ALPHA_CUT, ALPHA_MAX, DISC_LOW_PASS, Splats
from ..views import View, ViewSet
from . import projection
from .projection import Footprints, Gaussians
from .rays import LOG_OPAQUE, Rays
from .scene import Scene

VALIDATION_RAYS = 1 << 14
"""How many validation rays all views together have."""

MAX_VALIDATION_HITS = 1 << 24
"""About how many hits these may have together; dense scenes get fewer rays."""

SCORING_RAYS = 1 << 16
"""How many scoring rays all views together have."""

MAX_SCORING_HITS = 3 << 24
"""About how many hits these may have together. Each takes 16 bytes."""

MAX_HITS_OF_VIEW = 1 << 21
"""About how many hits the rays of one view may have: casting takes 60 bytes for each, and views are
cast side by side. Only few views of dense scenes reach it."""

MAX_RAYS_OF_VIEW = 60_000
"""A view has at most so many rays: their numbers fit into 16 bits."""

VALIDATION_VIEWS = 24
"""What takes longer to compare than deleted splats (merged ones, written files) is compared in at
most about so many views."""

MIN_RAYS_OF_VIEW = 16
"""A view has at least this many rays, if it has as many pixels."""

BEHIND = 1e-4
"""Of a disc: a plane that a ray hits behind the camera, or at 1 / this times the centre's depth, is
not hit."""

_PAIRS = 1 << 15  # pairs of footprint and pixel at a time: what the second-level cache holds
_MARGIN = 1e-6  # of a logarithm; far more than sums in float64 differ by their order
_MAX_TABLE = 1 << 14  # pixels; images up to this size are looked up in a table, see `_before`

_CROSSING = 1e-3  # a disc of which this much is left of a plane through the camera crosses it
_NO_END = 1e9  # px; beyond any image

_STEPS = (0.7548776662466927, 0.5698402909980532)
"""1 / p and 1 / p^2 of the plastic number p: their multiples modulo 1 spread evenly over the unit
square (the R2 sequence, Roberts 2018)."""


class RaySample:
    """Rays of all views into one scene.

    Parameters
    ----------
    views : sequence of (View, float)
        Views and their weights, in an order given by the scene; see `ViewSet.by_distance`.
    gaussians : Gaussians
        What the rays may hit.
    splats : Splats
        What the Gaussians were made of, for their colours.
    few_views : bool
        Whether rays of only about `VALIDATION_VIEWS` of the views are wanted: enough to validate
        other splats by, not for a curve.
    scoring : bool
        Whether these are scoring rays; else they are validation rays.

    Attributes
    ----------
    splat_rows : (M,) int64
        Which of all splats each Gaussian is.
    share : float
        How many rays all views have together, as a part of what they usually have.
    rays : list of Rays or None
        Of each view; None where they have not been cast.
    """

    def __init__(
        self,
        views: Sequence[tuple[View, float]],
        gaussians: Gaussians,
        splats: Splats,
        *,
        few_views: bool = False,
        scoring: bool = False,
    ) -> None:
        self.views, self.splats, self.scoring, self.share = views, splats, scoring, 1.0
        self._step = max(math.ceil(len(views) / VALIDATION_VIEWS), 1) if few_views else 1
        self.splat_rows = np.asarray(gaussians.index)
        self.rays: list[Rays | None] = [None] * len(views)

    def colors(self, number: int, rays: Rays) -> NDArray[np.float64]:
        """Colours in which view `number` sees what its rays hit, (3, u)."""
        return colors_from(self.splats, self.splat_rows[rays.hit], self.views[number][0])

    def wants(self, number: int) -> bool:
        """Whether the rays of a view are wanted and have not been cast yet."""
        return self.rays[number] is None and number % self._step == 0

    def cast_all(
        self, gaussians: Gaussians, scene: Scene, progress: Progress, threads: int | None
    ) -> None:
        """Project all Gaussians into the views, and cast the rays that are wanted."""

        def cast_one(number):
            with np.errstate(under="ignore"):
                footprints = projection.project(gaussians, scene, self.views[number][0])
                self.rays[number] = cast_view(
                    self.views, number, footprints, scoring=self.scoring, share=self.share
                )

        run_all(
            cast_one, filter(self.wants, range(len(self.views))),
            progress=progress, what="casting rays", threads=threads,
        )  # fmt: skip

    def seeing(self) -> list[int]:
        """Numbers of the views whose rays hit a splat."""
        return [k for k, rays in enumerate(self.rays) if rays is not None and len(rays.ray)]

    def validating(self) -> list[int]:
        """Numbers of the views that validate where comparing in all would take long."""
        seeing = self.seeing()
        return seeing[:: max(math.ceil(len(seeing) / VALIDATION_VIEWS), 1)]

    def hits_of_ray(self) -> float:
        """How many splats a ray hits on average, hidden ones included."""
        every = [rays for rays in self.rays if rays is not None]
        return sum(len(rays.ray) for rays in every) / max(sum(rays.count for rays in every), 1)


def validation_rays(
    splats: Splats, views: ViewSet, *, progress: Progress = silent, threads: int | None = None
) -> RaySample:
    """Validation rays of all views, for scores that did not project splats.

    Parameters
    ----------
    splats : Splats
        In the frame and unit of the views.
    views : ViewSet
    progress : callable, optional
    threads : int, optional

    Raises
    ------
    Cancelled
        If `progress` answers ``False``.
    """
    gaussians, scene, _ = projection.prepare(
        splats, views, progress=part(progress, 0.0, 0.2), threads=threads
    )
    sample = RaySample(views.by_distance(), gaussians, splats)
    sample.cast_all(gaussians, scene, part(progress, 0.2, 1.0), threads)
    return sample


def cast_view(
    views: Sequence[tuple[View, float]],
    number: int,
    footprints: Footprints,
    *,
    scoring: bool = False,
    share: float = 1.0,
) -> Rays:
    """Rays of one of some views.

    Parameters
    ----------
    views : sequence of (View, float)
        All views of the sample, which share its rays evenly.
    number : int
        Which of them.
    footprints : Footprints
        In that view.
    scoring : bool
        Whether these are scoring rays, which go through other pixels than the validation rays.
    share : float
        See `RaySample`.
    """
    view = views[number][0]
    rays_of_all, hits_of_all = VALIDATION_RAYS, MAX_VALIDATION_HITS
    if scoring:
        rays_of_all, hits_of_all = SCORING_RAYS, MAX_SCORING_HITS
    most_rays = min(share * rays_of_all / len(views), MAX_RAYS_OF_VIEW)
    most_hits = min(share * hits_of_all / len(views), MAX_HITS_OF_VIEW)
    count = min(most_rays, most_hits / max(depth_complexity(footprints, view), 1.0))
    # Half a step of the sequence keeps the two samples apart in every view, however many there are.
    return cast(footprints, *pixels(view, number + 0.5 * scoring, count))


def colors_from(splats: Splats, rows: NDArray[np.int64], view: View) -> NDArray[np.float64]:
    """Colours in which a view sees some splats, (3, n), at least 0.

    All harmonics count. By the constant alone, which the rest of scoring uses, the estimated PSNR
    was 1.2 dB too high on an outdoor scene.

    Parameters
    ----------
    splats : Splats
        In the frame of the view.
    rows : (n,) int64
        Which of them.
    view : View
    """
    direction = splats.means[rows].astype(np.float64) - view.center
    length = np.linalg.norm(direction, axis=1)
    direction /= np.maximum(length, np.finfo(np.float64).tiny)[:, None]
    colors = spherical_harmonics.colors(direction, splats.sh_dc[rows], splats.sh_rest[rows])
    return np.ascontiguousarray(colors.T.clip(0.0, projection.BRIGHTEST))


def pixels(view: View, number: float, count: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns and rows of a view through which about `count` rays go, spread evenly.

    Parameters
    ----------
    view : View
    number : float
        Different numbers give different pixels.
    count : float

    Returns
    -------
    columns, rows : (C,), (R,) int64
        Ascending; see `Rays`.
    """
    count = max(count, MIN_RAYS_OF_VIEW)
    columns = max(round(math.sqrt(count * view.width / view.height)), 1)
    columns = min(columns, view.width, max(int(count), 1))
    rows = min(max(round(count / columns), 1), view.height)
    return (
        spread(view.width, columns, (number * _STEPS[0]) % 1.0),
        spread(view.height, rows, (number * _STEPS[1]) % 1.0),
    )


def spread(size: int, count: int, start: float) -> NDArray[np.int64]:
    """`count` of `size` pixels, evenly spread and ascending; `start` shifts them, 0 to 1."""
    places = (np.arange(count) + start) * (size / count)
    return np.floor(places).astype(np.int64)


def depth_complexity(footprints: Footprints, view: View) -> float:
    """About how many footprints a ray of a view hits on average, at most all of them."""
    size = float(view.width * view.height)
    area = _squared_radius(footprints.alphas)  # (n,), px^2
    area *= np.float32(math.pi) * footprints.sigmas[0] * footprints.sigmas[1]
    return float(np.minimum(area, np.float32(size)).sum(dtype=np.float64)) / size


def aimed(
    view: View, columns: NDArray[np.int64], rows: NDArray[np.int64], targets: NDArray[np.float32]
) -> NDArray[np.int64]:
    """Pixel that each ray goes through so that rays pass through targets, (2, P).

    The columns and rows divide the image into cells of one ray each. A ray goes through the first
    of the targets that lie in its cell, or where its column and row cross if none does.

    Parameters
    ----------
    view : View
    columns, rows : (C,), (R,) int64
        See `Rays`; ascending.
    targets : (2, t) float32
        Column and row in the image, pixels; what lies outside it is no target.

    Returns
    -------
    aims : (2, P) int64
        Column and row of the pixel of each ray; see `Rays`.
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
    """Rays through some pixels with all that they hit.

    A ray hits a footprint where its alpha there is at least `ALPHA_CUT`. Discs are hit where the
    ray meets their plane: see `projection.Footprints.discs`.

    Parameters
    ----------
    footprints : Footprints
        In the view of the pixels, front to back.
    columns, rows : (C,), (R,) int64
        See `Rays`; ascending.
    aims : (2, P) int64, optional
        See `aimed`.
    """
    found = hits(footprints, columns, rows, _PAIRS, aims=aims)
    return _front_to_back(footprints, columns, rows, aims, found)


def cast_visible(
    footprints: Footprints, columns: NDArray[np.int64], rows: NDArray[np.int64]
) -> tuple[Rays, NDArray[np.float32]]:
    """The same as `Rays.visible` of `cast`, without following rays on behind opaque hits.

    Footprints come front to back, some at a time: it is known of each ray how much is left of it.
    """
    log_left = np.zeros(len(columns) * len(rows))

    def found():
        for piece in hits(footprints, columns, rows, _PAIRS, wanted):
            yield piece
            log_left[:] += np.bincount(piece[1], np.log1p(-piece[2]), len(log_left))

    def wanted(_footprint, ray):
        return (log_left > LOG_OPAQUE - _MARGIN).take(ray)

    return _front_to_back(footprints, columns, rows, None, found()).visible()


def _front_to_back(footprints, columns, rows, aims, found):
    """Rays with their hits, as `hits` yields them; for what they go through see `cast`."""
    # The smallest types hold them. A view has fewer than 2^16 rays: NumPy sorts numbers of 16 bits
    # by radix, in linear time.
    types = np.int32, np.uint16, np.float32
    pieces = [[np.empty(0, kind) for kind in types]]
    pieces += [[*map(np.ndarray.astype, piece, types)] for piece in found]
    footprint, ray, alpha = (np.concatenate(arrays) for arrays in zip(*pieces, strict=True))
    order = np.argsort(ray, kind="stable")  # footprints are front to back, and so stay hits
    used = np.zeros(len(footprints.index), np.bool_)
    used[footprint] = True
    members = np.flatnonzero(used)
    members = members[np.argsort(footprints.index[members])]  # (u,)
    place = np.empty(len(used), np.int32)  # of each footprint among those that are hit
    place[members] = np.arange(len(members))
    alpha = alpha.take(order)
    return Rays(
        columns, rows, ray.take(order).astype(np.int32), place.take(footprint.take(order)), alpha,
        np.log1p(-alpha), footprints.index[members], aims,
    )  # fmt: skip


def hits(
    footprints: Footprints,
    columns: NDArray[np.int64],
    rows: NDArray[np.int64],
    limit: int,
    wanted: Callable[[NDArray[np.int64], NDArray[np.int32]], NDArray[np.bool_]] | None = None,
    *,
    aims: NDArray[np.int64] | None = None,
) -> Iterator[tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.float32]]]:
    """Yield which pixels footprints hit, some footprints at a time.

    Parameters
    ----------
    footprints : Footprints
        Front to back.
    columns, rows : (C,), (R,) int64
        Of the pixels; ascending.
    limit : int
        About how many pairs of a footprint and a pixel in its bounding box are looked at together,
        which limits temporary memory.
    wanted : callable, optional
        Which pairs of a footprint and a pixel are of interest, (p,) bool; by default all.
    aims : (2, P) int64, optional
        Pixels in the cells between the columns and rows that are looked at instead; see `aimed`.

    Yields
    ------
    footprint : (h,) int64
        Row of the footprint, ascending.
    pixel : (h,) int32
        Number of the pixel, row by row.
    alpha : (h,) float32
        Of the footprint there, at most `ALPHA_MAX`.
    """
    squared_radius = _squared_radius(footprints.alphas)  # (n,)
    # Of each footprint: the first column and row in its bounding box, and how many lie in it.
    across, down = (
        _bounding_boxes(footprints, squared_radius, axis, places)
        for axis, places in enumerate((columns, rows))
    )
    if aims is not None:  # the cell before may reach into the box
        across, down = (
            (np.maximum(first - 1, 0), count + (first > 0)) for first, count in (across, down)
        )
    boxed = np.flatnonzero(across[1] * down[1] > 0)  # (r,)
    ends = np.cumsum((across[1] * down[1])[boxed])
    cuts = np.searchsorted(ends, np.arange(0, int(ends[-1:].sum()), limit)).tolist()
    for start, end in pairwise([*cuts, len(boxed)]):
        checkpoint()
        owner, column, row = _boxed_pixels(boxed[start:end], across, down)
        pixel = row * np.int32(len(columns)) + column
        if wanted is not None:
            left = np.flatnonzero(wanted(owner, pixel))
            if len(left) < len(owner):
                owner, pixel = owner.take(left), pixel.take(left)
                column, row = column.take(left), row.take(left)
        if aims is None:
            place = columns.take(column), rows.take(row)
        else:
            place = aims[0].take(pixel), aims[1].take(pixel)
        squared = _squared_distances(footprints, owner, *place)
        inside = np.flatnonzero(squared < squared_radius.take(owner))
        owner = owner[inside]
        alpha = footprints.alphas.take(owner) * np.exp(squared[inside] / np.float32(-2.0))
        yield owner, pixel[inside], np.minimum(alpha, np.float32(ALPHA_MAX))


def _boxed_pixels(chosen, across, down):
    """All p pairs of some of n footprints, (b,), and the pixels in their bounding boxes.

    For the boxes of all n see `_bounding_boxes`. Of each pair these are the footprint, and which of
    the columns and rows the pixel lies in, (p,) each.
    """
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
    """The first of some columns or rows in each footprint's bounding box, and how many."""
    center = footprints.centers[axis] - np.float32(0.5)
    if footprints.discs is None:
        half = np.sqrt(squared_radius * (footprints.major[axis] ** 2 + footprints.minor[axis] ** 2))
        low, high = center - half, center + half
    else:
        low, high = (center + edge for edge in _disc_extent(footprints.discs, squared_radius, axis))
    first, end = (_before(places, np.ceil(edge)) for edge in (low, high))
    return first, end - first


def _disc_extent(discs, squared_radius, axis):
    """From where to where discs reach from their centres along an axis, (n,) each, px.

    With C, g and the squared radius r^2 of `projection.Footprints.discs`, the edge
    ``d' C^-1 d = r^2 (1 + g d)^2`` is an ellipse about ``r^2 C g / s``, ``s = 1 - r^2 g' C g``, and
    reaches ``sqrt(r^2 / s (C_xx + r^2 (C g)_x^2 / s))`` from there. The low-pass reaches as far as
    a circle of its variance. A disc with parts behind the camera has no end.
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
    """Squared Mahalanobis distance of pixels to footprints, (p,).

    `owner`, (p,), is the row of the footprint; the centre of a pixel is at + 0.5. Of discs it is
    that of where the ray meets them, at most that of their low-pass; see `projection`.
    """
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
    """The same on discs, (7, p), at a step from their centres."""
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
