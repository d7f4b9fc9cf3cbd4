"""The report of a prune: counts, sizes, timings and notes; the same for panel, command and API."""

from __future__ import annotations

import platform
import time
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .formats.format import Format
from .formats.ply import SplatFile
from .formats.registry import left_out
from .merging.merge import Merged
from .quality.cost import expected_seconds
from .quality.curve import FEWEST, expected, in_words, out_of_reach, parted
from .scores import Scores
from .selection import Budget
from .survivor_choice import Became

SEES_TOO_LITTLE = "the views see too little for an estimate of the pictures' quality"
NOT_ESTIMATED = "the closed form estimates the pictures' quality only if a PSNR is the budget"
NOT_FORETOLD = (
    f"what absorbing and refitting reach is not foretold for fewer than {FEWEST:,} splats"
)
"""Why there is no estimate: notes of the report."""

MANY_UNSEEN = 0.05
"""Share of the splats from which on it is said how many of those that lie in no view go."""

LITTLE_SEEN = 0.19
"""Share of the splats that lie in one view or none from which on it is said that other views may
lose more than is told. On five scenes 8 views have .197 to .341 and 16 neighbours more, 12 and more
that are spread out at most .180."""

MEASURES = "absorbing measures by occlusion: closed-form was not used"
"""A note of the report."""


class Clock:
    """A clock for the steps of one prune.

    Attributes
    ----------
    timings : dict of str to float
        Seconds of each step, by name.
    """

    def __init__(self) -> None:
        self.timings: dict[str, float] = {}
        self._start = self._last = time.perf_counter()

    def lap(self, step: str) -> None:
        """Store the time since the last lap as that of a step."""
        now = time.perf_counter()
        self.timings[step], self._last = now - self._last, now

    def stop(self) -> None:
        """Store the time since the start as ``total_s``."""
        self.timings["total_s"] = time.perf_counter() - self._start


def files_facts(
    source: str, output: str | None, before: int, after: int | None
) -> dict[str, str | int | None]:
    """Return what a report says of files: their names, and bytes; see docs/report.md."""
    return {"input": source, "output": output, "input_bytes": before, "output_bytes": after}


def size_in_words(count: int) -> str:
    """Return a number of bytes, in kB below .1 MB.

    >>> size_in_words(4_940_000), size_in_words(32_000)
    ('4.9 MB', '32.0 kB')
    """
    return f"{count / 1e3:,.1f} kB" if count < 1e5 else f"{count / 1e6:,.1f} MB"


def sizes_in_words(first: int, between: str, second: int) -> str:
    """Return two numbers of bytes, with one unit where they have the same.

    >>> sizes_in_words(9_860_000, "->", 4_940_000), sizes_in_words(9_860_000, "->", 32_000)
    ('9.9 -> 4.9 MB', '9.9 MB -> 32.0 kB')
    """
    one, other = size_in_words(first), size_in_words(second)
    return f"{one[:-3] if one[-3:] == other[-3:] else one} {between} {other}"


def scoring_notes(scores: Scores) -> list[str]:
    """Return what the user should know about a scoring, in sentences."""
    notes = [*scores.notes, *(scores.alignment.notes() if scores.alignment else ())]
    if scores.undrawable:
        notes.append(f"{scores.undrawable} splats cannot be drawn; they rank lowest")
    return notes


def what_was_seen(
    seen: NDArray[np.int32], undrawable: int, given: int, used: int
) -> dict[str, dict[str, int]]:
    """Return what every report says of the splats and the views, as plain JSON values.

    Parameters
    ----------
    seen : (N,) int32
        In how many of the views used each splat's centre lies.
    undrawable : int
        How many splats cannot be drawn.
    given, used : int
        How many views there were, and how many of them were used.
    """
    unseen = int(np.count_nonzero(seen == 0))
    return {
        "splats": {"before": len(seen), "undrawable": undrawable, "unseen": unseen},
        "views": {"given": given, "used": used},
    }


def seen_by(scores: Scores) -> dict[str, dict[str, int]]:
    """Return `what_was_seen` of a scoring."""
    return what_was_seen(scores.seen, scores.undrawable, scores.views_given, scores.views_used)


def kept_and_removed(keep: NDArray[np.bool_]) -> dict[str, int]:
    """Return how many splats stay and go."""
    kept = int(np.count_nonzero(keep))
    return {"kept": kept, "removed": len(keep) - kept}


def held(
    file: SplatFile, form: Format | None, keep: NDArray[np.bool_], *, written: bool = True
) -> dict[str, int | None]:
    """Return how many splats a file of the kept rows holds, and how many its format leaves out.

    Parameters
    ----------
    file : SplatFile
        What is written.
    form : Format or None
        How; None is plain PLY.
    keep : (N,) bool
    written : bool
        Whether there is a file; without one, ``written`` is None.
    """
    missing = left_out(file, form, keep)
    count = int(np.count_nonzero(keep)) - missing
    return {"written": count if written else None, "left_out": missing}


