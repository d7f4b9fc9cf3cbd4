"""Calls from other threads on Blender's main thread, the only one that may touch Blender's data.
With them core's formats read and write WebP images through Blender."""

from __future__ import annotations

import queue
import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from functools import partial
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from .core.execute import Cancelled, checkpoint
from .core.images import Codec

_STEP = 0.1  # Seconds between two checks of a waiting thread for cancelling
_LOSSLESS = 100  # Quality at which Blender compresses WebP without loss
_calls: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = queue.SimpleQueue()


def call(function: Callable[[], Any]) -> Any:
    """Result of a function called on the main thread: at once if this is it, else by `serve`.
    Raises the function's error, or `Cancelled`; the function may have been called even then."""
    if threading.current_thread() is threading.main_thread():
        return function()
    answer: Future[Any] = Future()
    _calls.put((function, answer))
    while not wait([answer], _STEP).done:
        try:
            checkpoint()
        except Cancelled:
            answer.cancel()
            raise
    return answer.result()


def serve() -> None:
    """Run the waiting calls on the main thread."""
    while not _calls.empty():  # no other thread takes any
        function, answer = _calls.get()
        if answer.set_running_or_notify_cancel():
            try:
                answer.set_result(function())
            except BaseException as error:
                answer.set_exception(error)


def stored(path: Path) -> NDArray[np.float32]:
    """Pixels of an image file as they are stored, (height, width, 4), 0..1, lowest row first."""
    image = bpy.data.images.load(str(path))
    try:
        image.colorspace_settings.name = "Non-Color"
        image.alpha_mode = "CHANNEL_PACKED"
        width, height = image.size
        pixels = np.empty((height, width, 4), np.float32)
        image.pixels.foreach_get(pixels.ravel())
    finally:
        bpy.data.images.remove(image)
    return pixels


class BlenderImages(Codec):
    """A codec on Blender's main thread."""

    def decode(self, data: bytes) -> NDArray[np.uint8]:
        """Pixels, (height, width, 4), top row first."""
        return call(partial(self._decode, data))

    def encode(self, pixels: NDArray[np.uint8]) -> bytes:
        """A WebP image of pixels, (height, width, 4); colours of alpha 0 may be lost."""
        return call(partial(self._encode, pixels))

    def _decode(self, data: bytes) -> NDArray[np.uint8]:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "image.webp"
            path.write_bytes(data)
            try:
                pixels = stored(path)
            except RuntimeError as error:
                raise ValueError(str(error).strip()) from error
        if pixels.shape[1::-1] != self.size(data):
            raise ValueError("damaged")
        return np.rint(pixels * 255.0).astype(np.uint8)[::-1]

    def _encode(self, pixels: NDArray[np.uint8]) -> bytes:
        height, width = pixels.shape[:2]
        image = bpy.data.images.new("refine", width, height, alpha=True, is_data=True)
        try:
            image.alpha_mode = "CHANNEL_PACKED"
            image.pixels.foreach_set((pixels[::-1] / np.float32(255.0)).astype(np.float32).ravel())
            image.file_format = "WEBP"
            with tempfile.TemporaryDirectory() as folder:
                path = Path(folder) / "image.webp"
                image.save(filepath=str(path), quality=_LOSSLESS)
                return path.read_bytes()
        finally:
            bpy.data.images.remove(image)
