"""An artist's whole walk in one window, from dropping the zip to the saved scene."""

from __future__ import annotations

import functools
import threading
from collections.abc import Generator
from typing import Any

import bpy
import extension
import numpy as np
import xserver
from selecting import NAME, Tools, count
from view import Show
from window import at_work, picture, price, until

IMAGE = "Render with Splats"
AROUND = (0.42, 0.33), (0.6, 0.33), (0.6, 0.6), (0.42, 0.6)
"""Where a lasso goes over the view, as shares of its width and height."""


def main(
    archive: str, cloud: str, pictures: str, blend: str
) -> Generator[float, None, dict[str, Any]]:
    """Do it; return what there was after each step.

    Parameters
    ----------
    archive, cloud
        Files to drop: the extension, and splats beside which cameras lie.
    pictures
        Folder for a picture of the whole screen after each step.
    blend
        Where to save the scene.

    Yields
    ------
    float
        Seconds to wait.
    """
    yield 1.0
    walk = Walk(pictures)
    yield from walk.install(archive)
    yield from walk.bring_in(cloud)
    yield from walk.score()
    yield from walk.select()
    yield from walk.crop()
    yield from walk.apply()
    yield from walk.render()
    walk.show.call(bpy.ops.wm.save_as_mainfile, filepath=blend)
    return walk.found


