"""Operators on splat objects: each reads what the user chose and makes one call.

Read `REFINE_OT_apply` from `prepare` to `finish` to see what runs when *Apply* is clicked.
"""

# ruff: noqa: D400, N801, RUF012, TC002 - Blender's names and tooltips; annotations are run
from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
import numpy as np
from bpy.props import BoolProperty, EnumProperty, StringProperty
from bpy_extras.io_utils import ExportHelper

from ..cameras.sets import Choice
from ..core import pipeline, score_splats
from ..core.estimate.quality import in_words
from ..core.formats.registry import FORMATS, Packed, without_suffix
from ..core.levels.lod import Level, Levels, lod
from ..core.report import scoring_notes, sizes_in_words
from ..core.seeing import frustum
from ..core.work import part, report
from ..mesh import edit as mesh_edit
from ..mesh import layout as mesh_layout
from ..mesh import scores as mesh_scores
from ..mesh.convert import converted
from ..objects import level_objects, splat_group, splat_object
from ..objects.demands import Demands
from ..viewport import draw
from . import plans, preview, running, staleness
from .adjust import Adjustable
from .import_operators import FILE_NAMES
from .on_thread import FAILURES, Answer, AskedFirst, OnThread, fail
from .running import Sketch
from .wrapped import counted

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..core.formats.ply import SplatFile
    from ..core.scores import Scores
    from ..core.splats import Splats
    from ..core.task import Result, Settings, Task
    from ..core.views import ViewSet
    from ..core.volumes import Forced
    from ..core.work import Progress
    from ..mesh.layout import SplatObject


_FORMATS = (
    (".ply", ".ply", "In the layout that was imported"),
    *((form.suffix, form.suffix, f"It {form.loss}") for form in FORMATS),
)
"""The formats of an export as Blender lists them, with tooltips."""


class OnSplats:
    """An operator on the active object, which must hold splats."""

    waits = True
    """Whether it waits until another one is over that works on a thread."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether the operator can run, and if not, why."""
        if cls.waits and (why := running.refusal()):
            cls.poll_message_set(why)
            return False
        obj = context.object
        if not mesh_layout.looks_like_splats(obj):
            cls.poll_message_set("Select an object that holds splats: import a file of splats")
            return False
        if obj.mode == "EDIT":
            cls.poll_message_set("Leave edit mode first")
            return False
        return True


class OnScored(OnSplats):
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


def chosen_views(context: bpy.types.Context) -> ViewSet:
    """Return the views of the cameras that the panel names."""
    return Choice.of_scene(context.scene).views(context, context.object)


def apply_task(context: bpy.types.Context, group: splat_group.Members, found: list[Forced]) -> Task:
    """Return what *Apply* has to decide of the selected objects by the settings of the panel.

    `found` is what must stay and what must go of each.
    """
    settings = context.scene.refine
    return splat_group.stored_task(
        group,
        settings.to_budget(),
        found,
        settings=settings.to_settings(),
        views=chosen_views(context) if settings.absorb else None,
    )


def _of_objects(group: splat_group.Members) -> str:
    """Return how many objects were worked on, if more than one."""
    return f" of {len(group)} objects" if len(group) > 1 else ""


def _new_name(obj: bpy.types.Object) -> str:
    """Return a name for an export that no file beside the .blend has yet."""
    mesh = obj.data
    pruned = mesh_scores.RANK in mesh.attributes and mesh_scores.record(mesh) is None
    name = f"{obj.name}_{'pruned' if pruned else 'copy'}"
    names = itertools.chain([name], (f"{name}_{number}" for number in itertools.count(2)))
    folder = Path(bpy.path.abspath("//"))  # where the file browser starts
    return next(f"{new}.ply" for new in names if not (folder / f"{new}.ply").exists())


