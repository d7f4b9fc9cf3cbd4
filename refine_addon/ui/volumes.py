"""What must stay and what must go, in the panel: marks by hand, and objects as volumes."""

# ruff: noqa: D400, N801, RUF012, TC002 - Blender's names and tooltips; annotations are run
from __future__ import annotations

from typing import TYPE_CHECKING

import bpy
import numpy as np
from bpy.app.handlers import persistent
from bpy.props import EnumProperty, IntProperty, PointerProperty

from ..core.errors import RefineError
from ..mesh import attributes as mesh_attributes
from ..mesh import edit as mesh_edit
from ..mesh import layout as mesh_layout
from ..mesh import scores as mesh_scores
from ..objects import demands, splat_object
from . import plans, running, wrapped
from .on_thread import FAILURES, Answer, fail

if TYPE_CHECKING:
    from numpy.typing import NDArray

ROLES = (
    ("PROTECT", "Protect Inside", "Splats in it stay, whatever else is said", "LOCKED", 0),
    ("REMOVE", "Remove Inside", "Splats in it go before all others", "TRASH", 1),
    (
        "KEEP",
        "Keep Inside",
        "All splats go that are in no volume of this kind",
        "FULLSCREEN_EXIT",
        2,
    ),
)
"""What becomes of the splats in a volume, by the names that core gives it in small letters."""

SHAPES = (
    ("BOX", "Box", "A new box around the middle of the splats"),
    ("SPHERE", "Sphere", "A new sphere around the middle of the splats"),
    (
        "SELECTED",
        "Selected Objects",
        "Closed meshes, and empties shown as cubes or spheres, that are selected too",
    ),
)


def _changed(_volume: RefineVolume, context: bpy.types.Context) -> None:
    again(context)


def _fits(_volume: RefineVolume, obj: bpy.types.Object) -> bool:
    return demands.can_be_volume(obj)


class RefineVolume(bpy.types.PropertyGroup):
    """A volume of the list, at ``scene.refine.volumes``."""

    object: PointerProperty(
        name="Volume",
        description="A closed mesh, or an empty that is shown as a cube or a sphere",
        type=bpy.types.Object,
        poll=_fits,
        update=_changed,
    )
    role: EnumProperty(
        name="Role", description="What becomes of the splats in it", items=ROLES, update=_changed
    )


def again(context: bpy.types.Context) -> None:
    """Mark soon what must stay and go of the splats, which may be otherwise now."""
    objects = _splats(context)
    if bpy.app.background:
        plans.refresh_objects(context.scene, objects)
    elif objects:
        plans.wait(context.scene, objects, plans.REST)


