"""Use the window while splats are scored: orbit, undo, save; then end it in every way there is."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import bpy
import extension
from hand import at_work, begin, until

NAME = "Splats"


def main(blend, pictures):
    """Score the splats of the open file again and again; return what went on meanwhile."""
    hand = yield from begin(pictures)
    gate = Gate()
    yield from hand.open_tab()
    found = {"before": method()}

    gate.opened.set()
    yield from hand.click("refine.score(")
    yield from until(lambda: not at_work() and method(), "it is over")
    found["scored"] = method()
    yield from hand.move(hand.area.x + 50, hand.area.y + 50)  # away from that button
    yield 0.5
    gate.opened.clear()
    yield from hand.click("refine.score(")
    yield from until(gate.held, "it is held back")
    found |= yield from meanwhile(hand, blend)
    found["still"] = gate.held()
    yield from hand.picture("alive-1-meanwhile")
    begun = time.monotonic()
    yield from hand.press("ESC")
    yield from until(lambda: not at_work(), "it is cancelled")
    found["esc_s"], found["stopped"] = time.monotonic() - begun, method()
    yield from hand.picture("alive-2-stopped")
    yield from hand.undo()
    yield from until(lambda: not method(), "the scores are gone")

    found["ended by"] = {}
    for how in (delete, load, close_window, disable):
        score_in_a_window(hand, gate)
        yield from until(gate.held, "it is held back")
        how(blend)
        yield 1.5
        threads = sum(thread.name == "refine" for thread in threading.enumerate())
        found["ended by"][how.__name__] = [not at_work(), threads]
        if how is delete:
            load(blend)
            yield 1.0
    extension.enable()
    score_in_a_window(hand, Gate())
    yield 1.0
    return found  # and Blender is quit, while it scores


def meanwhile(hand, blend):
    """Do while splats are scored what the window is to allow."""
    view = hand.space.region_3d
    turned, far = view.view_rotation.copy(), view.view_distance
    x, y = yield from hand.over()
    yield from hand.event("MIDDLEMOUSE")
    for step in range(8):
        yield from hand.move(x + 15 * step, y)
    yield from hand.event("MIDDLEMOUSE", "RELEASE")
    yield 0.3
    yield from hand.event("WHEELUPMOUSE")
    yield 0.5
    saved, undone = Path(blend).stat().st_mtime_ns, []
    for redo in (False, True):
        yield from hand.undo(redo=redo)
        undone.append(method())
    yield from hand.press("S", ctrl=True)
    yield 0.5
    return {
        "orbited": view.view_rotation.rotation_difference(turned).angle,
        "zoomed": view.view_distance / far,
        "saved": Path(blend).stat().st_mtime_ns != saved,
        "undone": undone,
        "apply": bpy.ops.refine.apply.poll(),
    }


def delete(_blend):
    """Delete the object."""
    bpy.data.objects.remove(bpy.data.objects[NAME])


def load(blend):
    """Open a file."""
    bpy.ops.wm.open_mainfile(filepath=blend)


def close_window(_blend):
    """Close the window that the operator was started in; there is another one."""
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[-1]):
        bpy.ops.wm.window_close()


def disable(_blend):
    """Switch the extension off."""
    extension.disable()


def score_in_a_window(hand, gate):
    """Start scoring in a window of its own."""
    gate.opened.clear()
    with bpy.context.temp_override(window=hand.window):
        bpy.ops.wm.window_new()
    new = bpy.context.window_manager.windows[-1]
    area = next(area for area in new.screen.areas if area.type == "VIEW_3D")
    with bpy.context.temp_override(window=new, area=area, region=area.regions[-1]):
        bpy.context.view_layer.objects.active = bpy.data.objects[NAME]
        bpy.ops.refine.score("INVOKE_DEFAULT")


def method():
    """Return by what the splats were scored."""
    mesh = bpy.data.objects[NAME].data
    noted = mesh.get("refine_scores") and extension.module("mesh.scores").record(mesh)
    return noted["method"] if noted else None


class Gate:
    """Holds back scoring until it is opened."""

    def __init__(self):
        self.opened, self.waits = threading.Event(), False
        operators, work = extension.module("ui.operators"), extension.module("core.execute")
        score = operators.score

        def held(splats, views, method, *, progress, **options):
            try:
                while not self.opened.wait(0.05):
                    self.waits = True
                    work.report(progress, 0.4, "looking")
            finally:
                self.waits = False
            return score(splats, views, method, progress=progress, **options)

        operators.score = held

    def held(self):
        """Tell whether scoring is held back."""
        return self.waits
