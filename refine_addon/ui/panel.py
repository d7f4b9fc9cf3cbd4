"""The panel REFINE in the 3D view's sidebar: it draws settings and stored results."""

from __future__ import annotations

from typing import Any

import bpy

from ..cameras.sets import CameraChoice, known_turn
from ..core.quality.alignment import Alignment
from ..core.report import size_in_words
from ..mesh import edit as mesh_edit
from ..mesh import floaters, native
from ..mesh import layout as mesh_layout
from ..mesh import scores as mesh_scores
from ..objects import demands, level_objects, splat_group
from ..viewport import draw as viewport_draw
from . import (
    camera_list,
    compare,
    plans,
    price,
    render_operators,
    running,
    staleness,
    transforms,
    wrapped,
)
from .instances import REFINE_PT_instances
from .panel_cache import cached
from .properties import FLOATERS, RefineSettings
from .select_panel import REFINE_PT_select
from .view_operators import MODES
from .volumes import ROLES, RefineVolume
from .wrapped import counted

_NONE = "Select an object that holds splats"


class _InSidebar:
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "REFINE"


def _named_column(layout: bpy.types.UILayout) -> bpy.types.UILayout:
    """Return a column of settings with their names beside them."""
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    return column


class REFINE_PT_splats(_InSidebar, bpy.types.Panel):
    """What is to be pruned."""

    bl_label = "1 Splats"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the import and what the active object holds."""
        layout = self.layout
        layout.operator("refine.import_ply", icon="IMPORT")
        obj = context.object
        if not mesh_layout.looks_like_splats(obj):
            lost = obj is not None and native.lost_base(obj)
            text = "Colours were lost: open it in Blender 5.2" if lost else _NONE
            wrapped.label(layout, context, text, icon="ERROR" if lost else "INFO")
            _draw_progress(layout, context, "refine.import_ply")
            return
        objects = splat_group.chosen(context.view_layer, obj)
        count = sum(mesh_layout.splat_count(each.data) for each in objects)
        several = len(objects) > 1
        degree = max(mesh_layout.sh_degree(each.data) for each in objects)
        text = f"{counted(len(objects), 'object') if several else obj.name}: {count:,} splats"
        size = None
        if not several:
            size = cached("bytes", context, lambda: mesh_layout.export_bytes(obj))
        text += f", SH degree {degree}" + (f", {size_in_words(size)}" if size is not None else "")
        wrapped.label(layout, context, text, icon="OUTLINER_OB_POINTCLOUD")
        transforms.draw(layout, context, objects)
        if several:
            wrapped.label(layout, context, "Scored and pruned as one scene", icon="INFO")
            return
        _named_column(layout).prop(context.scene.refine, "model")
        _draw_progress(layout, context, "refine.import_ply")


class REFINE_PT_cameras(_InSidebar, bpy.types.Panel):
    """Who decides."""

    bl_label = "2 Cameras"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the choice of cameras."""
        layout, settings = _named_column(self.layout), context.scene.refine
        row = layout.row(align=True)
        row.operator("refine.import_cameras", icon="IMPORT")
        row.operator("refine.add_ring", text="Add a Ring", icon="OUTLINER_OB_CAMERA")
        layout.prop(settings, "source")
        if settings.source == "COLLECTION":
            layout.prop(settings, "collection", text="")  # room for its name
        if settings.source == "FRAMES":
            _draw_frames(layout, settings, context.scene)
        elif settings.source != "ACTIVE":
            count = cached("cameras", context, lambda: len(_cameras(context)))
            layout.label(text=counted(count, "camera"), icon="CAMERA_DATA")
        obj = context.object
        if mesh_layout.looks_like_splats(obj) and _record(obj) is None:
            turn = cached("turn", context, lambda: known_turn(context, obj))
            if turn:
                _draw_warning(self.layout, context, plans.turned(Alignment(turn, known=True)))


class REFINE_PT_camera_list(_InSidebar, bpy.types.Panel):
    """Who sees how much."""

    bl_label = "What Each Sees"
    bl_parent_id = "REFINE_PT_cameras"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether there is a scoring to tell of."""
        return _record(context.object) is not None

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the list."""
        record = _record(context.object) or {}
        if text := camera_list.warning(record):
            wrapped.label(self.layout, context, text, icon="ERROR")
        if price.shows(context.object.data):  # the list is of the object whose chart there is
            camera_list.draw(self.layout, context)


