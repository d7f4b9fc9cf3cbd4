"""Score the splats of a scene, and move the slider of the budget: pictures of the panel."""

from __future__ import annotations

from collections.abc import Generator

import bpy
import extension
from view import Show
from window import Hand, price, until


def main(
    cloud: str, cameras: str, shares: list[float], picture: str
) -> Generator[float, None, int]:
    """Take a picture of the whole screen at each share, percent; return their number."""
    extension.enable()
    yield 1.0
    hand = Hand()
    yield from hand.press("ESC")  # the splash screen
    bpy.data.batch_remove(bpy.data.objects)
    Show(picture).call(bpy.ops.screen.screen_full_area)
    yield 1.0
    show, hand = Show(picture), Hand()  # the area of the whole window is another one
    space = show.area.spaces.active
    space.show_gizmo = space.overlay.show_extras = space.overlay.show_floor = False
    space.overlay.show_cursor = space.overlay.show_axis_x = space.overlay.show_axis_y = False
    yield from hand.open_tab()
    show.call(bpy.ops.refine.import_ply, filepath=cloud)
    splats = bpy.context.object
    show.call(bpy.ops.refine.import_cameras, filepath=cameras)
    show.call(bpy.ops.view3d.view_camera)
    bpy.context.view_layer.objects.active = splats
    show.call(bpy.ops.refine.score)
    show.call(bpy.ops.refine.view, mode="STAYS")
    for number, share in enumerate(shares):
        bpy.context.scene.refine.percent = share
        yield 0.5
        yield from until(lambda: price(splats.name)["rested"], "marks follow")
        yield from show.picture(f"{number:02}")
    return len(shares)
