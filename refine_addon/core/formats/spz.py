"""SPZ files by Niantic: 19 or 20 bytes a splat and one for each coefficient, compressed as a whole.

Versions 2 and 3 (3 is written) are a gzip stream. Version 4 (only read) has a zstd stream for each
attribute, for which Python needs a module that Blender has.
"""

from __future__ import annotations

import importlib
import io
import math
import struct
import zlib
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ..affine import UNKNOWN_AXES
from ..errors import RefineError
from ..place import GZIP, SPZ, Place, is_spz
from ..splats import MODELS, Splats, above_constant, opacity, opacity_logits, unit_quaternions
from ..whole_file import explained
from .format import Format, codes, join_largest, new_file, pieces, refuse_short, split_largest

NAME, SUFFIX = "SPZ", ".spz"

_HEADER = struct.Struct("<4sIIBBBB")
"""Magic, version, splats, degree, fractional bits, flags, streams (0 before version 4)."""

_TABLE_AT = struct.Struct("<I12x")  # behind the header in version 4: byte of the table of streams
_STREAM = struct.Struct("<QQ")  # in that table: bytes of a stream, packed and unpacked
_ANTIALIASED = 1  # bit of the flags: trained with antialiasing
_SYSTEMS = "ldb rdb lub rub ldf rdf luf ruf lfd rfd lfu rfu lbd rbd lbu rbu"
"""Axes x, y and z that the extension SPZ_ADOBE_coordinate_system names, by a number from 1."""
_NAMES_AXES = struct.pack("<II", 0xADBE0003, 4)  # type and length before that number
_MOST_EXTENSIONS = 1 << 16  # bytes of extensions that are read
_VERSIONS = (2, 3, 4)
_ONE_TURN, _ZSTD = 2, 4  # versions with rotations as x y z, and with zstd streams
_DEGREES = 5  # how many, from 0
_COLOR_STEP = 0.15  # share of the codes for 1 of f_dc; they reach colours somewhat outside 0..1
_SCALE_STEPS, _LOWEST_SCALE = 16.0, -10.0
_PLACES = np.array([30, 20, 10, 0], np.uint32)  # of bits of a rotation: largest, three components
_BUCKETS = (8, 16)  # steps, 1 / 128 each, to which harmonics of degree 1 and above are rounded

_USUAL_FRACTION, _LEAST_STEPS = 12, 18
"""Bits of a position behind the point in most files; least bits of a scene's largest coordinate."""

_LARGEST_CODE = (1 << 23) - 1  # of a position: of its 24 bits, one is the sign

_INFLATION = 1032
"""Most bytes unpacked from a byte: gzip's limit, which zstd exceeds only for equal splats."""

_PIECE = 1 << 20  # bytes that a zstd stream is unpacked to at a time
_STEP = 1 << 12  # bytes of gzip unpacked at a time, into at most 4 MB


class _Header(NamedTuple):
    magic: bytes
    version: int
    splats: int
    degree: int
    fraction: int
    flags: int
    streams: int

    def widths(self) -> dict[str, int]:
        """Bytes of each attribute of a splat by name, in file order."""
        turn, rest = 3 if self.version == _ONE_TURN else 4, 3 * above_constant(self.degree)
        return {"mean": 9, "opacity": 1, "color": 3, "scale": 3, "rotation": turn, "rest": rest}

    def needed(self) -> int:
        return self.splats * sum(self.widths().values())


def _matches(path, head):
    """Whether it has the signature, or is a gzip file, maybe damaged, with this suffix."""
    return is_spz(head) or (path.suffix.lower() == SUFFIX and head.startswith(GZIP))


def _read(path, data):
    if not data[: len(SPZ)].tobytes().startswith(SPZ):
        header, body = _unpacked(path, data)
    else:
        header = _parsed(path, data[: _HEADER.size].tobytes(), len(data))
        body = _streams(path, data, header) if header.version == _ZSTD else data[_HEADER.size :]
    refuse_short(path, header.needed(), len(body), f"{header.splats} splats (unpacked)")
    widths = [*header.widths().values()]
    ends = header.splats * np.cumsum(widths)
    pairs = zip(np.split(body, ends), widths, strict=False)
    blocks = [block.reshape(header.splats, width) for block, width in pairs]

    def parts():
        for piece in pieces(header.splats):
            places, alpha, color, sizes, turns, rest = (block[piece] for block in blocks)
            means, turns = _positions(places, header.fraction), _rotations(turns)
            logits = opacity_logits(alpha[:, 0] / 255.0)
            colors = (color / 255.0 - 0.5) / _COLOR_STEP
            rest = (rest.reshape(len(rest), -1, 3) - np.float32(128.0)) / np.float32(128.0)
            yield Splats(means, sizes / _SCALE_STEPS + _LOWEST_SCALE, turns, logits, colors, rest)

    origin = f"{NAME} version {header.version}", len(data)
    model = MODELS[bool(header.flags & _ANTIALIASED)]  # default or antialiased
    file = new_file(path, origin, header.splats, header.degree, parts(), model)
    # Extensions stand in front of the streams of version 4, else behind the splats.
    held = data[:_MOST_EXTENSIONS] if header.version == _ZSTD else body[ends[-1] :]
    number = int.from_bytes(held.tobytes().partition(_NAMES_AXES)[2][:4], "little")
    return replace(file, axes=dict(enumerate(_SYSTEMS.split(), 1)).get(number, UNKNOWN_AXES))


