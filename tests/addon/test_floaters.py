"""Floaters in the panel: what is found is what core finds, switches choose, the button deletes."""

from __future__ import annotations

import json

import bpy
import numpy as np
import pytest

from tests.e2e.inside.clouds import as_cloud

MOVED = 60


@pytest.fixture
def polluted(addon, quarter, room_cameras, room_views):
    """Move opaque splats before the cameras, alone, at an eighth of the way to the middle."""
    mesh, random = quarter.data, np.random.default_rng(5)
    count = len(mesh.vertices)
    opacities = addon.mesh.attributes.read_attribute(mesh, "opacity")
    moved = random.choice(np.flatnonzero(opacities > 2.0), MOVED, replace=False)
    means = np.empty(count * 3, np.float32)
    mesh.vertices.foreach_get("co", means)
    means = means.reshape(-1, 3)
    middle = np.median(means, axis=0)
    cameras = [view.center for view in room_views.views][:MOVED]
    means[moved] = [center + (middle - center) / 8 for center in cameras]
    mesh.vertices.foreach_set("co", means.ravel())
    mesh.update()
    bpy.context.scene.refine.views = 24
    return quarter, moved


def marked(addon, room):
    """Return which splats the preview would hide."""
    return addon.mesh.attributes.read_attribute(room.data, addon.mesh.edit.REMOVE)


def test_floaters_found_in_the_panel_are_those_that_core_finds(addon, polluted):
    """The same splats and views: the same verdict, marked and counted by reason; none deleted."""
    room, moved = polluted
    splats = addon.objects.splat_group.gather([addon.mesh.layout.check(room)])
    count = len(splats)
    expected = addon.core.clean(
        splats, addon.ui.operators.chosen_views(bpy.context), addon.core.Cleaning(views=24)
    )

    bpy.ops.refine.find_floaters()

    assert (~expected.keep)[moved].mean() > 0.8
    np.testing.assert_array_equal(marked(addon, room), ~expected.keep)
    found = addon.mesh.scores.floater_counts(room.data)
    assert {name: found[name] for name in expected.settings.reasons} == expected.counts()
    assert len(room.data.vertices) == count


def test_floaters_of_native_splats_are_those_of_the_mesh(addon, polluted):
    """Activated values differ in the last bits of single precision: the verdicts are the same."""
    room, moved = polluted
    bpy.ops.refine.find_floaters()
    on_mesh = marked(addon, room)

    cloud = as_cloud(addon, room)
    bpy.ops.refine.find_floaters()
    on_cloud = marked(addon, cloud)

    assert cloud.type == "POINTCLOUD"
    assert on_mesh[moved].any()
    assert np.count_nonzero(on_mesh != on_cloud) <= 2
    bpy.ops.refine.delete(what="FLOATERS")
    assert addon.mesh.layout.splat_count(cloud.data) == np.count_nonzero(~on_cloud)


def test_marks_follow_the_strength(addon, polluted):
    """Nothing is looked for again: each strength goes for reasons of its own."""
    room, _ = polluted
    bpy.ops.refine.find_floaters()
    found, counts = addon.mesh.scores.floater_counts(room.data), {}
    for strength in ("CAREFUL", "USUAL", "STRONG"):
        bpy.context.scene.refine.strength = strength
        counts[strength] = np.count_nonzero(marked(addon, room))

    assert counts["CAREFUL"] == found["front"] + found["isolated"] > 0
    assert counts["USUAL"] == counts["CAREFUL"] + found["giant"] + found["needle"]
    assert counts["STRONG"] == counts["USUAL"] + found["transparent"] + found["haze"]


def test_deleting_floaters_takes_those_and_asks_for_new_scores(addon, polluted):
    """Scores are of all splats together, floaters included: without these they do not hold."""
    room, _ = polluted
    bpy.ops.refine.score()
    bpy.ops.refine.find_floaters()
    goes = marked(addon, room)
    opacities = addon.mesh.attributes.read_attribute(room.data, "opacity")

    assert bpy.ops.refine.delete(what="FLOATERS") == {"FINISHED"}

    left = addon.mesh.attributes.read_attribute(room.data, "opacity")
    np.testing.assert_array_equal(left, opacities[~goes])
    assert addon.mesh.scores.record(room.data) is None
    assert addon.mesh.scores.floater_counts(room.data) is None
    with pytest.raises(RuntimeError, match="look for floaters first"):
        bpy.ops.refine.delete(what="FLOATERS")


def test_protected_splats_are_no_floaters(addon, polluted):
    """A vertex group holds all that was moved: nothing of it is found."""
    room, moved = polluted
    group = room.vertex_groups.new(name="mine")
    group.add(moved.tolist(), 1.0, "REPLACE")
    bpy.context.scene.refine.protect = "mine"

    bpy.ops.refine.find_floaters()

    assert not marked(addon, room)[moved].any()


def test_floaters_that_were_protected_after_the_search_stay(addon, polluted):
    """Half of what was found is marked to stay: the other half goes, and nothing else."""
    room, _ = polluted
    bpy.ops.refine.find_floaters()
    goes = marked(addon, room)
    spared = goes & (np.cumsum(goes) % 2 == 0)
    opacities = addon.mesh.attributes.read_attribute(room.data, "opacity")
    addon.mesh.edit.mark_by_hand(room, spared)

    assert bpy.ops.refine.delete(what="FLOATERS") == {"FINISHED"}

    left = addon.mesh.attributes.read_attribute(room.data, "opacity")
    assert spared.sum() > 10
    np.testing.assert_array_equal(left, opacities[~goes | spared])


def test_with_no_floaters_to_delete_scores_and_findings_stay(addon, polluted):
    """All that was found is protected by now, so nothing is touched."""
    room, _ = polluted
    bpy.ops.refine.score()
    bpy.ops.refine.find_floaters()
    addon.mesh.edit.mark_by_hand(room, marked(addon, room))

    with pytest.raises(RuntimeError, match="no splat floats that need not stay"):
        bpy.ops.refine.delete(what="FLOATERS")

    assert len(room.data.vertices) == 9_939
    assert addon.mesh.scores.record(room.data) is not None
    assert addon.mesh.scores.floater_counts(room.data) is not None


def test_what_was_found_is_of_no_use_once_splats_were_added(addon, polluted):
    """The note says of how many splats it is; one more, and it is to be looked for again."""
    room, _ = polluted
    bpy.ops.refine.find_floaters()
    room.data.vertices.add(1)

    assert addon.mesh.scores.floater_counts(room.data) is None
    with pytest.raises(addon.core.RefineError, match="look for floaters first"):
        addon.mesh.scores.floater_mask(addon.mesh.layout.check(room), ("front",))


@pytest.mark.parametrize("text", ["", "{", "[]", json.dumps({"splats": 39755})])
def test_a_damaged_note_counts_as_none(addon, room, text):
    """A .blend may come from anywhere."""
    room.data[addon.mesh.scores.FOUND] = text

    assert addon.mesh.scores.floater_counts(room.data) is None
