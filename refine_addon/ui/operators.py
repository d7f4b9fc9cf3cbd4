"""Operators on splat objects: each reads what the user chose and makes one call."""

# ruff: noqa: D400, N801, RUF012, TC002 - Blender's names and tooltips; annotations are run
from __future__ import annotations

from typing import TYPE_CHECKING, Any

import bpy
from bpy.props import BoolProperty, EnumProperty, StringProperty
from bpy_extras.io_utils import ExportHelper

from .. import splat_object
from ..cameras.sets import views_from_scene
from ..core import pipeline
from ..core.errors import Cancelled, RefineError
from ..core.report import scoring_notes
from ..core.work import Progress, silent
from ..mesh import edit as mesh_edit
from ..mesh import layout as mesh_layout
from ..mesh import scores as mesh_scores
from . import plans, preview, staleness
from .worker import Worker

if TYPE_CHECKING:
    from ..core.absorbing.absorb import Absorbed
    from ..core.scores import Scores
    from ..core.views import ViewSet

Answer = set[str]


def fail(operator: bpy.types.Operator, error: Exception) -> Answer:
    """Report an error to the user, and return that nothing was done."""
    operator.report({"ERROR"}, str(error))
    return {"CANCELLED"}


class _OnSplats:
    """An operator on the active object, which must hold splats."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether the operator can run, and if not, why."""
        obj = context.object
        if not mesh_layout.looks_like_splats(obj):
            cls.poll_message_set("Select an object that holds splats: import a 3DGS PLY file")
            return False
        if obj.mode == "EDIT":
            cls.poll_message_set("Leave edit mode first")
            return False
        return True


class _OnScored(_OnSplats):
    """An operator on the active object, which must be scored."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether the operator can run, and if not, why."""
        if not super().poll(context):
            return False
        if mesh_scores.record(context.object.data) is None:
            cls.poll_message_set("Score the splats first")
            return False
        return True


def _views(context: bpy.types.Context) -> ViewSet:
    """Return the views of the cameras that the panel names."""
    settings = context.scene.refine
    return views_from_scene(
        context,
        settings.source,
        collection=settings.collection,
        frames=settings.to_frames(context.scene),
        splats=context.object,
    )


class _OnThread:
    """An operator that waits for a thread in a window, with a bar to watch and a key to cancel.

    It says what to do in three steps: `prepare` reads what it needs of the scene, `work` runs on
    the thread and touches arrays alone, `finish` writes the result.
    """

    doing = ""

    def execute(self, context: bpy.types.Context) -> Answer:
        """Do all of it at once."""
        try:
            self.prepare(context, context.object)
            result = self.work(silent)
            return self.finish(context, context.object, result)
        except RefineError as error:
            return fail(self, error)

    def invoke(self, context: bpy.types.Context, _event: bpy.types.Event) -> Answer:
        """Start the thread, unless there is nobody to watch."""
        if bpy.app.background or context.window is None:
            return self.execute(context)
        try:
            self.prepare(context, context.object)
        except RefineError as error:
            return fail(self, error)
        # By name: the object itself may not be the same one after an undo.
        self._name = context.object.name
        self._worker = Worker(self.work)
        manager = context.window_manager
        self._timer = manager.event_timer_add(0.05, window=context.window)
        manager.modal_handler_add(self)
        self._show(context, 0.0)
        return {"RUNNING_MODAL"}

    def modal(self, context: bpy.types.Context, event: bpy.types.Event) -> Answer:
        """Wait for the thread, and write what it found."""
        if event.type == "ESC":
            self._worker.cancel()
        if event.type != "TIMER":
            return {"RUNNING_MODAL"}
        if self._worker.running():
            self._show(context, self._worker.fraction)
            return {"RUNNING_MODAL"}
        self._clean_up(context)
        try:
            result = self._worker.result()
            return self.finish(context, splat_object.find(self._name), result)
        except Cancelled:
            self.report({"INFO"}, f"{self.doing} cancelled; nothing was changed")
            return {"CANCELLED"}
        except RefineError as error:
            return fail(self, error)

    def cancel(self, context: bpy.types.Context) -> None:
        """Stop the thread where Blender ends the operator."""
        self._worker.cancel()
        self._clean_up(context)

    def _show(self, context: bpy.types.Context, fraction: float) -> None:
        context.window_manager.refine_progress = fraction
        context.workspace.status_text_set(f"{self.doing}: {fraction:.0%} (Esc cancels)")
        for area in context.window.screen.areas:
            if area.type == "VIEW_3D":
                area.tag_redraw()

    def _clean_up(self, context: bpy.types.Context) -> None:
        context.window_manager.event_timer_remove(self._timer)
        self._show(context, -1.0)
        context.workspace.status_text_set(None)


