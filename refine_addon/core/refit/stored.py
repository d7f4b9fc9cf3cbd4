"""Objects in a temporary file that no memory is needed for until they are asked for."""

from __future__ import annotations

import os
import pickle
import tempfile
import threading
import weakref
from contextlib import suppress
from typing import IO, Any

HELD = 1 << 23
"""So many bytes stay in memory; small scenes need no file."""


class Stored:
    """A list of objects, most of them in a file, which goes with this list.

    The first of them, up to `HELD` bytes, stay in memory, and so does what the file has no room
    for. One of the file is read whenever it is asked for.
    """

    def __init__(self) -> None:
        self._held = 0
        self._places: list[bytes | tuple[int, int]] = []  # or start and end in the file
        self._file: IO[bytes] | None = None
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """How many there are."""
        return len(self._places)

    def append(self, item: Any) -> None:
        """Add one."""
        told: bytes = pickle.dumps(item, 5)
        place: bytes | tuple[int, int] = told
        if self._held + len(told) > HELD:
            with suppress(OSError):
                place = self._written(told)
        if place is told:
            self._held += len(told)
        self._places.append(place)

    def __getitem__(self, number: int) -> Any:
        """One of them, equal to the bit. Any thread can ask."""
        place = self._places[number]
        if isinstance(place, tuple):
            assert self._file is not None
            start, end = place
            with self._lock:
                self._file.seek(start)
                place = self._file.read(end - start)
        return pickle.loads(place)

    def _written(self, told: bytes) -> tuple[int, int]:
        """Write to the end of the file; return where."""
        if self._file is None:
            # Without a buffer, so that nothing is left to be written when it closes.
            self._file = tempfile.TemporaryFile("w+b", 0, prefix="refine-")  # noqa: SIM115
            weakref.finalize(self, self._file.close)
        start = self._file.seek(0, os.SEEK_END)
        if self._file.write(told) != len(told):
            raise OSError
        return start, start + len(told)
