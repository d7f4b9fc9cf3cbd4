"""The report of what was done: one dictionary of plain JSON values; see docs/report.md."""

from __future__ import annotations

import platform
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cleaning.clean import Cleaned
from .methods import ClosedForm, Refit
from .quality.curve import FEWEST, Way, expected, expected_seconds, in_words, out_of_reach, parted
from .scores import Scores
from .volumes import Forced

SEES_TOO_LITTLE = "the views see too little for an estimate of the pictures' quality"
NOT_ESTIMATED = "the closed form estimates the pictures' quality only if a PSNR is the budget"
NOT_PREDICTED = (
    f"what merging and refitting reach is not predicted for fewer than {FEWEST:,} splats"
)
"""Why there is no estimate: notes of the report."""

MANY_UNSEEN = 0.05  # share of unseen splats from which the command says how many were removed

PRICED = (0.3, 0.5, 0.7, 0.9)  # shares removed whose cost a scoring predicts

Chosen = tuple[NDArray[np.bool_], "float | None", "float | None"]
"""Kept splats, (N,), and the PSNR in views that decided and between, dB."""

Estimates = dict[Way, "float | None"]
"""Estimated PSNR by what was done, dB; None if too little is seen."""


class Clock:
    """Times of the steps of a run, seconds by name."""

    def __init__(self) -> None:
        self.timings: dict[str, float] = {}
        self._start = self._last = time.perf_counter()

    def lap(self, step: str) -> None:
        """Store the time since the last lap as that of a step."""
        now = time.perf_counter()
        self.timings[step], self._last = now - self._last, now

    def stop(self) -> dict[str, float]:
        """All times, with that since the start as ``total_s``."""
        self.timings["total_s"] = time.perf_counter() - self._start
        return self.timings


def size_in_words(count: int) -> str:
    """Write a number of bytes, in kB below 0.1 MB.

    >>> size_in_words(4_940_000), size_in_words(32_000)
    ('4.9 MB', '32.0 kB')
    """
    return f"{count / 1e3:,.1f} kB" if count < 1e5 else f"{count / 1e6:,.1f} MB"


def sizes_in_words(first: int, between: str, second: int) -> str:
    """Write two numbers of bytes, with one unit where they have the same.

    >>> sizes_in_words(9_860_000, "->", 4_940_000), sizes_in_words(9_860_000, "->", 32_000)
    ('9.9 -> 4.9 MB', '9.9 MB -> 32.0 kB')
    """
    one, other = size_in_words(first), size_in_words(second)
    return f"{one[:-3] if one[-3:] == other[-3:] else one} {between} {other}"


def scoring_notes(scores: Scores) -> list[str]:
    """Notes on a scoring for the user, one sentence each."""
    notes = [*scores.notes, *(scores.alignment.notes() if scores.alignment else ())]
    if scores.views_between:
        notes.append(f"few cameras: {scores.views_between} views near them decide, too")
    if scores.undrawable:
        notes.append(f"{scores.undrawable} splats cannot be drawn; they rank lowest")
    return notes


def seen_by(found: Scores | Cleaned, demands: Forced) -> dict[str, dict[str, int]]:
    """Counts of splats and views for every report; no view sees what the user removed."""
    forced = demands.counts()
    unseen = int(np.count_nonzero(found.seen == 0)) - forced["removed_by_user"]
    counts = {"before": len(found.seen), "undrawable": found.undrawable, "unseen": unseen}
    views = {"given": found.views_given, "used": found.views_used, "between": found.views_between}
    return {"splats": counts | forced, "views": views}


def kept_and_removed(keep: NDArray[np.bool_]) -> dict[str, int]:
    """How many splats there were, are kept and are removed."""
    kept = int(np.count_nonzero(keep))
    return {"before": len(keep), "kept": kept, "removed": len(keep) - kept}


