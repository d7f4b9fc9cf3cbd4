"""Use the panel as a person does: its tab, *Score*, a slider, *Apply*, Ctrl+Z."""

from __future__ import annotations

import importlib
import subprocess
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import bpy
import extension

TAB = "REFINE"

# Seconds: for Blender to take in an event and draw, and for an operator to end.
A_MOMENT = 0.05
PATIENCE = 60.0

# Pixels. A button is 20 high or more: the mouse comes to it, and then moves on it.
STEP = 8


def main(name: str, pictures: str) -> Generator[float, None, dict[str, Any]]:
    """Prune the open scene by hand; return what was there before, between and after.

    Parameters
    ----------
    name
        The active object, splats.
    pictures
        Folder for a picture of the whole screen after each stage.

    Yields
    ------
    float
        Seconds to wait.
    """
    extension.enable()
    yield 1.0
    hand = Hand()
    yield from hand.press("ESC")  # the splash screen
    yield from hand.open_tab()
    yield from picture(pictures, "1-opened")
    found = {"opened": state(name)}

    yield from hand.click("refine.score(")
    yield from until(lambda: state(name)["scored"] and not at_work(), "there are scores")
    found["scored"] = state(name)

    yield from hand.scroll(down=True)
    yield from picture(pictures, "2-scored")
    found["priced"] = price(name)
    yield from hand.slide("refine.percent", 60)
    yield from until(lambda: price(name)["rested"], "marks follow")
    yield from picture(pictures, "2-slid")
    found["slid"] = price(name)
    bpy.context.scene.refine.percent = 50.0

    bpy.data.objects[name].location.x += 0.1
    yield from picture(pictures, "3-moved")  # the scores are older than that, says the panel

    yield from hand.click("refine.apply(")
    yield from until(lambda: state(name) != found["scored"], "splats are removed")
    yield from picture(pictures, "4-applied")
    found["applied"] = state(name)

    yield from hand.undo()
    yield from until(lambda: state(name) != found["applied"], "they are back")
    yield from picture(pictures, "5-undone")
    found["undone"] = state(name)
    return found


def state(name: str) -> dict[str, Any]:
    """Return what the panel's buttons are to change; by name, as undo replaces the object."""
    mesh = bpy.data.objects[name].data
    return {"vertices": len(mesh.vertices), "scored": "refine_score" in mesh.attributes}


def at_work() -> bool:
    """Tell whether an operator works on a thread."""
    return importlib.import_module(f"{extension.MODULE}.ui.operator_bases").now() is not None


def price(name: str) -> dict[str, Any]:
    """Return what the panel says of the budget: its slider, its sentence, its chart, its marks."""
    ui = importlib.import_module(f"{extension.MODULE}.ui")
    obj, settings = bpy.data.objects[name], bpy.context.scene.refine
    plan = ui.plans.stored(obj, settings)
    marks = obj.data.attributes["refine_remove"].data
    return {
        "percent": settings.percent,
        "ratio": settings.to_budget().ratio,
        "sentence": ui.plans.sentence(plan) if plan else "",
        "rested": bool(plan),
        "marked": sum(mark.value for mark in marks),
        "chart": ui.images.icon("chart") > 0,
        "images": len([image for image in bpy.data.images if image.users]),
    }


def picture(folder: str, name: str, settle: float = 2.0) -> Generator[float, None, None]:
    """Save what the X server shows; Blender's own screenshot is black with this driver.

    Before it, let Blender draw for ``settle`` seconds: panels glide to their places and shaders
    are compiled, slowly where the processor does it.
    """
    for _ in range(int(settle)):
        for area in bpy.context.window_manager.windows[0].screen.areas:
            area.tag_redraw()
        yield 1.0
    target = Path(folder) / f"{name}.png"
    subprocess.run(["import", "-window", "root", target], check=True)


def until(is_so: Callable[[], bool], what: str) -> Generator[float, None, None]:
    """Wait for something to become so.

    Raises
    ------
    TimeoutError
        If it does not within `PATIENCE`.
    """
    for _ in range(int(PATIENCE / A_MOMENT)):
        if is_so():
            return
        yield A_MOMENT
    raise TimeoutError(f"after {PATIENCE} s it is still not so that {what}")