def _splats(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the objects whose splats are marked, or are to be: the one looked at comes first.

    That is the active one, or else the first there is; also all that are selected, and all that
    bear marks or scores.
    """
    active = getattr(context, "object", None)
    objects = [o for o in context.scene.objects if mesh_layout.looks_like_splats(o)]
    looked_at = [active] if active in objects else [o for o in objects if o.visible_get()][:1]
    others = (
        obj
        for obj in objects
        if obj.select_get() or demands.FACTS in obj.data or mesh_scores.RECORD in obj.data
    )
    return list(dict.fromkeys([*looked_at, *others]))


_edited: set[str] = set()
"""Names of objects whose marks were changed in edit mode, where nothing can be counted."""


@persistent
def _updated(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph | None = None) -> None:
    """Hear of volumes that move, of splats that move under them, and of the end of edit mode."""
    if depsgraph is None or bpy.app.background:
        return
    objects = {bpy.data.objects.get(name) for name in _edited} - {None}
    if objects and all(obj.mode != "EDIT" for obj in objects):
        _edited.clear()
        again(bpy.context)
        return
    if not scene.refine.volumes:
        return
    there = {item.object for item in demands.listed(scene)}
    there |= {obj.data for obj in there if obj.data is not None}
    for update in depsgraph.updates:
        original = update.id.original
        moved = update.is_updated_transform and mesh_layout.looks_like_splats(
            original if isinstance(original, bpy.types.Object) else None
        )
        if moved or original in there:
            again(bpy.context)
            return


@persistent
def _undone(*_: object) -> None:
    """Mark anew what may be marked as before or after a step."""
    if not bpy.app.background and bpy.context.scene.refine.volumes:
        again(bpy.context)


def register() -> None:
    """Hear of changes."""
    handlers = bpy.app.handlers
    handlers.depsgraph_update_post.append(_updated)
    handlers.undo_post.append(_undone)
    handlers.redo_post.append(_undone)


def unregister() -> None:
    """Hear of changes no more."""
    handlers = bpy.app.handlers
    handlers.redo_post.remove(_undone)
    handlers.undo_post.remove(_undone)
    handlers.depsgraph_update_post.remove(_updated)
    _edited.clear()


class _Waiting(bpy.types.Operator):
    """An operator that waits until work on a thread is over: that goes by what it read."""

    @classmethod
    def poll(cls, _context: bpy.types.Context) -> bool:
        """Tell whether the operator can run, and if not, why."""
        if why := running.refusal():
            cls.poll_message_set(why)
            return False
        return True


class _OnSplats(_Waiting):
    """An operator on the active object, which must hold splats, in object or edit mode."""

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether the operator can run, and if not, why."""
        if not super().poll(context):
            return False
        if not mesh_layout.looks_like_splats(context.object):
            cls.poll_message_set("Select an object that holds splats: import a file of splats")
            return False
        return True


class REFINE_OT_protect(_OnSplats):
    """Change which splats are marked to stay"""

    bl_idname = "refine.protect"
    bl_label = "Protect Splats"
    bl_options = {"REGISTER", "UNDO"}

    mode: EnumProperty(
        name="Mode",
        description="What is done to the marks",
        items=(
            ("ADD", "Protect Selected", "Mark the selected splats to stay"),
            ("SUBTRACT", "Release Selected", "Take the marks off the selected splats"),
            ("CLEAR", "Clear", "Take the marks off all splats"),
        ),
    )

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.AnyType) -> str:
        """Return the tooltip of a button."""
        return {
            "ADD": "Mark the splats that are selected in edit mode: they stay, whatever the budget",
            "SUBTRACT": "Take the marks off the splats that are selected in edit mode",
            "CLEAR": "Take the marks off all splats",
        }[properties.mode]

    def execute(self, context: bpy.types.Context) -> Answer:
        """Write the marks."""
        obj = context.object
        try:
            mesh_edit.check_writable(obj)
            if obj.mode == "EDIT" and obj.type == "MESH":
                _mark_in_edit_mode(obj, self.mode)
            else:
                _mark(obj, self.mode)
        except FAILURES as error:
            return fail(self, error)
        if obj.mode == "EDIT":
            _edited.add(obj.name)
        else:
            marked = mesh_edit.protected_mask(obj, "")
            count = 0 if marked is None else int(np.count_nonzero(marked))
            self.report({"INFO"}, f"{count:,} splats are marked to stay")
        again(context)
        return {"FINISHED"}


def _mark(obj: bpy.types.Object, mode: str) -> None:
    """Change the marks by what is selected."""
    mesh, marked = obj.data, mesh_edit.protected_mask(obj, "")
    if marked is None:
        marked = np.zeros(mesh_layout.splat_count(mesh), np.bool_)
    if mode == "CLEAR":
        marked[:] = False
    else:
        marked[_selection(obj)] = mode == "ADD"
    mesh_edit.mark_protected(obj, marked)


def _selection(obj: bpy.types.Object) -> NDArray[np.bool_]:
    """Return which splats are selected, (N,).

    Raises
    ------
    RefineError
        If none is.
    """
    name = ".selection" if obj.type == "POINTCLOUD" else ".select_vert"
    attribute = obj.data.attributes.get(name)
    if attribute and attribute.domain == "POINT" and attribute.data_type in {"BOOLEAN", "FLOAT"}:
        selected = mesh_attributes.read_attribute(obj.data, name) > 0
        if selected.any():
            return np.asarray(selected)
    elif obj.mode == "EDIT":
        return np.ones(mesh_layout.splat_count(obj.data), np.bool_)  # Blender's way to say all
    msg = f"object '{obj.name}': no splat is selected; select some in edit mode first"
    raise RefineError(msg)


