"""3DGS PLY files: read through a memory map, write the kept rows and not a byte else.

plyfile reads the header's grammar and every body that is text or holds lists. Rows of fixed size
are mapped, so that a file of any size costs only the columns that are looked at.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import plyfile

from .errors import RefineError
from .files import whole_file
from .splats import Splats

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from typing import BinaryIO

    from numpy.typing import NDArray

HEADER_LIMIT = 1 << 20
"""A header longer than this many bytes is not one of ours."""

REQUIRED = (
    *("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
"""Properties without which a vertex is no splat."""

REST_COUNTS = {0: 0, 9: 1, 24: 2, 45: 3, 72: 4}
"""Number of ``f_rest_*`` properties -> spherical-harmonics degree."""

_WRITE_ROWS = 1 << 16


@dataclass(frozen=True, eq=False)
class SplatFile:
    """A 3DGS PLY file, opened.

    Attributes
    ----------
    path : Path
        Where it was read from.
    rows : (N,) structured
        The vertex element, one field a property in file order; a read-only memory map if binary.
    header : bytes
        The header as it stands in the file, ``end_header`` and line end included.
    before, after : (M,) uint8
        Bytes of the body ahead of and behind the vertex rows.
    lines : list of bytes or None
        For ASCII files, the text of each vertex row with its line end.
    """

    path: Path
    rows: NDArray[Any]
    header: bytes
    before: NDArray[np.uint8]
    after: NDArray[np.uint8]
    lines: list[bytes] | None = None

    def __len__(self) -> int:
        """Return the number of splats."""
        return len(self.rows)

    @property
    def row_bytes(self) -> float:
        """Bytes one splat takes (the mean, for an ASCII file)."""
        if self.lines is not None:
            return sum(map(len, self.lines)) / max(len(self), 1)
        return self.rows.dtype.itemsize

    @property
    def fixed_bytes(self) -> int:
        """Bytes that stay however many splats go."""
        return len(self.header) + len(self.before) + len(self.after)

    @property
    def format(self) -> str:
        """What the header's format line says, such as ``binary_little_endian 1.0``."""
        found = re.search(rb"[\r\n]format[ \t]+([^\r\n]*)", self.header)
        return found[1].decode("ascii", "replace").strip() if found else ""

    def size(self, keep: NDArray[np.bool_] | None = None) -> int:
        """Return how many bytes the file takes with the kept rows (all by default)."""
        count = len(self) if keep is None else int(np.count_nonzero(keep))
        header = len(_with_count(self.header, count))
        if self.lines is None:
            rows = count * int(self.rows.dtype.itemsize)
        else:
            kept = range(len(self)) if keep is None else np.flatnonzero(keep)
            rows = sum(len(self.lines[index]) for index in kept)
        return header + len(self.before) + rows + len(self.after)

    def splats(self) -> Splats:
        """Return the rows as splats, as views of the file where its layout permits."""
        return splats_from_columns(self.rows)

    def write(
        self,
        path: Path,
        keep: NDArray[np.bool_] | None = None,
        *,
        columns: Mapping[str, NDArray[Any]] | None = None,
        overwrite: bool = False,
    ) -> None:
        """Write the kept rows, in order, byte for byte as they were read.

        Parameters
        ----------
        path : Path
            The file to make; written whole or not at all.
        keep : (N,) bool, optional
            Which rows to write; all by default.
        columns : mapping of str to (N,), optional
            Properties to set; those the file lacks are appended as the type of their array
            (float32 -> ``float``), those it has keep their place and type.
        overwrite : bool
            Whether an existing file may be replaced.

        Raises
        ------
        RefineError
            If the file cannot be written, or exists and may not be replaced.
        """
        source = self._with_columns(columns) if columns else self
        count = len(source) if keep is None else int(np.count_nonzero(keep))
        with whole_file(Path(path), overwrite=overwrite) as stream:
            stream.write(_with_count(source.header, count))
            stream.write(source.before.data)
            if source.lines is not None:
                kept = range(len(source)) if keep is None else np.flatnonzero(keep)
                stream.writelines(source.lines[index] for index in kept)
            else:
                _write_rows(stream, source.rows, keep)
            stream.write(source.after.data)

    def _with_columns(self, columns: Mapping[str, NDArray[Any]]) -> SplatFile:
        names = self.rows.dtype.names or ()
        order: Any = self.rows.dtype[0].byteorder
        new = [name for name in columns if name not in names]
        fields = [(name, self.rows.dtype[name]) for name in names]
        fields += [(name, columns[name].dtype.newbyteorder(order)) for name in new]
        rows = np.empty(len(self), np.dtype(fields))
        for name in names:
            rows[name] = columns[name] if name in columns else self.rows[name]
        for name in new:
            rows[name] = columns[name]
        declared = b"".join(
            b"property %s %s\n" % (_PLY_TYPES[columns[name].dtype.str[1:]], name.encode())
            for name in new
        )
        lines = self.lines
        if lines is not None:
            lines = [" ".join(map(_text, row)).encode() + b"\n" for row in rows.tolist()]
        header = _insert_after_vertex(self.header, declared)
        return SplatFile(self.path, rows, header, self.before, self.after, lines)


