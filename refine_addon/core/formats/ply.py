"""Plain 3DGS PLY: read through a memory map, written with the kept rows unchanged.

plyfile parses a copy of the header: without comments, which have any encoding, with plain line
ends, and with row counts of 0, since it would allocate memory for the rows. ASCII is written as
binary.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, NoReturn

import numpy as np
import plyfile
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from ..errors import RefineError
from ..execute import chunks, run
from ..mapped import file_bytes
from ..place import Place, foreign_kind, refuse_pointer
from ..splats import MODELS, Model, Splats
from ..whole_file import Url, expanded, refuse_mapped, whole_file
from . import ply_columns
from .ply_columns import REQUIRED, REST_COUNTS, THIRD_SCALE, Changed, Changes, Keep

HEADER_LIMIT = 1 << 20  # longest header that is read, bytes
TEXT = "="  # stands for ASCII among byte orders: once parsed, numbers have the machine's
FORMATS = {"<": "binary_little_endian 1.0", ">": "binary_big_endian 1.0", TEXT: "ascii 1.0"}
"""Byte order -> format, as a header has it; PLY has no other version."""

PLY_TYPES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort"}
PLY_TYPES |= {"i4": "int", "u4": "uint", "f4": "float", "f8": "double"}  # NumPy's names -> PLY's

INDEXING = ("edge", "face", "tristrips")  # elements that by convention hold indices of vertices
_NAMES_SHOWN = 12

_MODES: dict[Model, bytes] = {"default": b"default", "antialiased": b"mip", "2dgs": b"2dgs"}
"""Model -> WORD in Brush's ``SplatRenderMode: WORD``; Postshot has ``antialiased 0`` or ``1``."""

_MODEL_COMMENT = re.compile(
    rb"comment[ \t]+(?:splatrendermode:[ \t]*(default|mip|2dgs)|antialiased[ \t]+([01]))[ \t\r]*",
    re.IGNORECASE,
)

_ENDS = {b"\n": rb"\n[ \t]*end_header[ \t]*\r?\n"}
_ENDS |= {end: end + rb"[ \t]*end_header[ \t]*" + end for end in (b"\r\n", b"\r")}
"""Line end -> end of a header. The first line tells the kind, since the body may hold others."""

_ROWS = 1 << 12
"""Rows copied at a time: 1 MB at degree 3, still in the L2 cache when they are written."""

_CHANGED_ROWS = 1 << 14
"""Rows copied at a time where columns are set, which takes a few calls for each column."""


