"""The list of the cameras that scored, and how many splats lie in the view of each."""

# ruff: noqa: N801, RUF012 - Blender's way to name classes and set options; runs annotations
from __future__ import annotations

from typing import Any

import bpy
from bpy.props import CollectionProperty, IntProperty

from ..mesh import layout as mesh_layout
from ..mesh import scores as mesh_scores
from . import price
from .wrapped import counted, label

_MOST = 6  # lines before the list scrolls


class RefineCamera(bpy.types.PropertyGroup):
    """A line of the list, at ``window_manager.refine_cameras``; its name is the view's."""

    seen: IntProperty(name="Splats", description="How many splats lie in its view")


def register() -> None:
    """Make a place for the list: of the session, not of the file."""
    manager = bpy.types.WindowManager
    manager.refine_cameras = CollectionProperty(type=RefineCamera, options={"SKIP_SAVE"})
    manager.refine_camera = IntProperty(options={"SKIP_SAVE"})


def unregister() -> None:
    """Undo `register`."""
    del bpy.types.WindowManager.refine_camera
    del bpy.types.WindowManager.refine_cameras


def fill(record: dict[str, Any]) -> None:
    """List the cameras of the note of a scoring, those that see least first."""
    listed = bpy.context.window_manager.refine_cameras
    listed.clear()
    for name, seen in sorted(record.get("cameras") or (), key=lambda camera: camera[1]):
        item = listed.add()
        item.name, item.seen = name, seen


def warning(record: dict[str, Any]) -> str:
    """Return a sentence if cameras of a scoring see no splat, else ""."""
    none = sum(seen == 0 for _, seen in record.get("cameras") or ())
    return f"No splat lies in the view of {counted(none, 'camera')}" if none else ""


class REFINE_UL_cameras(bpy.types.UIList):
    """Cameras that scored."""

    def draw_item(
        self,
        _context: bpy.types.Context,
        layout: bpy.types.UILayout,
        _data: bpy.types.WindowManager,
        item: RefineCamera,
        _icon: int,
        _active_data: Any,  # noqa: ANN401
        _active_property: str,
    ) -> None:
        """Draw a camera; one that sees nothing is marked."""
        row = layout.row()
        row.alert = item.seen == 0
        row.label(text=item.name, icon="CAMERA_DATA" if item.seen else "ERROR")
        row = row.row()
        row.alignment = "RIGHT"
        row.label(text=f"{item.seen:,}" if item.seen else "nothing")


class REFINE_PT_camera_list(bpy.types.Panel):
    """Who sees how much."""

    bl_label = "What Each Sees"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "REFINE"
    bl_parent_id = "REFINE_PT_cameras"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether there is a scoring to tell of."""
        obj = context.object
        return mesh_layout.looks_like_splats(obj) and bool(mesh_scores.record(obj.data))

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the list."""
        record = mesh_scores.record(context.object.data) or {}
        manager = context.window_manager
        if text := warning(record):
            label(self.layout, context, text, icon="ERROR")
        if not price.shows(context.object.data):
            return  # the list is of the object whose chart there is
        self.layout.template_list(
            *("REFINE_UL_cameras", "", manager, "refine_cameras", manager, "refine_camera"),
            rows=min(len(manager.refine_cameras) + 1, _MOST),
        )
