"""SPZ by hand: every version, and files that lie."""

from __future__ import annotations

import gzip
import importlib
import re
import struct
import tracemalloc
import zlib

import numpy as np
import pytest

from refine_addon.core import RefineError, read_splats, write_splats
from tests.strategies import plain_ply

MEAN = bytes([0, 16, 0, 0, 240, 255, 1, 0, 0])
"""1, -1 and 1/4096 with 12 bits behind the point: 0x001000, 0xfff000, 1."""

REST = [255, 0, 128, *[128] * 6]
"""Degree 1: red, green and blue of the first harmonic are 127/128, -1 and 0."""

TURN = {2: [128, 255, 0], 3: list(struct.pack("<I", 3 << 30 | 511 << 20 | 1 << 9 | 0))}
"""Version 2: x y z near 0, 1 and -1. Version 3: w is left out, x is sqrt(1/2), z is minus 0."""


def body(version: int) -> list[bytes]:
    """Return the attributes of one splat of degree 1."""
    turn = TURN[min(version, 3)]
    return [MEAN, b"\x80", bytes([255, 128, 0]), bytes([160, 0, 255]), bytes(turn), bytes(REST)]


def header(version: int, count: int = 1, degree: int = 1, streams: int = 0) -> bytes:
    """Return the first 16 bytes."""
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, 0, streams)


def version_4(parts: list[bytes], *, count: int = 1) -> bytes:
    """Return a file of version 4; skips where nothing compresses zstd."""
    zstandard = pytest.importorskip("zstandard")
    packed = [zstandard.ZstdCompressor().compress(part) for part in parts]
    table = b"".join(
        struct.pack("<QQ", len(short), len(part)) for short, part in zip(packed, parts, strict=True)
    )
    first = header(4, count, 1, len(parts)) + struct.pack("<I12x", 32)
    return first + table + b"".join(packed)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_every_version_is_read(tmp_path, version):
    """Values by hand: .5 is opacity 128/255; (255/255 - .5) / .15 = 10/3; 160/16 - 10 = 0."""
    parts = body(version)
    data = version_4(parts) if version == 4 else gzip.compress(header(version) + b"".join(parts))
    (tmp_path / "a.spz").write_bytes(data)

    file = read_splats(tmp_path / "a.spz")

    splats = file.splats()
    assert file.format == f"SPZ version {version}"
    assert splats.means.tolist() == [[1.0, -1.0, 1.0 / 4096]]
    np.testing.assert_allclose(splats.opacity_logits, [np.log(128 / 127)], rtol=1e-5)
    np.testing.assert_allclose(splats.sh_dc, [[10 / 3, 1 / 76.5, -10 / 3]], rtol=1e-5)
    assert splats.log_scales.tolist() == [[0.0, -10.0, 5.9375]]
    turn = [0, 1 / 255, 1, -1] if version == 2 else [0.5**0.5, 0.5**0.5, 0, 0]
    np.testing.assert_allclose(splats.quaternions, [turn], atol=1e-6)
    first = splats.sh_rest[0, 0].tolist()
    assert first == [127 / 128, -1.0, 0.0]
    assert not splats.sh_rest[0, 1:].any()