@dataclass(frozen=True, eq=False)
class SplatFile:
    """An opened 3DGS PLY file of N splats, or one in memory for a file of another format."""

    path: Path
    rows: NDArray[Any]  # (N,) structured, one field a property; read-only and mapped if binary
    header: bytes  # with ``end_header`` and its line end
    # Bytes of the body before and after the rows.
    before: NDArray[np.uint8] = field(default_factory=lambda: np.empty(0, np.uint8))
    after: NDArray[np.uint8] = field(default_factory=lambda: np.empty(0, np.uint8))
    indexing: tuple[str, ...] = ()  # other elements whose rows hold indices of splats
    format: str = ""  # of the file that was read, such as ``binary_little_endian 1.0``
    stored_bytes: int = 0  # size of that file
    remarks: tuple[str, ...] = ()  # sentences for the user on how it was read
    axes: str = ""  # of an SPZ: `affine.AXES` or `UNKNOWN_AXES`; other files are written with them

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def row_bytes(self) -> int:
        """Bytes of one splat in the file."""
        return int(self.rows.dtype.itemsize)

    @property
    def fixed_bytes(self) -> int:
        """Bytes of everything but the splats."""
        return len(self.header) + len(self.before) + len(self.after)

    @property
    def model(self) -> Model:
        """How its splats are drawn, by its header; discs if they have no third scale."""
        return model_drawn(self.path, self.header, self.rows.dtype, None)

    def drawn_as(self, model: Model | None) -> SplatFile:
        """The file with another model in its header; None keeps that of the file.

        `RefineError` if the model is unknown, or not "2dgs" for splats without a third scale.
        """
        drawn = model_drawn(self.path, self.header, self.rows.dtype, model)
        return self if drawn == self.model else replace(self, header=with_model(self.header, drawn))

    def without_third_scale(self) -> SplatFile:
        """Discs without a third scale; other splats unchanged."""
        names = self.rows.dtype.names or ()
        if self.model != "2dgs" or THIRD_SCALE not in names:
            return self
        rows = repack_fields(self.rows[[name for name in names if name != THIRD_SCALE]])
        header = with_model(new_header(rows.dtype, len(rows)), "2dgs")
        return replace(self, rows=rows, header=header)

    def splats(self) -> Splats:
        """The rows as splats; the arrays are views of the file if its layout permits."""
        return ply_columns.splats_from_columns(self.rows, self.model)

    def size(self, keep: Keep = None, columns: Changes = None) -> int:
        """Bytes that `write` would write."""
        header, row, count = self._layout(keep, columns or {})
        return len(header) + len(self.before) + count * row.itemsize + len(self.after)

    def write(
        self,
        path: Path | str,
        keep: Keep = None,
        *,
        columns: Changes = None,
        overwrite: bool = False,
        threads: int | None = 1,
    ) -> None:
        """Write the kept rows as binary, in order; their bytes stay as they were read.

        Parameters
        ----------
        path : path-like, written completely or not at all; ``~`` is the home folder
        keep : (N,) bool, optional; all by default
        columns : mapping of str to (N,), optional
            Properties to set: existing ones in their place and type, new ones at the end.
        overwrite : bool, whether a file may be replaced, even the one that was read

        Raises
        ------
        RefineError : if the file exists or cannot be written, or a shape or type is wrong
        """
        path, columns = expanded(path), columns or {}
        if keep is not None and (keep.shape != self.rows.shape or keep.dtype != np.bool_):
            wanted = f"expected one bool for each of {len(self)} splats"
            raise RefineError(f"{self.path}: keep is {keep.dtype} {keep.shape}, {wanted}")
        header, *_ = self._layout(keep, columns)
        if not self.rows.flags.writeable:
            refuse_mapped(path, self.path)
        with whole_file(path, overwrite=overwrite) as stream:
            stream.write(header)
            stream.write(self.before.data)
            write_rows(stream, self.rows, keep, columns, threads=threads)
            stream.write(self.after.data)

    def _layout(self, keep, columns):
        """Header, row dtype and number of splats of the output; refuse columns that do not fit."""
        count = len(self) if keep is None else int(np.count_nonzero(keep))
        header, names = with_count(self.header, count), self.rows.dtype.names or ()
        if isinstance(columns, Changed):
            return header, self.rows.dtype, count  # in stored types, and not computed for this
        declared, place = [], Place(self.path)
        for name, values in columns.items():
            stored = self.rows.dtype[name] if name in names else None
            kind, what = PLY_TYPES.get(values.dtype.str[1:]), f"column '{name}'"
            if values.shape != self.rows.shape:
                place.fail(f"{what} has shape {values.shape}, expected {self.rows.shape}")
            if stored is None and not (kind and re.fullmatch(r"[!-~]+", name)):
                wanted = f"expected ASCII without spaces and one of {', '.join(PLY_TYPES)}"
                place.fail(f"{what} of type {values.dtype} cannot be a property, {wanted}")
            if stored is None:
                declared.append(f"property {kind} {name}".encode())
            elif not np.can_cast(values.dtype, stored, "same_kind"):
                what = f"property '{name}' is there already, of type {stored}"
                place.fail(f"{what}; expected one that holds {values.dtype}")
        lines, last, within = _lines(header), 0, False
        for index, words in enumerate(map(bytes.split, lines)):
            within = words[1:2] == [b"vertex"] if words[:1] == [b"element"] else within
            last = index if within and words[:1] in ([b"element"], [b"property"]) else last
        lines[last + 1 : last + 1] = declared
        return _line_end(header).join(lines), _grown(self.rows.dtype, columns), count


# Reading.


