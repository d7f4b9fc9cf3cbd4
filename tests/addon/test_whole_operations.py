"""Operations are done whole or not at all, check their object once, and keep nothing when over."""

from __future__ import annotations

import gc
import importlib
import shutil
import threading
import time
import weakref

import bpy
import numpy as np
import pytest

from tests.windows import event, started_in_a_window, until_over


@pytest.fixture
def few(addon, room, room_cameras):
    """Every tenth splat of the room, to be merged to two fifths by four views."""
    addon.mesh.edit.delete_vertices(room, np.arange(len(room.data.vertices)) % 10 != 0)
    settings = bpy.context.scene.refine
    settings.method, settings.ratio, settings.views = "merge", 0.6, 4
    return room


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


@pytest.fixture
def fail_at(addon, monkeypatch):
    """Return a function that makes a stage of reducing a mesh fail, after it is checked."""

    def fail_at(stage):
        edit, attributes = addon.mesh.edit, addon.mesh.attributes
        delete = edit.delete_vertices

        def refuse(*_arguments):
            raise addon.core.RefineError("refused")

        def delete_and_refuse(*arguments):
            delete(*arguments)
            refuse()

        if stage == "writing":
            monkeypatch.setattr(attributes, "write_columns", refuse)
        else:
            change = refuse if stage == "deleting" else delete_and_refuse
            monkeypatch.setattr(edit, "delete_vertices", change)

    return fail_at


@pytest.mark.parametrize("stage", ["deleting", "after deleting", "writing"])
def test_an_apply_that_fails_leaves_the_mesh_as_it_was(few, fail_at, stage):
    """With Merge, wherever it fails: attributes, groups, plan and scores are equal to the bit."""
    few.vertex_groups.new(name="some").add(range(0, 3000, 7), 0.5, "REPLACE")
    few.data.use_fake_user = True
    bpy.ops.refine.score()
    before = bits(few)
    fail_at(stage)

    with pytest.raises(RuntimeError, match="refused"):
        bpy.ops.refine.apply()

    assert bits(few) == before
    assert few.data.use_fake_user
    assert [mesh.name for mesh in bpy.data.meshes] == [few.data.name]
    assert bpy.ops.refine.apply.poll()


def pruned(addon, room_views, tmp_path, method="merge"):
    """Prune the object as the command does, to a file and in the .blend."""
    return addon.objects.splat_group.prune_object(
        "room",
        room_views,
        addon.core.Budget(ratio=0.6),
        addon.core.METHODS[method](4),
        output=tmp_path / "out.ply",
        save=True,
    )


@pytest.mark.parametrize("method", ["occlusion", "merge"])
def test_a_blend_that_cannot_be_saved_keeps_its_splats(addon, few, room_views, tmp_path, method):
    """Its folder is gone: what was exported stays and is named, the object is as it was."""
    (tmp_path / "blend").mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "blend" / "scene.blend"))
    shutil.rmtree(tmp_path / "blend")
    before = bits(few)

    with pytest.raises(
        addon.core.RefineError, match=r"nothing was removed, .*out\.ply was written"
    ):
        pruned(addon, room_views, tmp_path, method)

    assert bits(few) == before
    assert len(addon.core.read_ply(tmp_path / "out.ply")) == len(few.data.vertices) * 2 // 5 + 1


def test_a_file_that_cannot_be_written_leaves_the_blend_alone(addon, few, room_views, tmp_path):
    """Exporting comes first: what is not written is not deleted."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    saved, before = (tmp_path / "scene.blend").read_bytes(), bits(few)

    with pytest.raises(addon.core.RefineError, match="no folder"):
        pruned(addon, room_views, tmp_path / "missing")

    assert bits(few) == before
    assert (tmp_path / "scene.blend").read_bytes() == saved


def test_what_stood_by_is_not_saved(addon, few, room_views, tmp_path):
    """The .blend holds one mesh, of the same name, with what is left of it."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    name = few.data.name
    report = pruned(addon, room_views, tmp_path)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))

    assert [mesh.name for mesh in bpy.data.meshes] == [name]
    assert len(bpy.data.meshes[name].vertices) == report["splats"]["kept"]


