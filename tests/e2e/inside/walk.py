"""Walk from a raw capture to a clean asset as docs/guide.md tells it, with its pictures."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import bpy
import extension
from view import Show
from window import Hand


def main(
    cloud: str, cameras: str, output: str, picture: str
) -> Generator[float, None, dict[str, int]]:
    """Clean, score, look, apply and export; return how many splats each step left.

    Parameters
    ----------
    cloud, cameras, output
        Files: the capture and its cameras, and where to write the asset.
    picture
        Where pictures of the whole screen go, with ``{}`` for their names.

    Yields
    ------
    float
        Seconds to wait.
    """
    extension.enable()
    yield 1.0
    hand = Hand()
    yield from hand.press("ESC")  # the splash screen
    bpy.data.batch_remove(bpy.data.objects)
    show = Show(picture)
    show.call(bpy.ops.screen.screen_full_area)
    yield 1.0
    show, hand = Show(picture), Hand()  # the area of the whole window is another one
    show.area.spaces.active.show_gizmo = False
    yield from hand.open_tab()
    found: dict[str, int] = {}

    show.call(bpy.ops.refine.import_ply, filepath=cloud)
    name = bpy.context.object.name
    splats = bpy.context.object
    show.call(bpy.ops.refine.import_cameras, filepath=cameras)
    show.call(bpy.ops.view3d.view_camera)
    bpy.context.view_layer.objects.active = splats
    settings = bpy.context.scene.refine
    yield from hand.scroll(down=False)
    yield from show.picture("1-imported")
    found["imported"] = size(name)

    show.call(bpy.ops.refine.find_floaters)
    show.call(bpy.ops.refine.view, mode="GOES")
    yield from show.picture("2-floaters")
    show.call(bpy.ops.refine.delete, what="FLOATERS")
    found["cleaned"] = size(name)

    show.call(bpy.ops.refine.score)
    show.call(bpy.ops.refine.view, mode="HEAT")
    yield from show.picture("3-scored")

    settings.percent = 70.0
    yield 2.0  # the marks follow when the slider rests
    show.call(bpy.ops.refine.view, mode="STAYS")
    yield from hand.scroll(down=True)
    yield from show.picture("4-price")

    show.call(bpy.ops.refine.apply)
    show.call(bpy.ops.refine.view, mode="SCENE")
    yield from show.picture("5-applied")
    found["applied"] = size(name)

    show.call(bpy.ops.refine.export_ply, filepath=output)
    return found


def size(name: str) -> int:
    """Return how many splats an object holds."""
    mesh: Any = bpy.data.objects[name].data
    return len(mesh.vertices)
