"""Prune a file by the panel's operators: import, import cameras, score, apply, export."""

from __future__ import annotations

from typing import Any

import bpy
from extension import enable


def main(cloud: str, cameras: str, output: str) -> dict[str, Any]:
    """Write ``output`` and return how many splats and cameras there were on the way."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    enable()
    bpy.ops.refine.import_ply(filepath=cloud)
    splats = bpy.context.object
    bpy.ops.refine.import_cameras(filepath=cameras)
    # Importing cameras may have made one of them active; the panel's buttons act on the active one.
    bpy.context.view_layer.objects.active = splats
    found = {"imported": len(splats.data.vertices), "cameras": len(bpy.data.cameras)}
    bpy.context.scene.refine.method = "occlusion"
    bpy.ops.refine.score()
    found["scored"] = "refine_score" in splats.data.attributes
    bpy.ops.refine.apply()
    found["kept"] = len(splats.data.vertices)
    bpy.ops.refine.export_ply(filepath=output)
    return found
