"""3DGS PLY files: read through a memory map, and written with the kept rows unchanged.

Binary rows are memory-mapped, so only the columns that are used are read from the disk. Text is
read into memory.
"""

from __future__ import annotations

import mmap
import stat
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import plyfile
from numpy.typing import NDArray

from ..errors import RefineError, reason_of
from ..rendering import MODELS, Model
from ..splats import Splats
from ..splats import with_model as drawn_as
from ..urls import Url
from ..whole_file import expanded, refuse_mapped, whole_file
from .ply_body import check_counts, read_text, vertex_range
from .ply_columns import (
    REQUIRED,
    REST_COUNTS,
    THIRD_SCALE,
    columns_from_splats,
    splats_from_columns,
)
from .ply_header import (
    TEXT,
    Header,
    format_of,
    model_of,
    read_header,
    shown,
    with_count,
    with_model,
    with_properties,
)
from .ply_write import declarations, longest_line, text_lines, write_rows

__all__ = [
    "REQUIRED",
    "REST_COUNTS",
    "SplatFile",
    "columns_from_splats",
    "read_ply",
    "splats_from_columns",
]

INDEXING = ("edge", "face", "tristrips")
"""Elements that by convention hold indices of vertices."""

_NAMES_SHOWN = 12


@dataclass(frozen=True)
class Origin:
    """The file that rows come from, where it is no plain PLY.

    Attributes
    ----------
    format : str
        Name and version of its format.
    size : int
        Its bytes.
    """

    format: str
    size: int