@dataclass(frozen=True, eq=False)
class _Scoring:
    """What is to be scored, by which views and how; where all of it stood (`staleness.origin`).

    What has to go is left out.
    """

    splats: Splats
    forced: Forced
    views: ViewSet
    settings: Settings
    quality: bool
    uids: tuple[int, ...]
    origins: list[dict[str, Any]]


class REFINE_OT_score(OnThread, OnSplats, bpy.types.Operator):
    """Score each splat by how much the cameras would miss it (Esc cancels)"""

    bl_idname = "refine.score"
    bl_label = "Score"
    bl_options = {"REGISTER", "UNDO"}
    doing = "Scoring splats"

    def prepare(self, context: bpy.types.Context, checked: SplatObject) -> _Scoring:
        """Gather splats, views and settings."""
        settings, views = context.scene.refine.to_settings(), chosen_views(context)
        group = splat_group.members(context.view_layer, checked)
        for member in group:
            mesh_edit.check_writable(member.obj)
        quality = settings.estimates or context.scene.refine.budget == "psnr"
        splats = splat_group.gather(group, whole=None if quality else False)
        origins = [staleness.origin(context, member.obj) for member in group]
        forced = splat_group.forced_of(splat_group.forced(context.scene, group), group)
        uids = splat_group.uids_of(group)
        return _Scoring(splats, forced, views, settings, quality, uids, origins)

    def written(self, context: bpy.types.Context, checked: SplatObject | None) -> list[SplatObject]:
        """Return the objects that are scored, the active one first."""
        return splat_group.active_first(context.view_layer, checked)

    def sketch(self, job: _Scoring) -> Sketch | None:
        """Score by the closed form first, which takes a fraction of the time."""
        if job.settings.method == "closed-form":
            return None
        work = partial(_sketched, job)
        left = "the scores are the closed form's"
        return Sketch(work, "Refining scores", "keeps the closed form's", left)

    @staticmethod
    def show(
        context: bpy.types.Context, checked: SplatObject, job: _Scoring, scores: Scores
    ) -> None:
        """Store the closed form's scores, to be looked at until those asked for are there."""
        group = splat_group.by_uids(job.uids, checked)
        noted = splat_group.Noted(_rough(job), job.origins, forced=job.forced, asked=job.settings)
        splat_group.store(group, scores, noted)
        plans.refresh(context)

    @staticmethod
    def work(job: _Scoring, progress: Progress) -> tuple[Scores, NDArray[np.int64]]:
        """Score, and count how many splats lie in each view."""
        ahead = part(progress, 0.0, 0.97)
        scores = score_splats.score(
            job.splats, job.views, job.settings,
            protected=job.forced.protected, removed=job.forced.removed,
            quality=job.quality, progress=ahead,
        )  # fmt: skip
        ahead = part(progress, 0.97, 1.0)
        gone, means = job.forced.removed, job.splats.means
        means = means if gone is None else means[~gone]
        return scores, frustum.census(means, job.views, progress=ahead)

    def finish(
        self,
        context: bpy.types.Context,
        checked: SplatObject,
        job: _Scoring,
        found: tuple[Scores, NDArray[np.int64]],
    ) -> Answer:
        """Store the scores on the meshes and say what came of it."""
        scores, counts = found
        pairs = zip(job.views, counts.tolist(), strict=True)
        cameras = [(view.name, count) for view, count in pairs if view.weight]
        group = splat_group.by_uids(job.uids, checked)
        forced = job.forced.counts()["forced"]
        noted = splat_group.Noted(job.settings, job.origins, cameras, job.forced)
        splat_group.store(group, scores, noted)
        plans.refresh(context)
        unseen = int((scores.seen == 0).sum()) - forced
        self.report(
            {"INFO"},
            f"Scored {len(scores.values) - forced:,} splats{_of_objects(group)} by "
            f"{scores.views_used} of "
            f"{counted(scores.views_given, 'view')}; {unseen:,} lie in none",
        )
        modified = [note for m in group for note in splat_object.modifier_notes(m.obj)]
        for note in (*scoring_notes(scores), *modified):
            self.report({"WARNING"}, note)
        return {"FINISHED"}


