"""The tab REFINE in the 3D view's sidebar, in the order of work; drawing computes nothing."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import bpy
from bpy.props import EnumProperty

from ..cameras import CameraChoice, known_turn
from ..core.formats.ply import stated_model
from ..core.quality.alignment import Alignment
from ..core.report import size_in_words
from ..mesh import edit, scores
from ..mesh import layout as mesh_layout
from ..objects import demands, instances, splat_group
from ..viewport import draw as viewport_draw
from . import camera_operators, images, operators, plans, render_operators, transforms, wrapped
from .marks import ROLES
from .operator_bases import Acting, Answer, idle, in_object_mode, now, tooltips
from .properties import HINTS, METHODS
from .select_operators import ACTIONS
from .select_tools import SHAPES, selected_count
from .wrapped import InSidebar, counted


class REFINE_OT_view(bpy.types.Operator):
    """Draw the splats in the 3D views; nothing in the scene is changed"""

    bl_label = "Show Splats"
    bl_options = {"INTERNAL"}

    mode: EnumProperty(name="Show", description="What is drawn", items=viewport_draw.MODES)

    description = tooltips("mode", viewport_draw.MODES)

    def execute(self, _context: bpy.types.Context) -> Answer:
        """Draw, or stop."""
        viewport_draw.show(self.mode)
        return {"FINISHED"}


def _count(context: bpy.types.Context) -> int:
    """Number of splats that the active object instances."""

    def count() -> int:
        return sum(mesh_layout.splat_count(p.obj.data) for p in instances.shown_by(context))

    return plans.cached("instanced", count)


def _instances(context: bpy.types.Context) -> str:
    """A need: the active object instances splats."""
    obj = context.object
    if obj is None or mesh_layout.looks_like_splats(obj) or not _count(context):
        return "Select an object that instances splats"
    return "Make the object local first: a library has it" if obj.library else ""


class REFINE_OT_make_real(Acting, bpy.types.Operator):
    """Turn the splats that the active object instances into objects, which can be scored"""

    bl_label = "Make Splats Real"
    needs = (idle, in_object_mode, _instances)

    def act(self, context: bpy.types.Context) -> None:
        """Copy them with their data to where they are seen, and instance them no more."""
        instances.make_real(context)


class REFINE_PT_splats(InSidebar, bpy.types.Panel):
    """Splats to prune, and their display."""

    bl_label = "1 Splats"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the import, the active object's content, and the display modes."""
        layout, obj = self.layout, context.object
        layout.operator("refine.import_ply", icon="IMPORT")
        if mesh_layout.looks_like_splats(obj):
            _draw_objects(layout, splat_group.chosen(obj))
        elif obj is not None and mesh_layout.lost_base(obj):
            wrapped.label(layout, "Colours were lost: open it in Blender 5.2", icon="ERROR")
        elif _instances(context):
            wrapped.label(layout, "Select an object that holds splats", icon="INFO")
        else:
            text = f"{_count(context):,} instanced splats"
            wrapped.label(layout, text, icon="OUTLINER_OB_GROUP_INSTANCE")
            layout.operator("refine.make_real")
        _draw_modes(layout, obj if mesh_layout.looks_like_splats(obj) else None)
        _draw_progress(layout, "refine.import_ply")


class REFINE_PT_cameras(InSidebar, bpy.types.Panel):
    """Cameras that decide."""

    bl_label = "2 Cameras"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the choice of cameras, and what each sees."""
        layout, settings = wrapped.named_column(self.layout), context.scene.refine
        row = layout.row(align=True)
        row.operator("refine.import_cameras", icon="IMPORT")
        row.operator("refine.add_ring", text="Add a Ring", icon="OUTLINER_OB_CAMERA")
        layout.prop(settings, "source")
        if settings.source == "COLLECTION":
            layout.prop(settings, "collection", text="")  # room for its name
        if settings.source == "FRAMES":
            layout.prop(settings, "frame_step")
            frames = counted(len(settings.to_frames(context.scene)), "frame")
            layout.label(text=frames, icon="CAMERA_DATA")
        elif settings.source != "ACTIVE":
            choice = CameraChoice.of_scene(context.scene)
            count = plans.cached("cameras", lambda: len(choice.cameras(context)))
            layout.label(text=counted(count, "camera"), icon="CAMERA_DATA")
            layout.prop(settings, "exact")
        obj = context.object
        if not mesh_layout.looks_like_splats(obj):
            return
        record = scores.record(obj.data)
        if record is None:
            turn = plans.cached("turn", lambda: known_turn(context, obj))
            alignment = Alignment(turn, known=True)
        else:
            alignment = Alignment.from_facts(record.get("alignment"))
        if text := alignment.turned():
            wrapped.label(self.layout, text[:1].upper() + text[1:], icon="ERROR")
            self.layout.operator("refine.turn_cameras").quarters = alignment.turn
        if record:
            plan = plans.shown(context) or {}
            camera_operators.draw(self.layout, record, plan.get("views", {}))


class REFINE_PT_prune(InSidebar, bpy.types.Panel):
    """Method, budget, and their cost."""

    bl_label = "3 Prune"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the methods with their price, the budget, and the buttons."""
        layout, settings, obj = self.layout, context.scene.refine, context.object
        record = scores.record(obj.data) if mesh_layout.looks_like_splats(obj) else None
        plan = plans.shown(context) if record else None
        column = layout.column(align=True)
        for (name, text, _), hint in zip(METHODS, HINTS, strict=True):
            price = plans.price(plan, name) or hint
            column.prop_enum(settings, "method", name, text=f"{text} · {price}")
        column = wrapped.named_column(layout)
        column.prop(settings, "budget")
        column.prop(settings, "percent" if settings.budget == "ratio" else settings.budget)
        if settings.budget == "max_mb":
            column.prop(settings, "max_mb_in")
        row = layout.row(align=True)
        row.operator("refine.score", icon="CAMERA_DATA")
        row.operator("refine.apply", icon="TRASH")
        _draw_plan(layout, obj, record, plan)
        layout.operator("refine.compare", icon="IMAGE_DATA")
        if record and (text := operators.measured(obj, settings)):
            wrapped.label(layout, text, icon="CHECKMARK")
        if plan and plan.get("quality"):
            images.draw_chart(layout, plan["quality"])
        _draw_progress(layout, "refine.score", "refine.apply", "refine.compare")


