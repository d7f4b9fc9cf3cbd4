"""Splats survive the way into a mesh and out again."""

import bpy
import numpy as np
import pytest

from tests.strategies import ply_of

from .conftest import ROOM, export, linked

ROOM_PLY = ROOM / "point_cloud.ply"


@pytest.fixture
def through(addon, tmp_path):
    """Return what imports and exports a file: object, whether it is the same, notes, new file."""

    def through(content, comments=()):
        source, target = tmp_path / "in.ply", tmp_path / "out.ply"
        source.write_bytes(content if isinstance(content, bytes) else ply_of(content, comments))
        file = addon.core.read_ply(source)
        obj = linked("in", addon.mesh.attributes.mesh_from_file(file))
        target.unlink(missing_ok=True)
        export(addon, addon.mesh.layout.check(obj), target)
        same = target.read_bytes() == source.read_bytes()
        return obj, same, addon.mesh.attributes.import_notes(file), addon.core.read_ply(target)

    return through


def test_the_room_comes_back_and_is_what_its_file_is(addon, core, room, tmp_path):
    """39755 rows of 62 floats, the header as it was; 44 of 45 coefficients are of no degree."""
    checked = addon.mesh.layout.check(room)
    export(addon, checked, tmp_path / "out.ply")
    assert (tmp_path / "out.ply").read_bytes() == ROOM_PLY.read_bytes()
    assert checked.layout.file_bytes(len(checked)) == ROOM_PLY.stat().st_size
    expected, got = (
        core.read_ply(ROOM_PLY).splats(),
        addon.mesh.attributes.splats_from_object(checked),
    )
    for name in core.splats.ARRAYS:
        assert np.array_equal(getattr(got, name), getattr(expected, name)), name

    room.modifiers.new("KIRI_3DGS_Render_GN", "NODES")  # draws splats, and moves none
    assert addon.objects.splat_group.modifier_notes(room) == []
    room.modifiers.new("Wave", "WAVE")
    (note,) = addon.objects.splat_group.modifier_notes(room)
    assert "without its modifiers (Wave)" in note

    room.data.attributes.remove(room.data.attributes["f_rest_7"])
    del room.data["refine_layout"]
    assert addon.mesh.layout.layout_if_any(room) is None


def test_every_degree_and_extra_property_comes_back(addon, make_splats, through):
    """3 ((d + 1)^2 - 1) coefficients; the extremes of each type; names that Blender keeps."""
    for degree in range(5):
        obj, same, *_ = through(make_splats(degree=degree))
        assert same
        assert addon.mesh.layout.sh_degree(obj.data) == degree
    columns = make_splats()
    for kind in ("i1", "u1", "i2", "u2", "i4", "u4", "f4"):
        dtype = np.dtype(kind)
        limits = np.finfo(dtype) if kind == "f4" else np.iinfo(dtype)
        extremes = np.resize(np.array([limits.min, limits.max, 0, 1], dtype), 8)
        columns = {f"extremes_{kind}": extremes, **columns}
    for name in ("position", "normal", "id", "material_index", ".hidden", "x" * 80, "refine_score"):
        columns[name] = np.arange(8, dtype=np.float32)
    assert through(columns, ["made by a test"])[1]

    header, body = ply_of(make_splats()).split(b"end_header\n")
    swapped = np.frombuffer(body, "<f4").astype(">f4").tobytes()
    assert through(header.replace(b"little", b"big") + b"end_header\n" + swapped)[1]

    _, _, (note,), got = through({**make_splats(), "fine": np.full(8, 1 / 3)})
    assert "fine stored as double" in note
    assert got.rows["fine"].dtype == np.float64
    assert got.rows["fine"][0] == np.float32(1 / 3)


