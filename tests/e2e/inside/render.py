"""*Render with Splats* in a window: a picture among meshes, an animation, Esc, F12 by itself."""

from __future__ import annotations

import importlib
import os
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

import bpy
import extension
import numpy as np
import xserver
from mathutils import Vector
from window import picture, until

IMAGE = "Render with Splats"


def main(pictures: str) -> Generator[float, None, dict[str, Any]]:
    """Render the open scene with a cube in front of its splats; return what is there afterwards.

    Parameters
    ----------
    pictures
        Folder for pictures of the whole screen, and the frames of an animation.

    Yields
    ------
    float
        Seconds to wait.
    """
    extension.enable()
    yield 1.0
    scene = bpy.context.scene
    prepare(scene)
    scene.render.filepath = f"{pictures}/frame_##"
    found: dict[str, Any] = {"in_windows": []}
    bpy.app.handlers.render_init.append(lambda scene, *_: note_windows(found, scene))
    before = settings(scene)

    invoke()
    yield 2.0
    running = importlib.import_module(f"{extension.MODULE}.ui.operator_bases")
    found["refusal"], found["can export"] = running.idle(None), bpy.ops.refine.export_ply.poll()
    found["scenes"] = [scene.name for scene in bpy.data.scenes if scene.name[0] != "."]
    yield from picture(pictures, "during")
    yield from until(lambda: IMAGE in bpy.data.images and not rendering(), "it is rendered")
    found["refusal"] = [found["refusal"], running.idle(None)]
    yield from picture(pictures, "render")
    found["size"] = list(bpy.data.images[IMAGE].size)
    found["alike"] = [settings(scene) == before]
    save(bpy.data.images[IMAGE], f"{pictures}/rendered.npy")

    card = importlib.import_module(f"{extension.MODULE}.render.card")
    card.available, real = (lambda: True), card.available
    name = bpy.data.images[IMAGE].session_uid
    invoke()
    yield from until(
        lambda: bpy.data.images[IMAGE].session_uid != name and not rendering(), "again"
    )
    save(bpy.data.images[IMAGE], f"{pictures}/by_card.npy")
    card.available = real

    scene.frame_end = 2
    before = settings(scene)
    invoke(animation=True)
    yield from until(lambda: not rendering(), "the animation is over")
    found["alike"].append(settings(scene) == before)

    for number in range(3):  # 160,000 splats
        copy = bpy.data.objects["Splats"].copy()
        copy.location.z += 0.01 * number
        scene.collection.objects.link(copy)
    found["busy"] = []
    scene.render.resolution_percentage = 400
    for animation in (True, False):  # which take longer than until Esc
        bpy.data.objects["Cube"].hide_render = not animation  # else it is the splats that are drawn
        scene.frame_end, scene.render.filepath = 99, f"{pictures}/stopped_##"
        yield 0.5
        before, shown = settings(scene), bpy.data.images[IMAGE].size[:]
        yield from escape(found, animation=animation)
        found["alike"].append(settings(scene) == before)
    found["stopped"] = bpy.data.images[IMAGE].size[:] == shown

    scene.render.resolution_percentage = 100
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        bpy.ops.render.render("INVOKE_DEFAULT")
    yield 1.0
    yield from picture(pictures, "f12")
    yield from until(lambda: not rendering(), "F12 is over")  # Blender quits badly amid a render
    notice = importlib.import_module(f"{extension.MODULE}.ui.render_operators")
    found["notice"] = bool(notice._until)
    return found


def escape(found: dict[str, Any], *, animation: bool) -> Generator[float, None, None]:
    """Begin a render, press Esc a second later, and note how busy Blender was until all is drawn.

    Until Blender hears of the key, after what it draws, its main thread counts alone: the render
    goes on beside it.
    """
    operators = importlib.import_module(f"{extension.MODULE}.ui.render_operators")
    heard: list[float] = []

    watch = operators.REFINE_OT_watch_render
    real = watch.modal

    def modal(self, context, event):
        if event.type == "ESC" and event.value == "PRESS":
            heard.append(processor() - time.thread_time())
        return real(self, context, event)

    watch.modal = modal
    invoke(animation=animation)
    yield 1.0
    found["began"] = rendering()
    pressed = time.thread_time()
    xserver.tap(xserver.ESCAPE)
    yield from until(lambda: not rendering(), "it has stopped")
    yield 1.0  # the scene is drawn
    found["busy"].append(processor() - heard[0] - pressed)
    watch.modal = real


def processor() -> float:
    """Return the seconds of processor that Blender has taken, but for its software renderer's."""
    ticks = 0
    for task in Path("/proc/self/task").iterdir():
        name, _, rest = (task / "stat").read_text(encoding="utf-8").rpartition(")")
        if "llvmpipe" in name:
            ticks += sum(map(int, rest.split()[11:13]))
    return time.process_time() - ticks / os.sysconf("SC_CLK_TCK")


def prepare(scene: bpy.types.Scene) -> None:
    """Put a red cube without shading in front of the splats, to the left."""
    place = scene.camera.matrix_world @ Vector((-0.15, 0.0, -0.5))
    bpy.ops.mesh.primitive_cube_add(size=0.12, location=place)
    material = bpy.data.materials.new("red")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    light = tree.nodes.new("ShaderNodeEmission")
    light.inputs["Color"].default_value = (1.0, 0.0, 0.0, 1.0)
    end = tree.nodes.new("ShaderNodeOutputMaterial")
    tree.links.new(light.outputs[0], end.inputs["Surface"])
    bpy.context.object.data.materials.append(material)
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 8, False
    scene.view_settings.view_transform = "Standard"
    scene.world = bpy.data.worlds.new("black")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes.clear()


def invoke(*, animation: bool = False) -> None:
    """Start it as the button does."""
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
        bpy.ops.refine.render("INVOKE_DEFAULT", animation=animation)


def note_windows(found: dict[str, Any], scene: bpy.types.Scene) -> None:
    """Note whether a window shows what Cycles renders; called on the thread that does."""
    if scene.render.engine == "CYCLES":
        windows = bpy.context.window_manager.windows
        found["in_windows"].append(any(window.scene == scene for window in windows))


def rendering() -> bool:
    """Tell whether a render is under way."""
    return bpy.app.is_job_running("RENDER") or any("refine_render" in s for s in bpy.data.scenes)


def settings(scene: bpy.types.Scene) -> list[str]:
    """Return what a render must leave as it was."""
    groups = (scene, scene.render, scene.render.image_settings, scene.view_settings)
    groups += (*scene.view_layers, bpy.context.preferences.view)
    told = [
        f"{group.bl_rna.identifier}.{name} = {getattr(group, name)!r}"
        for group in groups
        for name, kind in group.bl_rna.properties.items()
        if kind.type in {"BOOLEAN", "INT", "FLOAT", "STRING", "ENUM"} and not kind.is_readonly
    ]
    told += [f"{obj.name} {obj.hide_render} {obj.is_holdout}" for obj in bpy.data.objects]
    told += {window.scene.name for window in bpy.context.window_manager.windows}
    return told + [scene.name for scene in bpy.data.scenes]


def save(image: bpy.types.Image, path: str) -> None:
    """Write the pixels of an image as they are, the top row first."""
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    np.save(path, values.reshape(image.size[1], image.size[0], 4)[::-1])
