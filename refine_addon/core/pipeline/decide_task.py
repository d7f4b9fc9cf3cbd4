"""The way from splats, views and a budget to the splats that stay.

The panel, the command and Python code all call `decide`, so all of them keep the same splats. It
has two steps: splats are scored, and the budget selects by score; then, if survivors may change,
splats are merged until as many are left as were selected, and those are refitted, if asked.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import selection
from ..costs import Cost, Plan, joined
from ..execute import Progress, report, silent
from ..merging.merge import Merged
from ..pace import phases
from ..quality.cost import expected_seconds
from ..quality.curve import AS_GOOD, PLAIN, deletion_will_do, in_words, needed
from ..quality.psnr import psnr_kept
from ..report import (
    MEASURES,
    Clock,
    conclude,
    conclude_between,
    expected_psnr,
    in_tenths,
    make_report,
    remark,
)
from ..scores import Scores
from ..selection import Budget, RowBytes
from ..splats import Splats
from ..survivor_choice import Became, SurvivorChoice
from ..task import DEFAULTS, Result, Settings, Task
from ..views import ViewSet, refuse_other
from ..visibility.measuring import Measured
from .absorb_splats import CLOSE, absorb_task, absorbing_plans
from .refit_splats import Made, unchanged_note
from .score_splats import score, score_once, scoring_plans, with_quality

TYPICAL = 0.5
"""Share of the splats that is expected to go where only scores tell it."""


def prune(
    splats: Splats,
    views: ViewSet,
    budget: Budget,
    settings: Settings = DEFAULTS,
    *,
    protected: NDArray[np.bool_] | None = None,
    forced_out: NDArray[np.bool_] | None = None,
    survivors: SurvivorChoice = "auto",
    row_bytes: RowBytes = 0.0,
    fixed_bytes: int = 0,
    progress: Progress = silent,
    threads: int | None = None,
) -> Result:
    """Score splats and decide which of them stay, and what those become.

    Parameters
    ----------
    splats, views, settings, progress, threads
        See `score`.
    budget : Budget
        How much to remove.
    protected : (N,) bool, optional
        Splats that are neither removed nor changed.
    forced_out : (N,) bool, optional
        Splats that go in any case, unless they are protected; see `Task`.
    survivors : {"auto", "unchanged", "absorb", "refit"}
        What survivors may become; see `Task`.
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
        forced_out=forced_out,
        survivors=survivors,
        row_bytes=row_bytes,
        fixed_bytes=fixed_bytes,
    )
    result = decide(task, progress=progress, threads=threads)
    if result.stopped is not None:
        raise result.stopped
    return result


