"""Hears of changes to what must stay and go, and has the splats marked anew."""

from __future__ import annotations

import bpy
from bpy.app.handlers import persistent

from ..mesh import layout as mesh_layout
from ..mesh import scores as mesh_scores
from ..objects import demands
from . import plans


def mark_again(context: bpy.types.Context) -> None:
    """Mark soon which splats must stay and go: that may have changed."""
    objects = _splats(context)
    if bpy.app.background:
        plans.refresh_objects(context.scene, objects)
    elif objects:
        plans.wait(context.scene, objects, plans.REST)


def _splats(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the objects whose splats are to be marked, the one that the panel shows first.

    That is the active one, or else the first that is visible. The others are those that are
    selected, or have marks or scores.
    """
    active = getattr(context, "object", None)
    objects = [o for o in context.scene.objects if mesh_layout.looks_like_splats(o)]
    looked_at = [active] if active in objects else [o for o in objects if o.visible_get()][:1]
    others = (
        obj
        for obj in objects
        if obj.select_get() or demands.FACTS in obj.data or mesh_scores.RECORD in obj.data
    )
    return list(dict.fromkeys([*looked_at, *others]))


def mark_after_edit_mode(obj: bpy.types.Object) -> None:
    """Have all marked again when an object leaves edit mode, in which nothing can be counted."""
    _edited.add(obj.name)


_edited: set[str] = set()
"""Names of the objects of `mark_after_edit_mode`."""


@persistent
def _updated(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Hear of volumes that move, of splats that move under them, and of the end of edit mode."""
    if depsgraph is None or bpy.app.background:
        return
    objects = {bpy.data.objects.get(name) for name in _edited} - {None}
    if objects and all(obj.mode != "EDIT" for obj in objects):
        _edited.clear()
        mark_again(bpy.context)
        return
    if not scene.refine.volumes:
        return
    volumes = {item.object for item in demands.listed(scene)}
    volumes |= {obj.data for obj in volumes if obj.data is not None}
    for update in depsgraph.updates:
        original = update.id.original
        moved = update.is_updated_transform and mesh_layout.looks_like_splats(
            original if isinstance(original, bpy.types.Object) else None
        )
        if moved or original in volumes:
            mark_again(bpy.context)
            return


@persistent
def _undone(*_: object) -> None:
    """Mark anew what may be marked as before or after a step."""
    if not bpy.app.background and bpy.context.scene.refine.volumes:
        mark_again(bpy.context)


def register() -> None:
    """Hear of changes."""
    handlers = bpy.app.handlers
    handlers.depsgraph_update_post.append(_updated)
    handlers.undo_post.append(_undone)
    handlers.redo_post.append(_undone)


def unregister() -> None:
    """Hear of changes no more."""
    handlers = bpy.app.handlers
    handlers.redo_post.remove(_undone)
    handlers.undo_post.remove(_undone)
    handlers.depsgraph_update_post.remove(_updated)
    _edited.clear()
