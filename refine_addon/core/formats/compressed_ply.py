"""SuperSplat's compressed PLY: 16 bytes a splat, in chunks of 256 that share their ranges.

A chunk stores the least and the largest position, log scale and colour of its splats. Each splat
stores its position and log scale as fractions of these ranges, in 11, 10 and 11 bits for x, y and
z, its colour likewise, in 8 bits a channel, its opacity in 8 bits, and the three smaller components
of its rotation in 10 each. Harmonics have 8 bits each. Splats are sorted, so that those of a chunk
are near each other and their ranges small.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import plyfile
from numpy.typing import NDArray

from ..errors import RefineError
from ..rendering import MODELS
from ..splats import SH_C0, Splats, above_constant, opacity, opacity_logits, unit_quaternions
from .format import (
    Format,
    Sizes,
    join_largest,
    near_ones_together,
    new_file,
    pieces,
    split_largest,
)
from .ply import Origin, SplatFile
from .ply_body import check_counts
from .ply_columns import REST_COUNTS
from .ply_header import (
    HEADER_LIMIT,
    TEXT,
    Header,
    model_of,
    raw_header,
    read_header,
    shown,
    with_model,
)

NAME = "compressed PLY"

SPLATS = 256
"""Splats of a chunk."""

_POSITION, _SCALE, _COLOR = (
    ("min_x", "min_y", "min_z", "max_x", "max_y", "max_z"),
    tuple(f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"),
    tuple(f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"),
)
"""Properties of a chunk, each group the lower ends of its three ranges and then the upper ones."""

_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")

_PLACES = ((21, 0x7FF), (11, 0x3FF), (0, 0x7FF))
"""Of x, y and z in 32 bits: how far to shift, and the largest code."""

_CHANNELS = ((24, 0xFF), (16, 0xFF), (8, 0xFF), (0, 0xFF))
"""Of red, green, blue and opacity: how far to shift, and the largest code."""

_TURNS = ((20, 0x3FF), (10, 0x3FF), (0, 0x3FF))
"""Of the three smaller components of a rotation; the two bits above say which is the largest."""

SCALE_LIMIT = 20.0
"""Log scales beyond this, above or below, are written as this."""

REST_RANGE = 8.0
"""Harmonics are written between -4 and 4, in 256 steps."""


def matches(_path: Path, head: bytes) -> bool:
    """Return whether a file is one: a PLY whose header has packed positions."""
    header = raw_header(head) or b""
    words = (line.split() for line in header.splitlines())
    return any(line[:1] == [b"property"] and line[2:] == [b"packed_position"] for line in words)


def read(path: Path, data: NDArray[np.uint8]) -> SplatFile:
    """Read a compressed PLY.

    Raises
    ------
    RefineError
        If it is truncated, or lacks an element or a property that such files have.
    """
    header = read_header(path, io.BytesIO(data[:HEADER_LIMIT].tobytes()))
    if header.order == TEXT:
        raise RefineError(f"{path}: a compressed PLY in ASCII, expected a binary one")
    body = data[len(header.raw) :]
    check_counts(header, len(body))
    elements = _elements(header, body)
    chunks, packed = _named(path, elements, "chunk"), _named(path, elements, "vertex")
    _expect(path, "vertex", packed, _PACKED, "u4")
    _expect(path, "chunk", chunks, (*_POSITION, *_SCALE), "f4")
    colored = _COLOR[0] in (chunks.dtype.names or ())
    if colored:
        _expect(path, "chunk", chunks, _COLOR, "f4")
    needed = -(-len(packed) // SPLATS)
    if len(chunks) < needed:
        raise RefineError(
            f"{path}: {len(chunks)} chunks, expected {needed} for {len(packed)} splats"
        )
    rest = _rest(path, elements, len(packed))
    degree = REST_COUNTS[rest.shape[1]]
    file, splats = new_file(
        path, Origin(NAME, len(data)), len(packed), degree, model_of(header.raw) or "default"
    )
    with np.errstate(invalid="ignore", over="ignore"):  # ranges that are not finite
        for piece in pieces(len(packed)):
            rows, ranges = packed[piece], chunks[_chunks_of(piece)]
            splats.means[piece] = _between(rows["packed_position"], ranges, _POSITION)
            splats.log_scales[piece] = _between(rows["packed_scale"], ranges, _SCALE)
            _fill_colors(splats, piece, rows["packed_color"], ranges if colored else None)
            splats.quaternions[piece] = _quaternions(rows["packed_rotation"])
            splats.sh_rest[piece] = _harmonics(rest[piece])
    return file


def _chunks_of(piece: slice) -> slice:
    """Return which chunks the splats of a piece are in; pieces begin with a chunk."""
    return slice(piece.start // SPLATS, -(-piece.stop // SPLATS))


def _elements(header: Header, body: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
    """Return the rows of every element by its name; elements with lists are refused."""
    elements, at = {}, 0
    for element, count in zip(header.elements, header.counts, strict=True):
        if any(isinstance(prop, plyfile.PlyListProperty) for prop in element.properties):
            raise RefineError(
                f"{header.path}: element {shown(element.name)} has a list, expected numbers"
            )
        kind = np.dtype(element.dtype(header.order))
        # All these bytes are there: without lists, the size that `check_counts` tests is exact.
        end = at + count * kind.itemsize
        elements[element.name] = body[at:end].view(kind) if count else np.empty(0, kind)
        at = end
    return elements


def _named(path: Path, elements: dict[str, NDArray[Any]], name: str) -> NDArray[Any]:
    if name not in elements:
        raise RefineError(f"{path}: a compressed PLY without an element '{name}'")
    return elements[name]


def _expect(
    path: Path, element: str, rows: NDArray[Any], names: tuple[str, ...], kind: str
) -> None:
    """Refuse rows that lack a property, or have it in another type."""
    for name in names:
        stored = rows.dtype[name].str[1:] if name in (rows.dtype.names or ()) else "none"
        if stored != kind:
            raise RefineError(
                f"{path}: element '{element}': property '{name}' is {stored}, expected {kind}"
            )


def _rest(path: Path, elements: dict[str, NDArray[Any]], count: int) -> NDArray[np.uint8]:
    """Return the codes of the harmonics, (count, 3 K) in the order of a plain PLY."""
    rows = elements.get("sh")
    if rows is None:
        return np.empty((count, 0), np.uint8)
    names = tuple(f"f_rest_{index}" for index in range(len(rows.dtype.names or ())))
    if len(rows) != count or len(names) not in REST_COUNTS:
        raise RefineError(
            f"{path}: element 'sh' has {len(rows)} rows of {len(names)} properties, expected "
            f"{count} rows of 9, 24, 45 or 72"
        )
    _expect(path, "sh", rows, names, "u1")
    table = rows.view(np.uint8).reshape(count, len(names))
    if rows.dtype.names == names:
        return table
    order = [(rows.dtype.names or ()).index(name) for name in names]
    return table[:, order]


def _unpacked(values: NDArray[Any], fields: tuple[tuple[int, int], ...]) -> NDArray[np.float64]:
    """Return bit fields of 32-bit numbers (n,) as shares of their largest codes, (n, F)."""
    shares = np.empty((len(values), len(fields)))
    for index, (shift, largest) in enumerate(fields):
        shares[:, index] = ((values >> np.uint32(shift)) & np.uint32(largest)) / largest
    return shares


def _packed(shares: NDArray[Any], fields: tuple[tuple[int, int], ...]) -> NDArray[np.uint32]:
    """Return shares (n, F) as 32-bit numbers (n,), the reverse of `_unpacked`."""
    packed = np.zeros(len(shares), np.uint32)
    for index, (shift, largest) in enumerate(fields):
        code = np.rint(np.clip(shares[:, index], 0.0, 1.0) * largest).astype(np.uint32)
        packed |= code << np.uint32(shift)
    return packed


def _between(
    values: NDArray[Any], chunks: NDArray[Any], names: tuple[str, ...]
) -> NDArray[np.float64]:
    """Return vectors (n, 3) from packed fractions of the ranges of their chunks."""
    return _lerp(_unpacked(values, _PLACES), chunks, names)


def _lerp(
    shares: NDArray[np.float64], chunks: NDArray[Any], names: tuple[str, ...]
) -> NDArray[np.float64]:
    for axis in range(3):
        low, high = (
            np.repeat(chunks[name].astype(np.float64), SPLATS)[: len(shares)]
            for name in (names[axis], names[axis + 3])
        )
        share = shares[:, axis]
        shares[:, axis] = low * (1.0 - share) + high * share
    return shares


def _fill_colors(
    splats: Splats, piece: slice, values: NDArray[Any], chunks: NDArray[Any] | None
) -> None:
    shares = _unpacked(values, _CHANNELS)
    colors = shares[:, :3] if chunks is None else _lerp(shares[:, :3], chunks, _COLOR)
    splats.sh_dc[piece] = (colors - 0.5) / SH_C0
    splats.opacity_logits[piece] = opacity_logits(shares[:, 3])


def _quaternions(values: NDArray[Any]) -> NDArray[np.float64]:
    others = (_unpacked(values, _TURNS) - 0.5) * np.sqrt(2.0)
    return join_largest((values >> np.uint32(30)).astype(np.intp), others)


def _harmonics(values: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return coefficients (n, K, 3) of codes (n, 3 K)."""
    planes = _REST.take(values).reshape(len(values), 3, values.shape[1] // 3)
    return planes.transpose(0, 2, 1)


_REST = np.concatenate([[0.0], (np.arange(1, 255) + 0.5) / 256.0, [1.0]]) * REST_RANGE - 4.0
"""Code -> coefficient: the middle of its step, the ends of the range at either end."""


def write(stream: BinaryIO, splats: Splats) -> None:
    """Write splats as a compressed PLY, sorted so that neighbours in space share a chunk."""
    count, rest = len(splats), 3 * splats.sh_rest.shape[1]
    order = near_ones_together(splats.means)
    stream.write(with_model(_header(count, rest), splats.model))
    ranges = np.empty((-(-count // SPLATS), 18), "<f4")
    packed = np.empty((count, 4), "<u4")
    harmonics = np.empty((count, rest), np.uint8)
    for piece in pieces(count):
        batch, ends = splats.take(order[piece]), ranges[_chunks_of(piece)]
        scales = np.clip(batch.log_scales, -SCALE_LIMIT, SCALE_LIMIT)
        colors = batch.sh_dc * np.float64(SH_C0) + 0.5
        packed[piece, 0] = _packed(_places(batch.means, ends[:, :6]), _PLACES)
        packed[piece, 1] = _rotations(batch.quaternions)
        packed[piece, 2] = _packed(_places(scales, ends[:, 6:12]), _PLACES)
        shares = np.empty((len(batch), 4))
        shares[:, :3] = _places(colors, ends[:, 12:])
        with np.errstate(under="ignore"):
            shares[:, 3] = opacity(batch.opacity_logits)
        packed[piece, 3] = _packed(shares, _CHANNELS)
        harmonics[piece] = _harmonic_codes(batch.sh_rest)
    stream.writelines(part.data for part in (ranges, packed, harmonics))


def _harmonic_codes(sh_rest: NDArray[Any]) -> NDArray[np.uint8]:
    """Return codes (n, 3 K) of coefficients (n, K, 3), the reverse of `_harmonics`."""
    planes = (
        np.asarray(sh_rest, np.float64)
        .transpose(0, 2, 1)
        .reshape(len(sh_rest), 3 * sh_rest.shape[1])
    )
    # Each code stands for the middle of its step, so that it is the whole part, not rounded.
    return np.clip((planes / REST_RANGE + 0.5) * 256.0, 0.0, 255.0).astype(np.uint8)


def _places(values: NDArray[Any], ranges: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return values (n, 3) as fractions of the ranges of their chunks; set `ranges` (C, 6)."""
    # Rounded once: of ends in float32, all values in between are in between.
    with np.errstate(under="ignore"):
        values = np.asarray(values, np.float32)
    starts = np.arange(0, len(values), SPLATS)
    ranges[:, :3] = np.minimum.reduceat(values, starts, axis=0)
    ranges[:, 3:] = np.maximum.reduceat(values, starts, axis=0)
    low, high = (
        np.repeat(ends.astype(np.float64), SPLATS, axis=0)[: len(values)]
        for ends in (ranges[:, :3], ranges[:, 3:])
    )
    extent = high - low
    return np.asarray((values - low) / np.where(extent > 0.0, extent, 1.0))


def _rotations(quaternions: NDArray[Any]) -> NDArray[np.uint32]:
    largest, others = split_largest(unit_quaternions(quaternions))
    turns = _packed(others / np.sqrt(2.0) + 0.5, _TURNS)
    return turns | (largest.astype(np.uint32) << np.uint32(30))


def _header(count: int, rest: int) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {-(-count // SPLATS)}"]
    lines += [f"property float {name}" for name in (*_POSITION, *_SCALE, *_COLOR)]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in _PACKED)]
    if rest:
        lines += [f"element sh {count}"]
        lines += [f"property uchar f_rest_{index}" for index in range(rest)]
    return "\n".join([*lines, "end_header", ""]).encode()


def sizes(count: int, degree: int) -> Sizes:
    """Return how large a file is, at most: the last chunk may have fewer splats than the others.

    The header has a comment unless the splats are of the default model.
    """
    rest = 3 * above_constant(degree)
    chunk, header = 18 * 4, with_model(_header(count, rest), "antialiased")
    return Sizes(16 + rest + chunk / SPLATS, len(header) + chunk)


FORMAT = Format(
    name=NAME,
    suffix=".compressed.ply",
    degree=3,
    loss="holds every value in 8 to 11 bits, and sorts the splats",
    matches=matches,
    read=read,
    write=write,
    sizes=sizes,
    models=MODELS,
)
