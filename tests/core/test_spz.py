"""SPZ by hand: every version, and files that lie."""

import gzip
import importlib
import struct
import zlib
from types import SimpleNamespace

import numpy as np
import pytest

from refine_addon import command, core
from refine_addon.core import RefineError, read_splats, write_splats
from refine_addon.core.affine import QUARTERS
from refine_addon.core.spherical_harmonics import rotate
from tests.hostile import refused
from tests.places import ROOM
from tests.strategies import plain_ply

MEAN = bytes([0, 16, 0, 0, 240, 255, 1, 0, 0])
"""1, -1 and 1/4096 with 12 bits behind the point: 0x001000, 0xfff000, 1."""

REST = bytes([255, 0, 128, *[128] * 6])
"""Degree 1: red, green and blue of the first harmonic are 127/128, -1 and 0."""

TURN = {2: bytes([128, 255, 0]), 3: struct.pack("<I", 3 << 30 | 511 << 20 | 1 << 9 | 0)}
"""Version 2: x y z near 0, 1 and -1. Version 3: w is left out, x is sqrt(1/2), z is minus 0."""


def body(version):
    """Return the attributes of one splat of degree 1."""
    turn = TURN[min(version, 3)]
    return [MEAN, b"\x80", bytes([255, 128, 0]), bytes([160, 0, 255]), turn, REST]


def header(version, count=1, degree=1, streams=0, table=b""):
    """Return the first 16 bytes, and where the table of streams begins."""
    return struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, 0, streams) + table


def version_4(parts, count=1, said=None):
    """Return a file of version 4; skips where nothing compresses zstd. `said` are other lengths."""
    zstandard = pytest.importorskip("zstandard")
    packed = [zstandard.ZstdCompressor().compress(part) for part in parts]
    sizes = said or map(len, parts)
    table = [struct.pack("<QQ", *pair) for pair in zip(map(len, packed), sizes, strict=True)]
    return b"".join([header(4, count, 1, len(parts), TABLE), *table, *packed])


TABLE = struct.pack("<I12x", 32)
ZSTD = b"\x28\xb5\x2f\xfd"  # how a stream begins


@pytest.mark.parametrize("version", [2, 3, 4])
def test_every_version_is_read(tmp_path, version, monkeypatch):
    """Values by hand: .5 is opacity 128/255; (255/255 - .5) / .15 = 10/3; 160/16 - 10 = 0."""
    parts, path = body(version), tmp_path / "a.spz"
    data = version_4(parts) if version == 4 else gzip.compress(header(version) + b"".join(parts))
    path.write_bytes(data)

    file = read_splats(path)

    splats = file.splats()
    assert file.format == f"SPZ version {version}"
    assert splats.means.tolist() == [[1.0, -1.0, 1.0 / 4096]]
    np.testing.assert_allclose(splats.opacity_logits, [np.log(128 / 127)], rtol=1e-5)
    np.testing.assert_allclose(splats.sh_dc, [[10 / 3, 1 / 76.5, -10 / 3]], rtol=1e-5)
    assert splats.log_scales.tolist() == [[0.0, -10.0, 5.9375]]
    turn = [0, 1 / 255, 1, -1] if version == 2 else [0.5**0.5, 0.5**0.5, 0, 0]
    np.testing.assert_allclose(splats.quaternions, [turn], atol=1e-6)
    assert splats.sh_rest[0].tolist() == [[127 / 128, -1.0, 0.0], [0.0] * 3, [0.0] * 3]

    if version == 4:

        def missing(name):
            raise ImportError(name)

        monkeypatch.setattr(importlib, "import_module", missing)
        refused(path, "SPZ version 4 needs a module for zstd: run this in Ble")


@pytest.mark.parametrize(
    ("version", "number", "place"),
    [(3, 4, [1, 1, -1]), (4, 4, [1, 1, -1]), (4, 6, [1, -1, 1]), (4, 12, [1, -1, -1])],
)
def test_axes_that_a_file_names_count(tmp_path, version, number, place):
    """RUB, RDF and RFU, z up: y and z of 1, -1 and 1/4096 are negated, kept, and swapped, negated.
    They are in front of the splats or behind them, behind another extension; written as RUB."""
    record = struct.pack("<II4x", 0xADBE0002, 4) + struct.pack("<III", 0xADBE0003, 4, number)
    parts, path = body(version), tmp_path / "a.spz"
    start = header(version)[:14] + b"\x02"  # flags
    data = gzip.compress(start + b"\0" + b"".join(parts) + record)
    if version == 4:
        table = struct.pack("<I12x", 32 + len(record))
        data = start + b"\6" + table + record + version_4(parts)[32:]
    path.write_bytes(data)
    file = read_splats(path, axes="rdf")
    write_splats(tmp_path / "b.spz", file)
    size = [1, 1 / 4096, 1] if number == 12 else [1, 1, 1 / 4096]
    for each in (file, read_splats(tmp_path / "b.spz", axes="rub")):
        assert each.splats().means.tolist() == np.multiply([place], size).tolist()


