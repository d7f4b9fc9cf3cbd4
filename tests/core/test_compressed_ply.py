"""Compressed PLY by hand, and files that are not what they say."""

import struct

import numpy as np
import pytest

from refine_addon.core import read_splats
from tests.hostile import refused

ENDS = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
ENDS += [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
COLORS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]

RANGES = [0.0, 10.0, -1.0, 2047.0, 1033.0, 2046.0, -2.0, -3.0, -4.0, 2.0, 3.0, 4.0]
RANGES += [0.0, 0.5, 0.25, 1.0, 1.0, 0.25]

ONE = struct.pack(
    "<4I",
    *(1 << 21 | 23 << 11 | 2047, 1 << 30 | 512 << 20 | 1023 << 10 | 0),
    *(0 << 21 | 1023 << 11 | 2047, 0 << 24 | 255 << 16 | 7 << 8 | 51),
)
"""The codes of a splat's position, rotation, scale and colour."""


def ply(*body, chunks=1, count=1, rest=0, color=True, swap=("", "")):
    """Return a file with a chunk and a splat; `swap` is a change to its header."""
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
    lines += [f"property float {name}" for name in [*ENDS, *(COLORS if color else [])]]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in PACKED)]
    if rest:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(rest))]
    text = "\n".join([*lines, "end_header", ""])
    assert swap[0] in text
    ranges = struct.pack(f"<{18 if color else 12}f", *RANGES[: 18 if color else 12])
    return b"".join([text.replace(*swap).encode(), ranges, ONE, *body])


@pytest.mark.parametrize("color", [True, False])
def test_values_by_hand(tmp_path, color):
    """Steps of x are 1, of y 1, of z 1: 0 + 1, 10 + 23, -1 + 2047. The rotation leaves out x.
    Its codes 512, 1023 and 0 of 1023 are .5 / 1023, 1/2 and -1/2 times sqrt(2). Colours are the
    ends of their ranges; without these they are the codes themselves, 0, 1 and 7/255."""
    data = ply(bytes([0, 255, 128, *[127] * 6]), rest=9, color=color)
    (tmp_path / "a.ply").write_bytes(data)
    file = read_splats(tmp_path / "a.ply")
    splats = file.splats()
    assert file.format == "compressed PLY"
    np.testing.assert_allclose(splats.means, [[1.0, 33.0, 2046.0]], rtol=1e-6)
    np.testing.assert_allclose(splats.log_scales, [[-2.0, 3.0, 4.0]], rtol=1e-6)
    w, y, z = (np.array([512, 1023, 0]) / 1023 - 0.5) * np.sqrt(2.0)
    np.testing.assert_allclose(splats.quaternions, [[w, 0.0, y, z]], atol=1e-3)
    expected = [[0.0, 1.0, 0.25]] if color else [[0.0, 1.0, 7 / 255]]
    np.testing.assert_allclose(splats.sh_dc * 0.28209479 + 0.5, expected, atol=1e-6)
    np.testing.assert_allclose(splats.opacity_logits, [-np.log(4.0)], rtol=1e-5)
    assert splats.sh_rest[0, :, 0].tolist() == [-4.0, 4.0, (128.5 / 256 - 0.5) * 8.0]


def test_harmonics_are_found_by_their_names(tmp_path):
    """In any order; each code is that of its property. gsplat announces none without properties."""
    names = [f"f_rest_{index}" for index in range(9)]
    declared = ["".join(f"property uchar {name}\n" for name in names[::way]) for way in (1, -1)]
    (tmp_path / "a.ply").write_bytes(ply(bytes(range(100, 109)), rest=9, swap=declared))
    rows = read_splats(tmp_path / "a.ply").rows
    assert [rows[name][0] * 32 + 127.5 for name in names] == [108.0 - index for index in range(9)]
    (tmp_path / "b.ply").write_bytes(ply(swap=("end_header", "element sh 1\nend_header")))
    assert read_splats(tmp_path / "b.ply").splats().sh_degree == 0


VERTEX, CHUNK = "element 'vertex': property", "element 'chunk'"
LIST = ("float min_x", "list uchar float min_x")
TURN, SIGNED = ("packed_rotation", "packed_turn"), ("uint packed_color", "int packed_color")
REST = ("uchar f_rest_0", "float f_rest_0")

FAULTS = [
    (ply(swap=("binary_little_endian", "ascii")), "a compressed PLY in ASCII, expected a binary"),
    (ply(ONE * 256, count=257), "1 chunks, expected 2 for 257 splats"),
    (ply(swap=("chunk", "lump")), f"a compressed PLY without an {CHUNK}"),
    (ply(swap=TURN), f"{VERTEX} 'packed_rotation' is none, expected u4"),
    (ply(swap=SIGNED), f"{VERTEX} 'packed_color' is i4, expected u4"),
    (ply(swap=("max_g", "green")), f"{CHUNK}: property 'max_g' is none, expected f4"),
    (ply(swap=LIST), f"{CHUNK} has a list, expected numbers"),
    (ply(bytes(8), rest=8), "'sh' has 1 rows of 8 properties, expected 1 rows of 9, 24, 45 or 72"),
    (ply(rest=9, swap=("sh 1", "sh 0")), "'sh' has 0 rows of 9 properties, expected 1 rows of"),
    (ply(bytes(12), rest=9, swap=REST), "element 'sh': property 'f_rest_0' is f4, expected u1"),
]


@pytest.mark.parametrize(("data", "expected"), FAULTS, ids=range(len(FAULTS)))
def test_what_is_wrong_is_named_with_its_place(tmp_path, data, expected):
    """The element, the property, what was found and what was expected."""
    refused(tmp_path / "a.ply", expected, data)
