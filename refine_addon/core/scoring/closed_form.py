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

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import radix
from ..errors import RefineError
from ..execute import Progress, chunks, default_threads, part, run_all, silent
from ..rendering import NEAR_RELATIVE
from ..scores import Scores
from ..splats import Splats, refuse_undrawable
from ..views import ViewSet
from ..visibility.scene import principal_axes, size_of
from . import adaptive
from .closed_form_block import CELLS, HIGHEST, ROWS, Frame, NeighbourhoodSums, RowBlock
from .closed_form_settings import DEFAULTS, ETA_RELATIVE, ClosedForm

Each = Callable[..., Iterable[Any]]

SHARES = {"read": 0.2, "count": 0.0, "sum_views": 0.75, "add": 0.0, "compare": 0.0}
"""How much of the time each step takes, for progress; the other steps are too short to tell."""

WHAT = {"read": "reading", "count": "reading"}
"""What progress is told of a step; of the others "scoring"."""


def score(
    splats: Splats,
    views: ViewSet,
    settings: ClosedForm = DEFAULTS,
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
        See `refine_addon.core.execute.Progress`.
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
    total, middle = len(splats), views.middle()
    pieces = [*chunks(total, ROWS)]
    threads = default_threads() if threads is None else threads
    inner = max(threads // max(len(pieces), 1), 1)  # threads of a block
    blocks = [
        RowBlock(splats.take(piece), views, settings, middle, threads=inner) for piece in pieces
    ]
    done = 0.0

    def each(step: str, *arguments: Any) -> list[Any]:
        nonlocal done
        progress_of_step = part(progress, done, done + SHARES[step])
        done += SHARES[step]
        if len(blocks) == 1:
            blocks[0].progress = progress_of_step
        return run_all(
            lambda piece: blocks[piece.start].step(step, *arguments), chunks(len(blocks), 1),
            progress=progress_of_step, what=WHAT.get(step, "scoring"), threads=threads,
        )  # fmt: skip

    scene = steps(each, total, views, settings)
    values, seen = (
        np.concatenate([getattr(block, name) for block in blocks]) for name in ("values", "seen")
    )
    return Scores(
        values=values,
        seen=seen,
        views_used=len(views),
        undrawable=scene.undrawable,
        facts=scene.facts,
        method="closed-form",
        frustum=settings.frustum,
    )


@dataclass(frozen=True)
class SceneFacts:
    """What the steps tell of all splats together.

    Attributes
    ----------
    undrawable : int
        How many cannot be drawn.
    size : float
        Of the scene, see `scene.Scene`.
    facts : dict of str to Any
        See `Scores`.
    """

    undrawable: int
    size: float
    facts: dict[str, Any]


def steps(
    each: Each,
    total: int,
    views: ViewSet,
    settings: ClosedForm,
    *,
    remember: Callable[[str, Callable[[], Any]], Any] = lambda _name, make: make(),
) -> SceneFacts:
    """Score splats block by block; each `RowBlock` has its scores afterwards.

    Parameters
    ----------
    each : callable
        ``each(step, *arguments)`` does a step with every block of rows, and returns what came of
        it in the order of the blocks. Results are put together in that order, so they are the
        same bits wherever and whenever blocks are computed.
    total : int
        How many splats there are.
    views, settings
        See `score`.
    remember : callable, optional
        ``remember(name, make)`` returns what `make` returns, or returned in an earlier run: blocks
        drop the arrays that the frame is computed from.

    Raises
    ------
    RefineError
        See `score`.
    """
    if not total:
        raise RefineError("there are no splats to score")
    tallies, moments, highest = _joined(each("read"))
    good = int(tallies[:, 0].sum())
    refuse_undrawable(good, total)
    axes, eta, near, size = remember(
        "frame", lambda: _frame(each, good, moments, highest, settings)
    )
    sums = np.concatenate([*each("sum_views", Frame(axes, float(eta), float(near)))])
    if settings.frustum and not sums[:, 3].any():
        raise RefineError(
            f"no camera sees the splats: none of {total} lies in the frustum of any of "
            f"{len(views)} views; check that cameras and splats share their frame and unit"
        )
    statistics = _statistics(tallies)
    lambdas = _lambdas(statistics, settings)
    means = np.sum(sums[:, :3], axis=0) / total  # of H G, for each of the three G
    factors = np.divide(lambdas, means, out=np.zeros(3), where=means > 0.0)
    of_neighbourhoods = _powers(each("add", factors), local=settings.local)
    for _ in each("compare", *of_neighbourhoods):
        pass
    facts = {
        "lambda": dict(zip(adaptive.TERMS, lambdas, strict=True)),
        "statistics": vars(statistics).copy(),
    }
    return SceneFacts(total - good, float(size), facts)


def _joined(
    read: Iterable[tuple[Any, ...]],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.int64]]:
    """Return what `RowBlock.read` tells of all blocks together.

    The tallies of all chunks, (chunks, 5), the sum of their moments, (4, 3), and how often each
    value of the highest digit occurs, (1, 65536).
    """
    tallies, moments, *highest = zip(*read, strict=True)
    digits = radix.added(map(radix.Sparse, *highest))
    return np.concatenate(tallies), np.sum(np.concatenate(moments), axis=0), digits


def _lambdas(statistics: adaptive.Statistics, settings: ClosedForm) -> tuple[float, float, float]:
    """Return lambda of geometry, colour and opacity."""
    if settings.equal_weights:
        return (1 / 3, 1 / 3, 1 / 3)
    return adaptive.lambdas(statistics, offset=settings.anisotropy_offset or 0.0)


def _frame(
    each: Each,
    good: int,
    moments: NDArray[np.float64],
    highest: NDArray[np.int64],
    settings: ClosedForm,
) -> tuple[NDArray[np.float64], float, float, float]:
    """Return what `Frame` takes, and the scene's size, of which eta and near plane are multiples.

    The size is a median over splats, so a few far splats hardly change it. Of the splats `good` can
    be drawn; for `moments`, (4, 3), and `highest` see `_joined`.
    """

    def count(prefixes: list[int], shift: int) -> NDArray[np.int64]:
        return highest if shift == HIGHEST else radix.added(each("count", prefixes, shift))

    size = size_of(radix.median(count, np.dtype(np.float64), good))
    axes = principal_axes(moments) / size  # (3, 3)
    eta = ETA_RELATIVE * size * size if settings.eta is None else settings.eta
    return axes, eta, NEAR_RELATIVE * size, size


def _powers(
    neighbourhoods: Iterable[NeighbourhoodSums | None], *, local: bool
) -> tuple[NDArray[np.float64] | None, float]:
    """Return the powers of `RowBlock.compare`, and the mean score of all."""
    if not local:
        for _ in neighbourhoods:
            pass
        return None, 0.0
    powers, count, end = np.zeros(CELLS**3), np.zeros(CELLS**3, np.int64), 0
    for of_block in neighbourhoods:
        assert of_block is not None
        cells, sums, counts = of_block
        powers[cells] += sums
        count[cells] += counts
        end = max(end, int(cells[-1]) + 1)
    # Cut behind the last occupied cell: more zeros would change the pairs of NumPy's pairwise sum.
    powers, count = powers[:end], count[:end]
    overall = float(powers.sum() / count.sum())
    # Sums, means and logarithms in turn, in place.
    powers /= np.maximum(count, 1)
    powers /= overall
    np.maximum(powers, np.finfo(np.float32).tiny, out=powers)
    np.log(powers, out=powers)
    powers *= -0.5
    return powers, overall


def _statistics(tallies: NDArray[np.float64]) -> adaptive.Statistics:
    """Return the statistics of a scene; for `tallies`, (chunks, 5), see `RowBlock.read`."""
    count, ratios, translucency, luma, squares = tallies.T  # (chunks,) each
    total = count.sum()
    # Variance within the chunks plus variance of their means: sums of squares do not cancel.
    around = luma - luma @ count / total
    return adaptive.Statistics(
        anisotropy=float(ratios.sum() / total),
        luma_variance=float((squares.sum() + around * around @ count) / total),
        translucency=float(translucency.sum() / total),
    )
