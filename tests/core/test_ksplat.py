""".ksplat: files of the reference converter, one by hand, and files that lie."""

from __future__ import annotations

import re
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from refine_addon.core import RefineError, read_splats

from .test_formats import differences

DATA = Path(__file__).parents[1] / "data"
STEP = 265
"""Every so many splats of the room are in the files; see the README beside them."""


def in_order(splats):
    """Return splats in the order of x and y, which tell all of them apart."""
    return splats.take(np.lexsort((splats.means[:, 1].round(3), splats.means[:, 0].round(3))))


BOUNDS = {
    # Level -> largest errors. Level 0 holds floats; 8 bits of colour and opacity, as all levels.
    0: {"mean": 0.0, "log scale": 1e-6, "rotation": 1e-6, "harmonics": 0.0},
    # Half of 3 units / 2 / 32767; a float16 has 11 bits, or steps of 6e-8 below 6e-5: of the least
    # scale here, 1.5e-7, that is .6; components of rotations 2^-12, each twice in products of two.
    1: {"mean": 2.4e-5, "log scale": 0.6, "rotation": 8 * 2**-12, "harmonics": 2**-12},
    2: {"mean": 2.4e-5, "log scale": 0.6, "rotation": 8 * 2**-12, "harmonics": 0.003},
}


@pytest.mark.parametrize("level", BOUNDS)
def test_what_the_reference_converter_writes_is_the_source(level):
    """Splat by splat: two sections whose buckets are in part full, degree 2."""
    file = read_splats(DATA / f"other_tools/level_{level}.ksplat")
    source = read_splats(DATA / "room_small/point_cloud.ply").splats()
    source = source.take(slice(0, None, STEP)).up_to_degree(2)

    found = differences(in_order(file.splats()), in_order(source))

    assert file.format == f".ksplat level {level}"
    assert file.stored_bytes == file.path.stat().st_size
    assert len(file) == len(source) == 151
    for name, bound in {**BOUNDS[level], "opacity": 1 / 255, "color": 1 / 255}.items():
        assert found[name] <= bound, name


def test_degree_1_is_read():
    """8 bits between the least and the largest harmonic, which are -.46 and .63: steps of .0043."""
    splats = read_splats(DATA / "other_tools/degree_1.ksplat").splats()
    source = read_splats(DATA / "room_small/point_cloud.ply").splats()
    source = source.take(slice(0, None, STEP)).up_to_degree(1)

    assert splats.sh_degree == 1
    assert differences(in_order(splats), in_order(source))["harmonics"] <= 0.003


def section(*, count=1, room=1, buckets=1, full=0, partial=1, degree=0, **other):
    """Return the header of a section with buckets of 2 splats and 4 units."""
    held = {"size": 2, "block": 4.0, "bytes": 12, "range": 0, **other}
    return struct.pack(
        "<IIIIfHxxIIIIH982x",
        *(count, room, held["size"], buckets, held["block"], held["bytes"], held["range"], 0),
        *(full, partial, degree),
    )


def whole(*parts, sections=1, count=1, level=1, version=(0, 1), ends=(0.0, 0.0)):
    """Return a file: header, then headers of sections and what they hold."""
    first = struct.pack(
        "<BBxxIIIIHxx12xff", *version, sections, sections, count, count, level, *ends
    )
    return first.ljust(4096, b"\0") + b"".join(parts)


ROW = (
    struct.pack("<3H", 0, 32767, 65534)
    + np.array([1.0, 2.0, 0.5, 0.0, 1.0, 0.0, 0.0], "<f2").tobytes()
    + bytes([255, 0, 51, 204])
)
"""Level 1: a corner and the middle of its bucket; half a turn about x; red 1, opacity .8."""

BUCKET = struct.pack("<I3f", 1, 10.0, 20.0, 30.0)
"""A bucket that is not full: one splat, and its centre."""


