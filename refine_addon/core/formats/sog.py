"""SOG by PlayCanvas: ``meta.json`` and WebP images, in a ZIP archive or in a folder.

A splat is a pixel in each image: logarithms of coordinates in 16 bits, rotation and opacity in 8.
Scales, colours and a palette of harmonics are places in tables of 256 values. Version 1, which is
only read and does not say its number, has tables of even steps between two ends, and logits as
opacities.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError, reason_of
from ..images import codec_for
from ..place import LARGEST_NUMBER, Place, is_sog, named_json
from ..splats import MODELS, Splats, above_constant, opacity, opacity_logits, unit_quaternions
from ..visibility.scene import nearby_order
from ..whole_file import explained
from .format import Format, codes, join_largest, new_file, pieces, split_largest
from .ply import SplatFile

NAME, VERSION = "SOG", 2
GENERATOR = "REFINE for Blender"
META = "meta.json"
_PARTS = ("means_l", "means_u", "quats", "scales", "sh0", "shN_labels", "shN_centroids")
IMAGES = tuple(f"{part}.webp" for part in _PARTS)
"""Names of the files written; those of harmonics only where there are any."""

_DEGREE = 3  # highest
_ACROSS = 64  # entries of the palette in a row of its image
_LABEL_BITS = 16  # of the number of an entry of the palette: two channels of an image
_TABLE = 256  # values of a table, whose places are a byte
_COORDINATE = 65535.0  # largest code of a coordinate: two bytes, in two images
_ROTATIONS = 252  # the alpha of a rotation is this plus the number of the largest component
_NO_SIZE = -20.0  # log scale written for anything smaller, since tables hold finite numbers
_MOST_PIXELS = 16383  # of a side of a WebP image

_META_LIMIT = 1 << 20
"""Most bytes of a ``meta.json`` that is read; with four tables it has about 20,000."""

_SPARE_PIXELS = 1 << 16
"""Images may have four times the pixels needed and these, since writers pad them."""

_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, ValueError, ArithmeticError)
_BROKEN = (*_DAMAGED, RuntimeError, KeyError, OSError)  # errors of damaged archives

_PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Compressions accepted in an archive; others may take any memory and raise any error."""


