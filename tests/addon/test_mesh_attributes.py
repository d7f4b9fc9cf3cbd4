"""Splats survive the way into a mesh and out again."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.strategies import ply_of

from .conftest import export

ROOM = Path(__file__).parents[1] / "data" / "room_small"


def _link(mesh):
    obj = bpy.data.objects.new(mesh.name, mesh)
    bpy.context.scene.collection.objects.link(obj)
    return obj


def _linked(addon, file):
    """Return a file as an object of the scene, checked."""
    return addon.mesh.layout.check(_link(addon.mesh.attributes.mesh_from_file(file)))


def _file(addon, path, columns, comments=()):
    path.write_bytes(ply_of(columns, comments))
    return addon.core.read_ply(path)


def test_import_and_export_of_the_room_gives_the_same_bytes(addon, room, tmp_path):
    """Nothing is computed on the way: 39755 rows of 62 floats, the header as it was."""
    export(addon, addon.mesh.layout.check(room), tmp_path / "out.ply")

    assert (tmp_path / "out.ply").read_bytes() == (ROOM / "point_cloud.ply").read_bytes()


def test_a_mesh_gives_the_splats_that_the_file_gives(addon, core, room):
    """The table maps each property to its place and back; no value changes."""
    expected = core.read_ply(ROOM / "point_cloud.ply").splats()
    got = addon.mesh.attributes.splats_from_object(addon.mesh.layout.check(room))

    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest"):
        assert np.array_equal(getattr(got, name), getattr(expected, name)), name


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_every_degree_of_harmonics_comes_back(addon, make_splats, tmp_path, degree):
    """3 ((d + 1)^2 - 1) coefficients: 0, 9, 24, 45, 72."""
    file = _file(addon, tmp_path / "in.ply", make_splats(degree=degree))
    obj = _link(addon.mesh.attributes.mesh_from_file(file))
    export(addon, addon.mesh.layout.check(obj), tmp_path / "out.ply")

    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()
    assert addon.mesh.layout.sh_degree(obj.data) == degree


@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2", "i4", "u4", "f4"])
def test_extra_properties_of_every_type_keep_type_place_and_value(
    addon, make_splats, tmp_path, kind
):
    """The extremes of each type, in the midst of the others; u4 goes through int32 by its bits."""
    dtype = np.dtype(kind)
    limits = np.finfo(dtype) if kind == "f4" else np.iinfo(dtype)
    columns = make_splats(count=8)
    columns = {"label": np.resize(np.array([limits.min, limits.max, 0, 1], dtype), 8), **columns}
    file = _file(addon, tmp_path / "in.ply", columns, comments=["made by a test"])
    export(addon, _linked(addon, file), tmp_path / "out.ply")

    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()


@pytest.mark.parametrize(
    "name", ["position", "normal", "id", "material_index", ".hidden", "x" * 80, "refine_score"]
)
def test_a_property_with_a_name_that_blender_keeps_survives(addon, make_splats, tmp_path, name):
    """Blender's own names are stored under others; the layout knows the way back."""
    columns = {**make_splats(count=8), name: np.arange(8, dtype=np.float32)}
    file = _file(addon, tmp_path / "in.ply", columns)
    export(addon, _linked(addon, file), tmp_path / "out.ply")

    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()


def test_big_endian_files_come_back_big_endian(addon, make_splats, tmp_path):
    """The layout notes the byte order of each property."""
    columns = make_splats()
    _file(addon, tmp_path / "little.ply", columns)
    header, body = (tmp_path / "little.ply").read_bytes().split(b"end_header\n")
    header = header.replace(b"little", b"big") + b"end_header\n"
    swapped = np.frombuffer(body, "<f4").astype(">f4").tobytes()
    (tmp_path / "in.ply").write_bytes(header + swapped)
    file = addon.core.read_ply(tmp_path / "in.ply")
    export(addon, _linked(addon, file), tmp_path / "out.ply")

    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()


def test_doubles_are_rounded_and_said_so(addon, make_splats, tmp_path):
    """1/3 in float32 is 0.3333333432674408; the column stays a double."""
    columns = {**make_splats(count=8), "fine": np.full(8, 1 / 3)}
    file = _file(addon, tmp_path / "in.ply", columns)
    notes = addon.mesh.attributes.import_notes(file)
    export(addon, _linked(addon, file), tmp_path / "out.ply")
    got = addon.core.read_ply(tmp_path / "out.ply").rows["fine"]

    assert len(notes) == 1
    assert "fine stored as double" in notes[0]
    assert got.dtype == np.float64
    assert got[0] == np.float32(1 / 3)


def test_a_text_file_comes_out_binary_with_the_same_values(addon, make_splats, tmp_path):
    """Same header but for the format line; other elements are left behind with a note."""
    columns = make_splats(count=3)
    names = "".join(f"property float {name}\n" for name in columns)
    rows = "".join(" ".join(f"{v[i]:.9g}" for v in columns.values()) + "\n" for i in range(3))
    (tmp_path / "in.ply").write_text(
        "ply\nformat ascii 1.0\ncomment kept\nelement vertex 3\n"
        f"{names}element extra 1\nproperty int a\nend_header\n{rows}7\n"
    )
    file = addon.core.read_ply(tmp_path / "in.ply")
    notes = addon.mesh.attributes.import_notes(file)
    export(addon, _linked(addon, file), tmp_path / "out.ply")
    got = addon.core.read_ply(tmp_path / "out.ply")

    assert b"format binary_little_endian 1.0\ncomment kept\n" in got.header
    assert b"extra" not in got.header
    assert all(np.array_equal(got.rows[name], values) for name, values in columns.items())
    assert len(notes) == 1
    assert "in.ply is text" in notes[0]
    assert "(extra)" in notes[0]


