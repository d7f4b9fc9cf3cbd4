"""The way from splats, views and a budget to the splats that stay.

The panel, the command and Python code all call `decide`, so all of them keep the same splats. It
has two steps: the splats are scored and the budget selects by score; then, if survivors are to
absorb the others, as many survivors are found again, by merging.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from . import selection
from .absorbing import absorb as absorbing
from .absorbing.merge_field import ViewSums
from .estimate.alignment import alignment
from .estimate.psnr import psnr_against, psnr_kept, quality_curve
from .estimate.quality import FEWEST, left_to_lose, needed, out_of_reach
from .report import Clock, make_report, size_in_words
from .scoring import auto, closed_form, occlusion
from .seeing.ray_sample import validation_rays
from .selection import Budget
from .task import DEFAULTS, Result, Settings, Task
from .volumes import refuse_all
from .work import Progress, part, report, silent

if TYPE_CHECKING:
    from typing import Any

    from numpy.typing import NDArray

    from .absorbing.absorb import Absorbed, Counts
    from .scores import Scores
    from .seeing.measuring import Measured
    from .selection import RowBytes
    from .splats import Splats
    from .views import ViewSet

UNSEEN = "the views see too little for an estimate of the pictures' quality"
UNESTIMATED = "the closed form estimates the pictures' quality only if a PSNR is the budget"
UNFORETOLD = f"what absorbing reaches is not foretold for fewer than {FEWEST:,} splats"
"""Why there is no estimate: notes of the report."""

MEASURES = "absorbing measures by occlusion: closed-form was not used"
"""A note of the report."""

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


def score(  # noqa: PLR0913 - as `prune`
    splats: Splats,
    views: ViewSet,
    settings: Settings = DEFAULTS,
    *,
    protected: NDArray[np.bool_] | None = None,
    removed: NDArray[np.bool_] | None = None,
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
    removed : (N,) bool, optional
        Splats that are to go in any case: the others are scored as if they had gone, and they
        score 0; see `Task`.
    quality : bool
        Whether the scores get an estimate of the pictures' quality even if that takes longer than
        scoring by the closed form; scores by occlusion always have one.
    settled : int, optional
        How many splats must be in their final order, those that are `removed` left out: scoring by
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
        If there are no splats, if none of them can be drawn, or if no view sees any.
    Cancelled
        If `progress` answers ``False``.
    """
    if removed is not None and removed.any():
        refuse_all(removed)
        rest = ~removed
        found = score(
            splats.take(rest), views, settings,
            protected=None if protected is None else protected[rest],
            quality=quality, settled=settled, progress=progress, threads=threads,
        )  # fmt: skip
        return found.for_all(rest)
    whole, estimates = progress, quality or settings.estimates
    progress = part(progress, 0.0, 0.9 if estimates else 1.0)
    # Numbers that underflow to 0 are negligible in all sums.
    with np.errstate(under="ignore"):
        used = views.spread(settings.views)
        if settings.method == "occlusion":
            scores = occlusion.score(
                splats, used, settings.occlusion,
                settled=settled, progress=progress, threads=threads,
            )  # fmt: skip
        elif settings.method == "auto":
            scores = auto.score(
                splats, used, settings.tolerance, settings.occlusion,
                settled=settled, progress=progress, threads=threads,
            )  # fmt: skip
        else:
            scores = closed_form.score(
                splats, used, settings.closed_form, progress=progress, threads=threads
            )
        if quality and scores.ray_sample is None:
            rays = validation_rays(splats, used, progress=part(whole, 0.9, 0.95), threads=threads)
            scores = replace(scores, ray_sample=rays)
    scores = _with_views(scores, splats, views, used, part(whole, 0.95, 0.95), threads)
    ahead = part(whole, 0.95, 1.0)
    return with_quality(scores, protected=protected, progress=ahead, threads=threads)


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
        progress=progress, threads=threads,
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
    """Return scores with what there is to say of all views, not only of those used.

    Parameters
    ----------
    scores : Scores
    splats : Splats
    views, used : ViewSet
        Those given, and those chosen from them.
    progress : callable
    threads : int, optional
    """
    notes = (*scores.notes, views.note) if views.note else scores.notes
    # Beside the closed form, measuring would take as long as scoring.
    some = None if scores.ray_sample is None else used
    found = alignment(splats, views, some, progress=progress, threads=threads)
    return replace(scores, views_given=len(views), notes=notes, alignment=found)


