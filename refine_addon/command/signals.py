"""Signals that ask to stop: Ctrl-C, a polite kill, a terminal that was closed."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from types import FrameType
from typing import Any, Self

REASONS = {"SIGINT": "cancelled", "SIGTERM": "terminated", "SIGHUP": "hung up"}
"""What each signal is called in a message; Windows lacks the last."""


class Stopped(KeyboardInterrupt):
    """Raised wherever the command is when a signal asks it to stop.

    Attributes
    ----------
    number : int
        The signal's.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


class Listener:
    """Turns signals into `Stopped` while it is entered, and gives them back afterwards.

    At first a signal waits: an exception amid an import can get lost (in a callback of the garbage
    collector's) or come out as another (NumPy's says that NumPy is broken). From `interrupt` on
    one raises at once, so that everything open is closed and removed on the way out.

    Parameters
    ----------
    last : bool
        Whether nothing comes afterwards: then signals are ignored from there on, not given back.
    """

    def __init__(self, *, last: bool = False) -> None:
        self._last = last
        self._arrived: int | None = None
        self._waits = True
        self._before: dict[int, Any] = {}
        # Python calls handlers in the order of numbers. A pipe tells which signal came first.
        self._pipe: tuple[int, int] | None = None
        self._wakeup_before = -1

    def __enter__(self) -> Self:
        """Listen, to what is not ignored; on the main thread, where Python delivers signals."""
        if threading.current_thread() is threading.main_thread():
            if os.name == "posix":
                self._pipe = os.pipe()
                for end in self._pipe:
                    os.set_blocking(end, False)
                self._wakeup_before = signal.set_wakeup_fd(self._pipe[1], warn_on_full_buffer=False)
            for number in (getattr(signal, name, None) for name in REASONS):
                if number and signal.getsignal(number) is not signal.SIG_IGN:
                    before = signal.signal(number, self._arrive)
                    # None: Blender's own for Ctrl-C, which Python cannot set again. It only asks
                    # for a second Ctrl-C to end Blender, as the default does at the first.
                    self._before[number] = signal.SIG_DFL if before is None else before
        return self

    def __exit__(self, *_: object) -> None:
        """Let whoever listened before listen again; nobody if this was the last."""
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_IGN if self._last else handler)
        if self._pipe is not None:
            signal.set_wakeup_fd(self._wakeup_before)
            for end in self._pipe:
                os.close(end)

    def interrupt(self) -> None:
        """Raise at once from here on; also for a signal that came already."""
        self._waits = False
        if self._arrived is not None:
            raise Stopped(self._arrived)

    def wait(self) -> None:
        """Raise no more: what comes now comes too late."""
        self._waits = True

    def _arrive(self, number: int, _frame: FrameType | None) -> None:
        if self._arrived is None:
            self._arrived = self._first(number)
        if not self._waits and not _stopping():
            raise Stopped(self._arrived)

    def _first(self, number: int) -> int:
        """Return which signal came first; `number` where the system does not tell."""
        if self._pipe is None:
            return number
        with contextlib.suppress(BlockingIOError):
            return next((n for n in os.read(self._pipe[0], 64) if n in self._before), number)
        return number


def reason(stop: KeyboardInterrupt) -> str:
    """Return what stopped the command, for a message."""
    return REASONS[signal.Signals(_number(stop)).name]


def exit_code(stop: KeyboardInterrupt) -> int:
    """Return the exit code by which a shell says the same: 130 for Ctrl-C."""
    return 128 + _number(stop)


def _number(stop: KeyboardInterrupt) -> int:
    # Python's own comes where nobody listens: from a thread, from whoever calls `main`.
    return stop.number if isinstance(stop, Stopped) else signal.SIGINT


def _stopping() -> bool:
    """Return whether what runs now is cleaning up after `Stopped`, which a second must not stop."""
    error = sys.exception()
    while error is not None and not isinstance(error, Stopped):
        error = error.__context__
    return error is not None
