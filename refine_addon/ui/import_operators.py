"""The operator that brings files of splats into the scene, and dropping them on the view."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import bpy
import mathutils
from bpy.props import BoolProperty, CollectionProperty, IntProperty, StringProperty
from bpy_extras.io_utils import ImportHelper

from ..cameras.objects import SOURCE, UPRIGHT
from ..core.cameras.read import read_cameras
from ..core.errors import RefineError
from ..core.execute import Progress, part, report
from ..core.formats.ply import SplatFile
from ..core.formats.registry import INDEX_NAMES, READ_SUFFIXES, read_splats
from ..core.formats.streamed_sog import INDEX
from ..core.views import ViewSet
from ..mesh import attributes as mesh_attributes
from ..mesh import drift as mesh_drift
from ..viewport import draw
from . import preferences
from .camera_import import (
    FOLDER,
    SET_RESOLUTION,
    add_cameras,
    cameras_beside,
    suggest_resolution,
    target_collection,
    warn_of_turn,
)
from .on_thread import AskedFirst
from .operator_bases import FAILURES, Answer, Needing, described, fail, idle, in_object_mode
from .properties import UPRIGHT_TEXT
from .wrapped import counted

_ROWS = 1 << 16
"""Rows that are read before the next look at whether the import was cancelled."""

FILE_NAMES = ";".join(f"*{suffix}" for suffix in READ_SUFFIXES)
"""What a file browser shows."""


@dataclass(frozen=True)
class _Files:
    """Files of splats, and that of the cameras found beside them if it is to be read too."""

    splats: list[Path]
    cameras: Path | None
    level: int


@dataclass
class _Read:
    """What files hold, and what is wrong with those that cannot be read."""

    files: list[SplatFile]
    errors: list[Exception]
    views: ViewSet | None = None


class REFINE_OT_import_ply(AskedFirst, Needing, bpy.types.Operator, ImportHelper):
    """Import files of splats, of any format: a vertex a splat, a point attribute a property"""

    bl_idname = "refine.import_ply"
    bl_label = "Import Splats"
    bl_options = {"REGISTER", "UNDO", "PRESET"}
    needs = (idle, in_object_mode)

    filename_ext = ".ply"
    filter_glob: StringProperty(default=FILE_NAMES, options={"HIDDEN"})
    files: CollectionProperty(
        type=bpy.types.OperatorFileListElement, options={"HIDDEN", "SKIP_SAVE"}
    )
    directory: StringProperty(subtype="DIR_PATH", options={"HIDDEN", "SKIP_SAVE"})
    upright: BoolProperty(name="Upright", description=UPRIGHT_TEXT)
    cameras: BoolProperty(
        name="With Cameras",
        description="Import the cameras that lie beside the file, or up to three folders above it",
        options={"SKIP_SAVE"},
    )
    set_resolution: BoolProperty(**SET_RESOLUTION)
    level: IntProperty(
        name="Level",
        description="Of a streamed SOG (lod-meta.json): 0 is the finest level",
        min=0,
        options={"SKIP_SAVE"},
    )

    doing = "Reading splats"
    reads_object = False

    def ask(self, context: bpy.types.Context, _event: bpy.types.Event) -> Answer:
        """Ask for the files, or only for the options where files were dropped."""
        preferences.suggest(self, context, "upright")
        if not self.properties.is_property_set("cameras"):
            self.cameras = not any(SOURCE in obj for obj in context.scene.objects)
        suggest_resolution(self, context)
        return self.invoke_popup(context)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the options, and name the cameras that would be taken before they are."""
        layout, browser = self.layout, context.space_data
        layout.prop(self, "upright")
        path = self._paths()[0]
        folder = path.parent
        if path.name.lower().endswith(INDEX):
            layout.prop(self, "level")
        if browser is not None and browser.type == "FILE_BROWSER":  # what is looked at now
            folder = Path(os.fsdecode(browser.params.directory))
        found = cameras_beside(folder)
        if found is None:
            layout.label(text="No cameras beside the file", icon="INFO")
            return
        layout.prop(self, "cameras")
        column = layout.column()
        column.enabled = self.cameras
        column.label(text=os.path.relpath(found, folder), icon="CAMERA_DATA")
        column.prop(self, "set_resolution")

    def prepare(self, _context: bpy.types.Context, _checked: None) -> _Files:
        """Note which files to read."""
        paths = self._paths()
        cameras = cameras_beside(paths[0].parent) if self.cameras else None
        return _Files(paths, cameras, self.level)

    @staticmethod
    def work(files: _Files, progress: Progress) -> _Read:
        """Read the files; one that cannot be read does not stop the others."""
        read, paths = _Read([], []), files.splats
        for index, path in enumerate(paths):
            progress_of_file = part(progress, index / len(paths), (index + 1) / len(paths))
            try:
                read.files.append(_read(path, files.level, progress_of_file))
            except FAILURES as error:
                read.errors.append(error)
        if files.cameras is not None and read.files:
            try:
                read.views = read_cameras(files.cameras)
            except FAILURES as error:
                read.errors.append(error)
        return read

    def finish(
        self, context: bpy.types.Context, _checked: None, files: _Files, read: _Read
    ) -> Answer:
        """Make an object of each file, and of each camera."""
        errors, imported = read.errors, []
        for file in read.files:
            try:
                imported.append(self._import(context, file))
            except FAILURES as error:
                errors.append(error)
        if not imported:
            return fail(self, errors[0] if len(errors) == 1 else RefineError(_joined(errors)))
        for error in errors:
            self.report({"WARNING"}, described(error))
        for obj in context.selected_objects:
            obj.select_set(False)
        for obj in imported:
            obj.select_set(True)
        context.view_layer.objects.active = imported[-1]
        preferences.give_defaults(context)
        if not bpy.app.background:
            draw.show("SCENE")
        count = sum(len(obj.data.vertices) for obj in imported)
        told = f"Imported {count:,} splats from {counted(len(imported), 'file')}"
        if read.views is not None and files.cameras is not None:
            add_cameras(self, context, read.views, files.cameras)
            beside = os.path.relpath(files.cameras, files.splats[0].parent)
            told += f", and {counted(len(read.views), 'camera')} from {beside}"
        warn_of_turn(self, context, imported[-1])
        self.report({"INFO"}, told)
        return {"FINISHED"}

    def _paths(self) -> list[Path]:
        names = [item.name for item in self.files if item.name]
        if names and self.directory:
            return [Path(bpy.path.abspath(self.directory)) / name for name in names]
        return [Path(bpy.path.abspath(self.filepath))]

    def _import(self, context: bpy.types.Context, file: SplatFile) -> bpy.types.Object:
        mesh = mesh_attributes.mesh_from_file(file)
        mesh_drift.stamp(mesh)
        obj = bpy.data.objects.new(mesh.name, mesh)
        obj[FOLDER] = str(Path(file.path).parent.absolute())
        if self.upright:
            obj.matrix_world = mathutils.Matrix(UPRIGHT.tolist())
        target_collection(context).objects.link(obj)
        for note in mesh_attributes.import_notes(file):
            self.report({"WARNING"}, note)
        return obj


