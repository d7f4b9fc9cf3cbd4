"""``.ksplat`` files of GaussianSplats3D (mkkellogg), which are read: levels 0 to 2, degrees 0 to 2.

A header, a header for each section, then the sections. In levels 1 and 2 the splats of a section
lie in buckets: a coordinate is 16 bits around the centre of the bucket, scales and rotations are
float16. The files have no signature and are known by their name alone.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..place import Place
from ..splats import SH_C0, Splats, above_constant, opacity_logits, unit_quaternions
from .format import Reader, new_file, pieces, refuse_short
from .ply import Origin, SplatFile

NAME = ".ksplat"

_HEADER = struct.Struct("<BBxxI4x4xIHxx12xff")
"""Version in two parts, section headers, splats, level; least and largest harmonic of level 2."""

_SECTION = struct.Struct("<IIIIfHxxI4xIIH")
"""See `_Section`, but for its place and start."""

_HEADER_BYTES, _SECTION_BYTES = 4096, 1024
"""What the two take in a file; the rest of each is not used."""

_LEVELS, _DEGREES = 3, 3

_HARMONICS = 1.5
"""Level 2: harmonics lie between this and minus this where the header says nothing."""

_MIDDLE = 32767
"""Levels 1 and 2: code of the middle of a bucket where a section says nothing."""


class _Section(NamedTuple):
    """What the header of a section says, and where the section stands."""

    place: Place
    start: int
    splats: int
    room: int  # splats that there is room for
    bucket_size: int  # splats of a full bucket
    bucket_count: int
    block: float  # side of a bucket, in the unit of positions
    bucket_bytes: int
    middle: int  # code of the middle of a bucket
    full: int  # buckets that are full: they come first
    partial: int  # the other buckets
    degree: int

    @property
    def before_rows(self) -> int:
        """Bytes of lengths and centres of buckets."""
        return 4 * self.partial + self.bucket_bytes * self.bucket_count


@dataclass(frozen=True)
class _Header:
    """What the first bytes say."""

    sections: int
    count: int
    level: int
    least: float
    largest: float

    def row(self, degree: int) -> np.dtype[Any]:
        """Return what is stored of a splat: rotation is w x y z, colour has opacity behind."""
        mean, number = ("<f4", "<f4") if self.level == 0 else ("<u2", "<f2")
        rest = ("<f4", "<f2", "u1")[self.level]
        return np.dtype(
            [
                ("mean", mean, 3),
                ("scale", number, 3),
                ("rotation", number, 4),
                ("color", "u1", 4),
                ("rest", rest, 3 * above_constant(degree)),
            ]
        )


def matches(path: Path, head: bytes) -> bool:
    """Return whether a file is taken for one: by its name, unless it is a PLY."""
    return path.suffix.lower() == READER.suffix and bool(head) and not head.startswith(b"ply")


def read(path: Path, data: NDArray[np.uint8]) -> SplatFile:
    """Read a ``.ksplat`` file.

    Raises
    ------
    RefineError
        If it is truncated or damaged, or of another version.
    """
    header = _parsed(path, data)
    sections = list(_sections(path, data, header))
    count = sum(section.splats for section in sections)
    if count != header.count:
        Place(path).fail(f"{header.count} splats by byte 16, {count} by the sections")
    degree = max((section.degree for section in sections if section.splats), default=0)
    origin = Origin(f"{NAME} level {header.level}", len(data))
    file, splats = new_file(path, origin, count, degree)
    splats.sh_rest[:] = 0.0
    start = 0
    # Any bits may stand in a file: scales that are no sizes, ranges that are no numbers.
    with np.errstate(divide="ignore", invalid="ignore", over="ignore", under="ignore"):
        for section in sections:
            _fill(splats.take(slice(start, start + section.splats)), header, section, data)
            start += section.splats
    return file


def _parsed(path: Path, data: NDArray[np.uint8]) -> _Header:
    """Return what the first bytes say, or refuse them."""
    refuse_short(path, _HEADER_BYTES, len(data), "the first bytes of a .ksplat file")
    fields = _HEADER.unpack(data[: _HEADER.size].tobytes())
    major, minor, sections, count, level, least, largest = fields
    if (major, minor) != (0, 1):
        Place(path).fail(f".ksplat version {major}.{minor}, expected 0.1")
    if level >= _LEVELS:
        Place(path).fail(f"byte 20: compression level {level}, expected 0 to {_LEVELS - 1}")
    needed = _HEADER_BYTES + sections * _SECTION_BYTES
    refuse_short(path, needed, len(data), f"the headers of {sections} sections")
    return _Header(sections, count, level, least or -_HARMONICS, largest or _HARMONICS)


def _sections(path: Path, data: NDArray[np.uint8], header: _Header) -> Iterator[_Section]:
    """Yield the sections; refuse those that reach beyond the end of the file."""
    start = _HEADER_BYTES + header.sections * _SECTION_BYTES
    for number in range(header.sections):
        at = _HEADER_BYTES + number * _SECTION_BYTES
        place = Place(path, f"section {number}")
        fields = _SECTION.unpack(data[at : at + _SECTION.size].tobytes())
        section = _Section(place, start, *fields)
        section = section._replace(middle=section.middle or _MIDDLE)
        if section.degree >= _DEGREES:
            place.fail(f"harmonics of degree {section.degree}, expected 0 to {_DEGREES - 1}")
        if section.splats > section.room:
            place.fail(f"{section.splats} splats, expected at most {section.room}, its room")
        if header.level and section.bucket_bytes != 12:
            place.fail(f"{section.bucket_bytes} bytes of a bucket, expected 12")
        start += section.before_rows + header.row(section.degree).itemsize * section.room
        refuse_short(path, start, len(data), f"section {number} and what is before it")
        yield section


def _fill(splats: Splats, header: _Header, section: _Section, data: NDArray[np.uint8]) -> None:
    """Set the splats of a section."""
    start = section.start + section.before_rows
    dtype = header.row(section.degree)
    stored = data[start : start + section.splats * dtype.itemsize].view(dtype)
    centers, buckets = _buckets(section, data) if header.level else (None, None)
    step = section.block / 2.0 / section.middle
    for piece in pieces(section.splats):
        rows = stored[piece]
        if centers is None or buckets is None:
            splats.means[piece] = rows["mean"]
        else:
            around = (rows["mean"] - float(section.middle)) * step
            splats.means[piece] = around + centers[buckets[piece]]
        splats.log_scales[piece] = np.log(rows["scale"].astype(np.float64))
        splats.quaternions[piece] = unit_quaternions(rows["rotation"])
        shares = rows["color"] / 255.0  # (n, 4)
        splats.sh_dc[piece] = (shares[:, :3] - 0.5) / SH_C0
        splats.opacity_logits[piece] = opacity_logits(shares[:, 3])
        splats.sh_rest[piece, : above_constant(section.degree)] = _harmonics(rows["rest"], header)


def _buckets(
    section: _Section, data: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Return the centres of the buckets (B, 3), and in which bucket each splat lies.

    Full buckets come first; the lengths of the others stand before the centres.
    """
    middle = section.start + 4 * section.partial
    lengths = data[section.start : middle].view("<u4").astype(np.int64)
    end = middle + section.bucket_bytes * section.bucket_count
    centers = data[middle:end].view("<f4").reshape(-1, 3)
    rows = np.arange(section.splats)
    in_full = min(section.full * section.bucket_size, section.splats)
    bucket = rows // max(section.bucket_size, 1)
    behind = np.searchsorted(np.cumsum(lengths), rows[in_full:] - in_full, "right")
    bucket[in_full:] = section.full + behind
    if section.splats and bucket.max() >= len(centers):
        row = int(np.argmax(bucket >= len(centers)))
        section.place.fail(f"splat {row} lies in bucket {bucket[row]} of {len(centers)}")
    return centers, bucket


def _harmonics(stored: NDArray[Any], header: _Header) -> NDArray[Any]:
    """Return harmonics (n, K, 3): each band is stored red, then green, then blue."""
    values = stored.astype(np.float32)
    if header.level == 2:
        low, high = np.float32(header.least), np.float32(header.largest)
        values = low + values / np.float32(255.0) * (high - low)
    bands: list[NDArray[np.float32]] = []
    at = 0
    while at < values.shape[1]:
        width = 2 * len(bands) + 3
        band = values[:, at : at + 3 * width].reshape(-1, 3, width)
        bands.append(band.swapaxes(1, 2))
        at += 3 * width
    return np.concatenate(bands, axis=1) if bands else values.reshape(len(values), 0, 3)


READER = Reader(name=NAME, suffix=".ksplat", matches=matches, read=read)
