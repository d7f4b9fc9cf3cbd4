"""How long after Esc a render is over: F12 with Cycles, the same among splats, splats alone."""

from __future__ import annotations

import importlib
import time
from collections.abc import Generator

import bpy
import extension
import xserver
from render import invoke, prepare, processor, rendering
from window import until

_WAITS = (0.8, 1.1, 1.4, 1.7)
"""Seconds from the start of a render to Esc, by turns: it is at something else each time."""


def main(turns: int, kinds: str) -> Generator[float, None, dict[str, list[list[float]]]]:
    """Return for each kind of render, and each turn, the seconds from Esc until it is over.

    Before them stand the seconds until Blender hears of the key, and until its render ends (0
    where none was under way); behind them seconds of the processor as `render.escape` counts them,
    which a busy machine does not lengthen: of the main thread, and of others since Esc was heard.

    Parameters
    ----------
    turns
        How often Esc is pressed amid each.
    kinds
        Of "plain" (F12), "cycles" (amid meshes of *Render with Splats*) and "splats", some.

    Yields
    ------
    float
        Seconds to wait.
    """
    extension.enable()
    yield 1.0
    scene = bpy.context.scene
    prepare(scene)
    scene.world = bpy.data.worlds.new("World")
    for number in range(3):  # 160,000 splats
        copy = bpy.data.objects["Splats"].copy()
        copy.location.z += 0.01 * number
        scene.collection.objects.link(copy)
    scene.render.resolution_percentage = 400
    scene.frame_end, scene.render.filepath = 99, "//escape_##"
    heard: list[tuple[float, float]] = []
    cancelled: list[float] = []
    bpy.app.handlers.render_cancel.append(lambda *_: cancelled.append(time.monotonic()))
    operators = importlib.import_module(f"{extension.MODULE}.ui.render_operators")
    note = operators.REFINE_OT_watch_render.modal

    def modal(self, context, event):
        if event.type == "ESC" and event.value == "PRESS":
            heard.append((time.monotonic(), processor() - time.thread_time()))
        return note(self, context, event)

    operators.REFINE_OT_watch_render.modal = modal
    found: dict[str, list[list[float]]] = {kind: [] for kind in kinds.split()}
    for turn in range(turns):
        for kind, seconds in found.items():
            bpy.data.objects["Cube"].hide_render = kind == "splats"
            scene.world.use_nodes = kind != "splats"
            yield 1.0
            heard.clear()
            cancelled.clear()
            if kind == "plain":
                with bpy.context.temp_override(window=bpy.context.window_manager.windows[0]):
                    bpy.ops.render.render("INVOKE_DEFAULT", animation=True)
                operators._watch_anew()
            else:
                invoke(animation=kind == "cycles")
            yield _WAITS[turn % len(_WAITS)]
            pressed, own = time.monotonic(), time.thread_time()
            xserver.tap(xserver.ESCAPE)
            yield from until(lambda: not rendering(), "it has stopped")
            first, others = heard[0]
            times = (first, next(iter(cancelled), 0.0), time.monotonic())
            busy = processor() - others - own
            seconds.append(
                [*(round(max(when - pressed, 0.0), 2) for when in times), round(busy, 2)]
            )
            print(kind, seconds[-1], flush=True)
    return found