@pytest.mark.usefixtures("few")
def test_each_operation_reads_the_layout_of_its_object_once(
    addon, room_views, tmp_path, monkeypatch
):
    """Scoring and applying are two operations, as the plan follows; the object is handed on."""
    remembered, counts = addon.mesh.layout._remembered, []

    def counted(mesh):
        counts[-1] += 1
        return remembered(mesh)

    monkeypatch.setattr(addon.mesh.layout, "_remembered", counted)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    for operation in (
        bpy.ops.refine.score,
        lambda: addon.ui.plans.refresh(bpy.context),
        lambda: bpy.ops.refine.export_ply(filepath=str(tmp_path / "exported.ply")),
        bpy.ops.refine.apply,
        lambda: pruned(addon, room_views, tmp_path),
    ):
        counts.append(0)
        operation()

    assert counts == [2, 1, 1, 2, 1]


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


def left(references):
    """Return what of it still lives."""
    gc.collect()
    return [found for found in (reference() for reference in references) if found is not None]


@pytest.mark.parametrize("name", ["score", "apply"])
def test_the_history_of_operators_holds_no_splats(few, noted, name):
    """Blender keeps the operator that ran."""
    bpy.ops.refine.score()
    noted.clear()
    getattr(bpy.ops.refine, name)("EXEC_DEFAULT", True)  # with undo, as a click
    history = [operator.bl_idname for operator in bpy.context.window_manager.operators]

    assert history[-1] == f"REFINE_OT_{name}"
    assert len(noted) == 2
    assert left(noted) == []


@pytest.fixture
def started(addon, few):
    """Return a function that starts an operator as a click in a window does."""
    return lambda name: started_in_a_window(addon, getattr(addon.ui.operators, f"REFINE_OT_{name}"))


@pytest.fixture
def work(addon, monkeypatch):
    """Return a function that has an operator's work wait until it is cancelled, or fail."""

    def work(name, how):
        def instead(*_arguments, progress, **_options):
            while how == "wait" and progress(0.5, "waiting") is not False:
                time.sleep(0.01)
            raise addon.core.Cancelled if how == "wait" else addon.core.RefineError("failed")

        function = {"score": "score", "apply": "prune"}[name]
        monkeypatch.setattr(addon.ui.operators, function, instead)

    return work


@pytest.mark.parametrize("name", ["score", "apply"])
@pytest.mark.parametrize("how", ["done", "escape", "work fails", "writing fails", "cancelled"])
def test_an_operation_in_a_window_is_dropped_when_it_is_over(
    addon, few, noted, started, work, monkeypatch, name, how
):
    """Done, cancelled by Esc or by Blender, failed on the thread or after: nothing lives on."""
    bpy.ops.refine.score()
    noted.clear()
    count = len(few.data.vertices)
    if how in ("escape", "cancelled", "work fails"):
        work(name, "fail" if how == "work fails" else "wait")
    if how == "writing fails":

        def refuse(*_arguments, **_options):
            raise addon.core.RefineError("failed")

        monkeypatch.setattr(addon.mesh.scores, "store", refuse)
        monkeypatch.setattr(addon.objects.splat_group, "apply", refuse)
    operator, context, said = started(name)
    assert addon.ui.operator_bases.now().operator == f"refine.{name}"
    if how == "escape":
        operator.modal(context, event("ESC"))
    if how == "cancelled":
        operator.cancel(context)
        for thread in threading.enumerate():
            if thread.name == "refine":
                thread.join()
    else:
        answer = until_over(operator, context)
        assert answer == ({"FINISHED"} if how == "done" else {"CANCELLED"})

    assert noted
    assert left(noted) == []
    assert addon.ui.operator_bases.now() is None
    assert [text for text in said if "failed" in text] == ["failed"] * ("fail" in how)
    assert ("nothing was changed" in "".join(said)) == (how == "escape")
    assert len(few.data.vertices) == (
        count * 2 // 5 + 1 if (name, how) == ("apply", "done") else count
    )