class Hand:
    """Mouse and keyboard over the sidebar of the window's 3D view."""

    def __init__(self) -> None:
        self.window = bpy.context.window_manager.windows[0]
        areas = self.window.screen.areas
        self.area = next(area for area in areas if area.type == "VIEW_3D")
        self.area.spaces.active.show_region_ui = True
        self.at = {"x": 0, "y": 0}

    @property
    def sidebar(self) -> bpy.types.Region:
        """The sidebar, as it is now."""
        return next(region for region in self.area.regions if region.type == "UI")

    def press(
        self, key: str, *, unicode: str | None = None, **modifiers: bool
    ) -> Generator[float, None, None]:
        """Press and release a key or a button of the mouse; a key that types needs its text."""
        for value, text in (("PRESS", unicode), ("RELEASE", None)):
            self.window.event_simulate(type=key, value=value, unicode=text, **self.at, **modifiers)
            yield A_MOMENT

    def move(self, x: int, y: int) -> Generator[float, None, None]:
        """Bring the mouse to a pixel of the window, y from the bottom."""
        self.at = {"x": x, "y": y}
        self.window.event_simulate(type="MOUSEMOVE", value="NOTHING", **self.at)
        yield A_MOMENT

    def open_tab(self) -> Generator[float, None, None]:
        """Click down the sidebar's column of tabs until ours is open.

        Raises
        ------
        LookupError
            If there is no such tab.
        """
        yield 0.5
        region = self.sidebar
        for y in range(region.y + region.height - STEP, region.y, -2 * STEP):
            yield from self.move(region.x + region.width - 12, y)
            yield from self.press("LEFTMOUSE")
            if region.active_panel_category == TAB:
                yield 0.5
                return
        raise LookupError(f"the sidebar of the 3D view has no tab {TAB}")

    def click(self, call: str) -> Generator[float, None, None]:
        """Click the button whose Python call begins like this, found by asking everywhere.

        Raises
        ------
        LookupError
            If the sidebar shows no such button.
        """
        region = self.sidebar
        # Buttons side by side leave the middle free.
        for share in (0.5, 0.25, 0.75):
            x = region.x + int(share * (region.width - 24))
            for y in range(region.y + region.height - STEP, region.y, -STEP):
                yield from self.move(x, y)
                if self.button().startswith(f"bpy.ops.{call}"):
                    yield from self.press("LEFTMOUSE")
                    return
        raise LookupError(f"the tab {TAB} has no button for {call}")

    def scroll(self, *, down: bool) -> Generator[float, None, None]:
        """Turn the wheel over the sidebar as far as it goes."""
        region = self.sidebar
        yield from self.move(region.x + region.width // 2, region.y + region.height // 2)
        kind = "WHEELDOWNMOUSE" if down else "WHEELUPMOUSE"
        for _ in range(40):
            self.window.event_simulate(type=kind, value="PRESS", **self.at)
            yield A_MOMENT

    def slide(self, path: str, pixels: int) -> Generator[float, None, None]:
        """Drag the slider of a property to the right.

        Raises
        ------
        LookupError
            If the sidebar shows no such slider.
        """
        region = self.sidebar
        x = region.x + int(0.6 * region.width)
        for y in range(region.y + region.height - STEP, region.y, -STEP):
            yield from self.move(x, y)
            if self.copied(bpy.ops.ui.copy_data_path_button).endswith(path):
                self.window.event_simulate(type="LEFTMOUSE", value="PRESS", **self.at)
                yield A_MOMENT
                for moved in range(0, pixels, 5):
                    yield from self.move(x + moved, y)
                self.window.event_simulate(type="LEFTMOUSE", value="RELEASE", **self.at)
                yield A_MOMENT
                return
        raise LookupError(f"the tab {TAB} has no slider for {path}")

    def button(self) -> str:
        """Return the Python call of the button under the mouse, empty where there is none."""
        return self.copied(bpy.ops.ui.copy_python_command_button)

    def copied(self, operator: Any) -> str:
        """Return what an operator copies of the button under the mouse, empty if nothing."""
        manager = bpy.context.window_manager
        manager.clipboard = ""
        with bpy.context.temp_override(window=self.window, area=self.area, region=self.sidebar):
            if operator.poll():
                operator()
        return manager.clipboard

    def undo(self) -> Generator[float, None, None]:
        """Press Ctrl+Z over the 3D view."""
        yield from self.move(self.area.x + self.area.width // 2, self.area.y + 100)
        yield from self.press("Z", ctrl=True)
