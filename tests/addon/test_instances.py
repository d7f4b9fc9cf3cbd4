"""Splats that stand in the scene as instances of collections; windows test how they look."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Matrix


@pytest.fixture
def instance(room, empty_scene):
    """Give an empty that instances a collection with the room, which is in no scene itself."""
    collection = bpy.data.collections.new("set")
    collection.objects.link(room)
    collection.instance_offset = (1.0, 0.0, 0.0)
    empty_scene.collection.objects.unlink(room)
    room.matrix_world = Matrix.Translation((0.0, 0.0, 5.0))
    empty = bpy.data.objects.new("instance", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", collection
    empty_scene.collection.objects.link(empty)
    empty.scale = (2.0, 2.0, 2.0)
    bpy.context.view_layer.objects.active = empty
    bpy.context.view_layer.update()
    return empty


def test_an_instance_stands_where_its_empty_puts_it(addon, room, instance):
    """Twice as large: the room's origin, at z = 5 less the offset of x = 1, is at (-2, 0, 10)."""
    (place,) = addon.viewport.content.placings([instance])

    assert place.obj == room
    np.testing.assert_allclose(place.matrix[:3, 3], [-2.0, 0.0, 10.0])
    np.testing.assert_allclose(place.matrix[:3, :3], 2.0 * np.eye(3))
    assert addon.viewport.content.instanced([instance]) == {room}


def test_instances_within_instances_and_beside_each_other_have_keys_of_their_own(
    addon, room, instance, empty_scene
):
    """Two empties of the collection, in one that a third and a fourth instance: four places."""
    both = bpy.data.collections.new("both")
    copies = [instance.copy(), instance.copy()]
    for copy in copies:
        both.objects.link(copy)
    outer = []
    for name in ("third", "fourth"):
        empty = bpy.data.objects.new(name, None)
        empty.instance_type, empty.instance_collection = "COLLECTION", both
        empty_scene.collection.objects.link(empty)
        outer.append(empty)
    places = list(addon.viewport.content.placings(outer))

    assert len({place.key for place in places}) == 4
    assert {place.key[1] for place in places} == {room.data.session_uid}


def test_instances_are_followed_as_deep_as_blender_draws_them(addon, instance):
    """Eight in each other; the ninth, with one more around it, is not looked at."""
    empties = [instance]
    for _ in range(8):
        collection = bpy.data.collections.new("around")
        collection.objects.link(empties[-1])
        empty = bpy.data.objects.new("instance", None)
        empty.instance_type, empty.instance_collection = "COLLECTION", collection
        empties.append(empty)

    found = [len(list(addon.viewport.content.placings([empty]))) for empty in empties]
    assert found == [1] * 8 + [0]


@pytest.mark.usefixtures("room_cameras")
def test_an_instance_is_made_real_and_scored(addon, room, instance):
    """A copy with data of its own stands where the instance stood, which is shown no more."""
    instance.scale, instance.location = (1.0, 1.0, 1.0), (1.0, 0.0, -5.0)
    with pytest.raises(RuntimeError, match="poll"):
        bpy.ops.refine.score()
    bpy.ops.refine.make_real()
    real = bpy.context.object
    bpy.ops.refine.score()

    assert real != room
    assert real.data != room.data
    np.testing.assert_allclose(np.array(real.matrix_world), np.eye(4))
    assert "refine_score" in real.data.attributes
    assert "refine_score" not in room.data.attributes
    assert not list(addon.viewport.content.placings([instance]))
    assert not bpy.ops.refine.make_real.poll()


def test_a_linked_collection_is_made_real(room, tmp_path, empty_scene):
    """Its copy belongs to this file and can be changed."""
    collection = bpy.data.collections.new("set")
    collection.objects.link(room)
    path = str(tmp_path / "set.blend")
    bpy.data.libraries.write(path, {collection}, fake_user=True)
    bpy.data.objects.remove(room)
    with bpy.data.libraries.load(path, link=True) as (_, wanted):
        wanted.collections = ["set"]
    empty = bpy.data.objects.new("instance", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", wanted.collections[0]
    empty_scene.collection.objects.link(empty)
    bpy.context.view_layer.objects.active = empty
    bpy.ops.refine.make_real()
    bpy.ops.refine.select(action="ALL")

    assert bpy.context.object.library is None
    assert bpy.context.object.data.library is None
    assert len(bpy.context.object.data.vertices) == 39_755
