"""Pruning from a file to a file: reading, cleaning, `pipeline.decide`, writing."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .cleaning.clean import clean
from .formats.registry import Packed, as_written, read_splats, refuse_unknown_size
from .pipeline import decide
from .report import Clock, Files, complete_report, held, kept_and_removed
from .survivors import survivor_columns
from .task import DEFAULTS, Result, Settings, Task
from .whole_file import expanded, refuse_existing, refuse_mapped
from .work import Progress, part, report, silent
from .written import written_facts

if TYPE_CHECKING:
    from pathlib import Path

    from .cleaning.clean import Cleaned, Cleaning
    from .selection import Budget, RowBytes
    from .views import ViewSet


def prune_file(  # noqa: PLR0913 - as `pipeline.prune`
    source: Path | str,
    output: Path | str | None,
    views: ViewSet,
    budget: Budget,
    settings: Settings = DEFAULTS,
    *,
    absorb: bool = False,
    cleaning: Cleaning | None = None,
    overwrite: bool = False,
    dry_run: bool = False,
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
    views, budget, settings, absorb, progress, threads
        See `pipeline.prune`.
    cleaning : Cleaning, optional
        What to clean away first. The budget then counts what is left.
    overwrite : bool
        Whether `output` may replace a file.
    dry_run : bool
        Whether to decide as for `output`, and write nothing.

    Returns
    -------
    Result
        Its report also has the names and sizes of the files.

    Raises
    ------
    RefineError, Cancelled
        See `pipeline.prune`, `read_splats` and `SplatFile.write`; also if a budget is a size, and
        the format of `output` compresses the file as a whole. Then nothing is written.
    """
    clock = Clock()
    target = None if output is None else expanded(output)
    written = None if dry_run else target
    if written is not None:
        refuse_existing(written, overwrite=overwrite)
        refuse_mapped(written, expanded(source))
    file = read_splats(source)
    made = as_written(file, target)
    row_bytes: RowBytes = made.row_bytes
    if budget.max_mb is not None and isinstance(made, Packed):
        refuse_unknown_size(made.form)
    if absorb and budget.removals(len(file), row_bytes, made.fixed_bytes) != 0:
        row_bytes = made.changed_row_bytes  # how long each becomes is not known before
    splats, cleaned = file.splats(), None
    clock.lap("read_s")
    if cleaning is not None:
        ahead = part(progress, 0.0, 0.4)
        cleaned = clean(splats, views, cleaning, progress=ahead, threads=threads)
        splats = splats.take(cleaned.keep)
        if isinstance(row_bytes, np.ndarray):
            row_bytes = row_bytes[cleaned.keep]
        clock.lap("clean_s")
    task = Task(
        budget=budget,
        settings=settings,
        splats=splats,
        views=views,
        absorb=absorb,
        row_bytes=row_bytes,
        fixed_bytes=made.fixed_bytes,
    )
    ahead = part(progress, 0.0 if cleaned is None else 0.4, 0.8)
    result = decide(task, clock=clock, progress=ahead, threads=threads)
    if cleaned is not None:
        result = _of_all(result, cleaned)
    report(progress, 0.8, "writing")
    columns = survivor_columns(file.rows, result.absorbed) if result.absorbed else {}
    sizes = (file.stored_bytes, made.size(result.keep, columns))
    if written is not None:
        made.write(written, result.keep, columns=columns, overwrite=overwrite)
        sizes = (sizes[0], written.stat().st_size)
    clock.lap("write_s")
    if written is not None:
        used = views.spread(settings.views)
        result.report.update(written_facts(written, result.scores, used, threads=threads))
    result.report["splats"] |= held(made, result.keep, written=written is not None)
    result.report["notes"] += made.notes(result.keep)
    names = (str(file.path), None if written is None else str(written))
    complete_report(result.report, clock, Files(*names, *sizes))
    return result


def _of_all(result: Result, cleaned: Cleaned) -> Result:
    """Return a result for what cleaning left as one for all splats.

    Its scores stay those of what cleaning left.
    """
    keep = cleaned.keep.copy()
    keep[cleaned.keep] = result.keep
    absorbed = result.absorbed
    if absorbed is not None:
        absorbed = replace(absorbed, keep=keep)
    result.report["splats"] |= {"before": len(keep), **kept_and_removed(keep)}
    result.report["cleaned"] = cleaned.facts()
    return replace(result, keep=keep, absorbed=absorbed)
