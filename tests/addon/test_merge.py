"""Merging and refitting through the panel and the command's objects: the splats of core."""

import time
from dataclasses import replace

import bpy
import numpy as np
import pytest

from tests.windows import event, started_in_a_window, until

from .conftest import read, splats_of


@pytest.fixture
def obj(few):
    """Every tenth splat of the room, to be merged to two fifths."""
    settings = bpy.context.scene.refine
    settings.method, settings.ratio, settings.views = "merge", 0.6, 4
    return few


def in_core(addon, obj, views, method="merge"):
    asked = addon.core.Budget(ratio=0.6), addon.core.METHODS[method](4)
    return addon.core.prune(splats_of(addon, obj), views, *asked)


@pytest.mark.parametrize("method", ["merge", "refit"])
def test_panel_and_command_leave_what_core_says(addon, obj, room_views, capfd, tmp_path, method):
    """Kept splats, changed or not, equal to the last bit; the command leaves the object alone.
    The sentences are those of the report: of refitting its own, and into how many others."""
    bpy.context.scene.refine.method, out = method, tmp_path / "out.ply"
    expected, core = in_core(addon, obj, room_views, method), addon.core
    told = addon.objects.splat_group.prune_object(
        obj.name, room_views, core.Budget(ratio=0.6), core.METHODS[method](4), output=out
    )
    written, count = core.read_ply(out).splats(), len(obj.data.vertices)
    bpy.ops.refine.score()
    bpy.ops.refine.apply()

    stored = addon.mesh.attributes.splats_from_object(addon.mesh.layout.check(obj))
    for name in ("means", "log_scales", "quaternions", "opacity_logits", "sh_dc", "sh_rest"):
        wanted = getattr(expected.merged.splats, name).astype(np.float32)
        np.testing.assert_array_equal(getattr(stored, name), wanted)
        np.testing.assert_array_equal(getattr(written, name), wanted)
    assert expected.merged.changed.sum() > 100
    assert told["merged"] == expected.report["merged"]
    assert ("refitted" in told) == (method == "refit")
    assert count == 3976
    said = capfd.readouterr().out
    assert f" splats were merged into {told['merged']['changed']:,} others; " in said
    assert ("were refitted in" in said) == (method == "refit")


@pytest.mark.parametrize(("scale", "done"), [(1.0, "merge"), (2.0, "occlusion")])
def test_splats_are_merged_unless_the_scale_is_uneven(addon, obj, room_views, scale, done):
    """Colours cannot follow a stretch: rows stay then, and refitting, if asked for, is refused."""
    obj.scale = (1.0, scale, 1.0)
    bpy.context.view_layer.update()
    settings, prune = bpy.context.scene.refine, addon.objects.splat_group.prune_object
    report = prune(obj.name, room_views, addon.core.Budget(ratio=0.6), dry_run=True)
    bpy.ops.refine.score()
    if scale != 1.0:
        settings.method = "refit"
        with pytest.raises(RuntimeError, match=r"object 'room': .* scales directions differently"):
            bpy.ops.refine.apply()
        assert len(obj.data.vertices) == 3976
        settings.method = "merge"
    bpy.ops.refine.apply()

    assert report["method"]["done"] == done
    assert len(obj.data.vertices) == 3976 - 3976 * 6 // 10


def test_nothing_is_saved_over_where_refitting_was_stopped(
    addon, obj, room_views, tmp_path, monkeypatch
):
    """A .blend is not taken back by Ctrl+Z: object and file stay, and no file is written either."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    before = (tmp_path / "scene.blend").read_bytes()
    core, prune, out = addon.core, addon.core.prune, tmp_path / "out.ply"

    def stopped(*arguments, **options):
        return replace(prune(*arguments, **options), stopped=core.Cancelled())

    monkeypatch.setattr(core.operations, "prune", stopped)
    asked = obj.name, room_views, core.Budget(ratio=0.6), core.ClosedForm()
    with pytest.raises(core.Cancelled):
        addon.objects.splat_group.prune_object(*asked, output=out, save=True)

    assert not out.exists()
    assert (tmp_path / "scene.blend").read_bytes() == before
    assert len(obj.data.vertices) == 3976
    with pytest.raises(core.Cancelled):
        addon.objects.splat_group.prune_object(*asked, output=out)
    assert out.exists()


@pytest.mark.parametrize("rounds", [0, 1])
def test_esc_while_refitting_keeps_what_that_has_reached(addon, obj, monkeypatch, rounds):
    """Merged, or refitted in a round: as many splats as asked for, and the sentence says which.
    The bar says so beforehand, and waits for it; what ends the work is told by core, at once."""
    monkeypatch.setattr(addon.ui.operator_bases, "PATIENCE", 0.0)
    bpy.context.scene.refine.method = "refit"
    bpy.ops.refine.score()
    done, measured = [], addon.core.refit.round_rays.RoundRays.psnr

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

    assert first == "cancels"
    assert sentence == "Pruning splats (refitting); Esc keeps the result so far"
    assert until(operator, context) == {"FINISHED"}
    assert len(obj.data.vertices) == 3976 - int(0.6 * 3976)
    words = "after round 1" if rounds else "before its first round was done"
    assert f"refitting was stopped {words}" in said
    assert any("were refitted in" in text for text in said) == (rounds > 0)


def test_an_object_moved_while_apply_works_keeps_its_splats_together(addon, obj, room_views):
    """The data is what it is without the move: splats are in the frame of their object.
    In edit mode nothing can be written; whoever presses Esc there gets nothing."""
    expected = in_core(addon, obj, room_views).merged.splats.means
    bpy.ops.refine.score()
    operator, context, said = started_in_a_window(addon, addon.ui.operators.REFINE_OT_apply)
    bpy.ops.object.mode_set(mode="EDIT")
    until(operator, context, lambda: addon.ui.operator_bases.now().waits)
    operator.modal(context, event("ESC"))
    assert until(operator, context) == {"CANCELLED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    assert said == ["Pruning splats cancelled; nothing was changed"]
    assert len(obj.data.vertices) == 3976

    operator, context, _ = started_in_a_window(addon, addon.ui.operators.REFINE_OT_apply)
    obj.location.x += 1.0
    assert until(operator, context) == {"FINISHED"}
    np.testing.assert_array_equal(read(addon, obj, "position"), expected.astype(np.float32))
