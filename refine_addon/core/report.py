"""The report of a prune: counts, sizes, timings and notes; the same for panel, command and API."""

from __future__ import annotations

import platform
import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from .scores import Scores
    from .selection import Budget
    from .task import Settings


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


@dataclass(frozen=True)
class Files:
    """The files of a prune, under their names in the report.

    Attributes
    ----------
    input : str
        A file, or a .blend file and the object in it.
    output : str or None
        The file that was written, if any.
    input_bytes : int
    output_bytes : int or None
        Sizes; None for a file that is not written and whose size only writing tells.
    """

    input: str
    output: str | None
    input_bytes: int
    output_bytes: int | None


def scoring_notes(scores: Scores) -> list[str]:
    """Return what the user should know about a scoring, in sentences."""
    notes = list(scores.notes)
    if scores.undrawable:
        notes.append(f"{scores.undrawable} splats cannot be drawn; they rank lowest")
    return notes


def make_report(
    scores: Scores, keep: NDArray[np.bool_], budget: Budget, settings: Settings, clock: Clock
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
    kept = int(np.count_nonzero(keep))
    return {
        "splats": {
            "before": len(keep),
            "kept": kept,
            "removed": len(keep) - kept,
            "undrawable": scores.undrawable,
            "unseen": int(np.count_nonzero(scores.seen == 0)),
        },
        "views": {"given": scores.views_given, "used": scores.views_used},
        "budget": {budget.kind: getattr(budget, budget.kind)},
        "settings": asdict(settings),
        "weights": scores.facts,
        "timings": clock.timings,
        "notes": scoring_notes(scores),
        "versions": {"python": platform.python_version(), "numpy": np.__version__},
    }


def complete_report(report: dict[str, Any], clock: Clock, files: Files) -> None:
    """Add the names and sizes of the files and the total time to a report."""
    clock.stop()
    report["files"] = asdict(files)
