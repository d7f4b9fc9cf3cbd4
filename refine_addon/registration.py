"""What Blender is told about, and in which order; `unregister` takes it back in reverse."""

from __future__ import annotations

import bpy
from bpy.props import PointerProperty

from . import command
from .core import images
from .core.formats.registry import READ_SUFFIXES
from .ui import (
    camera_list,
    demand_changes,
    panel_cache,
    plans,
    price,
    render_notice,
    render_operators,
    running,
    select_tools,
    transforms,
)
from .ui.camera_import import REFINE_FH_cameras, REFINE_OT_import_cameras
from .ui.camera_list import REFINE_UL_cameras, RefineCamera
from .ui.compare import REFINE_OT_compare
from .ui.export_operators import REFINE_OT_export_levels, REFINE_OT_export_ply
from .ui.floaters import REFINE_OT_delete_floaters, REFINE_OT_find_floaters
from .ui.import_operators import REFINE_FH_ply, REFINE_OT_import_ply
from .ui.instances import REFINE_OT_make_real, REFINE_PT_instances
from .ui.operators import (
    REFINE_OT_apply,
    REFINE_OT_convert,
    REFINE_OT_levels,
    REFINE_OT_score,
)
from .ui.panel import (
    REFINE_PT_apply,
    REFINE_PT_camera_list,
    REFINE_PT_cameras,
    REFINE_PT_export,
    REFINE_PT_floaters,
    REFINE_PT_preview,
    REFINE_PT_score,
    REFINE_PT_splats,
    REFINE_PT_volumes,
)
from .ui.preferences import RefinePreferences
from .ui.properties import RefineSettings
from .ui.protect import REFINE_OT_protect
from .ui.remedies import (
    REFINE_OT_add_between,
    REFINE_OT_add_ring,
    REFINE_OT_keep_unseen,
    REFINE_OT_leave_out,
    REFINE_OT_turn_cameras,
)
from .ui.render_operators import REFINE_OT_render, REFINE_OT_watch_render
from .ui.select_operators import (
    REFINE_OT_delete_selected,
    REFINE_OT_grow_selection,
    REFINE_OT_select,
    REFINE_OT_select_by,
    REFINE_OT_separate_selected,
)
from .ui.select_panel import REFINE_PT_select
from .ui.select_tools import REFINE_OT_brush_radius, REFINE_OT_select_stroke
from .ui.transforms import REFINE_OT_bake_transform, REFINE_OT_join, REFINE_OT_mend
from .ui.view_operators import REFINE_OT_view
from .ui.volumes import (
    REFINE_OT_add_volume,
    REFINE_OT_crop,
    REFINE_OT_drop_volume,
    RefineVolume,
)
from .viewport import draw
from .webp import BlenderImages

CLASSES = (
    RefineCamera,
    RefineVolume,
    RefineSettings,
    RefinePreferences,
    REFINE_OT_import_ply,
    REFINE_OT_import_cameras,
    REFINE_OT_find_floaters,
    REFINE_OT_delete_floaters,
    REFINE_OT_protect,
    REFINE_OT_add_volume,
    REFINE_OT_drop_volume,
    REFINE_OT_crop,
    REFINE_OT_make_real,
    REFINE_OT_select_stroke,
    REFINE_OT_brush_radius,
    REFINE_OT_select,
    REFINE_OT_select_by,
    REFINE_OT_grow_selection,
    REFINE_OT_delete_selected,
    REFINE_OT_separate_selected,
    REFINE_OT_score,
    REFINE_OT_apply,
    REFINE_OT_compare,
    REFINE_OT_view,
    REFINE_OT_render,
    REFINE_OT_watch_render,
    REFINE_OT_convert,
    REFINE_OT_bake_transform,
    REFINE_OT_join,
    REFINE_OT_mend,
    REFINE_OT_export_levels,
    REFINE_OT_export_ply,
    REFINE_OT_levels,
    REFINE_OT_turn_cameras,
    REFINE_OT_add_between,
    REFINE_OT_add_ring,
    REFINE_OT_leave_out,
    REFINE_OT_keep_unseen,
    REFINE_FH_ply,
    REFINE_FH_cameras,
    REFINE_PT_splats,
    REFINE_PT_instances,
    REFINE_PT_cameras,
    REFINE_UL_cameras,
    REFINE_PT_camera_list,
    REFINE_PT_select,
    REFINE_PT_floaters,
    REFINE_PT_volumes,
    REFINE_PT_score,
    REFINE_PT_preview,
    REFINE_PT_apply,
    REFINE_PT_export,
)

_SPLATS = f"Gaussian Splats ({', '.join(READ_SUFFIXES)})"

_commands: list[object] = []
"""Handle of the command, which Blender wants back."""


def register() -> None:
    """Register classes, properties, menu entries and the command ``refine``."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.refine = PointerProperty(type=RefineSettings)
    bpy.types.TOPBAR_MT_file_import.append(_draw_import)
    bpy.types.TOPBAR_MT_file_export.append(_draw_export)
    bpy.types.TOPBAR_MT_render.append(render_operators.draw_menu)
    render_notice.register()
    camera_list.register()
    panel_cache.register()
    demand_changes.register()
    price.register()
    plans.register()
    draw.register()
    running.register()
    transforms.register()
    select_tools.register()
    images.use(BlenderImages())
    _commands.append(bpy.utils.register_cli_command("refine", _run_command))


def unregister() -> None:
    """Undo `register`, in reverse."""
    draw.unregister()
    bpy.utils.unregister_cli_command(_commands.pop())
    images.use(None)
    transforms.unregister()
    select_tools.unregister()
    running.unregister()
    plans.unregister()
    price.unregister()
    demand_changes.unregister()
    panel_cache.unregister()
    camera_list.unregister()
    render_notice.unregister()
    bpy.types.TOPBAR_MT_render.remove(render_operators.draw_menu)
    bpy.types.TOPBAR_MT_file_export.remove(_draw_export)
    bpy.types.TOPBAR_MT_file_import.remove(_draw_import)
    del bpy.types.Scene.refine
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)


def _run_command(arguments: list[str]) -> int:
    return command.main(arguments, scene=True)


def _draw_import(menu: bpy.types.Menu, _context: bpy.types.Context) -> None:
    menu.layout.operator("refine.import_ply", text=_SPLATS)
    menu.layout.operator("refine.import_cameras", text="Splat Cameras (.json, COLMAP)")


def _draw_export(menu: bpy.types.Menu, _context: bpy.types.Context) -> None:
    menu.layout.operator("refine.export_ply", text=_SPLATS)
