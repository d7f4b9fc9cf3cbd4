"""How long after Esc a render is over: F12 with Cycles, the same among splats, splats alone."""

from __future__ import annotations

import bpy
import extension
from render import Escape, invoke, prepare, prolong

_WAITS = (0.8, 1.1, 1.4, 1.7)
"""Seconds from the start of a render to Esc, by turns: it is at something else each time."""


def main(turns, kinds):
    """Return what `Escape.seconds` does of each turn, by kind of render: words of ``kinds``.

    "plain" is F12, "cycles" amid meshes of *Render with Splats*, "splats" amid splats alone.
    """
    extension.enable()
    yield 1.0
    scene = bpy.context.scene
    prepare(scene)
    scene.world = bpy.data.worlds.new("World")
    prolong(scene)
    scene.render.filepath = "//escape_##"
    found = {kind: [] for kind in kinds.split()}
    for turn in range(turns):
        for kind, seconds in found.items():
            bpy.data.objects["Cube"].hide_render = kind == "splats"
            scene.world.use_nodes = kind != "splats"
            yield 1.0
            with Escape() as escape:
                if kind == "plain":
                    invoke(bpy.ops.render.render, animation=True)
                    watched = extension.module("render.engine").Shared()
                    extension.module("ui.render_operators")._watch_anew(watched)
                else:
                    invoke(bpy.ops.refine.render, animation=kind == "cycles")
                yield _WAITS[turn % len(_WAITS)]
                times = yield from escape.seconds()
                seconds.append([round(time, 2) for time in times])
            print(kind, seconds[-1], flush=True)
    return found
