"""Look at splats in the 3D view: imported, through a camera, in every mode; then without."""

from __future__ import annotations

import importlib
import subprocess
import time
from collections.abc import Generator
from typing import Any

import bpy
import extension

PATIENCE = 60.0  # seconds


def main(cloud: str, cameras: str, picture: str, blend: str) -> Generator[float, None, dict]:
    """Import a scene and show it; return what was drawn and what is left of it.

    Parameters
    ----------
    cloud, cameras
        Files of splats and cameras.
    picture
        Where pictures of the whole screen go, with ``{}`` for the mode.
    blend
        Where to save the scene while splats are drawn.

    Yields
    ------
    float
        Seconds to wait.
    """
    extension.enable()
    yield 1.0
    show = Show(picture)
    show.window.event_simulate(type="ESC", value="PRESS", x=5, y=300)  # the splash screen
    bpy.data.batch_remove(bpy.data.objects)
    show.call(bpy.ops.refine.import_ply, filepath=cloud)
    show.call(bpy.ops.refine.import_cameras, filepath=cameras)
    found: dict[str, Any] = {"after import": show.draw.mode()}
    show.call(bpy.ops.view3d.view_camera)
    plain(show.area.spaces.active)
    found["SCENE"] = yield from show.picture("SCENE")
    found["camera"] = show.numbers()

    bpy.context.view_layer.objects.active = bpy.data.objects["point_cloud"]
    bpy.context.scene.refine.method = "closed-form"
    show.call(bpy.ops.refine.score)
    for mode in ("HEAT", "STAYS", "GOES"):
        show.call(bpy.ops.refine.view, mode=mode)
        found[mode] = yield from show.picture(mode)
    found |= yield from handle(show)

    found["stored"] = bpy.data.objects["renamed"].display_type
    show.call(bpy.ops.wm.save_as_mainfile, filepath=blend, copy=True)
    bpy.ops.wm.open_mainfile(filepath=blend)
    yield 1.0
    found["still on"], found["failure"] = show.draw.mode(), show.draw.failure()
    found["handlers"] = [handlers()]
    extension.disable()
    found["handlers"].append(handlers())
    graph = bpy.context.window_manager.windows[0].view_layer.depsgraph
    found["shown as"] = bpy.data.objects["renamed"].evaluated_get(graph).display_type
    return found


def handle(show: Show) -> Generator[float, None, dict[str, int]]:
    """Do to an object what may happen to it while it is drawn; none of it may raise."""
    splats, found = bpy.context.object, {}
    show.call(bpy.ops.object.mode_set, mode="EDIT")
    yield 0.3
    show.call(bpy.ops.object.mode_set, mode="OBJECT")
    splats.name, splats.scale = "renamed", (1.0, 2.0, 0.5)
    copy = splats.copy()
    bpy.context.scene.collection.objects.link(copy)
    show.call(bpy.ops.refine.view, mode="SCENE")
    found["two"] = yield from show.settle()
    copy.hide_set(True)
    found["one hidden"] = yield from show.settle()
    show.call(bpy.ops.ed.undo_push, message="before")
    bpy.data.objects.remove(splats)
    show.call(bpy.ops.ed.undo_push, message="removed")
    yield 0.3
    show.call(bpy.ops.ed.undo)
    found["undone"] = yield from show.settle()
    return found


def handlers() -> int:
    """Return how many handlers of the drawing Blender calls after updates."""
    modules = [handler.__module__ for handler in bpy.app.handlers.depsgraph_update_post]
    return modules.count(f"{extension.MODULE}.viewport.draw")


class Show:
    """The window's 3D view, and what the extension draws in it."""

    def __init__(self, pictures: str) -> None:
        self.draw = importlib.import_module(f"{extension.MODULE}.viewport.draw")
        self.window = bpy.context.window_manager.windows[0]
        self.area = next(a for a in self.window.screen.areas if a.type == "VIEW_3D")
        self.region = next(r for r in self.area.regions if r.type == "WINDOW")
        self.pictures = pictures

    def call(self, operator: Any, **values: Any) -> None:
        """Call an operator in the view."""
        with bpy.context.temp_override(window=self.window, area=self.area, region=self.region):
            operator(**values)

    def settle(self) -> Generator[float, None, int]:
        """Wait until the view shows all it is to show; return how many splats.

        Raises
        ------
        TimeoutError
            If it does not within `PATIENCE`.
        """
        end = time.monotonic() + PATIENCE
        self.area.tag_redraw()
        yield 0.5
        while not self.draw.drawn(self.region) or not self.draw.complete():
            if time.monotonic() > end:
                raise TimeoutError(
                    f"after {PATIENCE} s the view is not complete: {self.draw.failure()}"
                )
            yield 0.1
        return self.draw.drawn(self.region)

    def picture(self, mode: str) -> Generator[float, None, int]:
        """Save what the screen shows once it is complete."""
        count = yield from self.settle()
        yield 0.2
        subprocess.run(["import", "-window", "root", self.pictures.format(mode)], check=True)
        return count

    def numbers(self) -> dict[str, Any]:
        """Return where the view looks from, and where it lies on the screen."""
        view, region = self.area.spaces.active.region_3d, self.region
        return {
            "view": [list(row) for row in view.view_matrix],
            "window": [list(row) for row in view.window_matrix],
            "left": region.x,
            "top": self.window.height - region.y - region.height,
            "size": [region.width, region.height],
        }


def plain(space: bpy.types.SpaceView3D) -> None:
    """Leave nothing in a view but what it shows, on black."""
    space.overlay.show_overlays = space.show_gizmo = False
    space.show_region_header = space.show_region_toolbar = space.show_region_ui = False
    space.shading.background_type, space.shading.background_color = "VIEWPORT", (0.0, 0.0, 0.0)
    bpy.context.scene.camera.data.show_passepartout = False
