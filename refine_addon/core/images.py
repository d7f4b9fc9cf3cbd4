"""PNG, OpenEXR and WebP images, the size of a PNG or JPEG by its header, and the curve of sRGB.

PNG has 8 bits a channel (ISO/IEC 15948). OpenEXR is read as Blender writes it for us: one part,
without compression ("OpenEXR File Layout"). Core has no codec of its own for lossless WebP: `use`
sets one, such as Blender's, and without it Pillow is imported when needed.
"""

from __future__ import annotations

import importlib
import io
import re
import struct
import warnings
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from .whole_file import explained

_PNG = b"\x89PNG\r\n\x1a\n"
_TRUECOLOR = 2
_UP = 2  # the filter that stores each row's difference to the one above
_EXR = 20000630
_MULTI_PART = 0x1000  # flag of the version
_LINE_HEAD = 8  # bytes: number and size of a line
_TYPES = {1: "<f2", 2: "<f4"}  # of numbers in a channel
_ATTRIBUTE = re.compile(rb"([^\0]+)\0[^\0]*\0(.{4})", re.DOTALL)  # name, type, bytes that follow
_CHANNEL = re.compile(rb"([^\0]+)\0(.).{15}", re.DOTALL)  # name, type of its numbers
_JPEG_START = b"\xff\xd8"
_MOST_SEGMENTS = 4096  # segments and fill bytes of a JPEG skipped at most; cameras write fewer
_FILL = 0xFF
_LAST = 0xDA, 0xD9  # start of scan and end of image
_STANDALONE = {0x01, *range(0xD0, 0xD9)}  # JPEG markers that no segment follows
_FRAME_MARKERS = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""JPEG start-of-frame markers: a segment with precision (1 byte), height, width (2 each)."""


def srgb_of(linear: NDArray[Any]) -> NDArray[np.float64]:
    """Values (...) float64 in sRGB of linear ones (IEC 61966-2-1); also beyond 0..1."""
    curved = 1.055 * np.maximum(linear, 0.0031308) ** (1.0 / 2.4) - 0.055
    return np.asarray(np.where(linear > 0.0031308, curved, 12.92 * linear))


def linear_of(srgb: NDArray[Any]) -> NDArray[np.float64]:
    """Inverse of `srgb_of`."""
    curved = ((np.maximum(srgb, 0.04045) + 0.055) / 1.055) ** 2.4
    return np.asarray(np.where(srgb > 0.04045, curved, srgb / 12.92))


def png(pixels: NDArray[np.uint8]) -> bytes:
    """PNG file that holds 8-bit pixels, (H, W, 3), the top row first."""
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, -1)
    filtered = np.full((height, 1 + rows.shape[1]), _UP, np.uint8)
    filtered[:, 1:] = np.diff(rows, axis=0, prepend=np.zeros((1, rows.shape[1]), np.uint8))
    header = struct.pack(">IIBBBBB", width, height, 8, _TRUECOLOR, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(filtered.tobytes())), (b"IEND", b""))
    return _PNG + b"".join(  # of each chunk: length, kind, data, checksum of kind and data
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )


def read_exr(path: Path) -> dict[str, NDArray[np.float32]]:
    """Channels by name, (H, W), top row first; `RefineError` if damaged, compressed or in parts."""
    with explained(path, "cannot be read"):
        data = path.read_bytes()
    wanted = "expected an OpenEXR image in one part, without compression"
    with explained(path, wanted, errors=(ValueError, KeyError, IndexError, struct.error)):
        magic, version = struct.unpack_from("<II", data)
        if magic != _EXR or version & _MULTI_PART:
            raise ValueError(f"it begins with {magic}, version {version:#x}")
        header, at = {}, 8
        while attribute := _ATTRIBUTE.match(data, at):
            at = attribute.end() + int.from_bytes(attribute[2], "little")
            header[attribute[1]] = data[attribute.end() : at]
        if header[b"compression"] != b"\0":
            raise ValueError(f"its compression is number {header[b'compression'][0]}")
        left, top, right, bottom = struct.unpack("<4i", header[b"dataWindow"])
        width, height = right - left + 1, bottom - top + 1
        parts: list[Any] = [("head", f"V{_LINE_HEAD}")]  # then channels, in the order of a line
        for name, kind in _CHANNEL.findall(header[b"channels"]):
            parts.append((name.decode(errors="replace"), _TYPES[kind[0]], (width,)))
        lines = np.frombuffer(data, np.dtype(parts), height, at + 1 + 8 * height)
        return {name: lines[name].astype(np.float32) for name, *_ in parts[1:]}


def image_size(path: Path) -> tuple[int, int] | None:
    """Width and height of a PNG or JPEG in pixels, before any EXIF rotation; None for others."""
    with suppress(OSError, ValueError, struct.error):
        if path.is_file():  # opening a pipe would wait for a writer
            with path.open("rb") as stream:
                head = stream.read(24)
                if head.startswith(_PNG) and head[12:16] == b"IHDR":
                    return struct.unpack(">II", head[16:24])
                return _jpeg_size(stream) if head.startswith(_JPEG_START) else None
    return None


def _jpeg_size(stream: BinaryIO) -> tuple[int, int] | None:
    """Size in the first frame header; the segments before it are skipped."""
    stream.seek(len(_JPEG_START))
    for _ in range(_MOST_SEGMENTS):
        start, marker = stream.read(2)
        if start != _FILL or marker in _LAST:
            return None
        if marker == _FILL:
            stream.seek(-1, 1)
        elif marker not in _STANDALONE:
            (length,) = struct.unpack(">H", stream.read(2))
            if marker in _FRAME_MARKERS:
                height, width = struct.unpack(">xHH", stream.read(5))
                return width, height
            stream.seek(max(length - 2, 0), 1)
    return None


class Codec(Protocol):
    """A reader and writer of WebP images."""

    def size(self, data: bytes) -> tuple[int, int]:
        """Width and height in pixels, without unpacking; `ValueError` if damaged.

        From the first chunk of a RIFF container: ``VP8X`` (sizes less 1 in 24 bits each, after 4
        bytes), ``VP8L`` (sizes less 1 in 14 bits each, after 1 byte) or ``VP8 `` (sizes in 14 bits
        each, after 6 bytes).
        """
        kind, start = data[12:16], data[20:30]
        if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or len(start) < 10:
            raise ValueError("not a WebP image")
        # Of such a file Blender makes a black image.
        if int.from_bytes(data[4:8], "little") + 8 > len(data):
            raise ValueError("truncated")
        if kind == b"VP8X":
            across, down = (int.from_bytes(start[at : at + 3], "little") + 1 for at in (4, 7))
        elif kind == b"VP8L":
            packed = int.from_bytes(start[1:5], "little")
            across, down = (packed & 0x3FFF) + 1, (packed >> 14 & 0x3FFF) + 1
        else:
            across, down = (int.from_bytes(start[at : at + 2], "little") & 0x3FFF for at in (6, 8))
        return across, down

    def decode(self, data: bytes) -> NDArray[np.uint8]:
        """Pixels, (height, width, 4), the top row first; `ValueError` if damaged."""

    def encode(self, pixels: NDArray[np.uint8]) -> bytes:
        """WebP image that holds these pixels, (height, width, 4), to the bit."""


class _Pillow(Codec):
    """Pillow as a codec."""

    def __init__(self) -> None:
        self._image: Any = importlib.import_module("PIL.Image")

    def decode(self, data: bytes) -> NDArray[np.uint8]:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # about large images, which we refuse by their size
                with self._image.open(io.BytesIO(data), formats=["WEBP"]) as image:
                    return np.array(image.convert("RGBA"))
        except (OSError, SyntaxError, self._image.DecompressionBombError) as error:
            raise ValueError(str(error)) from error

    def encode(self, pixels: NDArray[np.uint8]) -> bytes:
        stream = io.BytesIO()
        # Without `exact`, the colours of pixels whose alpha is 0 would be lost.
        image = self._image.fromarray(pixels, "RGBA")
        image.save(stream, "WEBP", lossless=True, exact=True, quality=25, method=2)
        return stream.getvalue()


_chosen: list[Codec] = []


def use(codec: Codec | None) -> None:
    """Read and write images by `codec` from now on; None stands for Pillow."""
    _chosen[:] = [] if codec is None else [codec]


def codec_for(path: Path) -> Codec:
    """Codec in use; `RefineError`, naming `path`, if there is none."""
    if _chosen:
        return _chosen[0]
    wanted = "run this in Blender, or 'pip install pillow'"
    with explained(path, f"WebP images need a library: {wanted}", errors=ImportError):
        return _Pillow()
