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
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .. import costs
from ..execute import Progress, silent
from ..pace import phases
from ..quality.curve import UNSEEN
from ..quality.psnr import psnr_by_views
from ..scores import Scores
from ..splats import Splats
from ..views import ViewSet
from .occlusion import MemoryScoring, Occlusion, OcclusionScoring, survivors_of_rounds

RATIOS = (0.3, 0.5, 0.7, 0.9)
"""Shares removed at which rankings are compared; the largest loss counts."""

LEAST_VIEWS = 16
"""Fewer views are all used: too few would be left to validate."""

FIRST, MORE, VALIDATING = (0, 1, 2, 3), (4,), (5, 6)
"""Groups of views, of eight: those that measure first, those that measure next, and those that
validate. The latter and the eighth group measure too if the others are not enough."""


def score(
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
    stays = survivors_of_rounds(len(splats), settings.rounds, settled)
    preparing, *later = costs.by_auto(len(splats), costs.Images.of(views), stays)
    prepared, rest = phases(progress, preparing, costs.joined(later), threads=threads)
    scoring = MemoryScoring(
        splats, views, settings, groups=groups_of(views), progress=prepared, threads=threads
    )
    return finish(scoring, tolerance, settled=settled, progress=rest, threads=threads)


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
    count = len(scoring.prior)
    images = costs.Images.of(view for view, _ in scoring.measuring.views)
    stays = survivors_of_rounds(count, scoring.rounds, settled)
    finds_out = images.views >= LEAST_VIEWS and bool(tolerance)
    plan = costs.by_auto if finds_out else costs.occlusion
    measuring_progress, ranking = phases(progress, *plan(count, images, stays)[1:])
    if not finds_out:
        scoring.measure(range(scoring.measuring.count), measuring_progress)
        loss, expected = 0.0, dict[str, list[float]]()
    else:
        loss, expected = _measure(scoring, tolerance, measuring_progress, threads)
    scores = scoring.rank(ranking, settled)
    used = scores.views_used
    facts = {
        "views": used,
        "given": images.views,
        "loss": loss,
        "tolerance": tolerance,
        "expected": expected,
        "saved": round(saved(count, images, used, stays), 3) if finds_out else 0.0,
    }
    return replace(scores, facts={**scores.facts, "auto": facts}, method="auto")


def saved(count: int, images: costs.Images, used: int, stays: Sequence[int]) -> float:
    """Return about which part of the time of scoring by all views was saved; see `costs`."""
    every = costs.seconds(costs.joined(costs.occlusion(count, images, stays)))
    casting, _, _, comparing, _ = costs.auto(count, images, *costs.auto_views(images.views))
    spared = costs.seconds([images.measuring(count, images.views - used)])
    return (spared - costs.seconds([*casting, *comparing])) / every


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
    assert rays is not None
    few, more, every = (
        sum(len(groups[k]) for k in chosen) for chosen in (FIRST, FIRST + MORE, range(len(groups)))
    )
    count = len(scoring.prior)
    images = costs.Images.of(view for view, _ in scoring.measuring.views)
    casting, first, second, comparing, rest = phases(
        progress,
        *costs.auto(count, images, len(validating), few, more - few, every - more),
    )
    rays.cast(validating, scoring.gaussians, scoring.measuring.scene, casting, threads)
    scoring.measure(FIRST, first)
    scoring.measure(MORE, second)
    rankings = [scoring.in_one_round(chosen, comparing) for chosen in (FIRST, FIRST + MORE)]
    psnr = psnr_by_views(rays, rankings, RATIOS, validating, threads=threads)
    loss, expected = math.inf, dict[str, list[float]]()
    if psnr is not None:
        told = zip((few, more), psnr.round(2).tolist(), strict=True)
        expected = {f"{count} views": of_count for count, of_count in told}
        # No eye tells apart what is above `UNSEEN`.
        gain = np.diff(np.minimum(psnr, UNSEEN), axis=0)
        loss = max(float(gain.max()), 0.0) * (1 / more - 1 / every) / (1 / few - 1 / more)
    if loss <= tolerance:
        return loss, expected
    (rest,) = phases(rest, [images.measuring(count, every - more)])
    scoring.measure(range(len(FIRST + MORE), len(groups)), rest)
    return 0.0, expected
