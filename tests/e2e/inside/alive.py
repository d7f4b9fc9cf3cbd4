"""Use the window while splats are scored: orbit, undo, save, load, close; then import a file."""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import bpy
import extension
import window

NAME = "Splats"

STRETCHES = 15
"""How often to look whether the panel is drawn twice without the view."""


def main(blend: str, cloud: str, pictures: str) -> Generator[float, None, dict[str, Any]]:
    """Score the splats of the open scene again and again; return what went on meanwhile.

    Parameters
    ----------
    blend
        The open file.
    cloud
        A file of splats.
    pictures
        Folder for pictures of the whole screen.

    Yields
    ------
    float
        Seconds to wait.
    """
    extension.enable()
    yield 1.0
    hand, gate = window.Hand(), Gate()
    yield from hand.press("ESC")  # the splash screen
    yield from hand.open_tab()
    found: dict[str, Any] = {"before": record()}

    gate.opened.set()
    yield from hand.click("refine.score(")
    yield from window.until(lambda: gate.idle() and record(), "it is over")
    found["scored"] = record()
    yield from hand.move(hand.area.x + 50, hand.area.y + 50)  # away from that button
    yield 0.5

    gate.opened.clear()
    yield from hand.click("refine.score(")
    yield from window.until(gate.held, "it is held back")
    found |= yield from meanwhile(hand, gate, blend)
    yield from window.picture(pictures, "alive-1-meanwhile")
    begun = time.monotonic()
    yield from hand.press("ESC")
    yield from window.until(gate.idle, "it is cancelled")
    found["esc_s"], found["stopped"] = time.monotonic() - begun, record()
    yield from window.picture(pictures, "alive-2-stopped")
    yield from hand.undo()
    yield from window.until(lambda: not record(), "the scores are gone")

    with scoring(hand.window, gate):
        yield from window.until(gate.held, "it is held back")
        bpy.ops.object.delete()
        yield 1.0
        found["deleted"] = [gate.idle(), bpy.ops.refine.import_ply.poll()]
        yield from window.picture(pictures, "alive-3-deleted")
    yield from load(blend)
    hand = window.Hand()

    found["ended by"] = {}
    for how in (load, close_window, disable):
        with scoring(hand.window, gate):
            yield from window.until(gate.held, "it is held back")
            yield from how(blend)
            yield 0.5
            found["ended by"][how.__name__] = [gate.idle(), gate.threads()]
        hand = window.Hand()
    extension.enable()
    gate = Gate()
    found["imported"] = yield from imported(hand, gate, cloud)
    with scoring(hand.window, gate):
        yield 1.0
    return found  # and Blender is quit, while it scores


def meanwhile(hand: window.Hand, gate: Gate, blend: str) -> Generator[float, None, dict[str, Any]]:
    """Do while splats are scored what the window is to allow."""
    view, draws = hand.area.spaces.active.region_3d, Draws()
    for _ in range(STRETCHES):  # at first the view is still drawn for what came before
        draws.clear()
        yield from window.until(lambda: draws.counts["panel"] > 1, "the bar is drawn")
        if not draws.counts["view"]:
            break
    drawn = draws.stop()
    turned, far = view.view_rotation.copy(), view.view_distance
    yield from orbit(hand)
    saved = Path(blend).stat().st_mtime_ns
    yield from hand.undo()
    yield 0.5
    undone = record()
    yield from hand.press("Z", ctrl=True, shift=True)
    yield 0.5
    redone = record()
    yield from hand.press("S", ctrl=True)
    yield 0.5
    return {
        "drawn": drawn,
        "orbited": view.view_rotation.rotation_difference(turned).angle,
        "zoomed": view.view_distance / far,
        "saved": Path(blend).stat().st_mtime_ns != saved,
        "undone": [undone, redone],
        "apply": bpy.ops.refine.apply.poll(),
        "still": gate.held(),
    }


def orbit(hand: window.Hand) -> Generator[float, None, None]:
    """Drag with the middle button over the 3D view, and turn the wheel."""
    x, y = hand.area.x + hand.area.width // 3, hand.area.y + hand.area.height // 2
    yield from hand.move(x, y)
    hand.window.event_simulate(type="MIDDLEMOUSE", value="PRESS", **hand.at)
    for step in range(8):
        yield from hand.move(x + 15 * step, y)
    hand.window.event_simulate(type="MIDDLEMOUSE", value="RELEASE", **hand.at)
    yield 0.3
    hand.window.event_simulate(type="WHEELUPMOUSE", value="PRESS", **hand.at)
    yield 0.5


