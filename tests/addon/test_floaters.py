"""Floaters in the panel: what is found is what core finds, switches choose, the button deletes."""

import bpy
import numpy as np
import pytest

from .conftest import read, splats_of


@pytest.fixture
def polluted(addon, few, room_views):
    """Move 40 opaque splats before the cameras, alone, at an eighth of the way to the middle."""
    opaque = np.flatnonzero(read(addon, few, "opacity") > 2.0)
    moved = np.random.default_rng(5).choice(opaque, 40, replace=False)
    means = read(addon, few, "position").copy()
    centers = np.array([view.center for view in room_views.views][:40])
    means[moved] = centers + (np.median(means, axis=0) - centers) / 8
    addon.mesh.attributes.write_attribute(few.data, "position", "FLOAT_VECTOR", means)
    few.data.update()
    bpy.context.scene.refine.views = 24
    return few, moved


def test_floaters_found_in_the_panel_are_those_that_core_finds(addon, polluted):
    """The same verdict, marked and counted by reason; none deleted, and none for a group to keep.
    Nothing is looked for again where the strength changes: each goes for reasons of its own."""
    obj, moved = polluted
    settings, views = bpy.context.scene.refine, addon.ui.operators.chosen_views(bpy.context)
    expected = addon.core.clean(splats_of(addon, obj), views, addon.core.Cleaning(views=24))
    bpy.ops.refine.find_floaters()
    assert (~expected.keep)[moved].mean() > 0.8
    np.testing.assert_array_equal(read(addon, obj, "refine_remove"), ~expected.keep)
    found, counts = {k: n for k, (n, _) in addon.mesh.scores.floaters(obj.data).items()}, {}
    assert {name: found[name] for name in expected.settings.reasons} == expected.counts()
    assert len(obj.data.vertices) == 3976
    for strength in ("CAREFUL", "USUAL", "STRONG"):
        settings.strength = strength
        counts[strength] = np.count_nonzero(read(addon, obj, "refine_remove"))
    assert counts["CAREFUL"] == found["front"] + found["isolated"] > 0
    assert counts["USUAL"] == counts["CAREFUL"] + found["giant"] + found["needle"]
    assert counts["STRONG"] == counts["USUAL"] + found["transparent"] + found["haze"]

    obj.vertex_groups.new(name="mine").add(moved.tolist(), 1.0, "REPLACE")
    settings.protect = "mine"
    bpy.ops.refine.find_floaters()
    assert not read(addon, obj, "refine_remove")[moved].any()
    scores = addon.mesh.scores
    obj.data.vertices.add(1)  # the note says of how many splats it is; a damaged one counts as none
    assert scores.floaters(obj.data) is None
    obj.data[scores.FLOATERS] = '{"splats": 3977}'
    assert scores.floaters(obj.data) is None


def test_what_goes_is_what_floats_or_must_go_and_with_scores_what_the_budget_removes(
    addon, polluted
):
    """Ten splats that do not float are marked to go; neither search nor strength changes a plan."""
    obj, _ = polluted
    bpy.ops.refine.find_floaters()
    floating = read(addon, obj, "refine_remove")
    marked = ~floating & (np.cumsum(~floating) <= 10)
    addon.mesh.selection.select(obj, marked)
    bpy.ops.refine.protect(mark="GO")
    np.testing.assert_array_equal(read(addon, obj, "refine_remove"), floating | marked)

    bpy.ops.refine.score()
    goes = read(addon, obj, "refine_remove")
    assert goes.sum() == 1988
    bpy.ops.refine.find_floaters()
    bpy.context.scene.refine.strength = "STRONG"
    np.testing.assert_array_equal(read(addon, obj, "refine_remove"), goes)


def test_deleting_floaters_takes_those_and_asks_for_new_scores(addon, polluted):
    """But for those that were marked to stay since; where all are, scores and findings stay.
    Scores are of all splats together, floaters included: without these they do not hold."""
    obj, _ = polluted
    scores, delete = addon.mesh.scores, bpy.ops.refine.delete
    bpy.ops.refine.score()
    bpy.ops.refine.find_floaters()
    goes = scores.floater_mask(addon.mesh.layout.check(obj), bpy.context.scene.refine.to_reasons())
    opacities = read(addon, obj, "opacity")
    addon.mesh.edit.mark(obj, addon.mesh.edit.PROTECT, goes)
    with pytest.raises(RuntimeError, match="no splat floats, or all of these must stay"):
        delete(what="FLOATERS")
    assert len(obj.data.vertices) == 3976
    assert scores.record(obj.data) is not None
    assert scores.floaters(obj.data) is not None

    spared = goes & (np.cumsum(goes) % 2 == 0)
    assert spared.sum() > 10
    addon.mesh.edit.mark(obj, addon.mesh.edit.PROTECT, spared)
    assert delete(what="FLOATERS") == {"FINISHED"}
    np.testing.assert_array_equal(read(addon, obj, "opacity"), opacities[~goes | spared])
    assert scores.record(obj.data) is None
    assert scores.floaters(obj.data) is None
    with pytest.raises(RuntimeError, match="find floaters first"):
        delete(what="FLOATERS")
