"""Apply and join objects of splats as Blender does, and mend them."""

from __future__ import annotations

import importlib
from typing import Any

import bpy
import clouds
import extension
import mathutils
import numpy as np

PLACES = [
    mathutils.Matrix.LocRotScale((1, -2, 0.5), mathutils.Euler((0.4, -0.7, 1.1)), (1.3, 1.3, 1.3)),
    mathutils.Matrix.LocRotScale((0, 1, 0), mathutils.Euler((-1.0, 0.2, 0.3)), (-0.7, 0.7, 0.7)),
]


def main(cloud: str) -> dict[str, Any]:
    """Return how far shapes and colours are off after each step, and what was said of it.

    Parameters
    ----------
    cloud
        A file of splats.
    """
    found = {}
    for form in ("MESH", "POINTCLOUD"):
        for step in (blenders_apply, *((blenders_join,) if form == "MESH" else ())):
            bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
            extension.enable()
            objects = [imported(cloud, form, place) for place in PLACES]
            before = seen(objects)
            said = step(objects)
            left = [obj for obj in bpy.context.scene.objects if obj.type == form]
            found[f"{form} {step.__name__}"] = [said, apart(before, seen(left))]
    return found


def imported(cloud: str, form: str, place: mathutils.Matrix) -> bpy.types.Object:
    """Import a file into an object of a type that stands somewhere."""
    bpy.ops.refine.import_ply(filepath=cloud)
    if form == "POINTCLOUD":
        package = importlib.import_module(extension.MODULE)
        package.mesh.drift.stamp(clouds.as_cloud(package, bpy.context.object).data)
    bpy.context.object.matrix_world = place
    bpy.context.view_layer.update()
    return bpy.context.object


def blenders_apply(objects: list[bpy.types.Object]) -> list[str]:
    """Ctrl+A."""
    select(objects)
    bpy.ops.object.transform_apply()
    return mended(objects)


def blenders_join(objects: list[bpy.types.Object]) -> list[str]:
    """Ctrl+J."""
    select(objects)
    bpy.ops.object.join()
    return mended([bpy.context.object])


def mended(objects: list[bpy.types.Object]) -> list[str]:
    """Mend objects; return what was said before, and what is said still."""
    drift = importlib.import_module(f"{extension.MODULE}.ui.transforms")
    said = [sentence for obj in objects if drift.of(obj) for sentence in drift.of(obj).told]
    if said:
        select(objects)
        bpy.ops.refine.mend()
        said += [f"still {obj.name}" for obj in objects if drift.of(obj)]
    return said


def select(objects: list[bpy.types.Object]) -> None:
    """Select objects; the first is the active one."""
    bpy.ops.object.select_all(action="DESELECT")
    for obj in objects:
        obj.select_set(True)
    bpy.context.view_layer.objects.active = objects[0]


def seen(objects: list[bpy.types.Object]) -> Any:
    """Return the splats of objects as they stand in the world."""
    package = importlib.import_module(extension.MODULE)
    check, gather = package.mesh.layout.check, package.objects.splat_group.gather
    bpy.context.view_layer.update()
    return gather([check(obj) for obj in objects], whole=True)


def apart(one: Any, other: Any) -> float:
    """Return the largest difference of means, covariances and harmonics."""
    package = importlib.import_module(extension.MODULE)
    pairs = [(one.means, other.means), (one.sh_rest, other.sh_rest)]
    shapes = [package.viewport.arrays.pack(splats).covariances for splats in (one, other)]
    return max(float(np.abs(a - b).max()) for a, b in [*pairs, shapes])
