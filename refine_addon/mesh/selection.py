"""Selected and hidden splats, stored where Blender stores them, so that undo and files keep them.
Meshes: ``.select_vert`` and ``.hide_vert``, in edit mode the flags of its vertices. Point clouds:
``.selection``, and ``.hide_vert``, which Blender ignores there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from operator import attrgetter

import bmesh
import bpy
import numpy as np
from numpy.typing import NDArray

from . import attributes
from .edit import mark
from .layout import Data, SplatObject, check, splat_count

HIDDEN = ".hide_vert"


def name_of(mesh: Data) -> str:
    """Attribute that holds the selection."""
    return ".selection" if hasattr(mesh, "points") else ".select_vert"


def selected(obj: bpy.types.Object) -> NDArray[np.bool_]:
    """Selected splats of an object, (N,) bool."""
    name = name_of(obj.data)
    if obj.type != "MESH" and obj.mode == "EDIT" and name not in obj.data.attributes:
        return np.ones(splat_count(obj.data), np.bool_)  # without it Blender selects all
    return _flags(obj, name, "select")


def hidden(obj: bpy.types.Object) -> NDArray[np.bool_]:
    """Hidden splats of an object, (N,) bool."""
    return _flags(obj, HIDDEN, "hide")


def select(obj: bpy.types.Object, wanted: NDArray[np.bool_]) -> None:
    """Select exactly these splats, (N,) bool, except hidden ones."""
    wanted = wanted & ~hidden(obj)
    if not _in_edit_mode(obj):
        mark(obj, name_of(obj.data), wanted)
        return
    vertices = bmesh.from_edit_mesh(obj.data).verts
    vertices.ensure_lookup_table()
    for row in np.flatnonzero(selected(obj) != wanted).tolist():
        vertices[row].select = bool(wanted[row])
    bmesh.update_edit_mesh(obj.data, loop_triangles=False, destructive=False)


def hide(obj: bpy.types.Object, wanted: NDArray[np.bool_]) -> None:
    """Hide exactly these splats, (N,) bool, and deselect them; in object mode."""
    mark(obj, HIDDEN, wanted)
    select(obj, selected(obj))


def count(obj: bpy.types.Object) -> int:
    """Number of selected splats; cheap enough to draw."""
    if _in_edit_mode(obj):
        return int(obj.data.total_vert_sel)
    return int(np.count_nonzero(selected(obj)))


@contextmanager
def readable(obj: bpy.types.Object) -> Iterator[SplatObject]:
    """The object; in edit mode a copy of its present state, without transform and in no scene."""
    if obj.mode != "EDIT" or obj.type != "MESH":
        yield check(obj)
        return
    obj.update_from_editmode()
    mesh = obj.data.copy()
    copy = bpy.data.objects.new(obj.name, mesh)
    try:
        yield check(copy)
    finally:
        bpy.data.objects.remove(copy)
        bpy.data.meshes.remove(mesh)


def _in_edit_mode(obj: bpy.types.Object) -> bool:
    return obj.type == "MESH" and obj.mode == "EDIT"


def _flags(obj: bpy.types.Object, name: str, flag: str) -> NDArray[np.bool_]:
    """An attribute above 0, (N,); in edit mode a flag of the vertices."""
    if _in_edit_mode(obj):
        vertices = bmesh.from_edit_mesh(obj.data).verts
        return np.fromiter(map(attrgetter(flag), vertices), np.bool_, len(vertices))
    values = attributes.attribute_if_any(obj.data, name, "BOOLEAN", "FLOAT")
    count = splat_count(obj.data)
    return np.zeros(count, np.bool_) if values is None or len(values) != count else values > 0
