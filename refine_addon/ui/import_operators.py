"""The operators that import splats and cameras from files, and dropping these on the view."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy
import mathutils
import numpy as np
from bpy.props import BoolProperty, CollectionProperty, IntProperty, StringProperty
from bpy.types import Context
from bpy_extras.io_utils import ImportHelper

from ..cameras import SHEAR, SOURCE, create_cameras, known_turn, y_down
from ..core import SplatFile, ViewSet
from ..core.affine import AXES, QUARTER
from ..core.cameras.read import cameras_in, read_cameras
from ..core.errors import RefineError, described
from ..core.execute import Progress, report, stages
from ..core.formats.registry import INDEX_NAMES, READ_SUFFIXES, read_splats
from ..core.formats.streamed_sog import INDEX
from ..core.operations import by_cameras
from ..core.quality.alignment import Alignment
from ..mesh import attributes, drift
from ..mesh import layout as mesh_layout
from ..viewport import draw
from . import properties
from .operator_bases import FAILURES, Answer, Job, Work, idle, in_object_mode, target_collection
from .wrapped import counted

_ABOVE = 3  # folders above the splats in which their cameras are looked for
_DEFAULT_SIZE = (1920, 1080, 100)  # of Blender's factory settings, with the percentage
_OF_MODELS = {".bin", ".txt"}  # several files of one folder are a COLMAP model


class _Importing(Job, ImportHelper):
    """An operator that imports cameras, alone or with splats."""

    bl_options = {"REGISTER", "UNDO", "PRESET"}
    needs = (idle, in_object_mode)

    files: CollectionProperty(  # `invoke_popup` reads them if files are dropped
        type=bpy.types.OperatorFileListElement, options={"HIDDEN", "SKIP_SAVE"}
    )
    directory: StringProperty(subtype="DIR_PATH", options={"HIDDEN", "SKIP_SAVE"})
    upright: BoolProperty(name="Upright", description=properties.UPRIGHT_TEXT)
    set_resolution: BoolProperty(
        name="Set Render Size",
        description="Give the scene the image size of the first camera, and make that the active "
        "one, so that renders show what the camera saw",
        options={"SKIP_SAVE"},
    )

    def add_cameras(self, context: Context, views: ViewSet) -> bpy.types.Collection:
        """Camera objects in a new collection, which decides from now on."""
        scene, collection = context.scene, bpy.data.collections.new("Cameras")
        target_collection(context).children.link(collection)
        cameras = create_cameras(views, collection, upright=self.upright)
        scene.refine.collection, scene.refine.source = collection, "COLLECTION"
        if self.set_resolution:
            render, size = scene.render, (views[0].width, views[0].height)
            (render.resolution_x, render.resolution_y), render.resolution_percentage = size, 100
        if self.set_resolution or scene.camera is None:
            scene.camera = cameras[0]
        if views.note:
            self.report({"WARNING"}, views.note)
        return collection

    def warn_of_turn(self, context: Context) -> None:
        """Report if only one of splats and deciding cameras was imported upright."""
        context.view_layer.update()  # or what was just made stands at the origin
        splats = _splats_in(context)
        if splats is not None and (turn := known_turn(context, splats)):
            self.report({"WARNING"}, Alignment(turn, known=True).turned())


class _Dropped:
    @classmethod
    def poll_drop(cls, context: Context) -> bool:
        """Whether files can be dropped here."""
        return context.area is not None and context.area.type == "VIEW_3D"


class REFINE_OT_import_cameras(_Importing, bpy.types.Operator):
    """Import cameras as objects: Inria cameras.json, nerfstudio transforms.json or COLMAP"""

    # On a thread also because Blender does not record an operator that ends within the file
    # browser's call: *Adjust Last Operation* would still be that of the splats imported before,
    # and adjusting them would undo these cameras.
    bl_label = "Import Cameras"
    doing = "Reading cameras"

    filter_glob: StringProperty(default="*.json;*.bin;*.txt", options={"HIDDEN"})

    def invoke(self, context: Context, _event: bpy.types.Event) -> Answer:
        """Ask for the file; upright by default where the splats are.
        A dropped JSON file that is an index of splats goes to the import of splats."""
        self.by_hand = True
        path = self.properties.filepath
        if path.lower().endswith(INDEX_NAMES):
            return bpy.ops.refine.import_ply("INVOKE_DEFAULT", filepath=path)
        obj = _splats_in(context)
        if obj is None:
            properties.fill(self.properties, context, "upright")
        elif not self.properties.is_property_set("upright"):
            self.upright = _is_upright(obj)
        suggest_resolution(self, context)
        return self.invoke_popup(context)

    def work(self, context: Context) -> Work:
        """Make camera objects of the file's views; of a COLMAP model, the whole folder's."""
        path = Path(bpy.path.abspath(self.filepath))
        if len(self.files) > 1 and path.suffix not in _OF_MODELS:
            raise RefineError(f"got {len(self.files)} files, expected one of cameras")
        path = path.parent if path.suffix in _OF_MODELS else path
        _, views = yield [], lambda _progress: read_cameras(path)
        collection = self.add_cameras(context, views)
        self.warn_of_turn(context)
        self.report({"INFO"}, f"Imported {counted(len(views), 'camera')} into '{collection.name}'")


class REFINE_FH_cameras(_Dropped, bpy.types.FileHandler):
    """Camera files dropped on the 3D view."""

    bl_label = "Splat Cameras (REFINE)"
    bl_import_operator = "refine.import_cameras"
    bl_file_extensions = ".json;.bin;.txt"


def suggest_resolution(operator: Any, context: Context) -> None:
    """Default of ``set_resolution``: true where nobody has chosen size or camera, and the scene
    has at most the camera that Blender starts with."""
    if operator.properties.is_property_set("set_resolution"):
        return
    render = context.scene.render
    size = (render.resolution_x, render.resolution_y, render.resolution_percentage)
    cameras = [obj for obj in context.scene.objects if obj.type == "CAMERA"]
    chosen = any(obj.animation_data or SOURCE in obj for obj in cameras)
    operator.set_resolution = size == _DEFAULT_SIZE and len(cameras) <= 1 and not chosen


def cameras_beside(folder: Path) -> Path | None:
    """Camera file of splats in a folder, there or above.
    Trained scenes have splats some folders below, in ``point_cloud/iteration_30000``."""
    places = (folder, *folder.parents[:_ABOVE])
    return next((files[0] for place in places if (files := cameras_in(place))), None)


def _splats_in(context: Context) -> bpy.types.Object | None:
    """Splats that cameras are imported for: the active ones, else the first of the scene."""
    objects = (context.object, *context.scene.objects)
    return next(filter(mesh_layout.looks_like_splats, objects), None)


def _is_upright(obj: bpy.types.Object) -> bool:
    """Whether an object stands as *Upright* turns it; float32 leaves 7.5e-8 of the zeros."""
    return np.allclose(np.array(obj.matrix_world)[:3, :3], QUARTER, atol=SHEAR)


_ROWS = 1 << 16  # Rows read between two checks for cancelling
FILE_NAMES = ";".join(f"*{suffix}" for suffix in READ_SUFFIXES)  # File browser's filter


class REFINE_OT_import_ply(_Importing, bpy.types.Operator):
    """Import files of splats as meshes: a vertex for each splat, an attribute for each property"""

    bl_label = "Import Splats"
    doing = "Reading splats"

    filter_glob: StringProperty(default=FILE_NAMES, options={"HIDDEN"})
    spz_y_up: BoolProperty(**properties.SPZ_Y_UP)
    cameras: BoolProperty(
        name="With Cameras",
        description="Import the cameras that lie beside the file, or up to three folders above it",
        options={"SKIP_SAVE"},
    )
    level: IntProperty(
        name="Level",
        description="Level of a streamed SOG (lod-meta.json); 0 is the finest",
        min=0,
        options={"SKIP_SAVE"},
    )
    chosen: Path | None = None  # File at the last `check`

    def invoke(self, context: Context, _event: bpy.types.Event) -> Answer:
        """Ask for files, or only for options where files were dropped."""
        self.by_hand = True
        properties.fill(self.properties, context, "upright")
        self.check(context)
        if not self.properties.is_property_set("cameras"):
            self.cameras = not any(SOURCE in obj for obj in context.scene.objects)
        suggest_resolution(self, context)
        return self.invoke_popup(context)

    def check(self, _context: Context) -> bool:
        """Set *Upright* if a newly chosen file names its vertical axis; whether it does."""
        before, self.chosen = self.chosen, self._paths()[0]
        down = y_down(self.chosen) if self.chosen != before else None
        self.upright = self.upright if down is None else down
        return down is not None

    def draw(self, context: Context) -> None:
        """Draw the options, and name the cameras that would come along."""
        layout, browser = self.layout, context.space_data
        layout.prop(self, "upright")
        layout.prop(self, "spz_y_up")
        path = self._paths()[0]
        folder = path.parent
        if path.name.lower().endswith(INDEX):
            layout.prop(self, "level")
        if browser is not None and browser.type == "FILE_BROWSER":  # the folder that is shown
            folder = Path(os.fsdecode(browser.params.directory))
        cameras = cameras_beside(folder)
        if cameras is None:
            layout.label(text="No cameras beside the file", icon="INFO")
            return
        layout.prop(self, "cameras")
        column = layout.column()
        column.enabled = self.cameras
        column.label(text=os.path.relpath(cameras, folder), icon="CAMERA_DATA")
        column.prop(self, "set_resolution")

    def work(self, context: Context) -> Work:
        """Make an object of each file, and of each camera beside the first if wanted.
        Errors of unreadable files stop no others."""
        paths, imported = self._paths(), []
        cameras = cameras_beside(paths[0].parent) if self.cameras else None
        how = self.level, AXES[0] if self.spz_y_up else None

        def read(progress: Progress) -> tuple[list[SplatFile], ViewSet | None, list[Any]]:
            files, views, errors = [], None, []
            for path, stage in zip(paths, stages(progress, *[1.0] * len(paths)), strict=True):
                try:
                    files.append(_read(path, how, stage))
                except FAILURES as error:
                    errors.append(error)
            if cameras is not None and files:
                try:
                    views = read_cameras(cameras)
                    files = [by_cameras(file, views) for file in files]
                except FAILURES as error:
                    errors.append(error)
            return files, views, errors

        _, (files, views, errors) = yield [], read
        for file in files:
            try:
                imported.append(self._import(context, file))
            except FAILURES as error:
                errors.append(error)
        if not imported:
            raise RefineError("; ".join(map(described, errors)))
        self.tell(map(described, errors))
        for obj in (*context.selected_objects, *imported):
            obj.select_set(obj in imported)
        context.view_layer.objects.active = imported[-1]
        if not bpy.app.background:  # scripts set what they want
            properties.fill(context.scene.refine, context, *properties.DEFAULTS)
            draw.show("SCENE")
        count = sum(len(obj.data.vertices) for obj in imported)
        text = f"Imported {count:,} splats from {counted(len(imported), 'file')}"
        if views is not None:
            self.add_cameras(context, views)
            beside = os.path.relpath(cameras, paths[0].parent)
            text += f", and {counted(len(views), 'camera')} from {beside}"
        self.warn_of_turn(context)
        self.report({"INFO"}, text)

    def _paths(self) -> list[Path]:
        names = [item.name for item in self.files if item.name]
        if names and self.directory:
            return [Path(bpy.path.abspath(self.directory)) / name for name in names]
        return [Path(bpy.path.abspath(self.filepath))]

    def _import(self, context: Context, file: SplatFile) -> bpy.types.Object:
        mesh = attributes.mesh_from_file(file)
        if file.axes:
            mesh[mesh_layout.AXES] = file.axes
        drift.stamp(mesh)
        obj = bpy.data.objects.new(mesh.name, mesh)
        if self.upright:
            obj.matrix_world = mathutils.Matrix(QUARTER.tolist()).to_4x4()
        target_collection(context).objects.link(obj)
        self.tell(attributes.import_notes(file))
        return obj


class REFINE_FH_ply(_Dropped, bpy.types.FileHandler):
    """Splat files dropped on the 3D view."""

    bl_label = "Gaussian Splats (REFINE)"
    bl_import_operator = "refine.import_ply"
    # Without .json, whose handler is that of cameras: Blender would ask which is meant.
    bl_file_extensions = ";".join(
        dict.fromkeys("." + end.split(".")[-1] for end in READ_SUFFIXES if end not in INDEX_NAMES)
    )


def _read(path: Path, how: tuple[int, str | None], progress: Progress) -> SplatFile:
    report(progress, 0.0, "")
    file = read_splats(path, None, *how)
    if not len(file):
        raise RefineError(f"{path}: holds no splats")
    for start in range(0, len(file), _ROWS):
        report(progress, start / len(file), "")
        file.rows[start : start + _ROWS].tobytes()  # a mapped file is read when it is looked at
    return file


def _draw_menu(menu: bpy.types.Menu, _context: Context) -> None:
    menu.layout.operator("refine.import_ply", text=f"Gaussian Splats ({', '.join(READ_SUFFIXES)})")
    menu.layout.operator("refine.import_cameras", text="Splat Cameras (.json, COLMAP)")


MENUS = {"TOPBAR_MT_file_import": _draw_menu}
