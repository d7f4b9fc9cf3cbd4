"""REFINE's closed form: the error of removing each splat as if nothing were hidden (T = 1).

    D_i   = sum over k of  lambda^k  H_i G_i^k / mean_j(H_j G_j^k)          REFINE, Eq. 20
    H_i   = alpha_i  mean over views of  inside_iv / (d_iv^2 + eta)         Eq. 13-16
    G_gem = product of the two largest scales, G_col = luma^2, G_opa = alpha^2

``d`` is the depth along the view's axis (the paper) or the distance to its centre (the authors'
code). Each term is divided by its mean, as in the authors' code, which makes the terms comparable.

Two factors are our addition. ``inside`` is the share of the splat that counts as inside the view's
frustum. And the more is removed, the more a splat counts relative to those around it:

    D'_i  = D_i / m_i^(w_i / 2),    w_i = D_i / (D_i + .05)

with D in units of its mean, and m_i its mean over the splats in the same cell of a coarse grid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np

from ..errors import RefineError
from ..frustum import Frustums
from ..rendering import NEAR_RELATIVE
from ..scene import median_size, principal_axes
from ..scores import Scores
from ..splats import base_color, drawable, opacity, refuse_undrawable
from ..work import Progress, for_chunks, part, silent
from . import adaptive

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..splats import Splats
    from ..views import ViewSet

LUMA = (0.299, 0.587, 0.114)
"""Factors of red, green and blue in the luma (Rec. 601)."""

ETA_RELATIVE = 0.005
"""Default eta over the squared size of the scene: the paper's .05 at a viewing distance of 3 m."""

UNSEEN = 1e-6
"""A splat that no view sees has H = this / (squared distance to the views + eta): such splats are
ordered by distance, and nearly always below all that are seen."""

REACH = 2.0
"""Standard deviations along its longest axis that a splat reaches into an image from outside."""

CROWDED = 0.05
"""Score, over the mean of all, from which on a splat's neighbourhood counts half."""

CELLS = 64
"""Cells of the neighbourhoods along each axis."""

_CHUNK = 4096
_VIEW_BLOCK = 64
_SMALLEST_AREA = -300.0  # natural logarithm
_SMALLEST_SQUARE = 1e-300


