"""Where splats stand: objects, and what collections, nodes, points, faces or particles instance."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..mesh.layout import looks_like_splats, splat_count

Key = tuple[tuple[int, ...], int]
"""Numbers that identify an object or an instance, and one that identifies its mesh."""


class Placing(NamedTuple):
    """An object with splats and its (4, 4) matrix to the world; `shown_by`: the object itself or
    the one that instances it."""

    key: Key
    obj: bpy.types.Object
    matrix: NDArray[np.float64]
    shown_by: bpy.types.Object


def placings(depsgraph: bpy.types.Depsgraph) -> Iterator[Placing]:
    """Placings of the splats that a depsgraph shows. Modifiers on splats are ignored. Of geometry
    that nodes instance without its object, `obj` is a stand-in, gone with the next placing."""
    others = set()  # of which there may be 100,000 instances
    for item in depsgraph.object_instances:
        obj, data = item.object, item.object.data
        if data in others:
            continue
        if not item.is_instance or data == item.instance_object.data:
            obj = obj.original
        if not looks_like_splats(obj) or not splat_count(obj.data):
            others.add(data)
            continue
        shown_by = (item.parent or obj).original
        numbers = (obj.original.session_uid, *item.persistent_id) if item.is_instance else ()
        key = ((shown_by.session_uid, *numbers), obj.data.session_uid)
        yield Placing(key, obj, np.array(item.matrix_world, np.float64), shown_by)


def shown_by(context: bpy.types.Context) -> Iterator[Placing]:
    """Placings of the splats that the active object instances."""
    obj, places = context.object, placings(context.evaluated_depsgraph_get())
    return (place for place in places if place.shown_by == obj != place.obj)


def make_real(context: bpy.types.Context) -> None:
    """Turn the splats that the active object instances into selected objects with their own data.
    It instances no more: the modifiers from the last one to the one that does are switched off."""
    instancer, real = context.object, []
    for place in shown_by(context):
        data = place.obj.data.copy()
        copy = bpy.data.objects.new(data.name, data) if place.obj.is_evaluated else place.obj.copy()
        copy.data = data
        copy.animation_data_clear()
        copy.constraints.clear()
        copy.parent = None
        copy.hide_viewport = copy.hide_render = False
        copy.matrix_world = Matrix(place.matrix)
        real.append(copy)
    instancer.instance_type = "NONE"
    for modifier in reversed(instancer.modifiers.values()):
        if any(shown_by(context)):
            modifier.show_viewport = modifier.show_render = False
    for copy in real:
        for collection in instancer.users_collection:
            collection.objects.link(copy)
        copy.select_set(True)
    instancer.select_set(False)
    context.view_layer.objects.active = real[0]