def make_report(
    scores: Scores,
    keep: NDArray[np.bool_],
    budget: Budget,
    settings: Any,
    clock: Clock,
) -> dict[str, Any]:
    """Return the report of a prune, as plain JSON values.

    Parameters
    ----------
    scores : Scores
        Those that decided.
    keep : (N,) bool
        Which splats stay.
    budget, settings
        Those of the prune.
    clock : Clock
        The report shares its timings, so it also gets those of later laps.
    """
    facts = seen_by(scores)
    facts["splats"] |= kept_and_removed(keep)
    return {
        **facts,
        "budget": {budget.kind: getattr(budget, budget.kind)},
        "settings": asdict(settings),
        "weights": scores.facts,
        "timings": clock.timings,
        "notes": scoring_notes(scores),
        "versions": {"python": platform.python_version(), "numpy": np.__version__},
    }


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
    absorbed: Merged | None,
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
    absorbed : Merged or None
        What was merged, if anything was.
    why : str
        See `remark`.
    """
    curve = scores.quality
    gone = 0.0 if curve is None else 1.0 - float(np.mean(keep))
    note = None
    if psnr is None:
        note = NOT_ESTIMATED if scores.ray_sample is None else SEES_TOO_LITTLE
    became: Became = "unchanged" if absorbed is None else "absorb"
    facts |= {
        "estimated_psnr": None if psnr is None else round(psnr, 2),
        "estimated_psnr_note": note,
        "survivors": {"became": became, **expected_psnr(scores, gone, {became: psnr})},
        "quality": None if curve is None else curve.facts(),
    }
    if psnr is None and scores.ray_sample is not None:
        facts["notes"].append(SEES_TOO_LITTLE)
    facts["budget_remark"] = why
    if why:
        facts["notes"].append(why)
    if absorbed is not None:
        facts["absorbed"] = absorbed.facts()
        facts["notes"].append(absorbed.note())


def little_seen(seen: NDArray[np.int32]) -> str:
    """Return what few views cannot know of others, for the user; "" where they are enough.

    The share of what exactly one of some views holds is about that which the next one adds to all
    of them (Good 1953, "The population frequencies of species").

    Parameters
    ----------
    seen : (N,) int32
        In how many of the views that decided each splat lies.

    Examples
    --------
    >>> little_seen(np.array([0, 1, 2, 3]))
    '50% of the splats lie in one view or none: views from elsewhere may lose more than is told'
    >>> little_seen(np.array([2, 2, 2, 3]))
    ''
    """
    share = np.count_nonzero(seen < 2) / max(len(seen), 1)
    if share < LITTLE_SEEN:
        return ""
    return (
        f"{share:.0%} of the splats lie in one view or none: views from elsewhere may lose more "
        "than is told"
    )


def conclude_between(
    facts: dict[str, Any], between: float | None, seen: NDArray[np.int32] | None = None
) -> None:
    """Add to a report what views between those that decided will see.

    Parameters
    ----------
    facts : dict
        The report; changed. It has the estimate in the views that decided.
    between : float or None
        The estimate between them, dB.
    seen : (N,) int32, optional
        See `little_seen`, which is told where there are views between.
    """
    facts["estimated_psnr_between"] = None if between is None else round(between, 2)
    if between is not None and parted(facts["estimated_psnr"], between):
        facts["notes"].append(
            f"views between these lose more, {in_words(between)}: have views in between decide "
            "too, or remove less"
        )
    if between is not None and seen is not None and (few := little_seen(seen)):
        facts["notes"].append(few)


PRICED = (0.3, 0.5, 0.7, 0.9)
"""Shares removed of which a scoring says what they would cost."""


def prices(scores: Scores, scored: float) -> list[dict[str, Any]]:
    """Return what pruning by some scores would cost, by the share removed and by survivors.

    Parameters
    ----------
    scores : Scores
        By *occlusion*.
    scored : float
        How long scoring took, seconds.
    """
    curve = scores.quality
    if curve is None:
        return []
    return [
        {
            "removed": share,
            **expected_psnr(scores, share, {"unchanged": curve.at(share)}),
            "seconds": in_tenths(expected_seconds(scored, share, once=False)),
        }
        for share in PRICED
    ]


def in_tenths(seconds: Mapping[Became, float]) -> dict[Became, float]:
    """Return times as a report has them."""
    return {way: round(value, 1) for way, value in seconds.items()}


def expected_psnr(
    scores: Scores, gone: float, measured: Mapping[Became, float | None]
) -> dict[str, Any]:
    """Return what a report says of how close the pictures stay by what survivors become.

    Parameters
    ----------
    scores : Scores
        Their curve and their rays tell what was not measured.
    gone : float
        Share of the splats that goes.
    measured : mapping of str to (float or None)
        The estimates that were measured on rays, dB, by what survivors became.
    """
    rays, many = scores.ray_sample, len(scores.values) >= FEWEST
    told = expected(
        scores.quality, gone, measured, rays.hits_of_ray() if rays is not None and many else None
    )
    some = [psnr for psnr in measured.values() if psnr is not None]
    foretold = told["absorb"] is not None or not some
    return {
        "psnr": {way: None if psnr is None else round(psnr, 2) for way, psnr in told.items()},
        "note": None if foretold else NOT_FORETOLD,
    }
