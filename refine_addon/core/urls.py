"""Addresses of files that are not paths: URLs, which fsspec opens for tiles."""

from __future__ import annotations

import re
from pathlib import Path, PurePosixPath

from .errors import RefineError

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.:-]+://")
"""A scheme has two letters at least: one would be a drive of Windows."""


class Url(str):
    """The address of a file or folder, such as ``s3://bucket/a.ply``.

    It has what a `Path` tells without looking at the disk.
    """

    __slots__ = ()

    @property
    def name(self) -> str:
        """What stands behind the last slash; of ``https:`` without a query."""
        whole = self.partition("?")[0] if self.startswith("http") else self
        return whole.rpartition("/")[2]

    @property
    def suffix(self) -> str:
        """The ending of the name, with its dot; "" if it has none."""
        return PurePosixPath(self.name).suffix

    def __truediv__(self, name: str) -> Url:
        """Return the address of a file in this folder."""
        return Url(f"{self}{'' if self.endswith('/') else '/'}{name}")


def is_url(text: Path | str) -> bool:
    """Return whether this is a URL and no path."""
    return isinstance(text, str) and _URL.match(text) is not None


def refuse_url(text: Path | str) -> None:
    """Raise `RefineError` if a URL stands where only a path can."""
    if is_url(text):
        raise RefineError(
            f"{text}: is a URL, expected a local path; only the tiles and the folder of "
            "'prune --together' can be URLs"
        )
