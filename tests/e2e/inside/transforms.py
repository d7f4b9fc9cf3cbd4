"""Do to splats in a window what artists do to objects, and take a picture after each step."""

from __future__ import annotations

import importlib
from collections.abc import Generator
from typing import Any

import bpy
import extension
import mathutils
import numpy as np
from view import Show, plain
from window import Hand, until

PLACE = mathutils.Matrix.LocRotScale(
    (1.0, -2.0, 0.5), mathutils.Euler((0.4, -0.7, 1.1)), (1.3, 1.3, 1.3)
)
"""Where the splats stand, and the camera with them."""


def main(cloud: str, cameras: str, picture: str, blend: str) -> Generator[float, None, dict]:
    """Return what was said of the splats after each step, by the name of its picture.

    Parameters
    ----------
    cloud, cameras
        Files of splats and cameras.
    picture
        Where pictures of the whole screen go, with ``{}`` for the step.
    blend
        Where to save the scene.

    Yields
    ------
    float
        Seconds to wait.
    """
    extension.enable()
    yield 1.0
    steps = Steps(picture)
    yield from steps.hand.press("ESC")  # the splash screen
    bpy.data.batch_remove(bpy.data.objects)
    steps.do(bpy.ops.refine.import_ply, filepath=cloud)
    steps.do(bpy.ops.refine.import_cameras, filepath=cameras)
    camera = bpy.context.scene.camera
    camera.matrix_world = PLACE @ camera.matrix_world
    camera.scale = (1.0, 1.0, 1.0)
    splats().matrix_world = PLACE
    yield from steps.hand.open_tab()
    steps.do(bpy.ops.view3d.view_camera)
    steps.do(bpy.ops.ed.undo_push, message="placed")
    yield from steps.look("start")
    steps.told["region"] = steps.show.numbers()

    yield from applied(steps)
    yield from arranged(steps, blend)
    yield from joined(steps)
    yield from edited(steps)
    yield from reopened(steps, blend)
    yield from foreign(steps, cloud)
    steps.told["failure"] = steps.show.draw.failure()
    return steps.told


def applied(steps: Steps) -> Generator[float, None, None]:
    """Apply all transforms as Ctrl+A does, mend by a click, undo and redo both, bake."""
    steps.select(splats())
    steps.do(bpy.ops.object.transform_apply)
    yield from steps.look("ruined by apply")
    yield from steps.panel("panel")
    yield from steps.hand.click("refine.mend(")
    yield from until(lambda: not steps.said(), "all is mended")
    yield from steps.look("apply mended")
    for name, operator in (("undo", bpy.ops.ed.undo), ("redo", bpy.ops.ed.redo)):
        steps.do(operator)
        steps.do(operator)
        yield from steps.look(name)
    steps.do(bpy.ops.ed.undo)
    steps.do(bpy.ops.ed.undo)
    steps.select(splats())
    steps.do(bpy.ops.refine.bake_transform)
    yield from steps.look("baked")


def arranged(steps: Steps, blend: str) -> Generator[float, None, None]:
    """Duplicate, instance, parent, mirror, append and link."""
    steps.select(splats())
    steps.do(bpy.ops.object.duplicate)
    copy = bpy.context.object
    bpy.data.objects.remove(splats(but=copy))
    yield from steps.look("duplicate")
    steps.do(bpy.ops.object.duplicate, linked=True)
    copy.hide_set(True)
    yield from steps.look("linked duplicate")
    steps.do(bpy.ops.object.make_single_user, object=True, obdata=True)
    bpy.data.objects.remove(copy)
    yield from steps.look("single user")

    empty = bpy.data.objects.new("parent", None)
    bpy.context.scene.collection.objects.link(empty)
    empty.matrix_world = PLACE @ PLACE
    steps.select(empty, splats())
    steps.do(bpy.ops.object.parent_set, type="OBJECT")
    yield from steps.look("parent")
    steps.select(splats())
    steps.do(bpy.ops.object.parent_inverse_apply)
    yield from steps.look("parent inverse")
    steps.do(bpy.ops.object.parent_clear, type="CLEAR_KEEP_TRANSFORM")

    bpy.context.view_layer.update()
    steps.do(bpy.ops.refine.bake_transform)
    splats().scale.x = -1.0
    steps.do(bpy.ops.object.transform_apply)
    splats().scale.x = -1.0
    yield from steps.look("ruined by mirror")
    steps.do(bpy.ops.refine.mend)
    yield from steps.look("mirror mended")

    steps.do(bpy.ops.wm.save_as_mainfile, filepath=blend, copy=True)
    source = splats()
    for name, link in (("append", False), ("link", True)):
        with bpy.data.libraries.load(blend, link=link) as (_, wanted):
            wanted.objects = [source.name]
        (copy,) = wanted.objects
        bpy.context.scene.collection.objects.link(copy)
        source.hide_set(True)
        yield from steps.look(name)
        bpy.data.objects.remove(copy)
        source.hide_set(False)


