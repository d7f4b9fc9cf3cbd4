"""SOG files by PlayCanvas: ``meta.json`` and WebP images, in a ZIP archive or in a folder.

A pixel of each image belongs to a splat: 16 bits of the logarithm of each coordinate, three
components of the rotation in 8, scales and colours as places in a table of 256 values, opacity in
8. Harmonics are one of up to 65,536 palettes' entries, whose values are places in a third table.

In version 1, which names no version and is only read, a table is even steps between two ends, one
table for each axis or channel, and opacity is a logit.
"""

from __future__ import annotations

import io
import math
import stat
import zipfile
import zlib
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, NoReturn, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError, reason_of
from ..foreign_files import is_sog
from ..place import Place, described
from ..rendering import MODELS, Model
from ..splats import Splats, above_constant, opacity_logits
from ..whole_file import mode_of
from .format import Format, Reader, join_largest, new_file, pieces
from .images import Codec, codec_for
from .ply import Origin, SplatFile
from .sog_write import ACROSS, COORDINATE, LABEL_BITS, META, NAME, ROTATIONS, TABLE, VERSION, write

_DEGREES = 3

_META_LIMIT = 1 << 20
"""Bytes of the longest ``meta.json`` that is read; with four tables it has some 20,000."""

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


class _Files(Protocol):
    """The files beside a ``meta.json``."""

    def read(self, name: str, limit: int) -> bytes:
        """Return what a file holds, at most `limit` bytes; more are refused."""
        ...


@dataclass(frozen=True, eq=False)
class _Archived:
    """The files of an archive, in a folder of it."""

    path: Path
    archive: zipfile.ZipFile
    folder: str = ""

    def read(self, name: str, limit: int) -> bytes:
        """See `_Files`."""
        label = (self.folder + name)[:80]
        try:
            with self.archive.open(self.folder + name) as stream:
                data = stream.read(limit + 1)
        except _BROKEN as error:
            raise RefineError(
                f"{self.path}: {label!r} in the archive cannot be read ({str(error)[:100]})"
            ) from error
        if len(data) > limit:
            raise RefineError(f"{self.path}: {label!r} in the archive has more than {limit} bytes")
        return data


@dataclass(frozen=True, eq=False)
class _Beside:
    """The files in the folder of a ``meta.json``."""

    place: Place

    def path(self, name: str) -> Path:
        """Return the path of a file; refuse one that is elsewhere or none."""
        return beside(self.place, name)

    def read(self, name: str, limit: int) -> bytes:
        """See `_Files`."""
        path = self.path(name)
        try:
            with path.open("rb") as stream:
                data = stream.read(limit + 1)
        except OSError as error:
            self.place.fail(f"{name[:80]!r} cannot be read ({reason_of(error)})")
        if len(data) > limit:
            self.place.fail(f"{name[:80]!r} has more than {limit} bytes")
        return data


def beside(place: Place, name: str) -> Path:
    """Return the path of a file that a JSON file names, in its folder or one below.

    Raises
    ------
    RefineError
        If it lies elsewhere, as an absolute path or one up, or is no file; with `place`.
    """
    steps = PurePosixPath(name).parts
    if not steps or steps[0] == "/" or ".." in steps or not set("\\:\0").isdisjoint(name):
        place.fail(f"{described(name)}, expected a file in this folder or one below")
    path = place.path.parent.joinpath(*steps)
    try:
        mode = mode_of(path)
    except (OSError, ValueError):  # a name too long, a folder that may not be entered
        mode = 0
    if not stat.S_ISREG(mode):
        place.fail(f"{described(name)} is not there")
    return path


