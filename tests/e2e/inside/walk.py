"""Walk from a raw capture to a clean asset as docs/guide.md tells it, with its pictures."""

from __future__ import annotations

import bpy
from hand import at_work, begin_large, until


def main(cloud, cameras, output, pictures):
    """Clean, score, look, apply and export; return how many splats each step left."""
    hand = yield from begin_large(pictures)
    refine, settings, found = bpy.ops.refine, bpy.context.scene.refine, {}

    splats = hand.bring_in(cloud, cameras)
    yield from hand.scroll(down=False)
    yield from hand.shown("1-imported")
    found["imported"] = len(splats.data.vertices)

    hand.call(refine.view, mode="GOES")
    yield from hand.over()
    hand.call(refine.find_floaters, "INVOKE_DEFAULT")
    yield from until(lambda: not at_work(), "they are found")
    yield from hand.shown("2-floaters")
    yield from hand.press("RET")  # Delete
    yield 1.0
    found["cleaned"] = len(splats.data.vertices)

    hand.call(refine.score)
    hand.call(refine.view, mode="HEAT")
    yield from hand.shown("3-scored")
    settings.percent = 70.0
    yield 2.0  # the marks follow when the slider rests
    hand.call(refine.view, mode="STAYS")
    yield from hand.scroll(down=True)
    yield from hand.shown("4-price")

    hand.call(refine.apply)
    hand.call(refine.view, mode="SCENE")
    yield from hand.shown("5-applied")
    found["applied"] = len(splats.data.vertices)
    hand.call(refine.export_ply, filepath=output)
    return found
