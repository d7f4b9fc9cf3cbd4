"""Which splats are kept, and their new values, by views and a budget.

Panel, command and Python code all call `prune`. It scores the splats, and the budget selects by
score. Methods that may change kept splats merge until as many are left, and then refit, if asked.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import report as reports
from .errors import RefineError
from .execute import Cancelled, Progress, in_file, part, report, seconds, silent, stages, within
from .formats.ply import SplatFile
from .merging.merge import Merged, copied, merge, stage_counts, stage_seconds
from .methods import DEFAULT, ClosedForm, Method, Refit
from .quality.alignment import alignment
from .quality.curve import AS_GOOD, FARTHER, PLAIN, Way, deletion_will_do, left_to_lose, needed
from .quality.psnr import psnr_against, psnr_kept, with_quality
from .refit.refit import Refitted, expected_rounds, refit_rounds
from .report import Chosen, Clock, Estimates
from .result import Origin, Result
from .scores import Scores
from .scoring import closed_form, occlusion
from .selection import Budget, quality_of, select
from .splats import Splats
from .views import ViewSet, refuse_other
from .visibility.cast import validation_rays
from .visibility.measuring import Measured
from .volumes import Forced, must_go

CLOSE = 0.7  # largest distance of an estimate from the PSNR of the budget, dB, else merge again

FIRST = 0.1
"""Share of splats deleted before any merge: deleting the lowest scores costs less than merging."""

PARTS = 2
"""Parts of the views that are measured in turn while splats are merged; other parts keep their
values meanwhile."""

REFITTING = "refitting"
"""What progress says during refitting. A prune that is cancelled then has a result, see
`Result.stopped`."""


def score(
    splats: Splats | SplatFile,
    views: ViewSet,
    method: Method = DEFAULT,
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
    splats : Splats or SplatFile, in the frame of the views
    views : ViewSet; those used are chosen by `Method.views`
    method : Method; `ClosedForm` scores by its formula, all others by occlusion
    protected : (N,) bool, optional; only the estimated PSNR depends on it, no score does
    removed : (N,) bool, optional; the others are scored as if these were gone, these score 0
    quality : bool, whether the closed form estimates the PSNR, which takes longer than scoring
    settled : int, optional
        How many of the lowest scores, besides `removed`, need their final order: fewer is faster.
    progress : callable, optional; ``progress(fraction, what)``, returning ``False`` cancels
    threads : int, optional; by default the cores of this process, at most 8

    Returns
    -------
    Scores : of all N splats

    Raises
    ------
    RefineError : no splats, none that can be drawn or that a view sees, or `views` is no `ViewSet`
    Cancelled
    """
    refuse_other(views)
    splats = splats.splats() if isinstance(splats, SplatFile) else splats
    if (gone := must_go(removed)) is not None:
        rest = ~gone
        scores = score(
            splats.take(rest), views, method,
            protected=None if protected is None else protected[rest],
            quality=quality, settled=settled, progress=progress, threads=threads,
        )  # fmt: skip
        return scores.for_all(rest)
    used, count = method.used(views), len(splats)
    by_formula = isinstance(method, ClosedForm)
    kind = "closed form" if by_formula else "measure"
    most = 0 if by_formula else method.between(used)
    cast = seconds("cast", count, len(used)) if quality or not by_formula else 0.0
    deciding = occlusion.expected_views(len(used), most)
    scoring, casting, estimating = stages(
        progress, 1.35 * seconds(kind, count, deciding), cast if by_formula else 0.0, cast
    )
    # Numbers that underflow to 0 are negligible in all sums.
    with np.errstate(under="ignore"), within(cores=threads):
        if by_formula:
            scores = closed_form.score(splats, used, progress=scoring)
            if quality:
                rays = validation_rays(splats, used, progress=casting)
                scores = replace(scores, ray_sample=rays)
        else:
            scores, _ = occlusion.score(
                splats, used, settled=settled, most_between=most, progress=scoring
            )
        scores = _with_views(scores, splats, views, used)
        return with_quality(scores, protected, estimating)


def _with_views(scores: Scores, splats: Splats, views: ViewSet, used: ViewSet) -> Scores:
    """Scores with alignment and notes on all views given, not only on those used."""
    notes = (*scores.notes, views.note) if views.note else scores.notes
    # After the closed form, measuring would take as long as scoring did.
    measured = None if scores.ray_sample is None else used
    aligned = alignment(splats, views, measured)
    return replace(scores, views_given=len(views), notes=notes, alignment=aligned)


