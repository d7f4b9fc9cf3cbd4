"""The plain points of splat meshes, hidden while the splats are drawn.

Blender draws a mesh without faces as points, and has no switch for that. What it draws is an
evaluated copy of the object, which no file, undo step or script ever gets to see: on that copy the
object is shown as its bounding box. The object itself is not touched.
"""

from __future__ import annotations

from collections.abc import Container, Iterator

import bpy

from ..mesh.layout import looks_like_splats
from . import placing


def hide(depsgraph: bpy.types.Depsgraph, refused: Container[int] = ()) -> None:
    """Show the splat objects of a view layer as their bounding boxes, but for refused meshes."""
    for obj, evaluated in _copies(depsgraph):
        drawn = not is_edited(obj) and obj.data.session_uid not in refused
        wanted = "BOUNDS" if drawn else obj.display_type
        if evaluated.display_type != wanted:
            evaluated.display_type = wanted


def show() -> None:
    """Show the points again, in all windows."""
    for depsgraph in graphs():
        for obj, evaluated in _copies(depsgraph):
            if evaluated.display_type != obj.display_type:
                evaluated.display_type = obj.display_type


def is_edited(obj: bpy.types.Object) -> bool:
    """Tell whether splats are in edit mode, of this object or of another that shares them."""
    return obj.mode == "EDIT" or getattr(obj.data, "is_editmode", False)


def graphs() -> Iterator[bpy.types.Depsgraph]:
    """Give what is evaluated for each window."""
    for window in bpy.context.window_manager.windows:
        yield window.view_layer.depsgraph


def _copies(
    depsgraph: bpy.types.Depsgraph | None,
) -> Iterator[tuple[bpy.types.Object, bpy.types.Object]]:
    if depsgraph is None or depsgraph.mode != "VIEWPORT":
        return
    objects = [obj.original for obj in depsgraph.scene.objects]
    for original in {*objects, *placing.instanced(objects)}:
        if looks_like_splats(original):
            evaluated = original.evaluated_get(depsgraph)
            if evaluated.is_evaluated:
                yield original, evaluated
