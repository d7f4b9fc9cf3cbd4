"""The command: ``blender -b [scene.blend] --command refine ...``, ``python -m refine_addon ...``.
Both run the same pipeline; only ``--object`` and `scene` need Blender. In order: this file listens
for Ctrl-C, `options` parses, `checks` refuses, `subcommands` works input by input with `run`."""

from __future__ import annotations

import contextlib
import signal  # and nothing that loads NumPy, see `_listening`
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any

_WORDS = {"SIGINT": "cancelled", "SIGTERM": "terminated", "SIGHUP": "hung up"}
REASONS = {getattr(signal, name): words for name, words in _WORDS.items() if hasattr(signal, name)}
"""Name of each signal in messages; Windows lacks the last."""


class Stopped(KeyboardInterrupt):
    """Raised wherever the command is when a signal asks it to stop; holds its number."""


def main(arguments: Sequence[str], *, scene: bool = False, last: bool = False) -> int:
    """Run the command on the words after ``refine``; exit code 0, 1 failed on an input, 2 usage.
    A signal gives 128 and its number. `scene`: whether an open Blender scene has objects and
    cameras. `last`: the process ends afterwards, so late signals are ignored."""
    with _listening(last=last) as raise_now:
        try:
            # Loads all of core, and with it NumPy: a signal waits until that is there.
            from ..core.execute import share_heap
            from . import subcommands

            if last:
                share_heap()
            raise_now()
            return subcommands.run(arguments, scene=scene)
        except KeyboardInterrupt as stop:
            from .run import complain

            # Python's own comes where nobody listens: from a thread, from whoever calls this.
            number = stop.args[0] if isinstance(stop, Stopped) else signal.SIGINT
            told = "".join(f" {note};" for note in getattr(stop, "__notes__", ()))
            complain(f"{REASONS[number]};{told} nothing was left half-written")
            return 128 + number  # as in shells: 130 for Ctrl-C


@contextlib.contextmanager
def _listening(*, last: bool) -> Iterator[Callable[[], None]]:
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


def _stopping() -> bool:
    """Whether `Stopped` is being cleaned up after, which a second one must not stop."""
    error = sys.exception()
    while error is not None and not isinstance(error, Stopped):
        error = error.__context__
    return error is not None
