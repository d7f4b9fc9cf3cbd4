"""The way of every operation on splats: refuse, read, decide, write, report.

A request says what is to be done, a source where the splats are, a sink where they go:

| | source | request | sink | in |
|---|---|---|---|---|
| `prune_file` | `FileSource` | `PruneRequest` | `FileSink` | `core/operation/files.py` |
| `convert_files` | `ArrangedSource` | `ConvertRequest` | `FileSink` | `operation/arranged.py` |
| `file_to_file` | `FileSource` | any of `requests.py` | `FileSink` | `core/operation/files.py` |
| `lod_file` | `FileSource` | `LevelsRequest` | a `LevelSink` | `core/levels/files.py` |
| `prune_object` | `ObjectSource` | `PruneRequest` | `ObjectSink` | `objects/operation.py` |
| `score_object` | `ObjectSource` | `ScoreRequest` | `FileSink` | `objects/operation.py` |
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from ..costs import Plan
from ..execute import Cancelled, Progress, part, silent
from ..formats.format import Format
from ..pace import phases
from ..rendering import Model
from ..report import Clock
from ..volumes import Zone


@dataclass(frozen=True, eq=False)
class Runtime:
    """What every step of a run gets besides its data.

    Attributes
    ----------
    clock : Clock
        Gets the time of each step.
    progress : callable
        ``progress(fraction, what)``; returning ``False`` cancels.
    threads : int or None
    """

    clock: Clock = field(default_factory=Clock)
    progress: Progress = silent
    threads: int | None = None

    def part(self, start: float, end: float) -> Runtime:
        """Return this for a step whose progress is `start`..`end` of the whole."""
        return replace(self, progress=part(self.progress, start, end))


@dataclass(frozen=True, eq=False)
class Written:
    """What a sink made, for the report.

    Attributes
    ----------
    files : dict
        Names and sizes of what was read and written: ``files`` of the report.
    path : Path or None
        The file that holds the splats, if a single one was written.
    splats : dict of str to int or None
        Counts to add to ``splats``: how many the files hold.
    notes : list of str
        What the user should know about the source and the files.
    facts : dict
        Anything else.
    """

    files: dict[str, Any]
    path: Path | None = None
    splats: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    facts: dict[str, Any] = field(default_factory=dict)


class Decision(Protocol):
    """What a request decided of an input; `run` completes its report."""

    @property
    def report(self) -> dict[str, Any]:
        """Plain JSON values, with ``splats`` and ``notes``."""
        ...


LoadedT = TypeVar("LoadedT")
LoadedT_co = TypeVar("LoadedT_co", covariant=True)
LoadedT_contra = TypeVar("LoadedT_contra", contravariant=True)
DecisionT = TypeVar("DecisionT", bound=Decision)
DecisionT_contra = TypeVar("DecisionT_contra", bound=Decision, contravariant=True)


class Source(Protocol[LoadedT_co]):
    """Where splats are."""

    def read(self, form: Format | None) -> LoadedT_co:
        """Return them, with the bytes that they take in a format; None is plain PLY."""
        ...


class Request(ABC, Generic[LoadedT_contra, DecisionT]):
    """What is to be done.

    Attributes
    ----------
    zones : sequence of Zone
        Volumes that say which splats must stay and which must go, in the frame of the views.
    overwrite : bool
        Whether files may be replaced.
    dry_run : bool
        Whether to decide as for the output, and write no splats.
    model : {"default", "antialiased", "2dgs"}, optional
        How the splats of a file are drawn, where it does not say or is wrong.
    """

    zones: Sequence[Zone] = ()
    model: Model | None = None
    overwrite: bool = False
    dry_run: bool = False

    @contextmanager
    def opened(self, _form: Format | None) -> Iterator[None]:
        """Refuse, before splats are read, what none can give in the format of the output."""
        yield

    def costs(self, _loaded: LoadedT_contra) -> Sequence[Plan] | None:
        """Return what deciding, writing and comparing are expected to cost.

        None where deciding and writing share one progress callback.
        """
        return None

    @abstractmethod
    def decide(self, loaded: LoadedT_contra, runtime: Runtime) -> DecisionT:
        """Decide; nothing is changed or written."""

    def compare(
        self, _loaded: LoadedT_contra, _decision: DecisionT, _path: Path | None, _runtime: Runtime
    ) -> dict[str, Any]:
        """Return what the report says of the written file's pictures, if anything."""
        return {}


class Sink(Protocol[LoadedT_contra, DecisionT_contra]):
    """Where splats go."""

    @property
    def timing(self) -> str:
        """What the report calls the time that writing took."""
        ...

    @property
    def form(self) -> Format | None:
        """The format in which a budget counts bytes; None is plain PLY."""
        ...

    def opened(self) -> AbstractContextManager[None]:
        """Refuse what could not be written; if the block fails, remove what was made for it."""
        ...

    def write(
        self, loaded: LoadedT_contra, decision: DecisionT_contra, runtime: Runtime
    ) -> Written:
        """Write all of what was decided, or nothing."""
        ...


def run(
    source: Source[LoadedT],
    request: Request[LoadedT, DecisionT],
    sink: Sink[LoadedT, DecisionT],
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> DecisionT:
    """Do what is requested with the splats of a source, and write the result to a sink.

    Parameters
    ----------
    source : Source
    request : Request
    sink : Sink
    progress : callable, optional
        ``progress(fraction, what)``; returning ``False`` cancels.
    threads : int, optional

    Returns
    -------
    Decision
        With the whole report.

    Raises
    ------
    RefineError, Cancelled
        See the steps. Nothing is written then; but where comparing fails or is cancelled, after
        writing, the file that was written stays; and where refitting is cancelled, what it had
        reached is written.
    """
    runtime = Runtime(progress=progress, threads=threads)
    with request.opened(sink.form), sink.opened():
        loaded = source.read(sink.form)
        runtime.clock.lap("read_s")
        costs = request.costs(loaded)
        deciding, writing, comparing = (
            [runtime] * 3
            if costs is None
            else [
                replace(runtime, progress=phase)
                for phase in phases(progress, *costs, threads=threads)
            ]
        )
        decision = request.decide(loaded, deciding)
        stopped = getattr(decision, "stopped", None)
        if stopped is not None:  # what was reached is written
            writing = replace(writing, progress=silent)
        written = sink.write(loaded, decision, writing)
        runtime.clock.lap(sink.timing)
        if stopped is not None:
            if written.path is not None:
                stopped.add_note(f"{written.path} is written with what that had reached")
            raise stopped
        try:
            compared = request.compare(loaded, decision, written.path, comparing)
        except (Cancelled, KeyboardInterrupt) as stop:
            if written.path is not None:
                stop.add_note(f"{written.path} is written, its pictures and report are not")
            raise
    runtime.clock.stop()
    report = decision.report
    report |= written.facts | compared
    report["splats"] |= written.splats
    report["notes"] += written.notes
    report |= {"files": written.files, "timings": runtime.clock.timings}
    return decision
