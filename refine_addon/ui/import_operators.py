"""The operator that imports splat files, and dropping them on the view."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy
import mathutils
from bpy.props import BoolProperty, CollectionProperty, IntProperty, StringProperty
from bpy.types import Context
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
from ..mesh.layout import SplatObject
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
from .operator_bases import FAILURES, Answer, Job, Needing, described, idle, in_object_mode
from .properties import UPRIGHT_TEXT
from .wrapped import counted

_ROWS = 1 << 16  # Rows read between two checks for cancelling

FILE_NAMES = ";".join(f"*{suffix}" for suffix in READ_SUFFIXES)  # File browser's filter


class REFINE_OT_import_ply(Job, Needing, bpy.types.Operator, ImportHelper):
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

    def invoke(self, context: Context, _event: bpy.types.Event) -> Answer:
        """Ask for files, or only for options where files were dropped."""
        self.by_hand = True
        preferences.suggest(self, context, "upright")
        if not self.properties.is_property_set("cameras"):
            self.cameras = not any(SOURCE in obj for obj in context.scene.objects)
        suggest_resolution(self, context)
        return self.invoke_popup(context)

    def draw(self, context: Context) -> None:
        """Draw the options, and name the cameras that would come along."""
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

    def gather(self, _context: Context) -> tuple[list[SplatObject], Any]:
        """The files to read, and the camera file beside them if wanted."""
        paths = self._paths()
        cameras = cameras_beside(paths[0].parent) if self.cameras else None
        return [], (paths, cameras, self.level)

    @staticmethod
    def compute(job: Any, progress: Progress) -> tuple[list[SplatFile], ViewSet | None, list[Any]]:
        """Files, views, and errors of unreadable ones, which stop no others."""
        (paths, cameras, level), files, views, errors = job, [], None, []
        for index, path in enumerate(paths):
            progress_of_file = part(progress, index / len(paths), (index + 1) / len(paths))
            try:
                files.append(_read(path, level, progress_of_file))
            except FAILURES as error:
                errors.append(error)
        if cameras is not None and files:
            try:
                views = read_cameras(cameras)
            except FAILURES as error:
                errors.append(error)
        return files, views, errors

    def put(self, context: Context, _group: list[SplatObject], job: Any, read: Any) -> None:
        """Make an object of each file and camera."""
        (paths, cameras, _), (files, views, errors), imported = job, read, []
        for file in files:
            try:
                imported.append(self._import(context, file))
            except FAILURES as error:
                errors.append(error)
        if not imported:
            raise RefineError("; ".join(map(described, errors)))
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
        if views is not None:
            add_cameras(self, context, views, cameras)
            beside = os.path.relpath(cameras, paths[0].parent)
            told += f", and {counted(len(views), 'camera')} from {beside}"
        warn_of_turn(self, context, imported[-1])
        self.report({"INFO"}, told)

    def _paths(self) -> list[Path]:
        names = [item.name for item in self.files if item.name]
        if names and self.directory:
            return [Path(bpy.path.abspath(self.directory)) / name for name in names]
        return [Path(bpy.path.abspath(self.filepath))]

    def _import(self, context: Context, file: SplatFile) -> bpy.types.Object:
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
    """Splat files dropped on the 3D view."""

    bl_idname = "REFINE_FH_ply"
    bl_label = "Gaussian Splats (REFINE)"
    bl_import_operator = "refine.import_ply"
    # Without .json, whose handler is that of cameras: Blender would ask which is meant.
    bl_file_extensions = ";".join(
        dict.fromkeys("." + end.split(".")[-1] for end in READ_SUFFIXES if end not in INDEX_NAMES)
    )

    @classmethod
    def poll_drop(cls, context: Context) -> bool:
        """Whether files can be dropped here."""
        return context.area is not None and context.area.type == "VIEW_3D"


def _read(path: Path, level: int, progress: Progress) -> SplatFile:
    report(progress, 0.0, "")
    file = read_splats(path, level=level)
    if not len(file):
        raise RefineError(f"{path}: holds no splats")
    for start in range(0, len(file), _ROWS):
        report(progress, start / len(file), "")
        file.rows[start : start + _ROWS].tobytes()  # a mapped file is read when it is looked at
    return file


def _draw_menu(menu: bpy.types.Menu, _context: Context) -> None:
    menu.layout.operator("refine.import_ply", text=f"Gaussian Splats ({', '.join(READ_SUFFIXES)})")
    menu.layout.operator("refine.import_cameras", text="Splat Cameras (.json, COLMAP)")


CLASSES = (REFINE_OT_import_ply, REFINE_FH_ply)
MENUS = {"TOPBAR_MT_file_import": _draw_menu}
