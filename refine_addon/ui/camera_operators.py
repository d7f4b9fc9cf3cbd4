"""Deciding cameras: what each sees, a ring of them around the splats, a turn of all."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import bpy
import mathutils
import numpy as np
from bpy.props import IntProperty

from ..cameras import CameraChoice
from ..core import RefineError
from ..core.affine import QUARTERS
from ..core.quality.curve import in_words
from ..mesh import edit, scores
from ..mesh import layout as mesh_layout
from ..objects import demands, splat_group
from .operator_bases import Acting
from .wrapped import counted

_MOST = 8  # Cameras shown


def cameras(record: dict[str, Any], psnr: Mapping[str, float]) -> list[tuple[Any, ...]]:
    """Cameras of a record, by: whether it sees splats, whether it is near, its dB (of `psnr`, by
    view; infinite if unknown), how many splats it sees; and its name."""
    far = set((record.get("alignment") or {}).get("far", ()))
    each = [
        (seen > 0, name not in far, psnr.get(name, math.inf), seen, name)
        for name, seen in record.get("cameras") or ()
    ]
    return sorted(each, key=lambda camera: camera[:-1])


def draw(layout: bpy.types.UILayout, record: dict[str, Any], psnr: Mapping[str, float]) -> None:
    """Draw the first of `cameras`; folded at first."""
    header, body = layout.panel("REFINE_cameras", default_closed=True)
    header.label(text="What Each Sees")
    if not body:
        return
    column = body.column(align=True)
    every = cameras(record, psnr)
    for sees, near, level, seen, name in every[:_MOST]:
        text = "far away" if not near else f"{seen:,}" if sees else "nothing"
        if level < math.inf:
            text += f", {in_words(level)}"
        column.label(text=f"{name}: {text}", icon="CAMERA_DATA" if near and sees else "ERROR")
    if len(every) > _MOST:
        column.label(text=f"and {len(every) - _MOST} that change less")


_INNER = (5.0, 95.0)  # Percentiles of positions that a ring frames: far floaters do not count
_ELEVATIONS = (15.0, 40.0)  # Degrees above the horizon of a ring's cameras, in turn
_MARGIN = 1.1  # Distance of a camera over the least that frames all


class REFINE_OT_turn_cameras(Acting, bpy.types.Operator):
    """Turn the cameras that decide about the world's X axis, and drop the scores"""

    bl_label = "Turn the Cameras"

    quarters: IntProperty(
        name="Quarters",
        description="Quarter turns: 1 from y down to z up as Upright does, -1 back, 2 for an SPZ",
        default=1, min=-1, max=2,
    )  # fmt: skip

    def act(self, context: bpy.types.Context) -> None:
        """Turn them, or the parents that animate them."""
        context.view_layer.update()  # or what a script just made stands at the origin
        scene, choice = context.scene, CameraChoice.of_scene(context.scene)
        cameras = choice.cameras(context)
        if choice.source == "FRAMES":  # all of a shot
            shot = [*(marker.camera for marker in scene.timeline_markers), scene.camera]
            cameras = list(dict.fromkeys(camera for camera in shot if camera))
        if not cameras:
            raise RefineError("no cameras: choose those that decide, or add a ring of cameras")
        roots = _roots(cameras, context.object)
        group = [mesh_layout.check(obj) for obj in splat_group.chosen(context.object)]
        for checked in group:
            edit.check_writable(checked.obj)
        turn = mathutils.Matrix(QUARTERS[self.quarters].tolist()).to_4x4()
        parent = None
        for root in roots:
            if root.animation_data:
                parent = parent or bpy.data.objects.new("Turned Cameras", None)
                root.parent = parent
                root.matrix_parent_inverse.identity()
            else:
                root.matrix_world = turn @ root.matrix_world
        if parent:
            scene.collection.objects.link(parent)
            parent.matrix_world = turn
        context.view_layer.update()
        for checked in group:
            scores.forget(checked)  # the cameras stood elsewhere
        self.report({"INFO"}, f"Turned {counted(len(cameras), 'camera')}; score again")


class REFINE_OT_add_ring(Acting, bpy.types.Operator):
    """Add cameras around the splats, taking Z as up; they decide together with the others"""

    bl_label = "Add a Ring of Cameras"

    count: IntProperty(name="Cameras", description="Number of cameras", default=16, min=3, max=360)

    def act(self, context: bpy.types.Context) -> None:
        """Add them."""
        means = demands.finite_means(mesh_layout.check(context.object))
        low, high = np.percentile(means, _INNER, axis=0)
        # All splats may lie in one point.
        radius = float(np.linalg.norm(high - low)) / 2.0 or 1.0
        data, render = bpy.data.cameras.new("Ring"), context.scene.render
        width = render.resolution_x * render.pixel_aspect_x
        height = render.resolution_y * render.pixel_aspect_y
        # The sensor lies along the longer side of the picture.
        half = data.sensor_width / 2.0 / data.lens * min(width, height) / max(width, height)
        distance = _MARGIN * radius / math.sin(math.atan(half))
        data.clip_start, data.clip_end = 1e-3 * distance, 1e2 * distance
        data.display_size = 0.1 * radius
        ring = bpy.data.collections.new("Ring of Cameras")
        for number in range(self.count):
            around = 2.0 * math.pi * number / self.count
            up = math.radians(_ELEVATIONS[number % len(_ELEVATIONS)])
            x, y = math.cos(around) * math.cos(up), math.sin(around) * math.cos(up)
            away = mathutils.Vector((x, y, math.sin(up)))
            camera = bpy.data.objects.new("Ring", data)
            camera.location = mathutils.Vector((low + high) / 2.0) + distance * away
            camera.rotation_euler = away.to_track_quat("Z", "Y").to_euler()
            ring.objects.link(camera)
        _join(context, ring)
        self.report({"INFO"}, f"Added {self.count} cameras in '{ring.name}'; score again")


def _roots(cameras: Sequence[bpy.types.Object], splats: bpy.types.Object) -> list[bpy.types.Object]:
    """Objects to turn so that cameras turn without the splats; else `RefineError`."""
    roots = {}
    for camera in cameras:
        root = _root(camera)
        if root == _root(splats):
            raise RefineError(f"camera '{camera.name}' turns with the splats; unparent it")
        if root.constraints:
            raise RefineError(f"'{root.name}': has constraints; turn it by hand")
        if root.library:
            raise RefineError(f"'{root.name}': is linked, make it local first")
        roots[root] = None
    return list(roots)


def _root(obj: bpy.types.Object) -> bpy.types.Object:
    return _root(obj.parent) if obj.parent else obj


def _join(context: bpy.types.Context, ring: bpy.types.Collection) -> None:
    scene, settings = context.scene, context.scene.refine
    if settings.source == "COLLECTION" and (others := settings.collection) and not others.library:
        others.children.link(ring)
        return
    scene.collection.children.link(ring)
    if settings.source != "VISIBLE":
        for camera in CameraChoice.of_scene(scene).cameras(context):
            ring.objects.link(camera)
        settings.collection, settings.source = ring, "COLLECTION"
