"""Cleaning a file."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from ..cleaning.clean import Cleaning, clean
from ..report import kept_and_removed, what_was_seen
from ..whole_file import expanded
from ..work import Progress, silent
from .files import FileSink, FileSource, Kept
from .run import DECIDED, Request, run

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from ..views import ViewSet
    from ..volumes import Zone
    from .loaded import Loaded
    from .run import Runtime


@dataclass(frozen=True, eq=False)
class CleanRequest(Request["Loaded", Kept]):
    """What is asked of a cleaning.

    Attributes
    ----------
    views : ViewSet
        Those that decide.
    cleaning : Cleaning
        What to clean away.
    zones : sequence of Zone
        Volumes that say which splats must stay and which must go, in the frame of the views.
    overwrite : bool
        Whether a file may be replaced.
    """

    views: ViewSet
    cleaning: Cleaning = field(default_factory=Cleaning)
    zones: Sequence[Zone] = ()
    overwrite: bool = False

    def decide(self, loaded: Loaded, runtime: Runtime) -> Kept:
        """Return what `clean` leaves.

        Raises
        ------
        RefineError, Cancelled
            See `clean`.
        """
        forced = loaded.forced
        cleaned = clean(
            loaded.splats, self.views, self.cleaning,
            protected=forced.protected, removed=forced.removed,
            progress=runtime.part(0.0, DECIDED).progress, threads=runtime.threads,
        )  # fmt: skip
        runtime.clock.lap("clean_s")
        facts: dict[str, Any] = what_was_seen(
            cleaned.seen, cleaned.undrawable, cleaned.views_given, cleaned.views_used
        )
        facts["splats"] |= kept_and_removed(cleaned.keep) | forced.counts()
        facts["splats"]["unseen"] -= facts["splats"]["forced"]
        facts |= {
            "settings": asdict(self.cleaning),
            "volumes": loaded.volumes,
            "cleaned": cleaned.facts(),
            "notes": cleaned.notes(),
        }
        return Kept(cleaned.keep, facts)


def clean_file(
    source: Path | str,
    output: Path | str | None,
    request: CleanRequest,
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> Kept:
    """Clean a file of splats, and write the rest to another file.

    Parameters
    ----------
    source, output, progress, threads
        See `prune_file`.
    request : CleanRequest
        What is asked.

    Raises
    ------
    RefineError, Cancelled
        See `run`.
    """
    path = None if output is None else expanded(output)
    sink = FileSink(path, source=expanded(source), overwrite=request.overwrite)
    return run(FileSource(source, request.zones), request, sink, progress=progress, threads=threads)
