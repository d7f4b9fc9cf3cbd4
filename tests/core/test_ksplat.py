""".ksplat: files of the reference converter, one by hand, and files that lie."""

import struct

import numpy as np
import pytest

from refine_addon.core import read_splats
from tests.hostile import refused
from tests.places import DATA

from .test_formats import differences

# Level -> largest errors. Level 0 holds floats. Level 1: half of 3 units / 2 / 32767; a float16 has
# 11 bits, or steps of 6e-8 below 6e-5: of the least scale here, 1.5e-7, that is .6; components of
# rotations 2^-12, each twice in products of two. Colours, opacities and harmonics of level 2 have
# 8 bits: the harmonics between -.46 and .63, in steps of .0043.
HALVES = {"mean": 2.4e-5, "log scale": 0.6, "rotation": 8 * 2**-12, "harmonics": 2**-12}
BOUNDS = {
    "level_0": {"mean": 0.0, "log scale": 1e-6, "rotation": 1e-6, "harmonics": 0.0},
    "level_1": HALVES,
    "level_2": {**HALVES, "harmonics": 0.003},
    "degree_1": {"harmonics": 0.003},
}


@pytest.mark.parametrize("name", BOUNDS)
def test_what_the_reference_converter_writes_is_the_source(name):
    """Every 265th splat of the room, in two sections whose buckets are in part full."""
    file = read_splats(DATA / f"other_tools/{name}.ksplat")
    source = read_splats(DATA / "room_small/point_cloud.ply").splats()
    source = source.take(slice(0, None, 265)).up_to_degree(1 if name == "degree_1" else 2)
    ordered = (  # x and y tell all of them apart
        splats.take(np.lexsort((splats.means[:, 1].round(3), splats.means[:, 0].round(3))))
        for splats in (file.splats(), source)
    )
    found = differences(*ordered)
    level = 2 if name == "degree_1" else name[-1]
    assert file.format == f".ksplat level {level}"
    assert file.stored_bytes == file.path.stat().st_size
    assert file.splats().sh_rest.shape == source.sh_rest.shape == (151, *source.sh_rest.shape[1:])
    for key, bound in {**BOUNDS[name], "opacity": 1 / 255, "color": 1 / 255}.items():
        assert found[key] <= bound, key


def section(*, count=1, room=1, buckets=1, full=0, partial=1, degree=0, size=2, width=12):
    """Return the header of a section with buckets of 2 splats and 4 units."""
    return struct.pack(
        "<IIIIfHxxIIIIH982x",
        *(count, room, size, buckets, 4.0, width, 0, 0, full, partial, degree),
    )


def whole(*parts, sections=1, count=1, level=1, version=(0, 1)):
    """Return a file: header, then headers of sections and what they hold."""
    counts = sections, sections, count, count, level
    first = struct.pack("<BBxxIIIIHxx12xff", *version, *counts, 0.0, 0.0)
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
    """4 units are 2 to each side of the centre. Harmonics: 3 of red, 3 of green, 3 of blue.
    That full buckets are said to come first does not matter: splat 0 lies in bucket 0."""
    rest, head = np.arange(9, dtype="<f2") / 8, section(degree=1, full=2**32 - 1)
    (tmp_path / "A.KSPLAT").write_bytes(whole(head, BUCKET, ROW, rest.tobytes()))
    splats = read_splats(tmp_path / "A.KSPLAT").splats()
    np.testing.assert_allclose(splats.means, [[8.0, 20.0, 32.0]], rtol=1e-6)
    np.testing.assert_allclose(splats.log_scales, np.log([[1.0, 2.0, 0.5]]), atol=1e-7)
    assert splats.quaternions.tolist() == [[0.0, 1.0, 0.0, 0.0]]
    np.testing.assert_allclose(splats.sh_dc * 0.28209479, [[0.5, -0.5, -0.3]], atol=1e-6)
    np.testing.assert_allclose(splats.opacity_logits, [np.log(4.0)], rtol=1e-6)
    assert (splats.sh_rest[0].T * 8).tolist() == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]


def test_sections_of_different_degrees_have_zeros(tmp_path):
    """Level 2: codes 0 and 255 are the ends, here -1.5 and 1.5, which stand for no ends."""
    heads, rest = section(degree=1) + section(degree=0), bytes([0, 255] + [0] * 7)
    data = whole(heads, BUCKET, ROW, rest, BUCKET, ROW, sections=2, count=2, level=2)
    (tmp_path / "a.ksplat").write_bytes(data)
    splats = read_splats(tmp_path / "a.ksplat").splats()
    assert splats.sh_rest[0, :2, 0].tolist() == [-1.5, 1.5]
    assert not splats.sh_rest[1].any()


NEED = "truncated: section 0 and what is before it need "
MOST = 2**32 - 1


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (bytes(4000), "truncated: the first bytes of a .ksplat file need 4096 bytes, the file "),
        (whole(version=(1, 0)), ".ksplat version 1.0, expected 0.1"),
        (whole(level=3), "byte 20: compression level 3, expected 0 to 2"),
        (whole(sections=MOST), "truncated: the headers of 4294967295 sections need "),
        (whole(section(room=MOST)), NEED),
        (whole(section(partial=MOST)), NEED),
        (whole(section(count=2), BUCKET, ROW), "section 0: 2 splats, expected at most 1, its roo"),
        (whole(section(degree=3), BUCKET, ROW), "section 0: harmonics of degree 3, expected 0 to"),
        (whole(section(width=8), BUCKET, ROW), "section 0: 8 bytes of a bucket, expected 12"),
        (whole(section(), BUCKET, ROW[:-1]), NEED),
        (whole(section(), BUCKET, ROW, count=2), "2 splats by byte 16, 1 by the sections"),
        (whole(section(full=MOST, size=0), BUCKET, ROW), "splat 0 lies in bucket 4294967295 of 1"),
        (whole(section(), bytes(16), ROW), "section 0: splat 0 lies in bucket 1 of 1"),
    ],
    ids=range(13),
)
def test_a_file_that_lies_is_refused(tmp_path, data, expected):
    refused(tmp_path / "a.ksplat", expected, data, memory=2e6)