def prune(  # noqa: PLR0913 - the main function of core; all but three are optional
    splats: Splats,
    views: ViewSet,
    budget: Budget,
    settings: Settings = DEFAULTS,
    *,
    protected: NDArray[np.bool_] | None = None,
    removed: NDArray[np.bool_] | None = None,
    absorb: bool = False,
    row_bytes: RowBytes = 0.0,
    fixed_bytes: int = 0,
    progress: Progress = silent,
    threads: int | None = None,
) -> Result:
    """Score splats and decide which of them stay; with `absorb`, also merge the others into them.

    Parameters
    ----------
    splats, views, settings, progress, threads
        See `score`.
    budget : Budget
        How much to remove.
    protected : (N,) bool, optional
        Splats that are neither removed nor changed.
    removed : (N,) bool, optional
        Splats that go in any case, unless they are protected; see `Task`.
    absorb : bool
        See `Task`.
    row_bytes, fixed_bytes
        See `Budget.removals`.

    Returns
    -------
    Result

    Raises
    ------
    RefineError, Cancelled
        See `score`; also if no splat would be left.
    """
    task = Task(
        budget=budget,
        settings=settings,
        splats=splats,
        views=views,
        protected=protected,
        removed=removed,
        absorb=absorb,
        row_bytes=row_bytes,
        fixed_bytes=fixed_bytes,
    )
    return decide(task, progress=progress, threads=threads)