_PLY_TYPES = {
    "i1": b"char",
    "u1": b"uchar",
    "i2": b"short",
    "u2": b"ushort",
    "i4": b"int",
    "u4": b"uint",
    "f4": b"float",
    "f8": b"double",
}


def splats_from_columns(columns: Mapping[str, NDArray[Any]] | NDArray[Any]) -> Splats:
    """Return splats from arrays named as the properties of a 3DGS PLY.

    Parameters
    ----------
    columns : structured array or mapping of str to (N,)
        With everything in `REQUIRED`, and ``f_rest_*`` if there are any: all coefficients of red,
        then green, then blue, as the reference implementation stores them.

    Returns
    -------
    Splats
        Views of `columns` where the fields of a group lie side by side in a structured array,
        copies otherwise.
    """
    names = columns.dtype.names or () if isinstance(columns, np.ndarray) else tuple(columns)
    count = sum(name.startswith("f_rest_") for name in names)
    rest = [f"f_rest_{index}" for index in range(count)]
    size = len(columns["x"])
    if rest:
        planes = _stack(columns, rest).reshape(size, 3, count // 3)
        sh_rest = planes.transpose(0, 2, 1)
    else:
        sh_rest = np.zeros((size, 0, 3), np.float32)
    return Splats(
        means=_stack(columns, ["x", "y", "z"]),
        log_scales=_stack(columns, ["scale_0", "scale_1", "scale_2"]),
        quaternions=_stack(columns, ["rot_0", "rot_1", "rot_2", "rot_3"]),
        opacity_logits=columns["opacity"],
        sh_dc=_stack(columns, ["f_dc_0", "f_dc_1", "f_dc_2"]),
        sh_rest=sh_rest,
    )


def columns_from_splats(splats: Splats) -> dict[str, NDArray[np.float32]]:
    """Return the float32 columns that a 3DGS PLY stores, in the reference order, no normals."""
    columns: dict[str, NDArray[Any]] = {}
    groups: list[tuple[Sequence[str], NDArray[Any]]] = [
        (["x", "y", "z"], splats.means),
        (["f_dc_0", "f_dc_1", "f_dc_2"], splats.sh_dc),
    ]
    rest = splats.sh_rest.transpose(0, 2, 1).reshape(len(splats), -1)
    groups += [
        ([f"f_rest_{index}" for index in range(rest.shape[1])], rest),
        (["opacity"], splats.opacity_logits[:, None]),
        (["scale_0", "scale_1", "scale_2"], splats.log_scales),
        (["rot_0", "rot_1", "rot_2", "rot_3"], splats.quaternions),
    ]
    for names, values in groups:
        for index, name in enumerate(names):
            columns[name] = np.ascontiguousarray(values[:, index], np.float32)
    return columns


def write_columns(
    path: Path,
    columns: Mapping[str, NDArray[Any]],
    *,
    comments: Sequence[str] = (),
    overwrite: bool = False,
) -> None:
    """Write a new binary little-endian 3DGS PLY from named columns, in their order.

    Parameters
    ----------
    path : Path
        The file to make; written whole or not at all.
    columns : mapping of str to (N,)
        One property each, of the type of its array.
    comments : sequence of str
        Header comments.
    overwrite : bool
        Whether an existing file may be replaced.

    Raises
    ------
    RefineError
        If the file cannot be written, or exists and may not be replaced.
    """
    dtype = np.dtype([(name, values.dtype.newbyteorder("<")) for name, values in columns.items()])
    rows = np.empty(len(columns["x"]), dtype)
    for name, values in columns.items():
        rows[name] = values
    element = plyfile.PlyElement.describe(rows[:0], "vertex")
    stream = io.BytesIO()
    plyfile.PlyData([element], text=False, byte_order="<", comments=list(comments)).write(stream)
    with whole_file(Path(path), overwrite=overwrite) as output:
        output.write(_with_count(stream.getvalue(), len(rows)))
        _write_rows(output, rows, None)


def read_ply(path: Path | str) -> SplatFile:
    """Open a 3DGS PLY file: binary of either byte order, or ASCII.

    Parameters
    ----------
    path : path-like
        ``~`` is the home folder.

    Returns
    -------
    SplatFile

    Raises
    ------
    RefineError
        If there is no such file, or it is no PLY, truncated, or not made of splats; the message
        names the file, the place, what was found and what was expected.
    """
    path = Path(path).expanduser()
    try:
        with path.open("rb") as stream:
            header = _read_header(path, stream)
            size = stream.seek(0, io.SEEK_END)
    except OSError as error:
        msg = f"{path}: cannot be read ({error.strerror or error})"
        raise RefineError(msg) from error
    elements, counts, order = _parse_header(path, header)
    vertex = _vertex_index(path, elements)
    _check_properties(path, elements[vertex])
    _check_sizes(path, elements, counts, size - len(header), text=order == "=")
    if order == "=":
        return _read_text(path, header, elements, counts, vertex)
    start = len(header) + _bytes_before(path, header, elements, counts, vertex, order)
    dtype = elements[vertex].dtype(order)
    end = start + counts[vertex] * dtype.itemsize
    if end > size:
        row = max(size - start, 0) // dtype.itemsize
        msg = (
            f"{path}: truncated: the file ends in vertex row {row} of {counts[vertex]} "
            f"({size} bytes, expected at least {end})"
        )
        raise RefineError(msg)
    body = np.memmap(path, np.uint8, "r")
    rows = body[start:end].view(dtype)
    return SplatFile(path, rows, header, body[len(header) : start], body[end:])


def _read_header(path: Path, stream: BinaryIO) -> bytes:
    head = stream.read(HEADER_LIMIT)
    if not head:
        msg = f"{path}: the file is empty, expected a PLY"
        raise RefineError(msg)
    if not re.match(rb"ply[\r\n]", head):
        msg = f"{path}: not a PLY: it starts with {head[:8]!r}, expected 'ply' and a line end"
        raise RefineError(msg)
    found = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", head)
    if not found:
        msg = f"{path}: header without end: no 'end_header' line in the first {len(head)} bytes"
        raise RefineError(msg)
    return head[: found.end()]


_COUNT = re.compile(rb"^(element[ \t]+\S+[ \t]+)(\S+)", re.MULTILINE)


def _lines(header: bytes) -> bytes:
    """Return the header with every kind of line end as a newline, for regular expressions."""
    return header.replace(b"\r\n", b"\n").replace(b"\r", b"\n")


def _parse_header(path: Path, header: bytes) -> tuple[list[plyfile.PlyElement], list[int], str]:
    """Let plyfile read the header as that of an empty file; return elements, counts, byte order."""
    counts: list[int] = []
    for match in _COUNT.finditer(_lines(header)):
        if not re.fullmatch(rb"[0-9]{1,18}", match[2]):
            msg = f"{path}: header: expected a count in {match[0]!r}"
            raise RefineError(msg)
        counts.append(int(match[2]))
    try:
        data = plyfile.PlyData.read(io.BytesIO(_COUNT.sub(rb"\g<1>0", _lines(header))))
    except (plyfile.PlyParseError, ValueError, UnicodeDecodeError) as error:
        msg = f"{path}: header: {error}"
        raise RefineError(msg) from error
    return list(data.elements), counts, "=" if data.text else data.byte_order


def _vertex_index(path: Path, elements: Sequence[plyfile.PlyElement]) -> int:
    for index, element in enumerate(elements):
        if element.name == "vertex":
            return index
    names = ", ".join(element.name for element in elements) or "none"
    msg = f"{path}: not a splat file: no element 'vertex' (found: {names})"
    raise RefineError(msg)


def _check_properties(path: Path, vertex: plyfile.PlyElement) -> None:
    kinds = {
        prop.name: None if isinstance(prop, plyfile.PlyListProperty) else prop.val_dtype
        for prop in vertex.properties
    }
    if "packed_position" in kinds:
        msg = f"{path}: a compressed splat PLY; expand it to the plain 3DGS layout first"
        raise RefineError(msg)
    missing = [name for name in REQUIRED if name not in kinds]
    if missing:
        what = "a mesh or point cloud, not splats" if "opacity" in missing else "incomplete splats"
        msg = (
            f"{path}: {what}: vertex lacks {', '.join(missing)} "
            f"(it has {', '.join(list(kinds)[:12])}{', ...' if len(kinds) > 12 else ''})"  # noqa: PLR2004
        )
        raise RefineError(msg)
    rest = [name for name in kinds if name.startswith("f_rest_")]
    if len(rest) not in REST_COUNTS or any(f"f_rest_{i}" not in kinds for i in range(len(rest))):
        msg = (
            f"{path}: found {len(rest)} f_rest properties, "
            "expected f_rest_0 onward, 0, 9, 24, 45 or 72 of them (degree 0 to 4)"
        )
        raise RefineError(msg)
    lists = [name for name, kind in kinds.items() if kind is None]
    if lists:
        msg = f"{path}: vertex property '{lists[0]}' is a list, expected one number a splat"
        raise RefineError(msg)
    for name in (*REQUIRED, *rest):
        if kinds[name] not in ("f4", "f8"):
            msg = f"{path}: property '{name}' is of type {kinds[name]}, expected float or double"
            raise RefineError(msg)


def _check_sizes(
    path: Path,
    elements: Sequence[plyfile.PlyElement],
    counts: Sequence[int],
    available: int,
    *,
    text: bool,
) -> None:
    """Refuse counts that the file cannot back, before anything is allocated by them."""
    least = 0
    for element, count in zip(elements, counts, strict=True):
        if text:
            # A number and a separator each; a list at least its length.
            row = max(2 * len(element.properties), 1)
        else:
            row = sum(
                np.dtype(
                    p.len_dtype if isinstance(p, plyfile.PlyListProperty) else p.val_dtype
                ).itemsize
                for p in element.properties
            )
            if not row and count:
                msg = f"{path}: element '{element.name}' has {count} rows and no property"
                raise RefineError(msg)
        least += row * count
        if least > available + text:  # the last line of a text may lack its line end
            msg = (
                f"{path}: truncated: the header announces {count} of '{element.name}', at least "
                f"{least} bytes so far, but only {available} bytes follow it"
            )
            raise RefineError(msg)


def _bytes_before(
    path: Path,
    header: bytes,
    elements: Sequence[plyfile.PlyElement],
    counts: Sequence[int],
    vertex: int,
    order: str,
) -> int:
    """Return how many bytes of body lie ahead of the vertex rows."""
    if not any(
        isinstance(prop, plyfile.PlyListProperty)
        for element in elements[:vertex]
        for prop in element.properties
    ):
        return sum(
            element.dtype(order).itemsize * count
            for element, count in zip(elements[:vertex], counts, strict=False)
        )
    data = _read_whole(path, header)
    total = 0
    for element in data.elements[:vertex]:
        for prop in element.properties:
            if isinstance(prop, plyfile.PlyListProperty):
                length, value = (np.dtype(kind).itemsize for kind in prop.list_dtype())
                total += sum(length + value * len(row) for row in element.data[prop.name])
            else:
                total += np.dtype(prop.val_dtype).itemsize * len(element.data)
    return total


def _read_whole(path: Path, header: bytes) -> plyfile.PlyData:
    """Let plyfile read everything; for text and for lists ahead of the splats."""
    try:
        body = path.read_bytes()[len(header) :]
        return plyfile.PlyData.read(io.BytesIO(_lines(header) + body))
    except (plyfile.PlyParseError, ValueError, UnicodeDecodeError, OverflowError) as error:
        msg = f"{path}: {error}"
        raise RefineError(msg) from error


def _read_text(
    path: Path,
    header: bytes,
    elements: Sequence[plyfile.PlyElement],
    counts: Sequence[int],
    vertex: int,
) -> SplatFile:
    lines = path.read_bytes()[len(header) :].splitlines(keepends=True)
    start = sum(counts[:vertex])
    end = start + counts[vertex]
    if len(lines) < end:
        msg = (
            f"{path}: truncated: the file ends in row {max(len(lines) - start, 0)} of "
            f"{counts[vertex]} of '{elements[vertex].name}'"
        )
        raise RefineError(msg)
    rows = _read_whole(path, header)[elements[vertex].name].data
    return SplatFile(
        path,
        rows,
        header,
        np.frombuffer(b"".join(lines[:start]), np.uint8),
        np.frombuffer(b"".join(lines[end:]), np.uint8),
        lines[start:end],
    )


def _with_count(header: bytes, count: int) -> bytes:
    return re.sub(rb"([\r\n]element[ \t]+vertex[ \t]+)[0-9]+", rb"\g<1>%d" % count, header, count=1)


def _insert_after_vertex(header: bytes, declared: bytes) -> bytes:
    """Return the header with property lines added behind the vertex element's last one."""
    end = re.search(rb"\r\n|\n|\r", header)
    line_end = end[0] if end else b"\n"
    start = re.search(rb"[\r\n]element[ \t]+vertex[ \t][^\r\n]*", header)
    at = start.end() if start else 0
    for match in re.finditer(rb"[\r\n](element|property|end_header)\b[^\r\n]*", header[at:]):
        if match[1] != b"property":
            break
        last = at + match.end()
    addition = b"".join(line_end + line for line in declared.splitlines())
    return header[:last] + addition + header[last:]


def _write_rows(stream: BinaryIO, rows: NDArray[Any], keep: NDArray[np.bool_] | None) -> None:
    plain = rows.view(np.dtype((np.void, rows.dtype.itemsize)))
    for start in range(0, len(plain), _WRITE_ROWS):
        chunk = plain[start : start + _WRITE_ROWS]
        if keep is not None:
            chunk = chunk[keep[start : start + _WRITE_ROWS]]
        stream.write(chunk.data if chunk.flags.c_contiguous else np.ascontiguousarray(chunk).data)


def _text(value: float) -> str:
    return repr(value) if isinstance(value, int) else f"{value:.9g}"


def _stack(columns: Any, names: Sequence[str]) -> NDArray[Any]:  # noqa: ANN401
    """Return the named columns as (N, len(names)): a view if they lie side by side in a row."""
    first = columns[names[0]]
    if isinstance(columns, np.ndarray) and columns.dtype.fields and columns.ndim == 1:
        kinds, offsets = zip(*(columns.dtype.fields[name][:2] for name in names), strict=True)
        step = kinds[0].itemsize
        beside = tuple(range(offsets[0], offsets[0] + step * len(names), step))
        if len(set(kinds)) == 1 and offsets == beside and len(columns):
            return np.lib.stride_tricks.as_strided(
                first, (len(first), len(names)), (first.strides[0], step), writeable=False
            )
    kind = np.result_type(*(columns[name].dtype for name in names), np.float32)
    stacked = np.empty((len(first), len(names)), kind)
    for index, name in enumerate(names):
        stacked[:, index] = columns[name]
    return stacked
