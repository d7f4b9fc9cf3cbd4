"""REFINE's closed form: the error of removing each splat, with nothing hidden (T = 1).

    D_i   = sum over k of  lambda^k  H_i G_i^k / mean_j(H_j G_j^k)          REFINE, Eq. 20
    H_i   = alpha_i  mean over views of  inside_iv / (d_iv^2 + eta)         Eq. 13-16
    G_gem = product of the two largest scales, G_col = luma^2, G_opa = alpha^2

``d`` is the depth along the view's axis (the paper) or the distance to its centre (the authors'
code). ``inside`` is ours: 1 where the splat's centre lies in the view's frustum. The division by
the mean of each term is the authors' code's; it makes the terms comparable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from . import adaptive
from .errors import RefineError
from .scores import Scores
from .splats import base_color, drawable, opacity
from .work import Progress, for_chunks, part, silent

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .splats import Splats
    from .views import ViewSet

LUMA = (0.299, 0.587, 0.114)
"""Rec. 601 weights of red, green, blue."""

ETA_RELATIVE = 0.005
"""Default eta over the squared size of the scene: the paper's .05 at a viewing distance of 3 m."""

NEAR_RELATIVE = 0.01
"""Default near plane over the size of the scene, where a view brings none of its own."""

UNSEEN = 1e-6
"""Factor on 1 / (mean squared distance + eta), the weight of splats that no view sees: it orders
them by distance, practically below all that is seen."""

_CHUNK = 4096
_VIEW_BLOCK = 64
_STACK = 16  # rows of one product: small enough that BLAS starts no threads beside ours
_SMALLEST_AREA = -300.0


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
        Added to the shortest axis in F_gem, world units; None compares the axes as they are, a
        ratio without unit.
    frustum : bool
        Whether only views that see a splat's centre count.
    margin : float
        How far beyond the image's edge still counts as inside, in half image sizes.
    visibility, projection, equal_weights : bool
        The paper's ablations: without alpha, without 1 / (d^2 + eta), with lambda = 1/3 each.
    """

    depth: Literal["z", "distance"] = "z"
    eta: float | None = None
    anisotropy_offset: float | None = None
    frustum: bool = True
    margin: float = 0.15
    visibility: bool = True
    projection: bool = True
    equal_weights: bool = False

    def __post_init__(self) -> None:
        """Check the values.

        Raises
        ------
        RefineError
            If one cannot be.
        """
        if self.depth not in ("z", "distance"):
            msg = f"depth is {self.depth!r}, expected 'z' or 'distance'"
            raise RefineError(msg)
        for name in ("eta", "anisotropy_offset"):
            value = getattr(self, name)
            if value is not None and not 0.0 < value < np.inf:
                msg = f"{name} is {value}, expected a positive number"
                raise RefineError(msg)
        if not 0.0 <= self.margin < np.inf:
            msg = f"margin is {self.margin}, expected 0 or more"
            raise RefineError(msg)

    @classmethod
    def published(cls, depth: Literal["z", "distance"], **changes: Any) -> ClosedForm:  # noqa: ANN401
        """Return the published reading: the paper's for "z", its authors' code for "distance"."""
        eta, offset = (0.05, 0.05) if depth == "z" else (0.5, 1e-6)
        return cls(depth, eta, offset, frustum=False, **changes)


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
        ``weights`` holds lambda and the statistics it comes from.

    Raises
    ------
    RefineError
        If there is no splat, or no view sees any.
    Cancelled
        If `progress` answers ``False``.
    """
    if not len(splats):
        msg = "there are no splats to score"
        raise RefineError(msg)
    good, squared = _measure(splats, views, part(progress, 0.0, 0.2), threads)
    terms = _Terms(splats, views, settings, good, squared)
    for_chunks(
        terms.fill, len(splats), _CHUNK,
        progress=part(progress, 0.2, 0.95), what="scoring", threads=threads,
    )  # fmt: skip
    if settings.frustum and not terms.seen.any():
        msg = (
            f"no camera sees the splats: none of {len(splats)} lies in the frustum of any of "
            f"{len(views)} views; check that cameras and splats share their frame and unit"
        )
        raise RefineError(msg)
    return terms.scores()


