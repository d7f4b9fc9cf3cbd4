"""The command's output: sentences, errors, progress; none can harm a terminal."""

from __future__ import annotations

import os
import sys
from typing import Literal, TextIO

from ..core.errors import printable, reason_of

_CLEAR = "\r\x1b[K"


def described(error: Exception) -> str:
    """An error's message; for those of the system with the file."""
    file = getattr(error, "filename", None)
    return f"{file}: {error.strerror}" if file else reason_of(error)


def complain(text: str) -> None:
    """Print an error in place of the progress."""
    start = _CLEAR if _is_terminal(sys.stderr) else ""
    _write("stderr", f"{start}refine: error: {printable(text)}\n")


def flush() -> None:
    """Flush argparse's help; its reader may be gone."""
    _write("stdout", "")


class Terminal:
    """Output of a run; `quiet`: errors only."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._draws = not quiet and _is_terminal(sys.stderr)

    def say(self, *lines: str) -> None:
        """Print lines, unless quiet."""
        if not self._quiet:
            _write("stdout", "".join(f"{printable(line)}\n" for line in lines))

    def draw(self, text: str) -> None:
        """Show a line until the next replaces it; on terminals only."""
        if self._draws:
            _write("stderr", f"{_CLEAR}{printable(text)}")

    def clear(self) -> None:
        """Erase the drawn line."""
        self.draw("")


def _is_terminal(stream: TextIO | None) -> bool:
    return stream is not None and stream.isatty()


def _write(name: Literal["stdout", "stderr"], text: str) -> None:
    stream: TextIO | None = getattr(sys, name)
    if stream is None:  # closed before Python began
        return
    try:
        stream.write(text)
        stream.flush()
    except UnicodeEncodeError:  # a name that this terminal's encoding cannot show
        _write(name, text.encode("ascii", "backslashreplace").decode())
    except OSError:
        # Whoever read this has gone, or its disk is full: the work goes on. Python would try once
        # more as it exits, and make that the exit code.
        setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
