"""How long the main thread is blocked by what an artist clicks, without a window.

What runs on a thread in a window does so here, too, and the main thread's part is cut where it
waits. The processor time of one stretch is what the window would stand still for, but for drawing.
"""

from __future__ import annotations

import time
from functools import partial

import bpy
import extension

_LEAST = 0.001  # seconds; less is not told
_POLL = 0.05  # seconds between two looks at a thread, as in a window


class Clock:
    """Stretches of the main thread, by what was done: its own processor time, and Blender's.

    Blender's is that of all threads, some of which the main thread may wait for: at most so long it
    is blocked on a quiet machine. While a thread works that nobody waits for, both are the first.
    """

    def __init__(self):
        self.stretches, self._name, self._since = {}, "", (0.0, 0.0)

    def cut(self, *, alone=True):
        """End a stretch, in which no other thread worked: the window is alive for a moment."""
        now = time.thread_time(), time.process_time()
        own, all_of = (end - start for end, start in zip(now, self._since, strict=True))
        if own > _LEAST:
            self.stretches[self._name].append((own, all_of if alone else own))
        self._since = now

    def time(self, name, operator, **options):
        """Run an operator as a click does, with the undo step and the update that follow."""
        self._name, self._since = name, (time.thread_time(), time.process_time())
        self.stretches[name] = []
        operator("EXEC_DEFAULT", True, **options)
        bpy.context.view_layer.update()
        self.cut()
        print(name, self.stretches[name], flush=True)


def main(cloud, folder, views, refit):
    """Return the stretches of each operator, seconds: see `Clock`.

    ``cloud``: a file of splats, beside its cameras. ``folder``: for files. ``views``: how many
    score. ``refit``: whether splats are refitted, too, minutes at a million of them.
    """
    extension.enable()
    job = extension.module("ui.operator_bases").Job
    clock, refine = Clock(), bpy.ops.refine
    at_once, threaded = job.execute, on_a_thread(clock)
    job.execute = threaded
    bpy.data.batch_remove(bpy.data.objects)
    clock.time("import with cameras", refine.import_ply, filepath=cloud, cameras=True)
    settings = bpy.context.scene.refine
    settings.method, settings.views, settings.levels = "closed-form", views, "0.5, 0.25"
    clock.time("score", refine.score)
    clock.time("slider", lambda *_: setattr(settings, "ratio", 0.6))
    settings.ratio = 0.5
    scored = Scored(bpy.context.object)

    selecting(clock, scored)
    changing(clock, scored, f"{folder}/out.ply")
    scored.again()
    job.execute = at_once  # as in a window
    clock.time("apply", refine.apply)
    clock.time("undo of apply", bpy.ops.ed.undo)
    job.execute = threaded
    for method in ("merge", "refit")[: 1 + refit]:
        scored.again()
        bpy.context.scene.refine.method = method
        clock.time(f"apply, {method}", refine.apply)
    scored.again()
    bpy.context.scene.refine.method = "closed-form"
    clock.time("make levels", refine.levels)
    return clock.stretches


def selecting(clock, scored):
    """Select, hide and protect splats, part and move them, and crop them."""
    refine = bpy.ops.refine
    scored.again()
    for name, operator, options in (
        ("select by size", refine.select_by, {"what": "LARGE"}),
        ("select what goes", refine.select_by, {"what": "GOING"}),
        ("invert", refine.select, {"action": "INVERT"}),
        ("grow", refine.grow_selection, {}),
        ("shrink", refine.grow_selection, {"shrink": True}),
        ("hide", refine.select, {"action": "HIDE"}),
        ("reveal", refine.select, {"action": "REVEAL"}),
        ("protect", refine.protect, {}),
        ("separate", refine.separate_selected, {}),
    ):
        clock.time(name, operator, **options)
    bpy.context.view_layer.objects.active.location.x += 0.5
    clock.time("bake transform", refine.bake_transform)
    clock.time("undo of bake transform", bpy.ops.ed.undo)
    scored.again()
    clock.time("add volume", refine.add_volume, role="REMOVE", shape="BOX")
    clock.time("select outside", refine.select_by, what="OUTSIDE")
    clock.time("crop", refine.delete, what="VOLUMES")
    bpy.context.scene.refine.volumes.clear()
    scored.again()
    clock.time("find floaters", refine.find_floaters)


def changing(clock, scored, path):
    """Export, bake and mend splats."""
    refine, export = bpy.ops.refine, {"filepath": path, "overwrite": True}
    obj = scored.again()
    clock.time("export", refine.export_ply, **export)
    obj.rotation_euler.x, obj.location.x = 0.3, 1.0
    bpy.context.view_layer.update()
    clock.time("export moved", refine.export_ply, apply_transform=True, **export)
    clock.time("bake transform", refine.bake_transform)
    obj.rotation_euler.y = 0.3
    bpy.context.view_layer.update()
    bpy.ops.object.transform_apply(location=False, rotation=True, scale=True)
    clock.time("mend after Ctrl+A", refine.mend)


def on_a_thread(clock):
    """Return what runs an operator as `Job` does in a window, and waits for its thread."""
    serve = extension.module("main_thread").serve
    bases = extension.module("ui.operator_bases")

    def execute(self, context):
        group, job = self.gather(context)
        targets = [bases.Target.of(each) for each in group]
        clock.cut()
        worker = bases.Worker(partial(self.compute, job))
        while worker.running():
            time.sleep(_POLL)
            serve()
            clock.cut(alone=False)
        result = worker.result()
        assert [bases.Target.of(each) for each in group] == targets
        self.put(context, group, job, result)
        return {"FINISHED"}

    return execute


class Scored:
    """An object of scored splats, to be there again as it was after each operator."""

    def __init__(self, obj):
        self.name, self.mesh = obj.name, obj.data
        self.mesh.use_fake_user = True

    def again(self):
        """Return the object anew, alone of its kind, active and selected."""
        scene = bpy.context.scene
        for obj in list(scene.objects):
            if obj.type in {"MESH", "POINTCLOUD"}:
                bpy.data.objects.remove(obj)
        obj = bpy.data.objects.new(self.name, self.mesh.copy())
        scene.collection.objects.link(obj)
        for other in scene.objects:
            other.select_set(other == obj)
        bpy.context.view_layer.objects.active = obj
        bpy.context.view_layer.update()
        bpy.ops.ed.undo_push(message="again")
        return obj