@dataclass(frozen=True, eq=False)
class Bundle:
    """A ``meta.json``, what it says and the files that it names.

    Attributes
    ----------
    place : Place
    files : _Files
    meta : dict
    size : int
        Bytes of all files.
    codec : Codec
    """

    place: Place
    files: _Files
    meta: dict[str, Any]
    size: int
    codec: Codec

    @property
    def version(self) -> int:
        """1 or 2."""
        return VERSION if "version" in self.meta else 1

    @property
    def count(self) -> int:
        """How many splats it holds; each takes more than a byte."""
        if self.version == VERSION:
            return self.place.at("count").whole(self.meta.get("count"), 1, self.size)
        section, place = self.section("means")
        shape = place.at("shape").items(section.get("shape"))
        return place.at("shape [0]").whole(shape[0] if shape else None, 1, self.size)

    @property
    def model(self) -> Model:
        """How its splats are drawn, as splat-transform says it: a word beside the version."""
        word = self.meta.get("model", MODELS[0])
        if word not in MODELS:
            wanted = ", ".join(MODELS)
            self.place.at("model").fail(f"expected one of {wanted}, got {described(word)}")
        return cast("Model", word)

    @property
    def degree(self) -> int:
        """Highest degree of its harmonics."""
        if "shN" not in self.meta:
            return 0
        section, place = self.section("shN")
        if self.version == VERSION:
            return place.at("bands").whole(section.get("bands"), 1, _DEGREES)
        across, _ = self._size("shN", 0, self._data("shN", 0))
        degrees = {ACROSS * above_constant(degree): degree for degree in range(1, _DEGREES + 1)}
        if across not in degrees:
            place.fail(f"a palette {across} pixels wide, expected {', '.join(map(str, degrees))}")
        return degrees[across]

    def section(self, name: str) -> tuple[dict[str, Any], Place]:
        """Return what is said of an attribute, and its place."""
        place = self.place.at(name)
        return place.members(self.meta.get(name)), place

    def numbers(self, name: str, key: str, count: int) -> NDArray[np.float64]:
        """Return a list of numbers."""
        section, place = self.section(name)
        return np.array(place.at(key).numbers(section.get(key), count))

    def tables(self, name: str, channels: int) -> NDArray[np.float64]:
        """Return the values of which pixels of an attribute are places, (256, channels)."""
        if self.version == VERSION:
            return self.numbers(name, "codebook", TABLE)[:, None].repeat(channels, axis=1)
        low, high = (self.numbers(name, key, channels) for key in ("mins", "maxs"))
        return low + (high - low) * (np.arange(TABLE)[:, None] / (TABLE - 1.0))

    def pixels(
        self, name: str, index: int, least: int, most: int, width: int = 0
    ) -> NDArray[np.uint8]:
        """Return an image of `least` to `most` pixels, (height, width, 4): a file of an attribute.

        Another width than `width` is refused, unless that is 0.
        """
        data = self._data(name, index)
        across, down = self._size(name, index, data)
        if not least <= across * down <= most:
            self._fail(name, index, f"{across} x {down} pixels, expected {least}")
        if width and across != width:
            self._fail(name, index, f"{across} pixels wide, expected {width}")
        try:
            return self.codec.decode(data)
        except ValueError as error:
            self._fail(name, index, f"cannot be read ({str(error)[:100]})")

    def rows(self, name: str, index: int, count: int) -> NDArray[np.uint8]:
        """Return the pixels of `count` splats, (count, 4), of an image.

        Far more pixels are refused.
        """
        image = self.pixels(name, index, count, 4 * count + _SPARE_PIXELS)
        return image.reshape(-1, 4)[:count]

    def _size(self, name: str, index: int, data: bytes) -> tuple[int, int]:
        try:
            return self.codec.size(data)
        except ValueError as error:
            self._fail(name, index, f"cannot be read ({str(error)[:100]})")

    def _data(self, name: str, index: int) -> bytes:
        return self.files.read(self._file(name, index), 4 * self.size)

    def _file(self, name: str, index: int) -> str:
        """Return the name of an image."""
        section, place = self.section(name)
        files = place.at("files").items(section.get("files"))
        if len(files) <= index:
            place.at("files").fail(f"expected at least {index + 1} names of images")
        return place.at(f"files [{index}]").text(files[index])

    def _fail(self, name: str, index: int, problem: str) -> NoReturn:
        """Raise the error of an image."""
        replace(self.place, where="").fail(f"image {self._file(name, index)[:80]!r}: {problem}")