def _measure(
    splats: Splats, views: ViewSet, progress: Progress, threads: int | None
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Return which splats are drawable, and the mean over views of their squared distance."""
    good = np.empty(len(splats), np.bool_)
    squared = np.empty(len(splats), np.float64)
    centers, weights = views.centers, views.weights
    origin = weights @ centers
    spread = float(weights @ np.sum((centers - origin) ** 2, axis=1))

    def measure(piece: slice) -> None:
        chunk = splats.take(piece)
        good[piece] = drawable(chunk)
        offset = np.where(good[piece, None], chunk.means, origin) - origin
        squared[piece] = np.einsum("ij,ij->i", offset, offset) + spread

    for_chunks(
        measure, len(splats), 16 * _CHUNK, progress=progress, what="reading", threads=threads
    )
    if not good.any():
        msg = f"none of the {len(splats)} splats can be drawn: each is transparent or not finite"
        raise RefineError(msg)
    return good, squared


class _Terms:
    """The three terms of every splat, filled chunk by chunk."""

    def __init__(
        self,
        splats: Splats,
        views: ViewSet,
        settings: ClosedForm,
        good: NDArray[np.bool_],
        squared: NDArray[np.float64],
    ) -> None:
        self.splats, self.settings, self.good, self.squared = splats, settings, good, squared
        # The median over splats follows the scene's unit, and not its origin, order or outliers.
        size = float(np.sqrt(np.median(squared if good.all() else squared[good]))) or 1.0
        self.count = len(views)
        self.origin = views.centers.mean(axis=0)
        self.centers = views.centers - self.origin
        self.weights = views.weights
        self.eta = ETA_RELATIVE * size * size if settings.eta is None else settings.eta
        self.rows = _frustum_rows(views, self.centers, settings.margin)
        near = np.array([view.near for view in views])
        self.near = np.where(near > 0.0, near, NEAR_RELATIVE * size)[:, None]
        self.far = np.array([view.far for view in views])[:, None]
        count = len(splats)
        self.seen = np.zeros(count, np.int32)
        self.alpha = np.zeros(count, np.float64)
        self.luma = np.zeros(count, np.float64)
        self.ratio = np.zeros(count, np.float64)
        self.terms = np.zeros((3, count), np.float64)

    def fill(self, piece: slice) -> None:
        """Compute the terms ``H G^k`` of one slice of splats."""
        chunk, good = self.splats.take(piece), self.good[piece]
        # Where T underflows to 0 it is 0 beside everything that counts.
        with np.errstate(under="ignore"):
            alpha = opacity(np.where(good, chunk.opacity_logits, -np.inf))
            red, green, blue = base_color(np.where(good[:, None], chunk.sh_dc, 0.0)).T
            luma = LUMA[0] * red + LUMA[1] * green + LUMA[2] * blue
            area, self.ratio[piece] = self._axes(chunk, good)
            offset = np.where(good[:, None], chunk.means, self.origin) - self.origin
            weight = self._weight(offset, piece)
            if self.settings.visibility:
                weight *= alpha
            weight *= good
            self.alpha[piece], self.luma[piece] = alpha, luma
            self.terms[0, piece] = weight * area
            self.terms[1, piece] = weight * (luma * luma)
            self.terms[2, piece] = weight * (alpha * alpha)

    def _axes(
        self, chunk: Splats, good: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the product of the two largest scales, and longest over shortest."""
        logs = np.where(good[:, None], chunk.log_scales, 0.0).astype(np.float64)
        a, b, c = logs.T
        low, high = np.minimum(a, b), np.maximum(a, b)
        largest, smallest = np.maximum(high, c), np.minimum(low, c)
        middle = np.maximum(low, np.minimum(high, c))
        area = np.exp(np.maximum(largest + middle, _SMALLEST_AREA))
        offset = self.settings.anisotropy_offset
        if offset is None:
            limit = np.log(adaptive.RATIO_LIMIT)
            return area, np.exp(np.minimum(largest - np.maximum(smallest, -1e300), limit))
        return area, np.exp(largest) / (np.exp(smallest) + offset)

    def _weight(self, offset: NDArray[np.float64], piece: slice) -> NDArray[np.float64]:
        """Return the mean over views of ``inside / (d^2 + eta)`` and note `seen`."""
        homogeneous = np.vstack([offset.T, np.ones(len(offset))])
        total = np.zeros(len(offset))
        for start in range(0, self.count, _VIEW_BLOCK):
            block = slice(start, start + _VIEW_BLOCK)
            x, y, z = self._project(homogeneous, block)
            inside = self._inside(x, y, z, block)
            self.seen[piece] += np.add.reduce(inside.view(np.uint8), axis=0, dtype=np.int32)
            if self.settings.projection:
                squared = self._squared(offset, z, block)
                squared += self.eta
                inside = np.divide(inside, squared, out=squared)
            total += np.einsum("v,vn->n", self.weights[block], inside)
        unseen = self.seen[piece] == 0
        if unseen.any():
            near = self.squared[piece] + self.eta
            prior = UNSEEN / near if self.settings.projection else UNSEEN
            total = np.where(unseen, prior, total)
        return total

    def _project(
        self, homogeneous: NDArray[np.float64], block: slice
    ) -> tuple[NDArray[np.float64], ...]:
        """Return x', y' and z, each (V, n), of points in the views of `block`."""
        rows = self.rows[:, block].reshape(-1, 4)
        stack = np.zeros((-(-len(rows) // _STACK), _STACK, 4))
        stack.reshape(-1, 4)[: len(rows)] = rows
        product = (stack @ homogeneous).reshape(-1, homogeneous.shape[1])
        return tuple(np.split(product[: len(rows)], 3))

    def _inside(
        self,
        x: NDArray[np.float64],
        y: NDArray[np.float64],
        z: NDArray[np.float64],
        block: slice,
    ) -> NDArray[np.bool_]:
        """Return which splats lie in which frustum; `x` and `y` are used up."""
        if not self.settings.frustum:
            return np.ones(z.shape, np.bool_)
        np.maximum(np.abs(x, out=x), np.abs(y, out=y), out=x)
        inside = np.less_equal(np.maximum(x, self.near[block], out=x), z)
        if np.isfinite(self.far[block]).any():
            inside &= z <= self.far[block]
        return inside

    def _squared(
        self, offset: NDArray[np.float64], z: NDArray[np.float64], block: slice
    ) -> NDArray[np.float64]:
        """Return d^2, (V, n), in the memory of `z`."""
        if self.settings.depth == "z":
            return np.multiply(z, z, out=z)
        z[:] = 0.0
        for axis in range(3):
            step = offset[:, axis] - self.centers[block, axis, None]
            z += np.multiply(step, step, out=step)
        return z

    def scores(self) -> Scores:
        """Weigh the terms and return their sum."""
        good = self.good
        alpha, luma = (values[good] for values in (self.alpha, self.luma))
        statistics = adaptive.Statistics(
            anisotropy=float(np.mean(self.ratio[good])),
            luma_variance=float(np.var(luma)),
            translucency=float(np.mean(4.0 * alpha * (1.0 - alpha))),
        )
        lambdas = (1 / 3, 1 / 3, 1 / 3)
        if not self.settings.equal_weights:
            lambdas = adaptive.weights(statistics, offset=self.settings.anisotropy_offset or 0.0)
        values = np.zeros(len(good))
        with np.errstate(under="ignore"):
            for weight, term in zip(lambdas, self.terms, strict=True):
                mean = np.mean(term)
                if mean > 0.0:
                    values += weight * (term / mean)
            stored = values.astype(np.float32)
        # A splat that can be drawn must never tie with one that cannot.
        stored[good] = np.maximum(stored[good], np.finfo(np.float32).tiny)
        return Scores(
            values=stored,
            seen=np.where(good, self.seen, 0).astype(np.int32),
            views_used=self.count,
            undrawable=int(np.count_nonzero(~good)),
            weights={
                "lambda": dict(zip(adaptive.TERMS, lambdas, strict=True)),
                "statistics": vars(statistics).copy(),
            },
        )


def _frustum_rows(
    views: ViewSet, centers: NDArray[np.float64], margin: float
) -> NDArray[np.float64]:
    """Return rows whose products with ``(p, 1)`` are x', y' and z of every view.

    A point lies between the image's edges, widened by `margin`, where ``|x'| <= z`` and
    ``|y'| <= z``: the principal point and the half image size are in the rows.

    Returns
    -------
    (3, V, 4) float64
    """
    rows = np.empty((3, len(views), 4))
    for index, (view, center) in enumerate(zip(views, centers, strict=True)):
        right, down, forward = np.column_stack([view.rotation, -view.rotation @ center])
        half_width = view.width / 2 * (1 + margin)
        half_height = view.height / 2 * (1 + margin)
        rows[0, index] = (view.fx * right + (view.cx - view.width / 2) * forward) / half_width
        rows[1, index] = (view.fy * down + (view.cy - view.height / 2) * forward) / half_height
        rows[2, index] = forward
    return rows
