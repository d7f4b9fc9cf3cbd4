"""Reading OpenEXR images of named channels, as Blender writes them for us: in one part, not packed.

The layout is that of "OpenEXR File Layout" (Academy Software Foundation): a header of named
attributes, a table of offsets, and then for each line its number, its size and its channels one
after another, in the order of their names.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import RefineError

_MAGIC = 20000630
_MULTI_PART = 0x1000  # flag of the version
_LINE_HEAD = 8  # bytes: number and size of a line
_TYPES = {1: "<f2", 2: "<f4"}  # of numbers in a channel


def read_exr(path: Path) -> dict[str, NDArray[np.float32]]:
    """Channels of an image by their names.

    Parameters
    ----------
    path : Path

    Returns
    -------
    mapping of str to (H, W) float32
        The top row first.

    Raises
    ------
    RefineError
        If the file cannot be read, or is packed, has several parts, or channels of integers.
    """
    try:
        return _channels(path.read_bytes())
    except OSError as error:
        raise RefineError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (ValueError, KeyError, IndexError, struct.error) as error:
        raise RefineError(
            f"{path}: expected an OpenEXR image in one part, without compression; {error}"
        ) from error


def _channels(data):
    magic, version = struct.unpack_from("<II", data)
    if magic != _MAGIC or version & _MULTI_PART:
        raise ValueError(f"it begins with {magic}, version {version:#x}")
    header, at = {}, 8
    while data[at]:
        name, at = _text(data, at)
        _, at = _text(data, at)  # its type
        (size,) = struct.unpack_from("<i", data, at)
        header[name] = data[at + 4 : at + 4 + size]
        at += 4 + size
    if header["compression"] != b"\0":
        raise ValueError(f"its compression is number {header['compression'][0]}")
    left, top, right, bottom = struct.unpack("<4i", header["dataWindow"])
    width, height = right - left + 1, bottom - top + 1
    parts: list[Any] = [("head", f"V{_LINE_HEAD}")]
    listed, place = header["channels"], 0
    while listed[place]:  # in the order in which lines hold them
        name, place = _text(listed, place)
        (kind,) = struct.unpack_from("<i", listed, place)
        parts.append((name, _TYPES[kind], (width,)))
        place += 16
    lines = np.frombuffer(data, np.dtype(parts), height, at + 1 + 8 * height)
    return {name: lines[name].astype(np.float32) for name, *_ in parts[1:]}


def _text(data: bytes, start: int) -> tuple[str, int]:
    """Text that begins here, and where it is over."""
    end = data.index(b"\0", start)
    return data[start:end].decode(errors="replace"), end + 1
