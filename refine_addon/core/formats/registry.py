"""All splat formats: an input is known by its content, an output by its suffix."""

from __future__ import annotations

import math
import mmap
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError, reason_of
from ..foreign_files import refuse_pointer
from ..rendering import Model
from ..splats import Splats, drawable, with_model
from ..urls import Url
from ..whole_file import expanded, whole_file
from . import compressed_ply, dot_splat, glb, ksplat, sog, spz, streamed_sog
from .format import Format, Reader, Sizes
from .ply import SplatFile, read_ply
from .ply_columns import other_properties, splats_from_columns

FORMATS: tuple[Format, ...] = (
    compressed_ply.FORMAT,
    spz.FORMAT,
    glb.FORMAT,
    sog.FORMAT,
    dot_splat.FORMAT,  # known by its name alone, if it is none of the others
)
"""Every format that is written, but plain PLY."""

READERS: tuple[Reader, ...] = (
    *FORMATS,
    ksplat.READER,
    streamed_sog.READER,  # before SOG, whose name its own ends in
    sog.META_READER,
)
"""Every format that is read, but plain PLY, in the order in which an input is tried."""

SUFFIXES = (".ply", *(form.suffix for form in FORMATS))
"""Endings of the files that are written."""

READ_SUFFIXES = (".ply", *(form.suffix for form in READERS))
"""Endings of the files that are read."""

INDEX_NAMES = (streamed_sog.INDEX, sog.META_READER.suffix)
"""Names of files that stand for a folder."""

_LONGEST_FIRST = sorted(READ_SUFFIXES, key=len, reverse=True)

NOT_WRITTEN = (
    ksplat.READER.suffix,
    sog.META_READER.suffix,
    ".gltf",
    ".lcc",
    ".gz",
    ".bz2",
    ".xz",
    ".zst",
    ".zip",
)
"""Endings of other splat formats and of compressed files: a PLY of such a name would mislead."""

_HEAD = 1 << 16  # bytes by which a format is known; the header of a compressed PLY has fewer


def read_splats(path: Path | str, model: Model | None = None, level: int = 0) -> SplatFile:
    """Open a file of splats of any format, known by its content.

    Parameters
    ----------
    path : path-like
        ``~`` is the home folder.
    model : {"default", "antialiased", "2dgs"}, optional
        How its splats are drawn, where it does not say or is wrong.
    level : int
        Which level of a streamed SOG, 0 being the finest; other files have none but 0.

    Returns
    -------
    SplatFile
        A plain PLY is mapped as it is; a file of another format becomes the rows of the plain PLY
        that holds the same splats, in memory, and `SplatFile.origin` says what it was.

    Raises
    ------
    RefineError
        If the file does not exist, is of no known format, or is damaged; the message names the
        file, the place, what was found and what was expected. See also `SplatFile.drawn_as`.
    """
    return _read(expanded(path), level).drawn_as(model).without_third_scale()


def _read(path: Path, level: int) -> SplatFile:
    """Open a file of splats, see `read_splats`."""
    head = _beginning(path)
    refuse_pointer(path, head)
    form = next((form for form in READERS if form.matches(path, head)), None)
    if level and form is not streamed_sog.READER:
        raise RefineError(f"{path}: has no level {level}: only {streamed_sog.INDEX} has levels")
    if form is None:
        return read_ply(path)
    try:
        with path.open("rb") as stream:
            whole = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:
        raise RefineError(f"{path}: cannot be read ({reason_of(error)})") from error
    data = np.frombuffer(whole, np.uint8)
    return streamed_sog.read(path, data, level) if level else form.read(path, data)


def read_written(path: Path) -> Splats | None:
    """Return what a file holds that was just written in a format that rounds.

    Parameters
    ----------
    path : Path

    Returns
    -------
    Splats or None
        None for a plain PLY, which is exact, and for a file that may not be read: one that replaced
        another has its permissions.

    Raises
    ------
    RefineError
        See `read_splats`.
    """
    try:
        path.open("rb").close()
    except PermissionError:
        return None
    return None if format_named(path) is None else read_splats(path).splats()


