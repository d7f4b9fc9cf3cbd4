"""Operators beside the warnings at Apply: each mends in one click what its warning tells."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import bpy
import mathutils
import numpy as np
from bpy.props import EnumProperty, IntProperty
from numpy.typing import NDArray

from ..cameras.objects import UPRIGHT, WEIGHT, world_matrix
from ..cameras.sets import CameraChoice, create_cameras
from ..core.errors import RefineError
from ..core.views import ViewSet, with_views_between
from ..mesh import attributes as mesh_attributes
from ..mesh import edit as mesh_edit
from ..mesh import layout as mesh_layout
from ..mesh import scores as mesh_scores
from ..objects import splat_group
from . import camera_list, plans
from .operator_bases import Answer, AtOnce, OnSplats
from .wrapped import counted

_INNER = (5.0, 95.0)
"""Percentiles of the splats' positions that a ring frames: floaters far away do not count."""

_ELEVATIONS = (15.0, 40.0)
"""Degrees above the horizon of the cameras of a ring, by turns."""

_MARGIN = 1.1
"""How many times as far away a camera stands as would just do."""


class _Bounds(NamedTuple):
    """The ball around most of the splats, world units."""

    middle: NDArray[np.float64]  # (3,)
    radius: float


class REFINE_OT_turn_cameras(AtOnce, OnSplats, bpy.types.Operator):
    """Turn the cameras that decide a quarter about the world's X axis, and drop their scores"""

    bl_idname = "refine.turn_cameras"
    bl_label = "Turn the Cameras"
    bl_options = {"REGISTER", "UNDO"}

    quarter: EnumProperty(
        name="Turn",
        description="About the world's X axis",
        items=(
            ("1", "As Upright", "From y down to z up, as Upright turns what is imported"),
            ("-1", "Back", "From z up to y down"),
        ),
    )

    def act(self, context: bpy.types.Context) -> Answer:
        """Turn them."""
        context.view_layer.update()  # or what a script just made stands at the origin
        cameras = _deciding(context)
        roots = _roots(cameras, context.object)
        turn = mathutils.Matrix(UPRIGHT.tolist())
        if self.quarter == "-1":
            turn = turn.inverted()
        moving = [root for root in roots if root.animation_data]
        for root in roots:
            if root not in moving:
                root.matrix_world = turn @ root.matrix_world
        if moving:
            _turn_animated(context, moving, turn)
        context.view_layer.update()
        for obj in splat_group.chosen(context.view_layer, context.object):
            mesh_scores.forget(mesh_layout.check(obj))  # of cameras that stood elsewhere
            plans.forget(obj.data)
        self.report({"INFO"}, f"Turned {counted(len(cameras), 'camera')}; score again")
        return {"FINISHED"}


class REFINE_OT_add_ring(AtOnce, OnSplats, bpy.types.Operator):
    """Add cameras around the splats that see all of them; they decide together with the others"""

    bl_idname = "refine.add_ring"
    bl_label = "Add a Ring of Cameras"
    bl_options = {"REGISTER", "UNDO"}

    count: IntProperty(name="Cameras", default=16, min=3, max=360)

    def act(self, context: bpy.types.Context) -> Answer:
        """Add them."""
        bounds = _bounds(context)
        collection = bpy.data.collections.new("Ring of Cameras")
        for number in range(self.count):
            collection.objects.link(_camera(context.scene, bounds, number, self.count))
        _join(context, collection)
        self.report({"INFO"}, f"Added {self.count} cameras in '{collection.name}'; score again")
        return {"FINISHED"}


