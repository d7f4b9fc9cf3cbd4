"""REFINE's closed form: the error of removing each splat as if nothing were hidden (T = 1).

    D_i = sum over k of  lambda^k  H_i G_i^k / mean_j(H_j G_j^k)        REFINE, Eq. 20
    H_i = alpha_i  mean over views of  inside_iv / (d_iv^2 + eta)       Eq. 13-16

For geometry, colour and opacity, k, G is the product of the two largest scales, luma^2 and alpha^2.
Our additions are `inside`, the share that counts as in the frustum, and `_compare`. Splats are read
once, in chunks; 49 bytes of each stay in memory. docs/method.md, section 1, has all formulas.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..execute import Progress, chunks, run_all, silent, stages
from ..scores import Scores
from ..splats import NEAR_RELATIVE, Splats, base_color, drawable, opacity, refuse_undrawable
from ..views import ViewSet
from ..visibility.frustum import Frustums
from ..visibility.scene import principal_axes, size_of

LUMA = (0.299, 0.587, 0.114)
"""Factors of red, green and blue in the luma (Rec. 601)."""

CALIBRATION = (10.73, 56.06, 100.67)
"""Means of the three statistics over the calibration scenes of REFINE's authors."""

RATIO_LIMIT = 1e6
"""Largest axis ratio, so that one flat disc does not make the mean infinite."""

ETA_RELATIVE = 0.005
"""Eta over the squared size of the scene: the paper's 0.05 at a viewing distance of 3 m."""

UNSEEN = 1e-6
"""H over alpha of a splat in no view, times (squared distance + V + eta): less than nearly all."""

REACH = 2.0
"""Standard deviations along its longest axis that a splat reaches into an image from outside."""

LOCAL_HALF = 0.05
"""Score, over the mean, at which w of `_compare` is 1/2."""

CELLS = 64
"""Cells of the neighbourhoods along each axis."""

ROWS = 1 << 18
"""Splats ordered, and summed over cells, at a time; the last bits of scores depend on it."""

_CHUNK = 4096
_RUN = 1000
"""Splats at a time: 64 views of them fit the L2 cache; multiples of a page's size would alias."""

_VIEW_BLOCK = 64
_SMALLEST_AREA = -300.0  # natural logarithm
_SMALLEST_SQUARE = 1e-300
_NOISE = 1e-12  # a smaller statistic counts as 0: rounding leaves about this much of a zero

# The grid whose cells a Hilbert curve connects, see `_near_order`. Bits of a cell's number along
# each axis: those of three axes fit into 16, which NumPy sorts by radix.
_BITS = 5
_SAMPLE = 4096  # splats that decide where it lies
_ENDS = (0.02, 0.98)  # quantiles of the sample along each axis between which it lies
_LEAST_SPAN = 1e-200


class _Columns(NamedTuple):
    """What the formula needs of N splats, (N,) but for `means`."""

    good: NDArray[np.bool_]  # whether it can be drawn
    means: NDArray[np.floating[Any]]  # (N, 3)
    alpha: NDArray[np.float64]
    area: NDArray[np.float64]  # product of the two largest scales
    reach: NDArray[np.float64]  # how far outside an image it still counts, world units
    luma: NDArray[np.float32]  # 0..1, to 6e-8

    def three_g(self, piece: slice) -> tuple[NDArray[np.float64], ...]:
        """G of a slice for geometry, colour and opacity, (n,) each."""
        luma, alpha = self.luma[piece].astype(np.float64), self.alpha[piece]
        return self.area[piece], luma * luma, alpha * alpha


