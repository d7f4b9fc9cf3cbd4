"""The two exceptions that core raises on purpose."""

from __future__ import annotations

import unicodedata

_OBEYED = {"Cc", "Cf", "Cs", "Zl", "Zp"}
"""Categories of characters that a terminal or a panel obeys, or cannot show, and nobody reads."""


def printable(text: str) -> str:
    r"""Return text on one line with control characters escaped, and all else as it is.

    Examples
    --------
    >>> print(printable("in\x1b[2J.ply"))
    in\x1b[2J.ply
    """
    return "".join(
        char.encode("unicode_escape").decode() if unicodedata.category(char) in _OBEYED else char
        for char in text
    )


class RefineError(Exception):
    """Bad input, said in words for the user: file, place, what was got, what was expected."""

    def __str__(self) -> str:
        """Return the words; names in them come from anywhere, so they are made `printable`."""
        return printable(super().__str__())


class Cancelled(Exception):  # noqa: N818 - not an error: somebody asked to stop
    """Raised between two pieces of work when the progress callback returns ``False``."""
