"""Operators on what must stay and go: volumes, marks by hand, floaters, deleting at once."""

from __future__ import annotations

import bpy
import numpy as np
from bpy.props import EnumProperty, IntProperty, PointerProperty
from bpy.types import Context

from ..core import Cleaned, Cleaning, RefineError, clean
from ..core.execute import Progress
from ..mesh import attributes, edit, layout, scores, selection
from ..objects import demands, splat_group
from . import plans
from .operator_bases import Acting, Answer, Job, Work, idle, on_splats, target_collection, tooltips
from .operators import chosen_views
from .select_operators import some, taken

ROLES = (
    ("PROTECT", "Protect Inside", "Splats inside stay, even where they must go", "LOCKED", 0),
    ("REMOVE", "Remove Inside", "Splats inside go before all others", "TRASH", 1),
    ("KEEP", "Keep Inside", "Splats outside of all volumes of this kind go", "FULLSCREEN_EXIT", 2),
)
"""Roles of volumes: core's names in capitals."""

_OUTSIDE, _OUTSIDE_KEPT = 0.25, 0.02
"""Share of splats beyond each face of a new volume; the latter for *Keep Inside*."""

_LEAST_HALF = 1e-3  # Least half width of a new volume, world units; splats may lie in a plane

SHAPES = (
    ("BOX", "Box", "A new box around the middle of the splats"),
    ("SPHERE", "Sphere", "A new sphere around the middle of the splats"),
    ("SELECTED", "Selected Objects", "Selected closed meshes, and empties shown as cube or sphere"),
)


class RefineVolume(bpy.types.PropertyGroup):
    """A volume of the list, at ``scene.refine.volumes``."""

    object: PointerProperty(
        name="Volume",
        description="A closed mesh, or an empty that is shown as a cube or a sphere",
        type=bpy.types.Object,
        poll=lambda _volume, obj: demands.can_be_volume(obj),
        update=plans.mark_again,
    )
    role: EnumProperty(
        name="Role",
        description="What happens to the splats inside",
        items=ROLES,
        update=plans.mark_again,
    )


class REFINE_OT_add_volume(Acting, bpy.types.Operator):
    """Add a volume to the list"""

    bl_label = "Add Volume"
    needs = (idle, on_splats)

    role: EnumProperty(name="Role", description="What happens to the splats inside", items=ROLES)
    shape: EnumProperty(name="Shape", description="The volume to add", items=SHAPES)
    description = tooltips("role", ROLES)

    def act(self, context: bpy.types.Context) -> None:
        """Add it, and select it to be moved; the splats stay active."""
        checked, new = layout.check(context.object), self.shape != "SELECTED"
        for obj in [self._new_empty(context, checked)] if new else _selected_volumes(context):
            item = context.scene.refine.volumes.add()
            item.role = self.role
            item.object = obj

    def _new_empty(self, context: Context, checked: layout.SplatObject) -> bpy.types.Object:
        """A new empty around the middle half of the splats, or nearly all if they are kept."""
        means = demands.finite_means(checked)
        share = _OUTSIDE_KEPT if self.role == "KEEP" else _OUTSIDE
        low, high = np.quantile(means, (share, 1.0 - share), axis=0)
        half = np.maximum((high - low) / 2.0, _LEAST_HALF)
        obj = bpy.data.objects.new(f"{checked.obj.name} {self.role.lower()}", None)
        obj.empty_display_type = "CUBE" if self.shape == "BOX" else "SPHERE"
        obj.location = (low + high) / 2.0
        obj.scale = half
        if self.shape == "SPHERE":
            away = np.linalg.norm(means - (low + high) / 2.0, axis=1)
            obj.scale = (max(float(np.quantile(away, 1.0 - 2.0 * share)), _LEAST_HALF),) * 3
        obj.show_in_front = True
        target_collection(context).objects.link(obj)
        for other in context.selected_objects:
            other.select_set(False)
        obj.select_set(True)
        context.view_layer.update()
        return obj


