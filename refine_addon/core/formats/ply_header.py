"""The header of a PLY file: parsed, and changed without touching anything else in it.

plyfile parses it. It gets the header without comments (which may be in any encoding), with plain
line ends, and with row counts of 0, since it would allocate memory for the rows.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import plyfile

from ..errors import RefineError
from ..foreign_files import refuse_foreign_splats
from ..rendering import Model
from ..urls import Url

HEADER_LIMIT = 1 << 20
"""Longest header that is read, bytes."""

TEXT = "="
"""Byte order for ASCII files: their numbers are stored in that of the machine."""

_MODES: dict[Model, bytes] = {"default": b"default", "antialiased": b"mip", "2dgs": b"2dgs"}
"""Model -> Brush's word for it, in a comment ``SplatRenderMode: WORD``. Postshot's is
``antialiased 0`` or ``1``."""

_MODEL_COMMENT = re.compile(
    rb"comment[ \t]+(?:splatrendermode:[ \t]*(default|mip|2dgs)|antialiased[ \t]+([01]))[ \t\r]*",
    re.IGNORECASE,
)

_END = {
    b"\n": re.compile(rb"\n[ \t]*end_header[ \t]*\r?\n"),
    b"\r\n": re.compile(rb"\r\n[ \t]*end_header[ \t]*\r\n"),
    b"\r": re.compile(rb"\r[ \t]*end_header[ \t]*\r"),
}
"""End of a header, for each kind of line end. Only that of the first line is looked for, since
bytes of the body may look like another."""


@dataclass(frozen=True, eq=False)
class Header:
    """A parsed header.

    Attributes
    ----------
    path : Path or Url
        The file, for messages.
    raw : bytes
        The bytes of the header, with ``end_header`` and its line end.
    elements : tuple of plyfile.PlyElement
        Names and properties, without rows.
    counts : tuple of int
        How many rows the header announces for each element.
    order : {"<", ">", "="}
        Byte order of the body; `TEXT` for ASCII files.
    """

    path: Path | Url
    raw: bytes
    elements: tuple[Any, ...]
    counts: tuple[int, ...]
    order: str


def read_header(path: Path | Url, stream: BinaryIO) -> Header:
    """Read the header of an open file.

    Raises
    ------
    RefineError
        If the file has no header, or the header is wrong; with the line.
    """
    head = stream.read(HEADER_LIMIT)
    if not head:
        raise RefineError(f"{path}: the file is empty, expected a PLY")
    if not re.match(rb"ply[\r\n]", head):
        refuse_foreign_splats(path, head)
        raise RefineError(
            f"{path}: not a PLY: it starts with {head[:8]!r}, expected 'ply' and a line end"
        )
    raw = raw_header(head)
    if raw is None:
        raise RefineError(
            f"{path}: header without end: no 'end_header' line in the first {len(head)} bytes"
        )
    plain, counts = _plain(path, raw)
    try:
        data = plyfile.PlyData.read(io.BytesIO(plain))
    except (plyfile.PlyParseError, ValueError) as error:
        raise RefineError(f"{path}: header: {str(error)[:200]}") from error
    order = TEXT if data.text else data.byte_order
    return Header(path, raw, tuple(data.elements), tuple(counts), order)


def raw_header(head: bytes) -> bytes | None:
    """Return the header at the beginning of a file; None if this is no PLY, or it has no end."""
    if not re.match(rb"ply[\r\n]", head):
        return None
    end = _END[_line_end(head)].search(head)
    return head[: end.end()] if end else None


def new_header(properties: Iterable[tuple[str, str]], count: int) -> bytes:
    """Return the header of a binary PLY of one element, ``vertex``.

    Parameters
    ----------
    properties : iterable of (str, str)
        Names and types (in PLY's words), in their order.
    count : int
        How many vertices.
    """
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property {kind} {name}" for name, kind in properties]
    return "\n".join([*lines, "end_header", ""]).encode()


def format_of(raw: bytes) -> str:
    """Return the format that a header announces, such as ``binary_little_endian 1.0``."""
    for line in _lines(raw):
        words = line.split()
        if words[:1] == [b"format"]:
            return b" ".join(words[1:]).decode("ascii", "replace")
    return ""


def with_count(raw: bytes, count: int) -> bytes:
    """Return the header with this number of vertices; nothing else in it changes."""
    lines = _lines(raw)
    index = _vertex_line(lines)
    announced = re.match(rb"(\s*element\s+vertex\s+)(\d+)", lines[index])
    if not announced or int(announced[2]) == count:
        return raw
    lines[index] = b"%s%d%s" % (announced[1], count, lines[index][announced.end() :])
    return _line_end(raw).join(lines)


def model_of(raw: bytes) -> Model | None:
    """Return how the comments of a header say that its splats are drawn; None if they do not.

    Of several comments the last counts, as in Brush and splat-transform.
    """
    model: Model | None = None
    for line in _lines(raw):
        found = _MODEL_COMMENT.fullmatch(line)
        if found and found[1]:
            word = found[1].lower()
            model = next(name for name, mode in _MODES.items() if mode == word)
        elif found:
            model = "antialiased" if found[2] == b"1" else "default"
    return model


def with_model(raw: bytes, model: Model) -> bytes:
    """Return the header with a comment on how its splats are drawn, in place of what it says.

    A header that says so already stays as it is, and so does one that says nothing where `model` is
    "default".
    """
    if (model_of(raw) or "default") == model:
        return raw
    lines = [line for line in _lines(raw) if not _MODEL_COMMENT.fullmatch(line)]
    if model != "default":
        lines.insert(2, b"comment SplatRenderMode: " + _MODES[model])
    return _line_end(raw).join(lines)


def with_properties(raw: bytes, declared: Sequence[bytes]) -> bytes:
    """Return the header with lines added after the last property of the vertex element."""
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
    """Return a word of the file for a message: in quotes, at most 40 characters."""
    text = word if isinstance(word, str) else word.decode("ascii", "replace")
    return repr(text[:40])


def _line_end(raw: bytes) -> bytes:
    """Return the line end of a header's first line, "ply"."""
    return next(end for end in (b"\r\n", b"\n", b"\r") if raw.startswith(end, 3))


def _lines(raw: bytes) -> list[bytes]:
    return raw.split(_line_end(raw))


def _vertex_line(lines: Sequence[bytes]) -> int:
    return next(
        index for index, line in enumerate(lines) if line.split()[:2] == [b"element", b"vertex"]
    )


def _plain(path: Path | Url, raw: bytes) -> tuple[bytes, list[int]]:
    """Return the header as plyfile gets it, see the top of this file, and the counts of rows."""
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
            raise RefineError(
                f"{path}: header line {number}: expected ASCII text, got {line[:80]!r}"
            )
        elif keyword == b"element" and len(words) == 3:
            counts.append(_count(path, number, words[2]))
            _refuse_double(path, number, words[1], elements)
            names = set()
            words[2] = b"0"
        elif keyword == b"property":
            _refuse_double(path, number, words[-1], names)
        lines.append(b" ".join(words) or b" ")  # an empty line would end the header for plyfile
    return b"\n".join([*lines[:-1], b""]), counts


def _count(path: Path | Url, number: int, word: bytes) -> int:
    """Return the number of rows in a word of header line `number`."""
    if not re.fullmatch(rb"[0-9]{1,30}", word):
        raise RefineError(
            f"{path}: header line {number}: expected a number of rows, got {shown(word)}"
        )
    return int(word)


def _refuse_double(path: Path | Url, number: int, name: bytes, known: set[bytes]) -> None:
    """Refuse a name that is in `known`; add it otherwise."""
    if name in known:
        raise RefineError(
            f"{path}: header line {number}: {shown(name)} is declared twice, expected once"
        )
    known.add(name)
