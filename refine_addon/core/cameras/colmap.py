"""COLMAP sparse models, text and binary: ``cameras`` and ``images`` of a folder.

The formats are described in COLMAP's "Output Format" page, the camera models in its
``src/colmap/sensor/models``. Poses are world to camera, quaternions Hamilton (w, x, y, z), axes
x right, y down, z forward. The upper left corner of the image is at (0, 0), the centre of its first
pixel at (0.5, 0.5). `View` has the same conventions, so only the camera's centre is computed. Newer
models also have files ``rigs`` and ``frames``; ``images`` still holds every pose.
"""

from __future__ import annotations

import codecs
import mmap
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from ..errors import reason_of
from ..foreign_files import refuse_pointer
from ..splats import rotation_matrices
from ..views import View, ViewSet
from .lenses import MODELS, MODELS_BY_NAME, Model, counted, lens_note
from .place import CameraPlace, is_file

SUFFIXES = (".bin", ".txt")
"""Binary files are preferred, as in COLMAP itself."""

MODEL_FILES = ("cameras", "images", "points3D", "rigs", "frames")
"""Names, without suffix, of the files that a model may consist of."""

POINT_BYTES = 24
"""Size of an observation in ``images.bin``: x, y (doubles) and the point's id (64 bit)."""

IMAGE_FIELDS = 10
"""Number of IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME."""

SHORT_LINE = 400
"""Only lines of points below this many bytes are checked: if the line of points is missing, the
short line of the next image is in its place."""


@dataclass(frozen=True)
class Lens:
    """A COLMAP camera as a pinhole, and whether it has distortion that is ignored."""

    model: Model
    focal: tuple[float, float]
    principal: tuple[float, float]
    size: tuple[int, int]
    distorted: bool


@dataclass(frozen=True)
class Image:
    """A registered image: its pose, world to camera, and its place in the file."""

    place: CameraPlace
    image_id: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    camera_id: int
    name: str


def find_colmap(folder: Path) -> tuple[Path, str] | None:
    """Return the folder of a model and the suffix to read, or ``None``.

    Looks in the folder itself, then ``sparse/0``, ``sparse`` and ``colmap/sparse/0``.

    Parameters
    ----------
    folder : Path
        A model's folder or a project's.
    """
    for place in (".", "sparse/0", "sparse", "colmap/sparse/0"):
        for suffix in SUFFIXES:
            if all(is_file(folder / place / f"{stem}{suffix}") for stem in MODEL_FILES[:2]):
                return folder / place, suffix
    return None


def read_colmap(folder: Path, suffix: str) -> ViewSet:
    """Return the views of a COLMAP model, sorted by image name.

    COLMAP writes images in the order of registration or of a hash, which may differ between text
    and binary. The 3DGS loader sorts them by name, too.

    Parameters
    ----------
    folder : Path
        The folder of ``cameras`` and ``images``.
    suffix : str
        ``".bin"`` or ``".txt"``.

    Raises
    ------
    RefineError
        If a file is missing, truncated or wrong; with the byte or the line.
    """
    cameras, images = folder / f"cameras{suffix}", folder / f"images{suffix}"
    if suffix == ".bin":
        lenses, registered = _binary_cameras(cameras), _binary_images(images)
    else:
        lenses, registered = _text_cameras(cameras), _text_images(images)
    if not registered:
        CameraPlace(images).fail("no registered image, expected at least one")
    for image in registered:
        if image.camera_id not in lenses:
            image.place.fail(
                f"refers to camera {image.camera_id}, expected one of the {len(lenses)} "
                f"in {cameras.name}"
            )
    registered.sort(key=lambda image: (image.name, image.image_id))
    views = tuple(_view(image, lenses[image.camera_id]) for image in registered)
    used = (lenses[camera_id] for camera_id in sorted({image.camera_id for image in registered}))
    counts = Counter(lens.model for lens in used if lens.distorted)
    return ViewSet(views, lens_note(counts, "camera"))


def _view(image: Image, lens: Lens) -> View:
    """Return the view of an image."""
    if not any(image.quaternion):
        image.place.fail("expected a quaternion (w, x, y, z) of a rotation, got all zeros")
    rotation = rotation_matrices(np.array(image.quaternion))
    center = -rotation.T @ np.array(image.translation)
    return image.place.view(image.name, rotation, center, lens.focal, lens.principal, lens.size)