class REFINE_PT_floaters(_InSidebar, bpy.types.Panel):
    """What the cameras see through."""

    bl_label = "Floaters"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the reasons, how many splats each takes, and the buttons."""
        layout = self.layout
        settings = context.scene.refine
        layout.operator("refine.find_floaters", icon="VIEWZOOM")
        obj = context.object
        counts = floaters.counts(obj.data) if mesh_layout.looks_like_splats(obj) else None
        sure = {} if counts is None else floaters.surety(obj.data)
        column = layout.column(align=True)
        for name, text, _ in FLOATERS:
            shown = text if counts is None else f"{text}: {counts[name]:,}"
            if sure.get(name) is not None:
                shown += f" ({100.0 * sure[name]:.0f} %)"
            column.prop_enum(settings, "reasons", name, text=shown)
        if counts is not None:
            total = sum(counts[name] for name in settings.reasons)
            layout.label(
                text=f"Go: {total:,} of {mesh_layout.splat_count(obj.data):,}", icon="TRASH"
            )
            layout.operator("refine.delete_floaters", icon="TRASH")
        _draw_progress(layout, context, "refine.find_floaters")


class REFINE_PT_volumes(_InSidebar, bpy.types.Panel):
    """What must stay and what must go."""

    bl_label = "Protect and Crop"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw marks, volumes, and how many splats they concern."""
        layout, settings, obj = self.layout, context.scene.refine, context.object
        facts = demands.facts(obj.data) if mesh_layout.looks_like_splats(obj) else {}
        layout.prop(settings, "protect", text="", icon="GROUP_VERTEX", placeholder="Vertex group")
        row = layout.row(align=True)
        row.operator("refine.protect", text="Protect Selected", icon="LOCKED").mode = "ADD"
        row.operator("refine.protect", text="", icon="REMOVE").mode = "SUBTRACT"
        row.operator("refine.protect", text="", icon="X").mode = "CLEAR"
        column = layout.column(align=True)
        for role, text, _, icon, _ in ROLES:
            button = column.operator_menu_enum("refine.add_volume", "shape", text=text, icon=icon)
            button.role = role
        for index, item in enumerate(settings.volumes):
            _draw_volume(layout, index, item, facts.get("volumes", {}))
        if "error" in facts:
            wrapped.label(layout, context, facts["error"], icon="ERROR")
            return
        if facts.get("protected"):
            layout.label(text=f"Stay: {facts['protected']:,}", icon="LOCKED")
        if facts.get("removed_by_user"):
            layout.label(text=f"Go: {facts['removed_by_user']:,}", icon="TRASH")
            layout.operator("refine.crop", icon="TRASH")


def _draw_volume(
    layout: bpy.types.UILayout, index: int, item: RefineVolume, counts: dict[str, int]
) -> None:
    """Draw a volume of the list, and below its name how many splats lie in it, if known."""
    column = layout.column(align=True)
    row = column.row(align=True)
    row.prop(item, "role", text="", icon_only=True)
    row.prop(item, "object", text="")
    count = counts.get(f"object '{item.object.name}'") if item.object else None
    row = column.row()
    row.label(text="" if count is None else f"{count:,} inside")
    row.operator("refine.drop_volume", text="", icon="X").index = index


class REFINE_PT_score(_InSidebar, bpy.types.Panel):
    """The scoring."""

    bl_label = "3 Score"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the method, the button and what came of it."""
        layout = self.layout
        settings = context.scene.refine
        column = _named_column(layout)
        column.prop(settings, "method")
        if settings.method == "refit":
            column.prop(settings, "rounds")
        column.prop(settings, "views")
        layout.operator("refine.score", icon="CAMERA_DATA")
        obj = context.object
        record = _record(obj)
        if record:
            views = counted(record["views_given"], "view")
            layout.label(text=f"Scored by {record['views_used']} of {views}", icon="CHECKMARK")
            if changed := _changes(context, obj):
                text = f"Score again: {', '.join(changed)}"
                wrapped.label(layout, context, text, icon="ERROR")
        elif mesh_layout.looks_like_splats(obj) and mesh_scores.RANK in obj.data.attributes:
            wrapped.label(layout, context, "Splats were deleted: score again", icon="INFO")
        _draw_progress(layout, context, "refine.score")


class REFINE_PT_preview(_InSidebar, bpy.types.Panel):
    """Looking before deleting."""

    bl_label = "4 Preview"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the ways to look at the splats."""
        layout = self.layout
        obj = context.object
        splats = mesh_layout.looks_like_splats(obj)
        _draw_modes(layout, obj if splats else None)
        render_operators.draw_buttons(layout)


class REFINE_PT_apply(_InSidebar, bpy.types.Panel):
    """How much goes."""

    bl_label = "5 Apply"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the budget, what it would do, and the button."""
        layout = self.layout
        settings = context.scene.refine
        column = _named_column(layout)
        column.prop(settings, "budget")
        column.prop(settings, "percent" if settings.budget == "ratio" else settings.budget)
        obj = context.object
        record = _record(obj)
        if record:
            _draw_price(layout, context)
            _draw_plan(layout, context, record)
            layout.operator("refine.compare", icon="IMAGE_DATA")
            if text := compare.measured(obj, settings):
                wrapped.label(layout, context, text, icon="CHECKMARK")
            _draw_progress(layout, context, "refine.compare")
        row = layout.row()
        row.enabled = record is not None
        row.operator("refine.apply", icon="TRASH")
        _draw_progress(layout, context, "refine.apply")


class REFINE_PT_export(_InSidebar, bpy.types.Panel):
    """The way out."""

    bl_label = "6 Export"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the buttons."""
        layout, settings, obj = self.layout, context.scene.refine, context.object
        layout.operator("refine.export_ply", icon="EXPORT")
        column = _named_column(layout)
        column.prop(settings, "levels")
        column.operator("refine.levels", icon="MOD_DECIM")
        if level_objects.has_levels(obj):
            column.operator("refine.export_levels", icon="EXPORT")
        _draw_progress(
            layout, context, "refine.export_ply", "refine.levels", "refine.export_levels"
        )


