"""glTF by hand: nodes, integers, bytes beside it, and files that are not what they say."""

import base64
import copy
import json
import struct

import numpy as np
import pytest

from refine_addon.core import read_splats, write_splats
from refine_addon.core.affine import transformed
from refine_addon.core.formats import format as form
from refine_addon.core.formats import registry
from refine_addon.core.spherical_harmonics import colors
from refine_addon.core.splats import ARRAYS, SH_C0, drawable, joined, opacity, rotation_matrices
from tests.hostile import calls, refused, with_value

SPLATTING = "KHR_gaussian_splatting"
OPACITY, ROTATION, SCALE = (f"{SPLATTING}:{name}" for name in ("OPACITY", "ROTATION", "SCALE"))
DTYPES = {5126: "<f4", 5122: "<i2", 5121: "u1", 5120: "i1", 5123: "<u2"}
FLOAT, *INTEGERS = DTYPES
SHORT, BYTE, BYTES, UNSIGNED_SHORT = INTEGERS

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
def opened(tmp_path):
    """Return a function that opens a file of this JSON and binary chunk."""

    def read_back(content, binary, nodes=(), model=None):
        """`nodes`, if given, are the file's, each below the one before."""
        if nodes:
            chain = [{"children": [k + 1], **node} for k, node in enumerate(nodes[:-1])]
            content = {**content, "nodes": [*chain, {"mesh": 0, **nodes[-1]}]}
        (tmp_path / "a.glb").write_bytes(packed(content, binary))
        with np.errstate(all="raise"):
            return read_splats(tmp_path / "a.glb", model)

    return read_back


@pytest.fixture
def read(opened):
    """Return a function that reads the splats of such a file."""
    return lambda *parts: opened(*parts).splats()


def test_values_are_activated_and_y_points_up(read):
    """Half a turn about z: x and y change sign.
    The rotation is multiplied by that turn, (0, 0, 0, 1), from the left: 1 becomes (0, 0, 0, 1).
    A scale of 2 is log 2, one of 0 -104; an opacity of 1 is kept 2^-26 away from it."""
    splats = read(*document())
    assert splats.means.tolist() == [[-1.0, -2.0, 3.0], [-4.0, -5.0, 6.0]]
    np.testing.assert_allclose(splats.log_scales[0], np.log([1.0, 2.0, 4.0]), rtol=1e-6)
    assert splats.log_scales[1, 1] == -104.0
    np.testing.assert_allclose(splats.opacity_logits, [0.0, np.log(2.0**26)], atol=1e-6)
    assert splats.quaternions.tolist() == [[0.0, 0.0, 0.0, 1.0], [-0.5, 0.5, 0.5, -0.5]]
    np.testing.assert_allclose(splats.sh_dc, VALUES[f"{SPLATTING}:SH_DEGREE_0_COEF_0"], rtol=1e-6)


def alike(one, other):
    """Compare splats; a rotation and its negative are one."""
    for name in {*ARRAYS} - {"quaternions"}:
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), 1e-6, 2e-6)
    turns = (rotation_matrices(splats.quaternions) for splats in (one, other))
    np.testing.assert_allclose(*turns, atol=1e-6)


