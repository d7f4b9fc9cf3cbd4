"""Operations are done whole or not at all, and keep nothing when they are over."""

import gc
import importlib
import shutil
import threading
import time
import weakref

import bpy
import numpy as np
import pytest

from tests.windows import event, started_in_a_window, until

from .test_merge import obj  # noqa: F401 - a fixture


def bits(obj):
    """Return all that a mesh holds, to the bit."""
    mesh = obj.data
    facts = {name: str(value) for name, value in mesh.items()}
    facts["name"], facts["groups"] = mesh.name, [group.name for group in obj.vertex_groups]
    facts["weights"] = [[(g.group, g.weight) for g in v.groups] for v in mesh.vertices[:50]]
    fields = {"FLOAT_VECTOR": ("vector", 3), "BYTE_COLOR": ("color", 4)}
    for attribute in mesh.attributes:
        field, width = fields.get(attribute.data_type, ("value", 1))
        values = np.empty(len(attribute.data) * width, np.float64)
        attribute.data.foreach_get(field, values)
        facts[f"{attribute.name} {attribute.data_type} {attribute.domain}"] = values.tobytes()
    return facts


@pytest.mark.parametrize("stage", ["deleting", "after deleting", "writing"])
def test_an_apply_that_fails_leaves_the_mesh_as_it_was(addon, obj, monkeypatch, stage):
    """With Merge, wherever it fails: attributes, groups, plan and scores are equal to the bit."""
    obj.vertex_groups.new(name="some").add(range(0, 3000, 7), 0.5, "REPLACE")
    obj.data.use_fake_user = True
    bpy.ops.refine.score()
    before, delete = bits(obj), addon.mesh.edit.delete_vertices

    def refuse(*arguments):
        if stage == "after deleting":
            delete(*arguments)
        raise addon.core.RefineError("refused")

    if stage == "writing":
        monkeypatch.setattr(addon.mesh.attributes, "write_columns", refuse)
    else:
        monkeypatch.setattr(addon.mesh.edit, "delete_vertices", refuse)
    with pytest.raises(RuntimeError, match="refused"):
        bpy.ops.refine.apply()
    assert bits(obj) == before
    assert obj.data.use_fake_user
    assert [mesh.name for mesh in bpy.data.meshes] == [obj.data.name]
    assert bpy.ops.refine.apply.poll()


def test_a_prune_in_the_blend_is_saved_whole_or_changes_nothing(addon, obj, room_views, tmp_path):
    """What is not exported is not deleted; where the .blend is not saved the export is named."""

    def pruned(folder):
        core = addon.core
        return addon.objects.splat_group.prune_object(
            "room", room_views, core.Budget(ratio=0.6), core.METHODS["merge"](4),
            output=folder / "out.ply", save=True,
        )  # fmt: skip

    blend, name = tmp_path / "blend" / "scene.blend", obj.data.name
    blend.parent.mkdir()
    with pytest.raises(addon.core.RefineError, match="not saved in a"):
        pruned(tmp_path)
    bpy.ops.wm.save_as_mainfile(filepath=str(blend))
    saved, before = blend.read_bytes(), bits(obj)
    with pytest.raises(addon.core.RefineError, match="no folder"):
        pruned(tmp_path / "missing")
    assert bits(obj) == before
    assert blend.read_bytes() == saved

    shutil.rmtree(blend.parent)
    with pytest.raises(addon.core.RefineError, match=r"nothing was removed, .*out\.ply was "):
        pruned(tmp_path)
    assert bits(obj) == before
    kept = len(obj.data.vertices) * 2 // 5 + 1
    assert len(addon.core.read_ply(tmp_path / "out.ply")) == kept

    blend.parent.mkdir()
    (tmp_path / "out.ply").unlink()
    assert pruned(tmp_path)["splats"]["kept"] == kept
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    assert [(mesh.name, len(mesh.vertices)) for mesh in bpy.data.meshes] == [(name, kept)]


@pytest.fixture
def noted(addon, monkeypatch):
    """Return weak references to all splats that are gathered and all that comes of them."""
    references = []

    def note(module, name):
        call = getattr(module, name)

        def noting(*arguments, **options):
            found = call(*arguments, **options)
            references.append(weakref.ref(found))
            return found

        monkeypatch.setattr(module, name, noting)

    note(addon.objects.splat_group, "gather")
    note(addon.ui.operators, "score")
    note(importlib.import_module(f"{addon.__name__}.core.prune"), "merge_down")
    return references


ENDS = {
    "score": ("at once", "done", "escape", "writing fails"),
    "apply": ("at once", "done", "cancelled", "work fails", "writing fails"),
}


@pytest.mark.parametrize(("name", "how"), [(name, how) for name in ENDS for how in ENDS[name]])
def test_an_operation_keeps_nothing_when_it_is_over(addon, obj, noted, monkeypatch, name, how):
    """Done or not, on the thread or at once, when Blender's history keeps the operator."""
    operators, said = addon.ui.operators, []
    bpy.ops.refine.score()
    noted.clear()
    count = len(obj.data.vertices)

    def refuse(*_arguments, progress=None, **_options):
        while how in ("escape", "cancelled") and progress(0.5, "waiting") is not False:
            time.sleep(0.01)
        raise addon.core.RefineError("failed") if "fail" in how else addon.core.Cancelled

    if how == "writing fails":
        monkeypatch.setattr(addon.mesh.scores, "store", refuse)
        monkeypatch.setattr(addon.objects.splat_group, "apply", refuse)
    elif how in ("escape", "cancelled", "work fails"):
        monkeypatch.setattr(operators, {"score": "score", "apply": "prune"}[name], refuse)
    if how == "at once":
        getattr(bpy.ops.refine, name)("EXEC_DEFAULT", True)  # with undo, as a click
        assert bpy.context.window_manager.operators[-1].bl_idname == f"REFINE_OT_{name}"
    else:
        cls = getattr(operators, f"REFINE_OT_{name}")
        operator, context, said = started_in_a_window(addon, cls)
        assert addon.ui.operator_bases.now().operator == f"refine.{name}"
    if how == "escape":
        operator.modal(context, event("ESC"))
    if how == "cancelled":
        operator.cancel(context)
        for thread in threading.enumerate():
            if thread.name == "refine":
                thread.join()
    elif how != "at once":
        answer = until(operator, context)
        assert answer == ({"FINISHED"} if how == "done" else {"CANCELLED"})

    gc.collect()
    assert noted
    assert [reference for reference in noted if reference() is not None] == []
    assert addon.ui.operator_bases.now() is None
    assert [text for text in said if "failed" in text] == ["failed"] * ("fail" in how)
    assert ("nothing was changed" in "".join(said)) == (how == "escape")
    went = name == "apply" and how in ("at once", "done")
    assert len(obj.data.vertices) == (count * 2 // 5 + 1 if went else count)
