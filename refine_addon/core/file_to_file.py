"""Pruning from a file to a file: reading, cleaning, `pipeline.decide`, writing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .affine import is_uniform, transformed
from .cleaning.clean import clean
from .estimate.written import written_facts
from .formats.registry import (
    Packed,
    as_written,
    read_splats,
    read_written,
    refuse_unknown_size,
)
from .pipeline import decide
from .report import Clock, Files, complete_report, held
from .survivors import survivor_columns
from .task import DEFAULTS, Result, Settings, Task
from .volumes import forced
from .whole_file import expanded, refuse_existing, refuse_mapped
from .work import Progress, part, report, silent

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from .cleaning.clean import Cleaning
    from .picture_files import PictureFiles
    from .selection import Budget, RowBytes
    from .splats import Splats
    from .views import ViewSet
    from .volumes import Zone


def prune_file(  # noqa: PLR0913 - as `pipeline.prune`
    source: Path | str,
    output: Path | str | None,
    views: ViewSet,
    budget: Budget,
    settings: Settings = DEFAULTS,
    *,
    zones: Sequence[Zone] = (),
    absorb: bool = False,
    cleaning: Cleaning | None = None,
    pictures: PictureFiles | None = None,
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
    zones : sequence of Zone
        Volumes that say which splats must stay and which must go.
    cleaning : Cleaning, optional
        What to clean away first. The budget then counts what is left.
    pictures : PictureFiles, optional
        Where pictures before and after go; none are drawn without it.
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
        See `pipeline.prune`, `volumes.forced`, `read_splats` and `SplatFile.write`; also if a
        budget is a size, and the format of `output` compresses the file as a whole. Then nothing is
        written.
    """
    if pictures is not None:
        pictures.refuse_existing(views)
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
    splats, cleaned = file.splats(), None
    given = forced(zones, splats.means)
    rest = np.ones(len(file), np.bool_) if given.removed is None else ~given.removed
    stay = row_bytes[rest] if isinstance(row_bytes, np.ndarray) else row_bytes
    if absorb and budget.removals(int(rest.sum()), stay, made.fixed_bytes) != 0:
        row_bytes = made.changed_row_bytes  # how long each becomes is not known before
    clock.lap("read_s")
    if cleaning is not None:
        ahead = part(progress, 0.0, 0.4)
        cleaned = clean(
            splats, views, cleaning, protected=given.protected, removed=given.removed,
            progress=ahead, threads=threads,
        )  # fmt: skip
        left = cleaned.keep | ~rest  # what is forced out is the budget's
        splats, given = splats.take(left), given.of(left)
        if isinstance(row_bytes, np.ndarray):
            row_bytes = row_bytes[left]
        clock.lap("clean_s")
    task = Task(
        budget=budget,
        settings=settings,
        splats=splats,
        views=views,
        protected=given.protected,
        removed=given.removed,
        absorb=absorb,
        row_bytes=row_bytes,
        fixed_bytes=made.fixed_bytes,
    )
    ahead = part(progress, 0.0 if cleaned is None else 0.4, 0.8)
    result = decide(task, clock=clock, progress=ahead, threads=threads)
    if cleaned is not None:
        result = result.for_all(left)
        result.report["cleaned"] = cleaned.facts()
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
    ahead = part(progress, 0.85, 1.0)
    result.report.update(
        picture_facts(
            pictures, file.splats(), result, written, views,
            clock=clock, progress=ahead, threads=threads,
        ),
        volumes=list(given.facts),
    )  # fmt: skip
    result.report["splats"] |= held(made, result.keep, written=written is not None)
    result.report["notes"] += made.notes(result.keep)

    complete_report(
        result.report, clock, Files(str(file.path), str(written) if written else None, *sizes)
    )
    return result


def picture_facts(  # noqa: PLR0913 - what was pruned, and what to draw of it
    pictures: PictureFiles | None,
    splats: Splats,
    result: Result,
    written: Path | None,
    views: ViewSet,
    *,
    clock: Clock,
    matrix: NDArray[np.float64] | None = None,
    progress: Progress = silent,
    threads: int | None = None,
) -> dict[str, Any]:
    """Write the pictures of a prune; return what the report says of them, nothing without any.

    Parameters
    ----------
    pictures : PictureFiles or None
    splats : Splats
        All of them, in the frame of the views.
    result : Result
        What was decided of them.
    written : Path or None
        The file that holds what stays, if there is one: what a lossy format rounds is to be seen.
    views : ViewSet
        Those that decided.
    clock : Clock
        Gets the time that it took.
    matrix : (4, 4) float64, optional
        From the frame of the file to that of the views; by default they are the same. Where it
        scales directions differently, nothing that is rounded is seen.
    progress, threads
        See `PictureFiles.write`.

    Raises
    ------
    RefineError, Cancelled
        See `PictureFiles.write`.
    """
    if pictures is None:
        return {}
    after = result.survivors(splats)
    matrix = np.eye(4) if matrix is None else matrix
    rounded = read_written(written) if written is not None and is_uniform(matrix) else None
    if rounded is not None:
        moved = not np.array_equal(matrix, np.eye(4))
        after = transformed(rounded, matrix) if moved else rounded
    facts = pictures.write(splats, after, views, progress=progress, threads=threads)
    clock.lap("pictures_s")
    return {"pictures": facts}
