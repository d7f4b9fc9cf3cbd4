"""Convert splats to a point cloud, prune that, reload the file, and convert what is left back."""

from __future__ import annotations

from typing import Any

import bpy
from extension import enable


def main(cloud: str, cameras: str, blend: str, output: str, back: str) -> dict[str, Any]:
    """Write what stays as the point cloud and as the mesh export it; return what was found."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    enable()
    bpy.ops.refine.import_ply(filepath=cloud)
    bpy.ops.refine.convert()
    splats = bpy.context.object
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
    bpy.ops.refine.convert()
    found["back"] = len(bpy.context.object.data.vertices)
    bpy.ops.refine.export_ply(filepath=back)
    return found
