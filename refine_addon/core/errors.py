"""`RefineError`, for bad input, and texts for messages; the other exception is `Cancelled`."""

from __future__ import annotations

import unicodedata

_OBEYED = {"Cc", "Cf", "Cs", "Zl", "Zp"}
"""Unicode categories of control characters and of characters that cannot be shown."""


def printable(text: str) -> str:
    r"""Text on one line, with control characters escaped.

    >>> print(printable("in\x1b[2J.ply"))
    in\x1b[2J.ply
    """
    return "".join(
        char.encode("unicode_escape").decode() if unicodedata.category(char) in _OBEYED else char
        for char in text
    )


def reason_of(error: Exception) -> str:
    """Why the system refuses, such as "Permission denied"."""
    return getattr(error, "strerror", None) or str(error) or type(error).__name__


def described(error: Exception) -> str:
    """An error as a sentence, with the file if the system raised it."""
    if isinstance(error, MemoryError):
        return f"not enough memory ({error})" if str(error) else "not enough memory"
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return reason_of(error)


class RefineError(Exception):
    """Bad input. The message is for the user: file, place, what was got, what was expected."""

    def __str__(self) -> str:
        """Message made `printable`, since it may hold names out of files."""
        return printable(super().__str__())
