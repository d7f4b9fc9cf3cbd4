"""Copies of a scene rendered in its place, so that its own settings stay untouched."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import bpy

from ..core.execute import Cancelled

MARK = "refine_render"  # Custom property of a copy: its original scene


class Step(NamedTuple):
    """A render for Blender: its scene's name, whether an animation (writes files), a label."""

    scene: str
    animation: bool
    what: str


def copied(scene: bpy.types.Scene, what: str) -> bpy.types.Scene:
    """A copy that renders what the scene does, without compositor and sequencer, one view layer.
    Its name begins with a dot, so menus leave it out."""
    copy = scene.copy()
    copy.name = f".REFINE {what}"
    copy[MARK] = scene
    render = copy.render
    render.use_compositing = render.use_sequencer = render.use_multiview = False
    rendered = next((layer for layer in copy.view_layers if layer.use), copy.view_layers[0])
    for layer in copy.view_layers:
        layer.use = layer == rendered
    return copy


def existing(name: str) -> bpy.types.Scene:
    """A copy by its name; raises `Cancelled` if an undo has removed it."""
    scene = bpy.data.scenes.get(name)
    if scene is None:
        raise Cancelled
    return scene


def set_frames(name: str, frames: Sequence[int]) -> bpy.types.Scene:
    """Make a copy render evenly spaced frames, and go to the first."""
    scene = existing(name)
    scene.frame_start, scene.frame_end = frames[0], frames[-1]
    scene.frame_step = frames[1] - frames[0] if frames[1:] else 1
    if scene.frame_current != frames[0]:
        scene.frame_set(frames[0])
    return scene


def remove_all() -> None:
    """Remove all copies; windows that show one show its scene again."""
    for window in bpy.context.window_manager.windows:
        if MARK in window.scene:
            window.scene = window.scene[MARK]
    found = [scene for scene in bpy.data.scenes if MARK in scene]
    if bpy.context.window is None:  # as in a command: `remove` of 4.3 crashes without a window
        bpy.data.batch_remove(found)
        found = []
    for scene in found:
        bpy.data.scenes.remove(scene)


def write_exr(scene: bpy.types.Scene, path: Path) -> None:
    """Make a copy write images with all passes for `core.images`."""
    render, settings = scene.render, scene.render.image_settings
    _set_format(settings, "MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER")
    settings.color_depth, settings.exr_codec = "32", "NONE"
    if hasattr(settings, "use_exr_interleave"):  # since 5.0
        settings.use_exr_interleave = True
    render.filepath = str(path)
    render.use_file_extension = render.use_overwrite = True
    render.use_placeholder = render.use_stamp = False
    render.use_crop_to_border = True


def write_png(scene: bpy.types.Scene) -> None:
    """Make a copy save 16-bit PNG, as fast as possible."""
    settings = scene.render.image_settings
    _set_format(settings, "IMAGE", "PNG")
    settings.color_mode, settings.color_depth, settings.compression = "RGB", "16", 0


def show_as_stored(scene: bpy.types.Scene) -> None:
    """Give a copy the view transform that shows sRGB colours as they are."""
    view = scene.view_settings
    view.view_transform, view.look = "Standard", "None"
    view.exposure, view.gamma, view.use_curve_mapping = 0.0, 1.0, False
    if hasattr(view, "use_white_balance"):  # since 4.3
        view.use_white_balance = False
    scene.render.image_settings.color_management = "FOLLOW_SCENE"


def _set_format(settings: bpy.types.ImageFormatSettings, media_type: str, file_format: str) -> None:
    if hasattr(settings, "media_type"):  # since 5.0
        settings.media_type = media_type
    settings.file_format = file_format
    settings.color_management = "FOLLOW_SCENE"
