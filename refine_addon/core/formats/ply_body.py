"""The body of a PLY file: where its splats are, and checks that it is complete."""

from __future__ import annotations

import struct
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import plyfile
from numpy.typing import NDArray

from ..errors import RefineError
from .ply_header import TEXT, Header, shown


def check_counts(header: Header, available: int) -> None:
    """Refuse a header that announces more rows than the file can hold, before memory is allocated.

    Parameters
    ----------
    header : Header
    available : int
        Bytes after the header.

    Raises
    ------
    RefineError
        If that many rows would not fit even if each were as short as possible.
    """
    least = 0
    text = header.order == TEXT
    for element, count in zip(header.elements, header.counts, strict=True):
        row = _least_bytes(element, text=text)
        if not row and count:
            raise RefineError(
                f"{header.path}: element {shown(element.name)} has {count} rows and no property"
            )
        least += row * count
        if least > available + text:  # plus 1 for text, whose last line may lack its line end
            raise RefineError(
                f"{header.path}: truncated: the header announces {count} rows of "
                f"{shown(element.name)}, at least {least} bytes so far, but only {available} bytes "
                "follow it"
            )


def _least_bytes(element: Any, *, text: bool) -> int:
    """Return the least bytes that one row of an element takes."""
    if text:  # one digit and one separator for each number; lists may be empty, but have a length
        return 2 * len(element.properties)
    return sum(
        np.dtype(p.len_dtype if isinstance(p, plyfile.PlyListProperty) else p.val_dtype).itemsize
        for p in element.properties
    )


def has_lists(element: Any) -> bool:
    """Return whether an element has lists, so that its rows differ in length."""
    return any(isinstance(prop, plyfile.PlyListProperty) for prop in element.properties)


def vertex_range(header: Header, vertex: int, body: NDArray[np.uint8]) -> tuple[int, int]:
    """Return where in a binary body the vertex rows begin and end.

    Parameters
    ----------
    header : Header
    vertex : int
        Index of the vertex element, which has no list.
    body : (M,) uint8
        Everything after the header.

    Raises
    ------
    RefineError
        If the file ends before the last row; with the row.
    """
    start = 0
    for element, count in zip(header.elements[:vertex], header.counts[:vertex], strict=True):
        if has_lists(element):
            start = _behind_lists(header, element, count, body, start)
        else:
            start += count * element.dtype(header.order).itemsize
    count, size = header.counts[vertex], header.elements[vertex].dtype(header.order).itemsize
    end = start + count * size
    if end > len(body):
        row = max(len(body) - start, 0) // size
        total = len(header.raw)
        raise RefineError(
            f"{header.path}: truncated: the file ends in vertex row {row} of {count} "
            f"({total + len(body)} bytes, expected at least {total + end})"
        )
    return start, end


def _behind_lists(
    header: Header,
    element: Any,
    count: int,
    body: NDArray[np.uint8],
    at: int,
) -> int:
    """Return where the rows of an element with lists end; they start at `at`."""
    # For each property: how to read the length of a list (None if it is not one), bytes of a value.
    steps = [
        (_length_reader(header, element, prop), np.dtype(prop.val_dtype).itemsize)
        for prop in element.properties
    ]
    data = body.data
    for row in range(count):
        try:
            for reader, size in steps:
                length = 1
                if reader is not None:
                    (length,) = reader.unpack_from(data, at)
                    at += reader.size
                if length < 0:
                    raise RefineError(
                        f"{header.path}: element {shown(element.name)} row {row}: "
                        f"a list of {length} numbers, expected 0 or more"
                    )
                at += length * size
        except struct.error:
            at = len(data) + 1
        if at > len(data):
            raise RefineError(
                f"{header.path}: truncated: the file ends in row {row} of {count} of "
                f"{shown(element.name)}"
            )
    return at


