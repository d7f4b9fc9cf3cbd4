"""Score a scene and move the slider of the budget, for pictures of the panel."""

from __future__ import annotations

import bpy
from hand import begin_large, price, until


def main(cloud, cameras, shares, pictures):
    """Take a picture of the whole screen at each share, percent; return their number."""
    hand = yield from begin_large(pictures)
    splats, settings = hand.bring_in(cloud, cameras), bpy.context.scene.refine
    overlay = hand.space.overlay
    overlay.show_extras = overlay.show_floor = overlay.show_cursor = False
    overlay.show_axis_x = overlay.show_axis_y = False
    hand.call(bpy.ops.refine.score)
    hand.call(bpy.ops.refine.view, mode="STAYS")
    for number, share in enumerate(shares):
        settings.percent = share
        yield 0.5
        yield from until(lambda: price(splats)["sentence"], "marks follow")
        yield from hand.shown(f"{number:02}")
    return len(shares)
