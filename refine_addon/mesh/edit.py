"""Changes to a splat object's data: refusals, deletion of splats, marks on splats."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core import RefineError
from ..core.formats.ply import REQUIRED
from . import attributes
from .layout import SplatObject, has, splat_count

REMOVE = "refine_remove"  # Boolean point attribute: splats that the budget removes
PROTECT = "refine_protect"  # Boolean point attribute, set by hand: splats protected above all else
MUST_GO = "refine_must_go"  # Boolean point attribute, set by hand: splats removed before all others
FORCE = "refine_force"  # Integer point attribute, for display: 1 protected, 2 removed by user
MARKING = ("BOOLEAN", "FLOAT")  # Types of point attributes that can protect splats by name
_GROUP_VALUES = "refine_group_values"


def check_writable(obj: bpy.types.Object) -> None:
    """Raise `RefineError` if the object or its data belongs to a library."""
    if obj.data.library or obj.library:
        source = (obj.data.library or obj.library).filepath
        raise RefineError(
            f"object '{obj.name}': is linked from {source}, which cannot be changed here; open "
            "that file, or make the object and its data local"
        )


def check_changeable(obj: bpy.types.Object) -> None:
    """Raise `RefineError` if the values of an object's splats cannot be changed."""
    check_writable(obj)
    label = f"object '{obj.name}'"
    if obj.mode != "OBJECT":
        raise RefineError(
            f"{label}: is in {obj.mode.replace('_', ' ').lower()} mode; go to object mode first"
        )
    if getattr(obj.data, "shape_keys", None):  # point clouds have none
        raise RefineError(
            f"{label}: has shape keys, which store every vertex again; apply or delete them first"
        )


def check_deletable(obj: bpy.types.Object) -> None:
    """Raise `RefineError` if vertices cannot be deleted from an object."""
    check_changeable(obj)
    users = obj.data.users - obj.data.use_fake_user
    if users > 1:
        raise RefineError(
            f"object '{obj.name}': shares its data '{obj.data.name}' with {users - 1} other "
            "user(s), which would lose the splats too; make it single-user first (Object > "
            "Relations)"
        )


@contextmanager
def all_or_nothing(group: Sequence[SplatObject]) -> Iterator[None]:
    """Undo a block's changes to objects' data if the block fails.
    The copies are cheap: Blender shares attributes until one changes."""
    pairs = [(checked.mesh, checked.mesh.copy()) for checked in group]
    try:
        yield
    except BaseException:
        for mesh, before in pairs:
            name, before.use_fake_user = mesh.name, mesh.use_fake_user
            mesh.user_remap(before)
            bpy.data.batch_remove([mesh])
            before.name = name
        raise
    bpy.data.batch_remove([before for _, before in pairs])


def delete_vertices(obj: bpy.types.Object, remove: NDArray[np.bool_]) -> None:
    """Delete the marked vertices, (N,) bool, where `check_deletable` allows it.
    `all_or_nothing` undoes a failure. An applied geometry-nodes modifier is the fastest way, and
    keeps attributes of every type, vertex groups, materials and custom properties."""
    attributes.remove_attribute(obj.data, REMOVE)
    if not remove.any():
        return
    expected = len(remove) - int(np.count_nonzero(remove))
    attributes.write_attribute(obj.data, REMOVE, "BOOLEAN", remove)
    tree, _ = _tree("GeometryNodeDeleteGeometry", REMOVE, "BOOLEAN", "Selection")
    modifier = obj.modifiers.new("REFINE delete", "NODES")
    name = modifier.name
    modifier.show_viewport = False  # else Blender evaluates it twice
    try:
        modifier.node_group = tree
        # First in the stack, else Blender warns of those before it.
        obj.modifiers.move(len(obj.modifiers) - 1, 0)
        with bpy.context.temp_override(object=obj, active_object=obj, selected_objects=[obj]):
            bpy.ops.object.modifier_apply(modifier=name)
    except RuntimeError as error:
        raise RefineError(
            f"object '{obj.name}': Blender could not delete the splats ({str(error).strip()})"
        ) from error
    finally:
        if name in obj.modifiers:
            obj.modifiers.remove(obj.modifiers[name])
        bpy.data.node_groups.remove(tree)
        attributes.remove_attribute(obj.data, REMOVE)
    left = splat_count(obj.data)
    if left != expected:
        raise RefineError(
            f"object '{obj.name}': {left} splats were left, expected {expected}; please report this"
        )


