"""Pruning where all splats are in memory: what is asked, and how it is decided."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..affine import is_uniform, transformed
from ..cleaning.clean import clean
from ..formats.registry import read_written, refuse_unknown_size
from ..pipeline import decide
from ..task import DEFAULTS, Settings, Task
from ..whole_file import expanded
from ..work import Progress, silent
from .files import FileSink, FileSource
from .run import DECIDED, Request, run
from .written import written_facts

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from ..cleaning.clean import Cleaning
    from ..formats.format import Format
    from ..picture_files import PictureFiles
    from ..selection import Budget
    from ..splats import Splats
    from ..task import Result
    from ..views import ViewSet
    from ..volumes import Zone
    from .loaded import Loaded
    from .run import Runtime

CLEANED, COMPARED = 0.4, 0.85
"""Where in the progress of a prune cleaning ends, and where pictures begin."""


@dataclass(frozen=True, eq=False)
class PruneRequest(Request["Loaded", "Result"]):
    """What is asked of a prune.

    Attributes
    ----------
    views : ViewSet
        Those that decide.
    budget : Budget
        How much goes.
    settings : Settings
        How to score.
    zones : sequence of Zone
        Volumes that say which splats must stay and which must go, in the frame of the views.
    absorb : bool
        Whether survivors absorb the splats that are removed; see `Task`.
    cleaning : Cleaning or None
        What to clean away first. The budget then counts what is left.
    pictures : PictureFiles or None
        Where pictures before and after go; none are drawn without it.
    overwrite : bool
        Whether files may be replaced.
    dry_run : bool
        Whether to decide as for the output, and write no splats.
    """

    views: ViewSet
    budget: Budget
    settings: Settings = DEFAULTS
    zones: Sequence[Zone] = ()
    absorb: bool = False
    cleaning: Cleaning | None = None
    pictures: PictureFiles | None = None
    overwrite: bool = False
    dry_run: bool = False

    @property
    def compares_pictures(self) -> bool:
        """Whether colours as each view sees them are needed, for an estimate or for pictures."""
        estimates = self.settings.estimates or self.budget.psnr is not None
        return estimates or self.pictures is not None

    @contextlib.contextmanager
    def opened(self, form: Format | None) -> Iterator[None]:
        """Refuse a size in a format that has none beforehand, and pictures that cannot be written.

        Parameters
        ----------
        form : Format or None
            Of the output.

        Raises
        ------
        RefineError
        """
        if self.budget.max_mb is not None and form is not None:
            refuse_unknown_size(form)
        with contextlib.ExitStack() as held:
            if self.pictures is not None:
                held.enter_context(self.pictures.opened(self.views))
            yield

    def decide(self, loaded: Loaded, runtime: Runtime) -> Result:
        """Return which splats stay, and what they become: clean, then `pipeline.decide`.

        Raises
        ------
        RefineError, Cancelled
            See `clean` and `pipeline.decide`.
        """
        loaded = loaded.counted(self.budget, absorb=self.absorb)
        if self.cleaning is None:
            return self._decide(loaded, runtime.part(0.0, DECIDED))
        forced = loaded.forced
        cleaned = clean(
            loaded.splats, self.views, self.cleaning,
            protected=forced.protected, removed=forced.removed,
            progress=runtime.part(0.0, CLEANED).progress, threads=runtime.threads,
        )  # fmt: skip
        runtime.clock.lap("clean_s")
        # The budget counts what is forced out as removed, so that is not cleaned away.
        left = cleaned.keep if forced.removed is None else cleaned.keep | forced.removed
        result = self._decide(loaded.take(left), runtime.part(CLEANED, DECIDED)).for_all(left)
        result.report["cleaned"] = cleaned.facts()
        return result

    def _decide(self, loaded: Loaded, runtime: Runtime) -> Result:
        """Decide on what cleaning left."""
        task = Task(
            budget=self.budget,
            settings=self.settings,
            splats=loaded.splats,
            views=self.views,
            protected=loaded.forced.protected,
            removed=loaded.forced.removed,
            absorb=self.absorb,
            row_bytes=loaded.sizes.row,
            fixed_bytes=loaded.sizes.fixed,
            reusable=loaded.reusable,
        )
        result = decide(
            task, clock=runtime.clock, progress=runtime.progress, threads=runtime.threads
        )
        result.report["volumes"] = loaded.volumes
        return result

    def compare(
        self, loaded: Loaded, result: Result, path: Path | None, runtime: Runtime
    ) -> dict[str, Any]:
        """Return what a lossy format costs, and what was measured in pictures.

        Parameters
        ----------
        loaded : Loaded
        result : Result
            What was decided of them.
        path : Path or None
            The file that holds what stays, if one was written.
        runtime : Runtime

        Raises
        ------
        RefineError, Cancelled
            See `PictureFiles.write`; by then the splats are written.
        """
        facts: dict[str, Any] = {}
        if path is not None:
            used = self.views.spread(self.settings.views)
            facts |= written_facts(
                path, result.scores, used, matrix=loaded.matrix, threads=runtime.threads
            )
        if self.pictures is not None:
            facts["pictures"] = self.pictures.write(
                loaded.splats, _as_written(loaded, result, path), self.views,
                progress=runtime.part(COMPARED, 1.0).progress, threads=runtime.threads,
            )  # fmt: skip
            runtime.clock.lap("pictures_s")
        return facts


def _as_written(loaded: Loaded, result: Result, path: Path | None) -> Splats:
    """Return what stays as the file holds it, in the frame of the views.

    Where the matrix scales directions differently, harmonics cannot follow it: nothing that a
    format rounds is seen then.
    """
    matrix = loaded.matrix
    if path is None or not is_uniform(matrix):
        return result.survivors(loaded.splats)
    rounded = read_written(path)
    if rounded is None:
        return result.survivors(loaded.splats)
    return rounded if np.array_equal(matrix, np.eye(4)) else transformed(rounded, matrix)


def prune_file(
    source: Path | str,
    output: Path | str | None,
    request: PruneRequest,
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> Result:
    """Prune a file of splats, and write the result to another file.

    Parameters
    ----------
    source : path-like
        The file to read, of any format (`read_splats`).
    output : path-like or None
        The file to write, in the format that its suffix names; None decides without writing, as for
        a plain PLY.
    request : PruneRequest
        What is asked.
    progress, threads
        See `run`.

    Returns
    -------
    Result
        Its report also has the names and sizes of the files.

    Raises
    ------
    RefineError, Cancelled
        See `run`, `FileSource`, `FileSink` and `PruneRequest`. Nothing is written then, unless the
        message says so.

    Examples
    --------
    To leave half of the splats, with what they absorbed::

        prune_file("in.ply", "out.ply", PruneRequest(views, Budget(ratio=0.5), absorb=True))
    """
    sink = FileSink(
        None if output is None else expanded(output),
        source=expanded(source),
        overwrite=request.overwrite,
        dry_run=request.dry_run,
    )
    return run(FileSource(source, request.zones), request, sink, progress=progress, threads=threads)