def _lens(
    place: CameraPlace, model: Model, size: Sequence[object], values: Sequence[object]
) -> Lens:
    """Return the lens of a camera model, image size and parameters."""
    if not model.focals:
        place.fail(f"camera model {model.name} is a panorama, expected one with a focal length")
    width, height = (
        place.at(key).side(side) for key, side in zip(("width", "height"), size, strict=True)
    )
    numbers = [place.at(f"parameter {index}").number(item) for index, item in enumerate(values)]
    fx, fy = (place.at("focal length").focal(numbers[index]) for index in (0, model.focals - 1))
    cx, cy, *distortion = numbers[model.focals :]
    if model.name == "EUCM":
        distortion = distortion[:1]  # with alpha = 0 it is a pinhole for every beta
    distorted = model.fisheye or any(distortion)
    return Lens(model, (fx, fy), (cx, cy), (width, height), distorted)


class _Binary:
    """A little-endian file, read from start to end; refused where it is truncated."""

    def __init__(self, path: Path) -> None:
        self.file = CameraPlace(path)
        self.offset = 0
        try:
            with path.open("rb") as stream:
                self.size = stream.seek(0, 2)
                if not self.size:
                    self.file.fail("the file is empty, expected a COLMAP model")
                # Memory-mapped, since images.bin is mostly observations, which are skipped.
                self.data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
                refuse_pointer(path, self.data[:SHORT_LINE])
        except (OSError, ValueError) as error:
            self.file.fail(f"cannot be read ({reason_of(error)})")

    def take(self, layout: str, what: str) -> tuple[Any, ...]:
        """Return the next values, of a `struct` layout."""
        start = self.skip(struct.calcsize(f"<{layout}"), what)
        return struct.unpack_from(f"<{layout}", self.data, start)

    def skip(self, count: int, what: str) -> int:
        """Skip `count` bytes; return where they start."""
        start = self.offset
        if count > self.size - start:
            self.truncated(what, f"expected {count} more bytes")
        self.offset += count
        return start

    def name(self, what: str) -> str:
        """Return the next text, which ends with a zero byte."""
        end = self.data.find(b"\0", self.offset)
        if end < 0:
            self.truncated(what, "expected a zero byte after the name")
        raw = self.data[self.offset : end]
        self.offset = end + 1
        return raw.decode("utf-8", "replace")

    def count(self, what: str, least: int) -> int:
        """Return the next count of things that take at least `least` bytes each."""
        (count,) = self.take("Q", f"number of {what}s")
        if count * least > self.size - self.offset:
            self.truncated(
                f"number of {what}s",
                f"{count} of at least {least} bytes each are announced",
            )
        return int(count)

    def end(self, what: str, count: int) -> None:
        """Refuse bytes after the last of `count` things: the file holds more than it announces."""
        left = self.size - self.offset
        if left:
            self.file.at(f"byte {self.offset}").fail(
                f"expected the end of the file after {counted(count, what)}, got {left} more bytes"
            )

    def truncated(self, what: str, expected: str) -> NoReturn:
        """Raise the error of a file that ends early."""
        left = self.size - self.offset
        self.file.at(f"byte {self.offset}").fail(f"truncated: {what}: {expected}, got {left}")


def _binary_cameras(path: Path) -> dict[int, Lens]:
    """Return the lenses of ``cameras.bin`` by their id."""
    data = _Binary(path)
    with data.data:
        lenses: dict[int, Lens] = {}
        for row in range(data.count("camera", 24 + 8 * 2)):
            place = data.file.at(f"camera row {row} at byte {data.offset}")
            camera_id, model_id, *size = data.take("IiQQ", f"camera row {row}")
            if model_id not in MODELS:
                place.fail(f"unknown camera model {model_id}, expected 0 to {max(MODELS)}")
            model = MODELS[model_id]
            values = data.take(f"{model.count}d", f"parameters of camera row {row}")
            _add(lenses, place, camera_id, _lens(place, model, size, values))
        data.end("camera", len(lenses))
        return lenses


