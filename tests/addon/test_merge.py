"""Merging and refitting through the panel and the command's objects: the splats of core."""

from __future__ import annotations

import time
from dataclasses import replace

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix

from tests.windows import event, started_in_a_window, until, until_over


@pytest.fixture
def few(addon, room, room_cameras):
    """Every tenth splat of the room, to be merged to two fifths."""
    core = addon.core
    remove = np.arange(len(room.data.vertices)) % 10 != 0
    addon.mesh.edit.delete_vertices(room, remove)
    settings = bpy.context.scene.refine
    settings.method, settings.ratio = "merge", 0.6
    return room, core.Budget(ratio=0.6)


BOTH = pytest.mark.parametrize("method", ["merge", "refit"])


def merged_in_core(addon, obj, views, budget, method="merge"):
    return addon.core.prune(
        addon.objects.splat_group.gather([addon.mesh.layout.check(obj)], whole=True),
        views,
        budget,
        addon.core.METHODS[method](),
    )


@BOTH
def test_apply_leaves_what_core_says(addon, few, room_views, method):
    """Kept splats, changed or not, equal to the last bit: the object stands where its data is."""
    room, budget = few
    bpy.context.scene.refine.method = method
    expected = merged_in_core(addon, room, room_views, budget, method).merged
    bpy.ops.refine.score()
    bpy.ops.refine.apply()

    splats = addon.mesh.attributes.splats_from_object(addon.mesh.layout.check(room))

    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest"):
        wanted = getattr(expected.splats, name).astype(np.float32)
        np.testing.assert_array_equal(getattr(splats, name), wanted)
    assert expected.changed.sum() > 100


@BOTH
def test_apply_says_what_became_of_the_splats(addon, few, room_views, capfd, method):
    """The sentences of the report: of refitting its own, and into how many others were merged."""
    room, budget = few
    bpy.context.scene.refine.method = method
    report = merged_in_core(addon, room, room_views, budget, method).report
    bpy.ops.refine.score()
    bpy.ops.refine.apply()

    told = capfd.readouterr().out
    assert f" splats were merged into {report['merged']['changed']:,} others; " in told
    assert ("were refitted in" in told) == (method == "refit")


def test_a_moved_object_is_merged_in_its_own_frame(addon, few, room_views):
    """Object and cameras moved together: the data changes as if neither had been."""
    room, budget = few
    still = merged_in_core(addon, room, room_views, budget).merged
    move = Matrix.Translation((1, 2, 3)) @ Euler((0.3, 0.2, 0.1)).to_matrix().to_4x4()
    for obj in (room, *(o for o in bpy.data.objects if o.type == "CAMERA")):
        obj.matrix_world = move @ obj.matrix_world
    bpy.context.view_layer.update()
    bpy.ops.refine.score()
    bpy.ops.refine.apply()

    splats = addon.mesh.attributes.splats_from_object(addon.mesh.layout.check(room))

    # float32 matrices move a few merges across; most kept splats are the same ones.
    here = {tuple(row) for row in np.round(splats.means, 3)}
    there = {tuple(row) for row in np.round(still.splats.means.astype(np.float32), 3)}
    assert len(splats) == len(still.splats)
    assert len(here & there) / len(there) > 0.95


def test_uneven_scale_is_refused_and_nothing_changes(addon, few):
    """Colours cannot follow a stretch, and refitting writes colours."""
    room, _ = few
    bpy.context.scene.refine.method = "refit"
    bpy.ops.refine.score()
    room.scale = (1, 2, 1)
    bpy.context.view_layer.update()
    before = addon.mesh.attributes.read_attribute(room.data, "f_dc_0")

    with pytest.raises(RuntimeError, match=r"object 'room': .* scales directions differently"):
        bpy.ops.refine.apply()

    np.testing.assert_array_equal(addon.mesh.attributes.read_attribute(room.data, "f_dc_0"), before)
    room.scale = (1, 1, 1)


@BOTH
def test_the_command_on_an_object_writes_the_same_splats(addon, few, room_views, tmp_path, method):
    """Exported without touching the object."""
    room, budget = few
    expected = merged_in_core(addon, room, room_views, budget, method)
    count = len(room.data.vertices)
    out = tmp_path / "out.ply"

    report = addon.objects.splat_group.prune_object(
        room.name, room_views, budget, addon.core.METHODS[method](), output=out
    )

    written = addon.core.read_ply(out).splats()
    wanted = expected.merged.splats.means.astype(np.float32)
    np.testing.assert_array_equal(np.asarray(written.means), wanted)
    assert report["merged"] == expected.report["merged"]
    assert ("refitted" in report) == (method == "refit")
    assert len(room.data.vertices) == count


def test_saving_leaves_in_the_blend_what_apply_leaves(addon, few, room_views, tmp_path):
    """Splats as in core, their scores to look at, and none to apply once more."""
    room, budget = few
    expected = merged_in_core(addon, room, room_views, budget).merged
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))

    addon.objects.splat_group.prune_object(room.name, room_views, budget, save=True)
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))

    obj = bpy.data.objects["room"]
    means = addon.mesh.attributes.splats_from_object(addon.mesh.layout.check(obj)).means
    np.testing.assert_array_equal(means, expected.splats.means.astype(np.float32))
    assert "refine_score" in obj.data.attributes
    assert addon.mesh.scores.record(obj.data) is None