def test_meshes_of_blenders_own_importer_are_read(addon, make_splats, tmp_path):
    """It folds nx ny nz into one vector and keeps the rest; the file comes back byte for byte."""
    columns = make_splats(count=50, degree=3)
    _file(addon, tmp_path / "in.ply", columns)
    bpy.ops.wm.ply_import(filepath=str(tmp_path / "in.ply"))
    export(addon, addon.mesh.layout.check(bpy.context.object), tmp_path / "out.ply")

    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()
    size = addon.mesh.layout.export_bytes(bpy.context.object)  # what the panel says
    assert (tmp_path / "out.ply").stat().st_size == size


def test_a_mesh_that_cannot_be_exported_has_no_size(addon, room):
    """Nor does drawing the panel fail: 44 of 45 coefficients are of no degree."""
    size = addon.mesh.layout.export_bytes(room)
    room.data.attributes.remove(room.data.attributes["f_rest_7"])
    del room.data["refine_layout"]

    assert (ROOM / "point_cloud.ply").stat().st_size == size
    assert addon.mesh.layout.export_bytes(room) is None


def test_kiris_vert_form_is_read_and_its_face_form_refused(addon, make_splats, tmp_path):
    """KIRI 3DGS Render marks its objects; 'face' has four vertices a splat."""
    _file(addon, tmp_path / "in.ply", make_splats(count=12))
    bpy.ops.wm.ply_import(filepath=str(tmp_path / "in.ply"))
    obj = bpy.context.object
    obj["3DGS_Mesh_Type"] = "vert"
    obj.data.attributes.new("KIRI_3DGS_Paint", "FLOAT", "POINT")
    count = len(addon.mesh.attributes.splats_from_object(addon.mesh.layout.check(obj)))
    layout = addon.mesh.layout.check(obj).layout
    obj["3DGS_Mesh_Type"] = "face"

    assert count == 12
    assert "KIRI_3DGS_Paint" not in [column.name for column in layout.columns]
    with pytest.raises(addon.core.RefineError, match="four vertices a splat"):
        addon.mesh.layout.check(obj)


def test_attributes_that_are_wrong_are_named(addon, room):
    """Object, attribute, what is there, what is expected."""
    mesh = room.data
    mesh.attributes.remove(mesh.attributes["scale_1"])
    with pytest.raises(addon.core.RefineError, match=r"'room': has no attribute scale_1"):
        addon.mesh.layout.check(room)

    mesh.attributes.new("scale_1", "INT", "POINT")
    with pytest.raises(
        addon.core.RefineError, match=r"'scale_1' is INT on POINT, expected FLOAT on POINT"
    ):
        addon.mesh.layout.check(room)

    mesh.attributes.remove(mesh.attributes["scale_1"])
    mesh.attributes.new("scale_1", "FLOAT", "CORNER")
    with pytest.raises(addon.core.RefineError, match="FLOAT on CORNER, expected FLOAT on POINT"):
        addon.mesh.layout.check(room)


def test_a_missing_property_of_a_foreign_mesh_is_named(addon, make_splats, tmp_path):
    """Without a remembered layout the required names are those of the reference files."""
    columns = make_splats(count=4)
    _file(addon, tmp_path / "in.ply", columns)
    bpy.ops.wm.ply_import(filepath=str(tmp_path / "in.ply"))
    obj = bpy.context.object
    obj.data.attributes.remove(obj.data.attributes["rot_2"])

    with pytest.raises(addon.core.RefineError, match="has no attribute rot_2"):
        addon.mesh.layout.check(obj)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"header": 3, "columns": []}', "null"])
def test_a_damaged_layout_falls_back_to_the_standard_one(addon, room, text):
    """Custom properties can be edited by anyone: they are a hint, the attributes are the truth."""
    room.data["refine_layout"] = text
    columns = [column.name for column in addon.mesh.layout.check(room).layout.columns]

    assert columns[:7] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0"]
    assert len(columns) == 62


def test_objects_that_are_no_splats_are_refused(addon):
    """An empty, a mesh of triangles, a mesh without vertices: a sentence each."""
    empty = bpy.data.objects.new("nothing", None)
    mesh = bpy.data.meshes.new("triangles")
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    triangles = _link(mesh)
    bare = _link(bpy.data.meshes.new("bare"))

    for obj, reason in ((empty, "type EMPTY"), (triangles, "no attribute"), (bare, "no vertices")):
        with pytest.raises(addon.core.RefineError, match=reason):
            addon.mesh.layout.check(obj)


def test_without_harmonics_only_their_finiteness_is_read(addon, make_splats, tmp_path):
    """Scoring must still rank a splat with a NaN coefficient as one that cannot be drawn."""
    columns = make_splats(count=8, degree=1)
    columns["f_rest_4"][3] = np.nan
    file = _file(addon, tmp_path / "in.ply", columns)
    obj = _link(addon.mesh.attributes.mesh_from_file(file))
    splats = addon.mesh.attributes.splats_from_object(addon.mesh.layout.check(obj), sh_rest=False)

    assert splats.sh_rest.shape == (8, 1, 3)
    assert addon.core.splats.drawable(splats).tolist() == [i != 3 for i in range(8)]
