"""glTF by hand: nodes, integers, bytes beside it, and files that are not what they say."""

from __future__ import annotations

import base64
import copy
import json
import struct

import numpy as np
import pytest

from refine_addon.core import RefineError, read_splats, write_splats
from refine_addon.core.formats import registry
from refine_addon.core.spherical_harmonics import colors
from refine_addon.core.splats import ARRAYS, SH_C0, drawable, opacity, rotation_matrices
from tests.hostile import refused, seconds, with_value

SPLATTING = "KHR_gaussian_splatting"
OPACITY, ROTATION, SCALE = (f"{SPLATTING}:{name}" for name in ("OPACITY", "ROTATION", "SCALE"))
DTYPES = {5126: "<f4", 5122: "<i2", 5121: "u1", 5120: "i1", 5123: "<u2"}
FLOAT, SHORT, BYTE, SIGNED_BYTE, UNSIGNED_SHORT = DTYPES

VALUES = {
    "POSITION": [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
    ROTATION: [[0.0, 0.0, 0.0, 1.0], [0.5, -0.5, 0.5, -0.5]],
    SCALE: [[1.0, 2.0, 4.0], [0.5, 0.0, 0.25]],
    OPACITY: [[0.5], [1.0]],
    f"{SPLATTING}:SH_DEGREE_0_COEF_0": [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]],
    **{
        f"{SPLATTING}:SH_DEGREE_1_COEF_{n}": [[0.1 * n, 0.2, 0.3], [-0.1, 0.2 * n, 0.1]]
        for n in range(3)
    },
}
"""Two splats as the attributes of a primitive; the scale of one is 0 along y."""