def read_ply(path: Path | str) -> SplatFile:
    """Open a 3DGS PLY file: binary of either byte order, or ASCII; it may have 0 splats.

    Raises
    ------
    RefineError : if the file is missing, damaged or no file of splats; with the place in the file
    """
    path = expanded(path)
    return read_plain(path, file_bytes(path))


def read_plain(path: Path, data: NDArray[np.uint8]) -> SplatFile:
    """Plain PLY of the bytes that `file_bytes` returned, (n,); see `read_ply`."""
    header, vertex = splat_header(path, data[:HEADER_LIMIT].tobytes())
    body = data[len(header.raw) :]
    at = row_ranges(header, len(body))[vertex]
    filled = [e.name for e, count in zip(header.elements, header.counts, strict=True) if count]
    if header.order == TEXT:
        return _text_file(header, vertex, filled, body.tobytes())
    rows = body[at].view(header.elements[vertex].dtype(header.order))
    indexing = tuple(name for name in filled if name in INDEXING)
    beside = body[: at.start], body[at.stop :]
    return SplatFile(path, rows, header.raw, *beside, indexing, FORMATS[header.order], len(data))


class Header(NamedTuple):
    """A parsed header."""

    path: Path | Url  # the file, for messages
    raw: bytes  # with ``end_header`` and its line end
    elements: tuple[Any, ...]  # of plyfile: names and properties, without rows
    counts: tuple[int, ...]  # rows that the header announces for each element
    order: str  # byte order of the body, "<", ">" or `TEXT`


def splat_header(path: Path | Url, head: bytes) -> tuple[Header, int]:
    """Header from a file's first bytes, and the index of ``vertex``; `RefineError` without it."""
    header = read_header(path, head)
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        wanted = f"expected an element 'vertex', got {_listed(names) or 'none'}"
        raise RefineError(f"{path}: not a splat file: {wanted}")
    vertex = names.index("vertex")
    properties = header.elements[vertex].properties
    lists = [prop.name for prop in properties if isinstance(prop, plyfile.PlyListProperty)]
    kinds = {prop.name: prop.val_dtype for prop in properties}
    missing = [name for name in REQUIRED if name not in kinds]
    rest = [name for name in kinds if name.startswith("f_rest_")]
    if "packed_position" in kinds:
        _refuse(path, "a compressed splat PLY: 'refine convert IN OUT.ply' makes a plain one of it")
    if missing and missing != [THIRD_SCALE]:
        mesh = any(name in INDEXING for name in names)
        guess = f"a {'mesh' if mesh else 'point cloud'}, not splats"
        guess = "incomplete splats" if "opacity" in kinds else guess
        has = (_listed([*kinds]) or "no property") + ", ..." * (len(kinds) > _NAMES_SHOWN)
        _refuse(path, f"{guess}: vertex lacks {', '.join(missing)} (it has {has})")
    if len(rest) not in REST_COUNTS or any(f"f_rest_{i}" not in kinds for i in range(len(rest))):
        wanted = "f_rest_0 onward, 0, 9, 24, 45 or 72 of them (degree 0 to 4)"
        _refuse(path, f"found {len(rest)} f_rest properties, expected {wanted}")
    for name, kind in kinds.items():
        if name in lists:
            _refuse(path, f"property {shown(name)} is a list, expected one number a splat")
        if kind not in ("f4", "f8") and (name in REQUIRED or name in rest):
            _refuse(path, f"property {shown(name)} is of type {kind}, expected float or double")
    for element in header.elements[:vertex]:
        if has_lists(element):
            what = f"element {shown(element.name)} has a list and stands before the splats"
            _refuse(path, f"{what}, expected it behind them")
    return header, vertex


def _refuse(path: Path | Url, problem: str) -> NoReturn:
    raise RefineError(f"{path}: {problem}")


