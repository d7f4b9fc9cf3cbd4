"""The one way through: splats, views and a budget in; what stays, and what becomes of it, out.

The panel's buttons, the command and Python code all come through `decide`, in two steps: the
budget, asked of scores, says which splats stay; where they are to absorb the others, what the views
see says which ones stay instead, and as what. So all of them keep the same splats.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from . import selection
from .absorbing import absorb as absorbing
from .absorbing.merging import ViewSums
from .formats.ply import read_ply
from .report import Clock, Files, complete_report, make_report
from .scoring import auto, closed_form, occlusion
from .selection import Budget
from .survivors import survivor_columns
from .task import DEFAULTS, Result, Settings, Task
from .whole_file import expanded, refuse_existing, refuse_mapped
from .work import Progress, part, report, silent

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from .absorbing.absorb import Absorbed
    from .scores import Scores
    from .scoring.measuring import Measured
    from .splats import Splats
    from .views import ViewSet

FIRST = 0.1
"""Share of the splats that goes before any are merged: what the views would miss least is next to
nothing, and any merge changes more."""


def score(
    splats: Splats,
    views: ViewSet,
    settings: Settings = DEFAULTS,
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> Scores:
    """Score splats by how much the views would miss each.

    Parameters
    ----------
    splats : Splats
        In the frame of the views.
    views : ViewSet
    settings : Settings
    progress : callable, optional
        ``progress(fraction, what)``; returning ``False`` cancels.
    threads : int, optional

    Returns
    -------
    Scores

    Raises
    ------
    RefineError
        If there are no splats, or no view sees any.
    Cancelled
        If `progress` answers ``False``.
    """
    # What is too small for a float is nothing beside what counts: it may underflow to 0.
    with np.errstate(under="ignore"):
        used = views.spread(settings.views)
        if settings.method == "occlusion":
            scores = occlusion.score(
                splats, used, settings.occlusion, progress=progress, threads=threads
            )
        elif settings.method == "auto":
            models = (settings.closed_form, settings.occlusion)
            scores = auto.score(
                splats, used, settings.tolerance, models, progress=progress, threads=threads
            )
        else:
            scores = closed_form.score(
                splats, used, settings.closed_form, progress=progress, threads=threads
            )
    return _with_views(scores, views)


def _with_views(scores: Scores, views: ViewSet) -> Scores:
    """Return scores that know of all the views there were, not only of those used."""
    notes = (*scores.notes, views.note) if views.note else scores.notes
    return replace(scores, views_given=len(views), notes=notes)


def prune(  # noqa: PLR0913 - the use case: what, by which views, how much, how
    splats: Splats,
    views: ViewSet,
    budget: Budget,
    settings: Settings = DEFAULTS,
    *,
    protected: NDArray[np.bool_] | None = None,
    absorb: bool = False,
    row_bytes: float = 0.0,
    fixed_bytes: int = 0,
    progress: Progress = silent,
    threads: int | None = None,
) -> Result:
    """Score splats and decide which stay; with `absorb`, what becomes of them.

    Parameters
    ----------
    splats, views, settings, progress, threads
        See `score`.
    budget : Budget
        How much to remove.
    protected : (N,) bool, optional
        Splats never to remove, nor to change.
    absorb : bool
        Whether survivors absorb what is removed. The budget then says how many survive; which ones
        do, and as what, is found by what the views see of each, whatever the method.
    row_bytes, fixed_bytes
        See `Budget.removals`.

    Returns
    -------
    Result

    Raises
    ------
    RefineError, Cancelled
        See `score`; also if the budget would leave nothing.
    """
    task = Task(
        budget=budget,
        settings=settings,
        splats=splats,
        views=views,
        protected=protected,
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
    """Decide which splats stay; with `absorb`, what becomes of them. Changes and writes nothing.

    Step 1: scores, new ones or those that are there, and the budget say which splats stay. Step 2,
    to absorb: as many survive, but which ones, and as what, is found by merging.

    Parameters
    ----------
    task : Task
    clock : Clock, optional
        Takes the times of the steps, in a row with what is timed before and after.
    progress, threads
        See `score`.

    Returns
    -------
    Result

    Raises
    ------
    RefineError, Cancelled
        See `score` and `selection.select`.
    """
    clock = clock or Clock()
    scored = 0.2 if task.absorb else 0.95
    scores, known = _scores_of(task, part(progress, 0.0, scored), threads)
    clock.lap("score_s")
    report(progress, scored, "selecting")
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
        splats, views = task.scene()
        absorbed = absorb_removed(
            splats, views, int(np.count_nonzero(keep)), task.settings, known=known,
            protected=task.protected, progress=part(progress, 0.2, 1.0), threads=threads,
        )  # fmt: skip
        keep = absorbed.keep
        clock.lap("absorb_s")
    facts = make_report(scores, keep, task.budget, task.settings, clock)
    if absorbed:
        facts["absorbed"] = absorbed.facts()
        facts["notes"].append(absorbed.note())
        if known and task.settings.method != "occlusion":
            name = task.settings.method
            facts["notes"].append(f"absorbing measures by occlusion: {name} had nothing to decide")
    return Result(keep, scores, facts, absorbed)


def _scores_of(
    task: Task, progress: Progress, threads: int | None
) -> tuple[Scores, tuple[Scores, Measured] | None]:
    """Return the scores that decide and, where absorbing asked for them, what it needs of them."""
    if task.scores is not None:
        return task.scores, None
    splats, views = task.scene()
    if task.absorb and not task.budget.needs_scores:
        # How many go does not depend on the scores, so those that absorbing needs will do.
        known = _score_once(splats, views, task.settings, progress, threads)
        return known[0], known
    # `select` would refuse it as well, but only after the work.
    task.budget.refuse_meaningless(task.settings.method, frustum=task.settings.frustum)
    return score(splats, views, task.settings, progress=progress, threads=threads), None


def _score_once(
    splats: Splats, views: ViewSet, settings: Settings, progress: Progress, threads: int | None
) -> tuple[Scores, Measured]:
    with np.errstate(under="ignore"):  # as for scores
        scores, measured = occlusion.score_once(
            splats,
            views.spread(settings.views),
            settings.occlusion,
            progress=progress,
            threads=threads,
        )
    return _with_views(scores, views), measured


def absorb_removed(  # noqa: PLR0913 - the use case, the other one
    splats: Splats,
    views: ViewSet,
    count: int,
    settings: Settings = DEFAULTS,
    *,
    known: tuple[Scores, Measured] | None = None,
    protected: NDArray[np.bool_] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> Absorbed:
    """Reduce splats to `count` survivors that absorb the others, by what the views see of each.

    Parameters
    ----------
    splats, views, settings, progress, threads
        See `score`; the occlusion settings count, whatever the method.
    count : int
        How many survive.
    known : tuple of Scores and Measured, optional
        What `occlusion.score_once` says of these splats and views, if it was asked already.
    protected : (N,) bool, optional
        Splats that neither vanish nor change.

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
    first = max(min(math.floor(FIRST * total), total - count), 0)
    # What no renderer draws scores lowest, so it is among these, or all of these are such.
    rest = selection.select(scores, Budget(keep=total - first), protected=protected)
    # What goes first hid and showed next to nothing: what was measured with it still holds.
    at_first = [ViewSums(measured.contribution[rest], measured.error[rest])]
    del known, scores, measured

    def seen(now: Splats, ahead: Progress) -> ViewSums:
        if at_first:
            return at_first.pop()
        found = occlusion.measure(now, used, settings.occlusion, progress=ahead, threads=threads)
        return ViewSums(found.contribution, found.error)

    with np.errstate(under="ignore"):  # as for scores
        absorbed = absorbing.absorb(
            splats.take(rest), used, seen, count,
            protected=None if protected is None else protected[rest],
            progress=part(progress, 0.2, 1.0), threads=threads,
        )  # fmt: skip
    keep = np.zeros(total, np.bool_)
    keep[np.flatnonzero(rest)[absorbed.keep]] = True
    gone = total - int(np.count_nonzero(rest))
    return replace(absorbed, keep=keep, deleted=absorbed.deleted + gone)