class REFINE_OT_score(_OnThread, _OnSplats, bpy.types.Operator):
    """Score each splat by how much the cameras would miss it (Esc cancels)"""

    bl_idname = "refine.score"
    bl_label = "Score"
    bl_options = {"REGISTER", "UNDO"}
    doing = "Scoring splats"

    def prepare(self, context: bpy.types.Context, obj: bpy.types.Object) -> None:
        """Gather splats, views and settings."""
        self._settings = context.scene.refine.to_settings()
        self._views = _views(context)
        splat_object.check_scorable(obj)
        self._splats = splat_object.gather(obj)
        self._origin = staleness.origin(context, obj)

    def work(self, progress: Progress) -> Scores:
        """Score."""
        return pipeline.score(self._splats, self._views, self._settings, progress=progress)

    def finish(self, context: bpy.types.Context, obj: bpy.types.Object, scores: Scores) -> Answer:
        """Store the scores on the mesh and say what came of it."""
        mesh_scores.store(obj, scores, self._settings, self._origin)
        plans.refresh(context)
        unseen = int((scores.seen == 0).sum())
        self.report(
            {"INFO"},
            f"Scored {len(scores.values):,} splats by {scores.views_used} of "
            f"{scores.views_given} views; {unseen:,} lie in none",
        )
        for note in (*scoring_notes(scores), *splat_object.modifier_notes(obj)):
            self.report({"WARNING"}, note)
        return {"FINISHED"}


class REFINE_OT_plan(_OnScored, bpy.types.Operator):
    """Work out again how many splats stay and go"""

    bl_idname = "refine.plan"
    bl_label = "Update"
    bl_options = {"INTERNAL"}

    def execute(self, context: bpy.types.Context) -> Answer:
        """Work it out."""
        plans.refresh(context)
        return {"FINISHED"}


class REFINE_OT_apply(_OnThread, _OnScored, bpy.types.Operator):
    """Delete the splats that the budget does not keep; with Absorb, survivors take them over"""

    bl_idname = "refine.apply"
    bl_label = "Apply"
    bl_options = {"REGISTER", "UNDO"}
    doing = "Absorbing splats"

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Answer:
        """Delete at once; absorb on a thread."""
        if not context.scene.refine.absorb:
            return self.execute(context)
        return super().invoke(context, event)

    def prepare(self, context: bpy.types.Context, obj: bpy.types.Object) -> None:
        """Gather what absorbing needs."""
        settings = context.scene.refine
        self._absorb = settings.absorb
        if not self._absorb:
            return
        self._settings = settings.to_settings()
        self._views = _views(context)
        self._count = int(splat_object.keep_mask(obj, settings.to_budget(), settings.protect).sum())
        self._protected = splat_object.protected(obj, settings.protect)
        mesh_edit.check_deletable(obj)
        self._splats = splat_object.gather(obj, whole=True)

    def work(self, progress: Progress) -> Absorbed | None:
        """Absorb, where that is asked for."""
        if not self._absorb:
            return None
        return pipeline.absorb_removed(
            self._splats, self._views, self._count, self._settings,
            protected=self._protected, progress=progress,
        )  # fmt: skip

    def finish(
        self, context: bpy.types.Context, obj: bpy.types.Object, absorbed: Absorbed | None
    ) -> Answer:
        """Delete what does not stay, and change what absorbed it."""
        settings = context.scene.refine
        budget = settings.to_budget()
        context.view_layer.update()
        changed = staleness.changes(context, obj)
        if absorbed and not budget.needs_scores:
            changed = []  # nothing went by the scores
        done = splat_object.apply_object(obj, budget, settings.protect, absorbed)
        plans.forget(obj.data)
        self.report(
            {"INFO"},
            f"Kept {done.kept:,} splats, removed {done.removed:,}: "
            f"{done.bytes_before / 1e6:,.1f} -> {done.bytes_after / 1e6:,.1f} MB",
        )
        if absorbed:
            self.report({"WARNING"}, absorbed.note())
        if changed:
            self.report(
                {"WARNING"},
                f"The scores were from before a change ({', '.join(changed)}); undo and "
                "score again if it is to count",
            )
        return {"FINISHED"}


