"""Select splats in a window with every tool: by mouse and keys, as one sees them."""

from __future__ import annotations

import bpy
from hand import begin, mask

NAME = "few"
BOX = (0.3, 0.3), (0.6, 0.7)
"""Two corners over the view, as shares of its width and height."""


def main(cloud, cameras, blend, pictures):
    """Select by each tool through a camera; return how many splats each took, and what follows."""
    hand = yield from begin(pictures, cloud, cameras)
    hand.plain()
    hand.space.show_region_toolbar = True
    yield from hand.settle()
    hand.call(bpy.ops.ed.undo_push, message="imported")
    found = {"imported": count()}

    box = yield from hand.drag("box", *BOX)
    found["box"], found["drawn"] = count(), hand.draw.drawn(hand.region())
    yield from hand.undo()
    found["undone"] = count()
    bpy.context.scene.refine.select_hidden = True
    through = yield from hand.drag("box", *BOX)
    found["through"], found["box is part"] = count(), not (box & ~through).any()
    bpy.context.scene.refine.select_hidden = False

    found |= yield from shapes(hand, box)
    found |= yield from keys(hand)
    hand.call(bpy.ops.object.mode_set, mode="EDIT")
    yield 1.0
    yield from hand.drag("box", *BOX)
    found["edit box"] = count()
    yield from hand.picture("select-4-edit", 1)
    hand.call(bpy.ops.object.mode_set, mode="OBJECT")
    yield from hand.settle()
    found["after edit"] = count()
    hand.call(bpy.ops.wm.save_as_mainfile, filepath=blend)
    bpy.ops.wm.open_mainfile(filepath=blend)
    yield 1.0
    found["reopened"], found["failure"] = count(), hand.draw.failure()
    return found


def shapes(hand, box):
    """Use the other tools, and the keys that combine; return what they took."""
    lasso = yield from hand.drag("lasso", BOX[0], (0.6, 0.3), BOX[1], (0.3, 0.7))
    stroke = "brush", (0.3, 0.5), (0.6, 0.5)
    brush = yield from hand.drag(*stroke)
    found = {"lasso is box": int((lasso ^ box).sum()), "brush": count(), "radii": []}
    yield from hand.shown("select-1-brush")
    for key in ("RIGHT_BRACKET", "LEFT_BRACKET"):
        yield from hand.press(key)
        yield 0.3
        found["radii"].append(round(bpy.context.scene.refine.select_radius, 3))
    added = yield from hand.drag("box", *BOX, shift=True)
    subtracted = yield from hand.drag(*stroke, ctrl=True)
    yield from hand.drag("box", *BOX)
    both = yield from hand.drag(*stroke, shift=True, ctrl=True)
    found["combined"] = [
        bool((got == wanted).all())
        for got, wanted in ((added, box | brush), (subtracted, box & ~brush), (both, box & brush))
    ]
    for tool, to, connected in (
        ("sphere", (0.6, 0.5), False),
        ("color", (0.5, 0.5), False),
        ("color", (0.5, 0.5), True),
    ):
        bpy.context.scene.refine.select_connected = connected
        yield from hand.drag(tool, (0.5, 0.5), to)
        found["piece" if connected else tool] = count()
    yield from hand.shown("select-2-piece")
    return found


def keys(hand):
    """Use the keys of a tool; return what they did."""
    found = {}
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
    found["isolated"] = yield from hand.shown("select-3-isolated")
    yield from hand.press("H", alt=True)
    yield from hand.settle()
    return found


def count():
    """Return how many splats are selected."""
    return int(mask(bpy.data.objects[NAME]).sum())