def _selected_volumes(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Selected objects not listed yet; raises `RefineError` if none fits."""
    listed = {item.object for item in context.scene.refine.volumes}
    objects = [obj for obj in context.selected_objects if obj not in listed]
    objects = [obj for obj in objects if not layout.looks_like_splats(obj)]
    if not objects:
        raise RefineError("no volume: select closed meshes or empties, and the splats last")
    for obj in objects:
        demands.zone("remove", obj)
    return objects


class REFINE_OT_drop_volume(Acting, bpy.types.Operator):
    """Remove the volume from the list; the object stays"""

    bl_label = "Remove from List"
    needs = (idle,)

    index: IntProperty(name="Index", description="Place in the list", min=0)

    def act(self, context: bpy.types.Context) -> None:
        """Remove it."""
        context.scene.refine.volumes.remove(self.index)
        plans.mark_again(self, context)


_MARKS = {"STAY": edit.PROTECT, "GO": edit.MUST_GO}

_ITEMS = (
    ("STAY", "Stay", "Mark the selected splats to stay, whatever the budget"),
    ("GO", "Go", "Mark the selected splats to go before all others"),
    ("NONE", "Unmark", "Remove both marks from the selected splats"),
)


class REFINE_OT_protect(Acting, bpy.types.Operator):
    """Mark the selected splats to stay, or to go"""

    bl_label = "Mark Splats"

    mark: EnumProperty(name="Mark", description="The mark to set", items=_ITEMS)
    description = tooltips("mark", _ITEMS)

    def act(self, context: bpy.types.Context) -> None:
        """Write the marks; a splat has one of the two."""
        obj = context.object
        chosen = some(obj, selection.selected(obj))
        for mark, name in _MARKS.items():
            before = attributes.attribute_if_any(obj.data, name, "BOOLEAN")
            others = False if before is None else before
            edit.mark(obj, name, np.where(chosen, mark == self.mark, others))
        plans.mark_again(self, context)


class REFINE_OT_find_floaters(Job, bpy.types.Operator):
    """Find splats that float where cameras see empty space, and ask whether to delete them"""

    bl_label = "Find Floaters"
    doing = "Looking for floaters"

    def work(self, context: Context) -> Work:
        """Find the floaters; store them, show them, report them."""
        checked, settings = layout.check(context.object), context.scene.refine
        edit.check_writable(checked.obj)
        cleaning = Cleaning(settings.to_reasons(), settings.views)
        masks = demands.Demands.of_scene(context.scene).masks([checked])
        splats, views = splat_group.gather([checked]), chosen_views(context)  # in the world

        def cleaned(progress: Progress) -> Cleaned:
            return clean(splats, views, cleaning, **masks, progress=progress)

        (checked,), found = yield [checked], cleaned
        scores.store_floaters(checked, found)
        plans.refresh(context)
        self.report({"INFO"}, f"Floaters: {found.in_words()}")

    def modal(self, context: Context, event: bpy.types.Event) -> Answer:
        """At the end ask whether to delete them."""
        answer = super().modal(context, event)
        if answer == {"FINISHED"}:
            bpy.ops.refine.delete("INVOKE_DEFAULT", what="FLOATERS")
        return answer


WHAT = (
    ("SELECTED", "Selected", "Delete the selected splats, except what must stay"),
    ("FLOATERS", "Floaters", "Delete the floaters of this strength, except what must stay"),
    ("VOLUMES", "By Volumes", "Delete the splats that must go by volumes and marks, and no others"),
)

_WORDS = {"SELECTED": "is selected", "FLOATERS": "floats", "VOLUMES": "must go"}


class REFINE_OT_delete(Acting, bpy.types.Operator):
    """Delete splats now, without scores"""

    bl_label = "Delete Splats"

    what: EnumProperty(name="What", description="Which splats go", items=WHAT)
    description = tooltips("what", WHAT)

    def invoke(self, context: Context, event: bpy.types.Event) -> Answer:
        """Of floaters, say which go, and ask."""
        reasons = context.scene.refine.to_reasons()
        text = scores.floaters_in_words(context.object.data, reasons)
        if self.what != "FLOATERS" or text.startswith("0 "):
            return self.execute(context)
        words = {"title": "Clean", "message": text, "confirm_text": "Delete"}
        return context.window_manager.invoke_confirm(self, event, **words)

    def act(self, context: bpy.types.Context) -> None:
        """Delete them, except protected ones, and report their number."""
        checked = layout.check(context.object)
        going = taken(context, checked, self.what) & ~taken(context, checked, "STAYING")
        if not going.any():
            what = f"no splat {_WORDS[self.what]}, or all of these must stay"
            raise RefineError(f"object '{checked.obj.name}': {what}")
        outcome = splat_group.delete_splats(checked, ~going)
        plans.refresh(context)
        self.report({"INFO"}, f"Deleted {outcome.removed:,} splats, kept {outcome.kept:,}")
