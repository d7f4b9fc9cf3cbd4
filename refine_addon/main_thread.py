"""Calls that other threads leave to Blender's main thread: only there its data may be touched."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any

from .core.execute import Cancelled, checkpoint

_STEP = 0.1  # Seconds between two checks of waiting work for cancelling

_asked: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = queue.SimpleQueue()


def call(function: Callable[[], Any]) -> Any:
    """Call a function on the main thread, at once or when `serve` runs; its result.
    Raises its error, or `Cancelled`, when it may have been called or not."""
    if threading.current_thread() is threading.main_thread():
        return function()
    answer: Future[Any] = Future()
    _asked.put((function, answer))
    while not wait([answer], _STEP).done:
        try:
            checkpoint()
        except Cancelled:
            answer.cancel()
            raise
    return answer.result()


def serve() -> None:
    """Run the waiting calls on the main thread."""
    with contextlib.suppress(queue.Empty):
        while True:
            function, answer = _asked.get_nowait()
            if not answer.set_running_or_notify_cancel():
                continue
            try:
                answer.set_result(function())
            except BaseException as error:
                answer.set_exception(error)