class REFINE_PT_clean(InSidebar, bpy.types.Panel):
    """Floaters."""

    bl_label = "Clean"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the strength, its number of floaters, and the buttons."""
        layout, settings, obj = self.layout, context.scene.refine, context.object
        layout.row(align=True).prop(settings, "strength", expand=True)
        layout.operator("refine.find_floaters", text="Clean", icon="VIEWZOOM")
        if text := scores.floaters_in_words(obj and obj.data, settings.to_reasons()):
            wrapped.label(layout, text, icon="INFO")
            layout.operator_context = "EXEC_DEFAULT"
            text = "Delete Floaters"
            layout.operator("refine.delete", text=text, icon="TRASH").what = "FLOATERS"
        _draw_progress(layout, "refine.find_floaters")


class REFINE_PT_select(InSidebar, bpy.types.Panel):
    """The selection, its tools and its uses."""

    bl_label = "Select"
    bl_options = {"DEFAULT_CLOSED"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Whether there are splats to select."""
        return mesh_layout.looks_like_splats(context.object)

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the count, the tools, other ways to select, and the uses."""
        layout, settings, obj = self.layout, context.scene.refine, context.object
        total = mesh_layout.splat_count(obj.data)
        text = f"{selected_count(context):,} of {total:,} selected"
        layout.label(text=text, icon="RESTRICT_SELECT_OFF")
        grid = layout.grid_flow(columns=3, even_columns=True, align=True)
        for shape, text, _ in SHAPES:
            grid.operator("wm.tool_set_by_id", text=text).name = f"refine.select_{shape.lower()}"
        row = layout.row()
        row.prop(settings, "select_hidden")
        row.prop(settings, "select_connected")
        if obj.mode == "EDIT":
            wrapped.label(layout, "More in object mode", icon="INFO")
            return
        grid = layout.grid_flow(columns=3, even_columns=True, align=True)
        for action, text, _, icon, _ in ACTIONS:
            grid.operator("refine.select", text=text, icon=icon).action = action
        row = layout.row(align=True)
        row.operator("refine.grow_selection", text="Grow", icon="ADD").shrink = False
        row.operator("refine.grow_selection", text="Shrink", icon="REMOVE").shrink = True
        layout.row(align=True).prop(settings, "select_mode", expand=True, icon_only=True)
        menu = layout.operator_menu_enum("refine.select_by", "what", text="Select By")
        menu.mode = settings.select_mode
        row = layout.row(align=True)
        row.prop(settings, "select_opacity")
        row.prop(settings, "select_size")
        row = layout.row(align=True)
        marks = ("STAY", "Stay", "LOCKED"), ("GO", "Go", "TRASH"), ("NONE", "", "X")
        for mark, text, icon in marks:
            row.operator("refine.protect", text=text, icon=icon).mark = mark
        column = layout.column(align=True)
        column.operator("refine.grade", icon="COLOR")
        column.operator("refine.separate_selected", text="Separate", icon="MOD_EXPLODE")
        column.operator("refine.delete", text="Delete", icon="X").what = "SELECTED"


class REFINE_PT_protect(InSidebar, bpy.types.Panel):
    """Protected splats and those removed by the user."""

    bl_label = "Protect"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw marks, volumes, and the splats in them."""
        layout, settings, obj = self.layout, context.scene.refine, context.object
        record = demands.record(obj.data) if mesh_layout.looks_like_splats(obj) else {}
        layout.prop(settings, "protect", text="", icon="GROUP_VERTEX", placeholder="Vertex group")
        column = layout.column(align=True)
        for role, text, _, icon, _ in ROLES:
            button = column.operator_menu_enum("refine.add_volume", "shape", text=text, icon=icon)
            button.role = role
        counts = record.get("volumes", {})
        for index, item in enumerate(settings.volumes):
            row = layout.row(align=True)
            row.prop(item, "role", text="", icon_only=True)
            row.prop(item, "object", text="")
            count = counts.get(f"object '{item.object.name}'") if item.object else None
            if count is not None:
                row.label(text=f"{count:,}")
            row.operator("refine.drop_volume", text="", icon="X").index = index
        if "error" in record:
            wrapped.label(layout, record["error"], icon="ERROR")
            return
        if record.get("protected"):
            layout.label(text=f"Stay: {record['protected']:,}", icon="LOCKED")
        if record.get("removed_by_user"):
            layout.label(text=f"Go: {record['removed_by_user']:,}", icon="TRASH")
            layout.operator("refine.delete", text="Delete Now", icon="TRASH").what = "VOLUMES"


