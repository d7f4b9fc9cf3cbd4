"""Who does the steps of a job: this process, one step after the other."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from ..errors import RefineError
from ..work import Progress, part, report, silent

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    from .steps import Job
    from .units import Tile


class Interrupted(RefineError):  # noqa: N818 - the job is not at fault
    """Raised where workers were lost: what is done stays for the next run."""


class Workers(Protocol):
    """Whoever does the steps."""

    def check(self, job: Job, tiles: list[Tile]) -> None:
        """Raise `RefineError` if a worker does not see the files."""

    def __call__(
        self, job: object, calls: Sequence[Call], progress: Progress, what: str
    ) -> Iterator[Any]:
        """Yield what each call returns, in their order."""


class Call(NamedTuple):
    """A step to be done.

    Attributes
    ----------
    step : str
        Name of a method of `Job`.
    arguments : tuple
    share : float
        How much of the work of all calls this is.
    chunked : bool
        Whether it takes ``progress`` and ``threads``.
    options : dict
        Arguments by name.
    """

    step: str
    arguments: tuple[Any, ...]
    share: float
    chunked: bool = False
    options: Mapping[str, Any] = {}

    def do(self, job: object, *, progress: Progress = silent, threads: int | None = None) -> Any:  # noqa: ANN401 - of each step its own
        """Return what the step returns; `job` has it as a method."""
        more = {"progress": progress, "threads": threads} if self.chunked else {}
        return getattr(job, self.step)(*self.arguments, **self.options, **more)


class Here:
    """Does all steps in this process.

    Parameters
    ----------
    threads : int, optional
        See `refine_addon.core.work.for_chunks`.
    """

    def __init__(self, threads: int | None = None) -> None:
        self._threads = threads

    def check(self, job: Job, tiles: list[Tile]) -> None:
        """Do nothing: this process sees what it sees."""

    def __call__(
        self, job: object, calls: Sequence[Call], progress: Progress, what: str
    ) -> Iterator[Any]:
        """Yield what each call returns, in their order."""
        done = 0.0
        for call in calls:
            report(progress, done, what)
            ahead = part(progress, done, done + call.share)
            yield call.do(job, progress=ahead, threads=self._threads)
            done += call.share
