"""Scoring splats: by any method, with what there is to say of the views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .. import costs
from ..costs import Plan
from ..execute import Progress, silent
from ..pace import phases
from ..quality.alignment import alignment
from ..quality.psnr import quality_curve
from ..scores import Scores
from ..scoring import closed_form, occlusion
from ..splats import Splats
from ..task import DEFAULTS, Settings
from ..views import ViewSet, refuse_other
from ..visibility.measuring import Measured
from ..visibility.ray_sample import validation_rays
from ..volumes import refuse_all


def score(
    splats: Splats,
    views: ViewSet,
    settings: Settings = DEFAULTS,
    *,
    protected: NDArray[np.bool_] | None = None,
    forced_out: NDArray[np.bool_] | None = None,
    quality: bool = False,
    settled: int | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Scores:
    """Score splats by how much each matters to the pictures of the views.

    Parameters
    ----------
    splats : Splats
        In the frame of the views.
    views : ViewSet
    settings : Settings
    protected : (N,) bool, optional
        Splats that are not removed: no score depends on them, the estimate of the pictures' quality
        does.
    forced_out : (N,) bool, optional
        Splats that are to go in any case: the others are scored as if they had gone, and they
        score 0; see `Task`.
    quality : bool
        Whether the scores get an estimate of the pictures' quality even if that takes longer than
        scoring by the closed form; scores by occlusion always have one.
    settled : int, optional
        How many splats must be in their final order, those `forced_out` left aside: scoring by
        occlusion takes less time where these are few. By default all.
    progress : callable, optional
        ``progress(fraction, what)``; returning ``False`` cancels.
    threads : int, optional

    Returns
    -------
    Scores

    Raises
    ------
    RefineError
        If there are no splats, if none of them can be drawn, if no view sees any, or the views are
        no `ViewSet`.
    Cancelled
        If `progress` answers ``False``.
    """
    refuse_other(views)
    if forced_out is not None and forced_out.any():
        refuse_all(forced_out)
        rest = ~forced_out
        scores = score(
            splats.take(rest), views, settings,
            protected=None if protected is None else protected[rest],
            quality=quality, settled=settled, progress=progress, threads=threads,
        )  # fmt: skip
        return scores.for_all(rest)
    used = views.spread(settings.views)
    plans = scoring_plans(splats, views, settings, settled, quality=quality)
    scoring, casting, checking, telling = phases(progress, *plans, threads=threads)
    # Numbers that underflow to 0 are negligible in all sums.
    with np.errstate(under="ignore"):
        if settings.method == "occlusion":
            scores = occlusion.score(
                splats, used, rounds=settings.occlusion.rounds, sampling=settings.occlusion,
                settled=settled, progress=scoring, threads=threads,
            )  # fmt: skip
        else:
            scores = closed_form.score(splats, used, progress=scoring, threads=threads)
        if quality and scores.ray_sample is None:
            rays = validation_rays(splats, used, progress=casting, threads=threads)
            scores = replace(scores, ray_sample=rays)
    scores = _with_views(scores, splats, views, used, checking, threads)
    return with_quality(scores, protected=protected, progress=telling, threads=threads)


def scoring_plans(
    splats: Splats, views: ViewSet, settings: Settings, settled: int | None, *, quality: bool
) -> list[Plan]:
    """Return the costs of scores, of validation rays, of checks and of a curve; see `score`."""
    count, used = len(splats), costs.Images.of(views.spread(settings.views))
    stays = occlusion.kept_after_rounds(count, settings.occlusion.rounds, settled)
    scored, rays, checked, told = costs.scoring(count, used, settings.method, stays)
    if not (quality or settings.estimates):
        rays = told = []
    return [scored, rays, checked, told]


def with_quality(
    scores: Scores,
    *,
    protected: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Scores:
    """Return scores with the curve of the estimated PSNR, as far as their validation rays tell it.

    Parameters
    ----------
    scores : Scores
    protected : (N,) bool, optional
        Splats that are not removed.
    progress : callable, optional
    threads : int, optional
    """
    if scores.ray_sample is None:
        return scores
    curve = quality_curve(
        scores.ray_sample, scores.values, protected=protected, settled=scores.settled,
        between=scores.between, progress=progress, threads=threads,
    )  # fmt: skip
    return replace(scores, quality=curve)


def _with_views(
    scores: Scores,
    splats: Splats,
    views: ViewSet,
    used: ViewSet,
    progress: Progress,
    threads: int | None,
) -> Scores:
    """Return scores with what there is to say of all views given, not only of those used."""
    notes = (*scores.notes, views.note) if views.note else scores.notes
    # Beside the closed form, measuring would take as long as scoring.
    measured = None if scores.ray_sample is None else used
    aligned = alignment(splats, views, measured, progress=progress, threads=threads)
    return replace(scores, views_given=len(views), notes=notes, alignment=aligned)


def score_once(
    splats: Splats,
    views: ViewSet,
    settings: Settings,
    progress: Progress,
    threads: int | None,
    *,
    curve: bool = False,
) -> tuple[Scores, Measured]:
    """Return scores by occlusion in one round, and what was measured of each splat.

    Parameters
    ----------
    splats, views, settings, progress, threads
        See `score`.
    curve : bool
        Whether the validation rays are to tell the whole curve of the PSNR. Else there are fewer
        of them, which tell that of a result.
    """
    used = views.spread(settings.views)
    plans = costs.scoring_once(len(splats), costs.Images.of(used))
    scoring, checking = phases(progress, *plans, threads=threads)
    with np.errstate(under="ignore"):  # as in `score`
        scores, measured = occlusion.score_once(
            splats, used, sampling=settings.occlusion, few_views=not curve,
            progress=scoring, threads=threads,
        )  # fmt: skip
    return _with_views(scores, splats, views, used, checking, threads), measured