def of_prune(
    run: Any, scores: Scores, chosen: Chosen, outcome: Any = None, tried: Estimates | None = None
) -> dict[str, Any]:
    """Report of a prune as plain JSON values; it shares the clock's times, later laps too.

    `run` has budget, method, sizes, clock, and scores if these were given: else the clock timed
    them, from which other methods' times are predicted. `outcome` is that of merging, `tried` its
    PSNR if deletion was as good.
    """
    keep, psnr, between = chosen
    budget, method, clock = run.budget, run.method, run.clock
    count, curve = len(keep), scores.quality
    measured: Any = {"delete": psnr} if outcome is None else outcome.psnr
    report: dict[str, Any] = {**seen_by(scores, Forced())}
    report["splats"] |= kept_and_removed(keep)
    report["splats"]["unseen_removed"] = int(np.count_nonzero((scores.seen == 0) & ~keep))
    removed = report["splats"]["removed"]
    share, note, why = removed / count, None, ""  # why the budget is out of reach
    if budget.psnr is not None:
        why = out_of_reach(budget.psnr, removed, count, psnr)
    elif budget.max_mb is not None and not removed:
        size = size_in_words(int(run.sizes[0] * count + run.sizes[1]))
        why = f"already {size}: the budget removes nothing"
    if psnr is None:
        note = NOT_ESTIMATED if scores.ray_sample is None else SEES_TOO_LITTLE
    notes = [
        *scoring_notes(scores),
        SEES_TOO_LITTLE if note == SEES_TOO_LITTLE else "",
        why,
        "" if outcome is None else outcome.merged.note(),
    ]
    told = between if scores.tells else None
    if parted(psnr, between):
        more = "how much is not known" if told is None else in_words(told)
        notes.append(f"views between these lose more, {more}: add cameras, or remove less")
    alike = tried if tried is not None and budget.psnr is None else {}  # of as many kept splats
    deletes, made = "closed-form" if isinstance(method, ClosedForm) else "occlusion", {}
    if outcome is not None:
        made["merged"] = outcome.merged.facts()
        if outcome.refitted is not None:
            notes.append(outcome.refitted.note(outcome.seconds))
            made["refitted"] = {
                "began": "merge" if outcome.merged.merged else deletes,
                **outcome.refitted.facts(outcome.seconds),
            }
        began, merge = measured.get("delete"), measured.get("merge")
        if isinstance(method, Refit) and None not in (began, merge) and not outcome.merged.merged:
            both = f"{in_words(began)}, merging {in_words(merge)}"
            notes.append(f"refitting began with plain deletion: {both}")
        notes += getattr(outcome.stopped, "__notes__", ())
        if outcome.done == "merge" and began is not None and began > (psnr or began):
            notes.append(f"plain deletion reaches more in these views: {in_words(began)}")
    if method.changes and outcome is None and removed:
        notes.append(deleted_note(psnr, None if tried is None else tried["merge"]))
    took = None if deletes == "closed-form" or run.scores is not None else clock.timings["score_s"]
    return report | {
        "budget": {budget.kind: getattr(budget, budget.kind)},
        "settings": method.facts(),
        "weights": scores.facts,
        "timings": clock.timings,
        "versions": {"python": platform.python_version(), "numpy": np.__version__},
        "estimated_psnr": None if psnr is None else round(psnr, 2),
        "estimated_psnr_note": note,
        "estimated_psnr_between": None if told is None else round(told, 2),
        "method": {
            "asked": method.name,
            "done": deletes if outcome is None or outcome.done == "delete" else outcome.done,
            **_predicted(scores, share, {**alike, **measured}, took, once=method.changes),
        },
        "quality": None if curve is None else curve.facts(),
        "budget_remark": why,
        "notes": [words for words in notes if words],
        **made,
    }


def deleted_note(plain: float | None, tried: float | None) -> str:
    """Why splats are deleted though the method merges; `plain` and `tried` are the estimated PSNR
    of deletion and of merging, dB, None if unknown.
    """
    why = "the views see too little to tell what merging would gain"
    if tried is not None:
        more = "no more" if plain is not None and tried <= plain else "hardly more"
        why = f"merging reaches {in_words(tried)}, {more}"
    elif plain is not None:
        why = "nobody sees the difference"
    return f"rows stay as they were, the others are deleted: {why}"


def prices(scores: Scores, took: float) -> list[dict[str, Any]]:
    """Predicted PSNR and seconds of each method at the shares `PRICED`; empty without a curve."""
    curve = scores.quality
    if curve is None or scores.method == "closed-form":
        return []
    return [
        {"removed": share, **_predicted(scores, share, {"delete": curve.at(share)}, took)}
        for share in PRICED
    ]


def _predicted(scores, share, measured, took, *, once=False):
    """PSNR of each method at a share removed, dB, measured or predicted, why one is missing, and
    seconds by those that scoring `took`, None if unknown; see `expected_seconds`.
    """
    psnr = expected(scores, share, measured)
    seconds = None if took is None else expected_seconds(took, share, once=once)
    return {
        "psnr": {way: None if value is None else round(value, 2) for way, value in psnr.items()},
        "note": None if psnr["merge"] is not None or scores.quality is None else NOT_PREDICTED,
        "seconds": seconds and {way: round(value, 1) for way, value in seconds.items()},
    }
