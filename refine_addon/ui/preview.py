"""Splats that Cycles renders as they are: a geometry nodes modifier and a material.

Each Gaussian is integrated along the ray, blended in depth order; for a few hundred thousand.
Harmonics beyond the constant are not shown. The 3D views draw splats by themselves (`viewport`).
"""

from __future__ import annotations

from math import e

import bpy

from ..core.errors import RefineError
from ..mesh import attributes as mesh_attributes
from ..mesh import edit as mesh_edit
from ..mesh import heat_map
from ..mesh import scores as mesh_scores
from ..mesh.layout import check
from ..mesh.node_trees import (
    add,
    chain,
    logistic,
    make_empty,
    math,
    named_attribute,
    vector_math,
)
from ..version import VERSION

MODIFIER = "REFINE preview"
"""Name of the modifier."""

MODES = {"COLOR": heat_map.COLOR, "HEAT": heat_map.HEAT}
"""What can be shown -> the colour attribute that holds it."""

MADE_BY = "refine_version"
"""Custom property of our node groups and materials: the version of the add-on that made them. Those
of another version, from an old .blend, are made anew in place, so that what uses them follows."""

_LEAST = 1 / 255
"""Opacity below which a Gaussian is not drawn, as in the reference rasterizer."""

_CIRCUMSCRIBED = 1.26
"""Radius of an icosphere of 20 faces over that of the sphere inside it."""


def show(obj: bpy.types.Object, mode: str) -> bpy.types.Modifier:
    """Show the splats of an object by a modifier; the mesh but gains a colour attribute.

    Parameters
    ----------
    obj : bpy.types.Object
    mode : {"COLOR", "HEAT"}
        The splats' own colour, or the heat map of their ranks.

    Returns
    -------
    bpy.types.Modifier
        The same one as before if the object is shown already.

    Raises
    ------
    RefineError
        If the object holds no splats, or cannot be changed, or is a point cloud; for the heat map,
        if it was not scored.
    """
    checked = check(obj)
    mesh_edit.check_writable(obj)
    if obj.type == "POINTCLOUD":
        msg = f"object '{obj.name}': is a point cloud; convert it to a mesh to see it as splats"
        raise RefineError(msg)
    if mode == "HEAT" and not has_heat(obj):
        msg = f"object '{obj.name}': has no heat map; score it first"
        raise RefineError(msg)
    if mode == "COLOR" and heat_map.COLOR not in obj.data.attributes:
        heat_map.write_base_color(checked)
    modifier = obj.modifiers.get(MODIFIER) or obj.modifiers.new(MODIFIER, "NODES")
    modifier.node_group = _tree(mode)
    _purge()
    return modifier


def hide(obj: bpy.types.Object) -> None:
    """Undo `show`."""
    modifier = obj.modifiers.get(MODIFIER)
    if modifier:
        obj.modifiers.remove(modifier)
    if not obj.data.library:
        mesh_attributes.remove_attribute(obj.data, heat_map.COLOR)
    _purge()


def has_heat(obj: bpy.types.Object) -> bool:
    """Tell whether an object has a heat map."""
    return heat_map.HEAT in obj.data.attributes and mesh_scores.RANK in obj.data.attributes


def shown(obj: bpy.types.Object) -> str:
    """Return which mode is shown, "" if none."""
    modifier = obj.modifiers.get(MODIFIER)
    tree = modifier.node_group if modifier else None
    return "" if tree is None else str(tree.get("mode", ""))


def set_up_render(scene: bpy.types.Scene, samples: int = 1) -> None:
    """Make a scene render splats as they are: Cycles, plain colours, no light.

    Parameters
    ----------
    scene : bpy.types.Scene
    samples : int
        Rays a pixel.
    """
    scene.render.engine = "CYCLES"
    cycles = scene.cycles
    cycles.samples = samples
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.max_bounces = 0
    # Paths ended by chance would be noise: all that a pixel looks through counts.
    cycles.transparent_max_bounces = cycles.min_transparent_bounces = 256
    scene.view_settings.view_transform = "Standard"
    scene.view_settings.look = "None"


def _tree(mode: str) -> bpy.types.NodeTree:
    """Return the node group of a mode; objects share it."""
    name = _name(mode)
    tree = bpy.data.node_groups.get((name, None))  # not one that is linked from a library
    if tree and tree.get(MADE_BY) == VERSION:
        return tree
    tree = tree or bpy.data.node_groups.new(name, "GeometryNodeTree")
    make_empty(tree)
    tree["mode"], tree[MADE_BY] = mode, VERSION
    chain(tree, _splats(tree, _material(mode)))
    return tree


def _name(mode: str) -> str:
    """Return the name of the node group and the material of a mode."""
    return f"REFINE {mode.lower()} splats"


