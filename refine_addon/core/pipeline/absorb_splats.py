"""Absorbing down to a budget: how many survive, what is deleted first, what is measured when."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .. import costs
from ..costs import Plan
from ..execute import Progress, part, silent
from ..merging.merge import Merged, merge, stage_counts
from ..merging.stage import copied
from ..pace import phases
from ..quality.curve import left_to_lose
from ..quality.psnr import psnr_against
from ..refit.refit import expected_rounds
from ..refit.round_rays import limits
from ..scores import Scores
from ..scoring import occlusion
from ..selection import Budget, quality_of, select
from ..splats import Splats
from ..survivor_choice import Became
from ..task import DEFAULTS, Settings, Task
from ..views import ViewSet
from ..visibility.measuring import Measured
from ..visibility.ray_sample import VALIDATION_VIEWS
from .refit_splats import Made, refit_made
from .score_splats import score_once, with_quality

TRIES = 3
"""How often absorbing is done at most to reach a PSNR."""

CLOSE = 0.7
"""How close to a PSNR the estimate for a result must be, dB, or absorbing is done again."""

FIRST = 0.1
"""Share of the splats that is deleted before any are merged: those with the lowest scores, whose
deletion changes the pictures less than any merge."""

PARTS = 2
"""While splats are merged, they are measured again in one of so many parts of the views, which take
turns; what the other views see is carried over."""


def absorb_task(
    task: Task,
    keep: NDArray[np.bool_],
    known: tuple[Scores, Measured] | None,
    progress: Progress,
    threads: int | None,
) -> Made:
    """Return what absorbing, and refitting if asked, makes of a task.

    Parameters
    ----------
    task : Task
    keep : (N,) bool
        Which splats plain deletion keeps: as many survive, unless the budget is a PSNR: then as few
        as keep it.
    known : tuple of Scores and Measured, optional
        See `absorb_removed`.
    progress : callable
    threads : int, optional

    Returns
    -------
    Made
    """
    goal, (splats, views) = task.budget.psnr, task.scene()
    left = len(splats) // 2 if goal is not None else int(np.count_nonzero(keep))
    scoring, deciding, comparing = phases(progress, *absorbing_plans(task, left, scored=known))
    if known is None:
        known = score_once(splats, views, task.settings, scoring, threads, curve=goal is not None)
    if goal is None:
        made = _absorb_to_count(task, keep, known, deciding, threads)
    else:
        made = _absorb_to_psnr(task, goal, known, deciding, threads)
    between = (known[0] if task.origin is None else task.origin).between
    if between is None or made.stopped is not None:
        return made
    psnr = psnr_against(
        between, made.survivors.splats, task.scene()[1],
        progress=comparing, threads=threads,
    )  # fmt: skip
    return replace(made, psnr_between=psnr)


def absorbing_plans(task: Task, left: int, *, scored: object) -> list[Plan]:
    """Return the costs of scoring once, unless that is done, of what follows, of what lies between.

    Parameters
    ----------
    task : Task
    left : int
        How many splats survive.
    scored : object
        Whether the scores are there.
    """
    splats, views = task.scene()
    count, used = len(splats), views.spread(task.settings.views)
    return [
        [] if scored else costs.joined(costs.scoring_once(count, costs.Images.of(used))),
        costs.joined(_to_count(task, left)),
        costs.comparing(left, min(len(used), costs.BETWEEN)),
    ]


def _to_count(task: Task, left: int) -> list[Plan]:
    """Return the costs of absorbing down to a number of splats.

    These are absorbing, comparing, refitting, and comparing again.
    """
    splats, views = task.scene()
    count, used = len(splats), views.spread(task.settings.views)
    compared = costs.comparing(left, min(len(used), VALIDATION_VIEWS))
    absorbed = _stages(count, left, costs.Images.of(used))
    if task.survivors != "refit":
        return [absorbed, compared, [], []]
    rounds = expected_rounds(left, task.settings.rounds)
    refitted = costs.refitting(count, left, len(used), limits(left)[0], rounds)
    return [absorbed, 2 * compared, costs.joined(refitted), compared]


def _stages(count: int, left: int, images: costs.Images) -> Plan:
    """Return the costs of the stages of absorbing; the first tenth is deleted before."""
    begin = max(count - math.floor(FIRST * count), left)
    return costs.joined(costs.absorbing(begin, stage_counts(begin, left), images))


def _absorb_to_count(
    task: Task,
    keep: NDArray[np.bool_],
    known: tuple[Scores, Measured],
    progress: Progress,
    threads: int | None,
) -> Made:
    """Return what as many survivors become as deletion keeps, and the estimated PSNR of it, dB."""
    splats, views = task.scene()
    origin, refits = task.origin, task.survivors == "refit"
    truth = known[0].ray_sample if origin is None else origin.ray_sample
    used, left = views.spread(task.settings.views), int(np.count_nonzero(keep))
    absorbing_progress, comparing, refitting, last = phases(progress, *_to_count(task, left))

    def estimated(survivors: Splats, progress: Progress) -> float | None:
        if truth is None:
            return None
        return psnr_against(truth, survivors, used, progress=progress, threads=threads)

    absorbed = absorb_removed(
        splats, views, left, task.settings,
        known=known, protected=task.protected,
        began=None if origin is None else len(origin.splats),
        progress=absorbing_progress, threads=threads,
    )  # fmt: skip
    if not refits:
        return Made(absorbed, estimated(absorbed.splats, comparing))
    plain = estimated(splats.take(keep), part(comparing, 0.0, 0.5))
    psnr = estimated(absorbed.splats, part(comparing, 0.5, 1.0))
    made = Made(absorbed, psnr, before={"unchanged": plain, "absorb": psnr})
    if plain is not None and psnr is not None and plain > psnr:
        made = replace(made, absorbed=_deleted(splats, keep), psnr=plain, began="unchanged")
    made = refit_made(task, made, refitting, threads)
    if made.refitted is None or made.stopped is not None:
        return made
    return replace(made, psnr=estimated(made.refitted.splats, last))


def _deleted(splats: Splats, keep: NDArray[np.bool_]) -> Merged:
    """Return what plain deletion leaves, as absorbing returns it."""
    left = copied(splats, np.flatnonzero(keep))
    return Merged(left, keep, np.zeros(len(left), np.bool_), 0, len(keep) - len(left))


def _absorb_to_psnr(
    task: Task,
    goal: float,
    known: tuple[Scores, Measured],
    progress: Progress,
    threads: int | None,
) -> Made:
    """Return the result with as few survivors as keep a PSNR, dB.

    What a number of survivors reaches is read from the curve of the scores, put right by what the
    last try reached; between a try that keeps the PSNR and one that does not, from these two.
    """
    scores, total = known[0], len(task.scene()[0])
    if scores.quality is None:
        scores = with_quality(scores, protected=task.protected, threads=threads)
    curve = quality_of(scores)
    way: Became = "refit" if task.survivors == "refit" else "absorb"
    origin = None if task.origin is None else task.origin.psnr
    once = costs.joined(_to_count(task, total // 2))
    tries = phases(progress, once, once, [])
    gone, tried, best = curve.share(left_to_lose(goal, origin), way), list[_Try](), None
    for number in range(TRIES):
        count = max(total - math.floor(gone * total), 1)
        if any(count == one.survivors for one in tried):
            break
        keep = select(known[0], Budget(keep=count), protected=task.protected)
        made = _absorb_to_count(task, keep, known, tries[number], threads)
        if made.stopped is not None:
            return replace(best or made, stopped=made.stopped)
        if made.psnr is None:
            return made
        tried.append(_Try(count, made.psnr))
        if best is None or min(tried, key=lambda one: one.misses(goal)) is tried[-1]:
            best = made
        if abs(made.psnr - goal) <= CLOSE:
            break
        gone = 1.0 - len(made.absorbed.splats) / total
        gone = _between(tried, goal, total) or curve.share(
            goal - made.psnr + curve.at(gone, way), way
        )
    assert best is not None
    return best


class _Try(NamedTuple):
    """How many survivors reached which PSNR, dB."""

    survivors: int
    psnr: float

    def misses(self, goal: float) -> tuple[bool, float]:
        """Return by how much it misses a PSNR, as a key: above is better than below."""
        return self.psnr < goal - CLOSE, abs(self.psnr - goal)


def _between(tried: Sequence[_Try], goal: float, total: int) -> float | None:
    """Return which share of `total` has to go by the tries next to a PSNR; None without both.

    The PSNR is taken as linear in the logarithm of the odds of that share, as by `Quality.at`.
    """
    above = min((one for one in tried if one.psnr >= goal), default=None)
    below = max((one for one in tried if one.psnr < goal), default=None)
    if above is None or below is None:
        return None
    odds = np.log([total / one.survivors - 1.0 for one in (below, above)])
    place = np.interp(goal, [below.psnr, above.psnr], odds)
    return float(1.0 / (1.0 + np.exp(-place)))


def absorb_removed(
    splats: Splats,
    views: ViewSet,
    count: int,
    settings: Settings = DEFAULTS,
    *,
    known: tuple[Scores, Measured] | None = None,
    began: int | None = None,
    protected: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Merged:
    """Reduce splats to `count` survivors that absorb the others.

    Parameters
    ----------
    splats, views, settings, progress, threads
        See `score_splats.score`; the occlusion settings are used for every method.
    count : int
        How many survive.
    known : tuple of Scores and Measured, optional
        The results of `occlusion.score_once` for these splats and views, if known.
    began : int, optional
        How many splats there were before these absorbed others. What is deleted first, and what
        merging costs, go by the share of them that has gone.
    protected : (N,) bool, optional
        Splats that are neither removed nor changed.

    Returns
    -------
    Merged

    Raises
    ------
    RefineError, Cancelled
        See `score_splats.score`.
    """
    used, total = views.spread(settings.views), len(splats)
    scoring, absorbing_progress = phases(
        progress,
        [] if known else costs.joined(costs.scoring_once(total, costs.Images.of(used))),
        _stages(total, count, costs.Images.of(used)),
        threads=threads,
    )
    scores, measured = known or score_once(splats, views, settings, scoring, threads)
    began = total if began is None else began
    # How many of all are deleted before any are merged, and how many of those are still there.
    deleted = max(min(math.floor(FIRST * began), began - count), 0)
    first = max(deleted - (began - total), 0)
    # Undrawable splats have the lowest scores, so these go first.
    rest = select(scores, Budget(keep=total - first), protected=protected)
    # The deleted splats hid almost nothing, so the first stage need not measure again.
    sums = np.array([measured.contribution, measured.error])
    del known, scores, measured
    turns = itertools.count()

    def measure(
        now: Splats, expected: NDArray[np.float64], stage_progress: Progress
    ) -> NDArray[np.float64]:
        measured, share = occlusion.measure_part(
            now, used, next(turns), PARTS, sampling=settings.occlusion,
            progress=stage_progress, threads=threads,
        )  # fmt: skip
        return np.array([measured.contribution, measured.error]) + (1.0 - share) * expected

    with np.errstate(under="ignore"):  # as in `score_splats.score`
        return merge(
            splats, used, sums, measure, count,
            began=began - deleted, deleted=~rest, protected=protected,
            progress=absorbing_progress, threads=threads,
        )  # fmt: skip