class REFINE_OT_add_between(AtOnce, OnSplats, bpy.types.Operator):
    """Add cameras halfway between neighbouring ones; they decide together with the others"""

    bl_idname = "refine.add_between"
    bl_label = "Add Views Between"
    bl_options = {"REGISTER", "UNDO"}

    count: IntProperty(name="Cameras", description="At most so many", default=32, min=1, max=1000)

    def act(self, context: bpy.types.Context) -> Answer:
        """Add them."""
        choice = CameraChoice.of_scene(context.scene)
        if choice.source == "FRAMES":
            raise RefineError(
                "a shot decides: add cameras between its frames by more frames, not as objects"
            )
        views = choice.views(context)
        more = with_views_between(views, self.count).views[len(views) :]
        if not more:
            raise RefineError(
                "no two cameras that decide stand apart and look alike: nothing is between them"
            )
        collection = bpy.data.collections.new("Views Between")
        create_cameras(ViewSet(more), collection)
        _join(context, collection)
        if context.scene.refine.views:
            context.scene.refine.views += len(more)  # or they would take the place of others
        added = counted(len(more), "camera")
        self.report({"INFO"}, f"Added {added} in '{collection.name}'; score again")
        return {"FINISHED"}


class REFINE_OT_leave_out(AtOnce, OnSplats, bpy.types.Operator):
    """Give cameras that see nothing, or all from far away, the weight 0: they no longer decide"""

    bl_idname = "refine.leave_out"
    bl_label = "Leave Them Out"
    bl_options = {"REGISTER", "UNDO"}

    def act(self, context: bpy.types.Context) -> Answer:
        """Leave them out."""
        record = mesh_scores.record(context.object.data) or {}
        out = camera_list.useless(record)
        cameras = _deciding(context)
        leave = [camera for camera in cameras if camera.name in out]
        _refuse_libraries(leave)
        if not leave:
            raise RefineError("none of the cameras is known to see nothing; score first")
        if all(camera in leave or camera.get(WEIGHT, 1.0) == 0.0 for camera in cameras):
            raise RefineError("no camera would be left; add a ring of cameras")
        for camera in leave:
            camera[WEIGHT] = 0.0
        self.report({"INFO"}, f"Left out {counted(len(leave), 'camera')}; score again")
        return {"FINISHED"}


class REFINE_OT_keep_unseen(AtOnce, OnSplats, bpy.types.Operator):
    """Mark the splats that lie in no view to stay, beside those that are marked already"""

    bl_idname = "refine.keep_unseen"
    bl_label = "Keep What Is Unseen"
    bl_options = {"REGISTER", "UNDO"}

    def act(self, context: bpy.types.Context) -> Answer:
        """Mark them."""
        group = splat_group.members(context.view_layer, mesh_layout.check(context.object))
        removed = splat_group.forced(context.scene, group).removed
        unseen = mesh_scores.stored_scores(group, removed).seen == 0
        masks = splat_group.parts_of(unseen if removed is None else unseen & ~removed, group)
        for member in group:
            mesh_edit.check_writable(member.obj)
        for member, unseen in zip(group, masks, strict=True):
            marked = mesh_edit.protected_mask(member.obj, "")
            mesh_edit.mark_by_hand(member.obj, unseen if marked is None else unseen | marked)
        plans.refresh(context)
        count = sum(int(np.count_nonzero(unseen)) for unseen in masks)
        self.report({"INFO"}, f"{count:,} splats that lie in no view stay")
        return {"FINISHED"}


