"""Levels of detail in the panel: objects in a collection, the original left as it was."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from .conftest import snapshot


@pytest.fixture
def few(addon, room, room_cameras):
    """Every tenth splat of the room, moved; two levels by deletion with the closed form."""
    remove = np.arange(len(room.data.vertices)) % 10 != 0
    addon.mesh.edit.delete_vertices(room, remove)
    settings = bpy.context.scene.refine
    settings.levels = "0.5, 0.1"
    return room


def splats_of(addon, obj):
    """Return an object's splats in its own frame."""
    return addon.mesh.attributes.splats_from_object(addon.mesh.layout.check(obj))


def test_levels_are_objects_beside_the_original(addon, few, room_views):
    """3976 splats: 1988 and 398, those that core keeps, in a collection of their own."""
    core = addon.core
    wanted = core.lod(
        addon.objects.splat_group.gather([addon.mesh.layout.check(few)], whole=True),
        room_views,
        core.Levels((0.5, 0.1)),
        addon.core.ClosedForm(),
    )
    before, matrix = splats_of(addon, few), few.matrix_world.copy()

    assert bpy.ops.refine.levels() == {"FINISHED"}

    collection = bpy.data.collections["room levels"]
    assert sorted(obj.name for obj in collection.objects) == ["room_lod1", "room_lod2"]
    assert len(few.data.vertices) == 3976
    for number, level in enumerate(wanted, start=1):
        obj = collection.objects[f"room_lod{number}"]
        np.testing.assert_array_equal(splats_of(addon, obj).means, before.means[level.result.keep])
        assert obj.matrix_world == matrix
        assert obj["refine_lod"]["splats"] == len(obj.data.vertices)
    assert len(collection.objects["room_lod2"].data.vertices) == 398
    assert bpy.context.object == few


def test_merged_levels_stand_where_the_original_does(addon, few):
    """The object and its cameras moved: splats are stored in its frame."""
    few.matrix_world = Matrix.Translation((1.0, 2.0, 3.0))
    for camera in (obj for obj in bpy.data.objects if obj.type == "CAMERA"):
        camera.matrix_world = Matrix.Translation((1.0, 2.0, 3.0)) @ camera.matrix_world
    settings = bpy.context.scene.refine
    settings.method, settings.levels, settings.views = "merge", "0.3", 8
    bpy.context.view_layer.update()
    low, high = (f(splats_of(addon, few).means, axis=0) for f in (np.min, np.max))

    assert bpy.ops.refine.levels() == {"FINISHED"}

    level = bpy.data.objects["room_lod1"]
    assert len(level.data.vertices) == 1193  # ceil(.3 * 3976)
    means = splats_of(addon, level).means
    original = {row.tobytes() for row in splats_of(addon, few).means}
    assert any(row.tobytes() not in original for row in means)
    assert np.all(means > low - 0.1)
    assert np.all(means < high + 0.1)
    assert level.matrix_world.translation.to_tuple() == (1.0, 2.0, 3.0)


def test_protected_splats_are_in_every_level(addon, few):
    """A boolean attribute on 100 of 3976 splats; the last level keeps 398."""
    mask = np.arange(3976) % 40 == 0
    addon.mesh.attributes.write_attribute(few.data, "mine", "BOOLEAN", mask)
    bpy.context.scene.refine.protect = "mine"

    bpy.ops.refine.levels()

    last = bpy.data.objects["room_lod2"].data
    assert addon.mesh.attributes.read_attribute(last, "mine").sum() == mask.sum()


@pytest.mark.parametrize("levels", ["", "a, b", "0.5, 0.6", "1.5"])
def test_levels_that_cannot_be_leave_the_scene_alone(few, levels):
    """The operator says what was expected."""
    bpy.context.scene.refine.levels = levels
    before = snapshot()

    with pytest.raises(RuntimeError, match=r"expected|got"):
        bpy.ops.refine.levels()

    assert snapshot() == before


def test_where_an_object_cannot_be_made_none_is(addon, few, monkeypatch):
    """The second level fails: collection, objects and meshes are gone again."""
    whole, calls = addon.objects.splat_group.apply, []

    def failing(group, parts):
        calls.append(1)
        if len(calls) == 2:
            raise addon.core.RefineError("no")
        return whole(group, parts)

    monkeypatch.setattr(addon.objects.splat_group, "apply", failing)
    before = snapshot()

    with pytest.raises(RuntimeError, match="no"):
        bpy.ops.refine.levels()

    assert snapshot() == before


