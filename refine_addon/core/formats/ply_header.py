"""The header of a PLY file: read with its grammar, changed without touching what stays.

plyfile knows the grammar. What it would refuse or change is kept from it: comments in any encoding,
line ends, and counts, by which it would allocate.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, BinaryIO

import plyfile

from ..errors import RefineError
from ..foreign_files import refuse_foreign_splats

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

HEADER_LIMIT = 1 << 20
"""A header longer than this many bytes is not one of ours."""

TEXT = "="
"""Byte order of the numbers of an ASCII file once they are read: the machine's."""

_END = {
    b"\n": re.compile(rb"\n[ \t]*end_header[ \t]*\r?\n"),
    b"\r\n": re.compile(rb"\r\n[ \t]*end_header[ \t]*\r\n"),
    b"\r": re.compile(rb"\r[ \t]*end_header[ \t]*\r"),
}
"""How a header ends, by the line end of its first line: bytes of the body may look like others."""


@dataclass(frozen=True, eq=False)
class Header:
    """A header and what it says.

    Attributes
    ----------
    path : Path
        The file, for messages.
    raw : bytes
        The header as it stands in the file, ``end_header`` and its line end included.
    elements : tuple of plyfile.PlyElement
        Names and properties; plyfile is told that there is no row.
    counts : tuple of int
        How many rows of each element are announced, however many there are.
    order : {"<", ">", "="}
        Byte order of the body, `TEXT` for an ASCII file.
    """

    path: Path
    raw: bytes
    elements: tuple[Any, ...]
    counts: tuple[int, ...]
    order: str


def read_header(path: Path, stream: BinaryIO) -> Header:
    """Read the header of an open file.

    Raises
    ------
    RefineError
        If there is none, or it is wrong; with the line.
    """
    head = stream.read(HEADER_LIMIT)
    if not head:
        msg = f"{path}: the file is empty, expected a PLY"
        raise RefineError(msg)
    if not re.match(rb"ply[\r\n]", head):
        refuse_foreign_splats(path, head)
        msg = f"{path}: not a PLY: it starts with {head[:8]!r}, expected 'ply' and a line end"
        raise RefineError(msg)
    found = _END[_line_end(head)].search(head)
    if not found:
        msg = f"{path}: header without end: no 'end_header' line in the first {len(head)} bytes"
        raise RefineError(msg)
    raw = head[: found.end()]
    plain, counts = _plain(path, raw)
    try:
        data = plyfile.PlyData.read(io.BytesIO(plain))
    except (plyfile.PlyParseError, ValueError) as error:
        msg = f"{path}: header: {str(error)[:200]}"
        raise RefineError(msg) from error
    order = TEXT if data.text else data.byte_order
    return Header(path, raw, tuple(data.elements), tuple(counts), order)


def format_of(raw: bytes) -> str:
    """Return what the format line of a header says, such as ``binary_little_endian 1.0``."""
    for line in _lines(raw):
        words = line.split()
        if words[:1] == [b"format"]:
            return b" ".join(words[1:]).decode("ascii", "replace")
    return ""


def with_count(raw: bytes, count: int) -> bytes:
    """Return the header with another number of vertices; the same bytes if it says so already."""
    lines = _lines(raw)
    index = _vertex_line(lines)
    found = re.match(rb"(\s*element\s+vertex\s+)(\d+)", lines[index])
    if not found or int(found[2]) == count:
        return raw
    lines[index] = b"%s%d%s" % (found[1], count, lines[index][found.end() :])
    return _line_end(raw).join(lines)


def with_properties(raw: bytes, declared: Sequence[bytes]) -> bytes:
    """Return the header with lines added behind the vertex element's last property."""
    lines = _lines(raw)
    last = index = _vertex_line(lines)
    for index in range(last + 1, len(lines)):
        keyword = lines[index].split()[:1]
        if keyword == [b"property"]:
            last = index
        elif keyword in ([b"element"], [b"end_header"]):
            break
    lines[last + 1 : last + 1] = declared
    return _line_end(raw).join(lines)


def shown(word: bytes | str) -> str:
    """Return a word of the file for a message: in quotes, and not endless."""
    text = word if isinstance(word, str) else word.decode("ascii", "replace")
    return repr(text[:40])


def _line_end(raw: bytes) -> bytes:
    return next(end for end in (b"\r\n", b"\n", b"\r") if raw.startswith(end, 3))


def _lines(raw: bytes) -> list[bytes]:
    return raw.split(_line_end(raw))


def _vertex_line(lines: Sequence[bytes]) -> int:
    return next(
        index for index, line in enumerate(lines) if line.split()[:2] == [b"element", b"vertex"]
    )


def _plain(path: Path, raw: bytes) -> tuple[bytes, list[int]]:
    """Return the header in the form that plyfile reads: same lines, no comment and no row."""
    lines: list[bytes] = []
    counts: list[int] = []
    names: set[bytes] = set()
    elements: set[bytes] = set()
    for number, line in enumerate(_lines(raw), 1):
        words = line.split()
        keyword = words[0] if words else b""
        if keyword in (b"comment", b"obj_info"):
            words = []
        elif not re.fullmatch(rb"[\t -~]*\r?", line):
            msg = f"{path}: header line {number}: expected ASCII text, got {line[:80]!r}"
            raise RefineError(msg)
        elif keyword == b"element" and len(words) == 3:  # noqa: PLR2004 - and a name and a count
            counts.append(_count(path, number, words[2]))
            _refuse_double(path, number, words[1], elements)
            names = set()
            words[2] = b"0"
        elif keyword == b"property":
            _refuse_double(path, number, words[-1], names)
        lines.append(b" ".join(words) or b" ")  # plyfile takes an empty line for the end
    return b"\n".join([*lines[:-1], b""]), counts


def _count(path: Path, number: int, word: bytes) -> int:
    if not re.fullmatch(rb"[0-9]{1,30}", word):
        msg = f"{path}: header line {number}: expected a number of rows, got {shown(word)}"
        raise RefineError(msg)
    return int(word)


def _refuse_double(path: Path, number: int, name: bytes, seen: set[bytes]) -> None:
    if name in seen:
        msg = f"{path}: header line {number}: {shown(name)} is declared twice, expected once"
        raise RefineError(msg)
    seen.add(name)
