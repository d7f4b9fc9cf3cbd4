"""The list of the cameras: what lies in the view of each, and how much of its picture changes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import bpy
from bpy.props import BoolProperty, CollectionProperty, FloatProperty, IntProperty, StringProperty

from ..core.quality.curve import in_words
from .wrapped import counted, label

_MOST = 6  # lines before the list scrolls


class RefineCamera(bpy.types.PropertyGroup):
    """A line of the list, at ``window_manager.refine_cameras``; its name is the view's."""

    seen: IntProperty(name="Splats", description="How many splats lie in its view")
    psnr: FloatProperty(
        name="dB",
        description="How close its picture is estimated to stay; negative where nothing tells",
        default=-1.0,
    )
    far: BoolProperty(name="Far Away", description="It sees the splats from far away")


def register() -> None:
    """Make a place for the list: of the session, not of the file."""
    manager = bpy.types.WindowManager
    manager.refine_cameras = CollectionProperty(type=RefineCamera, options={"SKIP_SAVE"})
    manager.refine_camera = IntProperty(options={"SKIP_SAVE"})
    manager.refine_changes_most = StringProperty(options={"SKIP_SAVE"})


def unregister() -> None:
    """Undo `register`."""
    del bpy.types.WindowManager.refine_changes_most
    del bpy.types.WindowManager.refine_camera
    del bpy.types.WindowManager.refine_cameras


def fill(record: dict[str, Any]) -> None:
    """List the cameras of the record of a scoring, those that see least first."""
    listed = bpy.context.window_manager.refine_cameras
    listed.clear()
    far = set((record.get("alignment") or {}).get("far", ()))
    for name, seen in sorted(record.get("cameras") or (), key=lambda camera: camera[1]):
        item = listed.add()
        item.name, item.seen, item.far = name, seen, name in far


def tell(psnr: Mapping[str, float]) -> None:
    """Take in how close the pictures of the cameras stay with the budget of the panel, dB.

    Parameters
    ----------
    psnr : mapping of str to float
        See `Quality.of_views`; empty where nothing is estimated.
    """
    manager = bpy.context.window_manager
    for item in manager.refine_cameras:
        item.psnr = psnr.get(item.name, -1.0)
    manager.refine_changes_most = min(psnr, key=psnr.__getitem__) if psnr else ""


def _changes_most(manager: bpy.types.WindowManager) -> str:
    """Return a sentence on the camera whose picture changes most, or ""."""
    name = manager.refine_changes_most
    item = manager.refine_cameras.get(name) if name else None
    return f"'{name}' changes most: {in_words(item.psnr)}" if item else ""


def warning(record: dict[str, Any]) -> str:
    """Return a sentence if cameras of a scoring see no splat, else ""."""
    none = sum(seen == 0 for _, seen in record.get("cameras") or ())
    return f"No splat lies in the view of {counted(none, 'camera')}" if none else ""


def useless(record: dict[str, Any]) -> set[str]:
    """Return the names of the cameras of a scoring that see nothing, or all from far away."""
    none = {name for name, seen in record.get("cameras") or () if seen == 0}
    return none | set((record.get("alignment") or {}).get("far", ()))


class REFINE_UL_cameras(bpy.types.UIList):
    """Cameras that scored."""

    def draw_item(
        self,
        _context: bpy.types.Context,
        layout: bpy.types.UILayout,
        manager: bpy.types.WindowManager,
        item: RefineCamera,
        _icon: int,
        _active_data: Any,
        _active_property: str,
    ) -> None:
        """Draw a camera; one that sees nothing is marked, and that whose picture changes most."""
        row = layout.row()
        row.alert = item.far or item.seen == 0
        icon = "SOLO_ON" if item.name == manager.refine_changes_most else "CAMERA_DATA"
        row.label(text=item.name, icon="ERROR" if row.alert else icon)
        right = row.row()
        right.alignment = "RIGHT"
        psnr = f", {in_words(item.psnr).removeprefix('about ')}" if item.psnr >= 0.0 else ""
        seen = "far away" if item.far else f"{item.seen:,}{psnr}"
        right.label(text=seen if item.seen else "nothing")


def draw(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the list, and a sentence on the camera whose picture changes most."""
    manager = context.window_manager
    layout.template_list(
        *("REFINE_UL_cameras", "", manager, "refine_cameras", manager, "refine_camera"),
        rows=min(len(manager.refine_cameras) + 1, _MOST),
    )
    if text := _changes_most(manager):
        label(layout, context, text, icon="SOLO_ON")


CLASSES = (RefineCamera, REFINE_UL_cameras)
