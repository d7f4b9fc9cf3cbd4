"""Write rows of splats with their bytes as they were read, and with columns set or added."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..execute import chunks, run
from .ply_columns import ChangedColumns

PLY_TYPES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}
"""Names of types in NumPy -> in PLY."""

_LONGEST = {4: len("-1234567800000000.0"), 8: len("-1.2345678901234567e-308")}
"""Bytes of a float or double -> most characters of its shortest text that reads back the same."""

_ROWS = 1 << 12
"""Rows copied at a time: 1 MB at degree 3, which stays in the L2 cache until it is written."""

_CHANGED_ROWS = 1 << 14
"""Rows copied at a time where columns are set, which takes a few calls for each of them."""

_AHEAD = 16
"""So many chunks may wait for those before them to be written."""


def write_rows(
    stream: BinaryIO,
    rows: NDArray[Any],
    keep: NDArray[np.bool_] | None,
    columns: Mapping[str, NDArray[Any]],
    *,
    threads: int | None = 1,
) -> None:
    """Write the kept rows as bytes, a chunk at a time, with `columns` set or appended."""
    plain = rows.view(np.dtype((np.void, rows.dtype.itemsize)))
    changed = columns if isinstance(columns, ChangedColumns) else None
    if changed is not None and not changed.keys() <= set(rows.dtype.names or ()):
        changed = None

    def bytes_of(piece: slice) -> NDArray[Any]:
        kept = None if keep is None else keep[piece]
        chunk = plain[piece] if kept is None else plain[piece][kept]
        if changed is not None:
            chunk = np.array(chunk)
            changed.put(chunk, rows.dtype, piece, kept)
        elif columns:
            chosen = slice(None) if kept is None else kept
            cells = {name: values[piece][chosen] for name, values in columns.items()}
            chunk = _with_cells(np.ascontiguousarray(chunk), rows.dtype, cells)
        return np.ascontiguousarray(chunk)

    pieces = [*chunks(len(plain), _CHANGED_ROWS if columns else _ROWS)]
    if threads == 1:
        stream.writelines(bytes_of(piece).data for piece in pieces)
        return
    for batch in chunks(len(pieces), _AHEAD):

        def of_batch(number: slice, begin: int = batch.start) -> NDArray[Any]:
            return bytes_of(pieces[begin + number.start])

        count = batch.stop - batch.start
        made = run(of_batch, chunks(count, 1), what="writing", threads=threads)
        stream.writelines(chunk.data for chunk in made)


def _with_cells(
    chunk: NDArray[Any], dtype: np.dtype[Any], cells: Mapping[str, NDArray[Any]]
) -> NDArray[np.uint8]:
    """Return n rows as bytes, (n, bytes of a row), with some properties set and others appended.

    `dtype` is that of a row; `cells` are values of the properties by name, (n,) each.
    """
    size, fields = dtype.itemsize, dict(dtype.fields or {})
    kinds = {name: _stored(dtype, name, values.dtype) for name, values in cells.items()}
    extra = sum(kind.itemsize for name, kind in kinds.items() if name not in fields)
    grown = np.empty((len(chunk), size + extra), np.uint8)
    grown[:, :size] = chunk.view(np.uint8).reshape(-1, size)
    for name, values in cells.items():
        width = kinds[name].itemsize
        at = fields[name][1] if name in fields else size
        size += 0 if name in fields else width
        stored = _cast(values, kinds[name])
        grown[:, at : at + width] = stored.view(np.uint8).reshape(-1, width)
    return grown


def text_lines(
    rows: NDArray[Any],
    lines: Sequence[bytes],
    keep: NDArray[np.bool_] | None,
    columns: Mapping[str, NDArray[Any]],
) -> Iterator[bytes]:
    """Yield the kept rows of an ASCII file with `columns` set or appended.

    Only the text of numbers that change is replaced; all other text stays.

    Parameters
    ----------
    rows : (N,) structured
        The numbers that the lines hold.
    lines : sequence of bytes
    keep : (N,) bool or None
    columns : mapping of str to (N,)

    Yields
    ------
    bytes
        A line with its end.
    """
    names = rows.dtype.names or ()
    cells = {n: _cast(v, _stored(rows.dtype, n, v.dtype)) for n, v in columns.items()}
    added = [values for name, values in cells.items() if name not in names]
    # Of each property that is set: its place in a row, its values, and which of them are new.
    changed = [
        (names.index(name), values, _differs(values, rows[name]))
        for name, values in cells.items()
        if name in names
    ]
    kept: Iterable[int] = range(len(lines)) if keep is None else np.flatnonzero(keep).tolist()
    for index in kept:
        words = {place: _word(values[index]) for place, values, new in changed if new[index]}
        more = [_word(values[index]) for values in added]
        yield _edited(lines[index], words, more) if words or more else lines[index]


def _word(value: Any) -> bytes:
    """Return the shortest text that reads back as a number, which `str` makes of NumPy's."""
    return str(value).encode()