def load(blend: str) -> Generator[float, None, None]:
    """Open a file."""
    bpy.ops.wm.open_mainfile(filepath=blend)
    yield 1.0


def close_window(_blend: str) -> Generator[float, None, None]:
    """Close the window that the operator was started in; there is another one."""
    windows = bpy.context.window_manager.windows
    with bpy.context.temp_override(window=windows[-1]):
        bpy.ops.wm.window_close()
    yield 1.0


def disable(_blend: str) -> Generator[float, None, None]:
    """Switch the extension off."""
    extension.disable()
    yield 1.0


@contextmanager
def scoring(first: bpy.types.Window, gate: Gate) -> Iterator[None]:
    """Start scoring in a window of its own; leave nothing behind if it goes on."""
    gate.opened.clear()
    with bpy.context.temp_override(window=first):
        bpy.ops.wm.window_new()
    new = bpy.context.window_manager.windows[-1]
    area = next(area for area in new.screen.areas if area.type == "VIEW_3D")
    with bpy.context.temp_override(window=new, area=area, region=area.regions[-1]):
        bpy.context.view_layer.objects.active = bpy.data.objects[NAME]
        bpy.ops.refine.score("INVOKE_DEFAULT")
    yield


def imported(hand: window.Hand, gate: Gate, cloud: str) -> Generator[float, None, int]:
    """Import a file as after it was dropped: a dialog, then a thread; return its splats."""
    region = next(region for region in hand.area.regions if region.type == "WINDOW")
    before = len(bpy.data.objects)
    yield from hand.move(hand.area.x + 300, hand.area.y + 300)
    with bpy.context.temp_override(window=hand.window, area=hand.area, region=region):
        bpy.ops.refine.import_ply("INVOKE_DEFAULT", filepath=cloud)
    yield 1.0
    yield from hand.press("RET")
    yield from window.until(lambda: len(bpy.data.objects) > before, "it is imported")
    yield from window.until(gate.idle, "it is over")
    return len(hand.window.view_layer.objects.active.data.vertices)


def record() -> str | None:
    """Return by what the splats were scored."""
    noted = bpy.data.objects[NAME].data.get("refine_scores")
    scores = importlib.import_module(f"{extension.MODULE}.mesh.scores")
    found = scores.record(bpy.data.objects[NAME].data) if noted else None
    return found and found["method"]


class Gate:
    """Holds back scoring until it is opened."""

    def __init__(self) -> None:
        self.running = importlib.import_module(f"{extension.MODULE}.ui.operator_bases")
        scoring = importlib.import_module(f"{extension.MODULE}.ui.operators")
        work = importlib.import_module(f"{extension.MODULE}.core.execute")
        self.opened, score = threading.Event(), scoring.score
        self.waits = False

        def held(splats: Any, views: Any, method: Any, *, progress: Any, **options: Any) -> Any:
            step = 0
            try:
                while not self.opened.wait(0.05):
                    self.waits = True
                    step += 1
                    work.report(progress, min(0.2 + 0.0005 * step, 0.9), "looking")
            finally:
                self.waits = False
            return score(splats, views, method, progress=progress, **options)

        scoring.score = held

    def held(self) -> bool:
        """Tell whether scoring is held back."""
        return self.waits

    def idle(self) -> bool:
        """Tell whether nothing works."""
        return self.running.now() is None

    def threads(self) -> int:
        """Return how many threads of operators there are."""
        return sum(thread.name == "refine" for thread in threading.enumerate())


class Draws:
    """Counts how often the 3D view and its panel are drawn."""

    def __init__(self) -> None:
        self.counts = {"view": 0, "panel": 0}
        self.panel = bpy.types.REFINE_PT_prune
        self.plain = plain = self.panel.draw

        def draw(panel: bpy.types.Panel, context: bpy.types.Context) -> None:
            self.counts["panel"] += 1
            plain(panel, context)

        self.panel.draw = draw
        space = bpy.types.SpaceView3D
        self.handle = space.draw_handler_add(self._view, (), "WINDOW", "POST_PIXEL")

    def _view(self) -> None:
        self.counts["view"] += 1

    def clear(self) -> None:
        """Begin to count."""
        self.counts.update(view=0, panel=0)

    def stop(self) -> dict[str, int]:
        """Return the counts, and count no more."""
        bpy.types.SpaceView3D.draw_handler_remove(self.handle, "WINDOW")
        self.panel.draw = self.plain
        return dict(self.counts)