def _mark_in_edit_mode(obj: bpy.types.Object, mode: str) -> None:
    """Change the marks of a mesh in edit mode, where Blender itself has to write them.

    Raises
    ------
    RefineError
        If no splat is selected, or Blender fails.
    """
    mesh = obj.data
    if mode == "CLEAR":
        mesh_attributes.remove_attribute(mesh, mesh_edit.PROTECT)
        return
    if not mesh.total_vert_sel:
        msg = f"object '{obj.name}': no splat is selected"
        raise RefineError(msg)
    marks = mesh.attributes.get(mesh_edit.PROTECT)
    if marks and (marks.data_type, marks.domain) != ("BOOLEAN", "POINT"):
        mesh_attributes.remove_attribute(mesh, mesh_edit.PROTECT)
        marks = None
    before = mesh.attributes.active.name if mesh.attributes.active else ""
    mesh.attributes.active = marks or mesh.attributes.new(mesh_edit.PROTECT, "BOOLEAN", "POINT")
    try:
        bpy.ops.mesh.attribute_set(value_bool=mode == "ADD")
    except RuntimeError as error:
        msg = f"object '{obj.name}': Blender could not mark the splats ({str(error).strip()})"
        raise RefineError(msg) from error
    finally:
        if before in mesh.attributes:
            mesh.attributes.active = mesh.attributes[before]


class REFINE_OT_add_volume(_OnSplats):
    """Add a volume to the list"""

    bl_idname = "refine.add_volume"
    bl_label = "Add Volume"
    bl_options = {"REGISTER", "UNDO"}

    role: EnumProperty(name="Role", description="What becomes of the splats in it", items=ROLES)
    shape: EnumProperty(name="Shape", description="What is added", items=SHAPES)

    @classmethod
    def description(cls, _context: bpy.types.Context, properties: bpy.types.AnyType) -> str:
        """Return the tooltip of a button."""
        return next(role[2] for role in ROLES if role[0] == properties.role)

    def execute(self, context: bpy.types.Context) -> Answer:
        """Add it, selected, so that it can be moved; the splats stay active."""
        try:
            checked = mesh_layout.check(context.object)
            if self.shape == "SELECTED":
                objects = _selected_volumes(context)
            else:
                objects = [_new_empty(context, checked, self.shape, self.role)]
        except FAILURES as error:
            return fail(self, error)
        for obj in objects:
            item = context.scene.refine.volumes.add()
            item.role = self.role
            item.object = obj
        return {"FINISHED"}


def _selected_volumes(context: bpy.types.Context) -> list[bpy.types.Object]:
    """Return the objects that are selected beside the splats, and not listed yet.

    Raises
    ------
    RefineError
        If there are none, or one can be no volume.
    """
    listed = {item.object for item in context.scene.refine.volumes}
    objects = [o for o in context.selected_objects if not mesh_layout.looks_like_splats(o)]
    objects = [obj for obj in objects if obj not in listed]
    if not objects:
        msg = "no volume: select closed meshes or empties, and the splats last"
        raise RefineError(msg)
    for obj in objects:
        demands.zone("remove", obj)
    return objects


def _new_empty(
    context: bpy.types.Context, checked: mesh_layout.SplatObject, shape: str, role: str
) -> bpy.types.Object:
    """Return a new empty around the middle half of the splats, or nearly all if they are kept."""
    means = demands.world_means(checked)
    means = means[np.isfinite(means).all(axis=1)]
    if not len(means):
        msg = f"object '{checked.obj.name}': no splat has a finite centre"
        raise RefineError(msg)
    share = 0.02 if role == "KEEP" else 0.25
    low, high = np.quantile(means, (share, 1.0 - share), axis=0)
    half = np.maximum((high - low) / 2.0, 1e-3)
    obj = bpy.data.objects.new(f"{checked.obj.name} {role.lower()}", None)
    obj.empty_display_type = "CUBE" if shape == "BOX" else "SPHERE"
    obj.location = (low + high) / 2.0
    obj.scale = half
    if shape == "SPHERE":
        away = np.linalg.norm(means - (low + high) / 2.0, axis=1)
        obj.scale = (max(float(np.quantile(away, 1.0 - 2.0 * share)), 1e-3),) * 3
    obj.show_in_front = True
    context.collection.objects.link(obj)
    for other in context.selected_objects:
        other.select_set(False)
    obj.select_set(True)
    context.view_layer.update()
    return obj