class REFINE_PT_deliver(InSidebar, bpy.types.Panel):
    """Export, levels, render."""

    bl_label = "Deliver"

    def draw(self, context: bpy.types.Context) -> None:
        """Draw the buttons."""
        layout, settings, obj = self.layout, context.scene.refine, context.object
        layout.operator("refine.export_ply", icon="EXPORT")
        render_operators.draw_buttons(layout.column(align=True))
        column = wrapped.named_column(layout)
        column.prop(settings, "levels")
        column.operator("refine.levels", icon="MOD_DECIM")
        if obj and splat_group.has_levels(obj):
            column.operator("refine.export_levels", icon="EXPORT")
        names = ("export_ply", "levels", "export_levels", "render")
        _draw_progress(layout, *(f"refine.{name}" for name in names))


def _draw_progress(layout: bpy.types.UILayout, *names: str) -> None:
    """Draw the progress if one of these operators runs. Called last in a panel, since Blender 4.3
    replaces a bar by a label that is drawn later."""
    running = now()
    if running is not None and running.operator in names:
        layout.progress(factor=running.worker.fraction, text=running.share)
        wrapped.label(layout, running.sentence)


def _draw_objects(layout: bpy.types.UILayout, objects: Sequence[bpy.types.Object]) -> None:
    obj = bpy.context.object
    count = sum(mesh_layout.splat_count(each.data) for each in objects)
    degree = max(mesh_layout.sh_degree(each.data) for each in objects)
    several = len(objects) > 1
    name = f"{len(objects)} objects, one scene" if several else obj.name
    text = f"{name}: {count:,} splats, SH degree {degree}"
    stored = None if several else plans.cached("layout", lambda: mesh_layout.layout_if_any(obj))
    text += f", {size_in_words(stored.file_bytes(count))}" if stored else ""
    wrapped.label(layout, text, icon="OUTLINER_OB_POINTCLOUD")
    if several:
        text = f"Score, Apply, Compare and Mend take all; other buttons '{obj.name}' alone"
        wrapped.label(layout, text, icon="INFO")
    transforms.draw(layout, objects)
    if stored and (
        mesh_layout.MODEL in obj.data or not stated_model(stored.header, stored.row_dtype)
    ):  # chosen, or not named by the file
        wrapped.named_column(layout).prop(bpy.context.scene.refine, "model")


def _draw_plan(layout: bpy.types.UILayout, obj: Any, record: Any, plan: Any) -> None:
    if record is None:
        lost = mesh_layout.looks_like_splats(obj) and scores.RANK in obj.data.attributes
        text = "Splats were deleted: score again" if lost else "Score to see what it costs"
        wrapped.label(layout, text, icon="INFO")
        return
    objects = splat_group.chosen(obj)
    question = ("changes", tuple(each.data.get(scores.RECORD) for each in objects))
    if changed := plans.cached(question, lambda: plans.stale(*objects)):
        wrapped.label(layout, f"Score again: {', '.join(changed)}", icon="ERROR")
    if plan is None:
        return  # a timer makes it
    if "error" in plan:
        wrapped.label(layout, plan["error"], icon="ERROR")
        return
    views = f"by {record['views_used']} of {counted(record['views_given'], 'view')}"
    if record.get("views_between"):
        views += f" and {record['views_between']} near them"
    wrapped.label(layout, f"{plans.sentence(plan)}, {views}", icon="CHECKMARK")
    if plan["remark"]:
        wrapped.label(layout, plan["remark"], icon="INFO")
    for text in plans.warnings(plan, record):
        wrapped.label(layout, text, icon="ERROR")


def _draw_modes(layout: bpy.types.UILayout, obj: bpy.types.Object | None) -> None:
    """Draw the display modes; those that need scores wait for them."""
    current, attributes = viewport_draw.mode(), obj.data.attributes if obj else ()
    needs = {"HEAT": scores.RANK, "STAYS": edit.REMOVE, "GOES": edit.REMOVE}
    grid = layout.grid_flow(row_major=True, columns=2, even_columns=True, align=True)
    for mode, text, _ in viewport_draw.MODES[1:]:
        cell = grid.row(align=True)
        cell.enabled = mode == current or mode not in needs or needs[mode] in attributes
        button = cell.operator("refine.view", text=text, depress=mode == current)
        button.mode = "OFF" if mode == current else mode
    if viewport_draw.failure():
        layout.label(text=viewport_draw.failure(), icon="ERROR")
