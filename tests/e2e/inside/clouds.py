"""Point clouds of splats, as Blender 5.3 imports them, made without the add-on; instances."""

from __future__ import annotations

import bpy
import numpy as np

FIELDS = {"FLOAT_COLOR": "color", "FLOAT_VECTOR": "vector", "FLOAT4": "vector"}
TYPES = bpy.types.Attribute.bl_rna.properties["data_type"].enum_items.keys()
FOUR = "FLOAT4" if "FLOAT4" in TYPES else "FLOAT_COLOR"


def point_cloud(count, name="cloud"):
    """A new object of `count` points, made by geometry nodes."""
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
    attribute.data.foreach_set(FIELDS.get(kind, "value"), np.ascontiguousarray(values).ravel())


def as_blender_imports(rows, name="cloud"):
    """What Blender 5.3 makes of the rows of a file: its formulas, in float32.

    See docs/conventions.md for where they stand in its sources.
    """
    obj = point_cloud(len(rows), name)
    get = {field: rows[field].astype(np.float32) for field in rows.dtype.names}
    get.setdefault("scale_2", np.full(len(rows), -np.inf, np.float32))  # of discs
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


def as_cloud(addon, obj):
    """Put a point cloud of the same splats, attributes and properties in the place of a mesh."""
    attributes, checked = addon.mesh.attributes, addon.mesh.layout.check(obj)
    rows, name = attributes.read_for_file(checked)().rows, obj.name
    cloud = as_blender_imports(rows, "cloud")
    taken = (*"xyz", "position", "opacity", "f_", "scale_", "rot_", ".", "refine_home")
    taken += ("refine_shape",)  # a checksum of other numbers
    for attribute in obj.data.attributes:
        if attribute.domain == "POINT" and not attribute.name.startswith(taken):
            values = attributes.read_attribute(obj.data, attribute.name)
            attributes.write_attribute(cloud.data, attribute.name, attribute.data_type, values)
    for key, value in obj.data.items():
        cloud.data[key] = value
    cloud.matrix_world = obj.matrix_world
    bpy.data.objects.remove(obj)
    cloud.name = name
    bpy.context.view_layer.objects.active = cloud
    bpy.context.view_layer.update()
    return cloud


def scatter(obj, source, *, as_instance):
    """Let geometry nodes instance an object, or its geometry alone, on the points of another."""
    tree = bpy.data.node_groups.new("scatter", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Mesh", in_out=direction, socket_type="NodeSocketGeometry")
    kinds = ("GeometryNodeObjectInfo", "GeometryNodeInstanceOnPoints")
    info, on_points, start, end = map(tree.nodes.new, (*kinds, "NodeGroupInput", "NodeGroupOutput"))
    info.inputs["Object"].default_value = source
    info.inputs["As Instance"].default_value = as_instance
    tree.links.new(start.outputs[0], on_points.inputs["Points"])
    tree.links.new(info.outputs["Geometry"], on_points.inputs["Instance"])
    tree.links.new(on_points.outputs[0], end.inputs[0])
    obj.modifiers.new("scatter", "NODES").node_group = tree