def test_what_nodes_do_is_applied(read):
    """A node turned a quarter about x, of twice the size and moved by (1, 0, 0), in a moved one.
    (x, y, z) becomes 2 (x, -z, y) + (1, 0, 0) + (0, 0, 1), and that is turned half about z.
    A matrix stands column by column: one that moves by (7, 8, 9) has these last."""
    moved = {"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 7, 8, 9, 1]}
    assert read(*document(), [moved]).means.tolist() == [[-8.0, -10.0, 12.0], [-11.0, -13.0, 15.0]]
    half, flip = float(np.sqrt(0.5)), np.diag([-1.0, -1, 1, 1])
    child = {"rotation": [half, 0, 0, half], "scale": [2, 2, 2], "translation": [1, 0, 0]}
    frame = np.array([[2, 0, 0, 1], [0, 0, -2, 0], [0, 2, 0, 1], [0, 0, 0, 1.0]])
    expected = transformed(read(*document()), flip @ frame @ flip)
    alike(read(*document(), [{"translation": [0, 0, 1]}, child]), expected)


def test_every_node_shows_its_primitives_where_it_stands(read):
    """Three nodes: one mesh moved by 5 and by 7 along x, which changes sign, around another.
    The one of less degree has zeros; all are there in the order of the scene's nodes."""
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


def test_values_that_stand_apart_are_read(read):
    """Positions have 8 bytes behind each, by a stride of 20."""
    content, binary = document()
    view = {"buffer": 0, "byteOffset": len(binary), "byteLength": 40, "byteStride": 20}
    content["bufferViews"][0] = view
    rows = np.pad(np.array(VALUES["POSITION"], "<f4"), ((0, 0), (0, 2)))
    splats = read(content, binary + rows.tobytes())
    assert splats.means.tolist() == [[-1.0, -2.0, 3.0], [-4.0, -5.0, 6.0]]


ALLOWED = {ROTATION: [BYTES, SHORT], SCALE: [*INTEGERS], OPACITY: [BYTE, UNSIGNED_SHORT]}


@pytest.mark.parametrize("name", ALLOWED)
@pytest.mark.parametrize("shares", [True, False])
def test_integers_of_every_type_are_read_as_the_floats_they_stand_for(read, name, shares):
    """The least of signed ones is -1, as the one above it: -128 as -127. Signed scales are those of
    drafts. Only scales may stand for themselves."""
    for kind in ALLOWED[name] if shares or name == SCALE else ():
        ends = np.iinfo(DTYPES[kind])
        stored = np.resize([ends.max, 3, ends.min, 0, ends.max // 2], (2, len(VALUES[name][0])))
        content, binary = document(VALUES | {name: stored}, **{name.split(":")[1]: kind})
        content["accessors"][list(VALUES).index(name)]["normalized"] = shares
        meant = np.maximum(stored / ends.max, -1.0) if shares else stored
        alike(read(content, binary), read(*document(VALUES | {name: meant})))


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


def test_linear_colours_become_those_of_srgb(opened):
    """Base colours by the curve, other harmonics by its slope, here from a difference.
    0.2140411 is 0.5 in sRGB, 0.001 is on the line; a colour beyond 1 goes on along the curve."""
    linear = np.array([[0.2140411, 0.001, 1.5], [0.03, 0.5, 1.0]])
    content, binary = document(VALUES | {f"{SPLATTING}:SH_DEGREE_0_COEF_0": (linear - 0.5) / SH_C0})
    rest = opened(content, binary).splats().sh_rest
    file = opened(with_value(content, *KIND, "colorSpace", "lin_rec709_display"), binary)
    np.testing.assert_allclose(SH_C0 * file.splats().sh_dc + 0.5, srgb(linear), atol=1e-6)
    assert abs(file.splats().sh_dc[0, 0]) < 1e-5
    slopes = (srgb(linear * 1.0001) - srgb(linear * 0.9999)) / (0.0002 * linear)
    np.testing.assert_allclose(file.splats().sh_rest, rest * slopes[:, None], rtol=1e-5)
    note = 'a.glb has colorSpace "lin_rec709_display", converted to sRGB: '
    assert file.remarks == (f"{note}harmonics and blends are approximate",)


def test_colours_for_programs_without_the_extension_are_linear(tmp_path, opened, monkeypatch):
    """COLOR_0 is so by glTF: 8 bits, of which half a step is at most 12.92 / 510 of sRGB."""
    monkeypatch.setattr(form, "CHUNK", 1)  # each splat by itself
    write_splats(tmp_path / "b.glb", opened(*document()))
    data = (tmp_path / "b.glb").read_bytes()
    start = len(data) - 2 * (60 + 36) + 24  # behind two positions
    codes = np.frombuffer(data[start : start + 8], np.uint8).reshape(2, 4)
    shown = 0.5 + SH_C0 * np.array(VALUES[f"{SPLATTING}:SH_DEGREE_0_COEF_0"])
    np.testing.assert_allclose(srgb(codes[:, :3] / 255), shown, atol=0.003)
    assert codes[:, 3].tolist() == [128, 255]


def test_what_is_not_as_the_file_says_is_noted(opened):
    """Colours of an unknown space, another projection, and what a reader must know of."""
    content, binary = document()
    kind = content["meshes"][0]["primitives"][0]["extensions"][SPLATTING]
    kind |= {"colorSpace": 7, "projection": "orthographic"}
    content["extensionsRequired"] = [SPLATTING, "KHR_materials_unlit", "X_packed"]
    assert opened(content, binary).remarks == (
        'a.glb has a required extension that is not read, "X_packed"',
        'a.glb has colorSpace 7, read as "srgb_rec709_display"',
        'a.glb has projection "orthographic", read as "perspective"',
    )


def test_scales_of_one_primitive_are_all_logarithms_or_none(opened):
    """One negative scale makes logarithms of those of its primitive alone; NaN makes none."""
    values = VALUES | {SCALE: [[-3.0, -2.0, 0.5], [0.0, 1.0, 2.0]]}
    content, binary = document(values | {"OTHER": [[1.0, 1.0, np.nan], [0.0, 1.0, 1.0]]})
    primitives = content["meshes"][0]["primitives"]
    primitives.append(copy.deepcopy(primitives[0]))
    primitives[1]["attributes"][SCALE] = len(VALUES)
    file = opened(content, binary)
    expected = [[-3.0, -2.0, 0.5], [0.0, 1.0, 2.0], [0.0, 0.0, np.nan], [-104.0, 0.0, 0.0]]
    np.testing.assert_array_equal(file.splats().log_scales, expected)
    note = "a.glb has negative scales: its scales are read as logarithms"
    assert registry.losses(file, None, np.ones(4, np.bool_)) == (0, [note])
    assert drawable(file.splats()).tolist() == [True, True, False, True]


def test_values_that_no_splat_holds_are_taken_for_what_they_mean(read):
    """The logit of an opacity of 0 is -104, as that of Blender's splats: float32 has nothing that
    small. 1e10 times 1e30 is beyond float32, which cannot be drawn."""
    splats = read(*document(VALUES | {OPACITY: [[0.0], [-0.1]]}))
    np.testing.assert_allclose(splats.opacity_logits, -104.0, rtol=1e-6)
    assert opacity(splats.opacity_logits).astype(np.float32).tolist() == [0.0, 0.0]
    far = document({**VALUES, "POSITION": [[1e10, 0.0, 0.0]] * 2})
    assert read(*far, [{"scale": [1e15] * 3}] * 2).means[:, 0].tolist() == [-np.inf, -np.inf]


@pytest.mark.slow
def test_time_grows_with_the_file_and_not_with_nodes_times_accessors(read):
    """1,000 nodes with one mesh of 20 primitives of 8 attributes: 160 are read, not 160,000.
    Of 20,001 nodes one moves anything: the others have no matrix. 10,000 are turned together."""
    content, binary = document()
    crowd = copy.deepcopy(content)
    for accessor in crowd["accessors"]:
        accessor["count"] = 0
    crowd["meshes"][0]["primitives"] *= 20
    crowd |= {"nodes": [{"mesh": 0}] * 1000, "scenes": [{"nodes": list(range(1000))}]}
    assert calls(lambda: read(crowd, binary)) < 150_000
    nodes = [{}] * 20_000 + [{"translation": [1.0, 0.0, 0.0]}]
    assert calls(lambda: read(content, binary, nodes)) < 60 * len(nodes)
    turned = {"rotation": [0.0, 1.0, 0.0, 0.0], "scale": [2.0] * 3}
    crowd = {"nodes": [{"mesh": 0}, *[turned] * 10_000], "scenes": [{"nodes": [*range(10_001)]}]}
    assert calls(lambda: read(content | crowd, binary)) < 200 * 10_000


CONTENT, BINARY = document()
PART = ("meshes", 0, "primitives", 0)
NAMED = (*PART, "attributes")
NODE = ("nodes", 0)
LESS = {name: index for index, name in enumerate(list(VALUES)[:-1])}
KIND = (*PART, "extensions", SPLATTING)
PLACE = "meshes[0] primitives[0]"
SPZ = f"{SPLATTING}_compression_spz_2"
ACCESSOR = {"bufferView": 0, "componentType": FLOAT, "type": "VEC3", "count": 0}
SCALES = [{"scale": [scale] * 3} for scale in (1e18, 1e-30)]
INSIDE = [[{"children": [1], **scale}, {"mesh": 0, **scale}] for scale in SCALES]
URI, OUTSIDE = ("buffers", 0, "uri"), "expected a file in this folder or one below"

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
    ("nodes", INSIDE[0], "nodes[1]: the transform sc"),  # NumPy warned, or knew no powers, of both
    ("nodes", INSIDE[1], "nodes[1]: the transform sc"),
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
    ("accessors", 0, "sparse", {}, "accessors[0]: sparse or without values in a bufferView"),
    ("accessors", 0, "count", 10**12, "accessors[0]: 1000000000000 values of 12 "),
    ("accessors", 0, "count", -1, "accessors[0] count: expected a whole number"),
    ("accessors", 2, "count", 1, f"{PLACE} attributes {SCALE}: 1 values, expected 2 as for"),
    ("accessors", 0, ACCESSOR | {"byteOffset": 10**6}, "accessors[0]: 0 values of 12 b"),
    ("bufferViews", 0, "buffer", 1, "bufferViews[0]: 1 is none of 1 buffers"),
    ("bufferViews", 0, "byteOffset", 10**6, "bufferViews[0]: 24 bytes from byte 1000000 of "),
    ("bufferViews", 0, "extensions", {"X_packed": {}}, "bufferViews[0]: compressed, expected p"),
    ("bufferViews", 0, "byteStride", 4, "accessors[0]: 2 values of 12 bytes f"),
    *((*URI, f"{up}/a.bin", OUTSIDE) for up in ("%2e%2e", "http://[::1]", "", "%00", "data:")),
    *((*URI, name, "is not there") for name in ("none.bin", "\ud800", "a" * 100_000)),
    (*URI, 5, "buffers[0]: expected a string, got 5"),
    *((*URI, f"data:;base64,{text}", "buffers[0]: invalid base64: ") for text in ("AAA", "AA*AA")),
    (*URI, "data:;base64,AAAA", "bufferViews[0]: 24 bytes from byte 0 of 3 do not fit"),
]
"""Where to put which value, and what is said. Of addresses that lead out of the folder, after their
% codes are undone, no file is so much as looked for."""


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


def test_a_file_that_is_no_glb_is_refused(tmp_path):
    head, chunk = struct.Struct("<4sII").pack, struct.Struct("<4sIII4s").pack
    for data, expected in (
        (head(b"glTF", 1, 99) + bytes(87), "glTF version 1, expected 2"),
        (head(b"glTF", 2, 2**32 - 1) + bytes(87), "truncated: all chunks need 4294967295"),
        (packed(b"[]"), "JSON: expected an object, got a list of 0"),
        (packed(b"{"), "JSON line 1 column 5: invalid JSON: Expecting prop"),
        (chunk(b"glTF", 2, 24, 99, b"JSON") + bytes(4), "truncated: a chunk at byte 20 and "),
        (chunk(b"glTF", 2, 20, 0, b"BIN\0"), "JSON line 1 column 1: invalid"),
    ):
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
    assert file.stored_bytes == len(text) + len(binary)


@pytest.fixture
def with_spz(tmp_path, opened):
    """Return a function: the stored splats, and a file that has them in views of an SPZ within."""

    def made(model, *views, behind=b""):
        """`views` are those of the primitives; 8 is one that shares its bytes with 0."""
        write_splats(tmp_path / "a.spz", opened(*document(), (), model), overwrite=True)
        data = (tmp_path / "a.spz").read_bytes() + behind
        content, binary = document()
        content["bufferViews"].append(content["bufferViews"][0])
        for view in content["bufferViews"][::8]:
            view |= {"byteOffset": len(binary), "byteLength": len(data)}
        primitives = content["meshes"][0]["primitives"]
        for view in views:
            packing = {SPZ: {"bufferView": view}}
            primitives.append(with_value(primitives[0], *KIND[4:], "extensions", packing))
        del primitives[0]
        content["extensionsRequired"] = [SPLATTING, SPZ]
        return read_splats(tmp_path / "a.spz").splats(), (content, binary + data)

    return made


@pytest.mark.parametrize("model", ["default", "antialiased"])
def test_an_spz_within_is_read_and_faces_as_the_extension_says(opened, with_spz, model):
    """SPZ's axes are right, up and back, those of its decoder here left, up and front.
    That turned half about z, (x, y, z) becomes (x, -y, -z)."""
    stored, parts = with_spz(model, 0, 0)
    file = opened(*parts)
    expected = transformed(stored, np.diag([1.0, -1.0, -1.0, 1.0]))
    assert (file.model, file.remarks) == (model, ())
    alike(file.splats(), joined([expected] * 2))


def test_spz_files_that_share_their_bytes_or_differ_in_model_are_refused(tmp_path, with_spz):
    """Each view of a file of 1 MB may be unpacked to 1 GB; a file of splats has one model."""
    path, (content, binary) = tmp_path / "b.glb", with_spz("default", 0, 8, behind=bytes(10**5))[1]
    refused(path, f"{SPZ}: 200", packed(content, binary))
    content, binary = with_spz("antialiased", 0)[1]
    content["meshes"][0]["primitives"] += document()[0]["meshes"][0]["primitives"]
    refused(path, "some splats are antialiased, others not, expected one", packed(content, binary))
