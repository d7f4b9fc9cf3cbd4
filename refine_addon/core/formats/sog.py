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
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import RefineError
from ..foreign_files import foreign_kind
from ..splats import above_constant, opacity, opacity_logits, unit_quaternions
from .format import (
    Format,
    Sizes,
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

    from ..splats import Splats

NAME = "SOG"

_VERSION = 2
_DEGREES = 3

_ACROSS = 64
"""Entries of the palette in a row of its image."""

_LARGEST_PALETTE = 16
"""It has 2 to the power of this many entries at most: labels have 16 bits."""

_TABLE = 256
_ROTATIONS = 252
"""In the alpha of a rotation: this, and which component is the largest."""

_META_LIMIT = 1 << 22
_MOST_PIXELS = 16383
"""Of a side of a WebP image."""

_BROKEN = (
    zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError, ValueError,
    KeyError, OSError, OverflowError, ArithmeticError,
)  # fmt: skip
"""What reading a damaged archive raises."""


def matches(path: Path, head: bytes) -> bool:
    """Return whether a file is one: an archive that lists images and ``meta.json``."""
    return foreign_kind(path, head).startswith("a SOG file")


@dataclass(frozen=True, eq=False)
class _Bundle:
    """An archive, and what its ``meta.json`` says."""

    path: Path
    archive: zipfile.ZipFile
    folder: str
    meta: dict[str, Any]
    size: int
    codec: Codec

    def wrong(self, place: str, problem: str) -> RefineError:
        """Return the error for a place in ``meta.json``."""
        return RefineError(f"{self.path}: meta.json: {place}: {problem}")

    def section(self, name: str) -> dict[str, Any]:
        """Return what is said of an attribute."""
        found = self.meta.get(name)
        if not isinstance(found, dict):
            raise self.wrong(place=name, problem="is not there, expected an object")
        return found

    def numbers(self, name: str, key: str, count: int) -> NDArray[np.float64]:
        """Return a list of numbers."""
        values = self.section(name).get(key)
        plain = values if isinstance(values, list) else []
        if len(plain) != count or not all(type(value) in (int, float) for value in plain):
            raise self.wrong(place=f"{name}.{key}", problem=f"expected {count} numbers")
        try:
            return np.array(plain, np.float64)
        except OverflowError:
            raise self.wrong(place=f"{name}.{key}", problem="a number too large for this") from None

    def pixels(self, name: str, index: int, count: int, width: int = 0) -> NDArray[np.uint8]:
        """Return an image of at least `count` pixels, (height, width, 4).

        Parameters
        ----------
        name, index
            Which of the files of an attribute.
        count : int
            How many are needed; far more are refused.
        width : int
            What the width must be; 0 for any.
        """
        files = self.section(name).get("files")
        if not isinstance(files, list) or len(files) <= index or not isinstance(files[index], str):
            raise self.wrong(
                place=f"{name}.files", problem=f"expected at least {index + 1} names of images"
            )
        label = files[index][:80]
        data = _entry(self.path, self.archive, self.folder + files[index], 4 * self.size)
        try:
            across, down = self.codec.size(data)
            problem = ""
            if across * down < count or across * down > 4 * count + (1 << 16):
                problem = f"{across} x {down} pixels, expected {count}"
            elif width and across != width:
                problem = f"{across} pixels wide, expected {width}"
            if not problem:
                return self.codec.decode(data)
        except ValueError as error:
            problem = f"cannot be read ({str(error)[:100]})"
        msg = f"{self.path}: image {label!r}: {problem}"
        raise RefineError(msg)


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
        count = bundle.meta.get("count")
        if type(count) is not int or not 0 < count <= len(data):
            shown = str(count)[:30] if type(count) is int else "none"
            problem = f"{shown}, expected 1 to {len(data)}, the bytes of the file"
            raise bundle.wrong(place="count", problem=problem)
        return _read(bundle, count)


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
    try:
        meta = json.loads(_entry(path, archive, name, _META_LIMIT))
    except (ValueError, RecursionError) as error:
        what = str(error) if isinstance(error, ValueError) else "nested too deeply"
        msg = f"{path}: meta.json cannot be read: {what[:100]}"
        raise RefineError(msg) from error
    version = meta.get("version") if isinstance(meta, dict) else None
    if version != _VERSION:
        shown = repr(version)[:30] if type(version) in (int, float, str) else "none"
        msg = f"{path}: meta.json: version {shown}, expected {_VERSION}"
        raise RefineError(msg)
    return _Bundle(path, archive, name[: -len("meta.json")], meta, size, codec_for(path))


def _read(bundle: _Bundle, count: int) -> SplatFile:
    def flat(name: str, index: int = 0) -> NDArray[np.uint8]:
        return bundle.pixels(name, index, count).reshape(-1, 4)[:count]

    low, high = (bundle.numbers("means", key, 3) for key in ("mins", "maxs"))
    lower, upper = flat("means", 0), flat("means", 1)
    turns, scales, colors = flat("quats"), flat("scales"), flat("sh0")
    scale_table, color_table = (bundle.numbers(n, "codebook", _TABLE) for n in ("scales", "sh0"))
    if turns[:, 3].min() < _ROTATIONS:
        index = int(np.argmax(turns[:, 3] < _ROTATIONS))
        msg = (
            f"{bundle.path}: rotation of splat {index}: alpha {turns[index, 3]}, "
            f"expected {_ROTATIONS} to 255"
        )
        raise RefineError(msg)
    palette, labels = _palette(bundle, count)
    degree = math.isqrt(palette.shape[1] + 1) - 1
    file, splats = new_file(bundle.path, Origin(f"{NAME} version 2", bundle.size), count, degree)
    with np.errstate(over="ignore", invalid="ignore"):  # any number may stand in meta.json
        for piece in pieces(count):
            whole = lower[piece, :3] + upper[piece, :3] * 256.0
            places = low + (high - low) * (whole / 65535.0)
            splats.means[piece] = np.sign(places) * np.expm1(np.abs(places))
            others = (turns[piece, :3] / 127.5 - 1.0) / math.sqrt(2.0)
            splats.quaternions[piece] = join_largest(
                (turns[piece, 3] - _ROTATIONS).astype(np.intp), others
            )
            splats.log_scales[piece] = scale_table[scales[piece, :3]]
            splats.sh_dc[piece] = color_table[colors[piece, :3]]
            splats.opacity_logits[piece] = opacity_logits(colors[piece, 3] / 255.0)
            splats.sh_rest[piece] = palette[labels[piece]]
    return file


def _palette(bundle: _Bundle, count: int) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Return the palette of harmonics (P, K, 3), and the entry of each splat."""
    if "shN" not in bundle.meta:
        return np.zeros((1, 0, 3), np.float32), np.zeros(count, np.intp)
    held = bundle.section("shN")
    bands, entries = held.get("bands"), held.get("count")
    if type(bands) is not int or not 1 <= bands <= _DEGREES:
        raise bundle.wrong(place="shN.bands", problem="expected 1, 2 or 3")
    if type(entries) is not int or not 0 < entries <= 1 << _LARGEST_PALETTE:
        raise bundle.wrong(place="shN.count", problem=f"expected 1 to {1 << _LARGEST_PALETTE}")
    table = bundle.numbers("shN", "codebook", _TABLE)
    coefficients = above_constant(bands)
    width, rows = _ACROSS * coefficients, -(-entries // _ACROSS)
    image = bundle.pixels("shN", 0, width * rows, width)
    places = image[:rows, :, :3].reshape(rows * _ACROSS, coefficients, 3)[:entries]
    pixels = bundle.pixels("shN", 1, count).reshape(-1, 4)[:count].astype(np.intp)
    labels = pixels[:, 0] + 256 * pixels[:, 1]
    if labels.max() >= entries:
        index = int(np.argmax(labels >= entries))
        msg = f"{bundle.path}: splat {index}: entry {labels[index]} of {entries} in the palette"
        raise RefineError(msg)
    with np.errstate(over="ignore"):
        return table.astype(np.float32)[places], labels


def write(stream: BinaryIO, splats: Splats) -> None:
    """Write splats as a SOG file, near ones together.

    Raises
    ------
    RefineError
        If there is no library for its images, or there are more splats than pixels in them.
    """
    count = len(splats)
    width = -(-math.isqrt(count - 1) // 4) * 4 + 4 if count > 1 else 4
    if width > _MOST_PIXELS:
        msg = f"{count} splats: {NAME} holds {(_MOST_PIXELS // 4 * 4) ** 2}"
        raise RefineError(msg)
    height = -(-count // width)
    codec = codec_for(Path(str(getattr(stream, "name", NAME))))
    splats = splats.take(near_ones_together(splats.means))
    images: dict[str, NDArray[np.uint8]] = {}

    def blank(name: str) -> NDArray[np.uint8]:
        images[name] = np.zeros((height, width, 4), np.uint8)
        images[name][..., 3] = 255
        flat: NDArray[np.uint8] = images[name].reshape(-1, 4)[:count]
        return flat

    means = np.asarray(splats.means, np.float64)
    places = np.sign(means) * np.log1p(np.abs(means))
    low, high = places.min(axis=0), places.max(axis=0)
    extent = np.where(high > low, high - low, 1.0)
    whole = np.rint((places - low) / extent * 65535.0).astype(np.uint16)
    blank("means_l.webp")[:, :3] = whole & 255
    blank("means_u.webp")[:, :3] = whole >> 8
    largest, others = split_largest(unit_quaternions(splats.quaternions))
    turns = blank("quats.webp")
    turns[:, :3] = codes(others * math.sqrt(0.5) + 0.5)
    turns[:, 3] = largest + _ROTATIONS
    # Of no size at all is e^-20: tables hold finite numbers.
    scale_table, scales = _tabulated(np.maximum(splats.log_scales, -20.0))
    blank("scales.webp")[:, :3] = scales
    color_table, colors = _tabulated(splats.sh_dc)
    pixels = blank("sh0.webp")
    pixels[:, :3] = colors
    with np.errstate(under="ignore"):
        pixels[:, 3] = codes(opacity(splats.opacity_logits))
    meta: dict[str, Any] = {
        "version": _VERSION,
        "asset": {"generator": "REFINE for Blender"},
        "count": count,
        "means": {
            "mins": low.tolist(),
            "maxs": (low + extent).tolist(),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": scale_table.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_table.tolist(), "files": ["sh0.webp"]},
    }
    if splats.sh_degree:
        labels = _grouped(splats.sh_rest.reshape(count, -1))
        entries = int(labels.max()) + 1
        flat = blank("shN_labels.webp")
        flat[:, 0], flat[:, 1], flat[:, 2] = labels & 255, labels >> 8, 0
        table, images["shN_centroids.webp"] = _centroids(splats.sh_rest, labels, entries)
        meta["shN"] = {
            "count": entries,
            "bands": splats.sh_degree,
            "codebook": table.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    # A ZipInfo has no date of today, so a file is the same whenever it is made.
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr(zipfile.ZipInfo("meta.json"), json.dumps(meta))
        for name, image in images.items():
            archive.writestr(zipfile.ZipInfo(name), codec.encode(image))


def _tabulated(values: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return a table of 256 values and the place of the nearest for each of `values`.

    Half of the table are even steps from the least to the largest, so that no value is off by more
    than half of one; the other half are where the values are, as many between any two.
    """
    flat = np.sort(values, axis=None)
    half = _TABLE // 2
    spots = np.linspace(0.0, 1.0, half)
    even = flat[0] + (float(flat[-1]) - float(flat[0])) * spots
    often = flat[np.rint(spots * (len(flat) - 1)).astype(np.intp)]
    table = np.sort(np.concatenate([even, often])).astype(np.float32)
    bounds = (table[1:].astype(np.float64) + table[:-1]) / 2.0
    return table, np.searchsorted(bounds, values).astype(np.uint8)


def _grouped(rows: NDArray[Any]) -> NDArray[np.int64]:
    """Return a group for each of N rows (N, D), near ones in one; groups are numbered from 0.

    All rows are one group first; every group is halved at its mean along the axis in which it
    varies most, again and again, until there are 65,536 or as many as half of the rows.
    """
    columns = np.ascontiguousarray(np.asarray(rows, np.float32).T)  # (D, N)
    labels = np.zeros(rows.shape[0], np.int64)
    for _ in range(min(_LARGEST_PALETTE, int(rows.shape[0]).bit_length() - 1)):
        groups = int(labels.max()) + 1
        sizes = np.bincount(labels, minlength=groups)
        widest = np.full(groups, -1.0)
        axis = np.zeros(groups, np.intp)
        middle = np.zeros(groups)
        for index, column in enumerate(columns):
            with np.errstate(under="ignore"):
                mean = np.bincount(labels, column, groups) / sizes
                square = np.bincount(labels, np.square(column, dtype=np.float64), groups) / sizes
                spread = square - np.square(mean)
            wider = spread > widest
            widest[wider], axis[wider], middle[wider] = spread[wider], index, mean[wider]
        above = columns[axis[labels], np.arange(len(labels))] > middle[labels]
        labels = np.unique(2 * labels + above, return_inverse=True)[1].reshape(-1)
    return labels


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


def sizes(_count: int, _degree: int) -> Sizes | None:
    """Return None: images are compressed as a whole."""
    return None


FORMAT = Format(
    name=NAME,
    suffix=".sog",
    degree=_DEGREES,
    loss="holds positions in 16 bits, all else in 8, takes harmonics from a palette, and sorts",
    matches=matches,
    read=read,
    write=write,
    sizes=sizes,
)