def _rough(job: _Scoring) -> Settings:
    """Return the settings of a sketch of the scores that a job asks for."""
    return replace(job.settings, method="closed-form")


def _sketched(job: _Scoring, progress: Progress) -> Scores:
    return score_splats.score(
        job.splats, job.views, _rough(job), removed=job.forced.removed, progress=progress
    )


class REFINE_OT_plan(OnScored, bpy.types.Operator):
    """Work out again how many splats stay and go"""

    bl_idname = "refine.plan"
    bl_label = "Update"
    bl_options = {"INTERNAL"}
    waits = False

    def execute(self, context: bpy.types.Context) -> Answer:
        """Work it out."""
        plans.refresh(context)
        return {"FINISHED"}


@dataclass(frozen=True, eq=False)
class _Applying:
    """What is to be decided, of which objects, and what must stay and go of each."""

    task: Task
    uids: tuple[int, ...]
    forced: list[Forced]


class REFINE_OT_apply(OnThread, OnSplats, Adjustable, bpy.types.Operator):
    """Delete the splats that the budget does not keep; with Absorb, survivors take them over"""

    bl_idname = "refine.apply"
    bl_label = "Apply"
    bl_options = {"REGISTER", "UNDO"}
    doing = "Absorbing splats"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether the operator can run, and if not, why.

        Also where it has run: to adjust it, Blender asks before it undoes it.
        """
        if not super().poll(context):
            return False
        mesh = context.object.data
        if mesh_scores.record(mesh) is None and mesh_scores.RANK not in mesh.attributes:
            cls.poll_message_set("Score the splats first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> Answer:
        """Do all of it at once; adjusted, by another budget than that of the panel."""
        return self.adjusted(context, partial(super().execute, context))

    def invoke(self, context: bpy.types.Context, event: bpy.types.Event) -> Answer:
        """Delete at once; absorb on a thread."""
        start = super().invoke

        def call() -> Answer:
            """Go by what the panel says by now."""
            absorbs = context.scene.refine.absorb
            return start(context, event) if absorbs else self.execute(context)

        return self.adjusted(context, call)

    def prepare(self, context: bpy.types.Context, checked: SplatObject) -> _Applying:
        """Gather the scores that decide; to absorb, splats and views besides."""
        group = splat_group.members(context.view_layer, checked)
        for member in group:
            mesh_edit.check_deletable(member.obj)
        found = splat_group.forced(context.scene, group)
        return _Applying(apply_task(context, group, found), splat_group.uids_of(group), found)

    def written(self, context: bpy.types.Context, checked: SplatObject | None) -> list[SplatObject]:
        """Return the objects that lose splats, the active one first."""
        return splat_group.active_first(context.view_layer, checked)

    @staticmethod
    def work(job: _Applying, progress: Progress) -> Result:
        """Decide which splats stay, and what they absorb."""
        return pipeline.decide(job.task, progress=progress)

    def finish(
        self, context: bpy.types.Context, checked: SplatObject, job: _Applying, result: Result
    ) -> Answer:
        """Delete what does not stay, and change what absorbed it."""
        context.view_layer.update()
        group = splat_group.by_uids(job.uids, checked)
        if job.task.absorb:  # on a thread, while volumes can be moved
            splat_group.check_forced(context.scene, group, job.forced)
        stay = splat_group.parts_of(job.task.protected, group)
        pairs = zip((member.obj for member in group), stay, strict=True)
        changed = staleness.changes_of(context, dict(pairs))
        if result.absorbed and not job.task.budget.needs_scores:
            changed = []  # nothing went by the scores
        done = splat_group.apply(group, result)
        for member in group:
            plans.forget(member.mesh)
        plans.refresh(context)
        psnr = result.report["estimated_psnr"]
        if result.absorbed:
            self.report({"INFO"}, result.absorbed.note())
        self.report(
            {"INFO"},
            f"Kept {done.kept:,} splats{_of_objects(group)}, removed {done.removed:,}: "
            + sizes_in_words(done.bytes_before, "->", done.bytes_after)
            + (f", {in_words(psnr)} in the views that scored" if psnr is not None else ""),
        )
        if changed:
            self.report(
                {"WARNING"},
                f"The scores were from before a change ({', '.join(changed)}); undo and "
                "score again if it is to count",
            )
        return {"FINISHED"}


@dataclass(frozen=True, eq=False)
class _Detail:
    """What levels are to be made of, by which views and how; what must stay and go."""

    splats: Splats
    views: ViewSet
    levels: Levels
    settings: Settings
    forced: Forced


class REFINE_OT_levels(OnThread, OnSplats, bpy.types.Operator):
    """Make objects with ever fewer of the splats, by the cameras, in a collection of their own"""

    bl_idname = "refine.levels"
    bl_label = "Make Levels"
    bl_options = {"REGISTER", "UNDO"}
    doing = "Making levels"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether the operator can run, and if not, why."""
        if not super().poll(context):
            return False
        if context.mode != "OBJECT":
            cls.poll_message_set("Go to object mode first")
            return False
        return True

    def prepare(self, context: bpy.types.Context, checked: SplatObject) -> _Detail:
        """Gather splats, views and settings."""
        settings = context.scene.refine
        levels = settings.to_levels()
        return _Detail(
            splat_object.gather(checked, whole=True if levels.absorb else None),
            chosen_views(context),
            levels,
            settings.to_settings(),
            Demands.of_scene(context.scene).forced(checked),
        )

    @staticmethod
    def work(job: _Detail, progress: Progress) -> list[Level]:
        """Make the levels."""
        return lod(
            job.splats, job.views, job.levels, job.settings,
            protected=job.forced.protected, removed=job.forced.removed, progress=progress,
        )  # fmt: skip

    def finish(
        self,
        _context: bpy.types.Context,
        checked: SplatObject,
        job: _Detail,
        levels: list[Level],
    ) -> Answer:
        """Make the objects and say what each level costs."""
        collection = level_objects.add_levels(checked, levels)
        told = [
            f"{len(level.splats):,}" + (f" ({in_words(level.psnr)})" if level.psnr else "")
            for level in levels
        ]
        self.report({"INFO"}, f"'{collection.name}': {', '.join(told)} splats")
        for note in job.levels.notes({level.asked: level.remark for level in levels}):
            self.report({"WARNING"}, note)
        return {"FINISHED"}


