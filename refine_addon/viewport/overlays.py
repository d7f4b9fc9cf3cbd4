"""Overlays over splats: see-through meshes, edges of volumes, the legend.
Blender draws see-through meshes without depth, so they are drawn here once more, over all splats,
lit from the viewer."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from itertools import product
from typing import Any

import blf
import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Color, Vector
from numpy.typing import NDArray

from ..mesh import attributes
from ..mesh.layout import looks_like_splats
from .arrays import GOES, MARKS, STAYS, ramp

_OPAQUE = 0.995  # Least opacity at which Blender draws a mesh with depth

_COLORS = {"PROTECT": MARKS[STAYS], "REMOVE": MARKS[GOES], "KEEP": MARKS[STAYS]}
"""Role of a volume -> colour of its edges, by what becomes of the splats inside."""

_FILLED = {"SOLID", "TEXTURED"}  # Display types of objects whose faces are drawn
WORDS = {"HEAT": ("goes first", "goes last"), "STAYS": ("What stays",), "GOES": ("What goes",)}
MARKED = {STAYS: "Protected", GOES: "Must go"}  # Text beside tints of protected and removed splats
_REDUNDANT = {(STAYS, "GOES"), (GOES, "STAYS")}  # Mark and a mode in which no splat has it
_WIDE, _HIGH, _EDGE, _FONT = 220, 10, 16, 12  # pixels at scale 1
_GAP = 6  # between the bar and the words above it
_WHITE, _BLACK = (1.0, 1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 1.0)
_WARNING = (1.0, 0.8, 0.2, 1.0)
_TURN = np.linspace(0.0, 2.0 * np.pi, 49)
CIRCLE = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1)  # Points of a circle, closed, (49, 2)


def draw(context: bpy.types.Context, *, mixed: bool, has_depths: bool) -> None:
    """Draw edges of volumes into a view, and if `mixed` see-through meshes.
    Without `has_depths` the view's depths are cleared first; see `view.View`."""
    if mixed and context.space_data.shading.type != "WIREFRAME":
        if not has_depths:
            gpu.state.active_framebuffer_get().clear(depth=1.0)
        for obj in context.visible_objects:
            if obj.type == "MESH" and not looks_like_splats(obj) and obj.display_type in _FILLED:
                _mix(context, obj)
    for item in context.scene.refine.volumes:
        obj = item.object
        if obj is not None and obj.type == "EMPTY" and obj.visible_get(viewport=context.space_data):
            lines = _edges(obj.empty_display_type)
            colors = np.tile((*_COLORS[item.role], 1.0), (len(lines), 1))
            with gpu.matrix.push_pop():
                gpu.matrix.multiply_matrix(obj.matrix_world)
                shape("LINES", lines * obj.empty_display_size, colors)()


def _mix(context: bpy.types.Context, obj: bpy.types.Object) -> None:
    """Draw an object's see-through faces over the splats."""
    shading = context.space_data.shading
    materials = [slot.material for slot in obj.material_slots] or [None]
    colors = np.array([_color(obj, material, shading) for material in materials], np.float32)
    if (colors[:, 3] >= _OPAQUE).all():
        return
    mesh = obj.evaluated_get(context.evaluated_depsgraph_get()).data
    places, corners = attributes.read_triangles(mesh)
    slots = attributes.read_field(mesh.loop_triangles, "material_index", np.int32)
    normals = attributes.read_field(mesh.loop_triangles, "normal", np.float32, 3)
    toward = context.region_data.view_rotation @ Vector((0.0, 0.0, 1.0))
    toward = (obj.matrix_world.to_3x3().transposed() @ toward).normalized()
    paint = colors[slots.clip(0, len(colors) - 1)]
    paint[:, :3] *= (0.4 + 0.6 * np.abs(normals @ np.array(toward)))[:, None]
    seen = paint[:, 3] < _OPAQUE
    if not seen.any():
        return
    faces = shape("TRIS", places[corners[seen].ravel()], np.repeat(paint[seen], 3, axis=0))
    gpu.state.depth_mask_set(True)
    with gpu.matrix.push_pop():
        gpu.matrix.multiply_matrix(obj.matrix_world)
        gpu.state.color_mask_set(False, False, False, False)
        gpu.state.depth_test_set("LESS_EQUAL")
        faces()
        gpu.state.color_mask_set(True, True, True, True)
        gpu.state.depth_test_set("EQUAL")
        gpu.state.blend_set("ALPHA")
        faces()
    gpu.state.blend_set("NONE")
    gpu.state.depth_mask_set(False)
    gpu.state.depth_test_set("NONE")


