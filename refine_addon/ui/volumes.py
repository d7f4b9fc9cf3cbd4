"""The panel's list of volumes: objects that protect splats or remove them."""

from __future__ import annotations

import bpy
import numpy as np
from bpy.props import EnumProperty, IntProperty, PointerProperty

from ..core.errors import RefineError
from ..mesh import layout as mesh_layout
from ..objects import demands
from . import plans
from .operator_bases import Answer, AtOnce, Needing, idle, on_splats, tooltips

ROLES = (
    ("PROTECT", "Protect Inside", "Splats in it stay, whatever else is said", "LOCKED", 0),
    ("REMOVE", "Remove Inside", "Splats in it go before all others", "TRASH", 1),
    (
        "KEEP",
        "Keep Inside",
        "All splats go that are in no volume of this kind",
        "FULLSCREEN_EXIT",
        2,
    ),
)
"""Roles of volumes, by core's names, in small letters there."""

_OUTSIDE, _OUTSIDE_KEPT = 0.25, 0.02
"""Share of splats beyond each face of a new volume; the latter where it keeps what is inside."""

_LEAST_HALF = 1e-3  # Half width, world units, at least: flat splats make no flat volume

SHAPES = (
    ("BOX", "Box", "A new box around the middle of the splats"),
    ("SPHERE", "Sphere", "A new sphere around the middle of the splats"),
    (
        "SELECTED",
        "Selected Objects",
        "Closed meshes, and empties shown as cubes or spheres, that are selected too",
    ),
)


def _changed(_volume: RefineVolume, context: bpy.types.Context) -> None:
    plans.mark_again(context)


def _fits(_volume: RefineVolume, obj: bpy.types.Object) -> bool:
    return demands.can_be_volume(obj)


class RefineVolume(bpy.types.PropertyGroup):
    """A volume of the list, at ``scene.refine.volumes``."""

    object: PointerProperty(
        name="Volume",
        description="A closed mesh, or an empty that is shown as a cube or a sphere",
        type=bpy.types.Object,
        poll=_fits,
        update=_changed,
    )
    role: EnumProperty(
        name="Role", description="What becomes of the splats in it", items=ROLES, update=_changed
    )


class REFINE_OT_add_volume(AtOnce, Needing, bpy.types.Operator):
    """Add a volume to the list"""

    bl_idname = "refine.add_volume"
    bl_label = "Add Volume"
    bl_options = {"REGISTER", "UNDO"}
    needs = (idle, on_splats)

    role: EnumProperty(name="Role", description="What becomes of the splats in it", items=ROLES)
    shape: EnumProperty(name="Shape", description="What is added", items=SHAPES)
    description = tooltips("role", ROLES)

    def act(self, context: bpy.types.Context) -> Answer:
        """Add it, selected to be moved; the splats stay active."""
        checked = mesh_layout.check(context.object)
        if self.shape == "SELECTED":
            objects = _selected_volumes(context)
        else:
            objects = [_new_empty(context, checked, self.shape, self.role)]
        for obj in objects:
            item = context.scene.refine.volumes.add()
            item.role = self.role
            item.object = obj
        return {"FINISHED"}


def _selected_volumes(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Selected objects not listed yet; raises `RefineError` if none fits."""
    listed = {item.object for item in context.scene.refine.volumes}
    objects = [o for o in context.selected_objects if not mesh_layout.looks_like_splats(o)]
    objects = [obj for obj in objects if obj not in listed]
    if not objects:
        raise RefineError("no volume: select closed meshes or empties, and the splats last")
    for obj in objects:
        demands.zone("remove", obj)
    return objects


def _new_empty(
    context: bpy.types.Context, checked: mesh_layout.SplatObject, shape: str, role: str
) -> bpy.types.Object:
    """A new empty around the middle half of the splats, or nearly all if they are kept."""
    means = demands.world_means(checked)
    means = means[np.isfinite(means).all(axis=1)]
    if not len(means):
        raise RefineError(f"object '{checked.obj.name}': no splat has a finite centre")
    share = _OUTSIDE_KEPT if role == "KEEP" else _OUTSIDE
    low, high = np.quantile(means, (share, 1.0 - share), axis=0)
    half = np.maximum((high - low) / 2.0, _LEAST_HALF)
    obj = bpy.data.objects.new(f"{checked.obj.name} {role.lower()}", None)
    obj.empty_display_type = "CUBE" if shape == "BOX" else "SPHERE"
    obj.location = (low + high) / 2.0
    obj.scale = half
    if shape == "SPHERE":
        away = np.linalg.norm(means - (low + high) / 2.0, axis=1)
        obj.scale = (max(float(np.quantile(away, 1.0 - 2.0 * share)), _LEAST_HALF),) * 3
    obj.show_in_front = True
    context.collection.objects.link(obj)
    for other in context.selected_objects:
        other.select_set(False)
    obj.select_set(True)
    context.view_layer.update()
    return obj


class REFINE_OT_drop_volume(Needing, bpy.types.Operator):
    """Take the volume off the list; the object stays"""

    bl_idname = "refine.drop_volume"
    bl_label = "Remove from List"
    bl_options = {"REGISTER", "UNDO"}

    index: IntProperty(name="Index", description="Place in the list", min=0)

    def execute(self, context: bpy.types.Context) -> Answer:
        """Take it off."""
        context.scene.refine.volumes.remove(self.index)
        plans.mark_again(context)
        return {"FINISHED"}


CLASSES = (RefineVolume, REFINE_OT_add_volume, REFINE_OT_drop_volume)