def test_splats_are_turned_as_asked_or_as_cameras_see_them_and_turned_back(tmp_path):
    """Half a turn about x, harmonics too; without either a file is read as it stands."""
    room, path, back = ROOM / "point_cloud.ply", tmp_path / "a.spz", tmp_path / "back.spz"
    assert command.main(["convert", str(room), str(path), "--spz-axes", "rub", "--quiet"]) == 0
    plain, asked = read_splats(path).splats(), read_splats(path, axes="rub")
    for file, copy in ((asked, back), (read_splats(path), tmp_path / "again.spz")):
        write_splats(copy, file)
    views, budget = core.read_cameras(ROOM / "cameras.json"), core.Budget(ratio=0.5)
    result = core.prune_file(path, tmp_path / "b.spz", views, budget, core.ClosedForm())
    expected = core.prune(asked, views, budget, core.ClosedForm())
    splats = asked.splats()

    assert back.read_bytes() == (tmp_path / "again.spz").read_bytes()
    np.testing.assert_array_equal(plain.means, splats.means * [1, -1, -1])
    assert np.abs(splats.means - read_splats(room).splats().means).max() < 1e-3
    np.testing.assert_array_equal(rotate(plain.sh_rest, QUARTERS[2]), splats.sh_rest)
    np.testing.assert_array_equal(result.keep, expected.keep)
    for note in ("a.spz: brought from axes RUB", "turned to y up and z back"):
        assert note in " ".join(result.report["notes"])
    with pytest.raises(RefineError, match="axes is 'ruf', expected one of rub, rdf"):
        read_splats(path, axes="ruf")


GOOD = gzip.compress(header(3) + bytes(29), mtime=0)
STORED = gzip.compress(header(3, 1000) + bytes(29_000), compresslevel=0, mtime=0)


def breaking(at):
    """Return a file of a stored block that is cut, and followed by a block of type 3."""
    length = at - 15  # a header of 10 bytes, and the 5 of the block's head
    block = struct.pack("<BHH", 0, length, 0xFFFF ^ length) + STORED[15:at]
    return STORED[:10] + block + b"\x06" + bytes(20_000)


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (gzip.compress(header(1) + bytes(99)), "SPZ version 1, expected 2, 3, 4"),
        (gzip.compress(header(5) + bytes(99)), "SPZ version 5, expected 2, 3, 4"),
        (gzip.compress(header(3, degree=5) + bytes(99)), "byte 12: harmonics of degree 5, expec"),
        (gzip.compress(header(3, 2**32 - 1) + bytes(99)), "truncated: 4294967295 splats need "),
        (gzip.compress(header(3, 1000) + bytes(99)), "truncated: 1000 splats (unpacked) need 29"),
        (GOOD[:-2], "truncated: the gzip stream has no end"),
        (GOOD[:-8] + bytes(8), "a damaged SPZ file: its gzip stream breaks behind "),
        (gzip.compress(header(4) + bytes(99)), "SPZ version 4 inside of gzip"),
        (header(4, 2**32 - 1, 1, 6, TABLE) + bytes(96), "truncated: 4294967295 splats need "),
        (header(4, 1, 1, 2, TABLE) + bytes(96), "byte 15: 2 streams, expect"),
        (header(4, 1, 1, 6, b"\xff" * 16), "truncated: the table of streams"),
        (header(4, 1, 1, 6), "truncated: the first bytes of an SPZ file of version 4 need 32 b"),
        # A file whose beginning is damaged is still called SPZ; it was told to be unpacked.
        (GOOD[:10] + b"\x06" + bytes(99), "a damaged SPZ file: its gzip strea"),
        (gzip.compress(b"NGSX" + bytes(99)), "no SPZ file: its gzip stream begins with b'NGSX', e"),
        (b"NGXP" + bytes(99), "a damaged SPZ file: begins with b'NGXP', expected b'NGSP' or "),
        (breaking(9000), "breaks behind byte 8192 "),  # named by 4096 bytes
    ],
    ids=range(16),
)
def test_a_file_that_lies_is_refused(tmp_path, data, expected):
    """With memory that the file accounts for; a count of 4294967295 would be 120 GB."""
    refused(tmp_path / "a.SPZ", expected, data, memory=3e6)


