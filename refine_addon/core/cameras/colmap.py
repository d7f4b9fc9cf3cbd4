"""COLMAP sparse models, text and binary: ``cameras`` and ``images`` of a folder.

See COLMAP's "Output Format" and ``src/colmap/sensor/models``. Poses are world to camera,
quaternions w x y z, axes x right, y down, z forward, pixel centres at 0.5: as in `View`. Newer
models add ``rigs`` and ``frames``; ``images`` still holds every pose.
"""

from __future__ import annotations

import codecs
import contextlib
import struct
from collections import Counter
from collections.abc import Generator, Iterator, Mapping, Sequence
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np

from ..splats import rotation_matrices
from ..views import ViewSet
from .place import CameraPlace, is_file, opened

SUFFIXES = (".bin", ".txt")  # binary files are preferred, as in COLMAP itself
MODEL_FILES = ("cameras", "images", "points3D", "rigs", "frames")  # without suffix
POINT_BYTES = 24  # an observation in ``images.bin``: x, y (doubles), point id (64 bit)
POSE = ("QW", "QX", "QY", "QZ", "TX", "TY", "TZ")
IMAGE_FIELDS = ("IMAGE_ID", *POSE, "CAMERA_ID", "NAME")

SHORT_LINE = 400
"""Bytes from which on a line is not checked to hold points. If a file lacks these lines, the next
image stands there, and its line is shorter."""


class Model(NamedTuple):
    """A camera model, whose parameters are the focal lengths, cx, cy, then those of distortion."""

    name: str  # as in ``cameras.txt``
    focals: int  # number: 2, 1 if fx = fy, 0 for a panorama
    parameters: int  # number

    @property
    def fisheye(self) -> bool:
        """Whether the distance from the centre grows with the angle, not its tangent."""
        return "FISHEYE" in self.name


_MODELS = """
SIMPLE_PINHOLE 1 3, PINHOLE 2 4, SIMPLE_RADIAL 1 4, RADIAL 1 5, OPENCV 2 8, OPENCV_FISHEYE 2 8,
FULL_OPENCV 2 12, FOV 2 5, SIMPLE_RADIAL_FISHEYE 1 4, RADIAL_FISHEYE 1 5, THIN_PRISM_FISHEYE 2 12,
RAD_TAN_THIN_PRISM_FISHEYE 2 16, SIMPLE_DIVISION 1 4, DIVISION 2 5, SIMPLE_FISHEYE 1 3, FISHEYE 2 4,
EUCM 2 6, EQUIRECTANGULAR 0 2"""
MODELS = [Model(name, int(f), int(p)) for name, f, p in map(str.split, _MODELS.split(","))]
"""By number in ``cameras.bin``."""

MODELS_BY_NAME = {model.name: model for model in MODELS}


def counted(count: int, thing: str) -> str:
    """A count and a noun, with a plural s if the count is not 1."""
    return f"{count} {thing}" if count == 1 else f"{count} {thing}s"


def lens_note(counts: Mapping[Model, int], thing: str) -> str:
    """Note on lenses that are no pinholes, counted by model, or ""; `thing` names what has one."""
    ways = (
        "distortion of {} ignored (model {})",
        "{} (fisheye, {}) taken as pinhole: wrong away from the centre",
    )
    each = counts.items()
    return "; ".join(ways[m.fisheye].format(counted(count, thing), m.name) for m, count in each)


def find_colmap(folder: Path) -> tuple[Path, str] | None:
    """Folder of a model (this, sparse/0, sparse or colmap/sparse/0) and its suffix, or None."""
    for place in (".", "sparse/0", "sparse", "colmap/sparse/0"):
        for suffix in SUFFIXES:
            if all(is_file(folder / place / f"{stem}{suffix}") for stem in MODEL_FILES[:2]):
                return folder / place, suffix
    return None


