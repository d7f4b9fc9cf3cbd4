"""SOG files by PlayCanvas, version 2: a ZIP archive of ``meta.json`` and WebP images.

A pixel of each image belongs to a splat: 16 bits of the logarithm of each coordinate, three
components of the rotation in 8, scales and colours as places in a table of 256 values, opacity in
8. Harmonics are one of up to 65,536 palettes' entries, whose values are places in a third table.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from ..errors import RefineError
from ..foreign_files import is_sog
from ..place import Place, described
from ..rendering import MODELS
from ..splats import above_constant, opacity, opacity_logits, unit_quaternions
from .format import (
    Format,
    codes,
    join_largest,
    near_ones_together,
    new_file,
    pieces,
    split_largest,
)
from .images import Codec, codec_for
from .ply import Origin, SplatFile

if TYPE_CHECKING:
    from typing import BinaryIO

    from numpy.typing import NDArray

    from ..rendering import Model
    from ..splats import Splats

NAME = "SOG"

_VERSION = 2
_DEGREES = 3

_ACROSS = 64  # entries of the palette in a row of its image
_LABEL_BITS = 16  # of the number of an entry of the palette: two channels of an image
_TABLE = 256  # values of a table, whose places are a byte
_COORDINATE = 65535.0  # largest code of a coordinate: two bytes, in two images
_ROTATIONS = 252  # in the alpha of a rotation: this, and which component is the largest
_NO_SIZE = -20.0  # log scale written for anything smaller, since tables hold finite numbers

_META_LIMIT = 1 << 20
"""Bytes of the longest ``meta.json`` that is read; with four tables it has some 20,000."""

_MOST_PIXELS = 16383  # of a side of a WebP image

_SPARE_PIXELS = 1 << 16
"""An image has at most four times the pixels that are needed, and these: writers pad images."""

_BROKEN = (
    zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, ValueError,
    KeyError, OSError, OverflowError, ArithmeticError,
)  # fmt: skip
"""What reading a damaged archive raises."""


def matches(path: Path, head: bytes) -> bool:
    """Return whether a file is one: an archive that lists images and ``meta.json``."""
    return is_sog(path, head)


@dataclass(frozen=True, eq=False)
class _Bundle:
    """An archive, and what its ``meta.json`` says."""

    place: Place
    archive: zipfile.ZipFile
    folder: str
    meta: dict[str, Any]
    size: int
    codec: Codec

    def section(self, name: str) -> tuple[dict[str, Any], Place]:
        """Return what is said of an attribute, and its place."""
        place = self.place.at(name)
        return place.members(self.meta.get(name)), place

    def numbers(self, name: str, key: str, count: int) -> NDArray[np.float64]:
        """Return a list of numbers."""
        section, place = self.section(name)
        return np.array(place.at(key).numbers(section.get(key), count))

    def table(self, name: str) -> NDArray[np.float64]:
        """Return the values that the pixels of an attribute are places of, (256,)."""
        return self.numbers(name, "codebook", _TABLE)

    def pixels(self, name: str, index: int, count: int, width: int = 0) -> NDArray[np.uint8]:
        """Return an image of at least `count` pixels, (height, width, 4): a file of an attribute.

        Far more pixels are refused, and so is another width than `width`, unless that is 0.
        """
        section, place = self.section(name)
        files = place.at("files").items(section.get("files"))
        if len(files) <= index:
            place.at("files").fail(f"expected at least {index + 1} names of images")
        file = place.at(f"files [{index}]").text(files[index])
        path = self.place.path
        data = _entry(path, self.archive, self.folder + file, 4 * self.size)
        try:
            across, down = self.codec.size(data)
            problem = ""
            if not count <= across * down <= 4 * count + _SPARE_PIXELS:
                problem = f"{across} x {down} pixels, expected {count}"
            elif width and across != width:
                problem = f"{across} pixels wide, expected {width}"
            if not problem:
                return self.codec.decode(data)
        except ValueError as error:
            problem = f"cannot be read ({str(error)[:100]})"
        msg = f"{path}: image {file[:80]!r}: {problem}"
        raise RefineError(msg)

    def rows(self, name: str, index: int, count: int) -> NDArray[np.uint8]:
        """Return the pixels of `count` splats, (count, 4), of an image; see `pixels`."""
        return self.pixels(name, index, count).reshape(-1, 4)[:count]


def _entry(path: Path, archive: zipfile.ZipFile, name: str, limit: int) -> bytes:
    """Return a file of the archive, of at most `limit` bytes."""
    label = name[:80]
    try:
        with archive.open(name) as stream:
            data = stream.read(limit + 1)
    except _BROKEN as error:
        msg = f"{path}: {label!r} in the archive cannot be read ({str(error)[:100]})"
        raise RefineError(msg) from error
    if len(data) > limit:
        msg = f"{path}: {label!r} in the archive has more than {limit} bytes"
        raise RefineError(msg)
    return data


def read(path: Path, data: NDArray[np.uint8]) -> SplatFile:
    """Read a SOG file of version 2.

    Raises
    ------
    RefineError
        If it is damaged or of another version, or there is no library for its images.
    """
    with _opened(path, data) as archive:
        bundle = _bundle(path, archive, len(data))
        # A splat takes more than a byte.
        count = bundle.place.at("count").whole(bundle.meta.get("count"), 1, len(data))
        return _splats(bundle, count)


def _opened(path: Path, data: NDArray[np.uint8]) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(io.BytesIO(data.tobytes()))
    except _BROKEN as error:
        msg = f"{path}: the archive cannot be read ({str(error)[:100]})"
        raise RefineError(msg) from error


def _bundle(path: Path, archive: zipfile.ZipFile, size: int) -> _Bundle:
    names = (name for name in archive.namelist() if name.split("/")[-1] == "meta.json")
    name = next(names, None)
    if name is None:
        msg = f"{path}: no meta.json in the archive, which a SOG file has"
        raise RefineError(msg)
    place = Place(path, "meta.json")
    meta = place.members(place.parsed(_entry(path, archive, name, _META_LIMIT)))
    version = meta.get("version")
    if version != _VERSION:
        place.at("version").fail(f"expected {_VERSION}, got {described(version)}")
    return _Bundle(place, archive, name[: -len("meta.json")], meta, size, codec_for(path))


def _splats(bundle: _Bundle, count: int) -> SplatFile:
    """Return the splats of an archive."""
    palette, labels = _palette(bundle, count)
    degree = math.isqrt(palette.shape[1] + 1) - 1
    origin = Origin(f"{NAME} version 2", bundle.size)
    file, splats = new_file(bundle.place.path, origin, count, degree, _model(bundle))
    with np.errstate(over="ignore", invalid="ignore"):  # any number may stand in meta.json
        _fill_means(bundle, splats)
        _fill_rotations(bundle, splats)
        _fill_from_tables(bundle, splats)
        for piece in pieces(count):
            splats.sh_rest[piece] = palette[labels[piece]]
    return file


def _model(bundle: _Bundle) -> Model:
    """Return how the splats are drawn, as splat-transform says it: a word beside the version."""
    word = bundle.meta.get("model", MODELS[0])
    if word not in MODELS:
        bundle.place.at("model").fail(f"expected one of {', '.join(MODELS)}, got {described(word)}")
    return cast("Model", word)


def _fill_means(bundle: _Bundle, splats: Splats) -> None:
    low, high = (bundle.numbers("means", key, 3) for key in ("mins", "maxs"))
    lower, upper = (bundle.rows("means", index, len(splats)) for index in (0, 1))
    for piece in pieces(len(splats)):
        code = lower[piece, :3] + upper[piece, :3] * 256.0
        logs = low + (high - low) * (code / _COORDINATE)
        splats.means[piece] = np.sign(logs) * np.expm1(np.abs(logs))


def _fill_rotations(bundle: _Bundle, splats: Splats) -> None:
    """Set quaternions from pixels; see `_rotation_pixels`."""
    pixels = bundle.rows("quats", 0, len(splats))
    wrong = pixels[:, 3] < _ROTATIONS
    if wrong.any():
        index = int(np.argmax(wrong))
        Place(bundle.place.path, f"rotation of splat {index}").fail(
            f"alpha {pixels[index, 3]}, expected {_ROTATIONS} to 255"
        )
    for piece in pieces(len(splats)):
        others = (pixels[piece, :3] / 127.5 - 1.0) / math.sqrt(2.0)
        largest = (pixels[piece, 3] - _ROTATIONS).astype(np.intp)
        splats.quaternions[piece] = join_largest(largest, others)


def _fill_from_tables(bundle: _Bundle, splats: Splats) -> None:
    """Set scales, colours and, from the alpha of the colours' image, opacities."""
    scales, scale_table = bundle.rows("scales", 0, len(splats)), bundle.table("scales")
    colors, color_table = bundle.rows("sh0", 0, len(splats)), bundle.table("sh0")
    for piece in pieces(len(splats)):
        splats.log_scales[piece] = scale_table[scales[piece, :3]]
        splats.sh_dc[piece] = color_table[colors[piece, :3]]
        splats.opacity_logits[piece] = opacity_logits(colors[piece, 3] / 255.0)


