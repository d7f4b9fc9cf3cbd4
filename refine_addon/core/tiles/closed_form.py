"""The closed form over units: `scoring.closed_form` with its arrays on a disk between steps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..operation.run import Runtime
from ..scores import Scores
from ..scoring import closed_form
from ..scoring.closed_form_block import STEPS, RowBlock
from ..scoring.closed_form_settings import ClosedForm
from ..views import ViewSet
from .folder import Folder
from .units import Unit
from .workers import Runner

SHARES: Mapping[str, tuple[float, float]] = {
    "read": (0.0, 0.24),
    "count": (0.24, 0.24),
    "sum_views": (0.24, 0.92),
    "add": (0.92, 0.95),
    "compare": (0.95, 1.0),
}
"""Step -> where it begins and ends in the progress of the closed form."""

_NAMES = {"read": "reading", "count": "reading"}  # of steps; the others are "scoring"

_REPEATED = ("count",)
"""Steps of `STEPS` that are done with several arguments: their results are not noted."""

_SMALL = 1 << 16  # bytes of an argument that travels with each step; larger ones lie in the folder


class _Stored(NamedTuple):
    """An argument that was noted under this name, since it is large."""

    name: str


@dataclass(frozen=True)
class ClosedFormContext:
    """What all steps of the closed form need; the views are those used, with `ViewSet.middle`."""

    folder: Folder
    views: ViewSet
    settings: ClosedForm
    middle: tuple[NDArray[np.float64], float]


@dataclass(frozen=True)
class ComputeRows:
    """A step of the closed form with the rows of a unit: one of `closed_form_block.STEPS`."""

    unit: Unit
    step: str
    arguments: tuple[Any, ...]

    def run(self, context: ClosedFormContext, runtime: Runtime) -> Any:
        """Do the step, unless it is done; return what came of it."""
        folder, index = context.folder, self.unit.index
        if self.step in _REPEATED:
            return self._computed(context, runtime)
        name = f"{index:06d}.{self.step}"
        result = folder.once(name, lambda: self._computed(context, runtime))
        folder.drop(index, STEPS[self.step][2])
        return result

    def _computed(self, context: ClosedFormContext, runtime: Runtime) -> Any:
        folder, unit = context.folder, self.unit
        needed, made, _ = STEPS[self.step]
        # From a disk a unit is read chunk by chunk; behind a URL each chunk would be a request.
        splats = unit.splats() if self.step == "read" and unit.remote else unit
        block = RowBlock(
            splats, context.views, context.settings, context.middle,
            threads=runtime.threads, arrays=folder.load(unit.index, needed),
        )  # fmt: skip
        del splats
        block.progress = runtime.progress
        arguments = [
            folder.noted(each.name)[1] if isinstance(each, _Stored) else each
            for each in self.arguments
        ]
        result = getattr(block, self.step)(*arguments)
        folder.save(unit.index, {name: getattr(block, name) for name in made})
        return result


@dataclass
class _Steps:
    """Does the steps of the closed form with each unit."""

    context: ClosedFormContext
    units: Sequence[Unit]
    runner: Runner
    stored: int = 0  # arguments that lie in the folder

    def each(self, step: str, *arguments: Any) -> Iterator[Any]:
        """Do a step with each unit."""
        small = tuple(map(self._small, arguments))
        steps = [ComputeRows(unit, step, small) for unit in self.units]
        what, sizes = _NAMES.get(step, "scoring"), [*map(len, self.units)]
        return self.runner.part(*SHARES[step]).run(self.context, steps, what, sizes)

    def _small(self, argument: Any) -> Any:
        """Return an argument, or where it lies if it is large."""
        if not isinstance(argument, np.ndarray) or argument.nbytes <= _SMALL:
            return argument
        self.stored += 1
        name = f"argument-{self.stored}"
        self.context.folder.note(name, argument)
        return _Stored(name)


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
    views, settings = context.views, context.settings
    steps = _Steps(context, units, runner)
    with np.errstate(under="ignore"):  # as in `pipeline.score`
        results = closed_form.steps(
            steps.each, sum(map(len, units)), views, settings, remember=context.folder.once
        )
    scores = Scores(
        np.empty(0, np.float32), np.empty(0, np.int32), len(views), results.undrawable,
        results.facts, method="closed-form", frustum=settings.frustum,
    )  # fmt: skip
    return scores, results.size