def read_colmap(folder: Path, suffix: str) -> ViewSet:
    """Views of a COLMAP model, sorted by image name, as text and binary may differ in order."""
    cameras, images = (CameraPlace(folder / f"{stem}{suffix}") for stem in MODEL_FILES[:2])
    binary, text = (_binary_cameras, _binary_images), (_text_cameras, _text_images)
    read_cameras, read_images = binary if suffix == ".bin" else text
    lenses: dict[int, tuple[Any, ...]] = {}
    for place, camera_id, lens in read_cameras(cameras):
        if camera_id in lenses:
            place.fail(f"camera {camera_id} is there twice, expected each id once")
        lenses[camera_id] = lens
    registered = sorted(read_images(images), key=lambda image: image[:2])
    if not registered:
        images.fail("no registered image, expected at least one")
    views = []
    for name, _, place, values, camera_id in registered:
        if camera_id not in lenses:
            wanted = f"one of the {len(lenses)} in {cameras.path.name}"
            place.fail(f"refers to camera {camera_id}, expected {wanted}")
        pose = [place.at(key).number(value) for key, value in zip(POSE, values, strict=True)]
        if not any(pose[:4]):
            place.fail("expected a quaternion (w, x, y, z) of a rotation, got all zeros")
        rotation = rotation_matrices(np.array(pose[:4]))
        center = -rotation.T @ np.array(pose[4:])
        views.append(place.view(name, (rotation, center), lenses[camera_id][1:]))
    used = sorted({camera_id for *_, camera_id in registered})
    counts = Counter(model for number in used if (model := lenses[number][0]))
    return ViewSet(tuple(views), lens_note(counts, "camera"))


def _lens(place: CameraPlace, model: Model, size: Sequence[Any], values: Sequence[Any]) -> Any:
    """A COLMAP camera as a pinhole, and its model if it has distortion, which is ignored."""
    if not model.focals:
        place.fail(f"camera model {model.name} is a panorama, expected one with a focal length")
    sides = [place.at(key).side(side) for key, side in zip(("width", "height"), size, strict=True)]
    numbers = [place.at(f"parameter {index}").number(item) for index, item in enumerate(values)]
    focal = [place.at("focal length").focal(numbers[index]) for index in (0, model.focals - 1)]
    cx, cy, *distortion = numbers[model.focals :]
    if model.name == "EUCM":
        distortion = distortion[:1]  # with alpha = 0 it is a pinhole for every beta
    return model if model.fisheye or any(distortion) else None, *focal, cx, cy, *sides


class _Binary(NamedTuple):
    """A little-endian file, read from start to end; `RefineError` where it is truncated."""

    file: CameraPlace
    data: mmap

    def take(self, layout: str, what: str) -> tuple[Any, ...]:
        start = self.skip(struct.calcsize(f"<{layout}"), what)
        return struct.unpack_from(f"<{layout}", self.data, start)

    def skip(self, count: int, what: str) -> int:
        start = self.data.tell()
        if count > len(self.data) - start:
            self.truncated(f"{what}: expected {count} more bytes")
        self.data.seek(start + count)
        return start

    def name(self, what: str) -> str:
        end = self.data.find(b"\0", self.data.tell())
        if end < 0:
            self.truncated(f"{what}: expected a zero byte after the name")
        start = self.skip(end + 1 - self.data.tell(), what)
        return self.data[start:end].decode("utf-8", "replace")

    def truncated(self, problem: str) -> NoReturn:
        at = self.data.tell()
        self.file.at(f"byte {at}").fail(f"truncated: {problem}, got {len(self.data) - at}")


def _rows(file: CameraPlace, thing: str) -> Iterator[tuple[_Binary, str, CameraPlace]]:
    """Yield the file, name and place of each row."""
    # Memory-mapped, since images.bin is mostly observations, which are skipped.
    with opened(file) as (stream, _), mmap(stream.fileno(), 0, access=ACCESS_READ) as mapped:
        data = _Binary(file, mapped)
        (count,) = data.take("Q", f"number of {thing}s")
        for index in range(count):
            row = f"{thing} row {index}"
            yield data, row, file.at(f"{row} at byte {mapped.tell()}")
        if left := len(mapped) - mapped.tell():
            wanted = f"the end of the file after {counted(count, thing)}"
            file.at(f"byte {mapped.tell()}").fail(f"expected {wanted}, got {left} more bytes")