def prune(
    splats: Splats | SplatFile | None,
    views: ViewSet | None,
    budget: Budget,
    method: Method = DEFAULT,
    *,
    protected: NDArray[np.bool_] | None = None,
    removed: NDArray[np.bool_] | None = None,
    scores: Scores | None = None,
    sizes: tuple[float, int] | None = None,
    origin: Origin | None = None,
    reusable: bool = False,
    partial: bool = False,
    clock: Clock | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Result:
    """Decide which splats are kept and their new values. Nothing is changed or written.

    Parameters
    ----------
    splats, views, progress, threads
        See `score`. Splats and views may be None if `scores` are given and `method` only deletes.
    budget : Budget; if `method` merges, only the number of kept splats comes from it
    method : Method
    protected : (N,) bool, optional; neither removed nor changed
    removed : (N,) bool, optional
        Removed first, unless protected; the budget counts them. The others are scored, merged and
        compared with pictures as if these had never been there.
    scores : Scores, optional; of an earlier `score`, to delete by: a merging method measures anew
    sizes : (float, int), optional; bytes of a splat and of the rest of the output, for `max_mb`
    origin : Origin, optional; the splats before an earlier merging prune, for comparing pictures
    reusable : bool, whether scores are to serve other budgets; else scoring ends at this one
    partial : bool, whether a cancelled refit returns its last round (`Result.stopped`)
    clock : Clock, optional; gets the times of the steps

    Returns
    -------
    Result

    Raises
    ------
    RefineError, Cancelled : see `score` and `select`; also if no splat would be left
    """
    file = splats if isinstance(splats, SplatFile) else None
    if file is not None:
        splats = file.splats()
        sizes = sizes or (file.row_bytes, file.fixed_bytes)
    if views is not None:
        refuse_other(views)
    gone = must_go(removed, protected)
    run = _Prune(
        splats, views, budget, method, protected, None if method.changes else scores,
        sizes or (0.0, 0), origin, reusable, clock or Clock(),
    )  # fmt: skip
    if scores is not None and gone is None:
        scores.refuse_unscored()
    run = run if gone is None else run.without(gone)
    with within(cores=threads):
        result = run.merge(progress) if method.changes else run.delete(progress)
    if gone is not None:
        result = result.for_all(~gone)
        result.report["budget"] = {budget.kind: getattr(budget, budget.kind)}
    result.report["splats"] |= Forced(protected, gone).counts()
    if result.stopped is not None and not partial:
        raise result.stopped
    return replace(result, source=file or splats)


class Outcome(NamedTuple):
    """Result of merging, and of refitting, if asked."""

    merged: Merged  # before refitting; by deletion where that is better to begin with
    done: Way
    psnr: Estimates
    refitted: Refitted | None = None
    seconds: float = 0.0  # of refitting
    stopped: Cancelled | KeyboardInterrupt | None = None  # what ended refitting early

    @property
    def reached(self) -> float | None:
        """Estimated PSNR of the final splats, dB."""
        return self.psnr[self.done]

    @property
    def final(self) -> Merged:
        """The kept splats with their final values."""
        if self.refitted is None:
            return self.merged
        changed = self.merged.changed | self.refitted.changed
        return replace(self.merged, splats=self.refitted.splats, changed=changed)


class _Prune(NamedTuple):
    """One prune; fields as the arguments of `prune`."""

    splats: Any  # Splats, or None where scores are given
    views: Any  # ViewSet, or None
    budget: Budget
    method: Method
    protected: NDArray[np.bool_] | None
    scores: Scores | None
    sizes: tuple[float, int]
    origin: Origin | None
    reusable: bool
    clock: Clock

    @property
    def used(self) -> ViewSet:
        if self.views is None or self.splats is None:
            raise RefineError("expected splats and views: scoring and merging need both")
        return self.method.used(self.views)

    def without(self, gone: NDArray[np.bool_]) -> _Prune:
        """Prune of the rest once some splats, (N,) bool, are gone."""
        rest = ~gone
        return self._replace(
            splats=None if self.splats is None else self.splats.take(rest),
            budget=self.budget.after(int(np.count_nonzero(gone)), len(gone)),
            protected=None if self.protected is None else self.protected[rest],
            scores=None if self.scores is None else self.scores.of(rest),
        )

    def delete(self, progress: Progress) -> Result:
        """Decide by scores alone."""
        scores = self.scores
        if scores is None:
            scores = score(
                self.splats, self.views or self.used, self.method,
                protected=self.protected, quality=self.budget.psnr is not None,
                settled=self._settled(), progress=part(progress, 0.0, 0.94),
            )  # fmt: skip
        elif self.budget.psnr is not None and self.protected is not None:
            # Other splats may have been protected when these scores were made.
            scores = with_quality(scores, self.protected)
        self.clock.lap("score_s")
        report(progress, 0.94, "selecting")
        return self._result(scores, self._select(scores))

    def _result(self, scores: Scores, chosen: Chosen, outcome=None, tried=None) -> Result:
        """Result of deletion, or the `Outcome` of merging; `tried` if deletion was as good."""
        summary = reports.of_prune(self, scores, chosen, outcome, tried)
        merged = None if outcome is None or outcome.done == "delete" else outcome.final
        return Result(chosen[0], summary, scores, merged, getattr(outcome, "stopped", None))

    def merge(self, progress: Progress) -> Result:
        """Merge down to the budget, refit if asked; delete where that is as good."""
        used, goal, count = self.used, self.budget.psnr, len(self.splats)
        most = self.method.between(used)
        views = occlusion.expected_views(len(used), most)
        refits = isinstance(self.method, Refit)
        gone = self.budget.removals(count, *self.sizes)
        left = count // 2 if gone is None else count - gone
        expected = sum(self._expected_seconds(left, views)) * (2.2 if goal else 1.0)
        scoring, making = stages(progress, seconds("measure", count, views), expected)
        scores, measurement = occlusion.score(
            self.splats, used, rounds=1, few_views=goal is None,
            most_between=most, progress=scoring,
        )  # fmt: skip
        scores = _with_views(scores, self.splats, self.views, used)
        if goal is not None:
            scores = with_quality(scores, self.protected)
        self.clock.lap("score_s")
        chosen: Chosen = np.ones(count, np.bool_), None, None
        if not (refits and goal is not None):
            report(making, 0.0, "selecting")
            chosen = self._select(scores)
        keep, plain, beside = chosen
        if (  # so that merging need not be tried
            all(map(deletion_will_do, (plain, beside))) if goal is None
            else not refits and quality_of(scores).share(goal, "merge") <= PLAIN
        ):  # fmt: skip
            return self._result(scores, chosen)
        if goal is None:
            outcome = self._to_count(keep, scores, measurement, making)
        else:
            outcome = self._to_psnr(goal, scores, measurement, making)
        self.clock.lap("merge_s")
        between, rays = None, self._first(scores).scores.between
        if rays is not None and outcome.stopped is None:
            between = psnr_against(rays, outcome.final.splats, used)
        pairs = [(plain, outcome.reached)]
        if beside is not None and between is not None:
            pairs.append((beside, between + FARTHER * (scores.views_between > 0)))
        if not refits and self._deletion_is_as_good(keep, outcome, *pairs):
            tried = outcome.psnr
            del outcome  # not needed where memory is highest
            scores = occlusion.in_rounds(  # up to 5 dB more than one round
                self.splats, scores, measurement, settled=self._settled(),
                progress=lambda *_: progress(1.0, "selecting"),
            )  # fmt: skip
            if goal is not None:
                scores = with_quality(scores, self.protected)
            return self._result(scores, self._select(scores), tried=tried)
        if goal is None:  # else deletion keeps another number of splats
            outcome = outcome._replace(psnr={"delete": plain, **outcome.psnr})
        chosen = outcome.merged.keep, outcome.reached, between
        return self._result(scores, chosen, outcome)

    def _first(self, scores: Scores) -> Origin:
        """The splats before any merging prune, with which results are compared."""
        return self.origin or Origin(self.splats, scores)

    def _settled(self) -> int | None:
        """How many splats are needed in their final order; None for all."""
        if self.reusable:
            return None
        total = len(self.splats)
        spared = 0 if self.protected is None else int(np.count_nonzero(self.protected))
        gone = needed(self.budget.removals(total, *self.sizes), total)
        # Protected splats are passed over, wherever in the order they are.
        return None if gone is None or gone + spared >= total else gone + spared

    def _select(self, scores: Scores) -> Chosen:
        keep = select(
            scores, self.budget, protected=self.protected,
            row_bytes=self.sizes[0], fixed_bytes=self.sizes[1],
        )  # fmt: skip
        gone, curve, psnr, between = 1.0 - float(np.mean(keep)), scores.quality, None, None
        if scores.ray_sample is not None:
            psnr = psnr_kept(scores.ray_sample, keep)
        elif curve is not None:
            psnr = curve.at(gone)
        if scores.between is not None:
            between = psnr_kept(scores.between, keep)
        elif curve is not None:
            between = curve.at_between(gone)
        self.clock.lap("select_s")
        return keep, psnr, between

    def _deletion_is_as_good(self, keep, outcome: Outcome, *pairs: tuple[Any, Any]) -> bool:
        """Whether deletion, keeping (N,), is about as good.

        `pairs` are the PSNR of deletion and of merging, dB, in views that decided and in others.
        """
        if None in itertools.chain(*pairs):
            return True
        if self.budget.psnr is None:
            return all(deleted > merged - AS_GOOD for deleted, merged in pairs)
        (plain, reached), *_ = pairs
        missed = reached < self.budget.psnr - CLOSE and reached < plain
        return missed or np.count_nonzero(keep) <= len(outcome.merged.splats)

    def _expected_seconds(self, left: int, views: int) -> tuple[float, float, float]:
        """Expected seconds of merging to `left` splats, of the estimate then, and of refitting."""
        count = len(self.splats)
        counts = stage_counts(max(math.ceil((1.0 - FIRST) * count), left), left)
        refit = 0.0
        if isinstance(self.method, Refit):
            rounds = expected_rounds(left, self.method.rounds)
            refit = rounds * seconds("refit", count + left, views)
        compared = seconds("compare", left, len(self.used))
        return sum(stage_seconds(count, counts, views)), compared, refit

    def _to_count(self, keep, scores: Scores, measurement: Measured, progress: Progress) -> Outcome:
        """Merge until as many are left as deletion keeps, (N,); refit if asked."""
        first, used, left = self._first(scores), self.used, int(np.count_nonzero(keep))
        expected = self._expected_seconds(left, len(scores.deciding or used))
        merging_progress, comparing, refitting = stages(progress, *expected)
        rays: Any = first.scores.ray_sample
        estimated = partial(psnr_against, rays, views=used)
        merged = merge_down(
            self.splats, left, scored=(scores, measurement), protected=self.protected,
            began=len(first.splats), progress=merging_progress,
        )  # fmt: skip
        psnr = estimated(merged.splats, progress=comparing)
        if not isinstance(self.method, Refit):
            return Outcome(merged, "merge", {"merge": psnr})
        rest = copied(self.splats, np.flatnonzero(keep))
        gone = len(keep) - len(rest)
        deleted = Merged(rest, keep, np.zeros(len(rest), np.bool_), 0, gone)  # changes none
        plain = estimated(deleted.splats)
        less = plain is not None and psnr is not None and plain > psnr
        kept = deleted if less else merged
        kept = replace(kept, splats=in_file(kept.splats))
        outcome = Outcome(kept, "delete" if less else "merge", {"delete": plain, "merge": psnr})
        del merged, deleted, rest  # one of them is not needed while splats are refitted
        outcome = self._refitted(outcome, scores.deciding or used, refitting)
        if outcome.refitted is None or outcome.stopped is not None:
            return outcome
        return outcome._replace(psnr=outcome.psnr | {"refit": estimated(outcome.refitted.splats)})

    def _to_psnr(
        self, goal: float, scores: Scores, measurement: Measured, progress: Progress
    ) -> Outcome:
        """Merge to as few splats as keep a PSNR, dB."""
        # The number comes from the scores' curve, corrected by what the last try reached. Once one
        # try keeps the PSNR and another does not, it is interpolated between the two.
        total, curve = len(self.splats), quality_of(scores)
        way: Way = "refit" if isinstance(self.method, Refit) else "merge"
        gone = curve.share(left_to_lose(goal, self._first(scores).psnr), way)
        tried, best = dict[int, float](), None  # PSNR, dB, by number of kept splats
        for of_try in stages(progress, 1.0, 1.0, 0.2):
            count = max(total - math.floor(gone * total), 1)
            if count in tried:
                break
            keep = select(scores, Budget(keep=count), protected=self.protected)
            outcome = self._to_count(keep, scores, measurement, of_try)
            if outcome.stopped is not None:
                return (best or outcome)._replace(stopped=outcome.stopped)
            if outcome.reached is None:
                return outcome
            tried[count] = outcome.reached
            # What misses the PSNR least; one within `CLOSE` or above comes first.
            if count == min(
                tried, key=lambda kept: (tried[kept] < goal - CLOSE, abs(tried[kept] - goal))
            ):
                best = outcome
            if abs(outcome.reached - goal) <= CLOSE:
                break
            kept = len(outcome.merged.splats)
            wanted = goal - outcome.reached + curve.at(1.0 - kept / total, way)
            gone = _share_between(tried, goal, total) or curve.share(wanted, way)
        assert best is not None  # every try gives one
        return best

    def _refitted(self, outcome: Outcome, views: ViewSet, progress: Progress) -> Outcome:
        """Refit to the views' pictures of the unpruned splats; if cancelled, the rounds so far."""
        assert isinstance(self.method, Refit)
        merged, start = outcome.merged, time.perf_counter()
        if merged.keep.all() and self.origin is None:
            return outcome
        done, stopped = None, None
        try:
            for reached in refit_rounds(
                merged.splats, (self.origin or self).splats, views, self.method.rounds,
                protected=None if self.protected is None else self.protected[merged.keep],
                progress=lambda fraction, _what: progress(fraction, REFITTING),
            ):  # fmt: skip
                done = reached
        except (Cancelled, KeyboardInterrupt) as stop:
            stopped = stop.with_traceback(None)  # which holds the arrays of the round
            if done is None or not done.rounds:
                stop.add_note("refitting was stopped before its first round was done")
                return outcome._replace(stopped=stopped)
            stop.add_note(f"refitting was stopped after round {done.rounds}")
        assert done is not None  # the merged splats are yielded first
        return outcome._replace(
            done="refit", psnr=outcome.psnr | {"refit": done.psnr}, refitted=done,
            seconds=time.perf_counter() - start, stopped=stopped,
        )  # fmt: skip


def _share_between(tried: Mapping[int, float], goal: float, total: int) -> float | None:
    """Share of `total` to remove by the tries next to a PSNR, linear in its log odds, or None."""
    finite = [kept for kept in tried if kept < total]  # those whose odds are finite
    above = min((kept for kept in finite if tried[kept] >= goal), default=0)
    below = max((kept for kept in finite if tried[kept] < goal), default=0)
    if not (above and below):
        return None
    odds = np.log([total / kept - 1.0 for kept in (below, above)])
    place = np.interp(goal, [tried[below], tried[above]], odds)
    return float(1.0 / (1.0 + np.exp(-place)))


def merge_down(
    splats: Splats,
    count: int,
    *,
    scored: tuple[Scores, Measured],
    began: int,
    protected: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
) -> Merged:
    """Merge splats until `count` are left, by the views that decided; errors as by `score`.

    `scored` comes from `occlusion.score`. `began` is the number before earlier merges:
    deletion before merging, and the merge penalty, depend on the share removed since then.
    """
    total = len(splats)
    scores, measured = scored
    views: Any = scores.deciding
    # How many of all are deleted before any are merged, and how many of those are still there.
    deleted = max(min(math.floor(FIRST * began), began - count), 0)
    first = max(deleted - (began - total), 0)
    # Undrawable splats have the lowest scores, so these go first.
    rest = select(scores, Budget(keep=total - first), protected=protected)
    # The deleted splats hid almost nothing, so the first stage need not measure again.
    sums = measured[:2]
    del scored, scores, measured
    turns = itertools.count()

    def measure(now: Splats, expected: Measured, progress: Progress) -> Measured:
        return occlusion.measure_part(now, views, next(turns), PARTS, expected, progress=progress)

    with np.errstate(under="ignore"):  # as in `score`
        return merge(
            splats, views, sums, measure, count,
            began=began - deleted, deleted=~rest, protected=protected, progress=progress,
        )  # fmt: skip
