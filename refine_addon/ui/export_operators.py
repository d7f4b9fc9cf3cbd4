"""The operators that write splats to a file, and levels to a folder."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, StringProperty
from bpy.types import Context
from bpy_extras.io_utils import ExportHelper

from ..core.affine import AXES
from ..core.execute import Progress, report
from ..core.formats import registry, sog
from ..core.formats.registry import SUFFIXES, losses, write_splats
from ..core.formats.streamed_sog import INDEX, StreamedSog, folder_for
from ..core.whole_file import expanded, refuse_existing
from ..mesh import layout, scores
from ..objects import splat_group
from . import properties
from .operator_bases import Answer, Job, Work

_FORMATS = (
    (".ply", ".ply", "In the layout that was imported"),
    *((form.suffix, form.suffix, f"It {form.loss}") for form in registry.FORMATS),
)
"""Export formats as Blender lists them, with tooltips."""


class Exporting(Job, ExportHelper):
    """An operator that writes the active object's splats, and does not change it.
    ``new_name(obj)`` is what the file browser proposes."""

    bl_options = {"REGISTER", "PRESET"}
    apply_transform: BoolProperty(
        name="Apply Transform",
        description="Write the splats as they stand in the world: positions, rotations, scales "
        "and view-dependent colour follow the object",
    )
    overwrite: BoolProperty(
        name="Overwrite",
        description="Replace a file or folder of that name",
        options={"SKIP_SAVE"},
    )

    def invoke(self, context: Context, event: bpy.types.Event) -> Answer:
        """Ask where; picking an existing file means to replace it."""
        self.by_hand = self.overwrite = True
        if not self.filepath:
            self.filepath = self.new_name(context.object)
        return ExportHelper.invoke(self, context, event)

    def read(self, *objects: bpy.types.Object) -> tuple[list[Any], list[str]]:
        """For each object a call that builds its file, and notes."""
        group, moved = [layout.check(obj) for obj in objects], self.apply_transform
        files = [splat_group.read_for_export(each, apply_transform=moved) for each in group]
        notes = [splat_group.export_notes(each, apply_transform=moved) for each in group]
        return files, list(dict.fromkeys(itertools.chain(*notes)))


class REFINE_OT_export_ply(Exporting, bpy.types.Operator):
    """Write the active object's splats to a file, in the format that its suffix names"""

    bl_label = "Export Splats"
    doing = "Writing splats"

    filter_glob: StringProperty(default=";".join(f"*{end}" for end in SUFFIXES), options={"HIDDEN"})
    suffix: EnumProperty(
        name="Format",
        description="Format of the file; a suffix that you type chooses it, too",
        items=_FORMATS,
        options={"SKIP_SAVE"},
    )
    spz_y_up: BoolProperty(**properties.SPZ_Y_UP)
    settled = _FORMATS[0][0]  # Format at the last `check`

    def new_name(self, obj: bpy.types.Object) -> str:
        """A name that no file beside the .blend has yet."""
        mesh = obj.data
        pruned = scores.RANK in mesh.attributes and scores.record(mesh) is None
        name = f"{obj.name}_{'pruned' if pruned else 'copy'}"
        names = itertools.chain([name], (f"{name}_{number}" for number in itertools.count(2)))
        folder = Path(bpy.path.abspath("//"))  # where the file browser starts
        return next(f"{new}.ply" for new in names if not (folder / f"{new}.ply").exists())

    def check(self, _context: Context) -> bool:
        """Match name and format, whichever changed; whether either did."""
        before = self.filepath, self.suffix
        name = registry.without_suffix(self.filepath)
        typed = self.filepath[len(name) :].lower()
        if typed in SUFFIXES and self.suffix == self.settled:
            self.suffix = typed
        self.filepath = name + self.suffix
        self.settled = self.suffix
        return before != (self.filepath, self.suffix)

    def work(self, context: Context) -> Work:
        """Write the file; say what it cannot hold."""
        target, overwrite = expanded(bpy.path.abspath(self.filepath)), self.overwrite
        refuse_existing(target, overwrite=overwrite)
        (read,), notes = self.read(context.object)
        axes = AXES[0] if self.spz_y_up else context.object.data.get(layout.AXES, "")

        def write(progress: Progress) -> list[str]:
            report(progress, 0.0, target.name)
            file, form = replace(read(), axes=axes), registry.format_named(target)
            write_splats(target, file, overwrite=overwrite)
            return losses(file, form, np.ones(len(file), np.bool_))[1]

        _, told = yield [], write
        self.tell(notes)
        self.tell([*told, f"Wrote the splats to {target}"], "INFO")


class REFINE_OT_export_levels(Exporting, bpy.types.Operator):
    """Write the active object and its levels as a streamed SOG: a folder that web viewers load"""

    bl_label = "Export Levels"
    doing = "Writing levels"

    check_extension = None
    filter_glob: StringProperty(default=INDEX, options={"HIDDEN"})

    def new_name(self, obj: bpy.types.Object) -> str:
        """Name of a folder, which is made."""
        return f"{splat_group.levels_of(obj)[0].name}_levels"

    def work(self, context: Context) -> Work:
        """Write the levels, finest first."""
        objects = splat_group.levels_of(layout.check(context.object).obj)
        files, notes = self.read(*objects)
        width = objects[1][splat_group.LEVEL_STATS].get("distance", np.inf)
        if not self.apply_transform:  # in the object's own unit
            width /= np.cbrt(abs(objects[0].matrix_world.to_3x3().determinant())) or 1.0
        path, overwrite = expanded(bpy.path.abspath(self.filepath)), self.overwrite
        target = path if path.name == INDEX else path / INDEX

        def write(progress: Progress) -> None:
            with folder_for(target, overwrite=overwrite) as folder:
                scene: Any = None
                for number, file in enumerate(files):
                    report(progress, number / len(files), f"level {number}")
                    splats = registry.held_splats(target, sog.FORMAT, file(), None, {})
                    scene = scene or StreamedSog(splats.means, float(width), folder)
                    scene.add(splats)
                scene.publish(target, overwrite=overwrite)

        yield [], write
        self.tell(notes)
        self.report({"INFO"}, f"Wrote {len(files)} levels, the finest as it is, to {target}")


def _draw_menu(menu: bpy.types.Menu, _context: Context) -> None:
    menu.layout.operator("refine.export_ply", text=f"Gaussian Splats ({', '.join(SUFFIXES)})")


MENUS = {"TOPBAR_MT_file_export": _draw_menu}