def longest_line(dtype: np.dtype[Any], lines: Sequence[bytes], names: Collection[str]) -> int:
    """Return the most bytes of a line after the numbers of these names have changed.

    Parameters
    ----------
    dtype : structured
        Of the numbers that the lines hold.
    lines : sequence of bytes
    names : collection of str
        Properties of type float or double.
    """
    room = [_LONGEST[dtype[name].itemsize] if name in names else 0 for name in dtype.names or ()]

    def longest(line: bytes) -> int:
        more = (most - len(word) for most, word in zip(room, line.split(), strict=True))
        return len(line) + sum(each for each in more if each > 0)

    return max(map(longest, lines), default=0)


def _differs(one: NDArray[Any], other: NDArray[Any]) -> NDArray[np.bool_]:
    """Return where two columns of one type differ in any bit, (N,); 0 and -0 differ."""
    bits = f"u{one.dtype.itemsize}"
    differs: NDArray[np.bool_] = one.view(bits) != np.ascontiguousarray(other).view(bits)
    return differs


def _edited(line: bytes, words: Mapping[int, bytes], added: Sequence[bytes]) -> bytes:
    """Return a line with some words replaced and others added at its end; its spaces stay."""
    numbers = line.rstrip()  # no space at its end, or the pattern would be tried at each of them
    parts = re.findall(rb"(\s*)(\S+)", numbers)
    text = b"".join(space + words.get(index, word) for index, (space, word) in enumerate(parts))
    return b" ".join([text, *added]) + line[len(numbers) :]


def declarations(
    path: Path, rows: NDArray[Any], columns: Mapping[str, NDArray[Any]]
) -> list[bytes]:
    """Return header lines for the columns that are not properties of `rows`.

    Parameters
    ----------
    path : Path
        Of the rows, for messages.
    rows : (N,) structured
    columns : mapping of str to (N,)

    Raises
    ------
    RefineError
        If a column cannot be a property of these rows.
    """
    present = dict(rows.dtype.fields or {})
    lines = []
    for name in columns:
        if isinstance(columns, ChangedColumns) and name in present:
            continue  # it has the stored type, and need not be made
        values = columns[name]
        kind = PLY_TYPES.get(values.dtype.str[1:])
        if values.shape != rows.shape:
            raise RefineError(
                f"{path}: column '{name}' has shape {values.shape}, expected {rows.shape}"
            )
        if name in present:
            if not np.can_cast(values.dtype, present[name][0], "same_kind"):
                raise RefineError(
                    f"{path}: property '{name}' is there already, of type {present[name][0]}; "
                    f"expected one that holds {values.dtype}"
                )
        elif kind is None or not re.fullmatch(r"[!-~]+", name):
            raise RefineError(
                f"{path}: column '{name}' of type {values.dtype} cannot be a property, expected "
                f"ASCII without spaces and one of {', '.join(PLY_TYPES)}"
            )
        else:
            lines.append(f"property {kind} {name}".encode())
    return lines


def _stored(dtype: np.dtype[Any], name: str, kind: np.dtype[Any]) -> np.dtype[Any]:
    """Return a column's type in the file.

    It is the type of the property if there is one; otherwise `kind` in the file's byte order.
    """
    if name in (dtype.names or ()):
        return dtype[name]
    # The byte order is that of x, since x has several bytes.
    return kind.newbyteorder(dtype["x"].byteorder)  # type: ignore[arg-type]


def _cast(values: NDArray[Any], kind: np.dtype[Any]) -> NDArray[Any]:
    """Return values in another type, without warnings."""
    # A double may be too large or too small for a float; a signalling NaN becomes a quiet one.
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):
        return values.astype(kind)