class REFINE_OT_drop_volume(_Waiting):
    """Take the volume off the list; the object stays"""

    bl_idname = "refine.drop_volume"
    bl_label = "Remove from List"
    bl_options = {"REGISTER", "UNDO"}

    index: IntProperty(name="Index", description="Place in the list", min=0)

    def execute(self, context: bpy.types.Context) -> Answer:
        """Take it off."""
        context.scene.refine.volumes.remove(self.index)
        again(context)
        return {"FINISHED"}


class REFINE_OT_crop(_OnSplats):
    """Delete now what the volumes say must go, without scores; nothing else is deleted"""

    bl_idname = "refine.crop"
    bl_label = "Delete Now"
    bl_options = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        """Tell whether the operator can run, and if not, why."""
        if not super().poll(context):
            return False
        if context.object.mode == "EDIT":
            cls.poll_message_set("Leave edit mode first")
            return False
        return True

    def execute(self, context: bpy.types.Context) -> Answer:
        """Delete it."""
        try:
            checked = mesh_layout.check(context.object)
            removed = demands.Demands.of_scene(context.scene).forced(checked).removed
            if removed is None or not removed.any():
                msg = f"object '{checked.obj.name}': no volume says of any splat that it must go"
                raise RefineError(msg)
            done = splat_object.delete_splats(checked, ~removed)
        except FAILURES as error:
            return fail(self, error)
        plans.forget(checked.mesh)
        plans.refresh(context)
        self.report({"INFO"}, f"Deleted {done.removed:,} splats, {done.kept:,} stay")
        return {"FINISHED"}


class REFINE_PT_volumes(bpy.types.Panel):
    """What must stay and what must go."""

    bl_label = "Protect and Crop"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "REFINE"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: bpy.types.Context) -> None:
        """Draw marks, volumes, and how many splats they concern."""
        layout, settings, obj = self.layout, context.scene.refine, context.object
        splats = mesh_layout.looks_like_splats(obj)
        found = demands.facts(obj.data) if splats else {}
        layout.prop(settings, "protect", text="", icon="GROUP_VERTEX", placeholder="Vertex group")
        row = layout.row(align=True)
        row.operator("refine.protect", text="Protect Selected", icon="LOCKED").mode = "ADD"
        row.operator("refine.protect", text="", icon="REMOVE").mode = "SUBTRACT"
        row.operator("refine.protect", text="", icon="X").mode = "CLEAR"
        column = layout.column(align=True)
        for role, text, _, icon, _ in ROLES:
            column.operator_menu_enum(
                "refine.add_volume", "shape", text=text, icon=icon
            ).role = role
        held = found.get("volumes", {})
        for index, item in enumerate(settings.volumes):
            row = layout.row(align=True)
            row.prop(item, "role", text="", icon_only=True)
            row.prop(item, "object", text="")
            count = held.get(f"object '{item.object.name}'") if item.object else None
            if count is not None:
                row.label(text=f"{count:,}")
            row.operator("refine.drop_volume", text="", icon="X").index = index
        if "error" in found:
            wrapped.label(layout, context, found["error"], icon="ERROR")
            return
        if found.get("protected"):
            layout.label(text=f"Stay: {found['protected']:,}", icon="LOCKED")
        if found.get("forced"):
            layout.label(text=f"Go: {found['forced']:,}", icon="TRASH")
            layout.operator("refine.crop", icon="TRASH")
