"""Start every operator that waits where it refuses: *Render with Splats* by its buttons."""

from __future__ import annotations

import importlib
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

import bpy
import extension
from selecting import BOX, NAME, Tools
from view import Show
from window import until

if TYPE_CHECKING:
    from collections.abc import Generator

    Doing = Generator[float, None, None]

ON_SPLATS = (
    *("score", "apply", "compare", "levels", "mend", "find_floaters"),
    "grow_selection",
)
"""Operators that refuse splats which lack an attribute as soon as they are called."""


def main(folder: str) -> Generator[float, None, dict[str, Any]]:
    """Return what each refusal said, and how many operators wait seconds afterwards.

    Parameters
    ----------
    folder
        For files.

    Yields
    ------
    float
        Seconds to wait.
    """
    extension.enable()
    yield 1.0
    start, scene = Starts(), bpy.context.scene
    yield from start.hand.press("ESC")  # the splash screen
    bpy.context.preferences.view.filebrowser_display_type = "SCREEN"  # in the same window
    splats = bpy.data.objects["Splats"]
    splats.name = NAME
    scene.refine.method = "closed-form"
    start.show.call(bpy.ops.refine.score)
    scene.refine.method = "merge"  # which waits
    other = splats.copy()
    other["refine_level_of"] = splats
    scene.collection.objects.link(other)
    other.select_set(True)
    splats.data.attributes.remove(splats.data.attributes["scale_0"])

    for name in ON_SPLATS:
        yield from start.refused(name, start.invoke(name))
    for name in ("export_ply", "export_levels"):
        yield from start.refused(name, start.confirm(name, filepath=f"{folder}/{name}"))
    files = [{"name": "a.json"}, {"name": "b.json"}]
    asked = start.confirm("import_cameras", filepath=f"{folder}/a.json", files=files)
    yield from start.refused("import_cameras", asked)
    yield from start.refused("import_ply", start.confirm("import_ply", filepath=f"{folder}/a.ply"))
    yield from start.refused("select_stroke", start.hand.drag("box", *BOX))

    yield from start.hand.open_tab()
    camera, scene.camera = scene.camera, None
    for case in ("render: no camera", "render: stereo", "render: no splats"):
        yield from start.refused(case, start.hand.click("refine.render("))
        scene.camera, scene.render.use_multiview = camera, "camera" in case
        if "stereo" in case:
            bpy.data.batch_remove([splats, other])
    return start.found | {"not tried": start.not_tried()}


class Starts:
    """Starts operators, and notes what they say."""

    def __init__(self) -> None:
        self.hand, self.show = Tools(), Show("")
        self.found: dict[str, Any] = {}
        self.said: list[str] = []
        bases = importlib.import_module(f"{extension.MODULE}.ui.operator_bases")
        described = bases.described

        def noted(error: Exception) -> str:
            self.said.append(described(error))
            return self.said[-1]

        bases.described = noted

    def refused(self, what: str, doing: Doing) -> Doing:
        """Do something, wait until it is refused, and leave Blender to itself."""
        self.said.clear()
        yield from doing
        yield from until(lambda: bool(self.said), f"it is refused: {what}")
        yield 1.0
        yield from self.hand.press("ESC")  # closes the message beside the mouse
        yield from self.hand.move(100, 300)  # off the button
        yield 1.0
        self.found[what] = [self.said[0], len(self.hand.window.modal_operators)]

    def invoke(self, name: str, **values: Any) -> Doing:
        """Call an operator as a button does."""
        start = partial(getattr(bpy.ops.refine, name), "INVOKE_DEFAULT")
        with suppress(RuntimeError):  # what it reports
            self.show.call(start, **values)
        yield 0.0

    def confirm(self, name: str, **values: Any) -> Doing:
        """Call one that asks in a dialog or a file browser, and confirm that."""
        yield from self.hand.move(500, 500)
        yield from self.invoke(name, **values)
        yield 1.0
        yield from self.hand.press("RET")

    def not_tried(self) -> list[str]:
        """Return the operators that wait, but for those that were started."""
        classes = importlib.import_module(f"{extension.MODULE}.registration").CLASSES
        waiting = {kind.bl_idname for kind in classes if hasattr(kind, "modal")}
        tried = {f"refine.{what.split(':')[0]}" for what in self.found}
        return sorted(waiting - tried)