def test_streams_that_lie_are_refused(tmp_path):
    """Before they are unpacked, or a piece at a time: 10 MB in a few bytes for one of opacity.
    Zstd packs zeros 30,000 times as small: 400,000 splats of 29 bytes are 11.6 MB in 1 kB."""
    parts, path = body(4), tmp_path / "a.spz"
    sizes = [len(part) for part in parts]
    more = version_4([parts[0], b"\0" * 10**7, *parts[2:]], said=sizes)
    much = version_4([bytes(400_000 * size) for size in sizes], 400_000)
    assert len(much) < 2000
    for data, expected, memory in (
        (version_4([b"\0" * 10**6, *parts[1:]]), "stream 'mean' announces 1000000 bytes, exp", 5e6),
        (version_4([parts[0], b"", *parts[2:]]), "stream 'opacity' announces 0 bytes, exp", 5e6),
        (version_4(parts).replace(ZSTD, bytes(4), 1), "stream 'mean' is damaged (", 5e6),
        (more, "stream 'opacity' holds more bytes, expected 1", 5e6),
        (much, "truncated: 400000 splats need 11600000 bytes unpacked", 1e6),
    ):
        refused(path, expected, data, memory=memory)


def test_what_follows_the_splats_is_read_once(tmp_path, monkeypatch):
    """Extensions may, up to the checksum: what is left was unpacked for every piece of them."""
    packed, made = [], zlib.decompressobj

    class Engine(SimpleNamespace):
        copy = property(lambda self: self.engine.copy)
        eof = property(lambda self: self.engine.eof)

        def decompress(self, data, *most):
            packed.append(len(data))
            return self.engine.decompress(data, *most)

    monkeypatch.setattr(zlib, "decompressobj", lambda *bits: Engine(engine=made(*bits)))
    data = gzip.compress(header(3) + bytes(29 + 2_000_000), compresslevel=0)
    (tmp_path / "a.spz").write_bytes(data)
    assert len(read_splats(tmp_path / "a.spz")) == 1
    assert sum(packed) < 1.1 * len(data)


@pytest.mark.parametrize(
    ("scale", "fraction"),
    [(0.001, 23), (1.0, 17), (40.0, 12), (10_000.0, 9), (5e6, 0), (8388607.0, 0)],
)
def test_the_steps_of_positions_follow_the_scene(tmp_path, scale, fraction):
    """The largest coordinate is below 2^b: 23 - b bits behind the point fit, 18 - b are enough.
    Between the two it is 12. .001 is below 2^-9, where 23 is the most; 1 is below 2^1, 40 below
    2^6, 10,000 below 2^14 and 5,000,000 below 2^23. 8,388,607 is the largest whole number of 24
    bits with a sign."""
    (tmp_path / "in.ply").write_bytes(plain_ply(50))
    file = read_splats(tmp_path / "in.ply")
    columns = {axis: (file.rows[axis] / file.rows["z"].max() * scale) for axis in "xyz"}
    write_splats(tmp_path / "a.spz", file, columns=columns)
    means = read_splats(tmp_path / "a.spz").splats().means
    assert gzip.decompress((tmp_path / "a.spz").read_bytes())[13] == fraction
    expected = np.stack([columns[axis] for axis in "xyz"], axis=1)
    assert np.abs(means - expected).max() <= 0.5 / 2**fraction * 1.01


def test_a_position_that_spz_cannot_hold_is_refused(tmp_path):
    """24 bits with a sign end at 2^23 - 1, and 8388607.5 is beyond; nothing is written."""
    (tmp_path / "in.ply").write_bytes(plain_ply(3))
    file = read_splats(tmp_path / "in.ply")
    for x, shown in ((1e7, "10000000"), (8388607.5, "8388607.5")):
        with pytest.raises(RefineError, match=f"a coordinate is {shown}: SPZ holds coordinates up"):
            write_splats(tmp_path / "a.spz", file, columns={"x": np.full(3, x, np.float32)})
    assert not (tmp_path / "a.spz").exists()