@dataclass(frozen=True, eq=False)
class SplatFile:
    """A 3DGS PLY file, opened; or a file of another format, as the PLY that holds the same splats.

    Attributes
    ----------
    path : Path
        Where it was read from.
    rows : (N,) structured
        The vertex element, one field for each property; read-only and mapped if binary.
    header : bytes
        The bytes of the header, with ``end_header`` and its line end.
    before, after : (M,) uint8
        Bytes of the body before and after the vertex rows.
    lines : list of bytes or None
        For ASCII files, the text of each vertex row with its line end.
    indexing : tuple of str
        Names of other elements whose rows hold indices of splats.
    origin : Origin or None
        Where the file is no plain PLY, what it is; `write` writes a plain PLY.
    """

    path: Path
    rows: NDArray[Any]
    header: bytes
    before: NDArray[np.uint8]
    after: NDArray[np.uint8]
    lines: list[bytes] | None = None
    indexing: tuple[str, ...] = ()
    origin: Origin | None = None

    def __len__(self) -> int:
        """Return the number of splats."""
        return len(self.rows)

    @property
    def row_bytes(self) -> int | NDArray[np.int64]:
        """Bytes of one splat in the file; of each of them, (N,), if rows are text."""
        if self.lines is not None:
            return np.fromiter(map(len, self.lines), np.int64, len(self.lines))
        return int(self.rows.dtype.itemsize)

    @property
    def changed_row_bytes(self) -> int:
        """Most bytes of one splat in the file after absorbing, which may change all its numbers."""
        if self.lines is None:
            return int(self.rows.dtype.itemsize)
        names = self.rows.dtype.names or ()
        ours = [name for name in names if name in REQUIRED or name.startswith("f_rest_")]
        return longest_line(self.rows.dtype, self.lines, ours)

    @property
    def fixed_bytes(self) -> int:
        """Bytes of everything but the splats."""
        return len(self.header) + len(self.before) + len(self.after)

    @property
    def format(self) -> str:
        """Format as in the header, such as ``binary_little_endian 1.0``, or of the `origin`."""
        return format_of(self.header) if self.origin is None else self.origin.format

    @property
    def stored_bytes(self) -> int:
        """Size of the file that was read, bytes."""
        return self.size() if self.origin is None else self.origin.size

    def size(
        self,
        keep: NDArray[np.bool_] | None = None,
        columns: Mapping[str, NDArray[Any]] | None = None,
    ) -> int:
        """Return how many bytes `write` would write.

        Parameters
        ----------
        keep, columns
            See `write`.
        """
        columns = columns or {}
        if self.lines is None:
            count = len(self) if keep is None else int(np.count_nonzero(keep))
            names = self.rows.dtype.names or ()
            kinds = [columns[name].dtype for name in columns if name not in names]
            rows = count * (self.rows.dtype.itemsize + sum(kind.itemsize for kind in kinds))
        else:
            rows = sum(map(len, text_lines(self.rows, self.lines, keep, columns)))
        return len(self._new_header(keep, columns)) + len(self.before) + rows + len(self.after)

    def notes(self, keep: NDArray[np.bool_]) -> list[str]:
        """Return what the user should know about a file of the kept rows, in sentences."""
        return [
            f"element '{name}' beside the splats is kept as it is; "
            "its indices may point past the end"
            for name in ([] if keep.all() else self.indexing)
        ]

    def left_out(self, _keep: NDArray[np.bool_]) -> int:
        """Return how many of the kept rows a file does not hold: none."""
        return 0

    @property
    def model(self) -> Model:
        """How its splats are drawn, by its header; discs if they have no third scale."""
        return stated_model(self.header, self.rows.dtype) or "default"

    def drawn_as(self, model: Model | None) -> SplatFile:
        """Return the file with splats that are drawn in another way; None leaves it as it is.

        Raises
        ------
        RefineError
            If there is no such model, or splats without a third scale are to be anything but discs.
        """
        if model is None or model == self.model:
            return self
        if model not in MODELS:
            raise RefineError(f"model is {model!r}, expected one of {', '.join(MODELS)}")
        if THIRD_SCALE not in (self.rows.dtype.names or ()):
            raise RefineError(
                f"{self.path}: splats without {THIRD_SCALE} are drawn as 2dgs, got {model}"
            )
        return replace(self, header=with_model(self.header, model))

    def without_third_scale(self) -> SplatFile:
        """Return discs of another format without the third scale that it has a place for.

        Rows of a plain PLY stay as they are, and so do splats that are no discs.
        """
        names = self.rows.dtype.names or ()
        if self.origin is None or self.model != "2dgs" or THIRD_SCALE not in names:
            return self
        left = [name for name in names if name != THIRD_SCALE]
        rows = np.empty(len(self), [(name, self.rows.dtype[name]) for name in left])
        for name in left:
            rows[name] = self.rows[name]
        third = f"property float {THIRD_SCALE}\n".encode()  # as `new_file` writes it
        return replace(self, rows=rows, header=self.header.replace(third, b""))

    def splats(self) -> Splats:
        """Return the rows as splats; the arrays are views of the file if its layout permits."""
        return drawn_as(splats_from_columns(self.rows), self.model)

    def write(
        self,
        path: Path | str,
        keep: NDArray[np.bool_] | None = None,
        *,
        columns: Mapping[str, NDArray[Any]] | None = None,
        overwrite: bool = False,
        threads: int | None = 1,
    ) -> None:
        """Write the kept rows in order; their bytes stay as they were read.

        Parameters
        ----------
        path : path-like
            The file to write, completely or not at all. ``~`` is the home folder.
        keep : (N,) bool, optional
            Which rows to write; all by default.
        columns : mapping of str to (N,), optional
            Properties to set. Properties that the file has keep their place and type; new ones are
            appended with the type of their array (float32 -> ``float``).
        overwrite : bool
            Whether an existing file may be replaced, even this one.
        threads : int, optional
            How many gather rows of a binary file, while others are written.

        Raises
        ------
        RefineError
            If the file cannot be written, or exists and may not be replaced; if the shape or type
            of `keep` or of a column is wrong.
        """
        path, columns = expanded(path), columns or {}
        if keep is not None and (keep.shape != self.rows.shape or keep.dtype != np.bool_):
            raise RefineError(
                f"{self.path}: keep is {keep.dtype} {keep.shape}, "
                f"expected one bool for each of {len(self)} splats"
            )
        header = self._new_header(keep, columns)
        if self.lines is None and not self.rows.flags.writeable:
            refuse_mapped(path, self.path)
        with whole_file(path, overwrite=overwrite) as stream:
            stream.write(header)
            stream.write(self.before.data)
            if self.lines is not None:
                stream.writelines(text_lines(self.rows, self.lines, keep, columns))
            else:
                write_rows(stream, self.rows, keep, columns, threads=threads)
            stream.write(self.after.data)

    def _new_header(
        self, keep: NDArray[np.bool_] | None, columns: Mapping[str, NDArray[Any]]
    ) -> bytes:
        """Return the header of a file of the kept rows with these columns."""
        count = len(self) if keep is None else int(np.count_nonzero(keep))
        header = with_count(self.header, count)
        declared = declarations(self.path, self.rows, columns)
        return with_properties(header, declared) if declared else header


def stated_model(header: bytes, rows: np.dtype[Any]) -> Model | None:
    """Return how a PLY says that its splats are drawn; None if it does not.

    Parameters
    ----------
    header : bytes
    rows : structured dtype
        Of its splats: without a third scale they are discs, whatever comments say.
    """
    return model_of(header) if THIRD_SCALE in (rows.names or ()) else "2dgs"


