"""Look at splats among other objects: meshes one sees through, a crop box, the grid, instances."""

from __future__ import annotations

import bpy
from clouds import scatter
from hand import begin
from mathutils import Quaternion, Vector


def main(cloud, pictures):
    """Show splats with one thing more each time; return where the view lies on the screen."""
    hand = yield from begin(pictures, cloud)
    splats, view = bpy.context.object, hand.space.region_3d
    hand.plain()
    hand.space.shading.background_type = "THEME"
    view.view_location, view.view_distance = Vector((0.0, 0.0, 1.0)), 9.0  # the room, from above
    view.view_rotation = Quaternion((1.0, 0.0, 0.0), 0.6)
    found = hand.numbers()
    yield from hand.shown("among-plain")
    yield from grid(hand)
    yield from glass(hand)
    yield from instances(hand, splats)
    hand.do(bpy.ops.refine.make_real)
    found["real"] = len(bpy.context.object.data.vertices)
    yield from hand.undo()
    found["undone"] = bpy.context.object.name
    yield from hand.undo(redo=True)
    hand.call(bpy.ops.refine.add_volume, role="PROTECT", shape="BOX")
    yield 1.0
    hand.space.overlay.show_overlays = True
    yield from hand.shown("among-crop")
    found["failure"] = hand.draw.failure()
    return found


def grid(hand):
    """Show the grid, which lies behind splats in every version."""
    overlay = hand.space.overlay
    overlay.show_overlays = True
    overlay.show_cursor = overlay.show_text = overlay.show_outline_selected = False
    overlay.show_object_origins = overlay.show_extras = False
    bpy.ops.object.select_all(action="DESELECT")
    beside = bpy.data.objects.new("beside", None)  # so that Blender's depth is looked at
    bpy.context.scene.collection.objects.link(beside)
    yield from hand.shown("among-grid")
    bpy.data.objects.remove(beside)
    overlay.show_overlays = False


def glass(hand):
    """Show a ball before the splats, and behind them, by X-ray and blended."""
    space = hand.space
    hand.call(bpy.ops.mesh.primitive_ico_sphere_add, radius=0.4, subdivisions=3)
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
    for name, distance in (("xray-behind", -2.0), ("xray-front", 6.5)):
        ball.location = space.region_3d.view_location + toward * distance
        yield from hand.shown(f"among-{name}")
    space.shading.show_xray, space.shading.type = False, "MATERIAL"
    yield 5.0  # shaders are compiled
    yield from hand.shown("among-blended-front")
    space.shading.type = "SOLID"
    bpy.data.objects.remove(ball)


def instances(hand, splats):
    """Show instances in the place of the splats: by nodes, of their geometry; of a collection."""
    splats.hide_set(True)
    point = bpy.data.objects.new("point", bpy.data.meshes.new("point"))
    point.data.vertices.add(1)
    bpy.context.scene.collection.objects.link(point)
    scatter(point, splats, as_instance=False)
    yield 0.5
    yield from hand.shown("among-scatter")
    bpy.data.objects.remove(point)
    collection = bpy.data.collections.new("set")
    collection.objects.link(splats)
    empty = bpy.data.objects.new("instance", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", collection
    bpy.context.scene.collection.objects.link(empty)
    yield 0.5
    yield from hand.shown("among-instance")
    bpy.context.view_layer.objects.active = empty
    hand.call(bpy.ops.ed.undo_push)
