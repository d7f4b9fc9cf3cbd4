"""Building geometry node groups."""

from __future__ import annotations

from typing import Any

import bpy


def new_tree(name: str) -> bpy.types.NodeTree:
    """Return a geometry node group with a geometry in and out, and nothing between."""
    tree = bpy.data.node_groups.new(name, "GeometryNodeTree")
    make_empty(tree)
    return tree


def make_empty(tree: bpy.types.NodeTree) -> None:
    """Leave of a geometry node group a geometry in and out, and nothing between."""
    tree.nodes.clear()
    tree.interface.clear()
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    tree.nodes.new("NodeGroupInput")
    tree.nodes.new("NodeGroupOutput").location.x = 600


def named_attribute(tree: bpy.types.NodeTree, name: str, data_type: str) -> bpy.types.NodeSocket:
    """Add a node that reads an attribute, and return its value."""
    node = tree.nodes.new("GeometryNodeInputNamedAttribute")
    node.data_type = data_type
    node.inputs["Name"].default_value = name
    node.location.y = -200
    return next(socket for socket in node.outputs if socket.name == "Attribute" and socket.enabled)


def chain(tree: bpy.types.NodeTree, nodes: list[bpy.types.Node]) -> None:
    """Link the geometry from the group's input through `nodes` to its output."""
    start = next(node for node in tree.nodes if node.bl_idname == "NodeGroupInput")
    end = next(node for node in tree.nodes if node.bl_idname == "NodeGroupOutput")
    socket = start.outputs[0]
    for index, node in enumerate(nodes):
        node.location.x = 200 * (index + 1)
        tree.links.new(socket, node.inputs[0])
        socket = node.outputs[0]
    tree.links.new(socket, end.inputs[0])


def add(tree: bpy.types.NodeTree, kind: str, **settings: Any) -> bpy.types.Node:
    """Add a node of a type and set its properties."""
    node = tree.nodes.new(kind)
    for name, value in settings.items():
        setattr(node, name, value)
    return node
