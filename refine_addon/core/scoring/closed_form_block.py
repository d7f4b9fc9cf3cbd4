"""A run of consecutive splats, and what the closed form computes of it step by step.

Between two steps `closed_form.steps` puts together the sums, counts and medians of all blocks. A
block needs no other block, so blocks may be computed one after the other, with their numbers on
disk in between, or on several machines.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from .. import radix
from ..execute import Progress, chunks, part, run_all, silent
from ..splats import Splats, base_color, drawable, opacity
from ..views import ViewSet
from ..visibility.frustum import Frustums
from . import adaptive
from .closed_form_settings import ClosedForm
from .nearness import near_order

LUMA = (0.299, 0.587, 0.114)
"""Factors of red, green and blue in the luma (Rec. 601)."""

UNSEEN = 1e-6
"""A splat that no view sees has H = this / (squared distance to the views + eta): such splats are
ordered by distance, and nearly always below all that are seen."""

REACH = 2.0
"""Standard deviations along its longest axis that a splat reaches into an image from outside."""

LOCAL_HALF = 0.05
"""Score, in units of the mean, at which w is 1/2; see `closed_form`."""

CELLS = 64
"""Cells of the neighbourhoods along each axis."""

ROWS = 1 << 18
"""Splats of a block: its numbers take 18 MB. Sums over cells depend on it in their last bits."""

HIGHEST = 64 - radix.DIGIT
"""Bits below the highest digit of a squared distance."""

_CHUNK = 4096
_RUN = 1000
"""Splats processed together: so few that their projections into 64 views stay in the L2 cache, and
not a multiple of the page size, at which loads and stores alias."""

_VIEW_BLOCK = 64
_SMALLEST_AREA = -300.0  # natural logarithm
_SMALLEST_SQUARE = 1e-300


class Frame(NamedTuple):
    """What the views are seen in, of all splats.

    Attributes
    ----------
    axes : (3, 3) float64
        Rotation into the scene's axes, over the size of the scene.
    eta : float
        Squared world units.
    near : float
        Near plane of views that have none of their own, world units.
    """

    axes: NDArray[np.float64]
    eta: float
    near: float


class NeighbourhoodSums(NamedTuple):
    """Sums over the neighbourhoods that occur in a block.

    Attributes
    ----------
    cells : (C,) int32
        Which.
    sums : (C,) float64
        Sum of the scores in each.
    counts : (C,) int64
        How many splats that can be drawn are in each.
    """

    cells: NDArray[np.int32]
    sums: NDArray[np.float64]
    counts: NDArray[np.int64]


class _Fringe(NamedTuple):
    """Pairs of a splat and a view whose image it reaches into from outside, (k,) each."""

    view: NDArray[np.int64]  # place in a block, as `splat`
    splat: NDArray[np.int64]
    share: NDArray[np.float64]  # 1 at the edge of the image, 0 at `REACH` standard deviations
    across: NDArray[np.float64]  # depth where the image is wide enough for its centre, world units


STEPS: Mapping[str, tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]] = {
    "read": (
        (),
        ("good", "means", "squared", "alpha", "area", "reach", "luma"),
        (),
    ),
    "count": (("good", "squared"), (), ()),
    "sum_views": (
        ("good", "means", "squared", "alpha", "area", "reach", "luma"),
        ("visibility", "seen", "cells"),
        ("means", "squared", "reach"),
    ),
    "add": (
        ("good", "alpha", "area", "luma", "visibility", "cells"),
        ("plain",),
        ("alpha", "area", "luma", "visibility"),
    ),
    "compare": (("good", "plain", "cells"), ("values",), ("good", "plain", "cells")),
}
"""Step -> arrays that it needs, that it makes, and that nobody needs after it."""


class Source(Protocol):
    """Splats in memory, or read when a slice is taken."""

    def __len__(self) -> int:
        """Return how many there are."""

    def take(self, piece: slice, /) -> Splats:
        """Return some of them; an empty slice has the dtypes of all."""


class RowBlock:
    """What the formula needs of n splats, filled step by step, chunk by chunk.

    The splats are read once, in the first step; it keeps 69 bytes of each.

    Parameters
    ----------
    splats : Splats, Source or None
        Needed for `read` alone.
    views : ViewSet
    settings : ClosedForm
    middle : (3,) float64, float
        Of the views, as `ViewSet.middle` returns it.
    threads : int, optional
    arrays : mapping of str to array, optional
        Those that the next step needs; see `STEPS`.

    Attributes
    ----------
    origin : (3,) float64
        Middle of the scene, world units.
    view_variance : float
        Median over views of their squared distance to the origin.
    good : (n,) bool
        Which splats can be drawn.
    means : (n, 3) floating
    squared : (n,) float64
        Squared distance to the origin plus `view_variance`.
    alpha, area, visibility : (n,) float64
        Opacity, the product of the two largest scales, and H.
    reach : (n,) float64
        How far outside an image a splat still counts, world units.
    luma, plain, values : (n,) float32
        Of the base colour, 0..1 to 6e-8; the scores before and after splats are compared with
        those around them.
    seen, cells : (n,) int32
        In how many views each lies; its neighbourhood.
    progress : callable
        Of the step that runs.
    """

    good: NDArray[np.bool_]
    means: NDArray[np.floating[Any]]
    squared: NDArray[np.float64]
    alpha: NDArray[np.float64]
    area: NDArray[np.float64]
    visibility: NDArray[np.float64]
    reach: NDArray[np.float64]
    luma: NDArray[np.float32]
    plain: NDArray[np.float32]
    values: NDArray[np.float32]
    seen: NDArray[np.int32]
    cells: NDArray[np.int32]

    def __init__(
        self,
        splats: Source | None,
        views: ViewSet,
        settings: ClosedForm,
        middle: tuple[NDArray[np.float64], float],
        *,
        threads: int | None = None,
        arrays: Mapping[str, NDArray[Any]] | None = None,
    ) -> None:
        self.splats, self.views, self.settings = splats, views, settings
        self.threads = threads
        self.progress: Progress = silent
        self.weights = views.weights
        self.origin, self.view_variance = middle
        vars(self).update(arrays or {})

    def step(self, name: str, *arguments: Any) -> Any:
        """Do a step, and forget what none after it needs; return what it returns."""
        result = getattr(self, name)(*arguments)
        for array in STEPS[name][2]:
            vars(self).pop(array, None)
        return result

    def read(self) -> tuple[Any, ...]:
        """Activate the splats.

        Returns
        -------
        tallies : (chunks, 5) float64
        moments : (chunks, 4, 3) float64
            See `_read`.
        prefixes, places, counts
            `count` of the highest digit, which the first pass needs anyway.
        """
        assert self.splats is not None
        count = len(self.splats)
        self.good = np.empty(count, np.bool_)
        kind = self.splats.take(slice(0, 0)).means.dtype.newbyteorder("=")
        self.means = np.empty((count, 3), kind)
        self.squared, self.alpha, self.area, self.reach = (np.empty(count) for _ in range(4))
        self.luma = np.empty(count, np.float32)
        statistics = run_all(
            self._read, chunks(count, 4 * _CHUNK),
            progress=self.progress, what="reading", threads=self.threads,
        )  # fmt: skip
        self.splats = None
        tallies, moments = zip(*statistics, strict=True)
        return np.array(tallies), np.array(moments), *self.count([0], HIGHEST)

    def _read(self, piece: slice) -> tuple[tuple[float, ...], NDArray[np.float64]]:
        """Activate one slice of splats."""
        chunk = self.splats.take(piece).by_columns()  # type: ignore[union-attr]
        good = self.good[piece] = drawable(chunk)  # (n,)
        if not good.all():
            chunk = replace(
                chunk,
                means=np.where(good[:, None], chunk.means, 0.0),
                log_scales=np.where(good[:, None], chunk.log_scales, 0.0),
                opacity_logits=np.where(good, chunk.opacity_logits, -np.inf),
                sh_dc=np.where(good[:, None], chunk.sh_dc, 0.0),
            )
        self.means[piece] = chunk.means
        offset = chunk.means - self.origin  # (n, 3)
        # Values that underflow to 0 are negligible in the sums.
        with np.errstate(under="ignore"):
            self.squared[piece] = np.einsum("ij,ij->i", offset, offset) + self.view_variance
            alpha = self.alpha[piece] = opacity(chunk.opacity_logits)
            red, green, blue = base_color(chunk.sh_dc).T
            self.luma[piece] = LUMA[0] * red + LUMA[1] * green + LUMA[2] * blue
            logs = chunk.log_scales.astype(np.float64)
            if chunk.model == "2dgs":  # how long they are is told by the axes that they have
                logs[:, 2] = logs[:, :2].min(axis=1)
            self.area[piece], ratio, longest = self._axes(logs)
            self.reach[piece] = REACH * longest
            alpha, luma = alpha[good], self.luma[piece][good].astype(np.float64)
            mean = luma.sum() / max(len(luma), 1)
            squares = np.sum(np.square(luma - mean))
            translucency = np.sum(4.0 * alpha * (1.0 - alpha))
            # Nearer than this, the products underflow anyway.
            weighted = offset / np.maximum(self.squared[piece], _SMALLEST_SQUARE)[:, None]
            weighted[~good] = 0.0
            moments = np.vstack([weighted.T @ offset, weighted.sum(axis=0)])
        return (len(luma), ratio[good].sum(), translucency, mean, squares), moments

    def _axes(self, logs: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Return the two largest scales' product, longest over shortest, and longest, (n,)."""
        a, b, c = logs.T  # (n,) each
        low, high = np.minimum(a, b), np.maximum(a, b)
        largest, smallest = np.maximum(high, c), np.minimum(low, c)
        middle = np.maximum(low, np.minimum(high, c))
        area = np.exp(np.maximum(largest + middle, _SMALLEST_AREA))
        longest = np.exp(largest)
        offset = self.settings.anisotropy_offset
        if offset is None:
            limit = np.log(adaptive.RATIO_LIMIT)
            ratio = np.exp(np.minimum(largest - np.maximum(smallest, -1e300), limit))
            return area, ratio, longest
        return area, longest / (np.exp(smallest) + offset), longest

    def count(self, prefixes: list[int], shift: int) -> radix.Sparse:
        """Return `radix.counts` of the squared distances of what can be drawn."""
        squared = self.squared if self.good.all() else self.squared[self.good]
        # Only those that begin like one of the prefixes: few, after the first digit.
        known, kind = shift + radix.DIGIT, squared.dtype
        if known < 8 * kind.itemsize:
            least = radix.value_of(prefixes[0] << known, kind)
            most = radix.value_of(((prefixes[-1] + 1) << known) - 1, kind)
            squared = squared[(squared >= least) & (squared <= most)]
        return radix.Sparse.of(radix.counts(radix.keys_of(squared), prefixes, shift))

    def sum_views(self, frame: Frame) -> NDArray[np.float64]:
        """Compute H, and in how many views each splat lies.

        Returns
        -------
        (chunks, 4) float64
            Sums over a chunk's splats of ``H G`` for each of the three G, and of the views that
            each lies in.
        """
        count = len(self.good)
        self.axes, self.eta = frame.axes, frame.eta
        self.frustums = Frustums(self.views, self.origin, frame.near)
        self.visibility = np.empty(count)
        self.seen = np.empty(count, np.int32)
        self.cells = np.zeros(count, np.int32)
        # Without a frustum every view counts for all, wherever they lie.
        order = near_order(self.means) if self.settings.frustum else np.arange(count)
        run_all(
            partial(self._sum_visibility, order), chunks(count, 8 * _CHUNK),
            progress=part(self.progress, 0.0, 0.9), what="scoring", threads=self.threads,
        )  # fmt: skip
        return np.array(
            run_all(
                self._sum,
                chunks(count, _CHUNK),
                progress=part(self.progress, 0.9, 1.0),
                what="scoring",
                threads=self.threads,
            )
        )

    def _sum_visibility(self, order: NDArray[np.int64], piece: slice) -> None:
        """Set H without its factor alpha, and the number of views, for a slice of `order`.

        Splats of a run lie near each other, so most views see none of them, and many see all.
        """
        rows = order[piece]
        points = np.ones((4, len(rows)))  # x, y, z, 1
        near = np.take(self.means, rows, axis=0)
        np.subtract(near.T, self.origin[:, None], out=points[:3])
        reach = self.reach[rows]
        starts = np.arange(0, len(rows), _RUN)
        low, high = (each.reduceat(points[:3], starts, axis=1) for each in (np.minimum, np.maximum))
        visibility, seen = np.empty(len(rows)), np.empty(len(rows), np.int32)
        with np.errstate(under="ignore"):
            touching, whole = self.frustums.classify(low, high, np.maximum.reduceat(reach, starts))
            if not self.settings.frustum:
                touching[:] = whole[:] = True
            # Views of which a run is partly outside come first, then those that see all of it.
            views = np.argsort(whole * 1 - touching * 2, axis=0, kind="stable")  # (V, runs)
            counts = np.count_nonzero(touching, axis=0).tolist()
            partly = np.count_nonzero(touching & ~whole, axis=0).tolist()
            for run, start in enumerate(starts.tolist()):
                here = slice(start, start + _RUN)
                visibility[here], seen[here] = self._visibility_of_run(
                    points[:, here], reach[here], views[: counts[run], run], partly[run]
                )
        self.visibility[rows] = visibility
        self.seen[rows] = seen

    def _visibility_of_run(
        self,
        points: NDArray[np.float64],
        reach: NDArray[np.float64],
        views: NDArray[np.int64],
        partly: int,
    ) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        """Return H without its factor alpha, and the number of views, of n splats, (n,) each.

        `points` is (4, n), `reach` (n,). Only `views`, (v,), see some of them; of these, the first
        `partly` may not see all.
        """
        total = np.zeros(points.shape[1])  # (n,), H without its factor alpha
        seen = np.full(points.shape[1], len(views) - partly, np.int32)
        for start in range(0, len(views), _VIEW_BLOCK):
            some_views = views[start : start + _VIEW_BLOCK]
            count = min(max(partly - start, 0), len(some_views))
            depth, beyond, between = self.frustums.project(points, some_views, count)
            inside = fringe = None
            if count:
                inside = beyond <= 0.0  # (c, n)
                inside &= between
                fringe = self._fringe(depth, beyond, between > inside, reach, some_views[:count])
                # A byte can count the at most 64 views of a block.
                seen += np.add.reduce(inside.view(np.uint8), axis=0, dtype=np.uint8)
            total += self._visibility_from(points, depth, inside, fringe, some_views)
        return total, seen

    def _sum(self, piece: slice) -> list[float]:
        """Complete H: alpha, and splats that no view sees. Return its sums, see `sum_views`."""
        points = np.empty((3, piece.stop - piece.start))
        np.subtract(self.means[piece].T, self.origin[:, None], out=points)
        visibility, good = self.visibility[piece], self.good[piece]
        with np.errstate(under="ignore"):
            if not visibility.all():
                near = self.squared[piece] + self.eta if self.settings.projection else 1.0
                visibility[:] = np.where(visibility == 0.0, UNSEEN / near, visibility)
            if self.settings.visibility:
                visibility *= self.alpha[piece]
            visibility *= good
            sums = [float(np.sum(visibility * g)) for g in self._three_g(piece)]
            if self.settings.local:
                self.cells[piece] = self._cells(points)
        self.seen[piece] *= good
        return [*sums, float(np.sum(self.seen[piece]))]

    def _cells(self, points: NDArray[np.float64]) -> NDArray[np.int32]:
        """Return which neighbourhood each of n points lies in, (n,)."""
        place = self.axes @ points  # (3, n), scene sizes
        # All of space is mapped into a ball, so cells grow with the distance.
        place *= CELLS / 2 / (1.0 + np.sqrt(np.einsum("in,in->n", place, place)))
        x, y, z = np.minimum((place + CELLS / 2).astype(np.int32), CELLS - 1)
        return np.asarray((x * CELLS + y) * CELLS + z)

    def _visibility_from(
        self,
        points: NDArray[np.float64],
        depth: NDArray[np.float64],
        inside: NDArray[np.bool_] | None,
        fringe: _Fringe | None,
        views: NDArray[np.int64],
    ) -> NDArray[np.float64]:
        """Return H, without alpha, of n splats by some views, (n,); `depth` is overwritten."""
        weights = self.weights[views]
        share = fringe.share if fringe else None
        if self.settings.projection:
            squared = self._squared(points, depth, views)
            if fringe:
                at = np.square(fringe.across)
                if self.settings.depth == "distance":
                    at = squared[fringe.view, fringe.splat]
                share = fringe.share / (at + self.eta)
            squared += self.eta
            counted = np.divide(1.0, squared, out=squared)
        else:
            depth[:] = 1.0
            counted = depth
        if inside is not None:
            counted[: len(inside)] *= inside
        total: NDArray[np.float64] = np.einsum("v,vn->n", weights, counted)
        if fringe and share is not None:
            total += np.bincount(fringe.splat, weights[fringe.view] * share, len(total))
        return total

    def _fringe(
        self,
        depth: NDArray[np.float64],
        beyond: NDArray[np.float64],
        outside: NDArray[np.bool_],
        reach: NDArray[np.float64],
        views: NDArray[np.int64],
    ) -> _Fringe:
        """Return which splats reach into which views from outside, and how far."""
        limit = reach * self.frustums.beyond_per_unit[views]  # (c, n)
        outside &= beyond < limit  # (c, n)
        index = np.flatnonzero(outside)  # few pairs: what follows is computed for these alone
        view = index // outside.shape[1]
        splat = index - view * outside.shape[1]
        away = beyond.ravel()[index]
        share = 1.0 - away / limit.ravel()[index]
        return _Fringe(view, splat, share, depth.ravel()[index] + away)

    def _three_g(self, piece: slice) -> tuple[NDArray[np.float64], ...]:
        """Return the three G of n splats, (n,) each."""
        luma, alpha = self.luma[piece].astype(np.float64), self.alpha[piece]
        return self.area[piece], luma * luma, alpha * alpha

    def _squared(
        self, points: NDArray[np.float64], depth: NDArray[np.float64], views: NDArray[np.int64]
    ) -> NDArray[np.float64]:
        """Return d^2, (V, n); `depth` is overwritten by it."""
        if self.settings.depth == "z":
            return np.multiply(depth, depth, out=depth)
        depth[:] = 0.0
        for axis in range(3):
            step = points[axis] - self.frustums.centers[views, axis, None]
            depth += np.multiply(step, step, out=step)
        return depth

    def add(self, factors: NDArray[np.float64]) -> NeighbourhoodSums | None:
        """Set the scores: the sum of the three terms, each times its factor.

        Returns
        -------
        NeighbourhoodSums or None
            None where splats are not compared with those around them.
        """
        self.plain = np.empty(len(self.good), np.float32)
        self._in_chunks(partial(self._add, factors))
        if not self.settings.local:
            return None
        sums = np.bincount(self.cells, self.plain).astype(np.float64, copy=False)
        counts = np.bincount(self.cells)
        cells = np.flatnonzero(counts).astype(np.int32)
        if not self.good.all():
            counts = np.bincount(self.cells, self.good).astype(np.int64)
        return NeighbourhoodSums(cells, sums[cells], counts[cells])

    def _add(self, factors: NDArray[np.float64], piece: slice) -> None:
        visibility = self.visibility[piece]
        with np.errstate(under="ignore"):
            terms = zip(factors, self._three_g(piece), strict=True)
            total = sum(factor * (visibility * g) for factor, g in terms)
            self._store(self.plain, np.asarray(total), piece)

    def compare(self, powers: NDArray[np.float64] | None, overall: float) -> None:
        """Divide each score by a power of the mean score around it.

        Parameters
        ----------
        powers : (cells,) float64 or None
            -1/2 times the logarithm of the mean score in each neighbourhood, in units of `overall`;
            None leaves scores as they are.
        overall : float
            Mean score of all.
        """
        self.values = self.plain
        if powers is not None:
            self._in_chunks(partial(self._compare, powers, overall))

    def _compare(self, powers: NDArray[np.float64], overall: float, piece: slice) -> None:
        values = self.plain[piece].astype(np.float64)
        weight = values / (values + LOCAL_HALF * overall)
        with np.errstate(under="ignore"):
            values *= np.exp(weight * powers[self.cells[piece]])
            self._store(self.values, values, piece)

    def _in_chunks(self, work: Any) -> None:
        run_all(work, chunks(len(self.good), 4 * _CHUNK), threads=self.threads)

    def _store(self, into: NDArray[np.float32], values: NDArray[np.float64], piece: slice) -> None:
        """Set the scores of some splats; call it where underflow is ignored."""
        good = self.good[piece]
        stored = np.asarray(values, np.float32)
        # Undrawable splats score 0; a drawable splat must not tie with them by underflow.
        stored[good] = np.maximum(stored[good], np.finfo(np.float32).tiny)
        into[piece] = stored