def _palette(bundle: _Bundle, count: int) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Return the palette of harmonics (P, K, 3), and the entry of each splat."""
    if "shN" not in bundle.meta:
        return np.zeros((1, 0, 3), np.float32), np.zeros(count, np.intp)
    held, place = bundle.section("shN")
    bands = place.at("bands").whole(held.get("bands"), 1, _DEGREES)
    entries = place.at("count").whole(held.get("count"), 1, 1 << _LABEL_BITS)
    table = bundle.table("shN")
    coefficients = above_constant(bands)
    width, height = _ACROSS * coefficients, -(-entries // _ACROSS)
    image = bundle.pixels("shN", 0, width * height, width)
    codes_of = image[:height, :, :3].reshape(height * _ACROSS, coefficients, 3)[:entries]
    pixels = bundle.rows("shN", 1, count).astype(np.intp)
    labels = pixels[:, 0] + 256 * pixels[:, 1]
    if labels.max() >= entries:
        index = int(np.argmax(labels >= entries))
        Place(bundle.place.path, f"splat {index}").fail(
            f"entry {labels[index]} of {entries} in the palette"
        )
    with np.errstate(over="ignore"):
        return table.astype(np.float32)[codes_of], labels


def write(stream: BinaryIO, splats: Splats) -> None:
    """Write splats as a SOG file, sorted so that neighbours in space are neighbours in images.

    Raises
    ------
    RefineError
        If there is no library for its images, or there are more splats than pixels in them.
    """
    size = _image_size(len(splats))
    codec = codec_for(Path(str(getattr(stream, "name", NAME))))
    splats = splats.take(near_ones_together(splats.means))
    low, high, lower, upper = _coordinates(splats.means)
    scale_table, scales = _tabulated(np.maximum(splats.log_scales, _NO_SIZE))
    color_table, colors = _tabulated(splats.sh_dc)
    with np.errstate(under="ignore"):
        alpha = codes(opacity(splats.opacity_logits))
    meta: dict[str, Any] = {
        "version": _VERSION,
        "asset": {"generator": "REFINE for Blender"},
        "count": len(splats),
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": scale_table.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_table.tolist(), "files": ["sh0.webp"]},
    }
    if splats.model != MODELS[0]:
        meta["model"] = splats.model
    images = {
        "means_l.webp": _image(size, lower),
        "means_u.webp": _image(size, upper),
        "quats.webp": _image(size, _rotation_pixels(splats.quaternions)),
        "scales.webp": _image(size, scales),
        "sh0.webp": _image(size, np.column_stack([colors, alpha])),
    }
    if splats.sh_degree:
        meta["shN"], images["shN_labels.webp"], images["shN_centroids.webp"] = _grouped_harmonics(
            splats.sh_rest, size
        )
    # A ZipInfo has no date of today, so a file is the same whenever it is made.
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr(zipfile.ZipInfo("meta.json"), json.dumps(meta))
        for name, image in images.items():
            archive.writestr(zipfile.ZipInfo(name), codec.encode(image))


def _image_size(count: int) -> tuple[int, int]:
    """Return height and width of images for `count` pixels: nearly square, width divisible by 4."""
    width = 4 * (-(-math.isqrt(max(count - 1, 0)) // 4) + 1)
    if width > _MOST_PIXELS:
        msg = f"{count} splats: {NAME} holds {(_MOST_PIXELS // 4 * 4) ** 2}"
        raise RefineError(msg)
    return -(-count // width), width


def _image(size: tuple[int, int], values: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image (height, width, 4) of a pixel for each splat, opaque where nothing is said.

    `values`, (N, C) uint8, are the first C channels of each pixel.
    """
    image = np.zeros((*size, 4), np.uint8)
    image[..., 3] = 255
    image.reshape(-1, 4)[: len(values), : values.shape[1]] = values
    return image


