"""Open a .blend and count what is in it."""

from __future__ import annotations

import bpy


def main(blend: str, name: str) -> dict[str, int]:
    """Return the number of the named object's vertices and of the cameras."""
    bpy.ops.wm.open_mainfile(filepath=blend)
    cameras = [obj for obj in bpy.data.objects if obj.type == "CAMERA"]
    return {"vertices": len(bpy.data.objects[name].data.vertices), "cameras": len(cameras)}
