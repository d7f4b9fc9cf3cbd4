"""Look at splats in the 3D view: imported, through a camera, in every mode; then without."""

from __future__ import annotations

import bpy
import extension
from hand import begin, until


def main(cloud, cameras, models, pictures, blend):
    """Return what was drawn, also of files of other models by name, and what is left of it."""
    hand = yield from begin(pictures, cloud, cameras)
    splats, refine = bpy.context.object, bpy.ops.refine
    found = {"after import": hand.draw.mode()}
    hand.plain()
    found["SCENE"] = yield from hand.shown("view-SCENE")
    found["camera"] = hand.numbers()
    splats.hide_set(True)
    for model, path in models.items():
        hand.call(refine.import_ply, filepath=path)
        yield from hand.shown(f"view-{model}")
        bpy.data.objects.remove(bpy.context.object)
    splats.hide_set(False)

    extension.select(splats)
    hand.call(refine.add_volume, shape="BOX", role="REMOVE")
    box = bpy.context.scene.refine.volumes[0].object
    box.location.x += 0.8 * box.scale.x
    yield from until(lambda: must_go(splats), "the volume is followed")
    found["must go"] = must_go(splats)
    hand.call(refine.view, mode="GOES")
    found["unscored GOES"] = yield from hand.shown("view-unscored")
    extension.select(splats)
    bpy.context.scene.refine.method = "closed-form"
    hand.call(refine.score)
    for mode in ("HEAT", "STAYS", "GOES", "ELLIPSES", "CENTERS"):
        hand.call(refine.view, mode=mode)
        found[mode] = yield from hand.shown(f"view-{mode}")
    found |= yield from handle(hand, splats)

    found["stored"] = bpy.data.objects["renamed"].display_type
    hand.call(refine.view, mode="HEAT")
    hand.call(bpy.ops.wm.save_as_mainfile, filepath=blend, copy=True)
    hand.call(refine.view, mode="OFF")
    bpy.ops.wm.open_mainfile(filepath=blend)
    yield from hand.settle()
    found["still on"], found["failure"] = hand.draw.mode(), hand.draw.failure()
    found["handlers"], found["shown as"] = [handlers()], [shown_as(hand)]
    extension.disable()
    found["handlers"].append(handlers())
    found["shown as"].append(shown_as(hand))
    return found


def must_go(splats):
    """Return how many splats the panel says that volumes remove."""
    return extension.module("objects.demands").record(splats.data).get("removed_by_user", 0)


def handle(hand, splats):
    """Do to an object what may happen to it while it is drawn; none of it may raise."""
    found = {}
    hand.call(bpy.ops.object.mode_set, mode="EDIT")
    yield 0.3
    hand.call(bpy.ops.object.mode_set, mode="OBJECT")
    splats.name, splats.scale = "renamed", (1.0, 2.0, 0.5)
    copy = splats.copy()
    bpy.context.scene.collection.objects.link(copy)
    hand.call(bpy.ops.refine.view, mode="SCENE")
    found["two"] = yield from hand.settle()
    copy.hide_set(True)
    found["one hidden"] = yield from hand.settle()
    hand.call(bpy.ops.ed.undo_push, message="before")
    bpy.data.objects.remove(splats)
    hand.call(bpy.ops.ed.undo_push, message="removed")
    yield 0.3
    hand.call(bpy.ops.ed.undo)
    found["undone"] = yield from hand.settle()
    return found


def handlers():
    """Return how many handlers of the drawing Blender calls after updates."""
    modules = [handler.__module__ for handler in bpy.app.handlers.depsgraph_update_post]
    return modules.count(f"{extension.MODULE}.viewport.draw")


def shown_as(hand):
    """Return as what the plain mesh is drawn."""
    graph = hand.window.view_layer.depsgraph
    return bpy.data.objects["renamed"].evaluated_get(graph).display_type
