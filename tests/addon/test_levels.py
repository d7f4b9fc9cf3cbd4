"""Levels of detail in the panel: objects in a collection, the original left as it was."""

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from .conftest import read, splats_of


def test_levels_are_objects_beside_the_original(addon, few, room_views):
    """3976 splats: 1988 and 398, those that core keeps, in a collection of their own.
    They are hidden, in renders too, so that they do not stand on top of each other. Of 100 that
    are protected the last level has all."""
    core, mask = addon.core, np.arange(3976) % 40 == 0
    addon.mesh.attributes.write_attribute(few.data, "mine", "BOOLEAN", mask)
    settings = bpy.context.scene.refine
    settings.protect, settings.levels = "mine", "0.5, 0.1"
    levels, method = core.Levels((0.5, 0.1)), core.ClosedForm()
    wanted = core.lod(splats_of(addon, few), room_views, levels, method, protected=mask)
    before, matrix = read(addon, few, "position"), few.matrix_world.copy()
    assert bpy.ops.refine.levels() == {"FINISHED"}

    collection = bpy.data.collections["room levels"]
    assert sorted(obj.name for obj in collection.objects) == ["room_lod1", "room_lod2"]
    for number, level in enumerate(wanted, start=1):
        made = collection.objects[f"room_lod{number}"]
        np.testing.assert_array_equal(read(addon, made, "position"), before[level.result.keep])
        assert made.matrix_world == matrix
        assert made["refine_lod"]["splats"] == len(made.data.vertices)
        assert (made.visible_get(), made.hide_render) == (False, True)
    assert len(made.data.vertices) == 398
    assert read(addon, made, "mine").sum() == 100
    assert len(few.data.vertices) == 3976
    assert bpy.context.object == few
    assert few.visible_get()


def test_levels_that_cannot_be_leave_the_scene_alone(addon, few, monkeypatch, unchanged, tmp_path):
    """The operator says what was expected; where the second object cannot be made none is."""
    whole, calls = addon.objects.splat_group.apply, []

    def failing(group, parts):
        calls.append(1)
        if len(calls) == 2:
            raise addon.core.RefineError("expected to fail")
        return whole(group, parts)

    unchanged.start()
    for levels in ("", "a, b", "0.5, 0.6", "1.5", "0.5, 0.1"):
        bpy.context.scene.refine.levels = levels
        if levels == "0.5, 0.1":
            monkeypatch.setattr(addon.objects.splat_group, "apply", failing)
        with pytest.raises(RuntimeError, match=r"expected|got"):
            bpy.ops.refine.levels()
        unchanged()
    assert len(calls) == 2
    with pytest.raises(RuntimeError, match="'room': has no levels; make them first"):
        bpy.ops.refine.export_levels(filepath=str(tmp_path / "web"))
    assert not (tmp_path / "web").exists()
    bpy.ops.object.mode_set(mode="VERTEX_PAINT")
    assert not bpy.ops.refine.levels.poll()


def test_levels_are_exported_as_a_streamed_sog(addon, few, tmp_path):
    """3976, 1988 and 398 splats, from the object or a level of it; replaced only when told.
    A copy of a level is none, nor are levels once others were made."""
    has, path = addon.objects.splat_group.has_levels, tmp_path / "web/lod-meta.json"
    assert not has(few)
    few.matrix_world = Matrix.Scale(2.0, 4)
    bpy.context.view_layer.update()
    bpy.context.scene.refine.levels = "0.5, 0.1"
    bpy.ops.refine.levels()

    def is_level(number, name, scale):
        means = addon.core.read_splats(path, level=number).splats().means
        wanted = read(addon, bpy.data.objects[name], "position") * scale
        np.testing.assert_allclose(
            np.sort(means, axis=0), np.sort(wanted, axis=0), atol=3e-4 * scale
        )
        return len(means)

    bpy.data.collections["room levels"].objects.link(bpy.data.objects["room_lod1"].copy())
    assert bpy.ops.refine.export_levels(filepath=str(tmp_path / "web")) == {"FINISHED"}
    names = ("room", "room_lod1", "room_lod2")
    assert [is_level(*pair, 1.0) for pair in enumerate(names)] == [3976, 1988, 398]
    level = bpy.context.view_layer.objects.active = bpy.data.objects["room_lod2"]
    with pytest.raises(RuntimeError, match="exists already"):
        bpy.ops.refine.export_levels(filepath=str(path))
    bpy.ops.refine.export_levels(filepath=str(path), overwrite=True, apply_transform=True)
    assert is_level(2, "room_lod2", 2.0) == 398
    assert has(few)
    assert has(level)
    bpy.context.view_layer.objects.active = few
    bpy.context.scene.refine.levels = "0.2"
    bpy.ops.refine.levels()
    others = list(bpy.data.collections["room levels.001"].objects)
    assert addon.objects.splat_group.levels_of(few) == [few, *others]