def decide(
    task: Task,
    *,
    clock: Clock | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Result:
    """Decide which splats stay and what they become. Nothing is changed or written.

    Step 1 selects by scores, which are computed unless the task has them. Step 2, only if survivors
    may change, keeps the number of survivors, but finds them and their new values by merging, and
    refits them, if asked. If it is cancelled while it refits, or by a signal, the result is what
    refitting had reached; `Result.stopped` says so.

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


def planned(task: Task) -> Plan:
    """Return what it is expected to cost to decide on a task."""
    return joined(_plans(task) if task.absorb else _deleting_plans(task))


def _deleting_plans(task: Task) -> list[Plan]:
    """Return what scoring and selecting are expected to cost."""
    if task.scores is not None:
        return [[], [Cost("selecting", len(task.scores.values))]]
    splats, views = task.scene()
    refuse_other(views)
    quality = task.budget.psnr is not None
    scored = joined(scoring_plans(splats, views, task.settings, _settled(task), quality=quality))
    selecting = [Cost("selecting", len(splats))] if quality or task.settings.estimates else []
    return [scored, selecting]


def _plans(task: Task) -> list[Plan]:
    """Return what scoring once, selecting, and absorbing are expected to cost."""
    splats, views = task.scene()
    refuse_other(views)
    count, budget = len(splats), task.budget
    left = round(count * (1.0 - TYPICAL))
    if budget.ratio is not None or budget.keep is not None:
        left = count - min(budget.removals(count) or 0, count)
    by_default = task.survivors == "auto"
    scored, *rest = absorbing_plans(task, left, scored=None if by_default else task.scores)
    return [scored, [Cost("selecting", count)], joined(rest)]


def _decide(task: Task, clock: Clock, progress: Progress, threads: int | None) -> Result:
    """Decide on a task from which nothing has to go in any case."""
    if not task.absorb:
        return _delete(task, clock, progress, threads)
    by_default = task.survivors == "auto"
    # Stored scores rank otherwise, and must not change what is chosen by default.
    trial = replace(task, scores=None) if by_default else task
    scoring, selecting, absorbing, deleting = phases(progress, *_plans(task), [], threads=threads)
    scores, known = _scored(trial, clock, scoring, threads)
    report(selecting, 0.0, "selecting")
    keep, plain = _deleting(trial, scores, threads)
    clock.lap("select_s")
    made = None
    if not (by_default and _will_do(task, scores, plain)):
        made = absorb_task(task, keep, known, absorbing, threads)
        clock.lap("absorb_s")
        if not (by_default and _as_good(task, keep, plain, made)):
            return _absorbed(task, scores, plain, made, clock)
    result = _delete(replace(task, survivors="unchanged"), clock, deleting, threads)
    facts, psnr = result.report, result.report["estimated_psnr"]
    measured: dict[Became, float | None] = {"unchanged": psnr}
    if made is not None and task.budget.psnr is None:  # of as many survivors
        measured |= made.measured()
    gone = facts["splats"]["removed"] / len(result.keep)
    facts["survivors"] |= {"asked": "auto", **expected_psnr(scores, gone, measured)}
    if gone:
        facts["notes"].append(unchanged_note(psnr, made))
    return result


def _delete(task: Task, clock: Clock, progress: Progress, threads: int | None) -> Result:
    """Decide by scores alone."""
    scoring, selecting = phases(progress, *_deleting_plans(task), threads=threads)
    scores, _ = _scored(task, clock, scoring, threads)
    report(selecting, 0.0, "selecting")
    keep, psnr = _deleting(task, scores, threads)
    clock.lap("select_s")
    facts = _facts(task, scores, keep, psnr, clock)
    conclude_between(facts, _estimated_between(scores, keep, threads), scores.seen)
    gone = facts["splats"]["removed"] / len(keep)
    facts["survivors"] = {
        "asked": task.survivors,
        "became": "unchanged",
        **expected_psnr(scores, gone, {"unchanged": psnr}),
        "seconds": _seconds(task, clock, gone, once=False),
    }
    return Result(keep, scores, facts)


def _absorbed(task: Task, scores: Scores, plain: float | None, made: Made, clock: Clock) -> Result:
    """Return the result of what survivors became."""
    absorbed = made.absorbed
    facts = _facts(task, scores, absorbed.keep, made.psnr, clock, absorbed)
    conclude_between(facts, made.psnr_between, scores.seen)
    gone = facts["splats"]["removed"] / len(absorbed.keep)
    measured = made.measured()
    if task.budget.psnr is None:  # else deletion keeps another number of splats
        measured.setdefault("unchanged", plain)
    once = task.survivors == "auto" or (task.scores is None and not task.budget.needs_scores)
    facts["survivors"] = {
        "asked": task.survivors,
        "became": made.became,
        **expected_psnr(scores, gone, measured),
        "seconds": _seconds(task, clock, gone, once=once),
    }
    facts |= made.facts()
    facts["notes"] += made.notes()
    if made.became == "absorb" and plain is not None and plain > (made.psnr or plain):
        facts["notes"].append(f"plain deletion reaches more: {in_words(plain)}")
    if once and task.settings.method == "closed-form":
        facts["notes"].append(MEASURES)
    survivors = None if made.became == "unchanged" else made.survivors
    return Result(absorbed.keep, scores, facts, survivors, made.stopped)


def _facts(
    task: Task,
    scores: Scores,
    keep: NDArray[np.bool_],
    psnr: float | None,
    clock: Clock,
    absorbed: Merged | None = None,
) -> dict[str, Any]:
    """Return the report, but for what survivors may become."""
    facts = make_report(scores, keep, task.budget, task.settings, clock)
    size = int(np.broadcast_to(task.row_bytes, len(keep)).sum() + task.fixed_bytes)
    why = remark(task.budget, facts["splats"]["removed"], len(keep), psnr, size)
    conclude(facts, scores, keep, psnr, absorbed, why)
    facts["splats"]["unseen_removed"] = int(np.count_nonzero((scores.seen == 0) & ~keep))
    return facts


def _scored(
    task: Task, clock: Clock, progress: Progress, threads: int | None
) -> tuple[Scores, tuple[Scores, Measured] | None]:
    """Return the scores that decide, and `known` of `absorb_removed` if that came with them."""
    scores, known = _scores_of(task, progress, threads)
    if not (task.scores is None or task.budget.psnr is None or task.protected is None):
        # Others may have been protected when these were scored.
        scores = with_quality(scores, protected=task.protected, threads=threads)
    clock.lap("score_s")
    return scores, known


def _seconds(task: Task, clock: Clock, share: float, *, once: bool) -> dict[Became, float] | None:
    """Return about how long it takes by what survivors become; None where scoring tells nothing."""
    if not once and (task.scores is not None or not task.settings.estimates):
        return None
    return in_tenths(expected_seconds(clock.timings["score_s"], share, once=once))


def _deleting(
    task: Task, scores: Scores, threads: int | None
) -> tuple[NDArray[np.bool_], float | None]:
    """Return which splats plain deletion keeps, (N,), and the estimated PSNR, dB.

    All splats where survivors absorb in any case to reach a PSNR: how many survive is found by
    absorbing.
    """
    if task.absorb and task.survivors != "auto" and task.budget.psnr is not None:
        return np.ones(len(scores.values), np.bool_), None
    keep = selection.select(
        scores,
        task.budget,
        protected=task.protected,
        row_bytes=task.row_bytes,
        fixed_bytes=task.fixed_bytes,
    )
    return keep, _estimated(scores, keep, threads)


def _will_do(task: Task, scores: Scores, plain: float | None) -> bool:
    """Return whether absorbing need not be tried, given what plain deletion reaches, dB."""
    goal = task.budget.psnr
    if task.survivors != "auto":
        return False
    if goal is None:
        return deletion_will_do(plain)
    return selection.quality_of(scores).share(goal, "absorb") <= PLAIN


def _as_good(task: Task, keep: NDArray[np.bool_], plain: float | None, made: Made) -> bool:
    """Return whether plain deletion is about as good as what was made by absorbing."""
    if plain is None or made.psnr is None:
        return True
    if task.budget.psnr is not None:
        missed = made.psnr < task.budget.psnr - CLOSE and made.psnr < plain
        return missed or np.count_nonzero(keep) <= len(made.absorbed.splats)
    return plain > made.psnr - AS_GOOD


def _estimated(scores: Scores, keep: NDArray[np.bool_], threads: int | None) -> float | None:
    """Return the estimated PSNR with some splats deleted, dB; None where nothing tells it."""
    if scores.ray_sample is not None:
        return psnr_kept(scores.ray_sample, keep, threads=threads)
    if scores.quality is not None:
        return scores.quality.at(1.0 - float(np.mean(keep)))
    return None


def _estimated_between(
    scores: Scores, keep: NDArray[np.bool_], threads: int | None
) -> float | None:
    """Return the same in views between those that scored, dB."""
    if scores.between is not None:
        return psnr_kept(scores.between, keep, threads=threads)
    if scores.quality is not None:
        return scores.quality.at_between(1.0 - float(np.mean(keep)))
    return None


def _scores_of(
    task: Task, progress: Progress, threads: int | None
) -> tuple[Scores, tuple[Scores, Measured] | None]:
    """Return the scores of a task, and `known` of `absorb_removed` if that came with them."""
    if task.scores is not None:
        return task.scores, None
    splats, views = task.scene()
    if task.absorb and not task.budget.needs_scores:
        # The number of survivors does not depend on scores, so the scores for absorbing are enough.
        goal = task.budget.psnr
        known = score_once(splats, views, task.settings, progress, threads, curve=goal is not None)
        if goal is not None:
            curve = with_quality(known[0], protected=task.protected, threads=threads)
            known = curve, known[1]
        return known[0], known
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
    spared = 0 if task.protected is None else int(np.count_nonzero(task.protected))
    removed = needed(task.budget.removals(total, task.row_bytes, task.fixed_bytes), total)
    # Those that are protected stay, wherever in the order they are.
    return None if removed is None or removed + spared >= total else removed + spared
