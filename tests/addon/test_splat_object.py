"""What panel and command share, and what the world's frame does to scores and exports."""

from __future__ import annotations

import math

import bpy
import numpy as np
import pytest

from tests.strategies import ply_of

from .conftest import export

COUNT = 9_939


@pytest.fixture
def views(addon, quarter, room_cameras):
    """Return what all visible cameras see."""
    return addon.cameras.CameraChoice("VISIBLE").views(bpy.context)


def test_a_dry_run_and_what_is_refused_change_nothing(
    addon, quarter_file, views, unchanged, tmp_path
):
    """A name that there is not, with those that are; an unsaved scene is no file to save to."""
    core, prune_object = addon.core, addon.objects.splat_group.prune_object
    unchanged.start()
    budget, out = core.Budget(keep=1000), tmp_path / "out.ply"
    report = prune_object("room", views, budget, core.ClosedForm(), dry_run=True, output=out)
    assert report["splats"]["kept"] == 1000
    assert report["files"]["input_bytes"] == quarter_file.stat().st_size
    assert not out.exists()
    for name, save, expected in (
        ("rooom", False, r"no object 'rooom'.*splat objects: room"),
        ("room", True, "not saved in a"),
    ):
        with pytest.raises(core.RefineError, match=expected):
            prune_object(name, views, budget, save=save)
    unchanged()


def test_moving_splats_and_cameras_together_keeps_the_rows(addon, quarter, room_cameras, score):
    """Below one parent, moved, turned and scaled by 3: the default ranks by no unit.

    Blender's matrices are float32: of ten thousand neighbours in rank a few may change places.
    """

    def low():
        score(quarter, addon.cameras.CameraChoice("VISIBLE").views(bpy.context))
        return addon.mesh.attributes.read_attribute(quarter.data, "refine_rank") < 0.5

    before = low()
    parent = bpy.data.objects.new("parent", None)
    bpy.context.scene.collection.objects.link(parent)
    for obj in (quarter, *room_cameras.objects):
        obj.parent = parent
    for camera in room_cameras.objects:  # a frustum's clip distances do not scale with a parent
        camera.data.clip_start, camera.data.clip_end = 1e-4, 1e6
    parent.location, parent.rotation_euler = (3.0, -2.0, 5.0), (0.3, 1.0, -0.7)
    parent.scale = (3.0, 3.0, 3.0)
    bpy.context.view_layer.update()

    assert np.count_nonzero(before != low()) <= 2


@pytest.fixture
def made(addon, tmp_path):
    """Return a function that makes an object of columns, with a transform."""

    def made(columns, **transform):
        (tmp_path / "in.ply").write_bytes(ply_of(columns))
        mesh = addon.mesh.attributes.mesh_from_file(addon.core.read_ply(tmp_path / "in.ply"))
        obj = bpy.data.objects.new("made", mesh)
        for name, value in transform.items():
            setattr(obj, name, value)
        bpy.context.scene.collection.objects.link(obj)
        bpy.context.view_layer.update()
        return obj

    return made


def test_an_unevenly_scaled_object_is_scored_as_it_stands_in_the_world(
    addon, core, make_splats, made, tmp_path
):
    """A scale of (1, 2, 1) on round splats of size s gives ellipsoids s, 2s, s at twice the y."""
    columns = make_splats(count=50)
    for axis in range(3):
        columns[f"scale_{axis}"][:] = -3.0
    checked = addon.mesh.layout.check(made(columns, scale=(1.0, 2.0, 1.0)))
    splats = addon.objects.splat_group.gather([checked])
    sizes = np.sort(splats.log_scales, axis=1)
    assert np.allclose(splats.means[:, 1], 2 * columns["y"])
    assert np.allclose(sizes, [-3.0, -3.0, math.log(2) - 3.0], atol=1e-5)

    export(addon, checked, tmp_path / "out.ply", apply_transform=True)
    written = core.read_ply(tmp_path / "out.ply").splats()
    np.testing.assert_allclose(written.means, splats.means, rtol=1e-6)
    np.testing.assert_allclose(written.log_scales, splats.log_scales, atol=1e-6)


def test_an_export_with_the_transform_is_the_moved_splats(addon, core, make_splats, made, tmp_path):
    """As `core.affine.transformed` has it; without a transform the bytes are the file's.

    A turn takes a normal (1, 0, 0) to its first column; a normal of zero stays zero.
    """
    columns = make_splats(count=50, degree=3)
    for name in ("nx", "ny", "nz"):
        columns[name][:] = 0.0
    columns["nx"][0] = 1.0
    place, turn = (1.0, 2.0, 3.0), (0.1, 0.2, 0.8)
    obj = made(columns, location=place, rotation_euler=turn, scale=(2.0, 2.0, 2.0))
    checked = addon.mesh.layout.check(obj)
    export(addon, checked, tmp_path / "moved.ply", apply_transform=True)
    export(addon, checked, tmp_path / "kept.ply")
    source, moved = (core.read_ply(tmp_path / f"{name}.ply") for name in ("in", "moved"))
    matrix = np.array(obj.matrix_world, np.float64)
    expected, got = core.affine.transformed(source.splats(), matrix), moved.splats()

    assert (tmp_path / "kept.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()
    for name in ("means", "log_scales", "quaternions", "sh_dc", "opacity_logits"):
        assert np.array_equal(getattr(got, name), getattr(expected, name).astype(np.float32)), name
    # A product of matrices may round otherwise where they lie otherwise in memory.
    assert np.allclose(got.sh_rest, expected.sh_rest, rtol=1e-5, atol=1e-7)
    assert np.abs(got.sh_rest - source.splats().sh_rest).max() > 0.1
    normals = np.stack([moved.rows[name] for name in ("nx", "ny", "nz")], axis=1)
    np.testing.assert_allclose(normals[0], matrix[:3, 0] / 2.0, atol=1e-6)
    assert not normals[1:].any()


def test_scores_of_another_mesh_are_not_stored(addon, quarter, room_views):
    """Someone deleted a vertex while the scoring ran."""
    method, check = addon.core.ClosedForm(), addon.mesh.layout.check
    splats = addon.objects.splat_group.gather([check(quarter)])
    scores = addon.core.score(splats, room_views, method)
    addon.mesh.edit.delete_vertices(quarter, np.arange(COUNT) == 7)

    with pytest.raises(addon.core.RefineError, match="9938 splats, was scored with 9939"):
        addon.mesh.scores.store(check(quarter), scores, method)


def test_modifiers_that_could_move_splats_are_mentioned(addon, quarter):
    """What is scored and exported is the mesh itself; KIRI's drawing moves none."""
    quarter.modifiers.new("KIRI_3DGS_Render_GN", "NODES")
    assert addon.objects.splat_group.modifier_notes(quarter) == []
    quarter.modifiers.new("Wave", "WAVE")
    (note,) = addon.objects.splat_group.modifier_notes(quarter)
    assert "without its modifiers (Wave)" in note