def joined(steps: Steps) -> Generator[float, None, None]:
    """Part the splats, stand one half otherwise, join, and mend."""
    whole = splats()
    select_vertices(whole, np.arange(len(whole.data.vertices)) % 2 == 0)
    steps.select(whole)
    steps.do(bpy.ops.object.mode_set, mode="EDIT")
    steps.do(bpy.ops.mesh.separate, type="SELECTED")
    steps.do(bpy.ops.object.mode_set, mode="OBJECT")
    half = splats(but=whole)
    half.matrix_world = PLACE
    half.data.transform(PLACE.inverted() @ whole.matrix_world)
    half.data.update()
    bpy.context.view_layer.update()
    steps.select(half)
    yield 0.5
    steps.do(bpy.ops.refine.mend)
    steps.select(whole, half)
    yield from steps.look("parted for join")
    steps.do(bpy.ops.object.join)
    yield from steps.look("ruined by join")
    steps.do(bpy.ops.refine.mend)
    yield from steps.look("join mended")


def edited(steps: Steps) -> Generator[float, None, None]:
    """Turn half of the splats in edit mode, mend, turn them back, and mend again."""
    obj = splats()
    steps.select(obj)
    select_vertices(obj, np.arange(len(obj.data.vertices)) % 2 == 0)
    for name, angle in (("turned", 0.8), ("turned back", -0.8)):
        steps.do(bpy.ops.object.mode_set, mode="EDIT")
        steps.do(bpy.ops.transform.rotate, value=angle, orient_axis="Z", center_override=(0, 0, 0))
        steps.do(bpy.ops.object.mode_set, mode="OBJECT")
        yield 0.5
        steps.told[name] = steps.said()
        steps.do(bpy.ops.refine.mend)
    select_vertices(obj, np.zeros(len(obj.data.vertices), np.bool_))  # selected ones are tinted
    obj.data.update()
    yield from steps.look("edit mode")


def reopened(steps: Steps, blend: str) -> Generator[float, None, None]:
    """Save, ruin, save, reopen: what was done is still known, and mended."""
    steps.do(bpy.ops.object.transform_apply)
    again = blend.replace("saved", "again")
    steps.do(bpy.ops.wm.save_as_mainfile, filepath=again)
    bpy.ops.wm.open_mainfile(filepath=again)
    yield 1.0
    steps.again()
    yield from steps.look("ruined and reopened")
    steps.do(bpy.ops.refine.mend)
    yield from steps.look("reopened")


def foreign(steps: Steps, cloud: str) -> Generator[float, None, None]:
    """Apply a transform of splats that Blender's own importer brought, and undo it."""
    bpy.data.objects.remove(splats())
    steps.do(bpy.ops.wm.ply_import, filepath=cloud)
    yield from until(lambda: "refine_shape" in splats().data.attributes, "they are noted")
    splats().matrix_world = PLACE
    steps.select(splats())
    steps.do(bpy.ops.ed.undo_push, message="placed")
    steps.do(bpy.ops.object.transform_apply)
    yield 0.5
    steps.told["foreign"] = steps.said()
    steps.do(bpy.ops.ed.undo)
    yield 0.5
    steps.told["foreign undone"] = steps.said()


def splats(but: bpy.types.Object | None = None) -> bpy.types.Object:
    """Return the object of the scene that holds splats, or the other one."""
    return next(
        obj for obj in bpy.context.scene.objects if obj.type == "MESH" and obj not in (but, None)
    )


def select_vertices(obj: bpy.types.Object, which: np.ndarray) -> None:
    """Select some vertices for edit mode."""
    obj.data.vertices.foreach_set("select", which)


class Steps:
    """The window, and what it said after each step."""

    def __init__(self, pictures: str) -> None:
        self.pictures = pictures
        self.told: dict[str, Any] = {}
        self.again()

    def again(self) -> None:
        """Find the window, after another file was opened as well."""
        self.hand = Hand()
        self.show = Show(self.pictures)
        self.transforms = importlib.import_module(f"{extension.MODULE}.ui.transforms")

    def do(self, operator: Any, **values: Any) -> None:
        """Call an operator in the view, as a step that can be undone."""
        show = self.show
        with bpy.context.temp_override(window=show.window, area=show.area, region=show.region):
            operator("EXEC_DEFAULT", True, **values)

    def select(self, *objects: bpy.types.Object) -> None:
        """Select objects; the first is the active one."""
        for obj in bpy.context.view_layer.objects:
            obj.select_set(obj in objects)
        bpy.context.view_layer.objects.active = objects[0]

    def said(self) -> list[str]:
        """Return what the panel says of the splats."""
        drift = self.transforms.of(splats())
        return drift.told if drift else []

    def look(self, name: str) -> Generator[float, None, None]:
        """Take a picture of what is drawn; note what is said."""
        space = self.show.area.spaces.active
        plain(space)
        space.show_region_hud = False
        yield 0.3
        yield from self.show.picture(name)
        self.told[name] = self.said()

    def panel(self, name: str) -> Generator[float, None, None]:
        """Take a picture with the panel."""
        self.show.area.spaces.active.show_region_ui = True
        yield 1.0
        yield from self.show.picture(name)