def prune_file(  # noqa: PLR0913 - the use case, file to file
    source: Path | str,
    output: Path | str | None,
    views: ViewSet,
    budget: Budget,
    settings: Settings = DEFAULTS,
    *,
    absorb: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
    threads: int | None = None,
) -> Result:
    """Prune a 3DGS PLY file into another.

    Parameters
    ----------
    source : path-like
        The file to read.
    output : path-like or None
        The file to make; None decides and writes nothing.
    views, budget, settings, absorb, progress, threads
        See `prune`.
    overwrite : bool
        Whether `output` may replace a file.

    Returns
    -------
    Result
        Its report says the files' names and sizes besides.

    Raises
    ------
    RefineError, Cancelled
        See `prune`, `read_ply` and `SplatFile.write`; nothing is written then.
    """
    clock = Clock()
    target = None if output is None else expanded(output)
    if target is not None:
        refuse_existing(target, overwrite=overwrite)
        refuse_mapped(target, expanded(source))
    file = read_ply(source)
    task = Task(
        budget=budget,
        settings=settings,
        splats=file.splats(),
        views=views,
        absorb=absorb,
        row_bytes=file.changed_row_bytes if absorb else file.row_bytes,
        fixed_bytes=file.fixed_bytes,
    )
    clock.lap("read_s")
    result = decide(task, clock=clock, progress=part(progress, 0.0, 0.8), threads=threads)
    report(progress, 0.8, "writing")
    columns = survivor_columns(file.rows, result.absorbed) if result.absorbed else {}
    if target is not None:
        file.write(target, result.keep, columns=columns, overwrite=overwrite)
    clock.lap("write_s")
    result.report["notes"] += file.notes(result.keep)
    made = None if target is None else str(target)
    sizes = (file.size(), file.size(result.keep, columns))
    complete_report(result.report, clock, Files(str(file.path), made, *sizes))
    return result
