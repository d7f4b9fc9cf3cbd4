"""A newcomer's first minutes: drop, one import, adjust it, score, apply, undo, save, reopen."""

from __future__ import annotations

from collections.abc import Generator
from pathlib import Path
from typing import Any

import bpy
import extension
from view import Show
from window import Hand, at_work, picture, price, until

NAME = "point_cloud"


def main(
    cloud: str, cameras: str, pictures: str, blend: str, asset: str
) -> Generator[float, None, dict[str, Any]]:
    """Do it; return what there was after each step.

    Parameters
    ----------
    cloud, cameras
        Files of splats and cameras, side by side.
    pictures
        Folder for a picture of the whole screen after each step.
    blend, asset
        Where to save the scene, and to export the splats.

    Yields
    ------
    float
        Seconds to wait.
    """
    extension.enable()
    yield 1.0
    hand = Hand()
    yield from hand.press("ESC")  # the splash screen
    show = Show(f"{pictures}/{{}}.png")
    yield from hand.open_tab()
    yield from hand.move(500, 500)
    found: dict[str, Any] = {}

    yield from bring_in(show, hand, found, (cloud, cameras))
    yield from prune(show, hand, found)
    show = yield from reopen(show, found, blend)
    show.call(bpy.ops.refine.export_ply, filepath=asset)
    found["exported"] = Path(asset).stat().st_size
    return found


def bring_in(
    show: Show, hand: Hand, found: dict[str, Any], files: tuple[str, str]
) -> Generator[float, None, None]:
    """Drop splats, which bring the cameras beside them, then cameras; adjust, take these back."""
    drop(show, files[0])
    yield 0.5
    yield from hand.press("S")  # of the two that import such files, ours
    yield from picture(str(Path(show.pictures).parent), "first-1-dialogue", 1.0)
    yield from hand.press("RET")
    yield from until(lambda: not at_work() and NAME in bpy.data.objects, "it is imported")
    yield from show.settle()
    yield from picture(str(Path(show.pictures).parent), "first-2-imported", 1.0)
    found["imported"] = scene()
    for upright in (True, False):
        yield from adjust(hand, {"upright": upright})
        found[f"upright {upright}"] = scene()

    yield from hand.move(500, 500)
    drop(show, files[1])
    yield 0.5
    yield from hand.press("RET")
    wanted = found["imported"]["cameras"] + 1
    yield from until(lambda: not at_work() and scene()["cameras"] >= wanted, "they are imported")
    yield 0.5
    found["dropped"] = scene()
    yield from adjust(hand, {"upright": True})
    found["adjusted"] = scene()
    yield from hand.undo()
    yield 0.5


def adjust(hand: Hand, values: dict[str, Any]) -> Generator[float, None, None]:
    """Give the last operator other values and have it done again, as its box (F9) does."""
    operator = bpy.context.window_manager.operators[-1]
    for key, value in values.items():
        setattr(operator.properties, key, value)
    with bpy.context.temp_override(window=hand.window, area=hand.area, region=hand.sidebar):
        # As by hand, with an undo step of its own.
        bpy.ops.ed.undo_redo("EXEC_DEFAULT", True)
    yield 0.5


def prune(show: Show, hand: Hand, found: dict[str, Any]) -> Generator[float, None, None]:
    """Score, apply and take that back; no event follows the last key."""
    bpy.context.scene.refine.method = "occlusion"
    yield from hand.click("refine.score(")
    yield from until(lambda: not at_work() and scene()["scored"], "there are scores")
    yield from hand.scroll(down=True)
    yield from picture(str(Path(show.pictures).parent), "first-3-scored")
    yield from hand.click("refine.apply(")
    before = found["imported"]["splats"]
    yield from until(lambda: not at_work() and scene()["splats"] < before, "splats are removed")
    yield from show.settle()
    yield from picture(str(Path(show.pictures).parent), "first-4-applied", 1.0)
    found["applied"], found["drawn"] = scene(), [show.draw.drawn(show.region)]
    yield from hand.undo()
    yield from until(lambda: show.draw.drawn(show.region) == before, "all are drawn")
    found["drawn"].append(show.draw.drawn(show.region))
    yield from until(lambda: price(NAME)["rested"] and price(NAME)["chart"], "the chart is there")
    yield from picture(str(Path(show.pictures).parent), "first-5-undone", 1.0)
    found["undone"] = scene()


def reopen(show: Show, found: dict[str, Any], blend: str) -> Generator[float, None, Show]:
    """Save the scene while a heat map is shown, show nothing, open it again; return its view."""
    show.call(bpy.ops.refine.view, mode="HEAT")
    yield from show.settle()
    bpy.ops.wm.save_as_mainfile(filepath=blend)
    show.call(bpy.ops.refine.view, mode="OFF")
    bpy.ops.wm.open_mainfile(filepath=blend)
    opened = Show(show.pictures)
    yield from opened.settle()
    yield from picture(str(Path(show.pictures).parent), "first-6-reopened", 1.0)
    number = opened.draw.drawn(opened.region)
    found["reopened"] = [opened.draw.mode(), number, shown_as(opened)]
    return opened


def drop(show: Show, path: str) -> None:
    """Drop a file on the view, as the window manager tells Blender."""
    folder, name = f"{Path(path).parent}/", Path(path).name
    with bpy.context.temp_override(window=show.window, area=show.area, region=show.region):
        files = [{"name": name}]
        bpy.ops.wm.drop_import_file("INVOKE_DEFAULT", directory=folder, files=files)


def scene() -> dict[str, Any]:
    """Return what there is, and which operation F9 adjusts."""
    render, operators = bpy.context.scene.render, bpy.context.window_manager.operators
    mesh = bpy.data.objects[NAME].data if NAME in bpy.data.objects else None
    return {
        "splats": len(mesh.vertices) if mesh else 0,
        "scored": bool(mesh) and "refine_score" in mesh.attributes,
        "cameras": sum(obj.type == "CAMERA" for obj in bpy.context.scene.objects),
        "turned": bool(mesh) and round(bpy.data.objects[NAME].matrix_world[2][1]) == -1,
        "size": [render.resolution_x, render.resolution_y],
        "last": operators[-1].bl_idname if operators else "",
    }


def shown_as(show: Show) -> str:
    """Return as what the plain mesh is drawn."""
    graph = show.window.view_layer.depsgraph
    return str(bpy.data.objects[NAME].evaluated_get(graph).display_type)
