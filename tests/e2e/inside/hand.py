"""A person at the window: mouse and keys, what the 3D view draws, pictures of the screen."""

from __future__ import annotations

import subprocess
import time
from contextlib import suppress
from itertools import pairwise

import bpy
import extension
import numpy as np

TAB = "REFINE"
IMAGE = "Render with Splats"

# Seconds: for Blender to take in an event and draw, and for an operator to end.
A_MOMENT, PATIENCE = 0.05, 60.0

STEP = 8  # pixels; a button is 20 high or more: the mouse comes to it, and then moves on it


def begin(pictures, cloud="", cameras=""):
    """Enable the extension; return a hand, beside splats that a camera looks at if asked."""
    extension.enable()
    yield 1.0
    hand = Hand(pictures)
    yield from hand.press("ESC")  # the splash screen
    if cloud:
        bpy.data.batch_remove(bpy.data.objects)
        extension.select(hand.bring_in(cloud, cameras))
    return hand


def begin_large(pictures):
    """Begin in a 3D view as large as the window, with nothing in it and our tab open."""
    hand = yield from begin(pictures)
    bpy.data.batch_remove(bpy.data.objects)
    hand.call(bpy.ops.screen.screen_full_area)
    yield 1.0
    hand.space.show_gizmo = False
    yield from hand.open_tab()
    return hand


def until(is_so, what):
    """Wait for something to become so, `PATIENCE` at most."""
    for _ in range(int(PATIENCE / A_MOMENT)):
        if is_so():
            return
        yield A_MOMENT
    raise TimeoutError(f"after {PATIENCE} s it is still not so that {what}")


def at_work():
    """Tell whether an operator works on a thread."""
    return extension.module("ui.operator_bases").now() is not None


def rendering():
    """Tell whether a render is under way."""
    return bpy.app.is_job_running("RENDER") or any("refine_render" in s for s in bpy.data.scenes)


def save(image, path):
    """Write the pixels of an image as they are, the top row first."""
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    np.save(path, values.reshape(image.size[1], image.size[0], 4)[::-1])


def price(obj):
    """Return what the panel says of the budget: its sentence, its chart, its marks."""
    ui, settings = extension.module("ui"), bpy.context.scene.refine
    plan = ui.plans.stored(obj, settings)
    return {
        "ratio": settings.to_budget().ratio,
        "sentence": ui.plans.sentence(plan) if plan else "",
        "marked": sum(mark.value for mark in obj.data.attributes["refine_remove"].data),
        "chart": ui.images.icon("chart") > 0,
        "images": len([image for image in bpy.data.images if image.users]),
    }


def mask(obj):
    """Return which splats are selected."""
    return np.array(extension.module("mesh.selection").selected(obj))


