"""The size of a PNG or JPEG image, read from its header."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import BinaryIO

PNG_START = b"\x89PNG\r\n\x1a\n"
JPEG_START = b"\xff\xd8"

MOST_SEGMENTS = 4096
"""Most segments and fill bytes that are skipped; no camera writes more."""

FILL = 0xFF
START_OF_SCAN = 0xDA
END_OF_IMAGE = 0xD9
STANDALONE = {0x01, *range(0xD0, 0xD9)}
"""JPEG markers that no segment follows."""
FRAME_MARKERS = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""JPEG start-of-frame markers: a segment with precision (1 byte), height, width (2 bytes each)."""


def image_size(path: Path) -> tuple[int, int] | None:
    """Width and height as stored (before any EXIF rotation), pixels.

    Parameters
    ----------
    path : Path
        An image, or anything else.

    Returns
    -------
    tuple of int or None
        ``None`` if the file does not exist, is neither PNG nor JPEG, or is truncated.
    """
    try:
        if not path.is_file():  # a pipe would be waited for
            return None
        with path.open("rb") as stream:
            head = stream.read(24)
            if head.startswith(PNG_START) and head[12:16] == b"IHDR":
                return struct.unpack(">II", head[16:24])
            return _jpeg_size(stream) if head.startswith(JPEG_START) else None
    except (OSError, ValueError, struct.error):
        return None


def _jpeg_size(stream: BinaryIO) -> tuple[int, int] | None:
    """Size in the first frame header; the segments before it are skipped."""
    stream.seek(len(JPEG_START))
    for _ in range(MOST_SEGMENTS):
        start, marker = stream.read(2)
        if start != FILL or marker in (START_OF_SCAN, END_OF_IMAGE):
            return None
        if marker == FILL:
            stream.seek(-1, 1)
        elif marker not in STANDALONE:
            (length,) = struct.unpack(">H", stream.read(2))
            if marker in FRAME_MARKERS:
                height, width = struct.unpack(">xHH", stream.read(5))
                return width, height
            stream.seek(max(length - 2, 0), 1)
    return None
