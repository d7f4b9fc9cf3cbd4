"""Which objects let light through, and so stand before splats and behind others in one pixel."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import bpy

LAYERS = 4
"""Groups of objects that are rendered apart, at most: each costs a render."""


def groups(
    objects: Sequence[bpy.types.Object], *, glass: bool
) -> tuple[list[bpy.types.Object], list[list[bpy.types.Object]]]:
    """Return the objects that hide what is behind them, and the others, each in a group.

    Parameters
    ----------
    objects : sequence of bpy.types.Object
    glass : bool
        Whether film is transparent behind glass (Cycles).

    Returns
    -------
    opaque : list of bpy.types.Object
    apart : list of list of bpy.types.Object
        At most `LAYERS`; the last holds all that is left.
    """
    known: dict[str, bool] = {}
    seen_through = [
        obj
        for obj in objects
        if any(_lets_through(slot.material, known, glass=glass) for slot in obj.material_slots)
    ]
    opaque = [obj for obj in objects if obj not in seen_through]
    apart = [[obj] for obj in seen_through[: LAYERS - 1]]
    if rest := seen_through[LAYERS - 1 :]:
        apart.append(rest)
    return opaque, apart


def _lets_through(
    material: bpy.types.Material | None, known: dict[str, bool], *, glass: bool
) -> bool:
    """Tell whether a material may let light through; `known` are answers by names."""
    if material is None or material.node_tree is None:
        return False
    if material.name_full not in known:
        nodes = _nodes(material.node_tree, set())
        known[material.name_full] = any(_is_clear(node, glass=glass) for node in nodes)
    return known[material.name_full]


def _nodes(tree: bpy.types.NodeTree, visited: set[str]) -> Iterator[bpy.types.Node]:
    """Yield the nodes of a tree and of the groups in it."""
    for node in tree.nodes:
        yield node
        group = getattr(node, "node_tree", None)
        if group is not None and group.name_full not in visited:
            visited.add(group.name_full)
            yield from _nodes(group, visited)


def _is_clear(node: bpy.types.Node, *, glass: bool) -> bool:
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
