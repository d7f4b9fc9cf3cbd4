"""*Render with Splats* in the background: seconds of the processor, and dB to the reference.

    python -m benchmarks.speed.renders SCENE_DIR [--view 0] [--size 960 540]

In Blender as a module, so splats are drawn by the processor. The camera of one view sees splats
alone, and splats with a red pane before a part of them and a white wall behind all. The reference
renderer draws the splats on white; pixels within 3 of the pane's edges are not compared.
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

# Before bpy is imported, so that nobody's own Blender settings are read or written.
os.environ["BLENDER_USER_RESOURCES"] = tempfile.mkdtemp(prefix="refine-bench-")

from collections.abc import Sequence

import bpy
from mathutils import Matrix
from numpy.typing import NDArray

import refine_addon
from refine_addon.cameras import SOURCE, view_from_camera
from refine_addon.core import read_ply

from ..renderer.rasterizer import render

IMAGE = "Render with Splats"
SAMPLES = 16
EDGE = 3


def make_plane(depth: float, color: Sequence[float], size: float, *, corner: bool = False) -> None:
    """Put a square that shines in a colour before the camera, its middle or corner on the axis."""
    bpy.ops.mesh.primitive_plane_add(size=size)
    aside = size / 2.0 if corner else 0.0
    bpy.context.object.matrix_world = bpy.context.scene.camera.matrix_world @ Matrix.Translation(
        (aside, aside, -depth)
    )
    material = bpy.data.materials.new("plane")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    light, end = (tree.nodes.new(f"ShaderNode{kind}") for kind in ("Emission", "OutputMaterial"))
    light.inputs[0].default_value = (*color, 1.0)
    tree.links.new(light.outputs[0], end.inputs[0])
    bpy.context.object.data.materials.append(material)


def rendered() -> tuple[NDArray[np.float32], float, float]:
    """Return the picture, (H, W, 4), the top row first, and seconds: processor's and clock's."""
    clock, busy = time.perf_counter(), time.process_time()
    bpy.ops.refine.render()
    busy, clock = time.process_time() - busy, time.perf_counter() - clock
    image = bpy.data.images[IMAGE]
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)[::-1], busy, clock


def set_up(cloud: Path, view: int, size: Sequence[int]) -> bpy.types.Scene:
    """Import splats and the cameras beside them; return the scene, to be rendered by one view."""
    refine_addon.register()
    bpy.data.batch_remove(bpy.data.objects)
    bpy.ops.refine.import_ply(filepath=str(cloud), cameras=True, upright=False)
    scene = bpy.context.scene
    scene.camera = [obj for obj in scene.objects if obj.type == "CAMERA"][view]
    del scene.camera[SOURCE]  # the scene's size counts, not that of the view's image
    scene.render.resolution_x, scene.render.resolution_y = size
    scene.render.resolution_percentage = 100
    scene.render.engine, scene.render.film_transparent = "CYCLES", True
    scene.render.pixel_aspect_x = scene.render.pixel_aspect_y = 1.0
    scene.view_settings.view_transform = "Standard"
    scene.cycles.samples, scene.cycles.use_denoising = SAMPLES, False
    bpy.context.view_layer.update()
    return scene


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the measurements."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--view", type=int, default=0)
    parser.add_argument("--size", type=int, nargs=2, default=(960, 540))
    options = parser.parse_args(arguments)
    scene = set_up(options.scene / "point_cloud.ply", options.view, options.size)
    view = view_from_camera(scene.camera)
    splats = read_ply(options.scene / "point_cloud.ply").splats()
    near = scene.camera.data.clip_start
    expected = render(splats, view, near=near)
    lines = [
        f"Blender {bpy.app.version_string}, {len(splats):,} splats, {view.width} x {view.height}"
    ]

    def told(name: str, apart: NDArray[np.float64], busy: float, clock: float) -> None:
        decibels = -10.0 * np.log10(np.mean(apart**2))
        lines.append(
            f"{name}: {decibels:.1f} dB, {busy:.1f} s of the processor, {clock:.1f} in all"
        )

    picture, busy, clock = rendered()
    on_black = picture[..., :3] * picture[..., 3:]
    told("splats alone", on_black - expected.clip(0.0, 1.0), busy, clock)

    depths = (splats.means - view.center) @ view.rotation[2]
    seen = depths[depths > near]
    close, far = float(np.quantile(seen, 0.01)), float(seen.max()) * 2.0
    wide = 4.0 * max(view.width / view.fx, view.height / view.fy)
    scene.camera.data.clip_end = far * 10.0
    make_plane(close, (1.0, 0.0, 0.0), wide * close, corner=True)
    make_plane(far, (1.0, 1.0, 1.0), wide * far)
    front = splats.take((depths > near) & (depths < close))
    expected = render(splats, view, near=near, background=(1.0,) * 3)
    before = render(front, view, near=near, background=(1.0, 0.0, 0.0))
    column, row = round(view.cx), round(view.cy)
    expected[:row, column:] = before[:row, column:]
    compared = np.ones(expected.shape[:2], np.bool_)
    compared[row - EDGE : row + EDGE, column - EDGE :] = False
    compared[: row + EDGE, column - EDGE : column + EDGE] = False
    picture, busy, clock = rendered()
    apart = (picture[..., :3] - expected.clip(0.0, 1.0))[compared]
    told("with a pane in front and a wall behind", apart, busy, clock)
    print("\n".join(lines))  # after what Blender says of its renders
    shutil.rmtree(os.environ["BLENDER_USER_RESOURCES"], ignore_errors=True)


if __name__ == "__main__":
    main()
