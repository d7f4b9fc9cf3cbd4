"""Splats that stand in the scene as instances; windows test how they look."""

import bpy
import numpy as np
import pytest

from tests.e2e.inside.clouds import scatter

from .conftest import linked


def instanced(*objects):
    """Return an empty of the scene that instances a collection, which is in no scene itself."""
    empty, collection = linked("instance"), bpy.data.collections.new("set")
    for obj in objects:
        collection.objects.link(obj)
    empty.instance_type, empty.instance_collection = "COLLECTION", collection
    bpy.context.view_layer.objects.active = empty
    bpy.context.view_layer.update()
    return empty


@pytest.fixture
def places(addon):
    """Give a function that lists the placings that an object shows."""

    found, graph = addon.objects.instances.placings, bpy.context.evaluated_depsgraph_get
    return lambda obj: [place for place in found(graph()) if place.shown_by == obj]


def test_an_instance_stands_where_its_empty_puts_it(quarter, empty_scene, places):
    """Twice as large: the room's origin, at z = 5 less the offset of x = 1, is at (-2, 0, 10).
    An empty that instances it twice has two placings of the same data."""
    quarter.location.z = 5.0
    empty_scene.collection.objects.unlink(quarter)
    instance = instanced(quarter)
    instance.instance_collection.instance_offset, instance.scale = (1.0, 0.0, 0.0), (2.0, 2.0, 2.0)
    outer = instanced(instance.copy(), instance.copy())
    ((_, obj, matrix, _),) = places(instance)
    assert obj == quarter
    expected = [[2, 0, 0, -2], [0, 2, 0, 0], [0, 0, 2, 10], [0, 0, 0, 1]]
    np.testing.assert_allclose(matrix, expected)
    keys = {place.key for place in places(outer)}
    assert [mesh for _, mesh in keys] == [quarter.data.session_uid] * 2


@pytest.mark.usefixtures("room_cameras")
@pytest.mark.parametrize("kind", ["OBJECT", "GEOMETRY", "VERTS", "FACES"])
def test_splats_on_points_and_faces_are_made_real_and_scored(quarter, places, kind):
    """A triangle of three points, 3 m along x, has three instances, or one on its face.
    They become objects where they stood, also of a hidden one, and are instanced no more."""
    corners = [(3.0, 0.0, 0.0), (6.0, 0.0, 0.0), (6.0, 3.0, 0.0)]
    ground = linked("ground", bpy.data.meshes.new("triangle"))
    ground.data.from_pydata(corners, [], [(0, 1, 2)])
    bpy.context.view_layer.objects.active = ground
    quarter.select_set(False)
    if kind in {"VERTS", "FACES"}:
        quarter.parent, ground.instance_type = ground, kind
    else:
        scatter(ground, quarter, as_instance=kind == "OBJECT")
        quarter.hide_viewport = quarter.hide_render = True
    bpy.ops.refine.make_real()
    real = bpy.context.selected_objects
    bpy.ops.refine.score()
    where = sorted(tuple(obj.matrix_world.translation) for obj in real)
    np.testing.assert_allclose(where, [(5.0, 1.0, 0.0)] if kind == "FACES" else corners)
    assert all("refine_score" in obj.data.attributes for obj in real)
    assert "refine_score" not in quarter.data.attributes
    assert places(ground) == []


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
    bpy.context.scene.collection.objects.link(wanted.objects[0])
    bpy.context.view_layer.objects.active = wanted.objects[0]
    bpy.context.view_layer.update()
    assert not bpy.ops.refine.make_real.poll()
