"""From a splat mesh to a point cloud of Blender's own splats, and back; nothing is lost.

A Blender object keeps its type for life, so that another object takes the place of the first:
with its name, transform, parent, collections and custom properties, and for all that refers to it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import RefineError
from ..core.formats.ply_columns import Columns
from . import attributes as mesh_attributes
from . import drift, native
from .edit import check_changeable, group_weights
from .layout import KINDS, PLACES, STORAGE, Column, SplatObject, check, rest_count
from .native import Place
from .node_trees import add, chain, new_tree

_TRANSFORM = (
    *("rotation_mode", "location", "rotation_euler", "rotation_quaternion", "rotation_axis_angle"),
    *("scale", "delta_location", "delta_rotation_euler", "delta_rotation_quaternion"),
    *("delta_scale", "parent", "parent_type", "parent_bone", "parent_vertices"),
    "matrix_parent_inverse",
)
_LOOKS = ("hide_viewport", "hide_render", "hide_select", "pass_index", "color", "show_in_front")


Attributes = list[tuple[str, str, "NDArray[Any]"]]
"""Names, types and values of attributes."""


def read(checked: SplatObject) -> Callable[[], Attributes]:
    """Read what makes the splats of an object; return what makes the other form's attributes of it.

    That may run on any thread, and takes most of the time.

    Raises
    ------
    RefineError
        See `converted`.
    """
    obj = checked.obj
    check_changeable(obj)
    if obj.type == "POINTCLOUD" and not checked.layout.native:
        raise RefineError(
            f"object '{obj.name}': is a point cloud without {native.NAMES}: nothing to convert"
        )
    columns = _moved(checked)
    names = [column.name for column in columns]
    if checked.layout.native:
        places = {c.name: PLACES.get(c.name) or Place(c.name, 0, (_kind(c),)) for c in columns}
    else:
        made = PLACES | native.places(rest_count(checked.mesh) // 3)
        places = {name: made[name] for name in names}
    held = mesh_attributes.held_columns(checked, names)
    return partial(_attributes, held, places, len(checked))


def _kind(column: Column) -> str:
    """Return the type of the attribute that a mesh holds a property in."""
    return STORAGE[column.dtype[1:]]


def _attributes(held: Columns, places: dict[str, Place], count: int) -> Attributes:
    """Return the attributes of the other form."""
    kinds = {place.attribute: place.kinds[0] for place in places.values()}

    def nothing(name: str) -> NDArray[np.float32]:  # of discs, whose third scale is none
        return np.zeros((count, KINDS[kinds[name]].width), np.float32)

    attributes = mesh_attributes.coded(held, places, kinds, nothing)
    with np.errstate(over="ignore"):  # a double may be too large for a float
        return [(n, k, np.ascontiguousarray(v, KINDS[k].dtype)) for n, k, v in attributes]


def converted(
    checked: SplatObject, attributes: Attributes | None = None
) -> tuple[bpy.types.Object, list[str]]:
    """Put an object of the other form in the place of one: a point cloud for a mesh, or a mesh.

    Point attributes, scores, materials and custom properties come along. Vertex groups become float
    attributes with their weights. A mesh gets Blender's own splats, activated in single precision,
    with quaternions of length 1; from these, logits and logarithms are taken as docs/conventions.md
    says.

    Parameters
    ----------
    checked : SplatObject
        It is gone afterwards.
    attributes : list of (str, str, ndarray), optional
        What the callable of `read` has returned; None to do that now.

    Returns
    -------
    obj : bpy.types.Object
    notes : list of str
        What did not come along, in sentences.

    Raises
    ------
    RefineError
        See `edit.check_changeable`; also if the object is a point cloud that holds the properties
        of a file under their own names, or has another attribute of a name that the new form
        needs. Nothing is changed then.
    """
    old = checked.obj
    attributes = read(checked)() if attributes is None else attributes
    check_changeable(old)
    notes = _left(old)
    data = _mesh_of(checked) if checked.layout.native else _point_cloud_of(checked)
    obj = bpy.data.objects.new(old.name, data)
    try:
        _fill(checked, obj, attributes)
    except BaseException:
        bpy.data.objects.remove(obj)
        bpy.data.batch_remove([data])
        raise
    _take_place(old, obj)
    return obj, notes


def _left(old: bpy.types.Object) -> list[str]:
    """Return what of an object cannot come along, in sentences."""
    notes, data = [], old.data
    modifiers = [modifier.name for modifier in old.modifiers if "REFINE" not in modifier.name]
    if modifiers:
        notes.append(f"its modifiers ({', '.join(modifiers)}) were left behind")
    if getattr(data, "edges", ()):
        notes.append(f"its {len(data.edges)} edges and {len(data.polygons)} faces were left behind")
    uncopied = [a.name for a in data.attributes if a.domain == "POINT" and not _copied(a)]
    uncopied = [name for name in uncopied if name[0] != "."]
    if uncopied:
        notes.append(f"its attributes {', '.join(uncopied)} were left behind")
    return [f"object '{old.name}': {note}" for note in notes]


def _copied(attribute: bpy.types.Attribute) -> bool:
    return attribute.domain == "POINT" and attribute.data_type in KINDS


def _point_cloud_of(checked: SplatObject) -> bpy.types.PointCloud:
    """Return a new point cloud with the attributes of Blender's own splats, to be filled."""
    cloud = _new_point_cloud(checked.mesh.name, len(checked))
    # Before Blender 5.3 there is but one type of point clouds.
    kinds = cloud.bl_rna.properties.get("type")
    if kinds and native.TYPE in kinds.enum_items:
        cloud.type = native.TYPE
    types = bpy.types.Attribute.bl_rna.properties["data_type"].enum_items.keys()
    for place in native.places(rest_count(checked.mesh) // 3).values():
        if place.attribute not in cloud.attributes:
            kind = next(kind for kind in place.kinds if kind in types)
            cloud.attributes.new(place.attribute, kind, "POINT")
    return cloud


def _new_point_cloud(name: str, count: int) -> bpy.types.PointCloud:
    """Return a point cloud of so many points; in 5.0 and older only nodes can make them."""
    cloud = bpy.data.pointclouds.new(name)
    if hasattr(cloud, "resize"):
        cloud.resize(count)
        return cloud
    helper, tree = bpy.data.objects.new("REFINE points", cloud), new_tree("REFINE points")
    try:
        points = add(tree, "GeometryNodePoints")
        chain(tree, [])
        end = next(node for node in tree.nodes if node.bl_idname == "NodeGroupOutput")
        points.inputs["Count"].default_value = count
        tree.links.new(points.outputs[0], end.inputs[0])
        helper.modifiers.new("REFINE points", "NODES").node_group = tree
        with bpy.context.temp_override(object=helper, active_object=helper):
            bpy.ops.object.modifier_apply(modifier="REFINE points")
        mesh_attributes.remove_attribute(cloud, "radius")
    finally:
        bpy.data.objects.remove(helper)
        bpy.data.node_groups.remove(tree)
    return cloud


def _mesh_of(checked: SplatObject) -> bpy.types.Mesh:
    """Return a new mesh with the attributes of a file of splats, to be filled."""
    mesh = bpy.data.meshes.new(checked.mesh.name)
    mesh_attributes.add_vertices(mesh, len(checked))
    for column in _moved(checked):
        if column.name not in ("x", "y", "z"):
            mesh.attributes.new(column.name, STORAGE[column.dtype[1:]], "POINT")
    return mesh


def _moved(checked: SplatObject) -> list[Column]:
    """Return the columns that lie elsewhere in the other form: those that make a splat."""
    places = native.places(rest_count(checked.mesh) // 3)
    return [column for column in checked.layout.columns if column.name in {*"xyz", *places}]


def _fill(checked: SplatObject, obj: bpy.types.Object, attributes: Attributes) -> None:
    """Give a new object what the old one holds."""
    _copy_attributes(checked, obj.data)
    for group in checked.obj.vertex_groups:
        if group.name not in obj.data.attributes:
            weights = group_weights(checked.obj, group.name)
            mesh_attributes.write_attribute(obj.data, group.name, "FLOAT", weights)
    for source, target in ((checked.mesh, obj.data), (checked.obj, obj)):
        for key, value in source.items():
            target[key] = value.to_dict() if hasattr(value, "to_dict") else value
    for material in checked.mesh.materials:
        obj.data.materials.append(material)
    check(obj)
    while attributes:  # each is forgotten when it is written
        name, _, values = attributes.pop()
        mesh_attributes.write_attribute(obj.data, name, obj.data.attributes[name].data_type, values)
    mesh_attributes.updated(obj.data)
    drift.carry(checked.mesh, obj.data)


def _copy_attributes(checked: SplatObject, data: bpy.types.ID) -> None:
    """Copy the point attributes that both forms hold alike.

    Raise `RefineError` if one has a name that the new form needs for another.
    """
    moved = {column.attribute for column in _moved(checked)}
    needed = set(data.attributes.keys())
    for attribute in list(checked.mesh.attributes):
        name = attribute.name
        if not _copied(attribute) or name in moved or name[0] == ".":
            continue
        if name in needed:
            raise RefineError(
                f"object '{checked.obj.name}': has an attribute '{name}', a name that the splats "
                f"of a {other_form(checked.mesh).lower()} need; rename it first"
            )
        values = mesh_attributes.read_attribute(checked.mesh, name)
        mesh_attributes.write_attribute(data, name, attribute.data_type, values)


def _take_place(old: bpy.types.Object, new: bpy.types.Object) -> None:
    """Put a new object where an old one is, for the scene and all that refers to it."""
    for name in (*_TRANSFORM, *_LOOKS):
        setattr(new, name, getattr(old, name))
    for constraint in old.constraints:
        new.constraints.copy(constraint)
    if old.animation_data:
        _animate(old.animation_data, new.animation_data_create())
    name, data = old.name, old.data
    layer = bpy.context.view_layer
    in_layer = old.name in layer.objects
    active, selected = layer.objects.active == old, in_layer and old.select_get()
    hidden = in_layer and old.hide_get()
    old.user_remap(new)
    bpy.data.objects.remove(old)
    if not data.users:
        name_of_data = data.name
        bpy.data.batch_remove([data])
        new.data.name = name_of_data
    new.name = name
    layer.update()
    if in_layer:
        new.select_set(selected)
        new.hide_set(hidden)
        if active:
            layer.objects.active = new


def _animate(old: bpy.types.AnimData, new: bpy.types.AnimData) -> None:
    """Give an object the action and the drivers of another."""
    new.action = old.action
    if getattr(old, "action_slot", None):  # since Blender 4.4
        new.action_slot = old.action_slot
    for driver in old.drivers:
        new.drivers.from_existing(src_driver=driver)


def other_form(data: Any) -> str:
    """Return what `converted` makes of an object's data, in words."""
    return "Mesh" if native.is_native(data) else "Point Cloud"
