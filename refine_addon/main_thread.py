"""Calls that other threads leave to Blender's main thread: only there its data may be touched."""

from __future__ import annotations

import contextlib
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any

from .core.execute import Cancelled, checkpoint

_STEP = 0.1
"""Seconds after which waiting work asks again whether it was cancelled."""

_asked: queue.SimpleQueue[tuple[Callable[[], Any], Future[Any]]] = queue.SimpleQueue()


def call(function: Callable[[], Any]) -> Any:
    """Have the main thread call a function, and return what it returns.

    Called on the main thread, it does so at once; on another, it waits until `serve` has done it.

    Raises
    ------
    Cancelled
        See `execute.checkpoint`. The function may have been called or not.
    Exception
        What the function raises.
    """
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
    """Make the calls that were asked for, in the main thread."""
    with contextlib.suppress(queue.Empty):
        while True:
            function, answer = _asked.get_nowait()
            if not answer.set_running_or_notify_cancel():
                continue
            try:
                answer.set_result(function())
            except BaseException as error:
                answer.set_exception(error)
