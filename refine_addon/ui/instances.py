"""Splats that stand in the scene as instances of a collection, perhaps a linked one."""

from __future__ import annotations

import bpy
from mathutils import Matrix

from ..mesh.layout import looks_like_splats, splat_count
from ..viewport.placing import placings
from . import wrapped
from .operator_bases import Answer, AtOnce, Needing, idle, in_object_mode


def _instances(context: bpy.types.Context) -> str:
    obj = context.object
    if obj is not None and not looks_like_splats(obj) and any(placings([obj])):
        return ""
    return "Select an empty that instances a collection with splats"


class REFINE_OT_make_real(AtOnce, Needing, bpy.types.Operator):
    """Make objects of the scene of the splats that the active object instances, to be scored"""

    bl_idname = "refine.make_real"
    bl_label = "Make Splats Real"
    bl_options = {"REGISTER", "UNDO"}
    needs = (idle, in_object_mode, _instances)

    def act(self, context: bpy.types.Context) -> Answer:
        """Copy them with their data to where they are seen, and hide the instance."""
        empty, real = context.object, []
        for place in list(placings([empty])):
            copy = place.obj.copy()
            copy.data = place.obj.data.copy()
            copy.animation_data_clear()
            copy.constraints.clear()
            copy.parent = None
            copy.matrix_world = Matrix(place.matrix)
            for collection in empty.users_collection:
                collection.objects.link(copy)
            real.append(copy)
        empty.instance_type = "NONE"
        empty.select_set(False)
        for copy in real:
            copy.select_set(True)
        context.view_layer.objects.active = real[0]
        return {"FINISHED"}


def draw(layout: bpy.types.UILayout, context: bpy.types.Context) -> bool:
    """Draw the active object's instances and the button; whether it instances splats."""
    if _instances(context):
        return False
    count = sum(splat_count(place.obj.data) for place in placings([context.object]))
    text = f"{count:,} splats of collection '{context.object.instance_collection.name}'"
    wrapped.label(layout, context, text, icon="OUTLINER_OB_GROUP_INSTANCE")
    layout.operator("refine.make_real")
    return True


CLASSES = (REFINE_OT_make_real,)