def document(values=VALUES, **kinds):
    """Return the JSON and the binary chunk of a file with one node."""
    views, accessors, binary = [], [], b""
    for name, rows in values.items():
        kind = kinds.get(name.removeprefix(f"{SPLATTING}:"), FLOAT)
        data = np.array(rows, DTYPES[kind]).tobytes()
        data += bytes(-len(data) % 4)
        shape = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[len(rows[0])]
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)})
        accessors.append({"bufferView": len(accessors), "componentType": kind, "type": shape})
        accessors[-1].update(count=len(rows), normalized=kind != FLOAT)
        binary += data
    extension = {SPLATTING: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    names = {name: index for index, name in enumerate(values)}
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": names, "mode": 0, "extensions": extension}]}],
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return content, binary


def packed(content, binary=b""):
    """Return a file."""
    text = content if isinstance(content, bytes) else json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    body += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


@pytest.fixture
def read(tmp_path):
    """Return a function that reads a file of this JSON and binary chunk."""

    def read_back(content, binary, nodes=()):
        """`nodes`, if given, are the file's, each below the one before."""
        if nodes:
            chain = [{"children": [k + 1], **node} for k, node in enumerate(nodes[:-1])]
            content = {**content, "nodes": [*chain, {"mesh": 0, **nodes[-1]}]}
        (tmp_path / "a.glb").write_bytes(packed(content, binary))
        with np.errstate(all="raise"):
            return read_splats(tmp_path / "a.glb").splats()

    return read_back


def test_values_are_activated_and_y_points_up(read):
    """Half a turn about z: x and y change sign, and so do harmonics of odd order.

    The rotation is multiplied by that turn, (0, 0, 0, 1), from the left: 1 becomes (0, 0, 0, 1).
    A scale of 2 is log 2, one of 0 -104; an opacity of 1 is kept 2^-26 away from it.
    """
    splats = read(*document())
    assert splats.means.tolist() == [[-1.0, -2.0, 3.0], [-4.0, -5.0, 6.0]]
    np.testing.assert_allclose(splats.log_scales[0], np.log([1.0, 2.0, 4.0]), rtol=1e-6)
    assert splats.log_scales[1, 1] == -104.0
    np.testing.assert_allclose(splats.opacity_logits, [0.0, np.log(2.0**26)], atol=1e-6)
    assert splats.quaternions.tolist() == [[0.0, 0.0, 0.0, 1.0], [-0.5, 0.5, 0.5, -0.5]]
    np.testing.assert_allclose(splats.sh_dc, VALUES[f"{SPLATTING}:SH_DEGREE_0_COEF_0"], rtol=1e-6)
    stored = np.array([VALUES[f"{SPLATTING}:SH_DEGREE_1_COEF_{n}"] for n in range(3)])
    expected = stored.transpose(1, 0, 2) * np.array([-1.0, 1.0, -1.0])[:, None]
    np.testing.assert_allclose(splats.sh_rest, expected, atol=1e-7)


def test_what_nodes_do_is_applied(read):
    """A node turned a quarter about x, of twice the size and moved by (1, 0, 0), in a moved one.

    (x, y, z) becomes 2 (x, -z, y) + (1, 0, 0) + (0, 0, 1), and that is turned half about z.
    The colour along the direction that the turns make of d is that of the untouched file along d.
    A matrix stands column by column: one that moves by (7, 8, 9) has these last.
    """
    moved = {"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 7, 8, 9, 1]}
    assert read(*document(), [moved]).means.tolist() == [[-8.0, -10.0, 12.0], [-11.0, -13.0, 15.0]]
    plain = read(*document())
    half = float(np.sqrt(0.5))
    child = {"rotation": [half, 0, 0, half], "scale": [2, 2, 2], "translation": [1, 0, 0]}

    splats = read(*document(), [{"translation": [0, 0, 1]}, child])

    np.testing.assert_allclose(splats.means[0], [-3.0, 6.0, 5.0], atol=1e-5)
    np.testing.assert_allclose(splats.log_scales[0], plain.log_scales[0] + np.log(2.0), atol=1e-6)
    quarter = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    flip = np.diag([-1.0, -1, 1])
    turn = flip @ quarter @ flip
    turned = np.abs(turn @ rotation_matrices(plain.quaternions))
    np.testing.assert_allclose(np.abs(rotation_matrices(splats.quaternions)), turned, atol=1e-6)
    along = np.array([[0.6, 0.0, 0.8], [0.0, -0.6, 0.8]])
    np.testing.assert_allclose(
        colors(along @ turn.T, splats.sh_dc, splats.sh_rest),
        colors(along, plain.sh_dc, plain.sh_rest),
        atol=1e-6,
    )


def test_every_node_shows_its_primitives_where_it_stands(read):
    """Three nodes: one mesh moved by 5 and by 7 along x, which changes sign, around another.

    The one of less degree has zeros; all are there in the order of the scene's nodes.
    """
    content, binary = document()
    short = copy.deepcopy(content["meshes"][0]["primitives"][0])
    for n in range(3):
        del short["attributes"][f"{SPLATTING}:SH_DEGREE_1_COEF_{n}"]
    content["meshes"].append({"primitives": [short]})
    moved = [{"mesh": 0, "translation": [x, 0, 0]} for x in (5, 7)]
    content |= {"nodes": [*moved, {"mesh": 1}], "scenes": [{"nodes": [0, 2, 1]}]}
    splats = read(content, binary)
    assert splats.means[:, 0].tolist() == [-6.0, -9.0, -1.0, -4.0, -8.0, -11.0]
    assert (splats.sh_dc[:2] == splats.sh_dc[4:]).all()
    assert splats.sh_rest.shape == (6, 3, 3)
    assert [part.any() for part in np.split(splats.sh_rest, 3)] == [True, False, True]


def test_normalized_integers_and_values_that_stand_apart_are_read(read):
    """Opacity 51 of 255 is .2; a rotation of 32767 is 1, and -32768 is -1 too.

    Positions have 8 bytes behind each, by a stride of 20.
    """
    turns = [[0, 0, 0, 32767], [-32768, 0, 0, 0]]
    values = {**VALUES, OPACITY: [[51], [255]], ROTATION: turns}
    content, binary = document(values, OPACITY=BYTE, ROTATION=SHORT)
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": 40, "byteStride": 20}
    content["bufferViews"][0] = view
    rows = np.pad(np.array(VALUES["POSITION"], "<f4"), ((0, 0), (0, 2)))
    splats = read(content, binary + rows.tobytes())
    np.testing.assert_allclose(splats.opacity_logits[0], np.log(0.25), rtol=1e-6)
    assert splats.quaternions.tolist() == [[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -1.0, 0.0]]
    assert splats.means.tolist()[1] == [-4.0, -5.0, 6.0]


INTEGERS = [
    (ROTATION, SIGNED_BYTE, 127, [[127, 0, 0, -127], [0, 64, -128, 0]]),
    (ROTATION, SHORT, 32767, [[32767, 0, 0, 9], [0, 64, -32768, 0]]),
    (SCALE, BYTE, 1, [[1, 2, 255], [0, 3, 4]]),
    (SCALE, BYTE, 255, [[1, 2, 255], [0, 3, 4]]),
    (SCALE, UNSIGNED_SHORT, 1, [[1, 2, 65535], [0, 3, 4]]),
    (SCALE, UNSIGNED_SHORT, 65535, [[1, 2, 65535], [0, 3, 4]]),
    (SCALE, SIGNED_BYTE, 1, [[1, -2, 3], [0, 4, 5]]),  # signed ones: drafts alone, logarithms
    (SCALE, SIGNED_BYTE, 127, [[127, -128, 0], [0, 4, 5]]),
    (SCALE, SHORT, 1, [[1, -2, 3], [0, 4, 5]]),
    (SCALE, SHORT, 32767, [[1, -2, 3], [0, 4, 5]]),
    (OPACITY, BYTE, 255, [[0], [255]]),
    (OPACITY, UNSIGNED_SHORT, 65535, [[1], [32768]]),
]
"""Attribute, type, the number that stands for 1 and values, for every type that is allowed."""


@pytest.mark.parametrize("case", range(len(INTEGERS)))
def test_integers_of_every_type_are_read_as_the_floats_they_stand_for(read, case):
    """The least of signed ones is -1, as the one above it: -128 as -127."""
    name, kind, unit, stored = INTEGERS[case]
    content, binary = document(VALUES | {name: stored}, **{name.split(":")[1]: kind})
    content["accessors"][list(VALUES).index(name)]["normalized"] = unit != 1
    splats = read(content, binary)
    meant = np.array(stored) / unit
    expected = read(*document(VALUES | {name: np.maximum(meant, -1.0) if unit != 1 else meant}))
    for array in ARRAYS:
        np.testing.assert_allclose(getattr(splats, array), getattr(expected, array), 1e-6, 1e-6)


@pytest.mark.parametrize("degree", range(4))
def test_harmonics_of_every_degree_are_turned_as_the_splats(read, degree):
    """The colour along a direction turned half about z is that of the file along it."""
    shape = ((degree + 1) ** 2, 2, 3)
    stored = np.random.default_rng(degree).normal(size=shape).astype(np.float32)
    names = [f"SH_DEGREE_{band}_COEF_{n}" for band in range(4) for n in range(2 * band + 1)]
    plain = {name: VALUES[name] for name in ("POSITION", ROTATION, SCALE, OPACITY)}
    pairs = zip(names, stored, strict=False)
    splats = read(*document(plain | {f"{SPLATTING}:{name}": rows for name, rows in pairs}))
    along = np.array([[0.6, 0.48, 0.64], [0.0, -0.6, 0.8]])
    np.testing.assert_allclose(
        colors(along * [-1.0, -1.0, 1.0], splats.sh_dc, splats.sh_rest),
        colors(along, stored[0], stored[1:].transpose(1, 0, 2)),
        atol=1e-6,
    )


def srgb(linear):
    """Return the curve of IEC 61966-2-1."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def test_linear_colours_become_those_of_srgb(tmp_path):
    """Base colours by the curve, other harmonics by its slope, here from a difference.

    0.2140411 is 0.5 in sRGB, 0.001 is on the line; a colour beyond 1 goes on along the curve.
    """
    linear = np.array([[0.2140411, 0.001, 1.5], [0.03, 0.5, 1.0]])
    values = VALUES | {f"{SPLATTING}:SH_DEGREE_0_COEF_0": (linear - 0.5) / SH_C0}
    content, binary = document(values)
    (tmp_path / "srgb.glb").write_bytes(packed(content, binary))
    content["meshes"][0]["primitives"][0]["extensions"][SPLATTING]["colorSpace"] = (
        "lin_rec709_display"
    )
    (tmp_path / "a.glb").write_bytes(packed(content, binary))

    file = read_splats(tmp_path / "a.glb")

    splats = file.splats()
    np.testing.assert_allclose(SH_C0 * splats.sh_dc + 0.5, srgb(linear), atol=1e-6)
    assert abs(splats.sh_dc[0, 0]) < 1e-5
    slopes = (srgb(linear * 1.0001) - srgb(linear * 0.9999)) / (0.0002 * linear)
    rest = read_splats(tmp_path / "srgb.glb").splats().sh_rest
    np.testing.assert_allclose(splats.sh_rest, rest * slopes[:, None], rtol=1e-5)
    assert file.remarks == (
        'a.glb has colorSpace "lin_rec709_display", converted to sRGB: '
        "harmonics and blends are approximate",
    )


def test_what_is_not_as_the_file_says_is_noted(tmp_path):
    """Colours of an unknown space, another projection, and what a reader must know of."""
    content, binary = document()
    kind = content["meshes"][0]["primitives"][0]["extensions"][SPLATTING]
    kind |= {"colorSpace": "custom_display", "projection": "orthographic"}
    content["extensionsRequired"] = [SPLATTING, "KHR_mesh_quantization", "X_packed"]
    (tmp_path / "a.glb").write_bytes(packed(content, binary))
    assert read_splats(tmp_path / "a.glb").remarks == (
        'a.glb has a required extension that is not read, "X_packed"',
        'a.glb has colorSpace "custom_display", read as "srgb_rec709_display"',
        'a.glb has projection "orthographic", read as "perspective"',
    )


def test_scales_of_one_primitive_are_all_logarithms_or_none(tmp_path):
    """One negative scale makes logarithms of those of its primitive alone; NaN makes none."""
    content, binary = document(VALUES | {SCALE: [[-3.0, -2.0, 0.5], [0.0, 1.0, 2.0]]})
    other, more = document(VALUES | {SCALE: [[1.0, 1.0, np.nan], [0.0, 1.0, 1.0]]})
    views, size = len(content["bufferViews"]), len(binary)
    for view in other["bufferViews"]:
        content["bufferViews"].append(view | {"byteOffset": view["byteOffset"] + size})
    for accessor in other["accessors"]:
        content["accessors"].append(accessor | {"bufferView": accessor["bufferView"] + views})
    part = copy.deepcopy(content["meshes"][0]["primitives"][0])
    part["attributes"] = {name: index + views for name, index in part["attributes"].items()}
    content["meshes"][0]["primitives"].append(part)
    (tmp_path / "a.glb").write_bytes(packed(content, binary + more))
    file = read_splats(tmp_path / "a.glb")
    expected = [[-3.0, -2.0, 0.5], [0.0, 1.0, 2.0], [0.0, 0.0, np.nan], [-104.0, 0.0, 0.0]]
    np.testing.assert_array_equal(file.splats().log_scales, expected)
    assert file.remarks == ("a.glb has negative scales: its scales are read as logarithms",)
    assert drawable(file.splats()).tolist() == [True, True, False, True]


def test_values_that_no_splat_holds_are_taken_for_what_they_mean(tmp_path, read):
    """Drafts of the extension have logarithms of scales; they became NaN, and nothing was said.

    The logit of an opacity of 0 is -104, as that of Blender's splats: float32 has nothing that
    small. 1e10 times 1e30 is beyond float32, which cannot be drawn.
    """
    scales = [[-3.0, -2.0, 0.5], [-1.0] * 3]
    values = {**VALUES, SCALE: scales, OPACITY: [[0.0], [-0.1]]}
    (tmp_path / "a.glb").write_bytes(packed(*document(values)))
    file = read_splats(tmp_path / "a.glb")
    assert file.splats().log_scales.tolist() == scales
    note = "a.glb has negative scales: its scales are read as logarithms"
    assert registry.notes(file, None, np.ones(2, np.bool_)) == [note]
    logits = file.splats().opacity_logits
    assert opacity(logits).astype(np.float32).tolist() == [0.0, 0.0]
    np.testing.assert_allclose(logits, -104.0, rtol=1e-6)
    far = document({**VALUES, "POSITION": [[1e10, 0.0, 0.0]] * 2})
    assert read(*far, [{"scale": [1e15] * 3}] * 2).means[:, 0].tolist() == [-np.inf, -np.inf]


@pytest.mark.slow
def test_time_grows_with_the_file_and_not_with_nodes_times_accessors(read):
    """1,000 nodes with one mesh of 20 primitives of 8 attributes: 160 are read, not 160,000.

    Of 20,001 nodes one moves anything: matrices of the others took 80 µs each. Either took seconds,
    as 10,000 that move something without splats did: each was turned by itself.
    """
    content, binary = document()
    crowd = copy.deepcopy(content)
    for accessor in crowd["accessors"]:
        accessor["count"] = 0
    crowd["meshes"][0]["primitives"] *= 20
    crowd |= {"nodes": [{"mesh": 0}] * 1000, "scenes": [{"nodes": list(range(1000))}]}
    assert seconds(lambda: read(crowd, binary), tries=1) < 1.0
    nodes = [{}] * 20_000 + [{"translation": [1.0, 0.0, 0.0]}]
    assert seconds(lambda: read(content, binary, nodes), tries=1) < 1.0
    turned = {"rotation": [0.0, 1.0, 0.0, 0.0], "scale": [2.0] * 3}
    crowd = {"nodes": [{"mesh": 0}, *[turned] * 10_000], "scenes": [{"nodes": [*range(10_001)]}]}
    assert seconds(lambda: read(content | crowd, binary), tries=1) < 0.6


CONTENT, BINARY = document()
PART = ("meshes", 0, "primitives", 0)
NAMED = (*PART, "attributes")
NODE = ("nodes", 0)
LESS = {name: index for index, name in enumerate(list(VALUES)[:-1])}
KIND = (*PART, "extensions", SPLATTING)


def inside(scale):
    """Return two nodes of a scale, one in the other: NumPy warned, or knew no powers, of both."""
    return [{"children": [1], "scale": [scale] * 3}, {"mesh": 0, "scale": [scale] * 3}]


PLACE = "meshes[0] primitives[0]"
SPZ = f"{SPLATTING}_compression_spz_2"
ACCESSOR = {"bufferView": 0, "componentType": FLOAT, "type": "VEC3", "count": 0}

FAULTS = [
    ("scenes", [], "scene: 0 is none of 0 scenes"),
    ("scenes", 0, "nodes", [], "no splats: no node of its scene shows a pri"),
    ("scenes", 0, "nodes", [7], "scenes[0]: 7 is none of 1 nodes"),
    ("scenes", 0, "nodes", ["a"], 'scenes[0]: "a" is none of 1 nodes'),
    (*NODE, "mesh", True, "nodes[0]: true is none of 1 meshes"),
    (*NODE, "children", [0], "nodes[0]: belongs to two nodes, expected a t"),
    (*NODE, "scale", [1, 2], "nodes[0] scale: expected a list of 3 numb"),
    (*NODE, "scale", [10**400] * 3, "nodes[0] scale [0]: expected a f"),
    (*NODE, "scale", [1, 1, 0], "nodes[0]: the transform is flat"),
    (*NODE, "scale", [1, 2, 1], "nodes[0]: the transform scales"),
    ("nodes", inside(1e18), "nodes[1]: the transform sc"),
    ("nodes", inside(1e-30), "nodes[1]: the transform sc"),
    (*NODE, "translation", [float("inf"), 0, 0], "nodes[0] translation [0]: expected a finite"),
    (*PART, "mode", 4, f"{PLACE} mode: expected 0, got 4"),
    (*KIND, "kernel", "cube", f'{PLACE}: splats of kernel "cube", expected "ellipse"'),
    (*KIND, "extensions", {"X_spz": {}}, f'{PLACE}: splats by "X_spz", expected plain accessors'),
    (*KIND, "extensions", {"": {}, SPZ: {}}, f'{PLACE}: splats by "", expected plain accessors'),
    (*KIND, "extensions", {SPZ: {"bufferView": 9}}, f"{PLACE} {SPZ}: 9 is none of 8 bufferViews"),
    (*KIND, "extensions", {SPZ: {"bufferView": 0}}, "a.glb: "),
    (*KIND, "extensions", [1], f"{PLACE}: expected an object, got a list of 1"),
    (*NAMED, {"POSITION": 0}, f"{PLACE} attributes: no {ROTATION}"),
    (*NAMED, LESS, f"{PLACE} attributes: no {SPLATTING}:SH_DEGREE_1_COEF_2"),
    (*NAMED, [], f"{PLACE} attributes: expected an object, got a list of 0"),
    ("accessors", 0, "type", "VEC4", 'accessors[0]: "VEC4" of 5126, exp'),
    ("accessors", 0, "componentType", 5125, 'accessors[0]: "VEC3" of 5125, '),
    ("accessors", 0, "sparse", {}, "accessors[0]: sparse or without values"),
    ("accessors", 0, "count", 10**12, "accessors[0]: 1000000000000 values of 12 "),
    ("accessors", 0, "count", -1, "accessors[0] count: expected a whole number"),
    ("accessors", 2, "count", 1, f"{PLACE} attributes {SCALE}: 1 values, expected 2 as for"),
    ("accessors", 0, ACCESSOR | {"byteOffset": 10**6}, "accessors[0]: 0 values of 12 b"),
    ("bufferViews", 0, "buffer", 1, "bufferViews[0]: 1 is none of 1 buffers"),
    ("bufferViews", 0, "byteOffset", 10**6, "bufferViews[0]: 24 bytes from byte 1000000 of "),
    ("bufferViews", 0, "extensions", {"X_packed": {}}, "bufferViews[0]: compressed, expected p"),
    ("bufferViews", 0, "byteStride", 4, "accessors[0]: 2 values of 12 bytes f"),
]


@pytest.mark.parametrize("case", range(len(FAULTS)))
def test_what_is_wrong_is_named_with_its_place(tmp_path, case):
    """By the path in the JSON, with memory that the file accounts for."""
    *change, expected = FAULTS[case]
    data = packed(with_value(CONTENT, *change), BINARY)
    refused(tmp_path / "a.glb", expected, data, memory=2.5e6)


def test_a_few_bytes_do_not_become_many_splats(tmp_path):
    """300 nodes that show one mesh of 100 splats are 30,000 in 16 KB, refused on the way."""
    content, binary = document({name: rows * 50 for name, rows in VALUES.items()})
    content |= {"nodes": [{"mesh": 0}] * 300, "scenes": [{"nodes": list(range(300))}]}
    message = refused(tmp_path / "a.glb", "its nodes show 16", packed(content, binary))
    assert "00 splats or more, expected at most 16" in message


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (struct.pack("<4sII", b"glTF", 1, 99) + bytes(87), "glTF version 1, expected 2"),
        (struct.pack("<4sII", b"glTF", 2, 2**32 - 1) + bytes(87), "truncated: all chunks need 429"),
        (packed(b"[]"), "JSON: expected an object, got a list of 0"),
        (packed(b"{"), "JSON line 1 column 5: invalid JSON: Expecting prop"),
        (packed(b"[" * 100_000), "JSON: invalid JSON: nested too deeply"),
        (packed(b"\xff\xff"), "JSON: invalid JSON: 'utf-8'"),
        (struct.pack("<4sIII4s", b"glTF", 2, 24, 99, b"JSON") + bytes(4), "truncated: a chunk at "),
        (struct.pack("<4sIII4s", b"glTF", 2, 20, 0, b"BIN\0"), "JSON line 1 column 1: invalid"),
    ],
    ids=range(8),
)
def test_a_file_that_is_no_glb_is_refused(tmp_path, data, expected):
    refused(tmp_path / "a.glb", expected, data)


def test_a_gltf_is_read_with_its_bytes_beside_it_and_in_itself(tmp_path):
    """A GLB's splats. A file named twice counts once among the bytes of the input."""
    content, binary = document()
    (tmp_path / "a.glb").write_bytes(packed(content, binary))
    (tmp_path / "a b").mkdir()
    (tmp_path / "a b/c.bin").write_bytes(binary)
    inside = base64.b64encode(binary).decode()
    uris = ["a%20b/c.bin", f"data:application/octet-stream;base64,{inside}", "./%61 b//c.bin"]
    content["buffers"] = [{"uri": uri, "byteLength": len(binary)} for uri in uris]
    for number, view in enumerate(content["bufferViews"]):
        view["buffer"] = number % 3
    text = json.dumps(content).encode()
    (tmp_path / "a.gltf").write_bytes(text)

    file = read_splats(tmp_path / "a.gltf")

    assert file.rows.tobytes() == read_splats(tmp_path / "a.glb").rows.tobytes()
    assert file.format == f"glTF with {SPLATTING}"
    assert file.origin.size == len(text) + len(binary)
    with pytest.raises(RefineError, match=r"\.gltf is not written"):
        write_splats(tmp_path / "b.gltf", file)


OUTSIDE = "expected a file in this folder or one below"


@pytest.mark.parametrize(
    ("uri", "expected"),
    [
        ("../a.bin", OUTSIDE),
        ("%2e%2e%2fa.bin", OUTSIDE),
        ("b/%2E./../a.bin", OUTSIDE),
        ("/etc/passwd", OUTSIDE),
        ("C:/a.bin", OUTSIDE),
        ("..\\a.bin", OUTSIDE),
        ("file:///etc/passwd", OUTSIDE),
        ("http://127.0.0.1/a.bin", OUTSIDE),
        ("data:text/plain,AAAA", OUTSIDE),
        ("a%00.bin", OUTSIDE),
        ("none.bin", '"none.bin" is not there'),
        (".", OUTSIDE),
        ("\ud800", "is not there"),
        ("a" * 100_000, "is not there"),
        (5, "buffers[0]: expected a string, got 5"),
        ("data:;base64,AAA", "buffers[0]: invalid base64: "),
        ("data:;base64,A*AA", "buffers[0]: invalid base64: "),
        ("data:;base64,", "bufferViews[0]: 24 bytes from byte 0 of 0 do not fit"),
        ("data:;base64,AAAA", "bufferViews[0]: 24 bytes from byte 0 of 3 do not fit"),
        ("short.bin", "bufferViews[0]: 24 bytes from byte 0 of 10 do not fit"),
        ("", "bufferViews[0]: 24 bytes from byte 0 of 0 do not fit"),
    ],
    ids=range(21),
)
def test_a_gltf_reads_nothing_outside_its_folder(tmp_path, uri, expected):
    """Addresses are refused without a look at them, after their % codes are undone."""
    (tmp_path / "in").mkdir()
    (tmp_path / "a.bin").write_bytes(BINARY)
    (tmp_path / "in/short.bin").write_bytes(bytes(10))
    data = json.dumps(with_value(CONTENT, "buffers", 0, "uri", uri)).encode()
    refused(tmp_path / "in/a.gltf", expected, data)


@pytest.mark.parametrize("model", ["default", "antialiased"])
def test_an_spz_within_is_read_and_faces_as_the_extension_says(tmp_path, model):
    """SPZ's axes are right, up and back, those of its decoder here left, up and front.

    That turned half about z, (x, y, z) becomes (x, -y, -z); so do directions.
    """
    (tmp_path / "a.glb").write_bytes(packed(*document()))
    write_splats(tmp_path / "a.spz", read_splats(tmp_path / "a.glb", model))
    stored = read_splats(tmp_path / "a.spz").splats()
    content, binary = document()
    primitive = content["meshes"][0]["primitives"][0]
    primitive["extensions"][SPLATTING]["extensions"] = {SPZ: {"bufferView": 0}}
    content["extensionsRequired"] = [SPLATTING, SPZ]
    data = (tmp_path / "a.spz").read_bytes()
    content["bufferViews"][0] |= {"byteOffset": len(binary), "byteLength": len(data)}
    for accessor in content["accessors"]:
        del accessor["bufferView"]
    (tmp_path / "b.glb").write_bytes(packed(content, binary + data))

    file = read_splats(tmp_path / "b.glb")

    splats, turn = file.splats(), np.diag([1.0, -1.0, -1.0])
    assert (file.model, file.remarks) == (model, ())
    np.testing.assert_allclose(splats.means, stored.means @ turn, atol=1e-6)
    np.testing.assert_allclose(splats.log_scales, stored.log_scales, atol=1e-6)
    np.testing.assert_array_equal(splats.opacity_logits, stored.opacity_logits)
    turned = np.abs(turn @ rotation_matrices(stored.quaternions))
    np.testing.assert_allclose(np.abs(rotation_matrices(splats.quaternions)), turned, atol=1e-6)
    along = np.array([[0.6, 0.0, 0.8], [0.0, -0.6, 0.8]])
    np.testing.assert_allclose(
        colors(along @ turn, splats.sh_dc, splats.sh_rest),
        colors(along, stored.sh_dc, stored.sh_rest),
        atol=1e-6,
    )


def test_models_that_differ_are_refused(tmp_path):
    """An antialiased SPZ beside plain accessors: a file of splats has one model."""
    content, binary = document()
    (tmp_path / "a.glb").write_bytes(packed(content, binary))
    write_splats(tmp_path / "a.spz", read_splats(tmp_path / "a.glb", "antialiased"))
    data = (tmp_path / "a.spz").read_bytes()
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)}
    content["bufferViews"].append(view)
    primitives = content["meshes"][0]["primitives"]
    primitives.append(copy.deepcopy(primitives[0]))
    primitives[1]["extensions"][SPLATTING]["extensions"] = {SPZ: {"bufferView": 8}}
    data = packed(content, binary + data)
    refused(tmp_path / "b.glb", "some splats are default, others not, expected one", data)