def read_header(path: Path | Url, head: bytes) -> Header:
    """Header from a file's first `HEADER_LIMIT` bytes; `RefineError`, with its line, if wrong."""
    raw = raw_header(head)
    if not head:
        _refuse(path, "the file is empty, expected a PLY")
    if not re.match(rb"ply[\r\n]", head):
        refuse_pointer(path, head)
        got = f"not a PLY: it starts with {head[:8]!r}, expected 'ply' and a line end"
        _refuse(path, foreign_kind(path, head) or got)
    if raw is None:
        _refuse(path, f"header without end: no 'end_header' line in the first {len(head)} bytes")
    plain, counts = _plain(path, raw)
    try:
        data = plyfile.PlyData.read(io.BytesIO(plain))
    except (plyfile.PlyParseError, ValueError) as error:
        raise RefineError(f"{path}: header: {str(error)[:200]}") from error
    order = TEXT if data.text else data.byte_order
    return Header(path, raw, tuple(data.elements), tuple(counts), order)


def raw_header(head: bytes) -> bytes | None:
    """Bytes of the header; None if this is no PLY, or the header has no end."""
    if not re.match(rb"ply[\r\n]", head):
        return None
    end = re.search(_ENDS[_line_end(head)], head)
    return head[: end.end()] if end else None


def _plain(path: Path | Url, raw: bytes) -> tuple[bytes, list[int]]:
    """Header for plyfile (see the top of this file), and the counts of rows."""
    lines: list[bytes] = []
    counts: list[int] = []
    names, elements = set[bytes](), set[bytes]()
    for number, line in enumerate(_lines(raw), 1):
        where, words = f"{path}: header line {number}", line.split()
        keyword = words[0] if words else b""
        if keyword in (b"comment", b"obj_info"):
            words = []
        elif not re.fullmatch(rb"[\t -~]*\r?", line):
            raise RefineError(f"{where}: expected ASCII text, got {line[:80]!r}")
        elif keyword == b"property" or (keyword == b"element" and len(words) == 3):
            if words[1:2] != [b"list"]:
                words[2:] = [b"_".join(words[2:])]  # Blender writes names with spaces
            taken, name = (names, words[-1]) if keyword == b"property" else (elements, words[1])
            if taken is elements:
                if not re.fullmatch(rb"[0-9]{1,30}", words[2]):
                    raise RefineError(f"{where}: expected a number of rows, got {shown(words[2])}")
                counts.append(int(words[2]))
                names, words[2] = set(), b"0"
            if name in taken:
                raise RefineError(f"{where}: {shown(name)} is declared twice, expected once")
            taken.add(name)
        lines.append(b" ".join(words) or b" ")  # an empty line would end the header for plyfile
    return b"\n".join([*lines[:-1], b""]), counts


def has_lists(element: Any) -> bool:
    """Whether an element of plyfile has lists, so that its rows may differ in length."""
    return any(isinstance(prop, plyfile.PlyListProperty) for prop in element.properties)


def row_ranges(header: Header, available: int) -> list[slice]:
    """Byte range of each element's rows, exact up to lists; `RefineError` beyond `available`."""
    ranges, least, text = [], 0, header.order == TEXT
    for element, count in zip(header.elements, header.counts, strict=True):
        kinds = (getattr(prop, "len_dtype", prop.val_dtype) for prop in element.properties)
        # Of text: one digit and one separator for each number; lists have a length.
        row = sum(2 if text else np.dtype(kind).itemsize for kind in kinds)
        ranges.append(slice(least, least + row * count))
        least, name = least + row * count, shown(element.name)
        if least > available + text:  # plus 1 for text, whose last line may lack its line end
            what = f"truncated: the header announces {count} rows of {name}, at least {least} bytes"
            raise RefineError(f"{header.path}: {what} so far, but only {available} bytes follow it")
    return ranges


def _text_file(header: Header, vertex: int, filled: list[str], body: bytes) -> SplatFile:
    """Read an ASCII file as the binary one that holds its splats."""
    path, lines, start = header.path, body.splitlines(), 0
    for index, (element, count) in enumerate(zip(header.elements, header.counts, strict=True)):
        if len(lines) < start + count:
            place = f"row {len(lines) - start} of {count} of {shown(element.name)}"
            raise RefineError(f"{path}: truncated: the file ends in {place}")
        if index == vertex:
            rows = _numbers(path, element.dtype("<"), lines[start : start + count])
        start += count
    left = _listed([name for name in filled if name != "vertex"])
    remark = f"{path.name} is text; a PLY that is written of it is binary"
    remark += f", without the elements beside its splats ({left})" if left else ""
    return SplatFile(
        Path(path), rows, vertex_header(header.raw), format=FORMATS[header.order],
        stored_bytes=len(header.raw) + len(body), remarks=(remark,),
    )  # fmt: skip