def _coordinates(
    means: NDArray[Any],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the range of the logarithms of positions (N, 3), and their codes within it.

    The range is two (3,) float64, the codes are two (N, 3) uint8: their lower and upper bytes.
    """
    means = np.asarray(means, np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(axis=0), logs.max(axis=0)
    extent = np.where(high > low, high - low, 1.0)
    code = np.rint((logs - low) / extent * _COORDINATE).astype(np.uint16)
    return low, low + extent, (code & 255).astype(np.uint8), (code >> 8).astype(np.uint8)


def _rotation_pixels(quaternions: NDArray[Any]) -> NDArray[np.uint8]:
    """Return pixels (N, 4): the three smaller components, and which is left out."""
    largest, others = split_largest(unit_quaternions(quaternions))
    return np.column_stack([codes(others * math.sqrt(0.5) + 0.5), largest + _ROTATIONS]).astype(
        np.uint8
    )


def _grouped_harmonics(
    sh_rest: NDArray[Any], size: tuple[int, int]
) -> tuple[dict[str, Any], NDArray[np.uint8], NDArray[np.uint8]]:
    """Return what ``meta.json`` says of harmonics (N, K, 3), and two images: labels, palette."""
    count = len(sh_rest)
    labels = _grouped(sh_rest.reshape(count, -1))
    entries = int(labels.max()) + 1
    table, centroids = _centroids(sh_rest, labels, entries)
    held = {
        "count": entries,
        "bands": math.isqrt(sh_rest.shape[1]),
        "codebook": table.tolist(),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }
    pixels = np.column_stack([labels & 255, labels >> 8]).astype(np.uint8)
    return held, _image(size, pixels), centroids


def _tabulated(values: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return a table of 256 values and the place of the nearest for each of `values`.

    Half of the table are equal steps from the least to the largest value, so that no value is off
    by more than half a step; the other half are quantiles of the values.
    """
    flat = np.sort(values, axis=None)
    half = _TABLE // 2
    shares = np.linspace(0.0, 1.0, half)
    even = flat[0] + (float(flat[-1]) - float(flat[0])) * shares
    quantiles = flat[np.rint(shares * (len(flat) - 1)).astype(np.intp)]
    table = np.sort(np.concatenate([even, quantiles])).astype(np.float32)
    bounds = (table[1:].astype(np.float64) + table[:-1]) / 2.0
    return table, np.searchsorted(bounds, values).astype(np.uint8)


def _grouped(rows: NDArray[Any]) -> NDArray[np.int64]:
    """Return a group for each of N rows (N, D): similar rows share one. Numbers start at 0.

    All rows are one group first; every group is halved at its mean along the axis in which it
    varies most, again and again, until there are 65,536 or as many as half of the rows.
    """
    columns = np.ascontiguousarray(np.asarray(rows, np.float32).T)  # (D, N)
    labels = np.zeros(rows.shape[0], np.int64)
    for _ in range(min(_LABEL_BITS, int(rows.shape[0]).bit_length() - 1)):
        axis, middle = _widest(columns, labels)
        above = columns[axis[labels], np.arange(len(labels))] > middle[labels]
        labels = np.unique(2 * labels + above, return_inverse=True)[1].reshape(-1)
    return labels


def _widest(
    columns: NDArray[np.float32], labels: NDArray[np.int64]
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Return in which of D columns (D, N) each group varies most, and its mean there, (G,) each."""
    sizes = np.bincount(labels)
    groups = len(sizes)
    largest = np.full(groups, -1.0)
    axis, middle = np.zeros(groups, np.intp), np.zeros(groups)
    for index, column in enumerate(columns):
        with np.errstate(under="ignore"):
            mean = np.bincount(labels, column, groups) / sizes
            square = np.bincount(labels, np.square(column, dtype=np.float64), groups) / sizes
            variance = square - np.square(mean)
        wider = variance > largest
        largest[wider], axis[wider], middle[wider] = variance[wider], index, mean[wider]
    return axis, middle


def _centroids(
    sh_rest: NDArray[Any], labels: NDArray[np.int64], entries: int
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return the table and the image of a palette: the mean harmonics of each group."""
    coefficients = sh_rest.shape[1]
    sizes = np.bincount(labels, minlength=entries)
    means = np.empty((entries, coefficients, 3))
    for k in range(coefficients):
        for channel in range(3):
            column = np.asarray(sh_rest[:, k, channel], np.float64)
            means[:, k, channel] = np.bincount(labels, column, entries) / sizes
    table, places = _tabulated(means)
    rows = -(-entries // _ACROSS)
    image = np.zeros((rows * _ACROSS, coefficients, 4), np.uint8)
    image[..., 3] = 255
    image[:entries, :, :3] = places
    return table, image.reshape(rows, _ACROSS * coefficients, 4)


FORMAT = Format(
    name=NAME,
    suffix=".sog",
    degree=_DEGREES,
    loss="holds positions in 16 bits, all else in 8, takes harmonics from a palette, and sorts",
    matches=matches,
    read=read,
    write=write,
    sizes=None,
    models=MODELS,
)