def _parsed(path, head, size):
    """Header of a file of `size` bytes; `RefineError` for more splats than it can hold."""
    refuse_short(path, _HEADER.size, len(head), "the first bytes of an SPZ file")
    header = _Header(*_HEADER.unpack(head))
    place = Place(path)
    if header.magic != SPZ:
        place.fail(f"no SPZ file: its gzip stream begins with {header.magic!r}, expected {SPZ!r}")
    if header.version not in _VERSIONS:
        place.fail(f"SPZ version {header.version}, expected {', '.join(map(str, _VERSIONS))}")
    if header.degree >= _DEGREES:
        place.fail(f"byte 12: harmonics of degree {header.degree}, expected 0 to {_DEGREES - 1}")
    if header.fraction > _LARGEST_CODE.bit_length():
        place.fail(f"byte 13: {header.fraction} fractional bits, expected 0 to 23")
    if header.needed() > _INFLATION * size:
        problem = f"truncated: {header.splats} splats need {header.needed()} bytes unpacked"
        place.fail(f"{problem}, a file of {size} bytes holds at most {_INFLATION * size}")
    return header


def _unpacked(path, data):
    engine, body, at = zlib.decompressobj(16 + zlib.MAX_WBITS), bytearray(), 0
    try:
        head = engine.copy().decompress(data.data, _HEADER.size)
        header = _parsed(path, head, len(data))
        if header.version == _ZSTD:
            Place(path).fail("SPZ version 4 inside of gzip, expected its own header first")
        needed = _HEADER.size + header.needed()
        for at in range(0, len(data), _STEP):
            if not engine.eof:
                body += engine.decompress(data[at : at + _STEP].data)
                del body[needed + _MOST_EXTENSIONS :]
    except zlib.error as error:
        Place(path).fail(f"a damaged SPZ file: its gzip stream breaks behind byte {at} ({error})")
    if len(body) >= needed and not engine.eof:
        Place(path).fail("truncated: the gzip stream has no end")
    return header, np.frombuffer(body, np.uint8)[_HEADER.size :]


def _streams(path, data, header):
    first = _HEADER.size + _TABLE_AT.size
    refuse_short(path, first, len(data), "the first bytes of an SPZ file of version 4")
    (at,) = _TABLE_AT.unpack_from(data, _HEADER.size)
    widths = header.widths() if header.splats else {}
    lengths = {name: header.splats * width for name, width in widths.items() if width}
    if header.streams < len(lengths):
        Place(path).fail(f"byte 15: {header.streams} streams, expected {len(lengths)}")
    start = at + header.streams * _STREAM.size
    refuse_short(path, start, len(data), "the table of streams")
    body = bytearray()
    for name, length in lengths.items():
        packed, announced = _STREAM.unpack_from(data, at)
        at += _STREAM.size
        if announced != length:
            Place(path).fail(f"stream '{name}' announces {announced} bytes, expected {length}")
        end = start + packed
        refuse_short(path, end, len(data), f"stream '{name}' and what is before it")
        body += _zstd(path, name, data[start:end].tobytes(), length)
        start = end
    return np.frombuffer(body, np.uint8)


def _zstd(path, name, packed, length):
    """Bytes of a zstd stream; `RefineError` if they are not `length`."""
    try:
        try:
            module = importlib.import_module("compression.zstd")  # Python 3.14 and later
            reader = module.ZstdFile(io.BytesIO(packed))
        except ImportError:
            module = importlib.import_module("zstandard")
            reader = module.ZstdDecompressor().stream_reader(packed)
    except ImportError:
        where = "run this in Blender, which brings one, or 'pip install zstandard'"
        Place(path).fail(f"SPZ version 4 needs a module for zstd: {where}; or write version 3")
    content = bytearray()
    with explained(path, f"stream '{name}' is damaged", errors=(module.ZstdError, EOFError)):
        while len(content) <= length and (piece := reader.read(_PIECE)):
            content += piece
    if len(content) != length:
        held = "more" if len(content) > length else str(len(content))
        Place(path).fail(f"stream '{name}' holds {held} bytes, expected {length}")
    return content


