"""Operators that bake and mend transforms; what Blender's own tools moved, in the panel."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from operator import call
from typing import Any

import bpy
import mathutils
import numpy as np
from bpy.props import BoolProperty
from bpy.types import Context

from ..core import RefineError
from ..core.execute import Progress, run_all
from ..mesh import drift, edit
from ..mesh import layout as mesh_layout
from ..objects import splat_group, transforms
from . import plans, wrapped
from .operator_bases import Acting, Job, Work, in_object_mode
from .wrapped import counted

_SOON = 0.1  # Seconds until new splats are stamped: Blender's operator is over by then


class REFINE_OT_bake_transform(Acting, bpy.types.Operator):
    """Apply the transforms of selected objects to their splats: places, sizes, turns, colours"""

    bl_label = "Bake Transform"
    needs = (*Acting.needs, in_object_mode)

    location: BoolProperty(
        name="Location",
        description="Also apply the location: the origin moves to that of the world or the parent",
        default=True,
    )

    def act(self, context: Context) -> None:
        """Bake the transforms of the selected objects."""
        group = splat_group.members(context.object)
        self.tell(transforms.bake(group, location=self.location))
        plans.refresh(context)
        self.report({"INFO"}, f"Baked the transform of {counted(len(group), 'object')}")


class REFINE_OT_mend(Job, bpy.types.Operator):
    """Make sizes, rotations and colours follow what Blender's own tools did to the positions"""

    bl_label = "Mend Splats"
    needs = (*Job.needs, in_object_mode)
    doing = "Mending splats"

    def work(self, context: Context) -> Work:
        """Mend those of the selected objects that drifted."""
        mesh_layout.check(context.object)
        drifted = {obj.data: obj for obj in splat_group.chosen(context.object) if drift.of(obj)}
        group = [mesh_layout.check(obj) for obj in drifted.values()]
        for each in group:
            edit.check_changeable(each.obj)
        moves = [transforms.read_to_move(each, np.eye(4), mend=True)[1] for each in group]

        def moved(progress: Progress) -> list[Any]:
            return run_all(call, moves, progress=progress, threads=1)

        group, mended = yield group, moved
        transforms.write_moved([(one, new) for one, (new, _) in zip(group, mended, strict=True)])
        plans.refresh(context)
        self.report({"INFO"}, f"Mended {counted(sum(count for _, count in mended), 'splat')}")


def draw(layout: bpy.types.UILayout, objects: Sequence[bpy.types.Object]) -> None:
    """Draw the objects' drift, and the buttons that move splats."""
    drifts = list(filter(None, map(drift.of, objects)))
    for sentence in dict.fromkeys(s for found in drifts for s in found.sentences):
        wrapped.label(layout, sentence, icon="ERROR")
    if any(found.mendable for found in drifts):
        layout.operator("refine.mend", icon="MODIFIER")
    if len(objects) == 1 and objects[0].matrix_basis != mathutils.Matrix():
        layout.operator("refine.bake_transform", icon="OBJECT_ORIGIN")


def _draw_apply(menu: bpy.types.Menu, context: Context) -> None:
    if mesh_layout.looks_like_splats(context.object):
        menu.layout.separator()
        menu.layout.operator("refine.bake_transform", text="Bake Transform of Splats")


def _updated(_scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Forget the drift of changed objects; stamp new splats soon."""
    for data in mesh_layout.changed_data(depsgraph):
        drift.known.pop(data.session_uid, None)
        if _is_new(data):
            _stamp_soon()


def _changed(*_: object) -> None:
    """Forget all drift after undo, redo and loading; stamp new splats soon."""
    drift.known.clear()
    _stamp_soon()


def _is_new(data: mesh_layout.Data) -> bool:
    return mesh_layout.holds_splats(data) and not (data.library or drift.is_stamped(data))


def _stamp_soon() -> None:
    """Stamp new splats once Blender is idle: nothing may be written while it works."""
    if not bpy.app.background and not bpy.app.timers.is_registered(_stamp):
        bpy.app.timers.register(_stamp, first_interval=_SOON)


def _stamp() -> None:
    for obj in bpy.data.objects:
        if mesh_layout.looks_like_splats(obj) and _is_new(obj.data) and obj.mode != "EDIT":
            with contextlib.suppress(RefineError):  # it may only look like splats
                drift.stamp(mesh_layout.check(obj).mesh)


def unregister() -> None:
    """Stop the timer, and forget all drift."""
    if bpy.app.timers.is_registered(_stamp):
        bpy.app.timers.unregister(_stamp)
    drift.known.clear()


MENUS = {"VIEW3D_MT_object_apply": _draw_apply}
HANDLERS = {_updated: ("depsgraph_update_post",), _changed: ("undo_post", "redo_post", "load_post")}
