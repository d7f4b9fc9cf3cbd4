"""The closed form over units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..scores import Scores
from ..scoring import closed_form
from ..splats import Splats, joined
from ..views import ViewSet
from ..visibility.scene import size_of
from .folder import Folder
from .units import Unit
from .workers import Runner


@dataclass(frozen=True)
class ClosedFormContext:
    """What the closed form needs; the views are those used, with `ViewSet.middle`."""

    folder: Folder
    views: ViewSet
    settings: dict[str, Any]  # keywords of `closed_form.score`
    middle: tuple[NDArray[np.float64], float]


class _Rows:
    """The splats of all units, read as they are taken."""

    def __init__(self, units: Sequence[Unit]) -> None:
        self._units = units
        self._ends = np.cumsum([0, *map(len, units)])

    def __len__(self) -> int:
        return int(self._ends[-1])

    def take(self, piece: slice) -> Splats:
        """Return a slice of them."""
        parts = []
        for unit, start in zip(self._units, self._ends.tolist(), strict=False):
            begin, end = max(piece.start - start, 0), min(piece.stop - start, len(unit))
            if begin < end:
                parts.append(unit.take(slice(begin, end)))
        return joined(parts) if parts else self._units[0].take(slice(0, 0))


def by_closed_form(
    context: ClosedFormContext, units: Sequence[Unit], runner: Runner
) -> tuple[Scores, float]:
    """Score units by the closed form; the folder has ``values`` and ``seen`` of each afterwards.

    Parameters
    ----------
    context : ClosedFormContext
    units : sequence of Unit
    runner : Runner

    Returns
    -------
    scores : Scores
        Without the values and numbers of views of any splat.
    size : float
        Of the scene, world units.

    Raises
    ------
    RefineError, Cancelled
        See `closed_form.score`.
    """
    rows, folder = _Rows(units), context.folder
    scores, squared = _scored(context, rows, runner)
    start = 0
    for unit in units:
        here = slice(start, start + len(unit))
        folder.save(unit.index, {"values": scores.values[here], "seen": scores.seen[here]})
        start = here.stop
    none = replace(scores, values=np.empty(0, np.float32), seen=np.empty(0, np.int32))
    return none, size_of(squared)


def _scored(context: ClosedFormContext, rows: _Rows, runner: Runner) -> tuple[Scores, float]:
    """Scores, and the median squared distance of the splats to the views."""
    with np.errstate(under="ignore"):  # as in `pipeline.score`
        scores = closed_form.score(
            rows, context.views, **context.settings, progress=runner.progress
        )  # fmt: skip
        columns, squared, *_ = closed_form._read(rows, *context.middle, runner.progress, None)
    return scores, float(np.median(squared[columns.good]))