def _positions(block, fraction):
    """Positions (n, 3) from 24-bit numbers, (n, 9) bytes."""
    parts = block.reshape(-1, 3, 3).astype(np.int32)
    whole = parts[..., 0] | (parts[..., 1] << 8) | (parts[..., 2] << 16)
    # Shifting up and down again repeats the sign.
    return ((whole << 8) >> 8) * math.ldexp(1.0, -fraction)


def _rotations(block):
    """Quaternions w x y z; in the file they are x y z w."""
    if block.shape[1] == 3:
        return join_largest(np.zeros(len(block), np.intp), block / 127.5 - 1.0)
    largest, *codes = (np.ascontiguousarray(block).view("<u4") >> _PLACES).T
    code = np.stack(codes, axis=1)
    size = (code & np.uint32(511)) * (math.sqrt(0.5) / 511.0)
    others = np.where(code & np.uint32(512), -size, size)
    return join_largest(largest.astype(np.intp), others)[:, [3, 0, 1, 2]]


def _write(stream, splats):
    """Write version 3; refuse coordinates beyond 8388607, the largest that it holds."""
    count, rest = len(splats), 3 * splats.sh_rest.shape[1]
    fraction, flags = _fraction(splats), _ANTIALIASED if splats.model == "antialiased" else 0
    header = _Header(SPZ, 3, count, splats.sh_degree, fraction, flags, 0)
    blocks = {name: np.empty((count, n), np.uint8) for name, n in header.widths().items()}
    for piece in pieces(count):
        batch = splats.take(piece)
        places = np.rint(np.ldexp(np.asarray(batch.means, np.float64), fraction)).astype("<i4")
        blocks["mean"][piece] = places.view(np.uint8).reshape(-1, 3, 4)[..., :3].reshape(-1, 9)
        blocks["opacity"][piece, 0] = codes(opacity(batch.opacity_logits))
        blocks["color"][piece] = codes(np.asarray(batch.sh_dc, np.float64) * _COLOR_STEP + 0.5)
        steps = (np.asarray(batch.log_scales, np.float64) - _LOWEST_SCALE) * _SCALE_STEPS
        blocks["scale"][piece] = np.rint(np.clip(steps, 0.0, 255.0))
        blocks["rotation"][piece] = _packed_rotations(batch.quaternions)
        steps = np.rint(np.clip(batch.sh_rest, -1.0, 1.0) * np.float32(128.0))
        steps = steps.astype(np.int16) + 128  # 128 is 0
        for bucket, band in zip(_BUCKETS, (slice(3), slice(3, None)), strict=True):
            steps[:, band] = (steps[:, band] + bucket // 2) // bucket * bucket
        blocks["rest"][piece] = np.minimum(steps, 255).reshape(len(batch), rest)
    engine = zlib.compressobj(wbits=16 + zlib.MAX_WBITS)
    stream.write(engine.compress(_HEADER.pack(*header)))
    stream.writelines(engine.compress(block.data) for block in blocks.values())
    stream.write(engine.flush())


def _fraction(splats):
    """Bits of a position behind the point: 12 as in other writers, if the scene's size allows."""
    farthest = float(np.abs(splats.means).max())
    _, bits = math.frexp(farthest)  # before the point
    most = _LARGEST_CODE.bit_length() - bits
    most -= int(np.rint(math.ldexp(farthest, most)) > _LARGEST_CODE)
    if most < 0:
        held = f"{NAME} holds coordinates up to {_LARGEST_CODE}"
        raise RefineError(f"a coordinate is {farthest:.10g}: {held}")
    return min(max(_USUAL_FRACTION, _LEAST_STEPS - bits), most, _LARGEST_CODE.bit_length())


def _packed_rotations(quaternions):
    largest, others = split_largest(unit_quaternions(quaternions)[:, [1, 2, 3, 0]])
    size = np.minimum(np.rint(np.abs(others) * (511.0 * math.sqrt(2.0))), 511.0)
    codes = np.column_stack([largest, size + 512.0 * (others < 0.0)]).astype(np.uint32)
    packed = np.bitwise_or.reduce(codes << _PLACES, axis=1)
    return packed.astype("<u4").view(np.uint8).reshape(-1, 4)


_LOSS = "holds positions in 24 bits, all else in 8 to 10, and harmonics in 4 to 5"
FORMAT = Format(NAME, SUFFIX, _matches, _read, _write, _DEGREES - 1, _LOSS, models=MODELS[:2])
