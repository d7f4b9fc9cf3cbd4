"""The two exceptions that core raises on purpose."""

from __future__ import annotations


class RefineError(Exception):
    """Bad input, said in words for the user: file, place, what was got, what was expected."""


class Cancelled(Exception):  # noqa: N818 - not an error: somebody asked to stop
    """Raised between two pieces of work when the progress callback returns ``False``."""
