"""Signals that ask to stop: Ctrl-C, a polite kill, a closed terminal."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

_WORDS = {"SIGINT": "cancelled", "SIGTERM": "terminated", "SIGHUP": "hung up"}
REASONS = {getattr(signal, name): words for name, words in _WORDS.items() if hasattr(signal, name)}
"""Name of each signal in messages; Windows lacks the last."""


class Stopped(KeyboardInterrupt):
    """Raised wherever the command is when a signal asks it to stop; holds its number."""


@contextlib.contextmanager
def listening(*, last: bool) -> Iterator[Callable[[], None]]:
    """Handle signals not ignored, and restore them, or ignore them if `last`.
    Yields a function; signals before its call wait for it: an exception amid an import can get
    lost, or come out as NumPy's advice on a broken NumPy."""
    arrived: list[int] = []
    before: dict[int, Any] = {}
    raises = False

    def raise_now() -> None:
        nonlocal raises
        raises = True
        if arrived:
            raise Stopped(arrived[0])

    def arrive(number: int, _frame: Any) -> None:
        arrived.append(number)
        if raises and not _stopping():
            raise_now()

    try:
        # On another thread Python allows no handlers.
        main = threading.current_thread() is threading.main_thread()
        for number in REASONS if main else ():
            if signal.getsignal(number) is not signal.SIG_IGN:
                # None: Blender's own for Ctrl-C, which Python cannot set again. It only asks for a
                # second Ctrl-C to end Blender, as the default does at the first.
                before[number] = signal.signal(number, arrive) or signal.SIG_DFL
        yield raise_now
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_IGN if last else handler)


def reason_and_code(stop: KeyboardInterrupt) -> tuple[str, int]:
    """What stopped the command, and its exit code as in shells: 130 for Ctrl-C."""
    # Python's own comes where nobody listens: from a thread, from whoever calls `main`.
    number = stop.args[0] if isinstance(stop, Stopped) else signal.SIGINT
    return REASONS[number], 128 + number


def _stopping() -> bool:
    """Whether `Stopped` is being cleaned up after, which a second one must not stop."""
    error = sys.exception()
    while error is not None and not isinstance(error, Stopped):
        error = error.__context__
    return error is not None