class REFINE_OT_preview(OnSplats, bpy.types.Operator):
    """Show the splats as points, or in renders as they are, without changing them"""

    bl_idname = "refine.preview"
    bl_label = "Preview"
    bl_options = {"REGISTER", "UNDO"}
    waits = False

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
    style: EnumProperty(
        name="Style",
        description="What is made of each splat",
        items=(
            ("POINTS", "Points", "A sphere, for the viewport"),
            ("SPLATS", "For Renders", "The Gaussian itself, for pictures that Cycles renders"),
        ),
        options={"SKIP_SAVE"},
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: Any) -> str:  # noqa: ANN401
        """Return the tooltip of a button."""
        if properties.style == "SPLATS" and properties.mode != "OFF":
            return (
                "Let renders show the splats as they are; sets the scene to Cycles, without light "
                "and with the view transform Standard"
            )
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
                hide, style = self.hide_removed, self.style
                preview.show(obj, self.mode, hide_removed=hide, style=style)
        except FAILURES as error:
            return fail(self, error)
        if self.mode != "OFF" and self.style == "SPLATS":
            preview.set_up_render(context.scene)
            return {"FINISHED"}  # too slow for the viewport, which draws them by itself
        draw.stop()
        shading = getattr(context.space_data, "shading", None)
        # Solid mode draws every point in one grey.
        if self.mode != "OFF" and shading and shading.type in {"SOLID", "WIREFRAME"}:
            shading.type = "MATERIAL"
        overlay = getattr(context.space_data, "overlay", None)
        if overlay:  # outlines of a million selected points hide their colours
            overlay.show_outline_selected = self.mode == "OFF"
        return {"FINISHED"}