class Hand:
    """Mouse and keyboard over the 3D view of the first window; pictures go into a folder."""

    def __init__(self, pictures):
        self.pictures = pictures
        self.area.spaces.active.show_region_ui = True
        self.at = {"x": 5, "y": 300}

    @property
    def window(self):
        """The window, also after another file was opened."""
        return bpy.context.window_manager.windows[0]

    @property
    def area(self):
        """The 3D view."""
        return next(area for area in self.window.screen.areas if area.type == "VIEW_3D")

    @property
    def space(self):
        """What the view shows, and how."""
        return self.area.spaces.active

    @property
    def draw(self):
        """The module that draws splats."""
        return extension.module("viewport.draw")

    def region(self, kind="WINDOW"):
        """Return the view itself, or its sidebar (UI)."""
        return next(region for region in self.area.regions if region.type == kind)

    def call(self, operator, *how, kind="WINDOW", **values):
        """Call an operator in the view, or in its sidebar."""
        place = {"window": self.window, "area": self.area, "region": self.region(kind)}
        with bpy.context.temp_override(**place):
            return operator(*how, **values)

    def bring_in(self, cloud, cameras):
        """Import splats, and cameras to look through; return the object."""
        self.call(bpy.ops.refine.import_ply, filepath=cloud)
        splats = bpy.context.object
        if cameras:
            self.call(bpy.ops.refine.import_cameras, filepath=cameras)
            self.call(bpy.ops.view3d.view_camera)
        bpy.context.view_layer.objects.active = splats
        return splats

    def do(self, operator, **values):
        """Call an operator in the view, as a step that can be undone."""
        self.call(operator, "EXEC_DEFAULT", True, **values)

    def plain(self):
        """Leave nothing in the view but what it shows, on black."""
        space = self.space
        space.overlay.show_overlays = space.show_gizmo = space.show_region_hud = False
        space.show_region_header = space.show_region_toolbar = space.show_region_ui = False
        space.shading.background_type, space.shading.background_color = "VIEWPORT", (0, 0, 0)
        if bpy.context.scene.camera:
            bpy.context.scene.camera.data.show_passepartout = False

    def numbers(self):
        """Return where the view looks from, and where it lies on the screen."""
        view, region = self.space.region_3d, self.region()
        return {
            "view": [list(row) for row in view.view_matrix],
            "window": [list(row) for row in view.window_matrix],
            "left": region.x,
            "top": self.window.height - region.y - region.height,
            "size": [region.width, region.height],
        }

    def settle(self):
        """Wait until the view shows all it is to show; return how many splats."""
        end = time.monotonic() + PATIENCE
        self.area.tag_redraw()
        yield 0.5
        while not self.draw.drawn(self.region()) or not self.draw.complete():
            if time.monotonic() > end:
                raise TimeoutError(f"the view is not complete: {self.draw.failure()}")
            yield 0.1
        return self.draw.drawn(self.region())

    def picture(self, name, seconds=2):
        """Save what the X server shows; Blender's own screenshot is black with this driver.

        Before it, let Blender draw: panels glide to their places and shaders are compiled.
        """
        for _ in range(seconds):
            for area in self.window.screen.areas:
                area.tag_redraw()
            yield 1.0
        target = f"{self.pictures}/{name}.png"
        subprocess.run(["import", "-window", "root", target], check=True)

    def shown(self, name):
        """Save what the screen shows once all splats are drawn; return how many."""
        count = yield from self.settle()
        yield 0.2
        yield from self.picture(name, 0)
        return count

    def event(self, kind, value="PRESS", **more):
        """Tell Blender of an event where the mouse is, and leave it a moment."""
        self.window.event_simulate(type=kind, value=value, **self.at, **more)
        yield A_MOMENT

    def press(self, key, *, unicode=None, **held):
        """Press and release a key or a button of the mouse; a key that types needs its text."""
        yield from self.event(key, unicode=unicode, **held)
        yield from self.event(key, "RELEASE", **held)

    def move(self, x, y):
        """Bring the mouse to a pixel of the window, y from the bottom."""
        self.at = {"x": x, "y": y}
        yield from self.event("MOUSEMOVE", "NOTHING")

    def over(self):
        """Bring the mouse over the view, beside the panel; return where."""
        region = self.region()
        yield from self.move(region.x + region.width // 3, region.y + region.height // 2)
        return self.at["x"], self.at["y"]

    def undo(self, *, redo=False):
        """Press Ctrl+Z over the view, or Ctrl+Shift+Z."""
        yield from self.over()
        yield from self.press("Z", ctrl=True, shift=redo)
        yield 0.5

    def open_tab(self):
        """Click down the sidebar's column of tabs until ours is open."""
        self.space.show_region_ui = True
        yield 0.5
        region = self.region("UI")
        for y in range(region.y + region.height - STEP, region.y, -2 * STEP):
            yield from self.move(region.x + region.width - 12, y)
            yield from self.press("LEFTMOUSE")
            if region.active_panel_category == TAB:
                yield 0.5
                return
        raise LookupError(f"the sidebar of the 3D view has no tab {TAB}")

    def click(self, call):
        """Click the button whose Python call begins like this, found by asking everywhere."""
        region = self.region("UI")
        for share in (0.5, 0.25, 0.75):  # buttons side by side leave the middle free
            x = region.x + int(share * (region.width - 24))
            for y in range(region.y + region.height - STEP, region.y, -STEP):
                yield from self.move(x, y)
                if self.button().startswith(f"bpy.ops.{call}"):
                    yield from self.press("LEFTMOUSE")
                    return
        raise LookupError(f"the tab {TAB} has no button for {call}")

    def button(self):
        """Return the Python call of the button under the mouse, empty where there is none."""
        manager, copy = bpy.context.window_manager, bpy.ops.ui.copy_python_command_button
        manager.clipboard = ""
        with suppress(RuntimeError):  # there is none
            self.call(copy, kind="UI")
        return manager.clipboard

    def scroll(self, *, down):
        """Turn the wheel over the sidebar as far as it goes."""
        region = self.region("UI")
        yield from self.move(region.x + region.width // 2, region.y + region.height // 2)
        for _ in range(40):
            yield from self.event("WHEELDOWNMOUSE" if down else "WHEELUPMOUSE")

    def drag(self, tool, *places, **held):
        """Draw with a tool over places of the view, shares of its size; return what it selected."""
        self.call(bpy.ops.wm.tool_set_by_id, name=f"refine.select_{tool}")
        region = self.region()
        spots = [
            (region.x + int(x * region.width), region.y + int(y * region.height)) for x, y in places
        ]
        yield from self.move(*spots[0])
        yield 0.2
        yield from self.event("LEFTMOUSE", **held)
        for start, end in pairwise(spots):
            for share in (0.5, 1.0):
                spot = (round(a + share * (b - a)) for a, b in zip(start, end, strict=True))
                yield from self.move(*spot)
        yield from self.event("LEFTMOUSE", "RELEASE", **held)
        yield from until(lambda: not self.window.modal_operators, "the tool is done")
        return mask(bpy.context.object)