def _color(
    obj: bpy.types.Object, material: bpy.types.Material | None, shading: bpy.types.View3DShading
) -> tuple[float, ...]:
    color, opacity = (0.8, 0.8, 0.8, 1.0), 1.0
    if shading.type == "SOLID":
        colors = {"OBJECT": obj.color, "MATERIAL": material and material.diffuse_color}
        color = colors.get(shading.color_type) or color
        opacity = color[3] * (shading.xray_alpha if shading.show_xray else 1.0)
    elif material is not None and material.surface_render_method == "BLENDED":
        color, opacity = material.diffuse_color, 0.5
        for node in material.node_tree.nodes if material.node_tree else ():
            if node.type == "BSDF_PRINCIPLED":
                color, alpha = node.inputs["Base Color"].default_value, node.inputs["Alpha"]
                opacity = 0.5 if alpha.is_linked else alpha.default_value
    return (*Color(color[:3]).from_scene_linear_to_srgb(), opacity)


def _edges(shape: str) -> NDArray[np.float64]:
    """End points of a cube's edges, (24, 3), or of the segments of three circles, (288, 3)."""
    if shape == "SPHERE":
        circle = np.pad(CIRCLE, ((0, 0), (0, 1)))
        pieces = np.stack([circle[:-1], circle[1:]], axis=1).reshape(-1, 3)
    else:
        signs = (-1.0, 1.0)
        pieces = np.array([(x, y, z) for y, z in product(signs, signs) for x in signs])
    return np.concatenate([np.roll(pieces, turn, axis=1) for turn in range(3)])


def draw_legend(
    context: bpy.types.Context, mode: str, marks: Collection[int], warnings: Collection[str]
) -> None:
    """Draw the legend of a mode and of marks (`MARKED`) into a view, warnings above it.
    It is at the lower right: Blender opens *Adjust Last Operation* at the lower left."""
    scale = context.preferences.system.ui_scale
    blf.size(0, _FONT * scale)
    line, high, wide = _EDGE * scale, _HIGH * scale, _WIDE * scale
    widest = max([wide, *(blf.dimensions(0, text)[0] for text in warnings)])
    x = max(_right(context) - widest - _EDGE * scale, 0.0)
    blf.color(0, *_WHITE)
    blf.enable(0, blf.SHADOW)
    blf.shadow(0, 5, *_BLACK)  # a blur of 0, 3 or 5
    if mode == "HEAT":
        _bar(x, line, wide, high, ramp()[::8])
        line += high + _GAP * scale
    if mode in WORDS:
        for index, text in enumerate(WORDS[mode]):  # the second ends where the bar does
            _write(text, x + index * (wide - blf.dimensions(0, text)[0]), line)
        line += 2 * high
    for mark, text in MARKED.items():
        if mark in marks and (mark, mode) not in _REDUNDANT:
            _write(text, x + 2 * high, line)
            _bar(x, line, high, high, (MARKS[mark],) * 2)
            line += 2 * high
    blf.color(0, *_WARNING)
    for text in warnings:
        _write(text, x, line)
        line += 2 * high
    blf.disable(0, blf.SHADOW)


def _write(text: str, x: float, y: float) -> None:
    blf.position(0, x, y, 0.0)
    blf.draw(0, text)


def _right(context: bpy.types.Context) -> int:
    """Right end of the room for the legend: the sidebar or the region's end, pixels."""
    left, region = context.region.x, context.region
    sidebars = (each for each in context.area.regions if each.type == "UI" and each.width > 1)
    return min([region.width, *(each.x - left for each in sidebars if each.x > left)])


def _bar(x: float, y: float, wide: float, high: float, colors: Any) -> None:
    places = [
        (x + wide * k / (len(colors) - 1), y + up) for k in range(len(colors)) for up in (0, high)
    ]
    painted = np.repeat(np.pad(colors, ((0, 0), (0, 1)), constant_values=1.0), 2, axis=0)
    shape("TRI_STRIP", places, painted)()


def shape(kind: str, places: Any, colors: Any) -> Callable[[], None]:
    """What draws a shape of one of Blender's kinds, with a colour at each of its places."""
    program = gpu.shader.from_builtin("SMOOTH_COLOR")
    content = {"pos": np.asarray(places, np.float32), "color": np.asarray(colors, np.float32)}
    return partial(batch_for_shader(program, kind, content).draw, program)
