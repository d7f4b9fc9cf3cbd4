"""Reading of files, and checks of values, that all camera formats share."""

from __future__ import annotations

import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..place import LARGEST_NUMBER, Place, foreign_kind, refuse_pointer
from ..views import View, is_orthonormal
from ..whole_file import explained, mode_of

SMALLEST_LENGTH = 1e-6  # focal length, px, or scale
LARGEST_SIDE = 1_000_000  # of an image, px
SNIFFED_BYTES = 4096  # read to find out whether a file can be JSON


Pose = tuple[NDArray[np.float64], NDArray[np.float64]]


class CameraPlace(Place):
    """A place in a file of cameras."""

    def positive(self, value: object, what: str) -> float:
        """A number from 1e-6 to 1e18; `what` names it in messages."""
        number = self.number(value)
        if number < SMALLEST_LENGTH:
            self.expected(f"a positive {what}", value)
        return number

    def focal(self, value: object) -> float:
        """A number that can be a focal length in pixels."""
        return self.positive(value, "focal length in pixels")

    def side(self, value: object) -> int:
        """A whole number of pixels, which may be written as 800.0."""
        number = self.number(value)
        if not (number.is_integer() and 1 <= number <= LARGEST_SIDE):
            self.expected(f"a whole number of pixels from 1 to {LARGEST_SIDE}", value)
        return int(number)

    def principal(self, values: Mapping[str, object], size: Sequence[int]) -> list[float]:
        """``cx`` and ``cy`` of a JSON object in pixels; by default the middle of the image."""
        return [
            self.at(repr(key)).number(values.get(key, side / 2))
            for key, side in zip(("cx", "cy"), size, strict=True)
        ]

    def matrix(self, value: object, rows: Sequence[int], columns: int) -> NDArray[np.float64]:
        """A list of rows of numbers as float64; `rows` are the allowed numbers of rows."""
        if not isinstance(value, list) or len(value) not in rows:
            sizes = " or ".join(f"{count} x {columns}" for count in rows)
            self.expected(f"a {sizes} matrix", value)
        table = [self.at(f"row {index}").numbers(row, columns) for index, row in enumerate(value)]
        return np.array(table, np.float64)

    def rotation(self, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
        """The matrix, (3, 3), if it is orthonormal up to `views.ORTHONORMAL`."""
        if not is_orthonormal(matrix):
            self.fail(f"expected an orthonormal rotation, got {np.round(matrix, 6).tolist()}")
        return matrix

    def view(self, name: str, pose: Pose, lens: Sequence[Any]) -> View:
        """View of a camera; characters of `name` that cannot be printed become "?".

        The pose is the rotation, world to camera in the axes of `View`, and the centre; the lens
        two focal lengths, the principal point, and width and height, pixels.
        """
        if np.abs(pose[1]).max() > LARGEST_NUMBER:
            self.fail(f"the camera's centre is farther than 1e18: {pose[1].tolist()}")
        fx, fy, cx, cy, width, height = lens
        printable = name.encode("utf-8", "replace").decode("utf-8")
        try:
            return View(*pose, fx, fy, cx, cy, width, height, name=printable)
        except RefineError as error:
            self.fail(str(error))


def kind_of(path: Path) -> int:
    """Type of `path` (`stat.S_IFMT`), 0 if it does not exist; `RefineError` if unknown."""
    with explained(path, "cannot be read", errors=(OSError, ValueError)):
        return stat.S_IFMT(mode_of(path))


def is_file(path: Path) -> bool:
    """Whether `path` is an existing file; see `kind_of`."""
    return kind_of(path) == stat.S_IFREG


def is_folder(path: Path) -> bool:
    """Whether `path` is an existing folder; see `kind_of`."""
    return kind_of(path) == stat.S_IFDIR


@contextmanager
def opened(place: Place) -> Iterator[tuple[BinaryIO, bytes]]:
    """Open a file; yields it with its first bytes. Refuses empty files and LFS pointers."""
    reading = explained(place.path, "cannot be read", errors=(OSError, ValueError))
    with reading, place.path.open("rb") as stream:
        head = stream.read(SNIFFED_BYTES)
        if not head:
            place.fail("the file is empty, expected cameras")
        refuse_pointer(place.path, head)
        stream.seek(0)
        yield stream, head


def read_json(path: Path) -> object:
    """Parsed content of a JSON file in UTF-8; `RefineError` with line and column if it is none."""
    place = Place(path)
    with opened(place) as (stream, head):
        if head[:1] not in b"{[\xef \t\r\n":  # so that a large splat file is not read
            problem = foreign_kind(path, head) or (
                "expected JSON (cameras.json, transforms.json) "
                f"or a COLMAP model, got a file that starts with {head[:8]!r}"
            )
            place.fail(f"not a camera file: {problem}")
        text = stream.read()
    if not text.strip():
        place.fail("the file is empty, expected cameras")
    return place.parsed(text)
