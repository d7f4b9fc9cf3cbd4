"""Click *Apply*, and adjust it afterwards as the box *Adjust Last Operation* (F9) does."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import bpy
import extension
from window import Hand, picture, until


def main(name: str, pictures: str) -> Generator[float, None, dict[str, Any]]:
    """Apply 50 %, make it 30 %, then 4,000 splats, then absorb; return what is left each time.

    Parameters
    ----------
    name
        The active object, splats.
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
    yield from until(lambda: "refine_score" in bpy.data.objects[name].data.attributes, "scored")
    yield from hand.scroll(down=True)
    yield from hand.click("refine.apply(")
    yield from until(lambda: count(name) < 39_755, "splats are removed")
    found = {"applied": state(name)}
    yield from picture(pictures, "adjust", settle=3.0)
    for label, values in (
        ("less", {"percent": 30.0}),
        ("count", {"budget": "keep", "keep": 4000}),
        ("absorbed", {"survivors": "absorb"}),
    ):
        yield from adjust(hand, values)
        found[label] = state(name)
    yield from hand.undo()
    yield from until(lambda: count(name) == 39_755, "they are back")
    scene = bpy.context.scene
    scene.refine.survivors, scene.refine.budget, scene.refine.percent = "unchanged", "ratio", 60.0
    yield from hand.scroll(down=True)
    yield from hand.click("refine.apply(")
    yield from until(lambda: count(name) < 39_755, "splats are removed")
    found["again"] = state(name)
    return found


def adjust(hand: Hand, values: dict[str, Any]) -> Generator[float, None, None]:
    """Give the last operator other values and have it done again."""
    operator = bpy.context.window_manager.operators[-1]
    for key, value in values.items():
        setattr(operator.properties, key, value)
    with bpy.context.temp_override(window=hand.window, area=hand.area, region=hand.sidebar):
        # As by hand, with an undo step of its own.
        bpy.ops.ed.undo_redo("EXEC_DEFAULT", True)
    yield 0.5


def count(name: str) -> int:
    """Return how many splats an object has."""
    return len(bpy.data.objects[name].data.vertices)


def state(name: str) -> dict[str, Any]:
    """Return what is left, what the panel says, and which operator was last."""
    settings = bpy.context.scene.refine
    return {
        "vertices": count(name),
        "panel": [settings.budget, round(settings.percent, 3), settings.keep, settings.survivors],
        "last": bpy.context.window_manager.operators[-1].bl_idname,
    }
