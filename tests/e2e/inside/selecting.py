"""Select splats in a window with every tool: by mouse and keys, as one sees them."""

from __future__ import annotations

import importlib
from collections.abc import Generator
from itertools import pairwise
from typing import Any

import bpy
import extension
import numpy as np
from view import Show, plain
from window import Hand, until

NAME = "point_cloud"
BOX = (0.3, 0.3), (0.6, 0.7)
"""Two corners over the view, as shares of its width and height."""


def main(cloud: str, cameras: str, blend: str, pictures: str) -> Generator[float, None, dict]:
    """Select by each tool through a camera; return how many splats each took, and what follows.

    Parameters
    ----------
    cloud, cameras
        Files of splats and cameras.
    blend
        Where the scene is saved.
    pictures
        Folder for pictures of the whole screen.

    Yields
    ------
    float
        Seconds to wait.
    """
    extension.enable()
    yield 1.0
    hand = Tools()
    yield from hand.press("ESC")  # the splash screen
    bpy.data.batch_remove(bpy.data.objects)
    show = Show(pictures + "/{}.png")
    show.call(bpy.ops.refine.import_ply, filepath=cloud)
    show.call(bpy.ops.refine.import_cameras, filepath=cameras)
    show.call(bpy.ops.view3d.view_camera)
    plain(show.area.spaces.active)
    show.area.spaces.active.show_region_toolbar = True
    splats = bpy.data.objects[NAME]
    bpy.context.view_layer.objects.active = splats
    splats.select_set(True)
    thin(splats)
    yield from show.settle()
    show.call(bpy.ops.ed.undo_push, message="imported")
    found: dict[str, Any] = {"imported": count()}

    found["box"] = yield from hand.drag("box", *BOX)
    box = mask()
    found["drawn"] = show.draw.drawn(show.region)
    found["undone"] = yield from hand.undone()
    settings = bpy.context.scene.refine
    settings.select_hidden = True
    found["through"] = yield from hand.drag("box", *BOX)
    found["box is part"] = not (box & ~mask()).any()
    settings.select_hidden = False

    found |= yield from shapes(hand, box, show)
    found |= yield from keys(hand, show)
    found |= yield from in_edit_mode(hand, show)
    yield from hand.drag("box", *BOX)
    show.call(bpy.ops.wm.save_as_mainfile, filepath=blend)
    bpy.ops.wm.open_mainfile(filepath=blend)
    yield 1.0
    found["reopened"] = count()
    found["failure"] = show.draw.failure()
    return found


def shapes(hand: Tools, box: np.ndarray, show: Show) -> Generator[float, None, dict[str, Any]]:
    """Use the other tools, and the keys that combine; return what they took."""
    found: dict[str, Any] = {}
    found["lasso"] = yield from hand.drag("lasso", BOX[0], (0.6, 0.3), BOX[1], (0.3, 0.7))
    found["lasso is box"] = int((mask() ^ box).sum())
    found["brush"] = yield from hand.drag("brush", (0.3, 0.5), (0.6, 0.5))
    brush = mask()
    yield from show.picture("select-2-brush")
    found["radii"] = []
    for key in ("RIGHT_BRACKET", "LEFT_BRACKET"):
        yield from hand.press(key)
        yield 0.3
        found["radii"].append(round(bpy.context.scene.refine.select_radius, 3))
    found["added"] = yield from hand.drag("box", *BOX, shift=True)
    found["added is both"] = bool((mask() == (box | brush)).all())
    found["subtracted"] = yield from hand.drag("brush", (0.3, 0.5), (0.6, 0.5), ctrl=True)
    found["subtracted is rest"] = bool((mask() == (box & ~brush)).all())
    yield from hand.drag("box", *BOX)
    yield from hand.drag("brush", (0.3, 0.5), (0.6, 0.5), shift=True, ctrl=True)
    found["intersected is both"] = bool((mask() == (box & brush)).all())
    found["sphere"] = yield from hand.drag("sphere", (0.5, 0.5), (0.6, 0.5))
    found["color"] = yield from hand.drag("color", (0.5, 0.5), (0.5, 0.5))
    bpy.context.scene.refine.select_connected = True
    found["piece"] = yield from hand.drag("color", (0.5, 0.5), (0.5, 0.5))
    yield from show.picture("select-4-piece")
    return found


