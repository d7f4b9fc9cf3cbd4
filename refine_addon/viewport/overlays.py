"""What is drawn over splats: meshes that one sees through, and edges of the volumes in the panel.

Blender draws such meshes without depth, so what lies before splats cannot be told from what lies
behind them. They are mixed over all splats, the nearest face of each pixel, lit from the viewer.
"""

from __future__ import annotations

from itertools import product

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Color, Vector
from numpy.typing import NDArray

from ..mesh.layout import looks_like_splats
from .arrays import GOES, MARKS, STAYS

_OPAQUE = 0.995
"""Opacity from which on Blender draws a mesh with its depth."""

_GRAY = (0.8, 0.8, 0.8, 1.0)

_COLORS = {"PROTECT": MARKS[STAYS], "REMOVE": MARKS[GOES], "KEEP": MARKS[GOES]}
"""By the role of a volume."""

_FILLED = {"SOLID", "TEXTURED"}
"""Display types of objects whose faces are drawn."""

_TURN = np.linspace(0.0, 2.0 * np.pi, 49)


def is_xray(shading: bpy.types.View3DShading) -> bool:
    """Tell whether a view sees through all meshes."""
    seen = {"SOLID": shading.show_xray, "WIREFRAME": shading.show_xray_wireframe}
    return bool(seen.get(shading.type))


def draw(context: bpy.types.Context) -> None:
    """Draw into a view, before its matrices."""
    shading = context.space_data.shading
    if shading.type != "WIREFRAME":
        if is_xray(shading):  # of which Blender 5 has kept the depth
            gpu.state.active_framebuffer_get().clear(depth=1.0)
        for obj in context.visible_objects:
            if obj.type == "MESH" and not looks_like_splats(obj) and obj.display_type in _FILLED:
                _mix(context, obj)
    for item in context.scene.refine.volumes:
        obj = item.object
        if obj is not None and obj.type == "EMPTY" and obj.visible_get(viewport=context.space_data):
            lines = _sphere() if obj.empty_display_type == "SPHERE" else _cube()
            _draw(lines * obj.empty_display_size, obj, _COLORS[item.role])


def _mix(context: bpy.types.Context, obj: bpy.types.Object) -> None:
    """Mix the faces of a mesh that are seen through with what has been drawn."""
    shading = context.space_data.shading
    materials = [slot.material for slot in obj.material_slots] or [None]
    colors = np.array([_color(obj, material, shading) for material in materials], np.float32)
    if (colors[:, 3] >= _OPAQUE).all():
        return
    mesh = obj.evaluated_get(context.evaluated_depsgraph_get()).data
    mesh.calc_loop_triangles()
    count = len(mesh.loop_triangles)
    corners, slots = np.empty(3 * count, np.int32), np.empty(count, np.int32)
    places, normals = np.empty(3 * len(mesh.vertices), np.float32), np.empty(3 * count, np.float32)
    mesh.loop_triangles.foreach_get("vertices", corners)
    mesh.loop_triangles.foreach_get("material_index", slots)
    mesh.loop_triangles.foreach_get("normal", normals)
    mesh.vertices.foreach_get("co", places)
    toward = context.region_data.view_rotation @ Vector((0.0, 0.0, 1.0))
    toward = (obj.matrix_world.to_3x3().transposed() @ toward).normalized()
    paint = colors[slots.clip(0, len(colors) - 1)]
    paint[:, :3] *= (0.4 + 0.6 * np.abs(normals.reshape(-1, 3) @ np.array(toward)))[:, None]
    seen = paint[:, 3] < _OPAQUE
    if not seen.any():
        return
    program = gpu.shader.from_builtin("SMOOTH_COLOR")
    corners = corners.reshape(-1, 3)[seen].ravel()
    content = {"pos": places.reshape(-1, 3)[corners], "color": np.repeat(paint[seen], 3, axis=0)}
    batch = batch_for_shader(program, "TRIS", content)
    gpu.state.depth_mask_set(True)
    with gpu.matrix.push_pop():
        gpu.matrix.multiply_matrix(obj.matrix_world)
        gpu.state.color_mask_set(False, False, False, False)
        gpu.state.depth_test_set("LESS_EQUAL")
        batch.draw(program)
        gpu.state.color_mask_set(True, True, True, True)
        gpu.state.depth_test_set("EQUAL")
        gpu.state.blend_set("ALPHA")
        batch.draw(program)
    gpu.state.blend_set("NONE")
    gpu.state.depth_mask_set(False)
    gpu.state.depth_test_set("NONE")


def _color(
    obj: bpy.types.Object, material: bpy.types.Material | None, shading: bpy.types.View3DShading
) -> tuple[float, ...]:
    """Colour of a material in a view, as it is shown, and its opacity."""
    color, opacity = _GRAY, 1.0
    if shading.type == "SOLID":
        if shading.color_type == "OBJECT":
            color = obj.color
        elif shading.color_type == "SINGLE":
            color = (*shading.single_color, 1.0)
        elif shading.color_type == "MATERIAL" and material is not None:
            color = material.diffuse_color
        opacity = color[3] * (shading.xray_alpha if shading.show_xray else 1.0)
    elif material is not None and material.surface_render_method == "BLENDED":
        color, opacity = material.diffuse_color, 0.5
        nodes = material.node_tree.nodes if material.node_tree else ()
        for node in nodes:
            if node.type == "BSDF_PRINCIPLED":
                color, alpha = node.inputs["Base Color"].default_value, node.inputs["Alpha"]
                opacity = 0.5 if alpha.is_linked else alpha.default_value
    return (*Color(color[:3]).from_scene_linear_to_srgb(), opacity)


def _cube() -> NDArray[np.float64]:
    """Return the ends of 12 edges, (24, 3)."""
    corners = np.array(list(product((-1.0, 1.0), repeat=3)))
    ends = [
        (one, other)
        for one, other in product(corners, corners)
        if np.count_nonzero(one != other) == 1 and one.sum() < other.sum()
    ]
    return np.array(ends).reshape(-1, 3)


def _sphere() -> NDArray[np.float64]:
    """Return the ends of the pieces of three circles, (288, 3)."""
    circle = np.stack([np.cos(_TURN), np.sin(_TURN), np.zeros_like(_TURN)], axis=1)
    pieces = np.stack([circle[:-1], circle[1:]], axis=1).reshape(-1, 3)
    return np.concatenate([np.roll(pieces, turn, axis=1) for turn in range(3)])


def _draw(
    lines: NDArray[np.float64], obj: bpy.types.Object, color: tuple[float, float, float]
) -> None:
    program = gpu.shader.from_builtin("UNIFORM_COLOR")
    gpu.state.depth_test_set("NONE")
    with gpu.matrix.push_pop():
        gpu.matrix.multiply_matrix(obj.matrix_world)
        program.uniform_float("color", (*color, 1.0))
        batch_for_shader(program, "LINES", {"pos": lines.astype(np.float32)}).draw(program)
