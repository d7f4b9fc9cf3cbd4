"""The parts of a binary glTF file, looked up with errors that name the place in its JSON."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..place import Place, described, is_whole
from .format import refuse_short

HEADER = struct.Struct("<4sII")
"""Magic, version, bytes of all."""

CHUNK = struct.Struct("<I4s")
"""Bytes, kind."""

MAGIC, VERSION = b"glTF", 2
JSON, BINARY = b"JSON", b"BIN\0"

KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
"""glTF's component types that splats may have -> NumPy's."""

SHAPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
"""Numbers of a value -> the type of its accessor."""


@dataclass(frozen=True, eq=False)
class Document:
    """A file: its JSON and its binary chunk. Every lookup raises `RefineError` with the place.

    Attributes
    ----------
    place : Place
        The file.
    content : dict
    binary : (M,) uint8
    """

    place: Place
    content: dict[str, Any]
    binary: NDArray[np.uint8]

    def item(self, group: str, index: Any, place: Place) -> tuple[dict[str, Any], Place]:
        """Return an item of a list such as ``nodes``, and its place; `place` names the index."""
        items = self.content.get(group, [])
        count = len(items) if isinstance(items, list) else 0
        if not is_whole(index) or not 0 <= index < count:
            place.fail(f"{described(index)} is none of {count} {group}")
        where = self.place.at(f"{group}[{index}]")
        return where.members(items[index]), where

    def accessor(self, index: Any, place: Place, width: int) -> NDArray[Any]:
        """Return the values of an accessor, (n, width): numbers as they are stored.

        Raises
        ------
        RefineError
            If it is of another shape, is not in the file, or reaches beyond its end.
        """
        held, place = self.item("accessors", index, place)
        kind, shape = held.get("componentType"), held.get("type")
        if not is_whole(kind) or kind not in KINDS or shape != SHAPES[width]:
            got = f"{described(shape)} of {described(kind)}"
            place.fail(f"{got}, expected {SHAPES[width]} of {', '.join(map(str, KINDS))}")
        if "sparse" in held or "bufferView" not in held:
            place.fail("sparse or without values, which splats are not read from")
        dtype, count = np.dtype(KINDS[kind]), _whole(held, "count", place)
        offset = _whole(held, "byteOffset", place, 0)
        start, length, stride = self._buffer_view(held["bufferView"], place)
        size = dtype.itemsize * width
        stride = stride or size
        end = offset + stride * (count - 1) + size if count else 0
        if stride < size or end > length or start + length > len(self.binary):
            place.fail(
                f"{count} values of {size} bytes from byte {offset} of a view of {length} bytes "
                f"at byte {start} of {len(self.binary)}, expected that they fit"
            )
        return np.ndarray(
            (count, width), dtype, self.binary.data, start + offset, (stride, dtype.itemsize)
        )

    def _buffer_view(self, index: Any, place: Place) -> tuple[int, int, int]:
        """Return first byte, bytes and stride (0: none is given) of a part of the binary chunk."""
        view, place = self.item("bufferViews", index, place)
        buffer, _ = self.item("buffers", view.get("buffer"), place)
        if view["buffer"] != 0 or "uri" in buffer or "extensions" in view:
            place.fail("in another file or compressed, expected the binary chunk")
        return (
            _whole(view, "byteOffset", place, 0),
            _whole(view, "byteLength", place),
            _whole(view, "byteStride", place, 0),
        )

    def normalized(self, index: int) -> bool:
        """Return whether the integers of an accessor stand for -1..1 or 0..1."""
        return bool(self.content["accessors"][index].get("normalized", False))


def _whole(holder: dict[str, Any], key: str, place: Place, default: int | None = None) -> int:
    """Return a whole number of 0 or more."""
    return place.at(key).whole(holder.get(key, default))


def opened(path: Path, data: NDArray[np.uint8]) -> Document:
    """Return the document in a binary glTF file.

    Raises
    ------
    RefineError
        If it is truncated, of another version, or its JSON cannot be read.
    """
    refuse_short(path, HEADER.size + CHUNK.size, len(data), "the first bytes of a GLB file")
    _, version, length = HEADER.unpack(data[: HEADER.size].tobytes())
    if version != VERSION:
        raise RefineError(f"{path}: glTF version {version}, expected {VERSION}")
    refuse_short(path, length, len(data), "all chunks")
    chunks: dict[bytes, NDArray[np.uint8]] = {}
    at = HEADER.size
    while at + CHUNK.size <= length:
        size, kind = CHUNK.unpack(data[at : at + CHUNK.size].tobytes())
        at += CHUNK.size
        refuse_short(path, at + size, length, f"a chunk at byte {at} and what is before it")
        chunks.setdefault(kind, data[at : at + size])
        at += size
    place = Place(path)
    text = place.at("JSON")
    content = text.members(text.parsed(chunks.get(JSON, data[:0]).tobytes()))
    return Document(place, content, chunks.get(BINARY, data[:0]))
