"""Lossless WebP images, read and written by Blender's own library or by Pillow.

Core has no codec of its own. `use` names one, as the extension does in Blender; without, Pillow is
imported when an image is read or written.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import warnings
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError


class Codec(Protocol):
    """What reads and writes images."""

    def size(self, data: bytes) -> tuple[int, int]:
        """Return width and height of an image, without unpacking it; raise `ValueError`."""

    def decode(self, data: bytes) -> NDArray[np.uint8]:
        """Return the pixels of an image, (height, width, 4), the top row first; see `size`."""

    def encode(self, pixels: NDArray[np.uint8]) -> bytes:
        """Return a WebP image that holds these pixels, (height, width, 4), to the bit."""


class _Pillow:
    """Pillow as a codec."""

    def __init__(self) -> None:
        self._image: Any = importlib.import_module("PIL.Image")

    def size(self, data: bytes) -> tuple[int, int]:
        """See `Codec`."""
        with self._opened(data) as image:
            return image.size

    def decode(self, data: bytes) -> NDArray[np.uint8]:
        """See `Codec`."""
        with self._opened(data) as image:
            return np.array(image.convert("RGBA"))

    @contextlib.contextmanager
    def _opened(self, data):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of large images, which are refused by their size
                image = self._image.open(io.BytesIO(data), formats=["WEBP"])
            with image:
                yield image
        except (OSError, SyntaxError, self._image.DecompressionBombError) as error:
            raise ValueError(str(error)) from error

    def encode(self, pixels: NDArray[np.uint8]) -> bytes:
        """See `Codec`."""
        stream = io.BytesIO()
        # Without `exact`, the colours of pixels whose alpha is 0 would be lost.
        image = self._image.fromarray(pixels, "RGBA")
        image.save(stream, "WEBP", lossless=True, exact=True, quality=25, method=2)
        return stream.getvalue()


_named: list[Codec] = []


def use(codec: Codec | None) -> None:
    """Read and write images by `codec` from now on; None stands for Pillow."""
    _named[:] = [] if codec is None else [codec]


def codec_for(path: Path) -> Codec:
    """Return what reads and writes images.

    Raises
    ------
    RefineError
        If there is nothing; `path` is the file that needs it.
    """
    if _named:
        return _named[0]
    try:
        return _Pillow()
    except ImportError as error:
        wanted = "run this in Blender, or 'pip install pillow'"
        raise RefineError(f"{path}: WebP images need a library: {wanted}") from error
