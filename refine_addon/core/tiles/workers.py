"""Who does the steps of a job: this process, one step after the other, or what `cluster` starts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

from ..costs import Plan
from ..execute import Progress, part, report, silent
from ..operation.run import Runtime
from ..pace import phases
from .folder import Folder
from .units import Tile

Context = TypeVar("Context")
_Context_contra = TypeVar("_Context_contra", contravariant=True)
Result = TypeVar("Result")
_Result_co = TypeVar("_Result_co", covariant=True)


class Step(Protocol[_Context_contra, _Result_co]):
    """A piece of work that any process can do, which is sent there as a pickle.

    It reads the tiles and the folder of the job, and writes into the folder. What it returns is
    small. It can be done again: where its result was noted, that is returned.
    """

    def run(self, context: _Context_contra, runtime: Runtime, /) -> _Result_co:
        """Do it.

        Parameters
        ----------
        context : object
            What all steps that are done together need.
        runtime : Runtime
            Its clock does not matter.
        """


@dataclass(frozen=True)
class Batch(Generic[Context, Result]):
    """Steps that are done together, and what is told of them meanwhile."""

    context: Context  # see `Step`; it is sent once
    steps: Sequence[Step[Context, Result]]
    progress: Progress
    what: str  # is being done, for `progress`
    sizes: Sequence[int] = ()  # how much work each step is, in any unit; by default all the same

    def shares(self) -> list[float]:
        """Return how much of the work of all steps each is."""
        if not self.sizes:
            return [1 / max(len(self.steps), 1)] * len(self.steps)
        total = max(sum(self.sizes), 1)
        return [size / total for size in self.sizes]


class Workers(Protocol):
    """Whoever does the steps."""

    def check(self, folder: Folder, tiles: Sequence[Tile]) -> None:
        """Raise `RefineError` if a worker does not see the folder of the job, or a tile."""

    def run(self, batch: Batch[Context, Result]) -> Iterator[Result]:
        """Do steps; yield what each returns, in their order."""


class InProcess:
    """Does all steps in this process.

    Parameters
    ----------
    threads : int, optional
        See `refine_addon.core.execute.run`.
    """

    def __init__(self, threads: int | None = None) -> None:
        self._threads = threads

    def check(self, folder: Folder, tiles: Sequence[Tile]) -> None:
        """Do nothing: this process sees what it sees."""

    def run(self, batch: Batch[Context, Result]) -> Iterator[Result]:
        """Do steps one after the other; see `Workers.run`."""
        done = 0.0
        for step, share in zip(batch.steps, batch.shares(), strict=True):
            report(batch.progress, done, batch.what)
            alone = len(batch.steps) == 1
            progress = batch.progress if alone else part(batch.progress, done, done + share)
            yield step.run(batch.context, Runtime(progress=progress, threads=self._threads))
            done += share


@dataclass(frozen=True)
class Runner:
    """Has workers do steps, and tells how far they are."""

    workers: Workers
    progress: Progress = silent

    def part(self, start: float, end: float) -> Runner:
        """Return a runner whose steps are a part of this one's, see `execute.part`."""
        return replace(self, progress=part(self.progress, start, end))

    def phases(self, *plans: Plan) -> list[Runner]:
        """Return a runner for each of several phases, see `pace.phases`."""
        return [replace(self, progress=phase) for phase in phases(self.progress, *plans)]

    def run(
        self,
        context: Context,
        steps: Sequence[Step[Context, Result]],
        what: str,
        sizes: Sequence[int] = (),
    ) -> Iterator[Result]:
        """Do steps; yield what each returns, in their order. See `Batch`."""
        return self.workers.run(Batch(context, steps, self.progress, what, sizes))

    def run_all(
        self,
        context: Context,
        steps: Sequence[Step[Context, object]],
        what: str,
        sizes: Sequence[int] = (),
    ) -> None:
        """Do steps that return nothing. See `Batch`."""
        for _ in self.run(context, steps, what, sizes):
            pass