def _numbers(path, dtype, lines):
    """Numbers in lines of text, (n,) of `dtype`; `RefineError` names the first wrong line."""
    if (rows := _parsed(lines, dtype)) is not None:
        return rows
    wrong = next(part for part in chunks(len(lines), _ROWS) if _parsed(lines[part], dtype) is None)
    numbers = range(wrong.start, wrong.stop)
    first = next(number for number in numbers if _parsed([lines[number]], dtype) is None)
    words, names = lines[first].split(), dtype.names or ()
    problem = f"expected {len(names)} numbers, got {len(words)}"
    if len(words) == len(names):
        each = zip(names, words, strict=True)
        name, word = next(pair for pair in each if _parsed([pair[1]], dtype[pair[0]]) is None)
        problem = f"property {shown(name)}: expected a number of type {dtype[name]}, got "
        problem += shown(word)
    raise RefineError(f"{path}: vertex row {first}: {problem}")


_NO_SPACES = bytes.maketrans(b"\x1c\x1d\x1e\x1f", b"????")
"""Replaces four control characters: str splits words at them, bytes and the header do not."""


def _parsed(lines: Sequence[bytes], dtype: np.dtype[Any]) -> NDArray[Any] | None:
    """Numbers in lines of text, or None if a line is wrong, or empty, which NumPy would skip."""
    if not lines:
        return np.empty(0, dtype)
    text = (line.translate(_NO_SPACES).decode("ascii") for line in lines)
    with suppress(ValueError, DeprecationWarning), warnings.catch_warnings():
        # NumPy only deprecates 1.5 for an integer property.
        warnings.simplefilter("error", DeprecationWarning)
        if all(map(bytes.strip, lines)):
            return np.loadtxt(text, dtype, comments=None, ndmin=1)
    return None


def shown(word: bytes | str) -> str:
    """Word of a file for a message: in quotes, at most 40 characters."""
    return repr((word if isinstance(word, str) else word.decode("ascii", "backslashreplace"))[:40])


def _listed(names: list[str]) -> str:
    """At most `_NAMES_SHOWN` names, cut to 40 characters each, for a message."""
    return ", ".join(name[:40] for name in names[:_NAMES_SHOWN])


# Headers.


def new_header(rows: np.dtype[Any], count: int) -> bytes:
    """Header of a binary PLY of one element, ``vertex``, with rows of a little-endian dtype."""
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {count}"]
    lines += [f"property {PLY_TYPES[rows[name].str[1:]]} {name}" for name in rows.names or ()]
    return "\n".join([*lines, "end_header", ""]).encode()


def vertex_header(raw: bytes) -> bytes:
    """Header of a binary file with ``vertex`` as its only element, otherwise unchanged."""
    kept, wanted = [], True
    for line in _lines(raw):
        words = line.split()
        if words[:1] == [b"element"]:
            wanted = words[1] == b"vertex"
        if words[:1] == [b"format"]:
            line = line.replace(b"ascii", b"binary_little_endian", 1)
        if wanted or words[:1] not in ([b"element"], [b"property"]):
            kept.append(line)
    return _line_end(raw).join(kept)


def with_count(raw: bytes, count: int) -> bytes:
    """Header with this number of vertices, otherwise unchanged."""
    announced = re.search(_line_end(raw) + rb"[ \t]*element[ \t]+vertex[ \t]+(\d+)", raw)
    if not announced or int(announced[1]) == count:
        return raw
    return b"%s%d%s" % (raw[: announced.start(1)], count, raw[announced.end(1) :])


def model_of(raw: bytes) -> Model | None:
    """Model in the comments of a header; None without; the last counts, as in other programs."""
    model: Model | None = None
    for match in filter(None, map(_MODEL_COMMENT.fullmatch, _lines(raw))):
        word = match[1].lower() if match[1] else (b"default", b"mip")[int(match[2])]
        model = next(name for name, mode in _MODES.items() if mode == word)
    return model