def mark(obj: bpy.types.Object, name: str, values: NDArray[Any]) -> None:
    """Set a point attribute to `values`, (N,) bool or int32, or remove it if all are 0.
    `REMOVE` stays: it tells that it is known what goes."""
    check_writable(obj)
    if name == REMOVE or values.any():
        kind = "BOOLEAN" if values.dtype == np.bool_ else "INT"
        attributes.write_attribute(obj.data, name, kind, values)
    elif name in obj.data.attributes:
        attributes.remove_attribute(obj.data, name)
    else:
        return
    attributes.updated(obj.data)


def _named_mask(obj: bpy.types.Object, name: str) -> NDArray[np.bool_] | None:
    # A splat's own properties protect nothing.
    if has(obj.data, name, *MARKING) and name not in REQUIRED:
        return attributes.read_attribute(obj.data, name) > 0
    return group_weights(obj, name) > 0.0 if name in obj.vertex_groups else None


def named_masks(group: Sequence[SplatObject], name: str) -> list[NDArray[np.bool_] | None]:
    """Splats of each object that an attribute or a vertex group protects, where it is above 0,
    (N,); None in objects without one, `RefineError` if all are."""
    masks = [_named_mask(checked.obj, name) for checked in group]
    if any(mask is not None for mask in masks):
        return masks
    obj = group[-1].obj
    attribute = obj.data.attributes.get(name)
    what = f" ('{name}' is {attribute.data_type} on {attribute.domain})" if attribute else ""
    no_groups = " (a point cloud has no vertex groups)" if obj.type == "POINTCLOUD" else ""
    raise RefineError(
        f"object '{obj.name}': nothing to protect is named '{name}'{what}; expected a vertex "
        f"group, or a boolean or float attribute on points{no_groups}"
    )


def group_weights(obj: bpy.types.Object, name: str) -> NDArray[np.float32]:
    """Weights of a vertex group, (N,), through geometry nodes, as Python reads one by one."""
    tree, storing = _tree("GeometryNodeStoreNamedAttribute", name, "FLOAT", "Value")
    storing.inputs["Name"].default_value = _GROUP_VALUES
    # On a second object with the same mesh, so that modifiers of the first do not take part.
    helper = bpy.data.objects.new("REFINE read", obj.data)
    try:
        bpy.context.scene.collection.objects.link(helper)
        helper.modifiers.new("REFINE read", "NODES").node_group = tree
        depsgraph = bpy.context.evaluated_depsgraph_get()
        return attributes.read_attribute(helper.evaluated_get(depsgraph).data, _GROUP_VALUES)
    finally:
        bpy.data.objects.remove(helper)
        bpy.data.node_groups.remove(tree)


def _tree(kind: str, name: str, data_type: str, target: str) -> tuple[Any, bpy.types.Node]:
    """A geometry-nodes tree of one node, whose input `target` reads attribute `name`; the node."""
    tree = bpy.data.node_groups.new("REFINE", "GeometryNodeTree")
    for direction in ("INPUT", "OUTPUT"):
        tree.interface.new_socket("Geometry", in_out=direction, socket_type="NodeSocketGeometry")
    kinds = ("NodeGroupInput", kind, "GeometryNodeInputNamedAttribute", "NodeGroupOutput")
    start, node, read, end = map(tree.nodes.new, kinds)
    node.domain, read.data_type = "POINT", data_type
    read.inputs["Name"].default_value = name
    tree.links.new(start.outputs[0], node.inputs[0])
    tree.links.new(read.outputs[0], node.inputs[target])
    tree.links.new(node.outputs[0], end.inputs[0])
    return tree, node
