"""Compressed PLY by hand, and files that are not what they say."""

from __future__ import annotations

import re
import struct

import numpy as np
import pytest

from refine_addon.core import RefineError, read_splats

POSITION = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
SCALE = [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
COLOR = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]

RANGES = [0.0, 10.0, -1.0, 2047.0, 1033.0, 2046.0, -2.0, -3.0, -4.0, 2.0, 3.0, 4.0]
COLORS = [0.0, 0.5, 0.25, 1.0, 1.0, 0.25]


def splat(position, rotation, scale, color):
    """Return the 16 bytes of one splat, from the codes of each value."""
    words = (
        position[0] << 21 | position[1] << 11 | position[2],
        rotation[0] << 30 | rotation[1] << 20 | rotation[2] << 10 | rotation[3],
        scale[0] << 21 | scale[1] << 11 | scale[2],
        color[0] << 24 | color[1] << 16 | color[2] << 8 | color[3],
    )
    return struct.pack("<4I", *words)


ONE = splat((1, 23, 2047), (1, 512, 1023, 0), (0, 1023, 2047), (0, 255, 7, 51))


def header(*, chunks=1, count=1, kind="binary_little_endian", color=True, rest=0, **changes):
    """Return the header of a file."""
    lines = ["ply", f"format {kind} 1.0", f"element chunk {chunks}"]
    lines += [f"property float {n}" for n in [*POSITION, *SCALE, *(COLOR if color else [])]]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in PACKED)]
    if rest:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(rest))]
    text = "\n".join([*lines, "end_header", ""])
    for old, new in changes.get("swap", {}).items():
        assert old in text
        text = text.replace(old, new)
    return text.encode()


def ranges(*, color=True):
    """Return the bytes of a chunk."""
    return struct.pack(f"<{18 if color else 12}f", *RANGES, *(COLORS if color else []))


@pytest.mark.parametrize("color", [True, False])
def test_values_by_hand(tmp_path, color):
    """Steps of x are 1, of y 1, of z 1: 0 + 1, 10 + 23, -1 + 2047. The rotation leaves out x.

    Its codes 512, 1023 and 0 of 1023 are .5 / 1023, 1/2 and -1/2 times sqrt(2). Colours are the
    ends of their ranges; without these they are the codes themselves, 0, 1 and 7/255.
    """
    data = header(color=color, rest=9) + ranges(color=color) + ONE
    (tmp_path / "a.ply").write_bytes(data + bytes([0, 255, 128, *[127] * 6]))

    file = read_splats(tmp_path / "a.ply")

    splats = file.splats()
    assert file.format == "compressed PLY"
    np.testing.assert_allclose(splats.means, [[1.0, 33.0, 2046.0]], rtol=1e-6)
    np.testing.assert_allclose(splats.log_scales, [[-2.0, 3.0, 4.0]], rtol=1e-6)
    w, y, z = (np.array([512, 1023, 0]) / 1023 - 0.5) * np.sqrt(2.0)
    np.testing.assert_allclose(splats.quaternions, [[w, 0.0, y, z]], atol=1e-3)
    colors = splats.sh_dc * 0.28209479 + 0.5
    expected = [[0.0, 1.0, 0.25]] if color else [[0.0, 1.0, 7 / 255]]
    np.testing.assert_allclose(colors, expected, atol=1e-6)
    np.testing.assert_allclose(splats.opacity_logits, [-np.log(4.0)], rtol=1e-5)
    red = splats.sh_rest[0, :, 0].tolist()
    assert red == [-4.0, 4.0, (128.5 / 256 - 0.5) * 8.0]


FAULTS = {
    "ASCII": (header(kind="ascii") + b"0 " * 22, "a compressed PLY in ASCII, expected a binary"),
    "no chunk for the last splat": (
        header(count=257) + ranges() + ONE * 257,
        "1 chunks, expected 2 for 257 splats",
    ),
    "no chunks at all": (
        header(swap={"element chunk 1": "element lump 1"}) + ranges() + ONE,
        "a compressed PLY without an element 'chunk'",
    ),
    "no rotation": (
        header(swap={"packed_rotation": "packed_turn"}) + ranges() + ONE,
        "element 'vertex': property 'packed_rotation' is none, expected u4",
    ),
    "signed numbers": (
        header(swap={"uint packed_color": "int packed_color"}) + ranges() + ONE,
        "element 'vertex': property 'packed_color' is i4, expected u4",
    ),
    "half of the colours": (
        header(swap={"max_g": "green"}) + ranges() + ONE,
        "element 'chunk': property 'max_g' is none, expected f4",
    ),
    "a list": (
        header(swap={"property float min_x": "property list uchar float min_x"}) + bytes(200),
        "element 'chunk' has a list, expected numbers",
    ),
    "harmonics of no degree": (
        header(rest=8) + ranges() + ONE + bytes(8),
        "element 'sh' has 1 rows of 8 properties, expected 1 rows of 9, 24, 45 or 72",
    ),
    "harmonics of fewer splats": (
        header(rest=9, swap={"element sh 1": "element sh 0"}) + ranges() + ONE,
        "element 'sh' has 0 rows of 9 properties, expected 1 rows of",
    ),
    "harmonics as floats": (
        header(rest=9, swap={"uchar f_rest_0": "float f_rest_0"}) + ranges() + ONE + bytes(12),
        "element 'sh': property 'f_rest_0' is f4, expected u1",
    ),
    "a count that lies": (
        header(count=2**40) + ranges() + ONE,
        "truncated: the header announces 1099511627776 rows of 'vertex', at least ",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_wrong_is_named_with_its_place(tmp_path, name):
    """The element, the property, what was found and what was expected."""
    data, expected = FAULTS[name]
    (tmp_path / "a.ply").write_bytes(data)

    with pytest.raises(RefineError, match=re.escape(f"{tmp_path / 'a.ply'}: {expected}")):
        read_splats(tmp_path / "a.ply")


def test_harmonics_are_found_by_their_names(tmp_path):
    """In any order; each code is that of its property."""
    names = [f"f_rest_{index}" for index in range(9)]
    swapped = {f"uchar {name}\n": f"uchar x{name}\n" for name in names}
    text = header(rest=9, swap=swapped).decode()
    for index, name in enumerate(names):
        text = text.replace(f"uchar x{name}\n", f"uchar f_rest_{8 - index}\n")
    (tmp_path / "a.ply").write_bytes(text.encode() + ranges() + ONE + bytes(range(100, 109)))

    rows = read_splats(tmp_path / "a.ply").rows

    codes = [float(rows[name][0]) * 32 + 127.5 for name in names]
    assert codes == [108.0 - index for index in range(9)]
