"""What panel and command do to a mesh and a point cloud, and what Blender does: in any version."""

from __future__ import annotations

import importlib.metadata

import bpy
import clouds
import extension
import numpy as np
from mathutils import Euler, Matrix

PLACES = [
    Matrix.LocRotScale((1, -2, 0.5), Euler((0.4, -0.7, 1.1)), (1.3, 1.3, 1.3)),
    Matrix.LocRotScale((0, 1, 0), Euler((-1.0, 0.2, 0.3)), (-0.7, 0.7, 0.7)),
]


def main(cloud, few, cameras, folder):
    """Return where the code came from, and how many splats each step left."""
    empty()
    import plyfile

    package = extension.module("")
    found = {
        "places": [package.__file__, plyfile.__file__],
        "plyfile": importlib.metadata.version("plyfile"),
    }
    for form in ("MESH", "POINTCLOUD"):
        found[form] = pruned(form, cloud, cameras, folder)
    found["processes"] = processes(cloud, cameras)
    words = ["prune", cloud, "--cameras", cameras, "--ratio", "0.5", "--method", "occlusion"]
    found["code"] = extension.module("command").main([*words, "-o", f"{folder}/command.ply"])
    found["mended"] = {
        f"{form} {step}": mended(step, form, few)
        for form, step in (("MESH", "apply"), ("MESH", "join"), ("POINTCLOUD", "apply"))
    }
    return found


def empty():
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    extension.enable()


def imported(cloud, form):
    """Import a file into an object of a type."""
    bpy.ops.refine.import_ply(filepath=cloud)
    if form == "POINTCLOUD":
        package = extension.module("")
        package.mesh.drift.stamp(clouds.as_cloud(package, bpy.context.object).data)
    return bpy.context.object


def count(obj):
    return len(obj.data.vertices if obj.type == "MESH" else obj.data.points)


def pruned(form, cloud, cameras, folder):
    """Import, score, apply, save, open, export; return the numbers of splats and cameras."""
    empty()
    splats = imported(cloud, form)
    bpy.ops.refine.import_cameras(filepath=cameras)
    # That may have made one of them active; the panel's buttons act on the active object.
    bpy.context.view_layer.objects.active = splats
    found = [splats.type, count(splats), len(bpy.data.cameras)]
    bpy.context.scene.refine.method = "occlusion"
    bpy.ops.refine.score()
    bpy.ops.refine.apply()
    name = splats.name
    bpy.ops.wm.save_as_mainfile(filepath=f"{folder}/{form}.blend")
    bpy.ops.wm.open_mainfile(filepath=f"{folder}/{form}.blend")
    bpy.context.view_layer.objects.active = bpy.data.objects[name]
    bpy.ops.refine.export_ply(filepath=f"{folder}/{form}.ply")
    return [*found, count(bpy.data.objects[name])]


def processes(cloud, cameras):
    """Score on two threads; return how many processes did it."""
    core, execute = extension.module("core"), extension.module("core.execute")
    views = core.read_cameras(cameras)
    core.score(core.read_ply(cloud).splats(), views, core.Occlusion(), threads=2)
    found = len(execute._idle)
    execute.end_idle()
    return found


def mended(step, form, cloud):
    """Do it to two objects and mend them; return what was said, still is, and is left apart."""
    empty()
    objects = [imported(cloud, form) for _ in PLACES]
    for obj, place in zip(objects, PLACES, strict=True):
        obj.matrix_world = place
    before, drift = seen(objects), extension.module("mesh.drift")
    extension.select(*objects)
    bpy.ops.object.join() if step == "join" else bpy.ops.object.transform_apply()
    left = [obj for obj in bpy.context.scene.objects if obj.type == form]
    said = [drift.of(obj).sentences for obj in left if drift.of(obj)]
    extension.select(*left)
    bpy.ops.refine.mend()
    still = [obj.name for obj in left if drift.of(obj)]
    pairs = zip(before, seen(left), strict=True)
    return said, still, max(float(np.abs(one - other).max()) for one, other in pairs)


def seen(objects):
    """Return means, covariances and harmonics of splats as they stand in the world."""
    package = extension.module("")
    bpy.context.view_layer.update()
    checked = [package.mesh.layout.check(obj) for obj in objects]
    splats = package.objects.splat_group.gather(checked, whole=True)
    return splats.means, package.viewport.arrays.pack(splats).covariances, splats.sh_rest
