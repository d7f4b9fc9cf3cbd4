"""SuperSplat's compressed PLY: 16 bytes a splat, in chunks of 256 splats that share ranges.

Position and log scale (11, 10 and 11 bits) and colour (8 each) are fractions of their chunk's
ranges. Opacity has 8 bits, the three smaller components of the rotation 10 each, harmonics 8 each.
"""

from __future__ import annotations

import numpy as np

from ..place import Place
from ..splats import MODELS, SH_C0, Splats, opacity, unit_quaternions
from ..visibility.scene import nearby_order
from . import ply
from .format import Format, from_colors, join_largest, new_file, pieces, split_largest
from .ply_columns import REST_COUNTS

NAME = "compressed PLY"
SPLATS = 256  # of a chunk
_NAMES = [(end, axis) for end in ("min", "max") for axis in "xyz"]
_POSITION = tuple(f"{end}_{axis}" for end, axis in _NAMES)
_SCALE = tuple(f"{end}_scale_{axis}" for end, axis in _NAMES)
_COLOR = tuple(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb")
"""Properties of a chunk: in each group the three lower ends of ranges, then the upper ones."""

_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_PLACES = ((21, 0x7FF), (11, 0x3FF), (0, 0x7FF))  # of x, y, z: shift, largest code
_CHANNELS = ((24, 0xFF), (16, 0xFF), (8, 0xFF), (0, 0xFF))  # likewise red, green, blue, opacity

_TURNS = ((20, 0x3FF), (10, 0x3FF), (0, 0x3FF))
"""Likewise of a rotation; the two bits above are the number of the largest component."""

SCALE_LIMIT = 20.0  # log scales are clipped to ±20
REST_RANGE = 8.0  # harmonics are written between -4 and 4, in 256 steps


def _matches(_path, head):
    words = (line.split() for line in (ply.raw_header(head) or b"").splitlines())
    return any(line[:1] == [b"property"] and line[2:] == [b"packed_position"] for line in words)


def _read(path, data):
    header = ply.read_header(path, data[: ply.HEADER_LIMIT].tobytes())
    place = Place(path)
    if header.order == ply.TEXT:
        place.fail("a compressed PLY in ASCII, expected a binary one")
    body = data[len(header.raw) :]
    elements = {}
    for element, at in zip(header.elements, ply.row_ranges(header, len(body)), strict=True):
        if ply.has_lists(element):
            place.fail(f"element {ply.shown(element.name)} has a list, expected numbers")
        stored, kind = body[at], np.dtype(element.dtype(header.order))
        elements[element.name] = stored.view(kind) if len(stored) else np.empty(0, kind)

    def rows_of(name, properties, kind):
        """Rows of an element; `RefineError` unless it has these properties, of type `kind`."""
        if name not in elements:
            place.fail(f"a compressed PLY without an element '{name}'")
        rows = elements[name]
        for key in properties:
            stored = rows.dtype[key].str[1:] if key in (rows.dtype.names or ()) else "none"
            if stored != kind:
                place.fail(f"element '{name}': property '{key}' is {stored}, expected {kind}")
        return rows

    packed = rows_of("vertex", _PACKED, "u4")
    ranges = rows_of("chunk", (*_POSITION, *_SCALE), "f4")
    colored = _COLOR[0] in (ranges.dtype.names or ())
    rows_of("chunk", _COLOR if colored else (), "f4")
    count, needed = len(packed), -(-len(packed) // SPLATS)
    if len(ranges) < needed:
        place.fail(f"{len(ranges)} chunks, expected {needed} for {count} splats")
    rest = np.empty((count, 0), np.uint8)
    if "sh" in elements and elements["sh"].dtype.names:  # gsplat's may be without properties
        held = elements["sh"]
        names = [f"f_rest_{index}" for index in range(len(held.dtype.names or ()))]
        if len(held) != count or len(names) not in REST_COUNTS:
            got = f"element 'sh' has {len(held)} rows of {len(names)} properties"
            place.fail(f"{got}, expected {count} rows of 9, 24, 45 or 72")
        held = rows_of("sh", tuple(names), "u1")
        rest = np.stack([held[name] for name in names], axis=1)
    model, degree = ply.model_of(header.raw) or "default", REST_COUNTS[rest.shape[1]]

    def parts():
        for piece in pieces(count):
            here = ranges[_chunks_of(piece)]
            places, turns, sizes, colors = (packed[name][piece] for name in _PACKED)
            means = _between(_unpacked(places, _PLACES), here, _POSITION)
            logs = _between(_unpacked(sizes, _PLACES), here, _SCALE)
            shares = _unpacked(colors, _CHANNELS)
            if colored:
                shares[:, :3] = _between(shares[:, :3], here, _COLOR)
            others = (_unpacked(turns, _TURNS) - 0.5) * np.sqrt(2.0)
            quaternions = join_largest((turns >> np.uint32(30)).astype(np.intp), others)
            planes = _REST.take(rest[piece]).reshape(len(means), 3, rest.shape[1] // 3)
            harmonics = planes.transpose(0, 2, 1)
            yield Splats(means, logs, quaternions, *from_colors(shares), harmonics)

    return new_file(path, (NAME, len(data)), count, degree, parts(), model)


def _chunks_of(piece):
    return slice(piece.start // SPLATS, -(-piece.stop // SPLATS))


def _unpacked(values, fields):
    """F bit fields of 32-bit numbers, (n,), as shares of their largest codes, (n, F)."""
    shifts, largest = np.array(fields, np.uint32).T
    return ((values[:, None] >> shifts) & largest) / largest


def _packed(shares, fields):
    """Shares (n, F) as 32-bit numbers (n,), the reverse of `_unpacked`."""
    shifts, largest = np.array(fields, np.uint32).T
    codes = np.rint(np.clip(shares, 0.0, 1.0) * largest).astype(np.uint32)
    return np.bitwise_or.reduce(codes << shifts, axis=1)


def _between(shares, chunks, names):
    """Vectors, (n, 3), from shares, (n, 3), of their chunks' ranges."""
    ends = np.stack([chunks[name] for name in names], axis=1).astype(np.float64)
    low, high = np.hsplit(np.repeat(ends, SPLATS, axis=0)[: len(shares)], 2)
    return low * (1.0 - shares) + high * shares


_REST = np.concatenate([[0.0], (np.arange(1, 255) + 0.5) / 256.0, [1.0]]) * REST_RANGE - 4.0
"""Code -> coefficient: the middle of its step, or for codes 0 and 255 the ends of the range."""


def _write(stream, splats):
    """Write splats as a compressed PLY, sorted so that neighbours in space share a chunk."""
    count, rest = len(splats), 3 * splats.sh_rest.shape[1]
    order = nearby_order(splats.means)
    stream.write(ply.with_model(_header(count, rest), splats.model))
    ranges = np.empty((-(-count // SPLATS), 18), "<f4")
    packed = np.empty((count, 4), "<u4")
    harmonics = np.empty((count, rest), np.uint8)
    for piece in pieces(count):
        batch, ends = splats.take(order[piece]), ranges[_chunks_of(piece)]
        scales = np.clip(batch.log_scales, -SCALE_LIMIT, SCALE_LIMIT)
        colors = batch.sh_dc * np.float64(SH_C0) + 0.5
        packed[piece, 0] = _packed(_places(batch.means, ends[:, :6]), _PLACES)
        largest, others = split_largest(unit_quaternions(batch.quaternions))
        turns = _packed(others / np.sqrt(2.0) + 0.5, _TURNS)
        packed[piece, 1] = turns | (largest.astype(np.uint32) << np.uint32(30))
        packed[piece, 2] = _packed(_places(scales, ends[:, 6:12]), _PLACES)
        shares = np.column_stack([_places(colors, ends[:, 12:]), opacity(batch.opacity_logits)])
        packed[piece, 3] = _packed(shares, _CHANNELS)
        planes = np.asarray(batch.sh_rest, np.float64).transpose(0, 2, 1).reshape(len(batch), rest)
        # Cut off, not rounded, since a code stands for the middle of its step.
        harmonics[piece] = np.clip((planes / REST_RANGE + 0.5) * 256.0, 0.0, 255.0)
    stream.writelines(part.data for part in (ranges, packed, harmonics))


def _places(values, ranges):
    """Values, (n, 3), as fractions of the ranges of their C chunks; sets `ranges`, (C, 6)."""
    # In float32 like the ranges, so that no value lies beyond the end of its range.
    with np.errstate(under="ignore"):
        values = np.asarray(values, np.float32)
    starts = np.arange(0, len(values), SPLATS)
    ranges[:, :3] = np.minimum.reduceat(values, starts, axis=0)
    ranges[:, 3:] = np.maximum.reduceat(values, starts, axis=0)
    each = np.repeat(ranges.astype(np.float64), SPLATS, axis=0)[: len(values)]
    low, extent = each[:, :3], each[:, 3:] - each[:, :3]
    return (values - low) / np.where(extent > 0.0, extent, 1.0)


def _moves(means):
    """How far writing moves the one of N positions, (N, 3), that it moves farthest."""
    order, largest, farthest = nearby_order(means), [k for _, k in _PLACES], 0.0
    for piece in pieces(len(means)):
        ends = np.empty((-(-len(order[piece]) // SPLATS), 6))
        codes = _places(means[order[piece]], ends) * largest
        steps = np.repeat((ends[:, 3:] - ends[:, :3]) / largest, SPLATS, axis=0)[: len(codes)]
        moves = (codes - np.rint(codes)) * steps
        farthest = max(farthest, float(np.linalg.norm(moves, axis=1).max()))
    return farthest


def _header(count, rest):
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {-(-count // SPLATS)}"]
    lines += [f"property float {name}" for name in (*_POSITION, *_SCALE, *_COLOR)]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in _PACKED)]
    lines += [f"element sh {count}"] if rest else []
    lines += [f"property uchar f_rest_{index}" for index in range(rest)]
    return "\n".join([*lines, "end_header", ""]).encode()


_LOSS = "holds every value in 8 to 11 bits, and sorts the splats"
FORMAT = Format(NAME, ".compressed.ply", _matches, _read, _write, 3, _LOSS, MODELS, _moves)