def decide(
    task: Task,
    *,
    clock: Clock | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Result:
    """Decide which splats stay and, to absorb, what they become. Nothing is changed or written.

    Step 1 selects by scores, which are computed unless the task has them. Step 2, only to absorb,
    keeps the number of survivors, but finds them and their new values by merging.

    Parameters
    ----------
    task : Task
    clock : Clock, optional
        Gets the timings of the steps; by default a new one.
    progress, threads
        See `score`.

    Returns
    -------
    Result

    Raises
    ------
    RefineError, Cancelled
        See `score` and `selection.select`; also if all splats have to go.
    """
    clock, forced = clock or Clock(), task.forced()
    if forced is None:
        if task.scores is not None:
            task.scores.refuse_unscored()
        result = _decide(task, clock, progress, threads)
    else:
        result = _decide(task.without(forced), clock, progress, threads).for_all(~forced)
        result.report["budget"] = {task.budget.kind: getattr(task.budget, task.budget.kind)}
    for name, mask in (("protected", task.protected), ("forced", forced)):
        result.report["splats"][name] = 0 if mask is None else int(np.count_nonzero(mask))
    return result


def _decide(task: Task, clock: Clock, progress: Progress, threads: int | None) -> Result:
    """Decide on a task from which nothing has to go in any case."""
    scored = 0.2 if task.absorb else 0.95
    scores, known = _scores_of(task, part(progress, 0.0, scored), threads)
    if not (task.scores is None or task.budget.psnr is None or task.protected is None):
        # Others may have been protected when these were scored.
        scores = with_quality(scores, protected=task.protected, threads=threads)
    clock.lap("score_s")
    report(progress, scored, "selecting")
    if task.absorb and task.budget.psnr is not None:
        keep = np.ones(len(scores.values), np.bool_)  # how many survive is found by absorbing
    else:
        keep = selection.select(
            scores,
            task.budget,
            protected=task.protected,
            row_bytes=task.row_bytes,
            fixed_bytes=task.fixed_bytes,
        )
    clock.lap("select_s")
    absorbed = None
    if task.absorb:
        count = int(np.count_nonzero(keep))
        ahead = part(progress, 0.2, 1.0)
        absorbed, psnr = _absorbed(task, count, known, ahead, threads)
        keep = absorbed.keep
        clock.lap("absorb_s")
    else:
        psnr = _estimated(scores, keep, threads)
    facts = make_report(scores, keep, task.budget, task.settings, clock)
    size = int(np.broadcast_to(task.row_bytes, len(keep)).sum() + task.fixed_bytes)
    gone = len(keep) - int(np.count_nonzero(keep))
    why = remark(task.budget, gone, len(keep), psnr, size)
    conclude(facts, scores, keep, psnr, absorbed, why)
    if absorbed and known and task.settings.method == "closed-form":
        facts["notes"].append(MEASURES)
    return Result(keep, scores, facts, absorbed)


def remark(budget: Budget, gone: int, total: int, psnr: float | None, size: int) -> str:
    """Return why a budget is out of reach or removes nothing, or "".

    Parameters
    ----------
    budget : Budget
    gone, total : int
        How many splats go, of how many.
    psnr : float or None
        The estimate for the result, dB.
    size : int
        Bytes of the file before.
    """
    if budget.psnr is not None:
        return out_of_reach(budget.psnr, gone, total, psnr)
    if budget.max_mb is not None and not gone:
        return f"already {size_in_words(size)}: the budget removes nothing"
    return ""


def conclude(
    facts: dict[str, Any],
    scores: Scores,
    keep: NDArray[np.bool_],
    psnr: float | None,
    absorbed: Counts | None,
    why: str,
) -> None:
    """Add to a report what it says about the quality of the pictures and about absorbing.

    Parameters
    ----------
    facts : dict
        The report; changed.
    scores : Scores
    keep : (N,) bool
    psnr : float or None
        The estimate for the result, dB.
    absorbed : Counts or None
        What survivors absorbed, if they did.
    why : str
        See `remark`.
    """
    facts |= _quality_facts(scores, keep, psnr, absorbed=absorbed is not None)
    if psnr is None and scores.ray_sample is not None:
        facts["notes"].append(UNSEEN)
    facts["budget_remark"] = why
    if why:
        facts["notes"].append(why)
    if absorbed is not None:
        facts["absorbed"] = absorbed.facts()
        facts["notes"].append(absorbed.note())


def _quality_facts(
    scores: Scores, keep: NDArray[np.bool_], psnr: float | None, *, absorbed: bool
) -> dict[str, Any]:
    """Return what a report says about the quality of the pictures; see `conclude`."""
    curve, other = scores.quality, psnr if absorbed else None
    if curve is not None and curve.foretold and not absorbed:
        other = curve.at(1.0 - float(np.mean(keep)), absorb=True)
    why = why_other = None
    if psnr is None:
        why = UNESTIMATED if scores.ray_sample is None else UNSEEN
    if other is None:
        why_other = UNFORETOLD if psnr is not None else why
    return {
        "estimated_psnr": None if psnr is None else round(psnr, 2),
        "estimated_psnr_absorbed": None if other is None else round(other, 2),
        "estimated_psnr_note": why,
        "estimated_psnr_absorbed_note": why_other,
        "quality": curve.facts() if curve is not None else None,
    }


def _estimated(scores: Scores, keep: NDArray[np.bool_], threads: int | None) -> float | None:
    """Return the estimated PSNR with some splats deleted, dB; None where nothing tells it."""
    if scores.ray_sample is not None:
        return psnr_kept(scores.ray_sample, keep, threads=threads)
    if scores.quality is not None:
        return scores.quality.at(1.0 - float(np.mean(keep)))
    return None


def _absorbed(
    task: Task,
    count: int,
    known: tuple[Scores, Measured] | None,
    progress: Progress,
    threads: int | None,
) -> tuple[Absorbed, float | None]:
    """Return what absorbing makes of a task, and the estimated PSNR of it, dB.

    Parameters
    ----------
    task : Task
    count : int
        How many survive, unless the budget is a PSNR: then as few as keep it. What a number of
        survivors reaches is expected first, and put right by what it reached.
    known : tuple of Scores and Measured, optional
        See `absorb_removed`.
    progress : callable
    threads : int, optional
    """
    splats, views = task.scene()
    start = 0.0 if known else 0.2
    goal, ahead = task.budget.psnr, part(progress, 0.0, start)
    known = known or _score_once(
        splats, views, task.settings, ahead, threads, curve=goal is not None
    )
    scores = known[0]
    if goal is not None and scores.quality is None:
        scores = with_quality(scores, protected=task.protected, threads=threads)
    used, origin = views.spread(task.settings.views), task.origin
    truth = scores.ray_sample if origin is None else origin.ray_sample
    best: tuple[Absorbed, float | None] | None = None
    offset, tries = 0.0, 1 if goal is None else TRIES
    if goal is not None and origin is not None:
        offset = goal - left_to_lose(goal, origin.psnr)
    for number in range(tries):
        if goal is not None:
            curve = selection.quality_of(scores)
            share = curve.share(goal - offset, absorb=True)
            count = len(splats) - math.floor(share * len(splats))
        low, high = (start + (1.0 - start) * (number + k) / tries for k in (0, 1))
        ahead = part(progress, low, high)
        absorbed = absorb_removed(
            splats, views, count, task.settings, known=known, protected=task.protected,
            began=None if origin is None else origin.count,
            progress=part(ahead, 0.0, 0.95), threads=threads,
        )  # fmt: skip
        psnr = None
        if truth is not None:
            psnr = psnr_against(
                truth, absorbed.splats, used, progress=part(ahead, 0.95, 1.0), threads=threads
            )
        if goal is None or psnr is None:
            return absorbed, psnr
        if best is None or abs(psnr - goal) < abs((best[1] or 0.0) - goal):
            best = absorbed, psnr
        if abs(psnr - goal) <= CLOSE:
            break
        gone = 1.0 - len(absorbed.splats) / len(splats)
        offset = psnr - curve.at(gone, absorb=True)
    assert best is not None  # noqa: S101 - every try gives one
    return best


def _scores_of(
    task: Task, progress: Progress, threads: int | None
) -> tuple[Scores, tuple[Scores, Measured] | None]:
    """Return the scores of a task.

    Returns
    -------
    scores : Scores
    known : tuple of Scores and Measured, or None
        See `absorb_removed`.
    """
    if task.scores is not None:
        return task.scores, None
    splats, views = task.scene()
    if task.absorb and not task.budget.needs_scores:
        # The number of survivors does not depend on scores, so the scores for absorbing are enough.
        goal = task.budget.psnr
        known = _score_once(splats, views, task.settings, progress, threads, curve=goal is not None)
        if goal is not None:
            curve = with_quality(known[0], protected=task.protected, threads=threads)
            known = curve, known[1]
        return known[0], known
    # `select` checks this too, but only after the work.
    task.budget.refuse_meaningless(task.settings.method, frustum=task.settings.frustum)
    scores = score(
        splats,
        views,
        task.settings,
        protected=task.protected,
        quality=task.budget.psnr is not None,
        settled=_settled(task),
        progress=progress,
        threads=threads,
    )
    return scores, None


def _settled(task: Task) -> int | None:
    """Return how many splats a task needs in their final order; None for all."""
    if task.reusable:
        return None
    total = len(task.scene()[0])
    held = 0 if task.protected is None else int(np.count_nonzero(task.protected))
    found = needed(task.budget.removals(total, task.row_bytes, task.fixed_bytes), total)
    # Those that are protected stay, wherever in the order they are.
    return None if found is None or found + held >= total else found + held


def _score_once(
    splats: Splats,
    views: ViewSet,
    settings: Settings,
    progress: Progress,
    threads: int | None,
    *,
    curve: bool = False,
) -> tuple[Scores, Measured]:
    """Return scores by occlusion in one round, and what was measured of each splat.

    With `curve` the lines of sight tell the whole curve of the PSNR, else only that of a result.
    """
    used = views.spread(settings.views)
    with np.errstate(under="ignore"):  # as in `score`
        scores, measured = occlusion.score_once(
            splats, used, settings.occlusion, few_views=not curve,
            progress=part(progress, 0.0, 0.99), threads=threads,
        )  # fmt: skip
    ahead = part(progress, 0.99, 1.0)
    return _with_views(scores, splats, views, used, ahead, threads), measured


def absorb_removed(  # noqa: PLR0913 - as `prune`
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
) -> Absorbed:
    """Reduce splats to `count` survivors that absorb the others.

    Parameters
    ----------
    splats, views, settings, progress, threads
        See `score`; the occlusion settings are used for every method.
    count : int
        How many survive.
    known : tuple of Scores and Measured, optional
        The results of `occlusion.score_once` for these splats and views, if known.
    began : int, optional
        How many splats there were before some of them became these by absorbing. What is deleted
        first, and how patient merging is, go by the share that has gone of those.
    protected : (N,) bool, optional
        Splats that are neither removed nor changed.

    Returns
    -------
    Absorbed

    Raises
    ------
    RefineError, Cancelled
        See `score`.
    """
    used, total = views.spread(settings.views), len(splats)
    scores, measured = known or _score_once(
        splats, views, settings, part(progress, 0.0, 0.2), threads
    )
    began = total if began is None else began
    # How many of all are deleted before any are merged, and how many of those are still there.
    deleted = max(min(math.floor(FIRST * began), began - count), 0)
    first = max(deleted - (began - total), 0)
    # Undrawable splats have the lowest scores, so these go first.
    rest = selection.select(scores, Budget(keep=total - first), protected=protected)
    # The deleted splats hid almost nothing, so the first stage need not measure again.
    at_first = [ViewSums(measured.contribution[rest], measured.error[rest])]
    del known, scores, measured
    turns = itertools.count()

    def measure(now: Splats, expected: ViewSums | None, ahead: Progress) -> ViewSums:
        if expected is None:
            return at_first.pop()
        found, share = occlusion.measure_part(
            now, used, settings.occlusion, next(turns), PARTS, progress=ahead, threads=threads
        )
        return ViewSums(
            found.contribution + (1.0 - share) * expected.contribution,
            found.error + (1.0 - share) * expected.error,
        )

    with np.errstate(under="ignore"):  # as in `score`
        absorbed = absorbing.absorb(
            splats.take(rest), used, measure, count,
            began=began - deleted, protected=None if protected is None else protected[rest],
            progress=part(progress, 0.2, 1.0), threads=threads,
        )  # fmt: skip
    keep = np.zeros(total, np.bool_)
    keep[np.flatnonzero(rest)[absorbed.keep]] = True
    gone = total - int(np.count_nonzero(rest))
    return replace(absorbed, keep=keep, deleted=absorbed.deleted + gone)