def test_version_4_says_what_is_missing(tmp_path, monkeypatch):
    """Without a module for zstd."""
    (tmp_path / "a.spz").write_bytes(version_4(body(4)))

    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)

    with pytest.raises(RefineError, match="SPZ version 4 needs a module for zstd: run this in Ble"):
        read_splats(tmp_path / "a.spz")


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (gzip.compress(header(1) + bytes(99)), "SPZ version 1, expected 2, 3, 4"),
        (gzip.compress(header(5) + bytes(99)), "SPZ version 5, expected 2, 3, 4"),
        (gzip.compress(header(3, degree=5) + bytes(99)), "byte 12: harmonics of degree 5, expec"),
        (gzip.compress(header(3, 2**32 - 1) + bytes(99)), "truncated: 4294967295 splats need "),
        (gzip.compress(header(3, 1000) + bytes(99)), "truncated: 1000 splats (unpacked) need 29"),
        (gzip.compress(header(3) + bytes(29))[:-2], "truncated: the gzip stream has no end"),
        (
            gzip.compress(header(3) + bytes(29))[:-8] + bytes(8),
            "a damaged SPZ file: its gzip stream breaks behind ",
        ),
        (gzip.compress(header(4) + bytes(99)), "SPZ version 4 inside of gzip"),
        (
            header(4, 2**32 - 1, streams=6) + struct.pack("<I12x", 32) + bytes(96),
            "truncated: 4294967295 splats need ",
        ),
        (header(4, streams=2) + struct.pack("<I12x", 32) + bytes(96), "byte 15: 2 streams, expect"),
        (header(4, streams=6) + struct.pack("<I12x", 2**32 - 1), "truncated: the table of streams"),
        (header(4, streams=6), "truncated: the first bytes of an SPZ file of version 4 need 32 b"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",  # gzip holds the time
)
def test_a_file_that_lies_is_refused(tmp_path, data, expected):
    """With the place, what was found and what was expected, and memory that the file accounts for.

    A count of 4294967295 would be 120 GB.
    """
    path = tmp_path / "a.spz"
    path.write_bytes(data)
    tracemalloc.start()

    with pytest.raises(RefineError, match=re.escape(f"{path}: {expected}")):
        read_splats(path)

    assert tracemalloc.get_traced_memory()[1] < 3_000_000
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"\x1f\x8b\x08\0" + bytes(6) + b"\x06" + bytes(99), "a damaged SPZ file: its gzip strea"),
        (gzip.compress(b"NGSX" + bytes(99)), "no SPZ file: its gzip stream begins with b'NGSX', e"),
        (b"NGXP" + bytes(99), "a damaged SPZ file: begins with b'NGXP', expected b'NGSP' or "),
    ],
    ids=["stream", "inside", "open"],
)  # fmt: skip
def test_a_file_whose_beginning_is_damaged_is_still_called_spz(tmp_path, data, expected):
    """It was told to be unpacked. A gzip header has 10 bytes; a block of type 3 does not exist."""
    path = tmp_path / "a.SPZ"
    path.write_bytes(data)

    with pytest.raises(RefineError, match=re.escape(f"{path}: {expected}")):
        read_splats(path)


@pytest.mark.parametrize(("at", "behind"), [(5000, 4096), (9000, 8192)])
def test_where_a_stream_breaks_is_named_by_4096_bytes(tmp_path, at, behind):
    """A stream of stored blocks, cut within one and followed by a block of type 3."""
    stored = gzip.compress(header(3, 1000) + bytes(29_000), compresslevel=0)
    path = tmp_path / "a.spz"
    first = 10 + 5 + 65535  # header, head of a block, its content
    assert len(stored) < first
    length = at - 15
    block = struct.pack("<BHH", 0, length, 0xFFFF ^ length) + stored[15 : 15 + length]
    path.write_bytes(stored[:10] + block + b"\x06" + bytes(20_000))

    with pytest.raises(RefineError, match=f"breaks behind byte {behind} "):
        read_splats(path)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda parts: [b"\0" * 10**6, *parts[1:]], "stream 'mean' announces 1000000 bytes, exp"),
        (
            lambda parts: [*parts[:1], b"", *parts[2:]],
            "stream 'opacity' announces 0 bytes, exp",
        ),
    ],
)
def test_streams_of_another_length_are_refused(tmp_path, change, expected):
    """Before they are unpacked."""
    path = tmp_path / "a.spz"
    path.write_bytes(version_4(change(body(4))))

    with pytest.raises(RefineError, match=re.escape(f"{path}: {expected}")):
        read_splats(path)


