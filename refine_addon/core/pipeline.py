"""The one use case: views and splats in, scores and a keep mask out.

The panel, the command and Python code all come through here, so that they keep the same splats.
"""

from __future__ import annotations

import math
import platform
import time
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from . import selection
from .absorbing import absorb as absorbing
from .absorbing.merging import ViewSums
from .errors import RefineError
from .formats.ply import read_ply
from .scoring import auto, closed_form, occlusion
from .selection import Budget
from .survivors import survivor_columns
from .whole_file import expanded, refuse_existing, refuse_mapped
from .work import Progress, part, report, silent

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from .absorbing.absorb import Absorbed
    from .scores import Scores
    from .scoring.occlusion import Measured
    from .splats import Splats
    from .views import ViewSet

METHODS = ("closed-form", "occlusion", "auto")

FIRST = 0.1
"""Share of the splats that goes before any are merged: what the views would miss least is next to
nothing, and any merge changes more."""


@dataclass(frozen=True)
class Settings:
    """How to score.

    Attributes
    ----------
    method : {"closed-form", "occlusion", "auto"}
        Name of the scoring method: as if nothing hid anything, with what hides what, or the
        cheapest that agrees with the latter.
    views : int
        Use at most this many views, spread out evenly; 0 uses all.
    closed_form : ClosedForm
    occlusion : Occlusion
        Settings of the methods of those names.
    tolerance : float
        For "auto": share of the kept set that may differ from that of "occlusion".
    """

    method: Literal["closed-form", "occlusion", "auto"] = "closed-form"
    views: int = 64
    closed_form: closed_form.ClosedForm = field(default_factory=closed_form.ClosedForm)
    occlusion: occlusion.Occlusion = field(default_factory=occlusion.Occlusion)
    tolerance: float = 0.01

    def __post_init__(self) -> None:
        """Check the values.

        Raises
        ------
        RefineError
            If one cannot be.
        """
        if self.method not in METHODS:
            msg = f"method is {self.method!r}, expected one of {', '.join(METHODS)}"
            raise RefineError(msg)
        if not 0.0 <= self.tolerance <= 1.0:
            msg = f"tolerance is {self.tolerance}, expected a share, 0 to 1"
            raise RefineError(msg)
        if self.views < 0:
            msg = f"views is {self.views}, expected 0 (all) or more"
            raise RefineError(msg)


@dataclass(frozen=True, eq=False)
class Result:
    """What a prune decided.

    Attributes
    ----------
    keep : (N,) bool
        Which splats stay.
    scores : Scores
        What decided; with `absorbed`, what decided how many, or which tenth went first.
    absorbed : Absorbed or None
        The survivors, changed by what they absorbed.
    report : dict
        Counts, settings, weights, timings and versions, ready for JSON.
    """

    keep: NDArray[np.bool_]
    scores: Scores
    report: dict[str, Any]
    absorbed: Absorbed | None = None