def stated_model(header: bytes, rows: np.dtype[Any]) -> Model | None:
    """Model that a PLY states, or None; "2dgs" if `rows`, dtype of a row, has no third scale."""
    return model_of(header) if THIRD_SCALE in (rows.names or ()) else "2dgs"


def model_drawn(path: Path | Url, header: bytes, rows: np.dtype[Any], model: Model | None) -> Model:
    """`model`, by default that of the PLY; `RefineError` unless its splats can be drawn so."""
    stated = stated_model(header, rows) or "default"
    if model not in (None, stated, *MODELS):
        raise RefineError(f"model is {model!r}, expected one of {', '.join(MODELS)}")
    if model not in (None, stated) and THIRD_SCALE not in (rows.names or ()):
        raise RefineError(f"{path}: splats without {THIRD_SCALE} are drawn as 2dgs, got {model}")
    return model or stated


def refuse_other_models(files: Sequence[Any]) -> None:
    """Raise `RefineError` if files, each with `path` and `model`, have not one model."""
    for file in files:
        if file.model != files[0].model:
            others = f"those of {files[0].path} {files[0].model}"
            wanted = "expected one model, or say which (--model)"
            raise RefineError(f"{file.path}: its splats are {file.model}, {others}; {wanted}")


def with_model(raw: bytes, model: Model) -> bytes:
    """Header that states a model in a comment; unchanged if it has this model already."""
    if (model_of(raw) or "default") == model:
        return raw
    lines = [line for line in _lines(raw) if not _MODEL_COMMENT.fullmatch(line)]
    if model != "default":
        lines.insert(2, b"comment SplatRenderMode: " + _MODES[model])
    return _line_end(raw).join(lines)


def _line_end(raw: bytes) -> bytes:
    return next(end for end in (b"\r\n", b"\n", b"\r") if raw.startswith(end, 3))


def _lines(raw: bytes) -> list[bytes]:
    return raw.split(_line_end(raw))


# Writing.


def write_rows(
    stream: BinaryIO, rows: NDArray[Any], keep: Keep, columns: Changes, threads: int | None = 1
) -> None:
    """Write kept rows, a chunk at a time, with `columns` set or appended (`SplatFile.write`)."""
    changed, values = columns if isinstance(columns, Changed) else (None, columns or {})
    row = _grown(rows.dtype, values)
    # As bytes, since NumPy gives no buffer of rows that have a field such as a:b.
    plain, grown = rows.view(f"V{rows.dtype.itemsize}"), np.dtype(f"V{row.itemsize}")
    at: Any = {"names": ["stored"], "formats": [plain.dtype], "itemsize": row.itemsize}

    def bytes_of(piece: slice) -> NDArray[Any]:
        stored, some, own = plain[piece], slice(None), piece
        if values:
            read, stored = stored, np.empty(len(stored), grown)
            stored.view(np.dtype(at))["stored"] = read
            if changed is not None:
                own = slice(*np.searchsorted(changed, (piece.start, piece.stop)))
                some = changed[own] - piece.start
            part = stored[some]
            fields = part.view(row)
            # A double may be too large or too small for a float; a signalling NaN becomes quiet.
            with np.errstate(over="ignore", under="ignore", invalid="ignore"):
                for name, new in values.items():
                    fields[name] = new[own]
            stored[some] = part
        every = np.ascontiguousarray(stored)
        return every if keep is None else every[keep[piece]]

    pieces = chunks(len(plain), _CHANGED_ROWS if values else _ROWS)
    copies = map(bytes_of, pieces) if threads == 1 else run(bytes_of, pieces, threads=threads)
    stream.writelines(chunk.data for chunk in copies)


def _grown(dtype, columns):
    """Row dtype with columns appended, in the byte order of x."""
    order, new = dtype["x"].byteorder, [name for name in columns if name not in dtype.names]
    return np.dtype(dtype.descr + [(n, columns[n].dtype.newbyteorder(order)) for n in new])