def test_a_stream_that_holds_more_than_it_announces_is_refused(tmp_path):
    """10 MB in a few bytes, for one byte of opacity: unpacked a piece at a time."""
    parts = body(4)
    parts[1] = b"\0" * 10**7
    data = bytearray(version_4(parts))
    data[32 + 16 + 8 : 32 + 16 + 16] = struct.pack("<Q", 1)  # the table's word on it
    path = tmp_path / "a.spz"
    path.write_bytes(data)
    del parts, data
    tracemalloc.start()

    with pytest.raises(RefineError, match="stream 'opacity' holds more bytes, expected 1"):
        read_splats(path)

    assert tracemalloc.get_traced_memory()[1] < 5_000_000
    tracemalloc.stop()


def test_a_count_that_the_file_is_too_small_for_is_refused(tmp_path):
    """Zstd packs zeros 30,000 times as small: 400,000 splats of 29 bytes are 11.6 MB in 1 kB."""
    widths = [len(part) for part in body(4)]
    path = tmp_path / "a.spz"
    path.write_bytes(version_4([bytes(400_000 * width) for width in widths], count=400_000))
    assert path.stat().st_size < 2000
    tracemalloc.start()

    with pytest.raises(RefineError, match="truncated: 400000 splats need 11600000 bytes unpacked"):
        read_splats(path)

    assert tracemalloc.get_traced_memory()[1] < 1_000_000
    tracemalloc.stop()


def test_what_follows_the_splats_is_read_once(tmp_path, monkeypatch):
    """Extensions may, up to the checksum: what is left was copied for every piece of them."""
    path = tmp_path / "a.spz"
    extension = np.random.default_rng(0).bytes(3_000_000)
    path.write_bytes(gzip.compress(header(3) + bytes(29) + extension, compresslevel=0))
    handed = []
    real = zlib.decompressobj

    class Engine:
        def __init__(self, *window, **keywords):
            self._real = real(*window, **keywords)

        def __getattr__(self, name):
            return getattr(self._real, name)

        def decompress(self, data, *limit):
            handed.append(len(data))
            return self._real.decompress(data, *limit)

    monkeypatch.setattr(zlib, "decompressobj", Engine)

    assert len(read_splats(path)) == 1
    assert sum(handed) < 4 * path.stat().st_size


@pytest.mark.parametrize(
    ("scale", "fraction"),
    [(0.001, 23), (1.0, 17), (40.0, 12), (10_000.0, 9), (5e6, 0), (8388607.0, 0)],
)
def test_the_steps_of_positions_follow_the_scene(tmp_path, scale, fraction):
    """The largest coordinate is below 2^b: 23 - b bits behind the point fit, 18 - b are enough.

    Between the two it is 12. .001 is below 2^-9, where 23 is the most; 1 is below 2^1, 40 below
    2^6, 10,000 below 2^14 and 5,000,000 below 2^23. 8,388,607 is the largest whole number of 24
    bits with a sign.
    """
    (tmp_path / "in.ply").write_bytes(plain_ply(50))
    file = read_splats(tmp_path / "in.ply")
    columns = {axis: (file.rows[axis] / file.rows["z"].max() * scale) for axis in "xyz"}
    write_splats(tmp_path / "a.spz", file, columns=columns)

    found = gzip.decompress((tmp_path / "a.spz").read_bytes())[13]
    means = read_splats(tmp_path / "a.spz").splats().means

    assert found == fraction
    expected = np.stack([columns[axis] for axis in "xyz"], axis=1)
    assert np.abs(means - expected).max() <= 0.5 / 2**found * 1.01


def test_a_position_that_spz_cannot_hold_is_refused(tmp_path):
    """24 bits with a sign end at 2^23 - 1, and 8388607.5 is beyond; nothing is written."""
    (tmp_path / "in.ply").write_bytes(plain_ply(3))
    file = read_splats(tmp_path / "in.ply")

    for x, shown in ((1e7, "10000000"), (8388607.5, "8388607.5")):
        with pytest.raises(RefineError, match=f"a coordinate is {shown}: SPZ holds coordinates up"):
            write_splats(tmp_path / "a.spz", file, columns={"x": np.full(3, x, np.float32)})
    assert not (tmp_path / "a.spz").exists()