class REFINE_OT_preview(_OnSplats, bpy.types.Operator):
    """Show the splats as points, without changing them"""

    bl_idname = "refine.preview"
    bl_label = "Preview"
    bl_options = {"REGISTER", "UNDO"}

    mode: EnumProperty(
        name="Show",
        description="What the points show",
        items=(
            ("HEAT", "Heat Map", "Rank of each splat: dark goes first, yellow last"),
            ("COLOR", "Colour", "The splat's own colour"),
            ("OFF", "Off", "Show the plain mesh again"),
        ),
    )
    hide_removed: BoolProperty(
        name="Hide What Goes", description="Hide the splats that the budget removes"
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: Any) -> str:  # noqa: ANN401
        """Return the tooltip of a button."""
        if properties.mode == "OFF":
            return "Show the plain mesh again"
        if properties.hide_removed:
            return "Hide the splats that would be removed; nothing is deleted"
        return {
            "HEAT": "Colour each splat by its rank: dark goes first, yellow goes last",
            "COLOR": "Show each splat in its own colour",
        }[properties.mode]

    def execute(self, context: bpy.types.Context) -> Answer:
        """Add, change or remove the preview."""
        obj = context.object
        try:
            if self.mode == "OFF":
                preview.hide(obj)
            else:
                preview.show(obj, self.mode, hide_removed=self.hide_removed)
        except RefineError as error:
            return fail(self, error)
        shading = getattr(context.space_data, "shading", None)
        # Solid mode draws every point in one grey.
        if self.mode != "OFF" and shading and shading.type in {"SOLID", "WIREFRAME"}:
            shading.type = "MATERIAL"
        overlay = getattr(context.space_data, "overlay", None)
        if overlay:  # outlines of a million selected points hide their colours
            overlay.show_outline_selected = self.mode == "OFF"
        return {"FINISHED"}


class REFINE_OT_export_ply(_OnSplats, bpy.types.Operator, ExportHelper):
    """Write the active object's splats to a 3DGS PLY file"""

    bl_idname = "refine.export_ply"
    bl_label = "Export Splats"
    bl_options = {"REGISTER"}

    filename_ext = ".ply"
    filter_glob: StringProperty(default="*.ply", options={"HIDDEN"})
    apply_transform: BoolProperty(
        name="Apply Transform",
        description="Write the splats as they stand in the world: positions, rotations, scales "
        "and view-dependent colour follow the object",
    )
    overwrite: BoolProperty(
        name="Overwrite",
        description="Replace the file if it exists",
        options={"SKIP_SAVE"},
    )

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Answer:
        """Ask for the file; whoever picks an existing one in the browser means to replace it."""
        if not self.filepath:
            self.filepath = f"{context.object.name}.ply"
        self.overwrite = True
        return super().invoke(context, event)

    def execute(self, context: bpy.types.Context) -> Answer:
        """Write the file."""
        obj = context.object
        try:
            file = splat_object.export_object(
                obj,
                bpy.path.abspath(self.filepath),
                apply_transform=self.apply_transform,
                overwrite=self.overwrite,
            )
        except RefineError as error:
            return fail(self, error)
        self.report({"INFO"}, f"Wrote {len(file):,} splats to {self.filepath}")
        return {"FINISHED"}
