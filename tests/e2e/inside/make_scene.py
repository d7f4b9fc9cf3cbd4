"""Make a .blend of a trained scene without the extension: a second way to what it imports itself.

The splats come in through Blender's own PLY importer, the cameras by the few lines below.
"""

from __future__ import annotations

import json
from pathlib import Path

import bpy
from mathutils import Matrix


def main(cloud, cameras, blend):
    """Save ``blend`` with the object "Splats" and a camera for each entry of ``cameras``."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    # The file is in Blender's own axes (z up), which the importer would turn otherwise.
    bpy.ops.wm.ply_import(filepath=cloud, forward_axis="Y", up_axis="Z", import_attributes=True)
    splats = bpy.context.object
    splats.name = "Splats"
    entries = json.loads(Path(cameras).read_text(encoding="utf-8"))
    for index, entry in enumerate(entries):
        add_camera(f"Camera.{index:03}", entry)
    render = bpy.context.scene.render
    render.resolution_x, render.resolution_y = entries[0]["width"], entries[0]["height"]
    render.resolution_percentage = 100
    bpy.context.scene.camera = bpy.data.objects["Camera.000"]
    bpy.context.view_layer.objects.active = splats
    splats.select_set(state=True)
    bpy.ops.wm.save_as_mainfile(filepath=blend)


def add_camera(name, entry):
    """Place one camera of a reference cameras.json in the scene.

    There ``rotation`` is camera to world and the camera looks along its +z with y down; Blender's
    looks along -z with y up.
    """
    data = bpy.data.cameras.new(name)
    data.sensor_fit = "HORIZONTAL"
    data.lens = entry["fx"] / entry["width"] * data.sensor_width
    camera = bpy.data.objects.new(name, data)
    turn = Matrix(entry["rotation"]) @ Matrix.Diagonal((1.0, -1.0, -1.0))
    camera.matrix_world = Matrix.Translation(entry["position"]) @ turn.to_4x4()
    bpy.context.scene.collection.objects.link(camera)