def test_nothing_is_saved_over_where_refitting_was_stopped(
    addon, few, room_views, tmp_path, monkeypatch
):
    """A .blend is not taken back by Ctrl+Z: object and file stay, and no file is written either."""
    room, budget = few
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    before, count = (tmp_path / "scene.blend").read_bytes(), len(room.data.vertices)
    prune, out = addon.core.prune, tmp_path / "out.ply"

    def stopped(*arguments, **options):
        return replace(prune(*arguments, **options), stopped=addon.core.Cancelled())

    monkeypatch.setattr(addon.core.operations, "prune", stopped)
    asked = room.name, room_views, budget, addon.core.ClosedForm()

    with pytest.raises(addon.core.Cancelled):
        addon.objects.splat_group.prune_object(*asked, output=out, save=True)

    assert not out.exists()
    assert (tmp_path / "scene.blend").read_bytes() == before
    assert len(room.data.vertices) == count
    with pytest.raises(addon.core.Cancelled):
        addon.objects.splat_group.prune_object(*asked, output=out)
    assert out.exists()


def test_protected_splats_neither_vanish_nor_change(addon, few):
    """A boolean attribute names every third."""
    room, _ = few
    marked = np.arange(len(room.data.vertices)) % 3 == 0
    addon.mesh.attributes.write_attribute(room.data, "mine", "BOOLEAN", marked)
    before = addon.mesh.attributes.read_attribute(room.data, "position")[marked]
    bpy.context.scene.refine.protect = "mine"
    bpy.ops.refine.score()
    bpy.ops.refine.apply()
    bpy.context.scene.refine.protect = ""

    after = addon.mesh.attributes.read_attribute(room.data, "position")
    still = addon.mesh.attributes.read_attribute(room.data, "mine")

    np.testing.assert_array_equal(after[still], before)


@pytest.mark.parametrize(("scale", "done"), [(1.0, "merge"), (2.0, "occlusion")])
def test_splats_are_merged_unless_the_scale_is_uneven(addon, few, room_views, scale, done):
    """The panel, as the command: colours cannot follow a stretch, so that rows stay then."""
    room, budget = few
    room.scale = (1.0, scale, 1.0)
    bpy.context.view_layer.update()

    report = addon.objects.splat_group.prune_object(room.name, room_views, budget, dry_run=True)
    bpy.ops.refine.score()
    before = len(room.data.vertices)
    bpy.ops.refine.apply()

    room.scale = (1.0, 1.0, 1.0)
    assert report["method"]["done"] == done
    assert len(room.data.vertices) == before - before * 6 // 10


@pytest.mark.parametrize("rounds", [0, 1])
def test_esc_while_refitting_keeps_what_that_has_reached(addon, few, monkeypatch, rounds):
    """Merged, or refitted in a round: as many splats as asked for, and the sentence says which.

    The bar says so beforehand; what ends the work is told by core, at once.
    """
    room, _ = few
    bpy.context.scene.refine.method = "refit"
    bpy.ops.refine.score()
    done, measured = [], addon.core.refit.round_rays.RoundRays.psnr
    count = len(room.data.vertices)

    def count_rounds(rays, *arguments):
        psnr = measured(rays, *arguments)
        done.append(psnr)
        while len(done) > rounds and not addon.ui.operator_bases.now().worker.cancelled:
            time.sleep(0.01)
        return psnr

    monkeypatch.setattr(addon.core.refit.round_rays.RoundRays, "psnr", count_rounds)
    operator, context, said = started_in_a_window(addon, addon.ui.operators.REFINE_OT_apply)
    first = addon.ui.operator_bases.now().at_escape
    until(operator, context, lambda: len(done) > rounds)
    sentence = addon.ui.operator_bases.now().sentence
    operator.modal(context, event("ESC"))
    answer = until_over(operator, context)

    assert first == "cancels"
    assert sentence == "Pruning splats (refitting); Esc keeps what that has reached"
    assert answer == {"FINISHED"}
    assert len(room.data.vertices) == count - int(0.6 * count)
    words = "after round 1" if rounds else "before its first round was done"
    assert f"refitting was stopped {words}" in said
    assert any("were refitted in" in text for text in said) == (rounds > 0)


def test_esc_while_the_result_of_refitting_waits_changes_nothing(addon, few):
    """In edit mode nothing can be written; whoever does not want to leave it gets nothing."""
    room, _ = few
    bpy.ops.refine.score()
    count = len(room.data.vertices)
    operator, context, said = started_in_a_window(addon, addon.ui.operators.REFINE_OT_apply)
    bpy.ops.object.mode_set(mode="EDIT")
    until(operator, context, lambda: addon.ui.operator_bases.now().waits)
    operator.modal(context, event("ESC"))
    answer = until_over(operator, context)
    bpy.ops.object.mode_set(mode="OBJECT")

    assert answer == {"CANCELLED"}
    assert said == ["Pruning splats cancelled; nothing was changed"]
    assert len(room.data.vertices) == count


def test_an_object_moved_while_apply_works_keeps_its_splats_together(addon, few, room_views):
    """The data is what it is without the move: splats are in the frame of their object."""
    room, budget = few
    expected = merged_in_core(addon, room, room_views, budget).merged.splats.means
    bpy.ops.refine.score()
    operator, context, _ = started_in_a_window(addon, addon.ui.operators.REFINE_OT_apply)
    room.location.x += 1.0
    answer = until_over(operator, context)

    means = addon.mesh.attributes.read_attribute(room.data, "position")
    assert answer == {"FINISHED"}
    np.testing.assert_array_equal(means, expected.astype(np.float32))