@dataclass(frozen=True)
class ClosedForm:
    """Settings of the closed form; the default ranks the same whatever the scene's unit.

    Attributes
    ----------
    depth : {"z", "distance"}
        Depth along the view's axis, or distance to its centre.
    eta : float or None
        Added to the squared depth, squared world units; None takes `ETA_RELATIVE` times the squared
        size of the scene.
    anisotropy_offset : float or None
        Added to the shortest axis in F_gem, world units; None adds nothing, so that F_gem has no
        unit.
    frustum : bool
        Whether only views that a splat lies in, or reaches into, count for it.
    local : bool
        Whether a splat counts relative to those around it.
    visibility, projection, equal_weights : bool
        The paper's ablations: H without alpha, H without 1 / (d^2 + eta), lambda = 1/3 each.
    """

    depth: Literal["z", "distance"] = "z"
    eta: float | None = None
    anisotropy_offset: float | None = None
    frustum: bool = True
    local: bool = True
    visibility: bool = True
    projection: bool = True
    equal_weights: bool = False

    def __post_init__(self) -> None:
        """Check the values.

        Raises
        ------
        RefineError
            If a value is out of range.
        """
        if self.depth not in ("z", "distance"):
            msg = f"depth is {self.depth!r}, expected 'z' or 'distance'"
            raise RefineError(msg)
        for name in ("eta", "anisotropy_offset"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < np.inf:
                msg = f"{name} is {value}, expected a positive number"
                raise RefineError(msg)

    @classmethod
    def published(cls, depth: Literal["z", "distance"], **changes: Any) -> ClosedForm:  # noqa: ANN401
        """Return the published constants: the paper's for "z", its authors' code's otherwise."""
        eta, offset = (0.05, 0.05) if depth == "z" else (0.5, 1e-6)
        return cls(depth, eta, offset, frustum=False, local=False, **changes)


def score(
    splats: Splats,
    views: ViewSet,
    settings: ClosedForm = ClosedForm(),
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> Scores:
    """Score splats by the closed form.

    Parameters
    ----------
    splats : Splats
        In the frame and unit of the views.
    views : ViewSet
        All of them are used.
    settings : ClosedForm
    progress : callable, optional
        See `refine_addon.core.work.Progress`.
    threads : int, optional

    Returns
    -------
    Scores
        ``facts`` holds lambda and the statistics that it is computed from.

    Raises
    ------
    RefineError
        If there are no splats, if none of them can be drawn, or if no view sees any.
    Cancelled
        If `progress` answers ``False``.
    """
    if not len(splats):
        msg = "there are no splats to score"
        raise RefineError(msg)
    scene = _Scene(splats, views, settings)
    read = for_chunks(
        scene.read, len(splats), 4 * _CHUNK,
        progress=part(progress, 0.0, 0.2), what="reading", threads=threads,
    )  # fmt: skip
    refuse_undrawable(scene.good)
    scene.set_frame(np.sum([moments for _, moments in read], axis=0))
    sums = for_chunks(
        scene.sum_views, len(splats), _CHUNK,
        progress=part(progress, 0.2, 0.95), what="scoring", threads=threads,
    )  # fmt: skip
    if settings.frustum and not scene.seen.any():
        msg = (
            f"no camera sees the splats: none of {len(splats)} lies in the frustum of any of "
            f"{len(views)} views; check that cameras and splats share their frame and unit"
        )
        raise RefineError(msg)
    statistics = _statistics(np.array([tally for tally, _ in read]))
    lambdas = (1 / 3, 1 / 3, 1 / 3)
    if not settings.equal_weights:
        lambdas = adaptive.lambdas(statistics, offset=settings.anisotropy_offset or 0.0)
    means = np.sum(sums, axis=0) / len(splats)
    factors = np.divide(lambdas, means, out=np.zeros(3), where=means > 0.0)
    for_chunks(partial(scene.add, factors), len(splats), 4 * _CHUNK, threads=threads)
    if settings.local:
        scene.compare(threads)
    return Scores(
        values=scene.values,
        seen=scene.seen,
        views_used=len(views),
        undrawable=len(splats) - int(np.count_nonzero(scene.good)),
        facts={
            "lambda": dict(zip(adaptive.TERMS, lambdas, strict=True)),
            "statistics": vars(statistics).copy(),
        },
        method="closed-form",
        frustum=settings.frustum,
    )


def _statistics(tallies: NDArray[np.float64]) -> adaptive.Statistics:
    """Return the statistics of a scene.

    Parameters
    ----------
    tallies : (chunks, 5) float64
        What `_Scene.read` returns for each chunk.
    """
    count, ratios, translucency, luma, squares = tallies.T  # (chunks,) each
    total = count.sum()
    # Variance within the chunks plus variance of their means: sums of squares do not cancel.
    around = luma - luma @ count / total
    return adaptive.Statistics(
        anisotropy=float(ratios.sum() / total),
        luma_variance=float((squares.sum() + around * around @ count) / total),
        translucency=float(translucency.sum() / total),
    )


class _Fringe(NamedTuple):
    """Pairs of a splat and a view whose image it reaches into from outside, k of them.

    Attributes
    ----------
    view, splat : (k,) int64
        Places in a block.
    share : (k,) float64
        1 at the edge of the image, falling to 0 at `REACH` standard deviations.
    across : (k,) float64
        The depth at which the image is wide enough to show its centre, world units.
    """

    view: NDArray[np.int64]
    splat: NDArray[np.int64]
    share: NDArray[np.float64]
    across: NDArray[np.float64]


class _Scene:
    """What the formula needs of N splats, filled chunk by chunk.

    The splats may be a file larger than memory, so they are read once; it keeps 69 bytes of each.

    Attributes
    ----------
    origin : (3,) float64
        Middle of the scene, world units.
    view_variance : float
        Median over views of their squared distance to the origin.
    good : (N,) bool
        Which splats can be drawn.
    means : (N, 3) floating
    squared : (N,) float64
        Squared distance to the origin plus `view_variance`.
    alpha, area, visibility : (N,) float64
        Opacity, the product of the two largest scales, and H.
    reach : (N,) float64
        How far outside an image a splat still counts, world units.
    luma, values : (N,) float32
        Of the base colour, 0..1 to 6e-8; the scores.
    seen, cells : (N,) int32
        In how many views each lies; its neighbourhood.
    """

    def __init__(self, splats: Splats, views: ViewSet, settings: ClosedForm) -> None:
        self.splats, self.views, self.settings = splats, views, settings
        self.weights = views.weights
        self.origin, self.view_variance = views.middle()
        count = len(splats)
        self.good = np.empty(count, np.bool_)
        self.means = np.empty((count, 3), splats.means.dtype.newbyteorder("="))
        self.squared, self.alpha, self.area, self.visibility = (np.empty(count) for _ in range(4))
        self.reach = np.empty(count)
        self.luma = np.empty(count, np.float32)
        self.values = np.empty(count, np.float32)
        self.seen = np.zeros(count, np.int32)
        self.cells = np.empty(count, np.int32)

    def read(self, piece: slice) -> tuple[tuple[float, ...], NDArray[np.float64]]:
        """Activate one slice of splats.

        Returns
        -------
        count, ratios, translucency, luma, squares : tuple of float
            Over the drawable splats: their number, the sums of the axis ratio and of
            4 alpha (1 - alpha), the mean of the luma and the sum of its squared deviations.
        moments : (4, 3) float64
            Over the drawable splats, weighted by 1 / `squared`: the sums of the products of their
            coordinates from the origin, and of the coordinates.
        """
        chunk = self.splats.take(piece)
        good = self.good[piece] = drawable(chunk)  # (n,)
        means = self.means[piece] = np.where(good[:, None], chunk.means, 0.0)  # (n, 3)
        offset = means - self.origin
        # Values that underflow to 0 are negligible in the sums.
        with np.errstate(under="ignore"):
            self.squared[piece] = np.einsum("ij,ij->i", offset, offset) + self.view_variance
            alpha = self.alpha[piece] = opacity(np.where(good, chunk.opacity_logits, -np.inf))
            red, green, blue = base_color(np.where(good[:, None], chunk.sh_dc, 0.0)).T
            self.luma[piece] = LUMA[0] * red + LUMA[1] * green + LUMA[2] * blue
            logs = np.where(good[:, None], chunk.log_scales, 0.0).astype(np.float64)
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

    def set_frame(self, moments: NDArray[np.float64]) -> None:
        """Set axes, and eta and the near plane, which are multiples of the scene's size.

        The size is a median over splats, so a few far splats hardly change it.

        Parameters
        ----------
        moments : (4, 3) float64
            As `read` returns them, of all splats.
        """
        size = median_size(self.squared, self.good)
        self.axes = principal_axes(moments[:3], moments[3]) / size  # (3, 3)
        eta = self.settings.eta
        self.eta = ETA_RELATIVE * size * size if eta is None else eta
        self.frustums = Frustums(self.views, self.origin, NEAR_RELATIVE * size)

    def sum_views(self, piece: slice) -> list[float]:
        """Compute H of n splats, and in how many views each lies.

        Returns
        -------
        list of float
            The sums over these splats of ``H G`` for each of the three G.
        """
        points = np.ones((4, piece.stop - piece.start))  # x, y, z, 1
        points[:3] = (self.means[piece] - self.origin).T
        total = np.zeros(points.shape[1])  # (n,), H before alpha
        seen = np.zeros(points.shape[1], np.int32)
        with np.errstate(under="ignore"):
            for start in range(0, len(self.weights), _VIEW_BLOCK):
                block = slice(start, start + _VIEW_BLOCK)
                depth, beyond, inside = self.frustums.project(points, block)  # (V, n) each
                fringe = None
                if self.settings.frustum:
                    between, inside = inside, beyond <= 0.0
                    inside &= between
                    fringe = self._fringe(depth, beyond, between > inside, piece, block)
                else:
                    inside[:] = True
                # A byte can count the at most 64 views of a block.
                seen += np.add.reduce(inside.view(np.uint8), axis=0, dtype=np.uint8)
                total += self._block(points, depth, inside, fringe, block)
            if not total.all():
                near = self.squared[piece] + self.eta if self.settings.projection else 1.0
                total = np.where(total == 0.0, UNSEEN / near, total)
            if self.settings.visibility:
                total *= self.alpha[piece]
            visibility = self.visibility[piece] = total * self.good[piece]
            sums = [float(np.sum(visibility * content)) for content in self._contents(piece)]
            if self.settings.local:
                self.cells[piece] = self._cells(points)
        self.seen[piece] = seen * self.good[piece]
        return sums

    def _cells(self, points: NDArray[np.float64]) -> NDArray[np.int32]:
        """Return which neighbourhood each of n points lies in, (n,)."""
        place = self.axes @ points[:3]  # (3, n), scene sizes
        # All of space is mapped into a ball, so cells grow with the distance.
        place *= CELLS / 2 / (1.0 + np.sqrt(np.einsum("in,in->n", place, place)))
        x, y, z = np.minimum((place + CELLS / 2).astype(np.int32), CELLS - 1)
        return np.asarray((x * CELLS + y) * CELLS + z)

    def _block(
        self,
        points: NDArray[np.float64],
        depth: NDArray[np.float64],
        inside: NDArray[np.bool_],
        fringe: _Fringe | None,
        block: slice,
    ) -> NDArray[np.float64]:
        """Return H before alpha of n splats from a block of views, (n,); `depth` is overwritten."""
        weights = self.weights[block]
        counted = inside
        share = fringe.share if fringe else None
        if self.settings.projection:
            squared = self._squared(points, depth, block)
            if fringe:
                at = np.square(fringe.across)
                if self.settings.depth == "distance":
                    at = squared[fringe.view, fringe.splat]
                share = fringe.share / (at + self.eta)
            squared += self.eta
            counted = np.divide(inside, squared, out=squared)
        total: NDArray[np.float64] = np.einsum("v,vn->n", weights, counted)
        if fringe and share is not None:
            total += np.bincount(fringe.splat, weights[fringe.view] * share, len(total))
        return total

    def _fringe(
        self,
        depth: NDArray[np.float64],
        beyond: NDArray[np.float64],
        outside: NDArray[np.bool_],
        piece: slice,
        block: slice,
    ) -> _Fringe:
        """Return which splats reach into which views from outside, and how far."""
        steepness = self.frustums.steepness[block]
        limit = self.reach[piece] * (steepness if np.ptp(steepness) > 0.0 else steepness[:1])
        outside &= beyond < limit  # (b, n)
        index = np.flatnonzero(outside)  # of few; everything else is done for all of them
        view = index // outside.shape[1]
        splat = index - view * outside.shape[1]
        away = beyond.ravel()[index]
        share = 1.0 - away / (limit[0, splat] if len(limit) == 1 else limit[view, splat])
        return _Fringe(view, splat, share, depth.ravel()[index] + away)

    def _contents(self, piece: slice) -> tuple[NDArray[np.float64], ...]:
        """Return the three G of n splats, (n,) each."""
        luma, alpha = self.luma[piece].astype(np.float64), self.alpha[piece]
        return self.area[piece], luma * luma, alpha * alpha

    def _squared(
        self, points: NDArray[np.float64], depth: NDArray[np.float64], block: slice
    ) -> NDArray[np.float64]:
        """Return d^2, (V, n); `depth` is overwritten by it."""
        if self.settings.depth == "z":
            return np.multiply(depth, depth, out=depth)
        depth[:] = 0.0
        for axis in range(3):
            step = points[axis] - self.frustums.centers[block, axis, None]
            depth += np.multiply(step, step, out=step)
        return depth

    def add(self, factors: NDArray[np.float64], piece: slice) -> None:
        """Set the scores of n splats: the sum of their three terms, each times its factor."""
        visibility = self.visibility[piece]
        with np.errstate(under="ignore"):
            terms = zip(factors, self._contents(piece), strict=True)
            self._store(sum(factor * (visibility * content) for factor, content in terms), piece)

    def compare(self, threads: int | None) -> None:
        """Divide each score by a power of the mean score around it."""
        cells = self.cells
        # Sums, means and logarithms in turn, in place.
        powers = np.bincount(cells, self.values).astype(np.float64, copy=False)
        count = np.bincount(cells, self.good)
        overall = powers.sum() / count.sum()
        powers /= np.maximum(count, 1, out=count)
        powers /= overall
        np.maximum(powers, np.finfo(np.float32).tiny, out=powers)
        np.log(powers, out=powers)
        powers *= -0.5
        del count

        def divide(piece: slice) -> None:
            values = self.values[piece].astype(np.float64)
            weight = values / (values + CROWDED * overall)
            with np.errstate(under="ignore"):
                self._store(values * np.exp(weight * powers[cells[piece]]), piece)

        for_chunks(divide, len(cells), 4 * _CHUNK, threads=threads)

    def _store(self, values: NDArray[np.float64], piece: slice) -> None:
        """Set the scores of n splats; call it where underflow is ignored."""
        good = self.good[piece]
        stored = np.asarray(values, np.float32)
        # Undrawable splats score 0; a drawable splat must not tie with them by underflow.
        stored[good] = np.maximum(stored[good], np.finfo(np.float32).tiny)
        self.values[piece] = stored