class Walk:
    """The window, and what was found in it."""

    def __init__(self, pictures: str) -> None:
        self.hand, self.pictures = Tools(), pictures
        self.found: dict[str, Any] = {}

    @functools.cached_property
    def show(self) -> Show:
        """The view with what is drawn in it, once the extension is there."""
        return Show(f"{self.pictures}/{{}}.png")

    def look(self, name: str) -> Generator[float, None, None]:
        """Take a picture of the screen for a person."""
        yield from picture(self.pictures, name, 1.0)

    def seen(self, name: str) -> Generator[float, None, None]:
        """Take two pictures: one of the screen, and one of nothing but splats to be compared."""
        yield from self.show.settle()
        yield from self.look(name)
        space = self.show.area.spaces.active
        overlays, gizmos = space.overlay.show_overlays, space.show_gizmo
        space.overlay.show_overlays = space.show_gizmo = False
        yield from self.show.picture(f"only-{name}")
        space.overlay.show_overlays, space.show_gizmo = overlays, gizmos
        self.found[name] = splats()

    def over(self) -> Generator[float, None, None]:
        """Bring the mouse over the view."""
        yield from self.hand.move(*self.middle())

    def middle(self) -> tuple[int, int]:
        """Return a place of the window over the view."""
        region = next(r for r in self.hand.area.regions if r.type == "WINDOW")
        return region.x + region.width // 3, region.y + region.height // 2

    def drop(self, path: str) -> Generator[float, None, None]:
        """Drop a file on the view, as a file manager does."""
        yield from self.over()
        x, y = self.middle()
        raised: list[Exception] = []

        def dropped() -> None:
            try:
                xserver.drop(path, x, self.hand.window.height - y)
            except Exception as error:
                raised.append(error)

        thread = threading.Thread(target=dropped)
        thread.start()
        while thread.is_alive():
            yield 0.1
        if raised:
            raise raised[0]
        yield 0.5

    def install(self, archive: str) -> Generator[float, None, None]:
        """Drop the zip and confirm; delete the cube that would stand in the room."""
        yield from self.hand.press("ESC")  # the splash screen
        yield from self.drop(archive)
        yield from self.look("01-zip")
        yield from self.hand.press("RET")
        yield from until(extension.is_enabled, "it is installed")
        yield 0.5
        yield from self.over()
        yield from self.hand.press("DEL")
        yield 0.5
        yield from self.hand.press("RET")
        yield from self.hand.open_tab()
        yield from self.look("02-installed")
        self.found["cube"] = "Cube" in bpy.data.objects

    def bring_in(self, cloud: str) -> Generator[float, None, None]:
        """Drop splats, which bring the cameras beside them, and look through the first camera."""
        yield from self.drop(cloud)
        yield from self.hand.press("S")  # of the two that import such files, ours
        yield 0.5
        yield from self.look("03-dialog")
        yield from self.hand.press("RET")
        yield from until(lambda: not at_work() and NAME in bpy.data.objects, "it is imported")
        yield from self.show.settle()
        yield from self.look("04-imported")
        yield from self.over()
        yield from self.hand.press("NUMPAD_0")
        space = self.show.area.spaces.active
        space.shading.background_type, space.shading.background_color = "VIEWPORT", (0, 0, 0)
        bpy.context.scene.camera.data.show_passepartout = False
        yield from self.seen("05-camera")
        self.found["numbers"] = self.show.numbers()

    def score(self) -> Generator[float, None, None]:
        """Score, read the price, and look at the heat map."""
        yield from self.hand.click("refine.score(")
        yield 2.0
        yield from self.look("06-scoring")
        yield from until(lambda: not at_work(), "there are scores")
        yield from self.seen("07-scored")
        yield from self.hand.scroll(down=True)
        yield from until(lambda: price(NAME)["rested"] and price(NAME)["chart"], "there is a price")
        yield from self.look("08-priced")
        self.found["priced"] = price(NAME)
        yield from self.hand.scroll(down=False)
        yield from self.hand.click("refine.view(mode='HEAT'")
        yield from self.show.settle()
        yield from self.look("09-heat")
        yield from self.hand.click("refine.view(mode='SCENE'")

    def select(self) -> Generator[float, None, None]:
        """Select with the lasso, delete what is selected, and take that back."""
        self.found["lasso"] = yield from self.hand.drag("lasso", *AROUND)
        yield from self.show.settle()
        yield from self.look("10-selected")
        yield from self.hand.press("DEL")
        yield 0.5
        yield from self.hand.press("A", alt=True)
        yield from self.seen("11-deleted")
        yield from self.hand.undo()
        yield from self.hand.undo()
        yield from until(lambda: splats()["splats"] > self.found["11-deleted"]["splats"], "undone")
        self.found["selected again"] = count()
        yield from self.hand.press("A", alt=True)
        yield from self.seen("12-back")

    def crop(self) -> Generator[float, None, None]:
        """Keep what is in a box that is made smaller by hand, and delete the rest now."""
        self.call(bpy.ops.wm.tool_set_by_id, name="builtin.select_box")
        self.call(bpy.ops.refine.add_volume, role="KEEP", shape="BOX")
        yield from self.over()
        yield from self.hand.press("S")
        for key, text in (("ZERO", "0"), ("PERIOD", "."), ("NINE", "9")):
            yield from self.hand.press(key, unicode=text)
        yield from self.hand.press("RET")
        yield 1.0
        yield from self.over()
        self.show.call(bpy.ops.wm.call_panel, name="REFINE_PT_protect", keep_open=True)
        yield from self.show.settle()
        yield from self.look("13-box")
        region = self.show.region
        yield from self.hand.move(region.x + region.width // 3, region.y + 20)  # out of the box
        yield from self.hand.press("ESC")
        yield 0.5
        self.call(bpy.ops.refine.delete, what="VOLUMES")
        for item in bpy.context.scene.refine.volumes:
            item.object.hide_set(True)
        yield from self.seen("14-cropped")

    def apply(self) -> Generator[float, None, None]:
        """Score again, apply, undo and redo."""
        yield from self.hand.click("refine.score(")
        yield 1.0
        yield from until(lambda: not at_work(), "there are scores")
        yield from self.hand.scroll(down=True)
        yield from self.look("15-scored")
        yield from self.hand.click("refine.apply(")
        before = self.found["14-cropped"]["splats"]
        yield from until(lambda: not at_work() and splats()["splats"] < before, "it is applied")
        yield from self.seen("16-applied")
        yield from self.hand.undo()
        yield from until(lambda: splats()["splats"] == before, "it is undone")
        yield from self.seen("17-undone")
        yield from self.hand.press("Z", ctrl=True, shift=True)
        yield from until(lambda: splats()["splats"] < before, "it is redone")
        yield from self.seen("18-redone")

    def render(self) -> Generator[float, None, None]:
        """Render with splats, by the button."""
        scene = bpy.context.scene
        scene.render.engine = "CYCLES"  # without a graphics card EEVEE compiles for minutes
        scene.cycles.samples, scene.cycles.use_denoising = 1, False
        scene.render.film_transparent = True
        yield from self.hand.scroll(down=True)
        yield from self.hand.click("refine.render(")
        yield from until(lambda: IMAGE in bpy.data.images and not rendering(), "it is rendered")
        yield 1.0
        yield from self.look("19-rendered")
        image = bpy.data.images[IMAGE]
        values = np.empty(len(image.pixels), np.float32)
        image.pixels.foreach_get(values)
        np.save(
            f"{self.pictures}/rendered.npy", values.reshape(image.size[1], image.size[0], 4)[::-1]
        )
        for window in list(bpy.context.window_manager.windows)[1:]:
            with bpy.context.temp_override(window=window):
                bpy.ops.wm.window_close()
        yield 0.5

    def call(self, operator: Any, **values: Any) -> None:
        """Call an operator in the view, as a step that can be undone."""
        show = self.show
        with bpy.context.temp_override(window=show.window, area=show.area, region=show.region):
            operator("EXEC_DEFAULT", True, **values)


def rendering() -> bool:
    """Tell whether a render is under way."""
    return bpy.app.is_job_running("RENDER") or any("refine_render" in s for s in bpy.data.scenes)


def splats() -> dict[str, Any]:
    """Return what there is."""
    scene, mesh = bpy.context.scene, bpy.data.objects[NAME].data
    return {
        "splats": len(mesh.vertices),
        "cameras": sum(obj.type == "CAMERA" for obj in scene.objects),
        "size": [scene.render.resolution_x, scene.render.resolution_y],
    }