def _deciding(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the cameras that decide, of a shot all of it, or raise `RefineError` without one."""
    scene, choice = context.scene, CameraChoice.of_scene(context.scene)
    cameras = choice.cameras(context)
    if choice.source == "FRAMES":
        cameras = [marker.camera for marker in scene.timeline_markers] + [scene.camera]
        cameras = list(dict.fromkeys(camera for camera in cameras if camera))
    if not cameras:
        raise RefineError("no cameras: choose those that decide, or add a ring of cameras")
    return cameras


def _refuse_libraries(objects: Iterable[bpy.types.Object]) -> None:
    for obj in objects:
        if obj.library:
            raise RefineError(
                f"'{obj.name}': is linked from {obj.library.filepath}; make it local first"
            )


def _roots(cameras: Sequence[bpy.types.Object], splats: bpy.types.Object) -> list[bpy.types.Object]:
    """Return what to turn for cameras to turn without the splats, or raise `RefineError`."""
    ancestors = [splats]  # of the splats, with themselves
    while ancestors[-1].parent:
        ancestors.append(ancestors[-1].parent)
    roots = []
    for camera in cameras:
        root = camera
        while root.parent and root.parent not in ancestors:
            root = root.parent
        if root.parent:
            raise RefineError(
                f"camera '{camera.name}' turns with the splats, being parented to them or theirs"
            )
        if root.constraints:
            raise RefineError(
                f"'{root.name}': has constraints, which decide where it is; turn it by hand"
            )
        roots.append(root)
    roots = list(dict.fromkeys(roots))
    _refuse_libraries(roots)
    return roots


def _turn_animated(
    context: bpy.types.Context, roots: Sequence[bpy.types.Object], turn: mathutils.Matrix
) -> None:
    """Turn objects whose place is animated, by a parent."""
    empty = bpy.data.objects.new("Turned Cameras", None)
    context.scene.collection.objects.link(empty)
    empty.matrix_world = turn
    for root in roots:
        root.parent = empty
        root.matrix_parent_inverse.identity()


def _bounds(context: bpy.types.Context) -> _Bounds:
    """Return the ball around most of the active object's splats, or raise `RefineError`."""
    checked = mesh_layout.check(context.object)
    matrix = world_matrix(checked.obj, context.evaluated_depsgraph_get())
    means = mesh_attributes.read_attribute(checked.mesh, "position").astype(np.float64)
    means = means[np.isfinite(means).all(axis=1)]
    if not len(means):
        raise RefineError(f"object '{checked.obj.name}': has no splat at a finite place")
    means = means @ matrix[:3, :3].T + matrix[:3, 3]
    low, high = np.percentile(means, _INNER, axis=0)
    # Of one point, and of what is flat, a ball of some size.
    return _Bounds((low + high) / 2.0, float(np.linalg.norm(high - low)) / 2.0 or 1.0)


def _camera(scene: bpy.types.Scene, bounds: _Bounds, number: int, count: int) -> bpy.types.Object:
    """Make one camera of a ring; it frames the ball in renders of the scene's size."""
    data = bpy.data.cameras.new("Ring")
    render = scene.render
    width = render.resolution_x * render.pixel_aspect_x
    height = render.resolution_y * render.pixel_aspect_y
    # The sensor lies along the longer side of the picture.
    half = data.sensor_width / 2.0 / data.lens * min(width, height) / max(width, height)
    distance = _MARGIN * bounds.radius / math.sin(math.atan(half))
    data.clip_start, data.clip_end = 1e-3 * distance, 1e2 * distance
    data.display_size = 0.1 * bounds.radius
    around = 2.0 * math.pi * number / count
    up = math.radians(_ELEVATIONS[number % len(_ELEVATIONS)])
    away = mathutils.Vector(
        (math.cos(around) * math.cos(up), math.sin(around) * math.cos(up), math.sin(up))
    )
    camera = bpy.data.objects.new("Ring", data)
    camera.location = mathutils.Vector(bounds.middle) + distance * away
    camera.rotation_euler = away.to_track_quat("Z", "Y").to_euler()
    return camera


def _join(context: bpy.types.Context, ring: bpy.types.Collection) -> None:
    """Have a ring decide with the cameras that decide already."""
    scene, settings = context.scene, context.scene.refine
    parent = settings.collection if settings.source == "COLLECTION" else None
    if parent and not parent.library:
        parent.children.link(ring)
        return
    scene.collection.children.link(ring)
    if settings.source == "VISIBLE":
        return
    if parent:
        ring.children.link(parent)
    else:
        for camera in CameraChoice(settings.source).cameras(context):
            ring.objects.link(camera)
    settings.collection, settings.source = ring, "COLLECTION"


CLASSES = (
    REFINE_OT_turn_cameras,
    REFINE_OT_add_between,
    REFINE_OT_add_ring,
    REFINE_OT_leave_out,
    REFINE_OT_keep_unseen,
)
