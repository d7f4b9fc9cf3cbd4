"""Cameras from files, as objects: alone, or with the splats beside them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import bpy
import numpy as np
from bpy.props import BoolProperty, CollectionProperty, StringProperty
from bpy.types import Context
from bpy_extras.io_utils import ImportHelper

from ..cameras.objects import SHEAR, SOURCE, UPRIGHT
from ..cameras.sets import create_cameras, known_turn
from ..core.cameras.read import cameras_in, read_cameras
from ..core.errors import RefineError
from ..core.execute import Progress
from ..core.formats.registry import INDEX_NAMES
from ..core.quality.alignment import Alignment
from ..core.views import ViewSet
from ..mesh import layout as mesh_layout
from ..mesh.layout import SplatObject
from . import preferences
from .operator_bases import Answer, Job, Needing, idle, in_object_mode
from .properties import UPRIGHT_TEXT
from .wrapped import counted

FOLDER = "refine_folder"  # Custom property of an imported object: its file's folder

SET_RESOLUTION: dict[str, Any] = {
    "name": "Set Render Size",
    "description": "Give the scene the image size of the first camera, and make that the active "
    "one, so that renders show what the camera saw",
    "options": {"SKIP_SAVE"},
}
"""Property of the operators that import cameras."""

_ABOVE = 3  # folders above the splats in which their cameras are looked for

_DEFAULT_SIZE = (1920, 1080, 100)  # of Blender's factory settings, with the percentage

_OF_MODELS = {".bin", ".txt"}  # several files of one folder are a COLMAP model

_USUAL_NAMES = {"cameras", "images", "transforms", "transforms_train"}  # of any capture


class REFINE_OT_import_cameras(Job, Needing, bpy.types.Operator, ImportHelper):
    """Import cameras as objects: Inria cameras.json, nerfstudio transforms.json or COLMAP"""

    # On a thread not for its time alone. What the file browser calls is put down as the last
    # operation only where it goes on after that: else the box *Adjust Last Operation* would stay
    # that of the splats before, and adjusting them would undo these cameras.
    bl_idname = "refine.import_cameras"
    bl_label = "Import Cameras"
    bl_options = {"REGISTER", "UNDO", "PRESET"}
    needs = (idle, in_object_mode)

    filename_ext = ".json"
    filter_glob: StringProperty(default="*.json;*.bin;*.txt", options={"HIDDEN"})
    files: CollectionProperty(  # without them Blender cannot ask about files that are dropped
        type=bpy.types.OperatorFileListElement, options={"HIDDEN", "SKIP_SAVE"}
    )
    directory: StringProperty(subtype="DIR_PATH", options={"HIDDEN", "SKIP_SAVE"})
    upright: BoolProperty(
        name="Upright",
        description=UPRIGHT_TEXT + ". Choose what you chose for the splats",
    )
    set_resolution: BoolProperty(**SET_RESOLUTION)

    doing = "Reading cameras"

    def invoke(self, context: Context, _event: bpy.types.Event) -> Answer:
        """Ask for the file; upright by default where the splats are.
        A dropped JSON file may hold splats, whose import asks then."""
        self.by_hand = True
        path = self.properties.filepath
        if path.lower().endswith(INDEX_NAMES):
            return bpy.ops.refine.import_ply("INVOKE_DEFAULT", filepath=path)
        obj = _imported_splats(context)
        if obj is None:
            preferences.suggest(self, context, "upright")
        elif not self.properties.is_property_set("upright"):
            self.upright = _is_upright(obj)
        suggest_resolution(self, context)
        folder = None if self.properties.is_property_set("filepath") else capture_folder(obj)
        if folder is None:
            return self.invoke_popup(context)
        self.filepath = os.path.join(folder, "")
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    def gather(self, _context: Context) -> tuple[list[SplatObject], Path]:
        """The path."""
        path = Path(bpy.path.abspath(self.filepath))
        if len(self.files) > 1 and path.suffix not in _OF_MODELS:
            raise RefineError(f"got {len(self.files)} files, expected one of cameras")
        return [], path

    @staticmethod
    def compute(path: Path, _progress: Progress) -> ViewSet:
        """The file's views; of a COLMAP model, the whole folder's."""
        return read_cameras(path.parent if path.suffix in _OF_MODELS else path)

    def put(self, context: Context, _group: list[SplatObject], path: Path, views: ViewSet) -> None:
        """Make camera objects."""
        collection = add_cameras(self, context, views, path)
        if (splats := _imported_splats(context)) is not None:
            warn_of_turn(self, context, splats)
        self.report({"INFO"}, f"Imported {counted(len(views), 'camera')} into '{collection.name}'")


class REFINE_FH_cameras(bpy.types.FileHandler):
    """Camera files dropped on the 3D view."""

    bl_idname = "REFINE_FH_cameras"
    bl_label = "Splat Cameras (REFINE)"
    bl_import_operator = "refine.import_cameras"
    bl_file_extensions = ".json;.bin;.txt"

    @classmethod
    def poll_drop(cls, context: Context) -> bool:
        """Whether files can be dropped here."""
        return context.area is not None and context.area.type == "VIEW_3D"


def add_cameras(
    operator: Any,
    context: Context,
    views: ViewSet,
    path: Path,
) -> bpy.types.Collection:
    """Make camera objects in a new collection named after `path`, which decides from now on.
    The operator has the properties ``upright`` and ``set_resolution``."""
    scene = context.scene
    name = "Cameras" if path.is_dir() or path.stem in _USUAL_NAMES else f"Cameras {path.stem}"
    collection = bpy.data.collections.new(name)
    target_collection(context).children.link(collection)
    cameras = create_cameras(views, collection, upright=operator.upright)
    scene.refine.collection = collection
    scene.refine.source = "COLLECTION"
    if operator.set_resolution:
        scene.render.resolution_x = views[0].width
        scene.render.resolution_y = views[0].height
        scene.render.resolution_percentage = 100
    if operator.set_resolution or scene.camera is None:
        scene.camera = cameras[0]
    if views.note:
        operator.report({"WARNING"}, views.note)
    return collection


def suggest_resolution(operator: Any, context: Context) -> None:
    """Default of ``set_resolution``: true where nobody has chosen size or camera."""
    if not operator.properties.is_property_set("set_resolution"):
        operator.set_resolution = _is_untouched(context.scene)


def warn_of_turn(operator: bpy.types.Operator, context: Context, splats: bpy.types.Object) -> None:
    """Report if only one of splats and deciding cameras was imported upright."""
    context.view_layer.update()  # or what was just made stands at the origin
    if turn := known_turn(context, splats):
        operator.report({"WARNING"}, Alignment(turn, known=True).turned())


def target_collection(context: Context) -> bpy.types.Collection:
    """Active collection, or the scene's where that is a library's."""
    active = context.collection
    return context.scene.collection if active is None or active.library else active


def cameras_beside(folder: Path) -> Path | None:
    """Camera file of splats in a folder, there or above.
    Trained scenes have splats some folders below, in ``point_cloud/iteration_30000``."""
    places = (folder, *folder.parents[:_ABOVE])
    return next((found[0] for place in places if (found := cameras_in(place))), None)


def capture_folder(obj: bpy.types.Object | None) -> Path | None:
    """Folder to search for cameras of a splat object; None if unknown."""
    stored = obj.get(FOLDER) if obj is not None else None
    if not isinstance(stored, str) or not stored or not os.path.isdir(stored):
        return None
    found = cameras_beside(Path(stored))
    return Path(stored) if found is None else found if found.is_dir() else found.parent


def _imported_splats(context: Context) -> bpy.types.Object | None:
    """Splats that cameras are imported for: the active ones, else any imported ones."""
    if mesh_layout.looks_like_splats(context.object):
        return context.object
    splats = (obj for obj in context.scene.objects if FOLDER in obj)
    return next((obj for obj in splats if mesh_layout.looks_like_splats(obj)), None)


def _is_upright(obj: bpy.types.Object) -> bool:
    """Whether an object stands as *Upright* turns it; float32 leaves 7.5e-8 of the zeros."""
    return np.allclose(np.array(obj.matrix_world)[:3, :3], UPRIGHT[:3, :3], atol=SHEAR)


def _is_untouched(scene: bpy.types.Scene) -> bool:
    """Whether a scene has the size and at most the camera that Blender starts with."""
    render = scene.render
    size = (render.resolution_x, render.resolution_y, render.resolution_percentage)
    cameras = [obj for obj in scene.objects if obj.type == "CAMERA"]
    moved = any(obj.animation_data or SOURCE in obj for obj in cameras)
    return size == _DEFAULT_SIZE and len(cameras) <= 1 and not moved


CLASSES = (REFINE_OT_import_cameras, REFINE_FH_cameras)
