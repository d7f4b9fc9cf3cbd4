"""Meshes that one sees through, as a picture of their own: colour, opacity and depth.

Blender draws them without depth, and what lies behind splats cannot be told from what lies before
them afterwards. So they are drawn once more, the nearest face of each pixel, and every splat behind
that face is mixed with its colour; blended front to back that is the mesh before these splats.
Colours are those of the viewport, lit from the viewer; nodes are not run.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from typing import NamedTuple

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix
from numpy.typing import NDArray

from ..mesh.layout import looks_like_splats

Color = tuple[float, float, float, float]

OPAQUE = 0.995
"""Opacity from which on Blender draws a mesh with its depth."""

_VERTEX = """
void main()
{
  vec4 seen = to_camera * vec4(pos, 1.0);
  place = seen.xyz;
  paint = tint;
  gl_Position = projection * seen;
}
"""

_FRAGMENT = """
void main()
{
  vec3 across = normalize(cross(dFdx(place), dFdy(place)));
  color = vec4(paint.rgb * (0.4 + 0.6 * abs(across.z)), paint.a);
  depth = gl_FragCoord.z;
}
"""


class Veils(NamedTuple):
    """The nearest face of each pixel: its colour with its opacity, and its depth in 0..1."""

    colors: gpu.types.GPUTexture
    depths: gpu.types.GPUTexture


class _Look(NamedTuple):
    """How a view draws meshes: what decides which are seen through, in which colours."""

    kind: str
    colors: str
    single: Color
    opacity: float  # of all meshes

    @classmethod
    def of(cls, shading: bpy.types.View3DShading) -> _Look:
        xray = {"SOLID": shading.show_xray, "WIREFRAME": shading.show_xray_wireframe}
        opacity = 1.0
        if xray.get(shading.type):
            solid = shading.type == "SOLID"
            opacity = shading.xray_alpha if solid else shading.xray_alpha_wireframe
        single = (*shading.single_color, 1.0)
        return cls(shading.type, shading.color_type, single, opacity)


def seen_through(
    objects: Iterable[bpy.types.Object], shading: bpy.types.View3DShading
) -> list[tuple[bpy.types.Object, list[Color]]]:
    """Return the meshes that a view draws transparent, with the colour of each material.

    Parameters
    ----------
    objects : iterable of bpy.types.Object
        Those that are visible.
    shading : bpy.types.View3DShading
        Of the view.
    """
    look = _Look.of(shading)
    if look.kind == "WIREFRAME" and look.opacity == 1.0:
        return []
    found = []
    for obj in objects:
        if obj.type != "MESH" or looks_like_splats(obj) or obj.display_type in {"WIRE", "BOUNDS"}:
            continue
        colors = [_color(obj, slot.material, look) for slot in obj.material_slots]
        colors = colors or [_color(obj, None, look)]
        if any(color[3] < OPAQUE for color in colors):
            found.append((obj, colors))
    return found


def _color(obj: bpy.types.Object, material: bpy.types.Material | None, look: _Look) -> Color:
    if look.kind in {"MATERIAL", "RENDERED"}:
        return _blended(material)
    color = (0.8, 0.8, 0.8, 1.0)
    if look.colors == "OBJECT":
        color = tuple(obj.color)
    elif look.colors == "SINGLE":
        color = look.single
    elif look.colors == "MATERIAL" and material is not None:
        color = tuple(material.diffuse_color)
    return (*color[:3], color[3] * look.opacity)


def _blended(material: bpy.types.Material | None) -> Color:
    """Return the colour of a material that EEVEE blends, of others without transparency."""
    if material is None or material.surface_render_method != "BLENDED":
        return (0.8, 0.8, 0.8, 1.0)
    nodes = material.node_tree.nodes if material.node_tree else ()
    for node in nodes:
        if node.type == "BSDF_PRINCIPLED":
            color, alpha = node.inputs["Base Color"], node.inputs["Alpha"]
            opacity = 0.5 if alpha.is_linked else alpha.default_value
            shown = material.diffuse_color if color.is_linked else color.default_value
            return (*tuple(shown)[:3], opacity)
    return (*tuple(material.diffuse_color)[:3], 0.5)


def draw(
    meshes: list[tuple[bpy.types.Object, list[Color]]],
    depsgraph: bpy.types.Depsgraph,
    matrices: tuple[NDArray[np.float64], NDArray[np.float64]],
    size: tuple[int, int],
) -> Veils:
    """Draw meshes that are seen through.

    Parameters
    ----------
    meshes : list of (bpy.types.Object, list of Color)
        See `seen_through`.
    depsgraph : bpy.types.Depsgraph
    matrices : (4, 4) float64, (4, 4) float64
        World to camera, and the projection.
    size : (int, int)
        Of the picture, pixels.
    """
    colors = gpu.types.GPUTexture(size, format="RGBA16F")
    depths = gpu.types.GPUTexture(size, format="R32F")
    buffer = gpu.types.GPUTexture(size, format="DEPTH_COMPONENT32F")
    frame = gpu.types.GPUFrameBuffer(depth_slot=buffer, color_slots=(colors, depths))
    program = _program()
    with frame.bind():
        frame.clear(color=(0.0, 0.0, 0.0, 0.0), depth=1.0)
        gpu.state.blend_set("NONE")
        gpu.state.depth_test_set("LESS")
        gpu.state.depth_mask_set(True)
        program.bind()
        program.uniform_float("projection", Matrix(matrices[1]))
        for obj, table in meshes:
            places, paint = _triangles(obj.evaluated_get(depsgraph), table)
            if len(places):
                world = np.array(obj.matrix_world, np.float64)
                program.uniform_float("to_camera", Matrix(matrices[0] @ world))
                content = {"pos": places, "tint": paint}
                batch_for_shader(program, "TRIS", content).draw(program)
        gpu.state.depth_mask_set(False)
        gpu.state.depth_test_set("NONE")
    return Veils(colors, depths)


def _triangles(
    evaluated: bpy.types.Object, table: list[Color]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the corners of triangles, (3 T, 3), and their colours, encoded, (3 T, 4)."""
    mesh = evaluated.data
    mesh.calc_loop_triangles()
    count = len(mesh.loop_triangles)
    corners, slots = np.empty(3 * count, np.int32), np.empty(count, np.int32)
    places = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.loop_triangles.foreach_get("vertices", corners)
    mesh.loop_triangles.foreach_get("material_index", slots)
    mesh.vertices.foreach_get("co", places)
    colors = np.array(table, np.float32)
    linear = colors[:, :3].clip(0.0, 1.0)
    curved = 1.055 * np.maximum(linear, 1e-6) ** (1 / 2.4) - 0.055  # sRGB, IEC 61966-2-1
    colors[:, :3] = np.where(linear > 0.0031308, curved, 12.92 * linear)
    paint = colors[np.repeat(slots.clip(0, len(table) - 1), 3)]
    return places.reshape(-1, 3)[corners], paint


def forget() -> None:
    """Let go of the shader."""
    _program.cache_clear()


@cache
def _program() -> gpu.types.GPUShader:
    info = gpu.types.GPUShaderCreateInfo()
    info.push_constant("MAT4", "to_camera")
    info.push_constant("MAT4", "projection")
    info.vertex_in(0, "VEC3", "pos")
    info.vertex_in(1, "VEC4", "tint")
    between = gpu.types.GPUStageInterfaceInfo("refine_veil")
    between.smooth("VEC3", "place")
    between.flat("VEC4", "paint")
    info.vertex_out(between)
    info.fragment_out(0, "VEC4", "color")
    info.fragment_out(1, "FLOAT", "depth")
    info.vertex_source(_VERTEX)
    info.fragment_source(_FRAGMENT)
    return gpu.shader.create_from_info(info)