def read(path: Path, data: NDArray[np.uint8]) -> SplatFile:
    """Read a SOG file: an archive.

    Raises
    ------
    RefineError
        If it is damaged or of another version, or there is no library for its images.
    """
    with _opened(path, data) as archive:
        names = (name for name in archive.namelist() if name.split("/")[-1] == META)
        name = next(names, None)
        if name is None:
            raise RefineError(f"{path}: no {META} in the archive, which a SOG file has")
        files = _Archived(path, archive, name.removesuffix(META))
        return read_bundle(
            _bundle(Place(path, META), files, files.read(META, _META_LIMIT), len(data))
        )


def _opened(path: Path, data: NDArray[np.uint8]) -> zipfile.ZipFile:
    try:
        return zipfile.ZipFile(io.BytesIO(data.tobytes()))
    except _BROKEN as error:
        raise RefineError(f"{path}: the archive cannot be read ({str(error)[:100]})") from error


def matches_meta(path: Path, head: bytes) -> bool:
    """Return whether a file is the ``meta.json`` of images beside it: by its name."""
    return path.name.lower().endswith(META) and head.lstrip().startswith(b"{")


def read_meta(path: Path, data: NDArray[np.uint8]) -> SplatFile:
    """Read the ``meta.json`` of a SOG whose images lie beside it.

    Raises
    ------
    RefineError
        See `read`; also if it names a file that lies elsewhere.
    """
    return read_bundle(bundle_beside(path, data.tobytes()))


def bundle_beside(path: Path, data: bytes | None = None) -> Bundle:
    """Return a ``meta.json`` and the images beside it; `data` is what the file holds, if known.

    Raises
    ------
    RefineError
        See `read_meta`.
    """
    place = Place(path)
    files = _Beside(place)
    if data is None:
        data = files.read(path.name, _META_LIMIT)
    if len(data) > _META_LIMIT:
        place.fail(f"{len(data)} bytes, expected at most {_META_LIMIT}")
    bundle = _bundle(place, files, data, len(data))
    sections = [section for section in bundle.meta.values() if isinstance(section, dict)]
    named = [section["files"] for section in sections if isinstance(section.get("files"), list)]
    names = {name for group in named for name in group if isinstance(name, str)}
    sizes = (files.path(name).stat().st_size for name in names)
    return replace(bundle, size=len(data) + sum(sizes))


def _bundle(place: Place, files: _Files, data: bytes, size: int) -> Bundle:
    meta = place.members(place.parsed(data))
    version = meta.get("version", VERSION)
    if version != VERSION:
        place.at("version").fail(f"expected {VERSION}, got {described(version)}")
    return Bundle(place, files, meta, size, codec_for(place.path))


def read_bundle(bundle: Bundle) -> SplatFile:
    """Return the splats of a bundle.

    Raises
    ------
    RefineError
        See `read`.
    """
    origin = Origin(f"{NAME} version {bundle.version}", bundle.size)
    file, splats = new_file(bundle.place.path, origin, bundle.count, bundle.degree, bundle.model)
    with np.errstate(over="ignore", invalid="ignore"):  # any number may stand in meta.json
        _fill_means(bundle, splats)
        _fill_rotations(bundle, splats)
        _fill_from_tables(bundle, splats)
        if splats.sh_degree:
            _fill_harmonics(bundle, splats)
    return file


def _fill_means(bundle: Bundle, splats: Splats) -> None:
    low, high = (bundle.numbers("means", key, 3) for key in ("mins", "maxs"))
    lower, upper = (bundle.rows("means", index, len(splats)) for index in (0, 1))
    for piece in pieces(len(splats)):
        code = lower[piece, :3] + upper[piece, :3] * 256.0
        logs = low + (high - low) * (code / COORDINATE)
        splats.means[piece] = np.sign(logs) * np.expm1(np.abs(logs))


