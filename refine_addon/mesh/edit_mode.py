"""Splats of a mesh in edit mode, where Blender lets nobody read attributes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import bpy

from .layout import SplatObject, check


@contextmanager
def readable(obj: bpy.types.Object) -> Iterator[SplatObject]:
    """The object, or in edit mode a copy of its present state, in no scene, untransformed."""
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