def score(
    splats: Splats,
    views: ViewSet,
    *,
    prior: bool = False,
    progress: Progress = silent,
) -> Scores:
    """Score splats, in memory or files, by the closed form; the same to the bit on any threads.

    Parameters
    ----------
    splats : Splats, in the frame of the views
    prior : bool
        For splats that no view shows, too: d is the distance to the view's centre, every view
        counts for every splat, and splats are not compared with those around them.
    progress : see `prune`

    Raises
    ------
    RefineError : no splats, none that can be drawn, or, but for `prior`, none in any frustum
    Cancelled
    """
    total = len(splats)
    if not total:
        raise RefineError("there are no splats to score")
    reading, summing, completing, comparing = stages(progress, 0.2, 0.67, 0.08, 0.05)
    origin, spread = views.middle()
    columns, squared, tallies, moments = _read(splats, origin, spread, reading)
    good = int(tallies[:, 0].sum())
    refuse_undrawable(good, total)
    # A median, so that a few far splats hardly change it.
    used = squared if good == total else squared[columns.good]
    size = size_of(float(np.median(used, overwrite_input=True)))
    del squared, used
    eta, near = ETA_RELATIVE * size * size, NEAR_RELATIVE * size
    visibility, seen = columns.reach, np.full(total, len(views), np.int32)
    if not prior:
        _sum_views(columns, seen, views, origin, near, eta, summing)
    axes = principal_axes(moments) / size
    weighted = list(zip(views.centers - origin, views.weights, strict=True))
    cells = np.zeros(0 if prior else total, np.int32)

    def complete(piece):
        points = np.empty((3, piece.stop - piece.start))
        np.subtract(columns.means[piece].T, origin[:, None], out=points)
        alone = visibility[piece]
        if prior:
            alone[:] = 0.0
            for center, weight in weighted:
                alone += weight / (np.square(points - center[:, None]).sum(axis=0) + eta)
        elif not alone.all():
            away = np.einsum("in,in->n", points, points) + spread + eta
            alone[:] = np.where(alone == 0.0, UNSEEN / away, alone)
        alone *= columns.alpha[piece]
        alone *= columns.good[piece]
        if not prior:
            cells[piece] = _cells(axes @ points)
        seen[piece] *= columns.good[piece]
        return [float(np.sum(alone * g)) for g in columns.three_g(piece)]

    later = summing if prior else completing
    sums = run_all(complete, chunks(total, _CHUNK), progress=later, what="scoring")
    if not seen.any():
        raise RefineError(
            f"no camera sees the splats: none of {total} lies in the frustum of any of "
            f"{len(views)} views; check that cameras and splats share their frame and unit"
        )
    statistics = _statistics(tallies)
    weights = lambdas(**statistics)
    means = np.sum(sums, axis=0) / total  # of H G, for each of the three G
    factors = np.divide(weights, means, out=np.zeros(3), where=means > 0.0)
    values = np.empty(total, np.float32)

    def add(piece):
        terms = zip(factors, columns.three_g(piece), strict=True)
        whole = sum(factor * (visibility[piece] * g) for factor, g in terms)
        _store(values, whole, columns.good, piece)

    run_all(add, chunks(total, 4 * _CHUNK), progress=comparing, what="scoring")
    if not prior:
        _compare(values, cells, columns.good)
    return Scores(
        values, seen, len(views), total - good,
        {
            "lambda": dict(zip(("geometry", "color", "opacity"), weights, strict=True)),
            "statistics": statistics,
        },
        method="closed-form",
    )  # fmt: skip


def lambdas(anisotropy: float, luma_variance: float, translucency: float) -> list[float]:
    """Lambda of geometry, colour and opacity, of sum 1 (REFINE, Eq. 17-20; authors' constants).

    They follow from mean axis ratio, variance of luma, 0..1, and mean of 4 alpha (1 - alpha).

    >>> [round(value, 3) for value in lambdas(10.73, 0.05, 0.5)]
    [0.274, 0.111, 0.615]
    """
    raw = (math.log(anisotropy), 100.0 * luma_variance, 100.0 * translucency)
    terms = [value / usual for value, usual in zip(raw, CALIBRATION, strict=True)]
    terms = [term if term > _NOISE else 0.0 for term in terms]
    total = sum(terms)
    return [term / total for term in terms] if total else [1 / 3] * 3