def _binary_images(path: Path) -> list[Image]:
    """Return the images of ``images.bin``."""
    data = _Binary(path)
    with data.data:
        images: list[Image] = []
        for row in range(data.count("image", 73)):
            place = data.file.at(f"image row {row} at byte {data.offset}")
            image_id, *pose, camera_id = data.take("I7dI", f"image row {row}")
            name = data.name(f"name of image row {row}")
            (points,) = data.take("Q", f"number of points of image row {row}")
            data.skip(points * POINT_BYTES, f"{points} points of image row {row}")
            images.append(_image(place, image_id, pose, camera_id, name))
        data.end("image", len(images))
        return images


def _lines(path: Path) -> Iterator[tuple[CameraPlace, bytes]]:
    """Yield the lines of a text file, each with its place, without comments."""
    file = CameraPlace(path)
    empty = True
    try:
        with path.open("rb") as stream:
            for number, text in enumerate(stream, 1):
                line = text.strip()
                if number == 1:
                    refuse_pointer(path, line)
                    line = line.removeprefix(codecs.BOM_UTF8)
                empty = empty and not line
                if not line.startswith(b"#"):
                    yield file.at(f"line {number}"), line
    except (OSError, ValueError) as error:
        file.fail(f"cannot be read ({reason_of(error)})")
    if empty:
        file.fail("the file is empty, expected a COLMAP model")


def _text_cameras(path: Path) -> dict[int, Lens]:
    """Return the lenses of ``cameras.txt`` by their id."""
    lenses: dict[int, Lens] = {}
    for place, line in _lines(path):
        if not line:
            continue
        fields = line.decode("utf-8", "replace").split()
        name = fields[1] if len(fields) > 1 else ""
        model = MODELS_BY_NAME.get(name)
        if model is None:
            place.fail(f"unknown camera model {name[:40]!r}, expected {', '.join(MODELS_BY_NAME)}")
        numbers = [_parsed(place, field) for field in fields[2:]]
        if len(numbers) != 2 + model.count:
            place.fail(
                f"expected width, height and {model.count} parameters of {model.name}, "
                f"got {len(numbers)} numbers"
            )
        lens = _lens(place, model, numbers[:2], numbers[2:])
        _add(lenses, place, _whole(place, "CAMERA_ID", fields[0]), lens)
    return lenses


def _text_images(path: Path) -> list[Image]:
    """Return the images of ``images.txt``."""
    images: list[Image] = []
    lines = _lines(path)
    for place, line in lines:
        if not line:
            continue
        fields = line.decode("utf-8", "replace").split(maxsplit=IMAGE_FIELDS - 1)
        where = place.at(f"image row {len(images)}")
        if len(fields) < IMAGE_FIELDS:
            where.fail(
                "expected IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, "
                f"got {len(fields)} fields"
            )
        pose = [_parsed(where, field) for field in fields[1:8]]
        image_id = _whole(where, "IMAGE_ID", fields[0])
        camera_id = _whole(where, "CAMERA_ID", fields[8])
        images.append(_image(where, image_id, pose, camera_id, fields[9]))
        place, points = next(lines, (place, b""))
        if len(points) < SHORT_LINE and len(points.split()) % 3:
            place.fail(
                f"expected the points of image row {len(images) - 1} as X, Y, POINT3D_ID each "
                "(an image takes two lines, of which the second may be empty)"
            )
    return images


def _image(
    place: CameraPlace, image_id: int, pose: Sequence[object], camera_id: int, name: str
) -> Image:
    numbers = [
        place.at(key).number(value)
        for key, value in zip(("QW", "QX", "QY", "QZ", "TX", "TY", "TZ"), pose, strict=True)
    ]
    return Image(place, image_id, tuple(numbers[:4]), tuple(numbers[4:]), camera_id, name)


def _add(lenses: dict[int, Lens], place: CameraPlace, camera_id: int, lens: Lens) -> None:
    """Add a lens; refuse an id that is there already."""
    if camera_id in lenses:
        place.fail(f"camera {camera_id} is there twice, expected each id once")
    lenses[camera_id] = lens


def _parsed(place: CameraPlace, field: str) -> float:
    try:
        return float(field)
    except ValueError:
        place.fail(f"expected a number, got {field[:40]!r}")


def _whole(place: CameraPlace, key: str, field: str) -> int:
    try:
        return int(field)
    except ValueError:
        place.fail(f"{key}: expected a whole number, got {field[:40]!r}")
