"""Prune a point cloud of Blender's own splats, reload the file, and export what is left."""

from __future__ import annotations

import importlib
from typing import Any

import bpy
import clouds
import extension


def main(cloud: str, cameras: str, blend: str, output: str) -> dict[str, Any]:
    """Write what stays; return what was found."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    extension.enable()
    bpy.ops.refine.import_ply(filepath=cloud)
    package = importlib.import_module(extension.MODULE)
    splats = clouds.as_cloud(package, bpy.context.object)
    bpy.ops.refine.import_cameras(filepath=cameras)
    bpy.context.view_layer.objects.active = splats
    found = {"type": splats.type, "points": len(splats.data.points)}
    bpy.context.scene.refine.method = "closed-form"
    bpy.ops.refine.score()
    bpy.ops.refine.apply()
    name = splats.name
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    bpy.ops.wm.open_mainfile(filepath=blend)
    splats = bpy.data.objects[name]
    bpy.context.view_layer.objects.active = splats
    found["kept"] = len(splats.data.points)
    bpy.ops.refine.export_ply(filepath=output)
    return found
