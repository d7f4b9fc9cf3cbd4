"""Start every operator that waits where it refuses: *Render with Splats* by its buttons."""

from __future__ import annotations

from contextlib import suppress
from functools import partial

import bpy
import extension
from hand import begin, until

ON_SPLATS = ["score", "apply", "compare", "levels", "mend", "find_floaters", "grow_selection"]
"""Operators that refuse splats which lack an attribute as soon as they are called."""


def main(pictures):
    """Return what each refusal said, and how many operators wait seconds afterwards."""
    hand = yield from begin(pictures)
    start, scene = Starts(hand), bpy.context.scene
    bpy.context.preferences.view.filebrowser_display_type = "SCREEN"  # in the same window
    splats = bpy.data.objects["Splats"]
    scene.refine.method = "closed-form"
    hand.call(bpy.ops.refine.score)
    scene.refine.method = "merge"  # which waits
    other = splats.copy()
    other["refine_level_of"] = splats
    scene.collection.objects.link(other)
    other.select_set(True)
    splats.data.attributes.remove(splats.data.attributes["scale_0"])

    for name in ON_SPLATS:
        yield from start.refused(name, start.invoke(name))
    files = [{"name": "a.json"}, {"name": "b.json"}]
    for name, path, more in (
        ("export_ply", "export_ply", {}),
        ("export_levels", "export_levels", {}),
        ("import_cameras", "a.json", {"files": files}),
        ("import_ply", "a.ply", {}),
    ):
        path = f"{pictures}/{path}"
        yield from start.refused(name, start.confirm(name, filepath=path, **more))
    yield from start.refused("select_stroke", hand.drag("box", (0.3, 0.3), (0.6, 0.7)))

    yield from hand.open_tab()
    camera, scene.camera = scene.camera, None
    for case in ("render: no camera", "render: stereo", "render: no splats"):
        yield from start.refused(case, hand.click("refine.render("))
        scene.camera, scene.render.use_multiview = camera, "camera" in case
        if "stereo" in case:
            bpy.data.batch_remove([splats, other])
    return start.found | {"not tried": start.not_tried()}


class Starts:
    """Starts operators, and notes what they say."""

    def __init__(self, hand):
        self.hand, self.found, self.said = hand, {}, []
        bases = extension.module("ui.operator_bases")
        described = bases.described

        def noted(error):
            self.said.append(described(error))
            return self.said[-1]

        bases.described = noted

    def refused(self, what, doing):
        """Do something, wait until it is refused, and leave Blender to itself."""
        self.said.clear()
        yield from doing
        yield from until(lambda: bool(self.said), f"it is refused: {what}")
        yield 1.0
        yield from self.hand.press("ESC")  # closes the message beside the mouse
        yield from self.hand.move(100, 300)  # off the button
        yield 1.0
        self.found[what] = [self.said[0], len(self.hand.window.modal_operators)]

    def invoke(self, name, **values):
        """Call an operator as a button does."""
        start = partial(getattr(bpy.ops.refine, name), "INVOKE_DEFAULT")
        with suppress(RuntimeError):  # what it reports
            self.hand.call(start, **values)
        yield 0.0

    def confirm(self, name, **values):
        """Call one that asks in a dialog or a file browser, and confirm that."""
        yield from self.hand.move(500, 500)
        yield from self.invoke(name, **values)
        yield 1.0
        yield from self.hand.press("RET")

    def not_tried(self):
        """Return the operators that wait, but for those that were started."""
        classes = extension.module("registration").CLASSES
        waiting = {kind.bl_idname for kind in classes if hasattr(kind, "modal")}
        tried = {f"refine.{what.split(':')[0]}" for what in self.found}
        return sorted(waiting - tried)