class REFINE_OT_convert(OnSplats, bpy.types.Operator):
    """Turn a splat mesh into a point cloud of Blender's own splats, or such a point cloud back"""

    bl_idname = "refine.convert"
    bl_label = "Convert Splats"
    bl_options = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> Answer:
        """Put the other form in the place of the active object."""
        try:
            obj, notes = converted(mesh_layout.check(context.object))
        except FAILURES as error:
            return fail(self, error)
        plans.refresh(context)
        for note in notes:
            self.report({"WARNING"}, note)
        kind = "a point cloud" if obj.type == "POINTCLOUD" else "a mesh"
        self.report({"INFO"}, f"'{obj.name}' is {kind} now")
        return {"FINISHED"}


@dataclass(frozen=True, eq=False)
class _Export:
    """What is to be written where."""

    file: SplatFile
    target: Path
    overwrite: bool


class REFINE_OT_export_ply(AskedFirst, OnSplats, bpy.types.Operator, ExportHelper):
    """Write the active object's splats to a file, in the format that its suffix names"""

    bl_idname = "refine.export_ply"
    bl_label = "Export Splats"
    bl_options = {"REGISTER", "PRESET"}
    doing = "Writing splats"

    filename_ext = ".ply"
    filter_glob: StringProperty(default=FILE_NAMES, options={"HIDDEN"})
    suffix: EnumProperty(
        name="Format",
        description="Of the file that is picked here; a suffix that is typed chooses it",
        items=_FORMATS,
        options={"SKIP_SAVE"},
    )
    settled: StringProperty(default=_FORMATS[0][0], options={"HIDDEN", "SKIP_SAVE"})
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

    def ask(self, context: bpy.types.Context, event: bpy.types.Event) -> Answer:
        """Ask for the file; whoever picks an existing one in the browser means to replace it."""
        if not self.filepath:
            self.filepath = _new_name(context.object)
        self.overwrite = True
        return ExportHelper.invoke(self, context, event)

    def check(self, _context: bpy.types.Context) -> bool:
        """Bring name and format together, whichever was changed; return whether either changed."""
        before = self.filepath, self.suffix
        name = without_suffix(self.filepath)
        typed = self.filepath[len(name) :].lower()
        if typed and self.suffix == self.settled:
            self.suffix = typed
        self.filepath = name + self.suffix
        self.settled = self.suffix
        return before != (self.filepath, self.suffix)

    def written(
        self, _context: bpy.types.Context, _checked: SplatObject | None
    ) -> list[SplatObject]:
        """Return none: the object is only read."""
        return []

    def prepare(self, _context: bpy.types.Context, checked: SplatObject) -> _Export:
        """Refuse what cannot be written, and gather what is."""
        target = splat_object.export_target(
            bpy.path.abspath(self.filepath), overwrite=self.overwrite
        )
        file = splat_object.export_source(checked, apply_transform=self.apply_transform)
        return _Export(file, target, self.overwrite)

    @staticmethod
    def work(job: _Export, progress: Progress) -> SplatFile | Packed:
        """Write the file."""
        report(progress, 0.0, job.target.name)
        return splat_object.write_export(job.file, job.target, overwrite=job.overwrite)

    def finish(
        self,
        _context: bpy.types.Context,
        _checked: SplatObject | None,
        _job: _Export,
        file: SplatFile | Packed,
    ) -> Answer:
        """Say what was written."""
        if isinstance(file, Packed):
            self.report({"INFO"}, "; ".join(file.notes(np.ones(len(file.file), np.bool_))))
        self.report({"INFO"}, f"Wrote the splats to {self.filepath}")
        return {"FINISHED"}
