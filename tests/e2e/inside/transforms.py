"""Do to splats in a window what artists do to objects, and take a picture after each step."""

from __future__ import annotations

import bpy
import extension
import mathutils
import numpy as np
from hand import begin, until

PLACE = mathutils.Matrix.LocRotScale(
    (1.0, -2.0, 0.5), mathutils.Euler((0.4, -0.7, 1.1)), (1.3, 1.3, 1.3)
)
"""Where the splats stand, and the camera with them."""

TOLD = {}


def main(cloud, cameras, pictures, blend):
    """Return what was said after each step, by the name of its picture, and where the view lies."""
    hand = yield from begin(pictures, cloud, cameras)
    camera = bpy.context.scene.camera
    camera.matrix_world = PLACE @ camera.matrix_world
    camera.scale = (1.0, 1.0, 1.0)
    splats().matrix_world = PLACE
    yield from hand.open_tab()
    hand.do(bpy.ops.ed.undo_push, message="placed")
    yield from look(hand, "start")
    TOLD["region"] = hand.numbers()
    yield from applied(hand)
    yield from arranged(hand, blend)
    yield from joined(hand)
    yield from reopened(hand, blend)
    return TOLD | {"failure": hand.draw.failure()}


def applied(hand):
    """Apply all transforms as Ctrl+A does, mend by a click, undo and redo both, bake."""
    extension.select(splats())
    hand.do(bpy.ops.object.transform_apply)
    yield from look(hand, "ruined by apply")
    hand.space.show_region_ui = True
    yield 1.0
    yield from hand.shown("transforms-panel")
    yield from hand.click("refine.mend(")
    yield from until(lambda: not said(), "all is mended")
    yield from look(hand, "apply mended")
    for name, operator in (("undo", bpy.ops.ed.undo), ("redo", bpy.ops.ed.redo)):
        hand.do(operator)
        hand.do(operator)
        yield from look(hand, name)
    hand.do(bpy.ops.ed.undo)
    hand.do(bpy.ops.ed.undo)
    extension.select(splats())
    hand.do(bpy.ops.refine.bake_transform)
    yield from look(hand, "baked")


def arranged(hand, blend):
    """Duplicate, instance, parent, append and link."""
    extension.select(splats())
    hand.do(bpy.ops.object.duplicate)
    bpy.data.objects.remove(splats(but=bpy.context.object))
    yield from look(hand, "duplicate")
    source = splats()
    hand.do(bpy.ops.object.duplicate, linked=True)
    source.hide_set(True)
    yield from look(hand, "linked duplicate")
    bpy.data.objects.remove(source)

    empty = bpy.data.objects.new("parent", None)
    bpy.context.scene.collection.objects.link(empty)
    empty.matrix_world = PLACE @ PLACE
    extension.select(empty, splats())
    hand.do(bpy.ops.object.parent_set, type="OBJECT")
    yield from look(hand, "parent")
    extension.select(splats())
    hand.do(bpy.ops.object.parent_clear, type="CLEAR_KEEP_TRANSFORM")

    hand.do(bpy.ops.wm.save_as_mainfile, filepath=blend, copy=True)
    source = splats()
    source.hide_set(True)
    for name, link in (("append", False), ("link", True)):
        with bpy.data.libraries.load(blend, link=link) as (_, wanted):
            wanted.objects = [source.name]
        bpy.context.scene.collection.objects.link(wanted.objects[0])
        yield from look(hand, name)
        bpy.data.objects.remove(wanted.objects[0])
    source.hide_set(False)


def joined(hand):
    """Part the splats, stand one half otherwise, join, and mend."""
    whole = splats()
    half_of_them = np.arange(len(whole.data.vertices)) % 2 == 0
    whole.data.vertices.foreach_set("select", half_of_them)
    extension.select(whole)
    hand.do(bpy.ops.object.mode_set, mode="EDIT")
    hand.do(bpy.ops.mesh.separate, type="SELECTED")
    hand.do(bpy.ops.object.mode_set, mode="OBJECT")
    half = splats(but=whole)
    half.matrix_world = PLACE
    half.data.transform(PLACE.inverted() @ whole.matrix_world)
    half.data.update()
    bpy.context.view_layer.update()
    extension.select(half)
    yield 0.5
    hand.do(bpy.ops.refine.mend)
    extension.select(whole, half)
    yield from look(hand, "parted for join")
    hand.do(bpy.ops.object.join)
    yield from look(hand, "ruined by join")
    hand.do(bpy.ops.refine.mend)
    yield from look(hand, "join mended")


def reopened(hand, blend):
    """Mirror, apply that, save, open: it is still known, and mended."""
    extension.select(splats())
    hand.do(bpy.ops.refine.bake_transform)
    splats().scale.x = -1.0
    hand.do(bpy.ops.object.transform_apply)
    splats().scale.x = -1.0
    again = blend.replace("saved", "again")  # a library of its own cannot be written over
    hand.do(bpy.ops.wm.save_as_mainfile, filepath=again)
    bpy.ops.wm.open_mainfile(filepath=again)
    yield 1.0
    yield from look(hand, "ruined and reopened")
    hand.do(bpy.ops.refine.mend)
    yield from look(hand, "reopened")


def splats(but=None):
    """Return the object of the scene that holds splats, or the other one."""
    return next(obj for obj in bpy.context.scene.objects if obj.type == "MESH" and obj != but)


def said():
    """Return what the panel says of the splats."""
    drift = extension.module("mesh.drift").of(splats())
    return drift.sentences if drift else []


def look(hand, name):
    """Take a picture of what is drawn; note what is said."""
    hand.plain()
    yield 0.3
    yield from hand.shown(f"transforms-{name}")
    TOLD[name] = said()