def _draw_progress(layout: bpy.types.UILayout, context: bpy.types.Context, *names: str) -> None:
    """Draw how far an operator is that works on a thread, if it is one of these.

    To be called last: Blender 4.3 draws a label as a bar that takes the place of one in a panel.
    """
    now = running.now()
    if now is not None and now.operator in names:
        layout.progress(factor=now.factor, text=now.share)
        wrapped.label(layout, context, now.sentence)


def _draw_frames(
    layout: bpy.types.UILayout, settings: RefineSettings, scene: bpy.types.Scene
) -> None:
    layout.prop(settings, "scene_frames")
    if not settings.scene_frames:
        column = layout.column(align=True)
        column.prop(settings, "frame_start")
        column.prop(settings, "frame_end")
    layout.prop(settings, "frame_step")
    layout.label(text=counted(len(settings.to_frames(scene)), "frame"), icon="CAMERA_DATA")


def _draw_modes(layout: bpy.types.UILayout, obj: bpy.types.Object | None) -> None:
    """Draw the ways to see splats as splats; those that need scores wait for them."""
    now = viewport_draw.mode()
    needs = {"HEAT": mesh_scores.RANK, "STAYS": mesh_edit.REMOVE, "GOES": mesh_edit.REMOVE}
    column = layout.column(align=True)
    rows = [column.row(align=True), column.row(align=True)]
    for place, (mode, text, _) in enumerate(MODES[1:]):
        cell = rows[place // 2].row(align=True)
        cell.enabled = mode == now or mode not in needs or _has(obj, needs[mode])
        button = cell.operator("refine.view", text=text, depress=mode == now)
        button.mode = "OFF" if mode == now else mode
    if viewport_draw.failure():
        layout.label(text=viewport_draw.failure(), icon="ERROR")


def _record(obj: bpy.types.Object | None) -> dict[str, Any] | None:
    """Return the record of an object's scoring, None without."""
    return mesh_scores.record(obj.data) if mesh_layout.looks_like_splats(obj) else None


def _has(obj: bpy.types.Object | None, attribute: str) -> bool:
    return obj is not None and attribute in obj.data.attributes


def _cameras(context: bpy.types.Context) -> list[bpy.types.Object]:
    return CameraChoice.of_scene(context.scene).cameras(context)


def _changes(context: bpy.types.Context, obj: bpy.types.Object) -> list[str]:
    """Return what changed since the objects that are worked on were scored."""
    objects = splat_group.chosen(context.view_layer, obj)
    question = ("changes", tuple(each.data.get(mesh_scores.RECORD) for each in objects))
    marked = dict.fromkeys(objects)  # what is protected of them is marked
    return cached(question, context, lambda: staleness.changes_of(context, marked))


def _draw_price(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the chart of the active object, and have it made if it is missing."""
    plans.ask(context, context.object)
    if price.shows(context.object.data):
        header, body = layout.panel("REFINE_price")
        header.label(text="Price")
        if body:
            row = body.row()
            row.alignment = "CENTER"
            row.template_icon(icon_value=price.icon(), scale=price.WIDTH)


def _draw_plan(
    layout: bpy.types.UILayout, context: bpy.types.Context, record: dict[str, Any]
) -> None:
    """Draw what the budget comes to, and what the cameras do not know of it."""
    obj, settings = context.object, context.scene.refine
    plan = plans.stored(obj, settings)
    if plan is None:
        return  # it is being made
    if "error" in plan:
        wrapped.label(layout, context, plan["error"], icon="ERROR")
        return
    wrapped.label(layout, context, plans.sentence(plan))
    if remark := plans.remark(plan, record):
        wrapped.label(layout, context, remark, icon="INFO")
    for warning in plans.warnings(plan, record):
        remedy = not _changes(context, obj)  # else it may be put right
        _draw_warning(layout, context, warning, remedy=remedy)


def _draw_warning(
    layout: bpy.types.UILayout,
    context: bpy.types.Context,
    warning: plans.Warned,
    *,
    remedy: bool = True,
) -> None:
    """Draw a warning, with the button that helps."""
    wrapped.label(layout, context, warning.text, icon="ERROR")
    if warning.remedy and remedy:
        button = layout.operator(warning.remedy)
        for name, value in warning.options.items():
            setattr(button, name, value)


CLASSES = (
    REFINE_PT_splats,
    REFINE_PT_instances,
    REFINE_PT_cameras,
    REFINE_PT_camera_list,
    REFINE_PT_select,
    REFINE_PT_floaters,
    REFINE_PT_volumes,
    REFINE_PT_score,
    REFINE_PT_preview,
    REFINE_PT_apply,
    REFINE_PT_export,
)
"""In the order of the sidebar."""
