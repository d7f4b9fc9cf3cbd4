"""``.splat`` and ``.ksplat``, formats that only the file's name identifies.

``.splat`` (antimatter15) is 32 bytes a splat. ``.ksplat`` (GaussianSplats3D by mkkellogg), levels
0 to 2, is only read; in levels 1 and 2 a coordinate is 16 bits around the centre of a bucket.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

import numpy as np

from ..place import Place
from ..splats import Splats, above_constant, scales, unit_quaternions
from .format import Format, color_codes, from_colors, new_file, pieces, refuse_short

_SPLAT = np.dtype(
    [("mean", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)]
)  # color: red, green, blue, opacity; rotation: w x y z

_NO_TURN = 128.0  # code of 0 in a rotation of ``.splat``; codes from 0 to 1

_HEADER = struct.Struct("<BBxxI4x4xIHxx12xff")
"""``.ksplat``: version (2 numbers), section headers, splats, level, level 2's harmonics' range."""

_SECTION = struct.Struct("<IIIIfHxxI4xIIH")  # the fields of `_Section` from `splats` on
_HEADER_BYTES, _SECTION_BYTES = 4096, 1024  # of the two in a file; the rest of each is unused
_LEVELS, _DEGREES = 3, 3  # how many: each begins at 0
_HARMONICS = 1.5  # level 2: harmonics lie between -1.5 and 1.5 unless the header says otherwise
_MIDDLE = 32767  # levels 1 and 2: code of a bucket's middle unless the section says otherwise


def _read_splat(path, data):
    size = _SPLAT.itemsize
    count, beyond = divmod(len(data), size)
    if beyond:
        where = f"splat {count} at byte {count * size}"
        Place(path).fail(f"truncated: {where} has {beyond} bytes, expected {size}")
    stored = data.view(_SPLAT)

    def parts():
        for rows in map(stored.__getitem__, pieces(count)):
            turns = unit_quaternions(rows["rotation"] / _NO_TURN - 1.0)
            colors, none = from_colors(rows["color"] / 255.0), np.empty((len(rows), 0, 3))
            # Scales that are 0, negative or NaN become logarithms that are not finite, as in a PLY.
            yield Splats(rows["mean"], np.log(rows["scale"]), turns, *colors, none)

    return new_file(path, (".splat", len(data)), count, 0, parts())


def _write_splat(stream, splats):
    for piece in pieces(len(splats)):
        batch = splats.take(piece)
        rows = np.empty(len(batch), _SPLAT)
        rows["mean"] = batch.means
        with np.errstate(under="ignore"):
            rows["scale"] = scales(batch.log_scales)
            rows["color"] = color_codes(batch)
        turns = np.rint(unit_quaternions(batch.quaternions) * _NO_TURN + _NO_TURN)
        rows["rotation"] = np.clip(turns, 0.0, 255.0)
        stream.write(rows.data)


class _Section(NamedTuple):
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
    def rows(self) -> int:
        """Byte at which its rows begin: behind lengths and centres of buckets."""
        return self.start + 4 * self.partial + self.bucket_bytes * self.bucket_count


def _row(level, degree):
    """Dtype of one splat: rotation is w x y z, colour ends with opacity."""
    mean, number = ("<f4", "<f4") if level == 0 else ("<u2", "<f2")
    rest = ("<f4", "<f2", "u1")[level], 3 * above_constant(degree)
    fields = [("mean", mean, 3), ("scale", number, 3), ("rotation", number, 4)]
    return np.dtype([*fields, ("color", "u1", 4), ("rest", *rest)])


def _read_ksplat(path, data):
    refuse_short(path, _HEADER_BYTES, len(data), "the first bytes of a .ksplat file")
    major, minor, number, announced, level, least, largest = _HEADER.unpack_from(data)
    if (major, minor) != (0, 1):
        Place(path).fail(f".ksplat version {major}.{minor}, expected 0.1")
    if level >= _LEVELS:
        Place(path).fail(f"byte 20: compression level {level}, expected 0 to {_LEVELS - 1}")
    sections = list(_sections(path, data, number, level))
    count = sum(section.splats for section in sections)
    if count != announced:
        Place(path).fail(f"{announced} splats by byte 16, {count} by the sections")
    degree = max((section.degree for section in sections if section.splats), default=0)
    limits = np.float32(least or -_HARMONICS), np.float32(largest or _HARMONICS)
    parts = (part for section in sections for part in _parts(level, limits, section, data))
    return new_file(path, (f".ksplat level {level}", len(data)), count, degree, parts)


def _sections(path, data, count, level):
    """Yield the sections; `RefineError` for one that reaches beyond the end of the file."""
    start = _HEADER_BYTES + count * _SECTION_BYTES
    refuse_short(path, start, len(data), f"the headers of {count} sections")
    for number in range(count):
        at = _HEADER_BYTES + number * _SECTION_BYTES
        place = Place(path, f"section {number}")
        section = _Section(place, start, *_SECTION.unpack_from(data, at))
        section = section._replace(middle=section.middle or _MIDDLE)
        if section.degree >= _DEGREES:
            place.fail(f"harmonics of degree {section.degree}, expected 0 to {_DEGREES - 1}")
        if section.splats > section.room:
            place.fail(f"{section.splats} splats, expected at most {section.room}, its room")
        if level and section.bucket_bytes != 12:
            place.fail(f"{section.bucket_bytes} bytes of a bucket, expected 12")
        start = section.rows + _row(level, section.degree).itemsize * section.room
        refuse_short(path, start, len(data), f"section {number} and what is before it")
        yield section


def _parts(level, limits, section, data):
    """Yield the splats of a section; `limits` are those of its harmonics in level 2."""
    dtype = _row(level, section.degree)
    stored = data[section.rows : section.rows + section.splats * dtype.itemsize].view(dtype)
    centers, buckets = _buckets(section, data) if level else np.empty((2, 0))
    step = section.block / 2.0 / section.middle
    ends = [3 * above_constant(band) for band in range(1, section.degree)]
    for piece in pieces(section.splats):
        rows = stored[piece]
        means, logs = rows["mean"], np.log(rows["scale"].astype(np.float64))
        if level:
            means = (means - float(section.middle)) * step + centers[buckets[piece]]
        values = rows["rest"].astype(np.float32)
        if level == 2:
            values = limits[0] + values / np.float32(255.0) * (limits[1] - limits[0])
        bands = np.split(values, ends, axis=1)  # each is red, then green, then blue
        rest = [band.reshape(len(rows), 3, -1).swapaxes(1, 2) for band in bands]
        turns, colors = unit_quaternions(rows["rotation"]), from_colors(rows["color"] / 255.0)
        yield Splats(means, logs, turns, *colors, np.concatenate(rest, axis=1))


def _buckets(section, data):
    """Centres of the buckets (B, 3) and the bucket of each splat; full buckets come first."""
    middle = section.start + 4 * section.partial
    lengths = data[section.start : middle].view("<u4").astype(np.int64)
    centers = data[middle : section.rows].view("<f4").reshape(-1, 3)
    rows = np.arange(section.splats)
    in_full = min(section.full * section.bucket_size, section.splats)
    bucket = rows // max(section.bucket_size, 1)
    behind = np.searchsorted(np.cumsum(lengths), rows[in_full:] - in_full, "right")
    bucket[in_full:] = section.full + behind
    if section.splats and bucket.max() >= len(centers):
        row = int(np.argmax(bucket >= len(centers)))
        section.place.fail(f"splat {row} lies in bucket {bucket[row]} of {len(centers)}")
    return centers, bucket


def _named(suffix):
    return lambda path, head: path.suffix.lower() == suffix and head[:3] not in (b"", b"ply")


_LOSS = "holds colour, opacity and rotation in 8 bits each"
SPLAT = Format(".splat", ".splat", _named(".splat"), _read_splat, _write_splat, 0, _LOSS)
KSPLAT = Format(".ksplat", ".ksplat", _named(".ksplat"), _read_ksplat)
