"""What a prune says of itself: counts, sizes, timings and notes, the same whoever asked for it."""

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
    """How long the steps of one prune take.

    Attributes
    ----------
    timings : dict of str to float
        Seconds of each step, by name.
    """

    def __init__(self) -> None:
        self.timings: dict[str, float] = {}
        self._start = self._last = time.perf_counter()

    def lap(self, step: str) -> None:
        """Note what has passed since the last lap as the time of a step."""
        now = time.perf_counter()
        self.timings[step], self._last = now - self._last, now

    def stop(self) -> None:
        """Note what has passed since the start as ``total_s``."""
        self.timings["total_s"] = time.perf_counter() - self._start


@dataclass(frozen=True)
class Files:
    """Where splats came from and where they went, under the names that the report gives them.

    Attributes
    ----------
    input : str
        A file, or a .blend and the object in it.
    output : str or None
        The file that was made, if any.
    input_bytes, output_bytes : int
        Sizes as PLY files.
    """

    input: str
    output: str | None
    input_bytes: int
    output_bytes: int


def scoring_notes(scores: Scores) -> list[str]:
    """Return what the user should know of a scoring, in sentences."""
    notes = list(scores.notes)
    if scores.undrawable:
        notes.append(f"{scores.undrawable} splats cannot be drawn; they rank lowest")
    return notes


def make_report(
    scores: Scores, keep: NDArray[np.bool_], budget: Budget, settings: Settings, clock: Clock
) -> dict[str, Any]:
    """Return everything a pipeline wants to know about a prune, as plain JSON values.

    Parameters
    ----------
    scores : Scores
        What decided.
    keep : (N,) bool
        Which splats stay.
    budget, settings
        What was asked for.
    clock : Clock
        Its timings are part of the report, those of later laps too.
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
    """Add names, sizes and the total time to the report of a prune that has been written."""
    clock.stop()
    report["files"] = asdict(files)