def _read(splats, origin, spread, progress):
    """Columns, squared distances to the views, tallies of chunks, and sums for `principal_axes`."""
    count = len(splats)
    kind = splats.take(slice(0, 0)).means.dtype.newbyteorder("=")
    drawn, lumas = np.empty(count, np.bool_), np.empty(count, np.float32)
    alphas, area, reach = np.empty((3, count))
    columns = _Columns(drawn, np.empty((count, 3), kind), alphas, area, reach, lumas)
    squared = np.empty(count)

    def read(piece):
        chunk = splats.take(piece).by_columns()
        good = columns.good[piece] = drawable(chunk)  # (n,)

        def clean(values, instead=0.0):
            keep = good.reshape(-1, *[1] * (values.ndim - 1))
            return values if good.all() else np.where(keep, values, values.dtype.type(instead))

        means = columns.means[piece] = clean(chunk.means)
        offset = means - origin  # (n, 3)
        squared[piece] = np.einsum("ij,ij->i", offset, offset) + spread
        alpha = columns.alpha[piece] = opacity(clean(chunk.opacity_logits, -np.inf))
        red, green, blue = base_color(clean(chunk.sh_dc)).T
        columns.luma[piece] = LUMA[0] * red + LUMA[1] * green + LUMA[2] * blue
        logs = clean(chunk.log_scales).astype(np.float64)
        if chunk.model == "2dgs":  # discs have two axes
            logs[:, 2] = logs[:, :2].min(axis=1)
        columns.area[piece], ratio, longest = _axes(logs)
        columns.reach[piece] = REACH * longest
        alpha, luma = alpha[good], columns.luma[piece][good].astype(np.float64)
        mean = luma.sum() / max(len(luma), 1)
        squares = np.sum(np.square(luma - mean))
        translucency = np.sum(4.0 * alpha * (1.0 - alpha))
        # Nearer than this, the products underflow anyway.
        weighted = offset / np.maximum(squared[piece], _SMALLEST_SQUARE)[:, None]
        weighted[~good] = 0.0
        moments = np.vstack([weighted.T @ offset, weighted.sum(axis=0)])
        return (len(luma), ratio[good].sum(), translucency, mean, squares), moments

    results = run_all(read, chunks(count, 4 * _CHUNK), progress=progress, what="reading")
    tallies, moments = zip(*results, strict=True)
    return columns, squared, np.array(tallies), np.sum(moments, axis=0)


def _axes(logs):
    """Product of the two largest scales, longest over shortest, and longest, (n,) each."""
    a, b, c = logs.T  # (n,) each
    low, high = np.minimum(a, b), np.maximum(a, b)
    largest, smallest = np.maximum(high, c), np.minimum(low, c)
    middle = np.maximum(low, np.minimum(high, c))
    ratio = np.minimum(largest - np.maximum(smallest, -1e300), np.log(RATIO_LIMIT))
    area = np.maximum(largest + middle, _SMALLEST_AREA)
    return np.exp(area), np.exp(ratio), np.exp(largest)


def _statistics(tallies):
    """The arguments of `lambdas`, from the tallies of chunks."""
    count, ratios, translucency, luma, squares = tallies.T  # (chunks,) each
    total = count.sum()
    # Variance within the chunks plus variance of their means: sums of squares do not cancel.
    around = luma - luma @ count / total
    return {
        "anisotropy": float(ratios.sum() / total),
        "luma_variance": float((squares.sum() + around * around @ count) / total),
        "translucency": float(translucency.sum() / total),
    }


def _sum_views(columns, seen, views, origin, near, eta, progress):
    """Replace `reach` by H over alpha, and `seen`, (N,), by how many views hold each centre."""
    total, frustums, weights = len(columns.good), Frustums(views, origin, near), views.weights
    order = np.arange(total, dtype=np.int32)

    def sort(rows):
        order[rows] = rows.start + _near_order(columns.means[rows])

    def sum_views(piece):
        rows = order[piece]
        points = np.ones((4, len(rows)))  # x, y, z, 1
        means, reach = np.take(columns.means, rows, axis=0), columns.reach[rows]
        np.subtract(means.T, origin[:, None], out=points[:3])
        starts = np.arange(0, len(rows), _RUN)
        low, high = (each.reduceat(points[:3], starts, axis=1) for each in (np.minimum, np.maximum))
        touching, whole = frustums.classify(low, high, np.maximum.reduceat(reach, starts))
        # Views of which a run is partly outside come first, then those that see all of it.
        order_of_views = np.argsort(whole * 1 - touching * 2, axis=0, kind="stable")  # (V, runs)
        counts = np.count_nonzero(touching, axis=0).tolist()
        partly = np.count_nonzero(touching & ~whole, axis=0).tolist()
        for run, start in enumerate(starts.tolist()):
            here = slice(start, start + _RUN)
            columns.reach[rows[here]], seen[rows[here]] = _of_run(
                frustums, weights, eta, points[:, here], reach[here],
                order_of_views[: counts[run], run], partly[run],
            )  # fmt: skip

    run_all(sort, chunks(total, ROWS))
    run_all(sum_views, chunks(total, 8 * _CHUNK), progress=progress, what="scoring")