def _beginning(path: Path) -> bytes:
    """Return the first bytes of a file; none where it cannot be read, which `read_ply` explains."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            return b""
        with path.open("rb") as stream:
            return stream.read(_HEAD)
    except (OSError, ValueError):
        return b""


def format_named(path: Path | Url) -> Format | None:
    """Return the format that an output of this name is written in; None for a plain PLY.

    Raises
    ------
    RefineError
        If the name is that of a format which is not written.
    """
    name = path.name.lower()
    form = next((form for form in FORMATS if name.endswith(form.suffix)), None)
    if form is None and name.endswith(NOT_WRITTEN):
        msg = f"{path}: {path.suffix} is not written, expected one of {', '.join(SUFFIXES)}"
        if name.endswith(streamed_sog.INDEX):
            msg = f"{path}: holds levels, which lod makes; expected one of {', '.join(SUFFIXES)}"
        raise RefineError(msg)
    return form


def without_suffix(name: str) -> str:
    """Return a file name without the ending of a format of splats, if it has one."""
    end = next((end for end in _LONGEST_FIRST if name.lower().endswith(end)), "")
    return name[: len(name) - len(end)]


def scene_name(path: Path) -> str:
    """Return what the splats of a file are called: as the file, or the folder of an index.

    Examples
    --------
    >>> from pathlib import Path
    >>> [scene_name(Path(name)) for name in ("a/b.compressed.ply", "a/b", "a/lod-meta.json")]
    ['b', 'b', 'a']
    """
    name = without_suffix(path.name)
    return name or path.absolute().parent.name or path.name


def refuse_unknown_size(form: Format) -> None:
    """Raise `RefineError` if the size of a file does not follow from the number of its splats."""
    if form.sizes is None:
        fixed = ", ".join(other.suffix for other in FORMATS if other.sizes)
        raise RefineError(
            f"a size cannot be kept to in {form.suffix}, which is compressed as a whole: choose "
            f"another budget, or write .ply, {fixed}"
        )


def as_written(file: SplatFile, path: Path | None) -> SplatFile | Packed:
    """Return what writes a file's splats to `path`, by the suffix of `path`.

    Parameters
    ----------
    file : SplatFile
    path : Path or None
        None stands for a plain PLY.

    Returns
    -------
    SplatFile or Packed
        `file` itself where a plain PLY is written.

    Raises
    ------
    RefineError
        See `format_named`.
    """
    form = None if path is None else format_named(path)
    return file if form is None else Packed(file, form)


@dataclass(frozen=True, eq=False)
class Packed:
    """The splats of a file as another format than plain PLY holds them.

    It has what `SplatFile` has for writing.
    """

    file: SplatFile
    form: Format

    @property
    def row_bytes(self) -> float:
        """Bytes of one splat in the file; 0 where a file is compressed as a whole."""
        sizes = self._sizes(len(self.file))
        return sizes.row if sizes else 0.0

    changed_row_bytes = row_bytes

    @property
    def fixed_bytes(self) -> int:
        """Bytes of everything but the splats, at most."""
        sizes = self._sizes(len(self.file))
        return sizes.fixed if sizes else 0

    def size(
        self,
        keep: NDArray[np.bool_] | None = None,
        _columns: Mapping[str, NDArray[Any]] | None = None,
    ) -> int | None:
        """Return how many bytes `write` would write, at most; None where only writing tells.

        Parameters
        ----------
        keep
            See `write`.
        """
        count = len(self.file) if keep is None else int(np.count_nonzero(keep))
        sizes = self._sizes(count)
        return None if sizes is None else math.ceil(sizes.row * count) + sizes.fixed

    def notes(self, keep: NDArray[np.bool_]) -> list[str]:
        """Return what the user should know about a file of the kept rows, in sentences."""
        notes = [f"{self.form.suffix} {self.form.loss} (docs/conventions.md, Formats)"]
        degree = self.file.splats().sh_degree
        if degree > self.form.degree:
            notes.append(
                f"{self.form.suffix} holds harmonics of degree {self.form.degree}, "
                f"the file has degree {degree}: the others are left out"
            )
        if self.file.model not in self.form.models:
            notes.append(
                f"{self.form.suffix} does not say that splats are {self.file.model}: read it with "
                f"--model {self.file.model}"
            )
        extra = other_properties(self.file.rows.dtype.names or ())
        if extra:
            notes.append(f"{self.form.suffix} does not hold {', '.join(extra)}: left out")
        lost = self.left_out(keep)
        if lost:
            notes.append(
                f"{lost} of the kept splats cannot be drawn and {self.form.suffix} cannot hold "
                "them: left out"
            )
        return notes

    def left_out(self, keep: NDArray[np.bool_]) -> int:
        """Return how many of the kept rows cannot be drawn: no file of the format holds them."""
        return int(np.count_nonzero(keep & ~drawable(self.file.splats())))

    def write(
        self,
        path: Path | str,
        keep: NDArray[np.bool_] | None = None,
        *,
        columns: Mapping[str, NDArray[Any]] | None = None,
        overwrite: bool = False,
        threads: int | None = 1,
    ) -> None:
        """Write the kept splats; those that cannot be drawn are left out.

        Parameters
        ----------
        path, keep, columns, overwrite, threads
            See `SplatFile.write`.

        Raises
        ------
        RefineError
            If the file cannot be written, or exists and may not be replaced; if no splat is left,
            or a column is none that the format holds.
        """
        path = expanded(path)
        splats = self.chosen(path, keep, columns or {})
        with whole_file(path, overwrite=overwrite) as stream:
            self.form.write(stream, splats)

    def chosen(
        self, path: Path, keep: NDArray[np.bool_] | None, columns: Mapping[str, NDArray[Any]]
    ) -> Splats:
        """Return the splats that `write` writes; errors name `path`."""
        rows = self.file.rows if keep is None else self.file.rows[keep]
        if columns:
            rows = rows.copy()
            for name, values in columns.items():
                if name not in (rows.dtype.names or ()):
                    raise RefineError(
                        f"{path}: {self.form.suffix} holds no property '{name}'; write to a .ply"
                    )
                rows[name] = values if keep is None else values[keep]
        splats = with_model(splats_from_columns(rows), self.file.model)
        good = drawable(splats)
        if not good.any():
            raise RefineError(
                f"{path}: none of the {len(splats)} splats can be drawn: nothing to write"
            )
        if not good.all():
            splats = splats.take(good)
        return splats.up_to_degree(self.form.degree)

    def _sizes(self, count: int) -> Sizes | None:
        return self.form.sizes_without_more(count, self.file.splats().sh_degree)
