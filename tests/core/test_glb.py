"""Binary glTF by hand: nodes, integers, and files that are not what they say."""

from __future__ import annotations

import json
import re
import struct
import tracemalloc

import numpy as np
import pytest

from refine_addon.core import RefineError, read_splats
from refine_addon.core.formats import glb, registry
from refine_addon.core.spherical_harmonics import colors
from refine_addon.core.splats import opacity, rotation_matrices

SPLATTING = "KHR_gaussian_splatting"
FLOAT, SHORT, BYTE = 5126, 5122, 5121

VALUES = {
    "POSITION": [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]],
    f"{SPLATTING}:ROTATION": [[0.0, 0.0, 0.0, 1.0], [0.5, -0.5, 0.5, -0.5]],
    f"{SPLATTING}:SCALE": [[1.0, 2.0, 4.0], [0.5, 0.0, 0.25]],
    f"{SPLATTING}:OPACITY": [[0.5], [1.0]],
    f"{SPLATTING}:SH_DEGREE_0_COEF_0": [[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]],
    **{
        f"{SPLATTING}:SH_DEGREE_1_COEF_{n}": [[0.1 * n, 0.2, 0.3], [-0.1, 0.2 * n, 0.1]]
        for n in range(3)
    },
}
"""Two splats as the attributes of a primitive; the scale of one is 0 along y."""