def test_a_file_by_hand(tmp_path):
    """4 units are 2 to each side of the centre. Harmonics: 3 of red, 3 of green, 3 of blue."""
    rest = np.arange(9, dtype="<f2") / 8
    data = whole(section(degree=1), BUCKET, ROW, rest.tobytes())
    (tmp_path / "A.KSPLAT").write_bytes(data)

    splats = read_splats(tmp_path / "A.KSPLAT").splats()

    np.testing.assert_allclose(splats.means, [[8.0, 20.0, 32.0]], rtol=1e-6)
    np.testing.assert_allclose(splats.log_scales, np.log([[1.0, 2.0, 0.5]]), atol=1e-7)
    assert splats.quaternions.tolist() == [[0.0, 1.0, 0.0, 0.0]]
    np.testing.assert_allclose(splats.sh_dc * 0.28209479, [[0.5, -0.5, -0.3]], atol=1e-6)
    np.testing.assert_allclose(splats.opacity_logits, [np.log(4.0)], rtol=1e-6)
    assert (splats.sh_rest[0].T * 8).tolist() == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]


def test_sections_of_different_degrees_have_zeros(tmp_path):
    """Level 2: codes 0 and 255 are the ends, here -1.5 and 1.5, which stand for no ends."""
    one = section(degree=1) + section(degree=0)
    rest = bytes([0, 255] + [0] * 7)
    data = whole(one, BUCKET, ROW, rest, BUCKET, ROW, sections=2, count=2, level=2)
    (tmp_path / "a.ksplat").write_bytes(data)

    splats = read_splats(tmp_path / "a.ksplat").splats()

    assert splats.sh_rest[0, :2, 0].tolist() == [-1.5, 1.5]
    assert not splats.sh_rest[1].any()


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (bytes(4000), "truncated: the first bytes of a .ksplat file need 4096 bytes, the file "),
        (whole(version=(1, 0)), ".ksplat version 1.0, expected 0.1"),
        (whole(version=(0, 0)), ".ksplat version 0.0, expected 0.1"),
        (whole(level=3), "byte 20: compression level 3, expected 0 to 2"),
        (whole(sections=2**32 - 1), "truncated: the headers of 4294967295 sections need "),
        (whole(section(room=2**32 - 1)), "truncated: section 0 and what is before it need "),
        (whole(section(buckets=2**32 - 1)), "truncated: section 0 and what is before it need "),
        (whole(section(partial=2**32 - 1)), "truncated: section 0 and what is before it need "),
        (whole(section(count=2), BUCKET, ROW), "section 0: 2 splats, expected at most 1, its roo"),
        (whole(section(degree=3), BUCKET, ROW), "section 0: harmonics of degree 3, expected 0 to"),
        (whole(section(bytes=8), BUCKET, ROW), "section 0: 8 bytes of a bucket, expected 12"),
        (whole(section(), BUCKET, ROW[:-1]), "truncated: section 0 and what is before it need "),
        (whole(section(), BUCKET, ROW, count=2), "2 splats by byte 16, 1 by the sections"),
        (
            whole(section(full=2**32 - 1), BUCKET, ROW),
            None,  # splat 0 lies in bucket 0, whatever buckets are said to follow
        ),
        (
            whole(section(full=2**32 - 1, size=0), BUCKET, ROW),
            "section 0: splat 0 lies in bucket 4294967295 of 1",
        ),
        (
            whole(section(), struct.pack("<I3f", 0, 0, 0, 0), ROW),
            "section 0: splat 0 lies in bucket 1 of 1",
        ),
    ],
    ids=range(16),
)
def test_a_file_that_lies_is_refused(tmp_path, data, expected):
    """With the place, what was found and what was expected, and little memory."""
    path = tmp_path / "a.ksplat"
    path.write_bytes(data)
    tracemalloc.start()
    if expected is None:
        assert len(read_splats(path)) == 1
    else:
        with pytest.raises(RefineError, match=re.escape(f"{path}: {expected}")):
            read_splats(path)

    assert tracemalloc.get_traced_memory()[1] < 2_000_000
    tracemalloc.stop()


@pytest.mark.slow
@pytest.mark.parametrize("level", BOUNDS)
def test_a_file_cut_anywhere_is_refused(tmp_path, level):
    """At each of the last 300 bytes, and every 97th before."""
    data = (DATA / f"other_tools/level_{level}.ksplat").read_bytes()
    path = tmp_path / "a.ksplat"
    for cut in (*range(1, len(data), 97), *range(len(data) - 300, len(data))):
        path.write_bytes(data[:cut])
        with pytest.raises(RefineError, match=re.escape(f"{path}: ")):
            read_splats(path)