def score(
    splats: Splats,
    views: ViewSet,
    settings: Settings = Settings(),
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
            return occlusion.score(
                splats, used, settings.occlusion, progress=progress, threads=threads
            )
        if settings.method == "auto":
            models = (settings.closed_form, settings.occlusion)
            return auto.score(
                splats, used, settings.tolerance, models, progress=progress, threads=threads
            )
        return closed_form.score(
            splats, used, settings.closed_form, progress=progress, threads=threads
        )


def prune(  # noqa: PLR0913 - the use case: what, by which views, how much, how
    splats: Splats,
    views: ViewSet,
    budget: Budget,
    settings: Settings = Settings(),
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
    start = time.perf_counter()
    _refuse_meaningless(budget, settings)
    ahead = part(progress, 0.0, 0.2 if absorb else 0.95)
    known = None
    if absorb and budget.removals(len(splats), row_bytes or 1.0, fixed_bytes) is not None:
        # How many go does not depend on the scores, so those that absorbing needs will do.
        known = _score_once(splats, views, settings, ahead, threads)
        scores = known[0]
    else:
        scores = score(splats, views, settings, progress=ahead, threads=threads)
    scored = time.perf_counter()
    report(progress, 0.2 if absorb else 0.95, "selecting")
    keep = selection.select(
        scores, budget, protected=protected, row_bytes=row_bytes, fixed_bytes=fixed_bytes
    )
    timings = {"score_s": scored - start, "select_s": time.perf_counter() - scored}
    absorbed = None
    if absorb:
        absorbed = absorb_removed(
            splats, views, int(np.count_nonzero(keep)), settings, known=known,
            protected=protected, progress=part(progress, 0.2, 1.0), threads=threads,
        )  # fmt: skip
        keep = absorbed.keep
        timings["absorb_s"] = time.perf_counter() - scored - timings["select_s"]
    facts = make_report(scores, keep, views, budget, settings, timings)
    if absorbed:
        facts["absorbed"] = absorbed.facts()
        facts["notes"].append(absorbed.note())
        if known and settings.method != "occlusion":
            name = settings.method
            facts["notes"].append(f"absorbing measures by occlusion: {name} had nothing to decide")
    return Result(keep, scores, facts, absorbed)


def _score_once(
    splats: Splats, views: ViewSet, settings: Settings, progress: Progress, threads: int | None
) -> tuple[Scores, Measured]:
    with np.errstate(under="ignore"):  # as for scores
        return occlusion.score_once(
            splats,
            views.spread(settings.views),
            settings.occlusion,
            progress=progress,
            threads=threads,
        )


def _refuse_meaningless(budget: Budget, settings: Settings) -> None:
    """Refuse budgets that the method gives no fixed meaning."""
    if settings.method == "auto" and budget.kind in ("threshold", "min_seen"):
        msg = (
            f"method auto may score by any model, and {budget.kind} means something else to each: "
            "choose closed-form or occlusion, or another budget"
        )
        raise RefineError(msg)
    uncounted = settings.method == "closed-form" and not settings.closed_form.frustum
    if uncounted and budget.kind == "min_seen":
        msg = "without the frustum test every view sees every splat: min_seen would remove none"
        raise RefineError(msg)


def absorb_removed(  # noqa: PLR0913 - the use case, the other one
    splats: Splats,
    views: ViewSet,
    count: int,
    settings: Settings = Settings(),
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
    at_first = [ViewSums(measured.contribution[rest], measured.contrast[rest])]
    del known, scores, measured

    def seen(now: Splats, ahead: Progress) -> ViewSums:
        if at_first:
            return at_first.pop()
        found = occlusion.measure(now, used, settings.occlusion, progress=ahead, threads=threads)
        return ViewSums(found.contribution, found.contrast)

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
    settings: Settings = Settings(),
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
    start = time.perf_counter()
    target = None if output is None else expanded(output)
    if target is not None:
        refuse_existing(target, overwrite=overwrite)
        refuse_mapped(target, expanded(source))
    file = read_ply(source)
    opened = time.perf_counter()
    result = prune(
        file.splats(),
        views,
        budget,
        settings,
        absorb=absorb,
        row_bytes=file.changed_row_bytes if absorb else file.row_bytes,
        fixed_bytes=file.fixed_bytes,
        progress=part(progress, 0.0, 0.8),
        threads=threads,
    )
    decided = time.perf_counter()
    report(progress, 0.8, "writing")
    columns = survivor_columns(file.rows, result.absorbed) if result.absorbed else {}
    if target is not None:
        file.write(target, result.keep, columns=columns, overwrite=overwrite)
    result.report["notes"] += file.notes(result.keep)
    timings = result.report["timings"]
    timings["read_s"] = opened - start
    timings["write_s"] = time.perf_counter() - decided
    timings["total_s"] = time.perf_counter() - start
    result.report["files"] = {
        "input": str(file.path),
        "output": None if target is None else str(target),
        "input_bytes": file.size(),
        "output_bytes": file.size(result.keep, columns),
    }
    return result


def scoring_notes(scores: Scores, views: ViewSet) -> list[str]:
    """Return what the user should know of a scoring, in sentences."""
    notes = [*scores.notes, *([views.note] if views.note else [])]
    if scores.undrawable:
        notes.append(f"{scores.undrawable} splats cannot be drawn; they rank lowest")
    return notes


def make_report(
    scores: Scores,
    keep: NDArray[np.bool_],
    views: ViewSet,
    budget: Budget,
    settings: Settings,
    timings: dict[str, float],
) -> dict[str, Any]:
    """Return everything a pipeline wants to know about a prune, as plain JSON values."""
    kept = int(np.count_nonzero(keep))
    return {
        "splats": {
            "before": len(keep),
            "kept": kept,
            "removed": len(keep) - kept,
            "undrawable": scores.undrawable,
            "unseen": int(np.count_nonzero(scores.seen == 0)),
        },
        "views": {"given": len(views), "used": scores.views_used},
        "budget": {budget.kind: getattr(budget, budget.kind)},
        "settings": asdict(settings),
        "weights": scores.weights,
        "timings": timings,
        "notes": scoring_notes(scores, views),
        "versions": {"python": platform.python_version(), "numpy": np.__version__},
    }