def keys(hand: Tools, show: Show) -> Generator[float, None, dict[str, Any]]:
    """Use the keys of a tool, and the panel; return what they did."""
    found: dict[str, Any] = {}
    yield from hand.drag("box", *BOX)
    for name, key, held in (
        ("inverted", "I", {"ctrl": True}),
        ("none", "A", {"alt": True}),
        ("all", "A", {}),
    ):
        yield from hand.press(key, **held)
        yield 0.3
        found[name] = count()
    yield from hand.drag("box", *BOX)
    yield from hand.press("H", shift=True)
    found["isolated"] = yield from show.settle()
    yield from show.picture("select-5-isolated")
    yield from hand.press("H", alt=True)
    yield from show.settle()
    show.area.spaces.active.show_region_ui = True
    yield 0.5
    yield from hand.open_tab()
    yield from hand.move(500, 500)
    show.call(bpy.ops.wm.call_panel, name="REFINE_PT_select", keep_open=True)
    yield from show.picture("select-6-panel")
    yield from hand.press("ESC")
    show.area.spaces.active.show_region_ui = False
    yield 0.5
    yield from show.settle()
    return found


def in_edit_mode(hand: Tools, show: Show) -> Generator[float, None, dict[str, Any]]:
    """Select in edit mode, by the same tool; return what was selected there and afterwards."""
    show.call(bpy.ops.object.mode_set, mode="EDIT")
    yield 1.0
    found = {"edit box": (yield from hand.drag("box", *BOX))}
    yield from show.picture("select-7-edit")
    show.call(bpy.ops.object.mode_set, mode="OBJECT")
    yield from show.settle()
    return found | {"after edit": count()}


def thin(splats: bpy.types.Object) -> None:
    """Delete three of four splats, which leaves 9,939: the test is done sooner."""
    module = importlib.import_module(f"{extension.MODULE}.mesh.selection")
    module.select(splats, np.arange(len(splats.data.vertices)) % 4 != 0)
    bpy.ops.refine.delete(what="SELECTED")


def mask() -> np.ndarray:
    """Return which splats are selected."""
    module = importlib.import_module(f"{extension.MODULE}.mesh.selection")
    return np.array(module.selected(bpy.data.objects[NAME]))


def count() -> int:
    """Return how many splats are selected."""
    return int(mask().sum())


class Tools(Hand):
    """The mouse over the 3D view, with a tool in it."""

    def drag(
        self, tool: str, *places: tuple[float, float], **held: bool
    ) -> Generator[float, None, int]:
        """Draw with a tool over some places of the view; return how many splats are selected."""
        region = next(r for r in self.area.regions if r.type == "WINDOW")
        with bpy.context.temp_override(window=self.window, area=self.area, region=region):
            bpy.ops.wm.tool_set_by_id(name=f"refine.select_{tool}")
        spots = [
            (region.x + int(x * region.width), region.y + int(y * region.height)) for x, y in places
        ]
        yield from self.move(*spots[0])
        yield 0.2
        self.window.event_simulate(type="LEFTMOUSE", value="PRESS", **self.at, **held)
        yield 0.1
        for start, end in pairwise(spots):
            for share in (0.5, 1.0):
                yield from self.move(
                    *(round(a + share * (b - a)) for a, b in zip(start, end, strict=True))
                )
        self.window.event_simulate(type="LEFTMOUSE", value="RELEASE", **self.at, **held)
        yield from until(self.over, "the tool is done")
        return count()

    def over(self) -> bool:
        """Tell whether no tool is at work."""
        return not self.window.modal_operators

    def undone(self) -> Generator[float, None, int]:
        """Press Ctrl+Z; return how many splats are selected."""
        yield from self.undo()
        yield 0.5
        return count()