def test_levels_go_with_one_undo(few):
    """The module pushes no undo steps by itself; a window does, for an operator with UNDO."""
    bpy.ops.ed.undo_push(message="before")
    bpy.ops.refine.levels()
    bpy.ops.ed.undo_push(message="levels")

    bpy.ops.ed.undo()

    assert "room levels" not in bpy.data.collections
    assert "room_lod1" not in bpy.data.objects
    assert len(bpy.data.objects["room"].data.vertices) == 3976


def test_another_mode_than_object_mode_is_refused(few):
    """Levels are made in object mode."""
    assert bpy.ops.refine.levels.poll()
    bpy.ops.object.mode_set(mode="VERTEX_PAINT")
    assert few.mode == "VERTEX_PAINT"

    assert not bpy.ops.refine.levels.poll()


def test_levels_are_exported_as_a_streamed_sog(addon, few, tmp_path):
    """3976, 1988 and 398 splats, from the object or a level of it; replaced only when told."""
    few.matrix_world = Matrix.Scale(2.0, 4)
    bpy.context.view_layer.update()
    assert bpy.ops.refine.levels() == {"FINISHED"}
    before = {
        obj.name: splats_of(addon, obj).means for obj in bpy.data.objects if obj.type == "MESH"
    }

    assert bpy.ops.refine.export_levels(filepath=str(tmp_path / "web")) == {"FINISHED"}

    path = tmp_path / "web/lod-meta.json"
    for level, (name, count) in enumerate(
        {"room": 3976, "room_lod1": 1988, "room_lod2": 398}.items()
    ):
        means = addon.core.read_splats(path, level=level).splats().means
        wanted = before[name]
        assert len(means) == len(wanted) == count
        np.testing.assert_allclose(np.sort(means, axis=0), np.sort(wanted, axis=0), atol=3e-4)
    bpy.context.view_layer.objects.active = bpy.data.objects["room_lod2"]
    with pytest.raises(RuntimeError, match="exists already"):
        bpy.ops.refine.export_levels(filepath=str(path))
    bpy.ops.refine.export_levels(filepath=str(path), overwrite=True, apply_transform=True)
    means = addon.core.read_splats(path, level=2).splats().means
    wanted = before["room_lod2"] * 2.0
    np.testing.assert_allclose(np.sort(means, axis=0), np.sort(wanted, axis=0), atol=6e-4)


def test_the_button_stands_where_there_are_levels(addon, few):
    """On the object and on each level; on another there is none."""
    has = addon.objects.splat_group.has_levels
    assert not has(few)
    assert not has(None)

    bpy.ops.refine.levels()

    assert has(few)
    assert has(bpy.data.objects["room_lod2"])
    for name in ("room_lod1", "room_lod2"):
        bpy.data.objects.remove(bpy.data.objects[name])
    assert not has(few)


def test_an_object_without_levels_is_not_exported_as_some(few, tmp_path):
    """It says what to do."""
    with pytest.raises(RuntimeError, match="'room': has no levels; make them first"):
        bpy.ops.refine.export_levels(filepath=str(tmp_path / "web"))
    assert not (tmp_path / "web").exists()
    assert few.name == "room"


def test_a_chunk_is_as_wide_as_the_views_are_away(addon, few, tmp_path, monkeypatch):
    """In the unit of the object, which is twice as large in the world; else that of the world."""
    few.matrix_world = Matrix.Scale(2.0, 4)
    bpy.context.view_layer.update()
    bpy.ops.refine.levels()
    module, widths = addon.ui.export_operators, []
    made = module.StreamedSog
    monkeypatch.setattr(
        module,
        "StreamedSog",
        lambda means, width, folder: widths.append(width) or made(means, width, folder),
    )

    for apply in (False, True):
        bpy.ops.refine.export_levels(filepath=str(tmp_path / str(apply)), apply_transform=apply)

    far = bpy.data.objects["room_lod1"]["refine_lod"]["distance"]
    assert widths == pytest.approx([far / 2.0, far])
    assert 0.5 < far < 20.0
