"""A file as a source, and a file as a sink."""

from __future__ import annotations

import contextlib
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ..formats.registry import as_written, format_named, read_splats
from ..report import Files, held
from ..volumes import forced
from ..whole_file import refuse_existing, refuse_mapped
from ..work import report
from .loaded import Loaded, RowSizes
from .run import DECIDED, Written

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from ..absorbing.absorb import Absorbed
    from ..formats.format import Format
    from ..volumes import Zone
    from .run import Runtime


@dataclass(frozen=True)
class FileSource:
    """Splats of a file.

    Attributes
    ----------
    path : path-like
    zones : sequence of Zone
        Volumes that say which splats must stay and which must go.
    """

    path: Path | str
    zones: Sequence[Zone] = ()

    def read(self, form: Format | None) -> Loaded:
        """Read the file; its frame is that of the views.

        Raises
        ------
        RefineError
            See `read_splats` and `volumes.forced`.
        """
        file = read_splats(self.path)
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


class Choice(Protocol):
    """Which splats stay, and as what."""

    @property
    def report(self) -> dict[str, Any]:
        """What the report says of it."""
        ...

    @property
    def keep(self) -> NDArray[np.bool_]:
        """Which splats stay, (N,)."""
        ...

    @property
    def absorbed(self) -> Absorbed | None:
        """What survivors became, where they absorbed others."""
        ...


@dataclass(frozen=True, eq=False)
class Kept:
    """Which splats stay, all of them as they are.

    Attributes
    ----------
    keep : (N,) bool
    report : dict
    """

    keep: NDArray[np.bool_]
    report: dict[str, Any]

    @property
    def absorbed(self) -> None:
        """Nothing is absorbed."""
        return


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

    def columns(self, loaded: Loaded, choice: Choice) -> dict[str, NDArray[Any]]:
        """Return the properties that are written otherwise than they are stored."""
        return loaded.columns(choice.absorbed)

    def write(self, loaded: Loaded, choice: Choice, runtime: Runtime) -> Written:
        """Write what stays: all of it, or nothing.

        Raises
        ------
        RefineError, Cancelled
            See `SplatFile.write`.
        """
        report(runtime.progress, DECIDED, "writing")
        made = as_written(loaded.file(), self.path)
        columns = self.columns(loaded, choice)
        path, size = self.written, made.size(choice.keep, columns)
        if path is not None:
            made.write(path, choice.keep, columns=columns, overwrite=self.overwrite)
            size = path.stat().st_size
        return Written(
            files=asdict(Files(loaded.name, str(path) if path else None, loaded.bytes, size)),
            path=path,
            splats=held(made, choice.keep, written=path is not None),
            notes=made.notes(choice.keep),
        )
