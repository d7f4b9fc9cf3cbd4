"""Look at splats among other objects: meshes one sees through, a crop box, the grid, instances."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import bpy
import extension
from mathutils import Quaternion, Vector
from selecting import thin
from view import Show
from window import Hand


def main(cloud: str, blend: str, picture: str) -> Generator[float, None, dict[str, Any]]:
    """Show splats with one thing more each time; return where the view lies on the screen.

    Parameters
    ----------
    cloud
        A file of splats.
    blend
        Where the splats are saved, to be linked from there.
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
    show.call(bpy.ops.refine.import_ply, filepath=cloud)
    splats = bpy.context.object
    thin(splats)
    look_down(show.area.spaces.active)
    found: dict[str, Any] = show.numbers()
    yield from show.picture("plain")
    yield from overlays(show)
    yield from glass(show)
    yield from instances(show, splats, blend)
    show.call(bpy.ops.refine.make_real)
    found["real"] = len(bpy.context.object.data.vertices)
    yield from crop(show, bpy.context.object)
    found["failure"] = show.draw.failure()
    return found


def look_down(space: bpy.types.SpaceView3D) -> None:
    """Look at the middle of the room from above, without overlays."""
    space.show_region_ui = space.show_region_toolbar = space.show_region_header = False
    space.show_gizmo = space.overlay.show_overlays = False
    view = space.region_3d
    view.view_location, view.view_distance = Vector((0.0, 0.0, 1.0)), 9.0
    view.view_rotation = Quaternion((1.0, 0.0, 0.0), 0.6)


def overlays(show: Show) -> Generator[float, None, None]:
    """Show the grid, which lies behind splats in every version."""
    overlay = show.area.spaces.active.overlay
    overlay.show_overlays = True
    overlay.show_cursor = overlay.show_text = overlay.show_outline_selected = False
    overlay.show_object_origins = overlay.show_extras = False
    bpy.ops.object.select_all(action="DESELECT")
    beside = bpy.data.objects.new("beside", None)  # so that Blender's depth is looked at
    bpy.context.scene.collection.objects.link(beside)
    yield from show.picture("grid")
    bpy.data.objects.remove(beside)
    overlay.show_overlays = False


def glass(show: Show) -> Generator[float, None, None]:
    """Show a ball before the splats, and behind them, by X-ray and blended."""
    space = show.area.spaces.active
    show.call(bpy.ops.mesh.primitive_ico_sphere_add, radius=0.4, subdivisions=3)
    ball = bpy.context.object
    ball.select_set(False)
    material = bpy.data.materials.new("glass")
    material.diffuse_color = (0.0, 1.0, 0.0, 0.5)
    material.use_nodes, material.surface_render_method = True, "BLENDED"
    inputs = material.node_tree.nodes["Principled BSDF"].inputs
    inputs["Base Color"].default_value, inputs["Alpha"].default_value = (0.0, 1.0, 0.0, 1.0), 0.5
    ball.data.materials.append(material)
    toward = space.region_3d.view_rotation @ Vector((0.0, 0.0, 1.0))
    space.shading.show_xray = True
    for name, distance in (("front", 6.5), ("behind", -2.0)):
        ball.location = space.region_3d.view_location + toward * distance
        yield from show.picture(f"xray-{name}")
    space.shading.show_xray, space.shading.type = False, "MATERIAL"
    ball.location = space.region_3d.view_location + toward * 6.5
    yield 5.0  # shaders are compiled
    yield from show.picture("blended-front")
    space.shading.type = "SOLID"
    bpy.data.objects.remove(ball)


def crop(show: Show, splats: bpy.types.Object) -> Generator[float, None, None]:
    """Show a box that protects what is inside."""
    bpy.context.view_layer.objects.active = splats
    show.call(bpy.ops.refine.add_volume, role="PROTECT", shape="BOX")
    yield 1.0
    yield from show.picture("crop")


def instances(show: Show, splats: bpy.types.Object, blend: str) -> Generator[float, None, None]:
    """Show an instance of a collection in the place of the splats, then one of a linked one."""
    collection = bpy.data.collections.new("set")
    collection.objects.link(splats)
    bpy.data.libraries.write(blend, {collection}, fake_user=True)
    splats.hide_set(True)
    empty = bpy.data.objects.new("instance", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", collection
    bpy.context.scene.collection.objects.link(empty)
    yield 0.5
    yield from show.picture("instance")
    with bpy.data.libraries.load(blend, link=True) as (_, wanted):
        wanted.collections = ["set"]
    empty.instance_collection = wanted.collections[0]
    bpy.context.view_layer.objects.active = empty
    yield 0.5
    yield from show.picture("linked")
