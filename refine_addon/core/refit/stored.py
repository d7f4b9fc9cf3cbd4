"""Arrays in a file that no memory is needed for until they are asked for."""

from __future__ import annotations

import math
import os
import tempfile
import threading
import weakref
from collections.abc import Callable
from contextlib import suppress
from typing import IO, Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

Item = TypeVar("Item")

HELD = 1 << 23
"""So many bytes stay in memory; small scenes need no file."""

_ALIGNED = 8  # bytes, so that arrays can be used where they were read


class Stored(Generic[Item]):
    """Objects whose attributes are arrays alone, most of them in a file.

    The first of them, up to `HELD` bytes, stay in memory, and so does what the file has no room
    for. One of the file is read whenever it is asked for. The file goes with this object.

    Parameters
    ----------
    make : callable
        Makes such an object of its arrays, by name.
    """

    def __init__(self, make: Callable[..., Item]) -> None:
        self._make, self._held = make, 0
        self._places: list[Item | _Place] = []
        self._file: IO[bytes] | None = None
        self._lock = threading.Lock()

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._places)

    def append(self, item: Item) -> None:
        """Add one."""
        place: Item | _Place = item
        size = sum(array.nbytes for array in vars(item).values())
        if self._held + size > HELD:
            with suppress(OSError):
                place = self._written(vars(item))
        if place is item:
            self._held += size
        self._places.append(place)

    def __getitem__(self, number: int) -> Item:
        """Return one of them, equal to the bit. Any thread can."""
        place = self._places[number]
        if not isinstance(place, _Place):
            return place
        assert self._file is not None
        with self._lock:
            self._file.seek(place.start)
            read = np.frombuffer(self._file.read(place.size), np.uint8)
        arrays, start = {}, 0
        for name, (shape, dtype) in place.arrays.items():
            end = start + math.prod(shape) * dtype.itemsize
            arrays[name] = read[start:end].view(dtype).reshape(shape)
            start = end + -end % _ALIGNED
        return self._make(**arrays)

    def _written(self, arrays: dict[str, NDArray[Any]]) -> _Place:
        """Write arrays to the end of the file, one after the other."""
        if self._file is None:
            # Without a buffer, so that nothing is left to be written when it closes.
            self._file = tempfile.TemporaryFile("w+b", 0, prefix="refine-")  # noqa: SIM115
            weakref.finalize(self, self._file.close)
        start = self._file.seek(0, os.SEEK_END)
        start += self._file.write(bytes(-start % _ALIGNED))  # behind what had no room
        pieces = (array.tobytes() + bytes(-array.nbytes % _ALIGNED) for array in arrays.values())
        size = sum(array.nbytes + -array.nbytes % _ALIGNED for array in arrays.values())
        if self._file.write(b"".join(pieces)) != size:
            raise OSError
        told = {name: (array.shape, array.dtype) for name, array in arrays.items()}
        return _Place(start, size, told)


class _Place(NamedTuple):
    """From which byte of a file on arrays lie, in how many bytes, and shape and type of each."""

    start: int
    size: int
    arrays: dict[str, tuple[tuple[int, ...], np.dtype[Any]]]
