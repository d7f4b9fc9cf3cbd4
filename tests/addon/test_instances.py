"""Splats that stand in the scene as instances of collections; windows test how they look."""

from __future__ import annotations

import bpy
import numpy as np
import pytest


def instanced(*objects):
    """Return an empty of the scene that instances a collection, which is in no scene itself."""
    empty, collection = bpy.data.objects.new("instance", None), bpy.data.collections.new("set")
    for obj in objects:
        collection.objects.link(obj)
    empty.instance_type, empty.instance_collection = "COLLECTION", collection
    bpy.context.scene.collection.objects.link(empty)
    bpy.context.view_layer.objects.active = empty
    bpy.context.view_layer.update()
    return empty


@pytest.fixture
def instance(quarter, empty_scene):
    """Give an empty that instances the room, which stands at z = 5; the collection is offset."""
    quarter.location.z = 5.0
    bpy.context.view_layer.update()
    empty_scene.collection.objects.unlink(quarter)
    empty = instanced(quarter)
    empty.instance_collection.instance_offset = (1.0, 0.0, 0.0)
    return empty


@pytest.fixture
def places(addon):
    return lambda *objects: list(addon.viewport.content.placings(objects))


def test_an_instance_stands_where_its_empty_puts_it(addon, quarter, instance, places):
    """Twice as large: the room's origin, at z = 5 less the offset of x = 1, is at (-2, 0, 10)."""
    instance.scale = (2.0, 2.0, 2.0)
    bpy.context.view_layer.update()
    (place,) = places(instance)
    assert place.obj == quarter
    np.testing.assert_allclose(
        place.matrix, [[2, 0, 0, -2], [0, 2, 0, 0], [0, 0, 2, 10], [0, 0, 0, 1]]
    )
    assert addon.viewport.content.instanced([instance]) == {quarter}


def test_instances_are_followed_as_deep_as_blender_draws_them(quarter, instance, places):
    """Eight in each other, not the ninth; two in a collection that two instance are four places."""
    outer = [instanced(instance.copy(), instance.copy()), instanced()]
    outer[1].instance_collection = outer[0].instance_collection
    four = places(*outer)
    assert len({place.key for place in four}) == 4
    assert {place.key[1] for place in four} == {quarter.data.session_uid}

    empties = [instance]
    for _ in range(8):
        empties.append(instanced(empties[-1]))
    assert [len(places(empty)) for empty in empties] == [1] * 8 + [0]


@pytest.mark.usefixtures("room_cameras")
def test_an_instance_is_made_real_and_scored(quarter, instance, places):
    """A copy with data of its own stands where the instance stood, which is shown no more."""
    instance.location = (1.0, 0.0, -5.0)
    with pytest.raises(RuntimeError, match="poll"):
        bpy.ops.refine.score()
    bpy.ops.refine.make_real()
    real = bpy.context.object
    bpy.ops.refine.score()
    assert real != quarter
    assert real.data != quarter.data
    np.testing.assert_allclose(np.array(real.matrix_world), np.eye(4))
    assert "refine_score" in real.data.attributes
    assert "refine_score" not in quarter.data.attributes
    assert places(instance) == []
    assert not bpy.ops.refine.make_real.poll()


def test_a_linked_collection_is_made_real(quarter, tmp_path):
    """Its copy belongs to this file and can be changed."""
    empty, path = instanced(quarter), str(tmp_path / "set.blend")
    bpy.data.libraries.write(path, {empty.instance_collection}, fake_user=True)
    bpy.data.objects.remove(quarter)
    bpy.data.collections.remove(empty.instance_collection)
    with bpy.data.libraries.load(path, link=True) as (_, wanted):
        wanted.collections = ["set"]
    empty.instance_collection = wanted.collections[0]
    bpy.ops.refine.make_real()
    bpy.ops.refine.select(action="ALL")
    real = bpy.context.object
    assert [real.library, real.data.library] == [None, None]
    assert len(real.data.vertices) == 9_939


def test_a_linked_empty_is_not_made_real(quarter, tmp_path):
    """Its copies would lie in no collection of this file."""
    empty, path = instanced(quarter), str(tmp_path / "set.blend")
    bpy.data.libraries.write(path, {empty}, fake_user=True)
    with bpy.data.libraries.load(path, link=True) as (_, wanted):
        wanted.objects = [empty.name]
    linked = wanted.objects[0]
    bpy.context.scene.collection.objects.link(linked)
    bpy.context.view_layer.objects.active = linked
    bpy.context.view_layer.update()
    assert not bpy.ops.refine.make_real.poll()