class REFINE_FH_ply(bpy.types.FileHandler):
    """Lets splat files be dropped on the 3D view."""

    bl_idname = "REFINE_FH_ply"
    bl_label = "Gaussian Splats (REFINE)"
    bl_import_operator = "refine.import_ply"
    # Without .json, whose handler is that of cameras: Blender would ask which is meant.
    bl_file_extensions = ";".join(
        dict.fromkeys("." + end.split(".")[-1] for end in READ_SUFFIXES if end not in INDEX_NAMES)
    )

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Tell whether files can be dropped here."""
        return context.area is not None and context.area.type == "VIEW_3D"


def _read(path: Path, level: int, progress: Progress) -> SplatFile:
    """Return what a file holds, with all its bytes in memory."""
    report(progress, 0.0, "")
    file = read_splats(path, level=level)
    if not len(file):
        raise RefineError(f"{path}: holds no splats")
    for start in range(0, len(file), _ROWS):
        report(progress, start / len(file), "")
        file.rows[start : start + _ROWS].tobytes()  # a mapped file is read when it is looked at
    return file


def _joined(errors: list[Exception]) -> str:
    return "; ".join(described(error) for error in errors)


def _draw_menu(menu: bpy.types.Menu, _context: bpy.types.Context) -> None:
    menu.layout.operator("refine.import_ply", text=f"Gaussian Splats ({', '.join(READ_SUFFIXES)})")
    menu.layout.operator("refine.import_cameras", text="Splat Cameras (.json, COLMAP)")


CLASSES = (REFINE_OT_import_ply, REFINE_FH_ply)
MENUS = {"TOPBAR_MT_file_import": _draw_menu}
