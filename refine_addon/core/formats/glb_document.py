"""The parts of a binary glTF file, looked up with errors that name the place in its JSON."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from ..errors import RefineError
from .format import refuse_short

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

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
    """A file: its JSON and its binary chunk.

    Attributes
    ----------
    path : Path
    content : dict
    binary : (M,) uint8
    """

    path: Path
    content: dict[str, Any]
    binary: NDArray[np.uint8]

    def wrong(self, place: str, problem: str) -> RefineError:
        """Return the error for a place."""
        return RefineError(f"{self.path}: {place}: {problem}")

    def item(self, group: str, index: Any, place: str) -> dict[str, Any]:  # noqa: ANN401
        """Return an item of a list such as ``nodes`` by its index, which `place` names."""
        items = self.content.get(group, [])
        count = len(items) if isinstance(items, list) else 0
        if not is_whole(index) or not 0 <= index < count:
            raise self.wrong(place, f"{shown(index)} is none of {count} {group}")
        found = items[index]
        if not isinstance(found, dict):
            where = f"{group}[{index}]"
            raise self.wrong(where, f"expected an object, got {shown(found)}")
        return found

    def whole(
        self, holder: dict[str, Any], key: str, place: str, default: int | None = None
    ) -> int:
        """Return a whole number of 0 or more."""
        value = holder.get(key, default)
        if not is_whole(value) or not 0 <= value < 1 << 53:
            raise self.wrong(place, f"{key} is {shown(value)}, expected a whole number")
        return int(value)

    def indices(self, holder: dict[str, Any], key: str, place: str) -> list[Any]:
        """Return a list, empty if it is not there."""
        value = holder.get(key, [])
        if not isinstance(value, list):
            raise self.wrong(place, f"{key} is {shown(value)}, expected a list")
        return value

    def numbers(
        self, holder: dict[str, Any], key: str, place: str, default: tuple[float, ...]
    ) -> NDArray[np.float64]:
        """Return a list of as many numbers as `default` has."""
        value = holder.get(key, default)
        plain = isinstance(value, list | tuple) and len(value) == len(default)
        if not plain or not all(isinstance(n, float) or is_whole(n) for n in value):
            raise self.wrong(place, f"{key} is {shown(value)}, expected {len(default)} numbers")
        try:
            return np.array(value, np.float64)
        except OverflowError:
            raise self.wrong(place, f"{key}: a number too large for this") from None

    def accessor(self, index: Any, place: str, width: int) -> NDArray[Any]:  # noqa: ANN401
        """Return the values of an accessor, (n, width): numbers as they are stored.

        Raises
        ------
        RefineError
            If it is of another shape, is not in the file, or reaches beyond its end.
        """
        held = self.item("accessors", index, place)
        place = f"accessors[{index}]"
        kind, shape = held.get("componentType"), held.get("type")
        if not is_whole(kind) or kind not in KINDS or shape != SHAPES[width]:
            found = f"{shown(shape)} of {shown(kind)}"
            raise self.wrong(
                place, f"{found}, expected {SHAPES[width]} of {', '.join(map(str, KINDS))}"
            )
        if "sparse" in held or "bufferView" not in held:
            raise self.wrong(place, "sparse or without values, which splats are not read from")
        view = self.item("bufferViews", held["bufferView"], place)
        at = f"bufferViews[{held['bufferView']}]"
        buffer = self.item("buffers", view.get("buffer"), at)
        if view["buffer"] != 0 or "uri" in buffer or "extensions" in view:
            raise self.wrong(at, "in another file or compressed, expected the binary chunk")
        dtype, count = np.dtype(KINDS[kind]), self.whole(held, "count", place)
        size = dtype.itemsize * width
        start = self.whole(view, "byteOffset", at, 0)
        length = self.whole(view, "byteLength", at)
        offset = self.whole(held, "byteOffset", place, 0)
        step = self.whole(view, "byteStride", at, 0) or size
        end = offset + step * (count - 1) + size if count else 0
        if step < size or end > length or start + length > len(self.binary):
            problem = (
                f"{count} values of {size} bytes from byte {offset} of {length}, which begin at "
                f"byte {start} of {len(self.binary)}: expected as many"
            )
            raise self.wrong(place, problem)
        return np.ndarray(
            (count, width), dtype, self.binary.data, start + offset, (step, dtype.itemsize)
        )

    def normalized(self, index: Any) -> bool:  # noqa: ANN401 - was looked up before
        """Return whether an accessor's integers stand for -1..1 or 0..1."""
        return bool(self.content["accessors"][index].get("normalized", False))


def is_whole(value: Any) -> TypeGuard[int]:  # noqa: ANN401 - from JSON
    """Return whether a value of the file is a whole number."""
    return isinstance(value, int) and not isinstance(value, bool)


def shown(value: Any) -> str:  # noqa: ANN401 - from JSON
    """Return a value of the file for a message."""
    simple = value is None or isinstance(value, str | float | bool)
    if is_whole(value):
        simple = abs(value) < 1 << 64
    return repr(value)[:40] if simple else f"a {type(value).__name__}"


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
        msg = f"{path}: glTF version {version}, expected {VERSION}"
        raise RefineError(msg)
    refuse_short(path, length, len(data), "all chunks")
    found: dict[bytes, NDArray[np.uint8]] = {}
    at = HEADER.size
    while at + CHUNK.size <= length:
        size, kind = CHUNK.unpack(data[at : at + CHUNK.size].tobytes())
        at += CHUNK.size
        refuse_short(path, at + size, length, f"a chunk at byte {at} and what is before it")
        found.setdefault(kind, data[at : at + size])
        at += size
    try:
        content = json.loads(found.get(JSON, data[:0]).tobytes())
    except (ValueError, RecursionError) as error:
        what = str(error) if isinstance(error, ValueError) else "nested too deeply"
        msg = f"{path}: its JSON cannot be read: {what[:100]}"
        raise RefineError(msg) from error
    if not isinstance(content, dict):
        msg = f"{path}: its JSON is {shown(content)}, expected an object"
        raise RefineError(msg)
    return Document(path, content, found.get(BINARY, data[:0]))