def document(values: dict = VALUES, kinds: dict | None = None) -> tuple[dict, bytes]:
    """Return the JSON and the binary chunk of a file with one node."""
    kinds, views, accessors, binary = kinds or {}, [], [], b""
    types = {FLOAT: "<f4", SHORT: "<i2", BYTE: "u1"}
    for name, rows in values.items():
        kind = kinds.get(name, FLOAT)
        data = np.array(rows, types[kind]).tobytes()
        data += bytes(-len(data) % 4)
        shape = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[len(rows[0])]
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)})
        accessors.append({"bufferView": len(accessors), "componentType": kind, "type": shape})
        accessors[-1].update(count=len(rows), normalized=kind != FLOAT)
        binary += data
    primitive = {
        "attributes": {name: index for index, name in enumerate(values)},
        "mode": 0,
        "extensions": {SPLATTING: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return content, binary


def packed(content: object, binary: bytes) -> bytes:
    """Return a file."""
    text = content if isinstance(content, bytes) else json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text
    body += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


@pytest.fixture
def read(tmp_path):
    """Return a function that reads a file of this JSON and binary chunk."""

    def read_back(content, binary):
        (tmp_path / "a.glb").write_bytes(packed(content, binary))
        return read_splats(tmp_path / "a.glb").splats()

    return read_back


def test_values_are_activated_and_y_points_up(read):
    """Half a turn about z: x and y change sign, and so do harmonics of odd order.

    The rotation is multiplied by that turn, (0, 0, 0, 1), from the left: 1 becomes (0, 0, 0, 1).
    A scale of 2 is log 2, one of 0 minus infinity; an opacity of 1 is kept 2^-26 away from it.
    """
    splats = read(*document())

    assert splats.means.tolist() == [[-1.0, -2.0, 3.0], [-4.0, -5.0, 6.0]]
    np.testing.assert_allclose(splats.log_scales[0], np.log([1.0, 2.0, 4.0]), rtol=1e-6)
    assert splats.log_scales[1, 1] == -np.inf
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
    """
    content, binary = document()
    plain = read(content, binary)
    half = float(np.sqrt(0.5))
    child = {
        "mesh": 0,
        "rotation": [half, 0, 0, half],
        "scale": [2, 2, 2],
        "translation": [1, 0, 0],
    }
    content["nodes"] = [{"children": [1], "translation": [0, 0, 1]}, child]

    splats = read(content, binary)

    np.testing.assert_allclose(splats.means[0], [-3.0, 6.0, 5.0], atol=1e-5)
    np.testing.assert_allclose(splats.log_scales[0], plain.log_scales[0] + np.log(2.0), atol=1e-6)
    quarter = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    flip = np.diag([-1.0, -1, 1])
    turn = flip @ quarter @ flip
    np.testing.assert_allclose(
        np.abs(rotation_matrices(splats.quaternions)),
        np.abs(turn @ rotation_matrices(plain.quaternions)),
        atol=1e-6,
    )
    along = np.array([[0.6, 0.0, 0.8], [0.0, -0.6, 0.8]])
    np.testing.assert_allclose(
        colors(along @ turn.T, splats.sh_dc, splats.sh_rest),
        colors(along, plain.sh_dc, plain.sh_rest),
        atol=1e-6,
    )


def test_a_matrix_stands_column_by_column(read):
    """One that moves by (7, 8, 9) has these last; turned half about z that is (-7, -8, 9)."""
    content, binary = document()
    content["nodes"][0]["matrix"] = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 7, 8, 9, 1]

    assert read(content, binary).means.tolist() == [[-8.0, -10.0, 12.0], [-11.0, -13.0, 15.0]]


def test_primitives_of_several_degrees_become_one(read):
    """The one with less has zeros; both are there in the order of the nodes."""
    content, binary = document()
    short = json.loads(json.dumps(content["meshes"][0]["primitives"][0]))
    for n in range(3):
        del short["attributes"][f"{SPLATTING}:SH_DEGREE_1_COEF_{n}"]
    content["meshes"].append({"primitives": [short]})
    content["nodes"].append({"mesh": 1})
    content["scenes"][0]["nodes"] = [1, 0]

    splats = read(content, binary)

    assert splats.sh_rest.shape == (4, 3, 3)
    assert not splats.sh_rest[:2].any()
    assert splats.sh_rest[2:].any()


def test_an_opacity_of_0_stays_0_in_float32(read):
    """Its logit is -104, as that of Blender's splats: float32 has nothing that small."""
    splats = read(*document({**VALUES, f"{SPLATTING}:OPACITY": [[0.0], [-0.1]]}))

    assert opacity(splats.opacity_logits).astype(np.float32).tolist() == [0.0, 0.0]
    np.testing.assert_allclose(splats.opacity_logits, -104.0, rtol=1e-6)


def test_normalized_integers_stand_for_shares(read):
    """Opacity 51 of 255 is .2; a rotation of 32767 is 1, and -32768 is -1 too."""
    values = {**VALUES, f"{SPLATTING}:OPACITY": [[51], [255]]}
    values[f"{SPLATTING}:ROTATION"] = [[0, 0, 0, 32767], [-32768, 0, 0, 0]]
    kinds = {f"{SPLATTING}:OPACITY": BYTE, f"{SPLATTING}:ROTATION": SHORT}
    content, binary = document(values, kinds)
    content["accessors"][3]["count"] = 2

    splats = read(content, binary)

    np.testing.assert_allclose(splats.opacity_logits[0], np.log(0.25), rtol=1e-6)
    assert splats.quaternions.tolist() == [[0.0, 0.0, 0.0, 1.0], [0.0, 0.0, -1.0, 0.0]]


def test_values_may_stand_apart(read):
    """Positions with 8 bytes behind each, by a stride of 20."""
    content, binary = document()
    rows = np.zeros((2, 5), "<f4")
    rows[:, :3] = VALUES["POSITION"]
    content["bufferViews"][0] = {
        "buffer": 0, "byteOffset": len(binary), "byteLength": 40, "byteStride": 20,
    }  # fmt: skip

    assert read(content, binary + rows.tobytes()).means.tolist()[1] == [-4.0, -5.0, 6.0]


def _set(*path_and_value):
    """Return a change of the JSON that sets a value at a path."""
    *path, key, value = path_and_value

    def change(content):
        for step in path:
            content = content[step]
        content[key] = value

    return change


PRIMITIVE = ("meshes", 0, "primitives", 0)

FAULTS = {
    "no scene": (_set("scenes", []), "scene: 0 is none of 0 scenes"),
    "nothing shown": (
        _set("scenes", 0, "nodes", []),
        "no splats: no node of its scene shows a pri",
    ),
    "a node that is not there": (
        _set("scenes", 0, "nodes", [7]),
        "scenes[0]: 7 is none of 1 nodes",
    ),
    "a node by name": (_set("scenes", 0, "nodes", ["a"]), 'scenes[0]: "a" is none of 1 nodes'),
    "true as an index": (_set("nodes", 0, "mesh", True), "nodes[0]: true is none of 1 meshes"),
    "a circle": (_set("nodes", 0, "children", [0]), "nodes[0]: belongs to two nodes, expected a t"),
    "two numbers": (_set("nodes", 0, "scale", [1, 2]), "nodes[0] scale: expected a list of 3 numb"),
    "a huge number": (_set("nodes", 0, "scale", [10**400] * 3), "nodes[0] scale [0]: expected a f"),
    "flat": (
        _set("nodes", 0, "scale", [1, 1, 0]),
        "nodes[0]: the transform is flat",
    ),
    "stretched": (
        _set("nodes", 0, "scale", [1, 2, 1]),
        "nodes[0]: the transform scales",
    ),
    "not finite": (
        _set("nodes", 0, "translation", [float("inf"), 0, 0]),
        "nodes[0] translation [0]: expected a finite",
    ),
    "triangles": (_set(*PRIMITIVE, "mode", 4), "meshes[0] primitives[0] mode: expected 0, got 4"),
    "a kernel": (
        _set(*PRIMITIVE, "extensions", SPLATTING, "kernel", "cube"),
        'meshes[0] primitives[0]: splats of kernel "cube", expected "ellipse"',
    ),
    "compressed": (
        _set(*PRIMITIVE, "extensions", SPLATTING, "extensions", {"X_spz": {}}),
        'meshes[0] primitives[0]: splats by "X_spz", expected plain accessors',
    ),
    "no rotation": (
        lambda content: content["meshes"][0]["primitives"][0]["attributes"].pop(
            f"{SPLATTING}:ROTATION"
        ),
        f"meshes[0] primitives[0] attributes: no {SPLATTING}:ROTATION",
    ),
    "half a band": (
        lambda content: content["meshes"][0]["primitives"][0]["attributes"].pop(
            f"{SPLATTING}:SH_DEGREE_1_COEF_2"
        ),
        f"meshes[0] primitives[0] attributes: no {SPLATTING}:SH_DEGREE_1_COEF_2",
    ),
    "another shape": (
        _set("accessors", 0, "type", "VEC4"),
        'accessors[0]: "VEC4" of 5126, exp',
    ),
    "another type": (_set("accessors", 0, "componentType", 5125), 'accessors[0]: "VEC3" of 5125, '),
    "sparse": (_set("accessors", 0, "sparse", {}), "accessors[0]: sparse or without values"),
    "elsewhere": (
        _set("buffers", 0, "uri", "a.bin"),
        "bufferViews[0]: in another file or compress",
    ),
    "too many": (
        _set("accessors", 0, "count", 10**12),
        "accessors[0]: 1000000000000 values of 12 ",
    ),
    "fewer": (
        _set("accessors", 2, "count", 1),
        f"meshes[0] primitives[0] attributes {SPLATTING}:SCALE: 1 values, expected 2 as for",
    ),
    "a negative": (
        _set("accessors", 0, "count", -1),
        "accessors[0] count: expected a whole number",
    ),
    "beyond": (
        _set("bufferViews", 0, "byteOffset", 10**6),
        "accessors[0]: 2 values of 12 bytes fro",
    ),
    "overlapping": (
        _set("bufferViews", 0, "byteStride", 4),
        "accessors[0]: 2 values of 12 bytes f",
    ),
    "attributes": (
        _set(*PRIMITIVE, "attributes", []),
        "meshes[0] primitives[0] attributes: expected an object, got a list of 0",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_what_is_wrong_is_named_with_its_place(tmp_path, name):
    """By the path in the JSON, with memory that the file accounts for."""
    change, expected = FAULTS[name]
    content, binary = document()
    change(content)
    path = tmp_path / "a.glb"
    path.write_bytes(packed(content, binary))
    tracemalloc.start()

    with pytest.raises(RefineError, match=re.escape(f"{path}: {expected}")):
        read_splats(path)

    assert tracemalloc.get_traced_memory()[1] < 40 * path.stat().st_size + 2_000_000
    tracemalloc.stop()


def test_a_few_bytes_do_not_become_many_splats(tmp_path):
    """300 nodes that show one mesh of 100 splats are 30,000 in 16 KB, refused on the way."""
    content, binary = document({name: rows * 50 for name, rows in VALUES.items()})
    content["nodes"] = [{"mesh": 0}] * 300
    content["scenes"] = [{"nodes": list(range(300))}]
    path = tmp_path / "a.glb"
    path.write_bytes(packed(content, binary))

    with pytest.raises(
        RefineError, match=r"its nodes show 16\d00 splats or more, expected at most 16\d{3}, t"
    ):
        read_splats(path)


@pytest.mark.parametrize("count", [0, 1])
def test_a_mesh_is_read_once_however_many_nodes_show_it(tmp_path, monkeypatch, count):
    """200 nodes with 20 primitives of 8 attributes each: 160 accessors are read, not 32,000.

    Those without splats were built, and then not counted; those with splats before they were.
    """
    content, binary = document()
    for accessor in content["accessors"]:
        accessor["count"] = count
    content["meshes"][0]["primitives"] *= 20
    content["nodes"] *= 200
    content["scenes"] = [{"nodes": list(range(200))}]
    path = tmp_path / "a.glb"
    path.write_bytes(packed(content, binary))
    accessors = []
    values = glb._Document.values
    monkeypatch.setattr(
        glb._Document, "values", lambda *given: accessors.append(1) or values(*given)
    )

    assert len(read_splats(path)) == 200 * 20 * count
    assert len(accessors) == 20 * 8


def test_nodes_that_move_nothing_take_no_matrix(read, monkeypatch):
    """Of 1,001 nodes only the last has one: 100,000 empty ones took 8 s."""
    content, binary = document()
    content["nodes"] = [{"children": [k + 1]} for k in range(1000)]
    content["nodes"].append({"mesh": 0, "translation": [1.0, 0.0, 0.0]})
    made, matrices = [], glb.rotation_matrices
    monkeypatch.setattr(glb, "rotation_matrices", lambda *q: made.append(1) or matrices(*q))

    assert len(read(content, binary)) == 2
    assert len(made) == 1


def test_negative_scales_are_logarithms(tmp_path):
    """Drafts of the extension have them; they became NaN in every row, and nothing was said."""
    content, binary = document({**VALUES, f"{SPLATTING}:SCALE": [[-3.0, -2.0, 0.5], [-1.0] * 3]})
    (tmp_path / "a.glb").write_bytes(packed(content, binary))

    file = read_splats(tmp_path / "a.glb")

    assert file.splats().log_scales.tolist() == [[-3.0, -2.0, 0.5], [-1.0] * 3]
    assert registry.notes(file, None, np.ones(2, np.bool_)) == [
        "a.glb has negative scales: its scales are read as logarithms"
    ]


def test_every_node_shows_the_mesh_where_it_stands(read):
    """Three nodes with one mesh: moved by 5 along x, not moved, moved by 7; x then changes sign."""
    content, binary = document()
    content["nodes"] = [{"mesh": 0, "translation": [x, 0, 0]} for x in (5, 0, 7)]
    content["scenes"] = [{"nodes": [0, 1, 2]}]

    splats = read(content, binary)

    assert splats.means[:, 0].tolist() == [-6.0, -9.0, -1.0, -4.0, -8.0, -11.0]
    assert (splats.sh_dc[:2] == splats.sh_dc[4:]).all()


@pytest.mark.parametrize("scale", [1e18, 1e-30])
def test_a_scale_that_no_splat_can_have_is_refused(tmp_path, scale):
    """Two such nodes, one in the other: 1e36 and 1e-60, of which NumPy warned or knew no powers."""
    content, binary = document()
    content["nodes"] = [
        {"mesh": 0, "scale": [scale] * 3},
        {"children": [0], "scale": [scale] * 3},
    ]
    content["scenes"] = [{"nodes": [1]}]
    (tmp_path / "a.glb").write_bytes(packed(content, binary))

    with (
        np.errstate(all="raise"),
        pytest.raises(RefineError, match=r"nodes\[0\]: the transform sc"),
    ):
        read_splats(tmp_path / "a.glb")


def test_positions_that_a_node_moves_beyond_float32_are_infinite(read):
    """Which cannot be drawn: 1e10 times 1e30 is beyond."""
    content, binary = document({**VALUES, "POSITION": [[1e10, 0.0, 0.0]] * 2})
    content["nodes"] = [
        {"mesh": 0, "scale": [1e15] * 3},
        {"children": [0], "scale": [1e15] * 3},
    ]
    content["scenes"] = [{"nodes": [1]}]

    with np.errstate(all="raise"):
        splats = read(content, binary)

    assert splats.means[:, 0].tolist() == [-np.inf, -np.inf]


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (struct.pack("<4sII", b"glTF", 1, 99) + bytes(87), "glTF version 1, expected 2"),
        (struct.pack("<4sII", b"glTF", 2, 2**32 - 1) + bytes(87), "truncated: all chunks need 429"),
        (packed(b"[]", b""), "JSON: expected an object, got a list of 0"),
        (packed(b"{", b""), "JSON line 1 column 5: invalid JSON: Expecting prop"),
        (packed(b"[" * 100_000, b""), "JSON: invalid JSON: nested too deeply"),
        (packed(b"\xff\xff", b""), "JSON: invalid JSON: 'utf-8'"),
        (struct.pack("<4sIII4s", b"glTF", 2, 24, 99, b"JSON") + bytes(4), "truncated: a chunk at "),
        (
            struct.pack("<4sIII4s", b"glTF", 2, 20, 0, b"BIN\0"),
            "JSON line 1 column 1: invalid JSON: ",
        ),
    ],
)
def test_a_file_that_is_no_glb_is_refused(tmp_path, data, expected):
    """With what was found and expected."""
    path = tmp_path / "a.glb"
    path.write_bytes(data)

    with pytest.raises(RefineError, match=re.escape(f"{path}: {expected}")):
        read_splats(path)