def _fill_rotations(bundle: Bundle, splats: Splats) -> None:
    """Set quaternions from pixels: three smaller components, and which is left out."""
    pixels = bundle.rows("quats", 0, len(splats))
    wrong = pixels[:, 3] < ROTATIONS
    if wrong.any():
        index = int(np.argmax(wrong))
        Place(bundle.place.path, f"rotation of splat {index}").fail(
            f"alpha {pixels[index, 3]}, expected {ROTATIONS} to 255"
        )
    for piece in pieces(len(splats)):
        others = (pixels[piece, :3] / 127.5 - 1.0) / math.sqrt(2.0)
        largest = (pixels[piece, 3] - ROTATIONS).astype(np.intp)
        splats.quaternions[piece] = join_largest(largest, others)


def _fill_from_tables(bundle: Bundle, splats: Splats) -> None:
    """Set scales, colours and, from the alpha of the colours' image, opacities."""
    scales, scale_tables = bundle.rows("scales", 0, len(splats)), bundle.tables("scales", 3)
    with_opacity = 4 if bundle.version == 1 else 3
    colors, color_tables = bundle.rows("sh0", 0, len(splats)), bundle.tables("sh0", with_opacity)
    for piece in pieces(len(splats)):
        splats.log_scales[piece] = _looked_up(scale_tables, scales[piece, :3])
        splats.sh_dc[piece] = _looked_up(color_tables[:, :3], colors[piece, :3])
        alpha = colors[piece, 3]
        splats.opacity_logits[piece] = (
            color_tables[alpha, 3] if bundle.version == 1 else opacity_logits(alpha / 255.0)
        )


def _looked_up(tables: NDArray[np.float64], places: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the values of places (n, C) in a table for each channel, (256, C)."""
    return np.asarray(tables[places, np.arange(places.shape[1])])


def _fill_harmonics(bundle: Bundle, splats: Splats) -> None:
    """Set harmonics from a palette, of which each splat has an entry."""
    palette = _palette(bundle, splats.sh_degree)
    pixels = bundle.rows("shN", 1, len(splats)).astype(np.intp)
    labels = pixels[:, 0] + 256 * pixels[:, 1]
    if labels.max() >= len(palette):
        index = int(np.argmax(labels >= len(palette)))
        Place(bundle.place.path, f"splat {index}").fail(
            f"entry {labels[index]} of {len(palette)} in the palette"
        )
    for piece in pieces(len(splats)):
        splats.sh_rest[piece] = palette[labels[piece]]


def _palette(bundle: Bundle, degree: int) -> NDArray[np.float32]:
    """Return the palette of harmonics, (P, K, 3)."""
    coefficients = above_constant(degree)
    width, most = ACROSS * coefficients, 1 << LABEL_BITS
    section, place = bundle.section("shN")
    if bundle.version == VERSION:
        table = bundle.tables("shN", 1)[:, 0]
        entries = place.at("count").whole(section.get("count"), 1, most)
        needed = width * -(-entries // ACROSS)
        image = bundle.pixels("shN", 0, needed, 4 * needed + _SPARE_PIXELS, width)
    else:
        low, high = (place.at(key).number(section.get(key)) for key in ("mins", "maxs"))
        table = np.linspace(low, high, TABLE)
        image = bundle.pixels("shN", 0, width, most * coefficients, width)
        entries = ACROSS * len(image)
    height = -(-entries // ACROSS)
    places = image[:height, :, :3].reshape(height * ACROSS, coefficients, 3)[:entries]
    return np.asarray(table.astype(np.float32)[places])


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

META_READER = Reader(name=NAME, suffix=META, matches=matches_meta, read=read_meta)
