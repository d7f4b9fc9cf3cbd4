"""Copies of a scene that are rendered in its place, so that its own settings are never touched."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import bpy

from ..core.execute import Cancelled

MARK = "refine_render"
"""Custom property of such a copy: the scene that it is of."""


class Step(NamedTuple):
    """A render to be done by Blender.

    Attributes
    ----------
    scene : str
        Name of the scene to be rendered.
    animation : bool
        Whether as an animation, which writes files.
    what : str
        What is rendered, in a few words.
    """

    scene: str
    animation: bool
    what: str


def copied(scene: bpy.types.Scene, what: str) -> bpy.types.Scene:
    """A copy that renders what the scene does, without compositing and sequencer.

    Of several view layers it renders the first that the scene does. Menus of scenes leave it out,
    as all names that begin with a dot.
    """
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
    """A copy by its name; an undo may have removed it.

    Raises
    ------
    Cancelled
        If it is not there.
    """
    scene = bpy.data.scenes.get(name)
    if scene is None:
        raise Cancelled
    return scene


def set_frames(name: str, frames: Sequence[int]) -> bpy.types.Scene:
    """Have a copy render some frames, evenly apart, and go to the first of them."""
    scene = existing(name)
    scene.frame_start, scene.frame_end = frames[0], frames[-1]
    scene.frame_step = frames[1] - frames[0] if frames[1:] else 1
    if scene.frame_current != frames[0]:
        scene.frame_set(frames[0])
    return scene


def remove_all() -> None:
    """Remove all copies; a window that shows one shows its scene again."""
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
    """Have renders of a copy write images with all passes, which `core.images` reads."""
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
    """Have images of a copy saved as PNG of 16 bits, as fast as that goes."""
    settings = scene.render.image_settings
    _set_format(settings, "IMAGE", "PNG")
    settings.color_mode, settings.color_depth, settings.compression = "RGB", "16", 0


def show_as_stored(scene: bpy.types.Scene) -> None:
    """Give a copy the view transform that shows colours of sRGB as they are."""
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
