"""Places of splats in a view: objects of the view layer, and instances of collections.
Blender draws a mesh without faces as points, and has no switch for that. So its evaluated copy,
which no file, undo step or script sees, is shown as its bounding box; the object is untouched."""

from __future__ import annotations

from collections.abc import Container, Iterator
from typing import NamedTuple

import bpy
import numpy as np
from mathutils import Matrix
from numpy.typing import NDArray

from ..mesh.layout import looks_like_splats, splat_count

_DEEPEST = 8  # Deepest nesting of instances; Blender draws no more


class Placing(NamedTuple):
    """An object with splats and its (4, 4) matrix to the world.
    `key`: identity of the object and its instancers in one number, and of the mesh."""

    key: tuple[int, int]
    obj: bpy.types.Object
    matrix: NDArray[np.float64]


def placings(objects: list[bpy.types.Object]) -> Iterator[Placing]:
    """Splats among some objects of a scene, and among their instances."""
    for obj in objects:
        yield from _placed(obj, obj.matrix_world, 0, 0)


def instanced(objects: list[bpy.types.Object]) -> set[bpy.types.Object]:
    """Splat objects that some objects instance."""
    return {place.obj for place in placings(objects)} - set(objects)


def every() -> set[tuple[int, int]]:
    """Keys of all splats of the file."""
    return {placing.key for placing in placings(list(bpy.data.objects))}


def _placed(obj: bpy.types.Object, matrix: Matrix, chain: int, depth: int) -> Iterator[Placing]:
    """An object's own splats, or those of its instances, given its matrix to the world."""
    chain = (chain << 32) + obj.session_uid
    if looks_like_splats(obj):
        if splat_count(obj.data):
            yield Placing((chain, obj.data.session_uid), obj, np.array(matrix, np.float64))
        return
    collection = obj.instance_collection if obj.instance_type == "COLLECTION" else None
    if collection is None or depth == _DEEPEST:
        return
    base = matrix @ Matrix.Translation(-collection.instance_offset)
    for member in collection.all_objects:
        if not member.hide_viewport:
            yield from _placed(member, base @ member.matrix_world, chain, depth + 1)


def hide_points(depsgraph: bpy.types.Depsgraph, refused: Container[int] | None) -> None:
    """Show a view layer's splats as bounding boxes, but for refused meshes; None: as points."""
    for obj, evaluated in _copies(depsgraph):
        hidden = refused is not None and obj.data.session_uid not in refused
        wanted = "BOUNDS" if hidden and not is_edited(obj) else obj.display_type
        if evaluated.display_type != wanted:
            evaluated.display_type = wanted


def is_edited(obj: bpy.types.Object) -> bool:
    """Whether splats are in edit mode, in this object or another with the same data."""
    return obj.mode == "EDIT" or getattr(obj.data, "is_editmode", False)


def graphs() -> Iterator[bpy.types.Depsgraph]:
    """Dependency graphs of all windows."""
    for window in bpy.context.window_manager.windows:
        yield window.view_layer.depsgraph


def _copies(
    depsgraph: bpy.types.Depsgraph | None,
) -> Iterator[tuple[bpy.types.Object, bpy.types.Object]]:
    if depsgraph is None or depsgraph.mode != "VIEWPORT":
        return
    objects = [obj.original for obj in depsgraph.scene.objects]
    for original in {*objects, *instanced(objects)}:
        if looks_like_splats(original):
            evaluated = original.evaluated_get(depsgraph)
            if evaluated.is_evaluated:
                yield original, evaluated
