"""A file as a source, and a file as a sink."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from ..execute import Progress, report, silent
from ..formats import registry
from ..formats.format import Format
from ..formats.registry import format_named, read_splats, write_splats
from ..rendering import Model
from ..report import files_facts, held
from ..task import Result
from ..volumes import Zone, forced
from ..whole_file import expanded, refuse_existing, refuse_mapped
from .loaded import Loaded, RowSizes
from .requests import Kept, PruneRequest
from .run import Request, Runtime, Written, run

ChoiceT = TypeVar("ChoiceT", bound="Result | Kept")


def prune_file(
    source: Path | str,
    output: Path | str | None,
    request: PruneRequest,
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> Result:
    """Prune a file of splats, and write the result to another file; see `file_to_file`.

    Examples
    --------
    To leave half of the splats, with what they absorbed::

        prune_file("in.ply", "out.ply", PruneRequest(views, Budget(ratio=0.5), survivors="absorb"))
    """
    return file_to_file(source, output, request, progress=progress, threads=threads)


def file_to_file(
    source: Path | str,
    output: Path | str | None,
    request: Request[Loaded, ChoiceT],
    *,
    progress: Progress = silent,
    threads: int | None = None,
) -> ChoiceT:
    """Do what is asked with the splats of a file, and write what stays to another file.

    Parameters
    ----------
    source : path-like
        The file to read, of any format (`read_splats`).
    output : path-like or None
        The file to write, in the format that its suffix names; None decides without writing, as for
        a plain PLY.
    request : PruneRequest, CleanRequest, ScoreRequest or ConvertRequest
        What is asked.
    progress, threads
        See `run`.

    Returns
    -------
    Result or Kept
        Its report also has the names and sizes of the files.

    Raises
    ------
    RefineError, Cancelled
        See `run`, `FileSource`, `FileSink` and the request. Nothing is written then, unless the
        message says so.
    """
    sink = FileSink(
        None if output is None else expanded(output),
        source=expanded(source),
        overwrite=request.overwrite,
        dry_run=request.dry_run,
    )
    read = FileSource(source, request.zones, request.model)
    return run(read, request, sink, progress=progress, threads=threads)


@dataclass(frozen=True)
class FileSource:
    """Splats of a file.

    Attributes
    ----------
    path : path-like
    zones : sequence of Zone
        Volumes that say which splats must stay and which must go.
    model : {"default", "antialiased", "2dgs"}, optional
        How the splats are drawn, where the file does not say or is wrong.
    """

    path: Path | str
    zones: Sequence[Zone] = ()
    model: Model | None = None

    def read(self, form: Format | None) -> Loaded:
        """Read the file; its frame is that of the views.

        Raises
        ------
        RefineError
            See `read_splats` and `volumes.forced`.
        """
        file = read_splats(self.path, self.model)
        splats = file.splats()
        return Loaded(
            name=str(file.path),
            bytes=file.stored_bytes,
            splats=splats,
            forced=forced(self.zones, splats.means),
            sizes=RowSizes.of(file, form),
            stored=file.rows,
            file=lambda: file,
            matrix=np.eye(4),
        )


@dataclass(frozen=True)
class FileSink:
    """A file to be made of what stays.

    Attributes
    ----------
    path : Path or None
        Its suffix names the format. None writes nothing.
    source : Path or None
        The file that is read meanwhile, if it is one.
    overwrite : bool
        Whether a file may be replaced.
    dry_run : bool
        Whether to tell sizes and counts as of the file, and write nothing.
    """

    path: Path | None
    source: Path | None = None
    overwrite: bool = False
    dry_run: bool = False
    timing: str = "write_s"

    @property
    def form(self) -> Format | None:
        """Its format; None is plain PLY."""
        return None if self.path is None else format_named(self.path)

    @property
    def written(self) -> Path | None:
        """The file that is made, if one is."""
        return None if self.dry_run else self.path

    @contextlib.contextmanager
    def opened(self) -> Iterator[None]:
        """Refuse a file that cannot be written, before the work.

        Raises
        ------
        RefineError
            See `refuse_existing` and `refuse_mapped`.
        """
        if self.written is not None:
            refuse_existing(self.written, overwrite=self.overwrite)
            if self.source is not None:
                refuse_mapped(self.written, self.source)
        yield

    def write(self, loaded: Loaded, choice: Result | Kept, runtime: Runtime) -> Written:
        """Write what stays: all of it, or nothing.

        Raises
        ------
        RefineError, Cancelled
            See `SplatFile.write`.
        """
        report(runtime.progress, 0.0, "writing")
        file = loaded.file()
        columns = choice.columns if isinstance(choice, Kept) else loaded.columns(choice.absorbed)
        path, size = self.written, registry.written_size(file, self.form, choice.keep, columns)
        if path is not None:
            write_splats(
                path, file, choice.keep, columns=columns, overwrite=self.overwrite,
                threads=runtime.threads,
            )  # fmt: skip
            size = path.stat().st_size
        return Written(
            files=files_facts(loaded.name, str(path) if path else None, loaded.bytes, size),
            path=path,
            splats=held(file, self.form, choice.keep, written=path is not None),
            notes=[*registry.notes(file, self.form, choice.keep), *loaded.notes],
        )
