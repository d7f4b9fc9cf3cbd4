"""Click *Compare*, twice: what is shown of the active camera, and where."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import bpy
import extension
import numpy as np
from window import Hand, picture, until

NAMES = ["Compare: before", "Compare: after", "Compare: difference"]


def main(pictures: str) -> Generator[float, None, dict[str, Any]]:
    """Compare what the panel's budget leaves of the open scene; return what is shown then.

    Parameters
    ----------
    pictures
        Folder for a picture of the whole screen.

    Yields
    ------
    float
        Seconds to wait.
    """
    extension.enable()
    yield 1.0
    scene = bpy.context.scene
    scene.refine.method = "closed-form"
    hand = Hand()
    yield from hand.press("ESC")  # the splash screen
    yield from hand.open_tab()
    yield from hand.click("refine.score(")
    yield from until(lambda: "refine_score" in bpy.context.object.data.attributes, "it is scored")
    yield from hand.scroll(down=True)
    yield from hand.click("refine.compare(")
    yield from until(lambda: NAMES[2] in bpy.data.images, "there are pictures")
    yield from picture(pictures, "compare", settle=3.0)
    found = {"first": shown()}
    scene.refine.ratio = 0.9
    yield 1.0
    before = sum_of(NAMES[2])
    override = {"window": hand.window, "area": hand.area, "region": hand.sidebar}
    with bpy.context.temp_override(**override):
        bpy.ops.refine.compare("INVOKE_DEFAULT")
    yield from until(lambda: sum_of(NAMES[2]) != before, "there are others")
    yield from picture(pictures, "compare-again")
    found["again"] = shown()
    found["larger"] = sum_of(NAMES[2]) > before
    return found


def shown() -> dict[str, Any]:
    """Return the images of the file, and those that the windows show from left to right."""
    windows = bpy.context.window_manager.windows
    areas = sorted((area for window in windows[1:] for area in window.screen.areas), key=place)
    return {
        "images": sorted(image.name for image in bpy.data.images if image.users),
        "windows": len(windows),
        "areas": [area.spaces.active.image.name for area in areas],
        "widths": [area.width for area in areas],
        "size": list(bpy.data.images[NAMES[0]].size),
        "unsaved": [image.name for image in bpy.data.images if image.is_dirty],
    }


def place(area: bpy.types.Area) -> int:
    """Return how far to the right an area is."""
    return area.x


def sum_of(name: str) -> float:
    """Return the sum of an image's pixels."""
    image = bpy.data.images[name]
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    return float(values.sum(dtype=np.float64))