def _near_order(means):
    """Order of positions, (n, 3), along a Hilbert curve through 32^3 cells, stable in a cell."""
    sample = means[:: max(len(means) // _SAMPLE, 1)].astype(np.float64)
    cell = np.zeros(len(means), np.uint16)
    low, high = np.quantile(sample, _ENDS, axis=0)  # (3,) each
    # Cubes: a run is about as wide as high, however flat the scene.
    scale = (1 << _BITS) / max(float(np.max(high - low)), _LEAST_SPAN)
    for values, least in zip(means.T, low, strict=True):
        number = np.subtract(values, least, dtype=np.float64)  # (N,)
        number *= scale
        cell <<= _BITS
        cell |= np.clip(number, 0, (1 << _BITS) - 1, out=number).astype(np.uint16)
    return np.argsort(_places()[cell], kind="stable")


@cache
def _places():
    """Place of each cell along the curve (as by Skilling, AIP Conf. Proc. 707, 2004)."""
    x = y = z = np.zeros(1, np.intp)  # of the cells, along the curve through a cube of one
    for bit in range(_BITS):
        size = 1 << bit
        # Through half of a cube twice as wide four times, turned, then back in the mirror image.
        half = np.hstack([
            (y, z, x), (y, x, z + size), (x, y + size, z + size),
            (size - 1 - z, y + size, size - 1 - x),
        ])  # fmt: skip
        x, y, z = np.hstack([half, half[:, ::-1]])
        x[len(x) // 2 :] = 2 * size - 1 - x[len(x) // 2 :]
    places = np.empty(len(x), np.uint16)
    places[x << 2 * _BITS | y << _BITS | z] = np.arange(len(x))
    return places


def _of_run(frustums, weights, eta, points, reach, views, partly):
    """H over alpha and `seen` of a run that `views`, (v,), see, the first `partly` only in part."""
    total = np.zeros(len(reach))
    seen = np.full(len(reach), len(views) - partly, np.int32)
    for start in range(0, len(views), _VIEW_BLOCK):
        some = views[start : start + _VIEW_BLOCK]
        count = min(max(partly - start, 0), len(some))
        depth, beyond, between = frustums.project(points, some, count)
        if count:
            inside = beyond <= 0.0  # (c, n)
            inside &= between
            # A byte can count the at most 64 views of a block.
            seen += np.add.reduce(inside.view(np.uint8), axis=0, dtype=np.uint8)
            # Few pairs reach inside from outside: what follows is computed for these alone.
            limit = reach * frustums.beyond_per_unit[some[:count]]  # (c, n)
            index = np.flatnonzero((between > inside) & (beyond < limit))
            view, splat = np.divmod(index, len(reach))
            away = beyond.ravel()[index]
            share = 1.0 - away / limit.ravel()[index]
            # The depth at which the image is wide enough for the centre.
            across = np.square(depth.ravel()[index] + away)
        depth *= depth
        depth += eta
        counted = np.divide(1.0, depth, out=depth)
        if count:
            counted[:count] *= inside
        summed = np.einsum("v,vn->n", weights[some], counted)
        if count:
            share /= across + eta
            summed += np.bincount(splat, weights[some[view]] * share, len(reach))
        total += summed
    return total, seen


def _cells(place):
    """Neighbourhoods of places in scene sizes, (3, n); `place` is overwritten."""
    # All of space is mapped into a ball, so cells grow with the distance.
    place *= CELLS / 2 / (1.0 + np.sqrt(np.einsum("in,in->n", place, place)))
    x, y, z = np.minimum((place + CELLS / 2).astype(np.int32), CELLS - 1)
    return (x * CELLS + y) * CELLS + z


def _compare(values, cells, good):
    """Divide each score by a power of the mean score in its cell of a coarse grid.

    ``D'_i = D_i / m_i^(w_i / 2)``, ``w_i = D_i / (D_i + 0.05)``, all in units of the mean: the more
    is removed, the more a splat counts relative to those around it.
    """
    end = int(cells.max()) + 1
    powers, count = np.zeros(end), np.zeros(end, np.int64)
    for rows in chunks(len(values), ROWS):
        powers += np.bincount(cells[rows], values[rows], end)
        count += np.bincount(cells[rows][good[rows]], minlength=end)
    overall = float(powers.sum() / count.sum())
    powers /= np.maximum(count, 1)
    powers /= overall
    powers = -0.5 * np.log(np.maximum(powers, np.finfo(np.float32).tiny))

    def compare(piece):
        plain = values[piece].astype(np.float64)
        weight = plain / (plain + LOCAL_HALF * overall)
        _store(values, plain * np.exp(weight * powers[cells[piece]]), good, piece)

    run_all(compare, chunks(len(values), 4 * _CHUNK))


def _store(into, values, good, piece):
    """Store scores as float32; only undrawable splats score 0, despite underflow."""
    stored = values.astype(np.float32)
    # A drawable splat must not tie with undrawable ones by underflow.
    np.maximum(stored, np.finfo(np.float32).tiny, out=stored, where=good[piece])
    into[piece] = stored