def _binary_cameras(file: CameraPlace) -> Iterator[Any]:
    """Yield place, id and `_lens` of each camera."""
    for data, row, place in _rows(file, "camera"):
        camera_id, model_id, *size = data.take("IiQQ", row)
        if not 0 <= model_id < len(MODELS):
            place.fail(f"unknown camera model {model_id}, expected 0 to {len(MODELS) - 1}")
        model = MODELS[model_id]
        values = data.take(f"{model.parameters}d", f"parameters of {row}")
        yield place, camera_id, _lens(place, model, size, values)


def _binary_images(file: CameraPlace) -> Iterator[Any]:
    """Yield name, id, place, pose (world to camera) and camera id of each registered image."""
    for data, row, place in _rows(file, "image"):
        image_id, *pose, camera_id = data.take("I7dI", row)
        name = data.name(f"name of {row}")
        (points,) = data.take("Q", f"number of points of {row}")
        data.skip(points * POINT_BYTES, f"{points} points of {row}")
        yield name, image_id, place, pose, camera_id


def _lines(file: CameraPlace) -> Generator[tuple[CameraPlace, bytes], None, None]:
    """Yield place and bytes of each line that is no comment."""
    with opened(file) as (stream, _):
        for number, text in enumerate(stream, 1):
            line = text.strip()
            if number == 1:
                line = line.removeprefix(codecs.BOM_UTF8)
            if not line.startswith(b"#"):
                yield file.at(f"line {number}"), line


def _text_cameras(file: CameraPlace) -> Iterator[Any]:
    for place, line in _lines(file):
        if not line:
            continue
        camera_id, name, *fields = [*line.decode("utf-8", "replace").split(), "", ""]
        model = MODELS_BY_NAME.get(name)
        if model is None:
            place.fail(f"unknown camera model {name[:40]!r}, expected {', '.join(MODELS_BY_NAME)}")
        numbers = [_parsed(place, field) for field in fields[:-2]]
        if len(numbers) != 2 + model.parameters:
            wanted = f"width, height and {model.parameters} parameters of {model.name}"
            place.fail(f"expected {wanted}, got {len(numbers)} numbers")
        yield place, _parsed(place, camera_id, int), _lens(place, model, numbers[:2], numbers[2:])


def _text_images(file: CameraPlace) -> Iterator[Any]:
    with contextlib.closing(_lines(file)) as lines:
        for row, (place, line) in enumerate(item for item in lines if item[1]):
            fields = line.decode("utf-8", "replace").split(maxsplit=len(IMAGE_FIELDS) - 1)
            where = place.at(f"image row {row}")
            if len(fields) < len(IMAGE_FIELDS):
                where.fail(f"expected {', '.join(IMAGE_FIELDS)}, got {len(fields)} fields")
            image_id, *pose, camera_id, name = fields
            numbers = [_parsed(where, field) for field in pose]
            image_id, camera_id = (_parsed(where, each, int) for each in (image_id, camera_id))
            yield name, image_id, where, numbers, camera_id
            place, points = next(lines, (place, b""))
            if len(points) < SHORT_LINE and len(points.split()) % 3:
                wanted = f"the points of image row {row} as X, Y, POINT3D_ID each"
                rule = "an image takes two lines, of which the second may be empty"
                place.fail(f"expected {wanted} ({rule})")


def _parsed(place: CameraPlace, field: str, kind: Any = float) -> Any:
    try:
        return kind(field)
    except ValueError:
        what = "a whole number as id" if kind is int else "a number"
        place.fail(f"expected {what}, got {field[:40]!r}")
