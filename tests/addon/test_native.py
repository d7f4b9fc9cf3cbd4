"""Blender's own splats: point clouds with activated values, as Blender 5.3 imports 3DGS files."""

from __future__ import annotations

from pathlib import Path

import bpy
import mathutils
import numpy as np
import pytest

from tests.strategies import ply_of

ROOM = Path(__file__).parents[1] / "data" / "room_small"
TYPES = bpy.types.Attribute.bl_rna.properties["data_type"].enum_items.keys()
FOUR = "FLOAT4" if "FLOAT4" in TYPES else "FLOAT_COLOR"


def point_cloud(count, name="cloud"):
    """Return a new object of `count` points, made by geometry nodes without the add-on."""
    obj = bpy.data.objects.new(name, bpy.data.pointclouds.new(name))
    bpy.context.scene.collection.objects.link(obj)
    tree = bpy.data.node_groups.new("points", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    points = tree.nodes.new("GeometryNodePoints")
    points.inputs["Count"].default_value = count
    tree.links.new(points.outputs[0], tree.nodes.new("NodeGroupOutput").inputs[0])
    obj.modifiers.new("points", "NODES").node_group = tree
    with bpy.context.temp_override(object=obj, active_object=obj):
        bpy.ops.object.modifier_apply(modifier="points")
    bpy.data.node_groups.remove(tree)
    obj.data.attributes.remove(obj.data.attributes["radius"])
    bpy.context.view_layer.objects.active = obj
    obj.select_set(True)
    return obj


def store(obj, name, kind, values):
    """Set a point attribute, made where it is not there."""
    attribute = obj.data.attributes.get(name) or obj.data.attributes.new(name, kind, "POINT")
    field = {"FLOAT_COLOR": "color", "FLOAT_VECTOR": "vector", "FLOAT4": "vector"}.get(
        kind, "value"
    )
    attribute.data.foreach_set(field, np.ascontiguousarray(values).ravel())


def as_blender_imports(rows, name="cloud"):
    """Return what Blender 5.3 makes of the rows of a file: its formulas, in float32.

    See docs/conventions.md for where they stand in its sources.
    """
    obj = point_cloud(len(rows), name)
    get = {field: rows[field].astype(np.float32) for field in rows.dtype.names}
    one = np.float32(1)
    with np.errstate(over="ignore", under="ignore"):
        opaque = one / (one + np.exp(-get["opacity"]))
        scale = np.exp(np.stack([get[f"scale_{i}"] for i in range(3)], 1))
    turn = np.stack([get[f"rot_{i}"] for i in range(4)], 1)
    turn /= np.sqrt((turn * turn).sum(axis=1, keepdims=True))
    store(obj, "position", "FLOAT_VECTOR", np.stack([get[axis] for axis in "xyz"], 1))
    base = np.stack([*(get[f"f_dc_{i}"] for i in range(3)), opaque], 1)
    store(obj, "radiance:base", FOUR, base)
    store(obj, "scale", "FLOAT_VECTOR", scale)
    store(obj, "rotation", "QUATERNION", turn)
    count = sum(name.startswith("f_rest_") for name in get) // 3
    for k in range(count):
        colors = [get[f"f_rest_{k + channel * count}"] for channel in range(3)]
        store(obj, f"radiance:sh_{k}", "FLOAT_VECTOR", np.stack(colors, 1))
    return obj


def differences(core, got, expected):
    """Return the largest difference of each activated value, relative to its size."""
    splats = core.splats

    def unit(q):
        q = splats.unit_quaternions(q)
        return q * np.sign(q[np.arange(len(q)), np.abs(q).argmax(axis=1)])[:, None]

    def apart(a, b):
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        return np.abs(a - b).max(initial=0.0, where=b != a) if b.size else 0.0

    def relative(a, b):
        a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
        return apart(a / b, np.ones_like(b))

    return {
        "means": apart(got.means, expected.means),
        "harmonics": apart(got.sh_rest, expected.sh_rest) + apart(got.sh_dc, expected.sh_dc),
        "scales": relative(splats.scales(got.log_scales), splats.scales(expected.log_scales)),
        "opacity": relative(
            splats.opacity(got.opacity_logits), splats.opacity(expected.opacity_logits)
        ),
        "rotation": apart(unit(got.quaternions), unit(expected.quaternions)),
    }


@pytest.fixture
def file(addon):
    """Return the small trained room's file."""
    return addon.core.read_ply(ROOM / "point_cloud.ply")


@pytest.fixture
def cloud(addon, file):
    """Return the room as Blender 5.3 would have imported it."""
    return as_blender_imports(file.rows, "room")


def test_an_import_of_blenders_exports_the_splats_of_the_file(addon, core, file, cloud, tmp_path):
    """Blender's float32 formulas are off by some roundings: 1e-6 at most, and 1e-5 in exp(10)."""
    addon.splat_object.export_object(addon.mesh.layout.check(cloud), tmp_path / "out.ply")
    found = differences(core, core.read_ply(tmp_path / "out.ply").splats(), file.splats())

    assert found["means"] == found["harmonics"] == 0.0
    assert max(found["scales"], found["opacity"], found["rotation"]) < 1e-6
    size = addon.mesh.layout.export_bytes(cloud)  # what the panel says
    assert (tmp_path / "out.ply").stat().st_size == size
