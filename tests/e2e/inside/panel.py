"""Use the panel as a person does: its tab, *Score*, *Apply*, Ctrl+Z; then *Compare*, twice."""

from __future__ import annotations

import bpy
import numpy as np
from hand import at_work, begin, price, until

NAMES = ["Compare: before", "Compare: after", "Compare: difference"]


def main(name, pictures):
    """Prune the open scene by hand; return what was there before, between and after."""
    hand = yield from begin(pictures)
    yield from hand.open_tab()
    yield from hand.picture("1-opened")
    found = {"opened": state(name)}

    yield from hand.click("refine.score(")
    yield from until(lambda: state(name)["scored"] and not at_work(), "there are scores")
    found["scored"] = state(name)
    yield from hand.scroll(down=True)
    yield from hand.picture("2-scored")
    found["priced"] = price(bpy.data.objects[name])
    bpy.context.scene.refine.percent = 60.0
    yield from until(lambda: price(bpy.data.objects[name])["sentence"], "marks follow")
    yield from hand.picture("2-slid")
    found["slid"] = price(bpy.data.objects[name])
    bpy.context.scene.refine.percent = 50.0

    bpy.data.objects[name].location.x += 0.1
    yield from hand.picture("3-moved")  # the scores are older than that, says the panel
    yield from hand.click("refine.apply(")
    yield from until(lambda: state(name) != found["scored"], "splats are removed")
    yield from hand.picture("4-applied")
    found["applied"] = state(name)
    yield from hand.undo()
    yield from until(lambda: state(name) != found["applied"], "they are back")
    yield from hand.picture("5-undone")
    found["undone"] = state(name)

    bpy.context.scene.refine.method = "occlusion"  # of the same scores, and sooner
    yield from hand.click("refine.compare(")
    yield from until(lambda: NAMES[2] in bpy.data.images, "there are pictures")
    yield from hand.picture("6-compare", 3)
    found["first"], before = compared(), sum_of(NAMES[2])
    bpy.context.scene.refine.ratio = 0.9
    yield 1.0
    hand.call(bpy.ops.refine.compare, "INVOKE_DEFAULT")
    yield from until(lambda: sum_of(NAMES[2]) != before, "there are others")
    yield from hand.picture("7-compare-again")
    found["again"], found["larger"] = compared(), sum_of(NAMES[2]) > before
    return found


def state(name):
    """Return what the panel's buttons are to change; by name, as undo replaces the object."""
    mesh = bpy.data.objects[name].data
    return {"vertices": len(mesh.vertices), "scored": "refine_score" in mesh.attributes}


def compared():
    """Return the images of the file, and those that the windows show from left to right."""
    windows = bpy.context.window_manager.windows
    areas = (area for window in windows[1:] for area in window.screen.areas)
    areas = sorted(areas, key=lambda area: area.x)
    return {
        "images": sorted(image.name for image in bpy.data.images if image.users),
        "windows": len(windows),
        "areas": [area.spaces.active.image.name for area in areas],
        "widths": [area.width for area in areas],
        "size": list(bpy.data.images[NAMES[0]].size),
        "unsaved": [image.name for image in bpy.data.images if image.is_dirty],
    }


def sum_of(name):
    """Return the sum of an image's pixels."""
    values = np.empty(len(bpy.data.images[name].pixels), np.float32)
    bpy.data.images[name].pixels.foreach_get(values)
    return float(values.sum(dtype=np.float64))
