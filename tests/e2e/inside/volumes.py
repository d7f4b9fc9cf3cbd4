"""Protect and crop in a window: marks and volumes in the panel, and in every mode of the view."""

from __future__ import annotations

import importlib
from collections.abc import Generator
from typing import Any

import bpy
import extension
import numpy as np
from view import Show
from window import Hand


def main(cloud: str, cameras: str, picture: str) -> Generator[float, None, dict[str, Any]]:
    """Mark splats, add volumes, look, score, look again, and move a volume.

    Parameters
    ----------
    cloud, cameras
        Files of splats and cameras.
    picture
        Where pictures of the whole screen go, with ``{}`` for the mode.

    Yields
    ------
    float
        Seconds to wait.
    """
    extension.enable()
    yield 1.0
    demands = importlib.import_module(f"{extension.MODULE}.objects.demands")
    show = Show(picture)
    hand = Hand()
    yield from hand.press("ESC")  # the splash screen
    bpy.data.batch_remove(bpy.data.objects)
    show.call(bpy.ops.refine.import_ply, filepath=cloud)
    show.call(bpy.ops.refine.import_cameras, filepath=cameras)
    show.call(bpy.ops.view3d.view_camera)
    splats = bpy.data.objects["point_cloud"]
    bpy.context.view_layer.objects.active = splats
    settings = bpy.context.scene.refine
    settings.method = "closed-form"
    yield from hand.open_tab()

    mark(splats, 1000)
    show.call(bpy.ops.refine.protect, mark="STAY")
    for shape, role in (("SPHERE", "PROTECT"), ("BOX", "REMOVE"), ("BOX", "KEEP")):
        show.call(bpy.ops.refine.add_volume, shape=shape, role=role)
    box = settings.volumes[1].object
    box.location.x += 0.8 * box.scale.x
    yield from wait(lambda: not marked(demands, splats, 0))
    found: dict[str, Any] = {"unscored": demands.facts(splats.data)}
    for mode in ("SCENE", "GOES"):
        show.call(bpy.ops.refine.view, mode=mode)
        found[f"unscored {mode}"] = yield from show.picture(f"unscored-{mode}")

    yield from hand.move(500, 500)
    show.call(bpy.ops.wm.call_panel, name="REFINE_PT_protect", keep_open=True)
    yield 1.0
    yield from show.picture("panel")
    yield from hand.press("ESC")

    show.call(bpy.ops.refine.score)
    for mode in ("SCENE", "HEAT", "STAYS", "GOES"):
        show.call(bpy.ops.refine.view, mode=mode)
        yield 1.0
        found[mode] = yield from show.picture(mode)
    before = demands.facts(splats.data)["removed_by_user"]
    box.location.x -= 0.5
    yield from wait(lambda: not marked(demands, splats, before))
    found["moved"] = demands.facts(splats.data)["removed_by_user"] - before
    found["failure"] = show.draw.failure()
    return found


def mark(splats: bpy.types.Object, count: int) -> None:
    """Select so many splats, as edit mode leaves it."""
    flags = np.arange(len(splats.data.vertices)) < count
    splats.data.vertices.foreach_set("select", flags)


def marked(demands: Any, splats: bpy.types.Object, count: int) -> bool:
    """Tell whether so many splats are said to go."""
    return demands.facts(splats.data).get("removed_by_user") == count


def wait(is_so: Any) -> Generator[float, None, None]:
    """Let Blender work until something is so, and a little longer; ten seconds at most."""
    for _ in range(50):
        yield 0.2
        if is_so():
            break
    yield 1.0