def read_ply(path: Path | str) -> SplatFile:
    """Open a 3DGS PLY file: binary of either byte order, or ASCII.

    Parameters
    ----------
    path : path-like
        ``~`` is the home folder.

    Returns
    -------
    SplatFile
        It may have no splats.

    Raises
    ------
    RefineError
        If the file does not exist, is not a PLY, is truncated, or does not hold splats; the message
        names the file, the place, what was found and what was expected.
    """
    path = expanded(path)
    header, vertex, body = _mapped(path)
    check_counts(header, len(body))
    filled = [e.name for e, count in zip(header.elements, header.counts, strict=True) if count]
    indexing = tuple(name for name in filled if name in INDEXING)
    if header.order == TEXT:
        rows, lines, beside = read_text(header, vertex, body.tobytes())
        before, after = (np.frombuffer(part, np.uint8) for part in beside)
        return SplatFile(path, rows, header.raw, before, after, lines, indexing)
    start, end = vertex_range(header, vertex, body)
    rows = body[start:end].view(header.elements[vertex].dtype(header.order))
    return SplatFile(path, rows, header.raw, body[:start], body[end:], indexing=indexing)


def _mapped(path: Path) -> tuple[Header, int, NDArray[np.uint8]]:
    """Return a file's header, which of its elements are splats, and its body, mapped."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # opening a pipe would wait for a writer
            raise RefineError(
                f"{path}: is a {'folder' if path.is_dir() else 'device'}, expected a PLY file"
            )
        with path.open("rb") as stream:
            header, vertex = splat_header(path, stream)
            whole = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError) as error:
        raise RefineError(f"{path}: cannot be read ({reason_of(error)})") from error
    return header, vertex, np.frombuffer(whole, np.uint8)[len(header.raw) :]


def splat_header(path: Path | Url, stream: BinaryIO) -> tuple[Header, int]:
    """Read the header of an open file of splats, and say which element they are.

    Raises
    ------
    RefineError
        See `read_ply`.
    """
    header = read_header(path, stream)
    vertex = _vertex_index(header)
    _check_properties(header, vertex)
    return header, vertex


def _vertex_index(header: Header) -> int:
    """Return the index of the vertex element; refuse files without one."""
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        raise RefineError(
            f"{header.path}: not a splat file: expected an element 'vertex', "
            f"got {_listed(names) or 'none'}"
        )
    return names.index("vertex")


def _listed(names: list[str]) -> str:
    """Return at most `_NAMES_SHOWN` names, cut to 40 characters each, for a message."""
    return ", ".join(name[:40] for name in names[:_NAMES_SHOWN])


def _check_properties(header: Header, vertex: int) -> None:
    """Refuse vertices that are not splats; the message says what they seem to be."""
    kinds = {
        prop.name: "list" if isinstance(prop, plyfile.PlyListProperty) else prop.val_dtype
        for prop in header.elements[vertex].properties
    }
    if "packed_position" in kinds:
        raise RefineError(
            f"{header.path}: a compressed splat PLY, which 'refine convert IN OUT.ply' makes a "
            "plain one of"
        )
    missing = [name for name in REQUIRED if name not in kinds]
    if missing and missing != [THIRD_SCALE]:
        present = _listed([*kinds])
        present += ", ..." if len(kinds) > _NAMES_SHOWN else ""
        raise RefineError(
            f"{header.path}: {_guess(header, kinds)}: vertex lacks {', '.join(missing)} "
            f"(it has {present or 'no property'})"
        )
    rest = [name for name in kinds if name.startswith("f_rest_")]
    if len(rest) not in REST_COUNTS or any(f"f_rest_{i}" not in kinds for i in range(len(rest))):
        raise RefineError(
            f"{header.path}: found {len(rest)} f_rest properties, "
            "expected f_rest_0 onward, 0, 9, 24, 45 or 72 of them (degree 0 to 4)"
        )
    for name, kind in kinds.items():
        if kind == "list":
            raise RefineError(
                f"{header.path}: property {shown(name)} is a list, expected one number a splat"
            )
        if kind not in ("f4", "f8") and (name in REQUIRED or name in rest):
            raise RefineError(
                f"{header.path}: property {shown(name)} is of type {kind}, expected float or double"
            )


def _guess(header: Header, kinds: Mapping[str, str]) -> str:
    """Return what a file without all properties of splats seems to be."""
    if "opacity" in kinds:
        return "incomplete splats"
    if any(element.name in INDEXING for element in header.elements):
        return "a mesh, not splats"
    return "a point cloud, not splats"
