"""Which objects let light through, and so stand before splats and behind others in one pixel."""

from __future__ import annotations

from collections.abc import Iterator

import bpy


def lets_through(obj: bpy.types.Object, *, glass: bool) -> bool:
    """Tell whether a material of an object may let light through.

    Parameters
    ----------
    obj : bpy.types.Object
    glass : bool
        Whether film is transparent behind glass (Cycles).
    """
    trees = {slot.material.node_tree for slot in obj.material_slots if slot.material} - {None}
    visited: set[bpy.types.NodeTree] = set()
    return any(_is_clear(node, glass) for tree in trees for node in _nodes(tree, visited))


def _nodes(tree: bpy.types.NodeTree, visited: set[bpy.types.NodeTree]) -> Iterator[bpy.types.Node]:
    """Nodes of a tree and of the groups in it."""
    visited.add(tree)
    for node in tree.nodes:
        yield node
        group = getattr(node, "node_tree", None)
        if group is not None and group not in visited:
            yield from _nodes(group, visited)


def _is_clear(node: bpy.types.Node, glass: bool) -> bool:
    def between(name: str, opaque: float) -> bool:
        socket = node.inputs.get(name)
        return socket is not None and (socket.is_linked or socket.default_value != opaque)

    if node.type in {"BSDF_TRANSPARENT", "HOLDOUT"}:
        return True
    if node.type == "BSDF_PRINCIPLED":
        return between("Alpha", 1.0) or (glass and between("Transmission Weight", 0.0))
    if node.type == "EEVEE_SPECULAR":
        return between("Transparency", 0.0)
    return glass and node.type in {"BSDF_GLASS", "BSDF_REFRACTION"}