def test_meshes_of_blenders_own_importer_and_of_kiri_are_read(addon, make_splats, tmp_path):
    """It folds nx ny nz into one vector and keeps the rest; KIRI 3DGS Render marks its objects."""
    source, target, layout = tmp_path / "in.ply", tmp_path / "out.ply", addon.mesh.layout
    source.write_bytes(ply_of(make_splats(count=50, degree=3)))
    bpy.ops.wm.ply_import(filepath=str(source))
    obj = bpy.context.object
    export(addon, layout.check(obj), target)
    assert target.read_bytes() == source.read_bytes()
    assert target.stat().st_size == layout.layout_of(obj).file_bytes(50)  # what the panel says

    obj["3DGS_Mesh_Type"] = "vert"
    obj.data.attributes.new("KIRI_3DGS_Paint", "FLOAT", "POINT")
    checked = layout.check(obj)
    assert len(addon.mesh.attributes.splats_from_object(checked)) == 50
    assert "KIRI_3DGS_Paint" not in [column.name for column in checked.layout.columns]
    obj["3DGS_Mesh_Type"] = "face"
    with pytest.raises(addon.core.RefineError, match="four vertices a splat"):
        layout.check(obj)
    obj["3DGS_Mesh_Type"] = "vert"
    obj.data.attributes.remove(obj.data.attributes["rot_2"])
    with pytest.raises(addon.core.RefineError, match="has no attribute rot_2"):
        layout.check(obj)


def test_what_is_no_splats_is_named(addon, room):
    """An empty, triangles, no vertices, a wrong attribute: what is there, what is expected."""
    mesh, attributes = bpy.data.meshes.new("triangles"), room.data.attributes
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    bare = bpy.data.meshes.new("bare")
    others = [linked("none"), linked("triangles", mesh), linked("bare", bare)]
    expected = ["type EMPTY", "no attribute", "no vertices"]
    for kind, sentence in (
        (("INT", "POINT"), r"'scale_1' is INT on POINT, expected FLOAT on POINT"),
        (("FLOAT", "CORNER"), "FLOAT on CORNER, expected FLOAT on POINT"),
        (None, r"'room': has no attribute scale_1"),
    ):
        attributes.remove(attributes["scale_1"])
        if kind:
            attributes.new("scale_1", *kind)
        with pytest.raises(addon.core.RefineError, match=sentence):
            addon.mesh.layout.check(room)
    for obj, sentence in zip(others, expected, strict=True):
        with pytest.raises(addon.core.RefineError, match=sentence):
            addon.mesh.layout.check(obj)


def test_a_damaged_layout_falls_back_to_the_standard_one(addon, room):
    """Custom properties can be edited by anyone: they are a hint, the attributes are the truth."""
    for text in ("", "{", "[]", '{"header": 3, "columns": []}', "null"):
        room.data["refine_layout"] = text
        columns = [column.name for column in addon.mesh.layout.check(room).layout.columns]
        assert columns[:7] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0"]
        assert len(columns) == 62


def test_without_harmonics_only_their_finiteness_is_read(addon, make_splats, through):
    """Scoring must still rank a splat with a NaN coefficient as one that cannot be drawn."""
    columns = make_splats(count=8, degree=1)
    columns["f_rest_4"][3] = np.nan
    checked = addon.mesh.layout.check(through(columns)[0])
    splats = addon.mesh.attributes.splats_from_object(checked, sh_rest=False)
    assert splats.sh_rest.shape == (8, 1, 3)
    assert addon.core.splats.drawable(splats).tolist() == [i != 3 for i in range(8)]


def test_an_export_is_moved_as_its_object(addon, core, make_splats, through, tmp_path):
    """A turn takes a normal (1, 0, 0) to its first column; a normal of zero stays zero."""
    columns = make_splats(count=50, degree=3)
    for name in ("nx", "ny", "nz"):
        columns[name][:] = 0.0
    columns["nx"][0] = 1.0
    obj, _, _, source = through(columns)
    obj.location, obj.rotation_euler, obj.scale = (1, 2, 3), (0.1, 0.2, 0.8), (2, 2, 2)
    bpy.context.view_layer.update()
    checked, matrix = addon.mesh.layout.check(obj), np.array(obj.matrix_world, np.float64)
    export(addon, checked, tmp_path / "moved.ply", apply_transform=True)
    moved = core.read_ply(tmp_path / "moved.ply")
    expected, got = core.affine.transformed(source.splats(), matrix), moved.splats()

    for name in ("means", "log_scales", "quaternions", "sh_dc", "opacity_logits"):
        assert np.array_equal(getattr(got, name), getattr(expected, name).astype(np.float32)), name
    assert np.allclose(got.sh_rest, expected.sh_rest, rtol=1e-5, atol=1e-7)
    assert np.abs(got.sh_rest - source.splats().sh_rest).max() > 0.1
    normals = np.stack([moved.rows[name] for name in ("nx", "ny", "nz")], axis=1)
    np.testing.assert_allclose(normals[0], matrix[:3, 0] / 2.0, atol=1e-6)
    assert not normals[1:].any()
