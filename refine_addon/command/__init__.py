"""The command: ``blender -b [scene.blend] --command refine ...``, ``python -m refine_addon ...``.
Both do the same; only ``--object``, ``--source`` and ``render`` need Blender. This file handles
Ctrl-C, `options` parses, `checks` refuses, and `subcommands` does each input's work with `run`."""

from __future__ import annotations

import contextlib
import signal  # and nothing that loads NumPy, see `_listening`
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

_WORDS = {"SIGINT": "cancelled", "SIGTERM": "terminated", "SIGHUP": "hung up"}
REASONS = {getattr(signal, name): words for name, words in _WORDS.items() if hasattr(signal, name)}
"""Signal -> what it did, in messages; Windows lacks SIGHUP."""


class Stopped(KeyboardInterrupt):
    """Raised by a signal that stops the command; its argument is the signal's number."""


def main(arguments: Sequence[str], *, scene: bool = False, last: bool = False) -> int:
    """Run the command on the words after ``refine``. Exit codes: 0 done, 1 failed, 2 wrong usage,
    128 + n stopped by signal n. `scene`: Blender is there, with an open scene. `last`: the process
    ends afterwards, so later signals are ignored."""
    with _listening(last=last) as raise_now:
        try:
            # These load NumPy; signals wait until that is done.
            from ..core.execute import share_heap
            from . import subcommands

            if last:
                share_heap()
            raise_now()
            return subcommands.run(arguments, scene=scene)
        except KeyboardInterrupt as stop:
            from .run import complain

            # A plain KeyboardInterrupt comes from a caller's handler, or on another thread.
            number = stop.args[0] if isinstance(stop, Stopped) else signal.SIGINT
            notes = "".join(f" {note};" for note in getattr(stop, "__notes__", ()))
            complain(f"{REASONS[number]};{notes} nothing was left half-written")
            return 128 + number  # as in shells: 130 for Ctrl-C


@contextlib.contextmanager
def _listening(*, last: bool) -> Iterator[Callable[[], None]]:
    """Handle signals that are not ignored; afterwards restore the handlers, or ignore if `last`.
    Yields a function that makes signals raise, also those before its call: an exception during an
    import can get lost, or become NumPy's message about a broken installation."""
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
        # Python allows handlers on the main thread only.
        main = threading.current_thread() is threading.main_thread()
        for number in REASONS if main else ():
            if signal.getsignal(number) is not signal.SIG_IGN:
                # None: a handler that is not Python's, as Blender's for Ctrl-C. Python cannot set
                # it again; the default ends Blender at the first Ctrl-C, Blender's at the second.
                before[number] = signal.signal(number, arrive) or signal.SIG_DFL
        yield raise_now
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_IGN if last else handler)


def _stopping() -> bool:
    """Whether a `Stopped` is being handled; a second one must not interrupt its cleaning up."""
    error = sys.exception()
    while error is not None and not isinstance(error, Stopped):
        error = error.__context__
    return error is not None
