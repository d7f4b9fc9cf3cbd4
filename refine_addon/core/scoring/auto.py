"""Method *auto*: occlusion with no more views than the pictures need.

Half of the views, spread evenly, measure the splats first, then an eighth more. Others validate:
their rays tell the PSNR after removing splats by each of the two rankings. The error of a mean
over k views falls as 1 / k, so the PSNR is about ``limit - slope / k``, and what the eighth has
gained tells what the rest would gain. Where that is within the tolerance, the rest is not measured.
All that is measured to find out is used, so finding out costs no more than two rankings and the
rays of the validation views.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..estimate.psnr import psnr_by_views
from ..estimate.quality import UNSEEN
from ..work import Progress, part, silent
from .occlusion import FIRST_END, MemoryScoring, OcclusionScoring

if TYPE_CHECKING:
    from ..scores import Scores
    from ..splats import Splats
    from ..views import ViewSet
    from .occlusion import Occlusion

RATIOS = (0.3, 0.5, 0.7, 0.9)
"""Shares removed at which rankings are compared; the largest loss counts."""

LEAST_VIEWS = 16
"""Fewer views are all used: too few would be left to validate."""

FIRST, MORE, VALIDATING = (0, 1, 2, 3), (4,), (5, 6)
"""Groups of views, of eight: those that measure first, those that measure next, and those that
validate. The latter and the eighth group measure too if the others are not enough."""

CASTING = 0.05
"""Share of the time of the first round that the rays of the validation views take, to show
progress."""


def score(  # noqa: PLR0913 - as `occlusion.score`, and the tolerance
    splats: Splats,
    views: ViewSet,
    tolerance: float,
    settings: Occlusion,
    *,
    settled: int | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Scores:
    """Score splats by occlusion, with no more views than are needed.

    Parameters
    ----------
    splats, settings, settled, progress, threads
        See `occlusion.score`.
    views : ViewSet
        Those that may be used.
    tolerance : float
        By how much the PSNR of the pictures may be lower than with all views, dB.

    Returns
    -------
    Scores
        ``facts["auto"]`` tells what the validation views expect and what is estimated to be lost;
        ``views_used`` how many views measured.

    Raises
    ------
    RefineError, Cancelled
        See `occlusion.score`.
    """
    scoring = MemoryScoring(
        splats, views, settings, groups=groups_of(views),
        progress=part(progress, 0.0, 0.1), threads=threads,
    )  # fmt: skip
    return finish(
        scoring, tolerance, settled=settled, progress=part(progress, 0.1, 1.0), threads=threads
    )


def finish(
    scoring: OcclusionScoring,
    tolerance: float,
    *,
    settled: int | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Scores:
    """Return the scores of a scoring that has measured nothing yet.

    Parameters
    ----------
    scoring : OcclusionScoring
        With the groups of `groups_of`, if these are not None.
    tolerance, settled, progress, threads
        See `score`.
    """
    end = FIRST_END if scoring.rounds > 1 else 1.0
    measuring_progress = part(progress, 0.0, end)
    if len(scoring.measuring.views) < LEAST_VIEWS or not tolerance:
        scoring.measure(range(scoring.measuring.count), measuring_progress)
        loss, expected = 0.0, dict[str, list[float]]()
    else:
        loss, expected = _measure(scoring, tolerance, measuring_progress, threads)
    scores = scoring.rank(part(progress, end, 1.0), settled)
    facts = {"views": scores.views_used, "loss": loss, "tolerance": tolerance, "expected": expected}
    return replace(scores, facts={**scores.facts, "auto": facts}, method="auto")


def groups_of(views: ViewSet) -> list[list[int]] | None:
    """Return the numbers of the views of each of eight groups, as in `ViewSet.by_distance`.

    The first four groups are half of the views, spread evenly over all.

    Parameters
    ----------
    views : ViewSet

    Returns
    -------
    list of list of int, or None
        None if there are fewer than `LEAST_VIEWS` views of positive weight.
    """
    order = [view for view, _ in views.by_distance()]
    if len(order) < LEAST_VIEWS:
        return None
    half = Counter(map(id, views.spread((len(order) + 1) // 2)))  # one view may be there twice
    first: list[int] = []
    rest: list[int] = []
    for number, view in enumerate(order):
        (first if half[id(view)] else rest).append(number)
        half[id(view)] -= half[id(view)] > 0
    return [numbers[k::4] for numbers in (first, rest) for k in range(4)]


def _measure(
    scoring: OcclusionScoring, tolerance: float, progress: Progress, threads: int | None
) -> tuple[float, dict[str, list[float]]]:
    """Measure the splats from as many of the views of `groups_of` as are needed; see `score`.

    Return what the views that were left out are estimated to gain, dB, and the PSNR that the
    validation views tell of the two rankings at `RATIOS`, dB.
    """
    groups, rays = scoring.measuring.groups, scoring.validation_rays
    validating = [number for k in VALIDATING for number in groups[k]]
    assert rays is not None  # noqa: S101 - a scoring of several views has them
    casting_progress = part(progress, 0.0, CASTING)
    rays.cast(validating, scoring.gaussians, scoring.measuring.scene, casting_progress, threads)
    scoring.measure(FIRST, part(progress, CASTING, 0.55))
    scoring.measure(MORE, part(progress, 0.55, 0.7))
    few, more, every = (
        sum(len(groups[k]) for k in chosen) for chosen in (FIRST, FIRST + MORE, range(len(groups)))
    )
    psnr = {}
    for count, chosen in ((few, FIRST), (more, FIRST + MORE)):
        values = scoring.in_one_round(chosen, part(progress, 0.7, 0.7))
        told = psnr_by_views(rays, values, RATIOS, validating, threads=threads)
        if told is not None:
            psnr[count] = told
    expected = {f"{count} views": told.round(2).tolist() for count, told in psnr.items()}
    loss = math.inf
    if len(psnr) == 2:  # noqa: PLR2004 - both were told
        # No eye tells apart what is above `UNSEEN`.
        gain = np.minimum(psnr[more], UNSEEN) - np.minimum(psnr[few], UNSEEN)
        loss = max(float(gain.max()), 0.0) * (1 / more - 1 / every) / (1 / few - 1 / more)
    if loss <= tolerance:
        return loss, expected
    scoring.measure(range(len(FIRST + MORE), len(groups)), part(progress, 0.7, 1.0))
    return 0.0, expected