def _splats(tree: bpy.types.NodeTree, material: bpy.types.Material) -> list[bpy.types.Node]:
    """Return nodes that draw an ellipsoid around each Gaussian, which the material fills."""
    opaque = logistic(tree, named_attribute(tree, "opacity", "FLOAT"))
    reach = math(tree, "SQRT", _squared_reach(tree, opaque))
    scale = add(tree, "ShaderNodeCombineXYZ")
    for axis in range(3):
        size = math(tree, "EXPONENT", named_attribute(tree, f"scale_{axis}", "FLOAT"))
        tree.links.new(math(tree, "MULTIPLY", size, reach), scale.inputs[axis])
    rotation = add(tree, "FunctionNodeQuaternionToRotation")
    for index in range(4):
        tree.links.new(named_attribute(tree, f"rot_{index}", "FLOAT"), rotation.inputs[index])
    ball = add(tree, "GeometryNodeMeshIcoSphere")
    ball.inputs["Radius"].default_value = _CIRCUMSCRIBED
    ball.inputs["Subdivisions"].default_value = 1
    paint = add(tree, "GeometryNodeSetMaterial")
    paint.inputs["Material"].default_value = material
    tree.links.new(ball.outputs["Mesh"], paint.inputs["Geometry"])
    instances = add(tree, "GeometryNodeInstanceOnPoints")
    tree.links.new(paint.outputs["Geometry"], instances.inputs["Instance"])
    tree.links.new(rotation.outputs[0], instances.inputs["Rotation"])
    tree.links.new(scale.outputs[0], instances.inputs["Scale"])
    return [add(tree, "GeometryNodeMeshToPoints"), instances]


def _material(mode: str) -> bpy.types.Material:
    name = _name(mode)
    material = bpy.data.materials.get((name, None))
    if material and material.get(MADE_BY) == VERSION:
        return material
    material = material or bpy.data.materials.new(name)
    material[MADE_BY] = VERSION
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    color = add(tree, "ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name=MODES[mode])
    light = add(tree, "ShaderNodeEmission")
    tree.links.new(color.outputs["Color"], light.inputs["Color"])
    mix = add(tree, "ShaderNodeMixShader")
    tree.links.new(_gaussian(tree), mix.inputs[0])
    tree.links.new(add(tree, "ShaderNodeBsdfTransparent").outputs[0], mix.inputs[1])
    tree.links.new(light.outputs[0], mix.inputs[2])
    tree.links.new(mix.outputs[0], add(tree, "ShaderNodeOutputMaterial").inputs["Surface"])
    return material


def _squared_reach(tree: bpy.types.NodeTree, opaque: bpy.types.NodeSocket) -> bpy.types.NodeSocket:
    """Return the squared distance, in standard deviations, at which opacity falls to `_LEAST`."""
    above = math(tree, "MAXIMUM", math(tree, "DIVIDE", opaque, _LEAST), 1.0)
    return math(tree, "MULTIPLY", math(tree, "LOGARITHM", above, e), 2.0)


def _gaussian(tree: bpy.types.NodeTree) -> bpy.types.NodeSocket:
    """Return the opacity of a Gaussian along the ray, where the ray enters its ellipsoid.

    In the frame in which the ellipsoid is a ball, at the squared distance ``b2`` of the ray from
    its centre: ``opacity exp(-b2 reach^2 / 2)``, the largest value along the ray.
    """
    geometry = add(tree, "ShaderNodeNewGeometry")
    local = []
    for kind, output in (("POINT", "Position"), ("VECTOR", "Incoming")):
        node = add(
            tree,
            "ShaderNodeVectorTransform",
            vector_type=kind,
            convert_from="WORLD",
            convert_to="OBJECT",
        )
        tree.links.new(geometry.outputs[output], node.inputs[0])
        local.append(node.outputs[0])
    point, ray = local[0], vector_math(tree, "NORMALIZE", local[1])
    along = vector_math(tree, "DOT_PRODUCT", point, ray)
    distance = math(
        tree,
        "SUBTRACT",
        vector_math(tree, "DOT_PRODUCT", point, point),
        math(tree, "MULTIPLY", along, along),
    )
    logit = add(tree, "ShaderNodeAttribute", attribute_type="INSTANCER", attribute_name="opacity")
    opaque = logistic(tree, logit.outputs["Fac"])
    spread = math(tree, "MULTIPLY", _squared_reach(tree, opaque), -0.5)
    density = math(tree, "EXPONENT", math(tree, "MULTIPLY", distance, spread))
    entering = math(tree, "SUBTRACT", 1.0, geometry.outputs["Backfacing"])
    return math(tree, "MULTIPLY", density, math(tree, "MULTIPLY", opaque, entering))


def _purge() -> None:
    """Remove the node groups and materials of ours that nothing uses any more."""
    for blocks in (bpy.data.node_groups, bpy.data.materials):
        for name in map(_name, MODES):
            block = blocks.get(name)
            if block and not block.users:
                blocks.remove(block)