def _length_reader(header: Header, element: Any, prop: Any) -> struct.Struct | None:
    """Return how to read the length of a list, or None for a single number."""
    if not isinstance(prop, plyfile.PlyListProperty):
        return None
    kind = np.dtype(prop.len_dtype)
    if kind.kind == "f":
        raise RefineError(
            f"{header.path}: element {shown(element.name)}: the length of list "
            f"{shown(prop.name)} is of type {kind}, expected a whole number"
        )
    return struct.Struct(header.order + kind.char)


def read_text(
    header: Header, vertex: int, body: bytes
) -> tuple[NDArray[Any], list[bytes], tuple[bytes, bytes]]:
    """Read the vertex rows of an ASCII body.

    Parameters
    ----------
    header : Header
    vertex : int
        Index of the vertex element, which has no list.
    body : bytes
        Everything after the header.

    Returns
    -------
    rows : (N,) structured
    lines : list of bytes
        The text of each row with its line end.
    beside : tuple of bytes
        The text before the rows and the text after them.

    Raises
    ------
    RefineError
        If lines are missing, or one does not hold the numbers announced; with the row.
    """
    lines = body.splitlines(keepends=True)
    start = sum(header.counts[:vertex])
    end = start + header.counts[vertex]
    before = 0
    for element, count in zip(header.elements, header.counts, strict=True):
        if len(lines) < before + count:
            raise RefineError(
                f"{header.path}: truncated: the file ends in row {len(lines) - before} of {count} "
                f"of {shown(element.name)}"
            )
        before += count
    rows = _numbers(header, header.elements[vertex], lines[start:end])
    return rows, lines[start:end], (b"".join(lines[:start]), b"".join(lines[end:]))


def _numbers(header: Header, element: Any, lines: Sequence[bytes]) -> NDArray[Any]:
    """Return the numbers in lines of text; refuse the first line that is wrong."""
    dtype = element.dtype(TEXT)
    try:
        return _parsed(lines, dtype)
    except _WRONG:
        row = _first_wrong(lines, dtype)
    words = lines[row].split()
    if len(words) != len(dtype):
        problem = f"expected {len(dtype)} numbers, got {len(words)}"
    else:
        index = next(i for i, word in enumerate(words) if not _is_number(word, dtype[i]))
        problem = (
            f"property {shown(dtype.names[index])}: expected a number of type {dtype[index]}, "
            f"got {words[index][:40].decode('ascii', 'backslashreplace')!r}"
        )
    raise RefineError(f"{header.path}: vertex row {row}: {problem}")


_WRONG = (ValueError, DeprecationWarning)
"""What NumPy raises for text that is not a number of the type."""

_NO_SPACES = bytes.maketrans(b"\x1c\x1d\x1e\x1f", b"????")
"""Replaces four control characters: str splits words at them, bytes and the header do not."""


def _parsed(lines: Sequence[bytes], dtype: Any) -> NDArray[Any]:
    """Return the numbers in lines of text; raise one of `_WRONG` if a line is wrong."""
    if not lines:
        return np.empty(0, dtype)
    if not all(map(bytes.strip, lines)):
        raise ValueError("an empty line, which NumPy would skip")
    with warnings.catch_warnings():
        # NumPy only deprecates 1.5 for an integer property.
        warnings.simplefilter("error", DeprecationWarning)
        text = (line.translate(_NO_SPACES).decode("ascii") for line in lines)
        return np.loadtxt(text, dtype, comments=None, ndmin=1)


def _is_number(word: bytes, dtype: Any) -> bool:
    """Return whether a word is a number of a type."""
    try:
        _parsed([word], dtype)
    except _WRONG:
        return False
    return True


def _first_wrong(lines: Sequence[bytes], dtype: Any) -> int:
    """Return the index of the first wrong line, by bisection; at least one line is wrong."""
    first, beyond = 0, len(lines)
    while beyond - first > 1:  # the first wrong line is one of first..beyond - 1
        middle = (first + beyond) // 2
        try:
            _parsed(lines[first:middle], dtype)
        except _WRONG:
            beyond = middle
        else:
            first = middle
    return first