class Bundle:
    """A ``meta.json`` and its files: their sizes by path, and ``opened(name, limit)`` for bytes."""

    def __init__(
        self, place: Place, meta: dict[str, Any], opened: Callable, files: dict[Path, int]
    ) -> None:
        self.place, self.meta, self.files, self._opened = place, meta, files, opened
        if self.meta.get("version", VERSION) != VERSION:
            place.at("version").expected(str(VERSION), self.meta["version"])
        self.version = VERSION if "version" in self.meta else 1
        self.size = sum(files.values())
        self.model = meta.get("model", MODELS[0])  # as splat-transform writes it
        if self.model not in MODELS:
            place.at("model").expected(f"one of {', '.join(MODELS)}", self.model)
        self._codec = codec_for(place.path)

    @property
    def count(self) -> int:
        """Number of splats; `RefineError` if it exceeds the number of bytes."""
        if self.version == VERSION:
            return self.place.at("count").whole(self.meta.get("count"), 1, self.size)
        section, place = self.section("means")
        shape = place.at("shape").items(section.get("shape"))
        return place.at("shape [0]").whole(shape[0] if shape else None, 1, self.size)

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        if "shN" not in self.meta:
            return 0
        section, place = self.section("shN")
        if self.version == VERSION:
            return place.at("bands").whole(section.get("bands"), 1, _DEGREE)
        widths = [_ACROSS * above_constant(degree) for degree in range(1, _DEGREE + 1)]
        across = self.pixels("shN", 0, 1, widths[-1] << _LABEL_BITS).shape[1]
        if across not in widths:
            place.fail(f"a palette {across} pixels wide, expected {', '.join(map(str, widths))}")
        return widths.index(across) + 1

    def section(self, name: str) -> tuple[dict[str, Any], Place]:
        """The JSON object of an attribute, and its place."""
        place = self.place.at(name)
        return place.members(self.meta.get(name)), place

    def numbers(self, name: str, key: str, count: int) -> NDArray[np.float64]:
        """`count` numbers under a key of an attribute, (count,)."""
        section, place = self.section(name)
        return np.array(place.at(key).numbers(section.get(key), count))

    def tables(self, name: str, channels: int) -> NDArray[np.float64]:
        """Table for the codes in the pixels of an attribute, (256, channels)."""
        if self.version == VERSION:
            return self.numbers(name, "codebook", _TABLE)[:, None].repeat(channels, axis=1)
        low, high = (self.numbers(name, key, channels) for key in ("mins", "maxs"))
        return low + (high - low) * (np.arange(_TABLE)[:, None] / (_TABLE - 1.0))

    def pixels(
        self, name: str, index: int, least: int, most: int, width: int = 0
    ) -> NDArray[np.uint8]:
        """Image of `least` to `most` pixels, (height, width, 4); `width` of 0 accepts any width."""
        section, place = self.section(name)
        files = place.at("files").items(section.get("files"))
        if len(files) <= index:
            place.at("files").fail(f"expected at least {index + 1} names of images")
        file = place.at(f"files [{index}]").text(files[index])
        data = self._opened(file, 4 * self.size)
        place = Place(self.place.path, f"image {file[:80]!r}")
        with explained(f"{place.path}: {place.where}", "cannot be read", errors=ValueError):
            across, down = self._codec.size(data)
            if not least <= across * down <= most:
                place.fail(f"{across} x {down} pixels, expected {least}")
            if width and across != width:
                place.fail(f"{across} pixels wide, expected {width}")
            return self._codec.decode(data)

    def rows(self, name: str, index: int) -> NDArray[np.uint8]:
        """Pixels of all splats, (N, 4), in an image; `RefineError` if it has far more."""
        image = self.pixels(name, index, self.count, 4 * self.count + _SPARE_PIXELS)
        return image.reshape(-1, 4)[: self.count]

    def read(self) -> SplatFile:
        """Read the splats; `RefineError` if an image is missing or wrong."""
        origin = f"{NAME} version {self.version}", self.size
        return new_file(self.place.path, origin, self.count, self.degree, self._parts(), self.model)

    def _parts(self):
        first, axes = self.version == 1, np.arange(3)
        low, high = (self.numbers("means", key, 3) for key in ("mins", "maxs"))
        lower, upper = (self.rows("means", index) for index in (0, 1))
        turns, scales, colors = (self.rows(name, 0) for name in ("quats", "scales", "sh0"))
        wrong = turns[:, 3] < _ROTATIONS
        if wrong.any():
            place = Place(self.place.path, f"rotation of splat {np.argmax(wrong)}")
            place.fail(f"alpha {turns[wrong][0, 3]}, expected {_ROTATIONS} to 255")
        scale_tables, color_tables = self.tables("scales", 3), self.tables("sh0", 3 + first)
        palette, labels = self._harmonics()
        for piece in pieces(self.count):
            code = lower[piece, :3] + upper[piece, :3] * 256.0
            logs = low + (high - low) * (code / _COORDINATE)
            means = np.sign(logs) * np.expm1(np.abs(logs))
            others = (turns[piece, :3] / 127.5 - 1.0) / math.sqrt(2.0)
            largest = (turns[piece, 3] - _ROTATIONS).astype(np.intp)
            sizes = scale_tables[scales[piece, :3], axes]
            alpha, dc = colors[piece, 3], color_tables[colors[piece, :3], axes]
            logits = color_tables[alpha, 3] if first else opacity_logits(alpha / 255.0)
            rest = palette[labels[piece]]
            yield Splats(means, sizes, join_largest(largest, others), logits, dc, rest)

    def _harmonics(self):
        """Palette of harmonics, (P, K, 3), and the entry of each splat, (N,)."""
        if "shN" not in self.meta:
            return np.empty((1, 0, 3), np.float32), np.zeros(self.count, np.intp)
        coefficients, most = above_constant(self.degree), 1 << _LABEL_BITS
        width, (section, place) = _ACROSS * coefficients, self.section("shN")
        if self.version == VERSION:
            table = self.tables("shN", 1)[:, 0]
            entries = place.at("count").whole(section.get("count"), 1, most)
            needed = width * -(-entries // _ACROSS)
            image = self.pixels("shN", 0, needed, 4 * needed + _SPARE_PIXELS, width)
        else:
            low, high = (place.at(key).number(section.get(key)) for key in ("mins", "maxs"))
            table = np.linspace(low, high, _TABLE)
            image = self.pixels("shN", 0, width, most * coefficients, width)
            entries = _ACROSS * len(image)
        places = image[: -(-entries // _ACROSS), :, :3].reshape(-1, coefficients, 3)[:entries]
        pixels = self.rows("shN", 1).astype(np.intp)
        labels = pixels[:, 0] + 256 * pixels[:, 1]
        if labels.max() >= entries:
            index = int(np.argmax(labels >= entries))
            place = Place(self.place.path, f"splat {index}")
            place.fail(f"entry {labels[index]} of {entries} in the palette")
        return table.astype(np.float32)[places], labels


def _held(place, label, limit, opened):
    """Bytes of a file; `RefineError` if it cannot be read or has more than `limit`."""
    try:
        with opened() as stream:
            content = stream.read(limit + 1)
    except _BROKEN as error:
        place.fail(f"{label} cannot be read ({reason_of(error)[:100]})")
    if len(content) > limit:
        place.fail(f"{label} has more than {limit} bytes")
    return content


def _read_archive(path, data):
    place = Place(path)
    with explained(path, "the archive cannot be read", errors=_BROKEN):
        archive = zipfile.ZipFile(io.BytesIO(data.tobytes()))
    metas = [name for name in archive.namelist() if name.split("/")[-1] == META]
    if not metas:
        place.fail(f"no {META} in the archive, which a SOG file has")
    folder = metas[0].removesuffix(META)

    def member(name):
        info = archive.getinfo(folder + name)
        if info.compress_type not in _PACKED:
            raise NotImplementedError(f"compressed by method {info.compress_type}")
        return archive.open(info)

    def opened(name, limit):
        label = f"{(folder + name)[:80]!r} in the archive"
        return _held(place, label, limit, lambda: member(name))

    with archive:
        meta = place.at(META).members(place.at(META).parsed(opened(META, _META_LIMIT)))
        return Bundle(place.at(META), meta, opened, {path: len(data)}).read()


def bundle_beside(path: Path) -> Bundle:
    """Open a ``meta.json`` with the images beside it."""
    place = Place(path)

    def held(there, limit):
        return _held(place, repr(there.name[:80]), limit, lambda: there.open("rb"))

    meta = place.members(place.parsed(held(path, _META_LIMIT)))
    named = [part.get("files") for part in meta.values() if isinstance(part, dict)]
    every = [name for group in named if isinstance(group, list) for name in group]
    paths = {path, *(place.beside(name) for name in every if isinstance(name, str))}
    files = {there.resolve(): there.stat().st_size for there in paths}
    return Bundle(place, meta, lambda name, limit: held(place.beside(name), limit), files)


def _write(stream, splats):
    """Write splats, sorted so that neighbours in space are neighbours in images."""
    path = Path(str(getattr(stream, "name", NAME)))
    # A ZipInfo has a fixed date, so equal splats give equal files.
    with zipfile.ZipFile(stream, "w") as archive:
        for name, data in contents(path, splats.take(nearby_order(splats.means))):
            archive.writestr(zipfile.ZipInfo(name), data)


def contents(path: Path, splats: Splats) -> Iterator[tuple[str, bytes]]:
    """Yield names and bytes of `META` and images, by splat; `RefineError` if too large."""
    count, codec = len(splats), codec_for(path)
    across = 4 * (-(-math.isqrt(max(count - 1, 0)) // 4) + 1)  # nearly square, divisible by 4
    if across > _MOST_PIXELS:
        raise RefineError(f"{count} splats: {NAME} holds {(_MOST_PIXELS // 4 * 4) ** 2}")

    def image(values, across):
        """Image of a width in pixels; `values`, (n, C), are the first channels of n of them."""
        pixels = np.zeros((-(-len(values) // across), across, 4), np.uint8)
        pixels[..., 3] = 255
        pixels.reshape(-1, 4)[: len(values), : values.shape[1]] = values
        return pixels

    means = np.asarray(splats.means, np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(axis=0), logs.max(axis=0)
    extent = np.where(high > low, high - low, 1.0)
    code = np.rint((logs - low) / extent * _COORDINATE).astype(np.uint16)
    largest, others = split_largest(unit_quaternions(splats.quaternions))
    scale_table, scales = _tabulated(np.maximum(splats.log_scales, _NO_SIZE))
    color_table, colors = _tabulated(splats.sh_dc)
    alpha = codes(opacity(splats.opacity_logits))
    meta: dict[str, Any] = {
        "version": VERSION,
        "asset": {"generator": GENERATOR},
        "count": count,
        "means": {"mins": low.tolist(), "maxs": (low + extent).tolist(), "files": [*IMAGES[:2]]},
        "scales": {"codebook": scale_table.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_table.tolist(), "files": ["sh0.webp"]},
    }
    if splats.model != MODELS[0]:
        meta["model"] = splats.model
    turns = np.column_stack([codes(others * math.sqrt(0.5) + 0.5), largest + _ROTATIONS])
    values = [code & 255, code >> 8, turns, scales, np.column_stack([colors, alpha])]
    images = [image(each, across) for each in values]
    if splats.sh_degree:  # a palette of the mean harmonics of each group
        labels = _grouped(splats.sh_rest.reshape(count, -1))
        entries = int(labels.max()) + 1
        coefficients, sizes = splats.sh_rest.shape[1], np.bincount(labels)
        means = np.empty((entries, coefficients, 3))
        for k, channel in np.ndindex(coefficients, 3):
            column = np.asarray(splats.sh_rest[:, k, channel], np.float64)
            means[:, k, channel] = np.bincount(labels, column) / sizes
        table, places = _tabulated(means)
        labels = np.column_stack([labels & 255, labels >> 8])
        palette = image(places.reshape(-1, 3), _ACROSS * coefficients)
        images += [image(labels, across), palette]
        held = {"count": entries, "bands": splats.sh_degree, "codebook": table.tolist()}
        meta["shN"] = {**held, "files": ["shN_centroids.webp", "shN_labels.webp"]}
    yield META, json.dumps(meta).encode()
    for name, pixels in zip(IMAGES, images, strict=False):
        yield name, codec.encode(pixels)


def _tabulated(values):
    """Table of 256 values, half in even steps and half quantiles, and the nearest to each value."""
    flat = np.sort(values, axis=None).clip(-LARGEST_NUMBER, LARGEST_NUMBER)  # which is read again
    half = _TABLE // 2
    shares = np.linspace(0.0, 1.0, half)
    even = flat[0] + (float(flat[-1]) - float(flat[0])) * shares
    quantiles = flat[np.rint(shares * (len(flat) - 1)).astype(np.intp)]
    table = np.sort(np.concatenate([even, quantiles])).astype(np.float32)
    bounds = (table[1:].astype(np.float64) + table[:-1]) / 2.0
    return table, np.searchsorted(bounds, values).astype(np.uint8)


def _grouped(rows):
    """Number of a group, from 0 on, for each of N rows, (N, D); similar rows share a group."""
    # Groups are halved at the mean of their widest axis, the most uneven ones in the last round:
    # up to 65,536 or 5/8 of the rows, so that files grow evenly with the number of splats.
    columns = np.ascontiguousarray(np.asarray(rows, np.float32).T)  # (D, N)
    labels = np.zeros(rows.shape[0], np.int64)
    most = min(1 << _LABEL_BITS, (5 * len(rows) + 7) // 8)
    for _ in range(_LABEL_BITS):
        sizes = np.bincount(labels)
        groups = len(sizes)
        axis, middle, largest = np.zeros(groups, np.intp), np.zeros(groups), np.full(groups, -1.0)
        for index, column in enumerate(columns):
            with np.errstate(under="ignore"):
                mean = np.bincount(labels, column, groups) / sizes
                square = np.bincount(labels, np.square(column, dtype=np.float64), groups) / sizes
                variance = square - np.square(mean)
            wider = variance > largest
            largest[wider], axis[wider], middle[wider] = variance[wider], index, mean[wider]
        middle[np.argsort(-largest * sizes, kind="stable")[most - groups :]] = np.inf
        above = columns[axis[labels], np.arange(len(labels))] > middle[labels]
        labels = np.unique(2 * labels + above, return_inverse=True)[1].reshape(-1)
    return labels


_LOSS = "holds positions in 16 bits, all else in 8, takes harmonics from a palette, and sorts"
FORMAT = Format(NAME, ".sog", is_sog, _read_archive, _write, _DEGREE, _LOSS, models=MODELS)
META_READER = Format(NAME, META, named_json(META), lambda path, _: bundle_beside(path).read())
