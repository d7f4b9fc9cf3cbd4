"""*Render with Splats* in a window: a picture among meshes, an animation, Esc, F12 by itself."""

from __future__ import annotations

import os
import time
from pathlib import Path

import bpy
import extension
import xserver
from hand import IMAGE, Hand, rendering, save, until
from mathutils import Vector


def main(pictures):
    """Render the open scene with a cube in front of its splats; return what is there afterwards."""
    extension.enable()
    yield 1.0
    scene, hand = bpy.context.scene, Hand(pictures)
    prepare(scene)
    scene.render.filepath = f"{pictures}/frame_##"
    found = {"in_windows": [], "busy": []}
    bpy.app.handlers.render_init.append(lambda scene, *_: note_windows(found, scene))
    before = settings(scene)

    invoke(bpy.ops.refine.render)
    yield 2.0
    running = extension.module("ui.operator_bases")
    found["refusal"], found["can export"] = [running.idle(None)], bpy.ops.refine.export_ply.poll()
    found["scenes"] = [scene.name for scene in bpy.data.scenes if scene.name[0] != "."]
    yield from hand.picture("during")
    yield from until(lambda: IMAGE in bpy.data.images and not rendering(), "it is rendered")
    found["refusal"].append(running.idle(None))
    yield from hand.picture("render")
    found["size"] = list(bpy.data.images[IMAGE].size)
    found["alike"] = [settings(scene) == before]
    save(bpy.data.images[IMAGE], f"{pictures}/rendered.npy")

    card = extension.module("render.card")
    card.available, real = (lambda: True), card.available
    first = bpy.data.images[IMAGE].session_uid
    invoke(bpy.ops.refine.render)
    yield from until(
        lambda: bpy.data.images[IMAGE].session_uid != first and not rendering(), "again"
    )
    save(bpy.data.images[IMAGE], f"{pictures}/by_card.npy")
    card.available = real

    scene.frame_end = 2
    before = settings(scene)
    invoke(bpy.ops.refine.render, animation=True)
    yield from until(lambda: not rendering(), "the animation is over")
    found["alike"].append(settings(scene) == before)

    prolong(scene)
    scene.render.filepath = f"{pictures}/stopped_##"
    for animation in (True, False):
        bpy.data.objects["Cube"].hide_render = not animation  # else it is the splats that are drawn
        yield 0.5
        before, shown = settings(scene), bpy.data.images[IMAGE].size[:]
        with Escape() as escape:
            invoke(bpy.ops.refine.render, animation=animation)
            yield 1.0
            found["began"] = rendering()
            found["busy"].append((yield from escape.seconds())[-1])
        found["alike"].append(settings(scene) == before)
    found["stopped"] = bpy.data.images[IMAGE].size[:] == shown

    bpy.ops.wm.window_new()
    before = settings(scene)
    invoke(bpy.ops.refine.render, window=-1, animation=True)
    yield 1.0
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[-1]):
        bpy.ops.wm.window_close()
    yield from until(lambda: not rendering() and settings(scene) == before, "its window is gone")

    scene.render.resolution_percentage = 100
    invoke(bpy.ops.render.render)
    yield 1.0
    yield from hand.picture("f12")
    yield from until(lambda: not rendering(), "F12 is over")  # Blender quits badly amid a render
    found["notice"] = bool(extension.module("ui.render_operators")._until)
    return found


class Escape:
    """Presses Esc amid a render, and counts what Blender still does."""

    def __enter__(self):
        self.heard, self.cancelled = [], []
        bpy.app.handlers.render_cancel.append(self.cancel)
        self.watch = extension.module("ui.render_operators").REFINE_OT_watch_render
        self.real = real = self.watch.modal

        def modal(operator, context, event):
            if event.type == "ESC" and event.value == "PRESS":
                self.heard.append((time.monotonic(), processor() - time.thread_time()))
            return real(operator, context, event)

        self.watch.modal = modal
        return self

    def __exit__(self, *_):
        bpy.app.handlers.render_cancel.remove(self.cancel)
        self.watch.modal = self.real

    def cancel(self, *_):
        self.cancelled.append(time.monotonic())

    def seconds(self):
        """Press it; return seconds from then on, and what a busy machine does not lengthen.

        Until Blender hears of the key, until its render ends (0 where none was under way), until
        all is over; and seconds of the processor until the scene is drawn: of the main thread, and
        of the others since Esc was heard, as a render goes on beside what it draws until then.
        """
        pressed, own = time.monotonic(), time.thread_time()
        xserver.tap(xserver.ESCAPE)
        yield from until(lambda: not rendering(), "it has stopped")
        over = time.monotonic()
        yield 1.0  # the scene is drawn
        heard, others = self.heard[0]
        times = heard, next(iter(self.cancelled), 0.0), over
        return [*(max(when - pressed, 0.0) for when in times), processor() - others - own]


def processor():
    """Return the seconds of processor that Blender has taken, but for its software renderer's."""
    ticks = 0
    for task in Path("/proc/self/task").iterdir():
        name, _, rest = (task / "stat").read_text(encoding="utf-8").rpartition(")")
        if "llvmpipe" in name:
            ticks += sum(map(int, rest.split()[11:13]))
    return time.process_time() - ticks / os.sysconf("SC_CLK_TCK")


def prepare(scene):
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


def prolong(scene):
    """Make renders take longer than until Esc: 160,000 splats, larger, and 99 frames."""
    for number in range(3):
        copy = bpy.data.objects["Splats"].copy()
        copy.location.z += 0.01 * number
        scene.collection.objects.link(copy)
    scene.render.resolution_percentage, scene.frame_end = 400, 99


def invoke(operator, *, window=0, animation=False):
    """Start a render as its button does, in one of the windows."""
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[window]):
        operator("INVOKE_DEFAULT", animation=animation)


def note_windows(found, scene):
    """Note whether a window shows what Cycles renders; called on the thread that does."""
    if scene.render.engine == "CYCLES":
        windows = bpy.context.window_manager.windows
        found["in_windows"].append(any(window.scene == scene for window in windows))


def settings(scene):
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
