"""Operators that bring splat and camera files into the scene, and dropping files on the view."""

# ruff: noqa: D400, N801, RUF012, TC002 - Blender's names and tooltips; annotations are run
from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import bpy
import mathutils
import numpy as np
from bpy.props import BoolProperty, CollectionProperty, StringProperty
from bpy_extras.io_utils import ImportHelper

from ..cameras.objects import UPRIGHT
from ..cameras.sets import create_cameras
from ..core.cameras.read import read_cameras
from ..core.errors import RefineError
from ..core.formats.registry import SUFFIXES, read_splats
from ..core.work import part, report
from ..mesh import attributes as mesh_attributes
from ..mesh import drift as mesh_drift
from ..mesh import layout as mesh_layout
from ..viewport import draw
from . import preferences
from .on_thread import AskedFirst
from .operator_bases import FAILURES, Answer, AtOnce, Needing, described, fail, idle, in_object_mode
from .properties import UPRIGHT_TEXT
from .wrapped import counted

if TYPE_CHECKING:
    from ..core.formats.ply import SplatFile
    from ..core.work import Progress

_ROWS = 1 << 16
"""Rows that are read before the next look at whether the import was cancelled."""

FILE_NAMES = ";".join(f"*{suffix}" for suffix in SUFFIXES)
"""What a file browser shows."""

FOLDER = "refine_folder"
"""Custom property of an imported object: the folder of its file."""

_CAMERAS = ("cameras.json", "transforms.json", "sparse", "cameras.bin", "cameras.txt")
"""What lies where the cameras of a capture are."""

_ABOVE = 3  # folders above the splats in which their cameras are looked for


@dataclass(frozen=True)
class _Read:
    """What files hold, and what is wrong with those that cannot be read."""

    files: list[SplatFile]
    errors: list[Exception]


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

    doing = "Reading splats"
    reads_object = False

    def ask(self, context: bpy.types.Context, _event: bpy.types.Event) -> Answer:
        """Ask for the files, or only for the options where files were dropped."""
        preferences.suggest(self, context, "upright")
        return self.invoke_popup(context)

    def prepare(self, _context: bpy.types.Context, _checked: None) -> list[Path]:
        """Note which files to read."""
        return self._paths()

    @staticmethod
    def work(paths: list[Path], progress: Progress) -> _Read:
        """Read the files; one that cannot be read does not stop the others."""
        read = _Read([], [])
        for index, path in enumerate(paths):
            progress_of_file = part(progress, index / len(paths), (index + 1) / len(paths))
            try:
                read.files.append(_read(path, progress_of_file))
            except FAILURES as error:
                read.errors.append(error)
        return read

    def finish(
        self, context: bpy.types.Context, _checked: None, _paths: list[Path], read: _Read
    ) -> Answer:
        """Make an object of each file."""
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
        self.report({"INFO"}, f"Imported {count:,} splats from {counted(len(imported), 'file')}")
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
        _target(context).objects.link(obj)
        for note in mesh_attributes.import_notes(file):
            self.report({"WARNING"}, note)
        return obj


class REFINE_OT_import_cameras(AtOnce, Needing, bpy.types.Operator, ImportHelper):
    """Import cameras as objects: Inria cameras.json, nerfstudio transforms.json or COLMAP"""

    bl_idname = "refine.import_cameras"
    bl_label = "Import Cameras"
    bl_options = {"REGISTER", "UNDO", "PRESET"}
    needs = (idle, in_object_mode)

    filename_ext = ".json"
    filter_glob: StringProperty(default="*.json;*.bin;*.txt", options={"HIDDEN"})
    upright: BoolProperty(
        name="Upright",
        description=UPRIGHT_TEXT + ". Choose what you chose for the splats",
    )
    set_resolution: BoolProperty(
        name="Set Render Size",
        description="Give the scene the image size of the first camera, so that renders show what "
        "the cameras saw",
    )

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> Answer:
        """Ask for the file; upright by default where the active splats are."""
        obj = context.object
        if mesh_layout.looks_like_splats(obj) and not self.properties.is_property_set("upright"):
            self.upright = np.allclose(np.array(obj.matrix_world)[:3, :3], UPRIGHT[:3, :3])
        folder = None if self.properties.is_property_set("filepath") else _capture_folder(obj)
        if folder is None:
            return self.invoke_popup(context)
        self.filepath = os.path.join(folder, "")  # noqa: PTH118 - ends in a separator
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def act(self, context: bpy.types.Context) -> Answer:
        """Import the cameras into a collection of their own."""
        path = Path(bpy.path.abspath(self.filepath))
        views = read_cameras(_model_folder(path))
        scene = context.scene
        collection = bpy.data.collections.new(f"Cameras {path.stem}")
        _target(context).children.link(collection)
        cameras = create_cameras(views, collection, upright=self.upright)
        scene.refine.collection = collection
        scene.refine.source = "COLLECTION"
        scene.camera = scene.camera or cameras[0]
        if self.set_resolution:
            scene.render.resolution_x = views[0].width
            scene.render.resolution_y = views[0].height
            scene.render.resolution_percentage = 100
        if views.note:
            self.report({"WARNING"}, views.note)
        self.report({"INFO"}, f"Imported {counted(len(views), 'camera')} into '{collection.name}'")
        return {"FINISHED"}


class REFINE_FH_ply(bpy.types.FileHandler):
    """Lets splat files be dropped on the 3D view."""

    bl_idname = "REFINE_FH_ply"
    bl_label = "Gaussian Splats (REFINE)"
    bl_import_operator = "refine.import_ply"
    bl_file_extensions = ";".join(dict.fromkeys("." + suffix.split(".")[-1] for suffix in SUFFIXES))

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        """Tell whether files can be dropped here."""
        return context.area is not None and context.area.type == "VIEW_3D"


def _capture_folder(obj: bpy.types.Object | None) -> Path | None:
    """Return where the cameras of a splat object may lie: where its file came from, or above it.

    Trained scenes have their splats some folders below their cameras, in
    ``point_cloud/iteration_30000``.
    """
    stored = obj.get(FOLDER) if obj is not None else None
    if not isinstance(stored, str) or not stored or not os.path.isdir(stored):  # noqa: PTH112
        return None
    folder = Path(stored)
    for place in (folder, *folder.parents[:_ABOVE]):
        if any((place / name).exists() for name in _CAMERAS):
            return place
    return folder


def _read(path: Path, progress: Progress) -> SplatFile:
    """Return what a file holds, with all its bytes in memory."""
    report(progress, 0.0, "")
    file = read_splats(path)
    if not len(file):
        msg = f"{path}: holds no splats"
        raise RefineError(msg)
    for start in range(0, len(file), _ROWS):
        report(progress, start / len(file), "")
        file.rows[start : start + _ROWS].tobytes()  # a mapped file is read when it is looked at
    return file


def _target(context: bpy.types.Context) -> bpy.types.Collection:
    """Return the active collection, or the scene's where that one belongs to a library."""
    active = context.collection
    return context.scene.collection if active is None or active.library else active


def _model_folder(path: Path) -> Path:
    """Return what to read: a COLMAP model is a folder, of which the user picked one file."""
    return path.parent if path.suffix in {".bin", ".txt"} else path


def _joined(errors: list[Exception]) -> str:
    return "; ".join(described(error) for error in errors)
