"""Several selected splat objects: one scene to the cameras, one budget, one undo step."""

import bpy
import numpy as np
import pytest

from tests.e2e.inside.clouds import as_cloud

from .conftest import linked

COUNT, FIRST = 9_939, 5_000


@pytest.fixture
def halves(addon, quarter, room_cameras):
    """Return the room as two selected objects: its first 5,000 splats, and the rest."""
    rows = np.arange(COUNT)
    addon.mesh.attributes.write_attribute(quarter.data, "row", "INT", rows)
    other = linked("b", quarter.data.copy())
    for obj, name, gone in ((quarter, "a", rows >= FIRST), (other, "b", rows < FIRST)):
        obj.name = name
        addon.mesh.edit.delete_vertices(obj, gone)
        obj.select_set(True)
    bpy.context.view_layer.objects.active = other
    return [quarter, other]


def read(addon, objects, name):
    return np.concatenate([addon.mesh.attributes.read_attribute(o.data, name) for o in objects])


CASES = [("closed-form", False), ("closed-form", True), ("occlusion", False), ("merge", False)]


@pytest.mark.slow
@pytest.mark.parametrize(("method", "cloud"), CASES)
def test_both_halves_keep_what_the_whole_room_keeps(
    addon, halves, quarter_file, room_views, method, cloud
):
    """floor(.8 * 9939) = 7951 go by one order; activated values of Blender's own are rounded."""
    settings, group, core = bpy.context.scene.refine, addon.objects.splat_group, addon.core
    settings.method, settings.views, settings.ratio = method, 4, 0.8
    splats = core.read_ply(quarter_file).splats()
    budget, way = core.Budget(ratio=0.8), core.METHODS[method](4)
    expected = core.prune(splats, room_views, budget, way)
    if cloud:
        halves[1] = as_cloud(addon, halves[1])
        halves[0].select_set(True)

    assert bpy.ops.refine.score() == {"FINISHED"}
    plan = addon.ui.plans.stored(halves[1], settings)
    assert (plan["before"], plan["kept"]) == (COUNT, COUNT - 7_951)
    members = group.members(halves[1])
    together = addon.mesh.scores.stored_scores(members)
    assert (together.quality is None) == (method == "closed-form")
    assert all(addon.mesh.scores.stored_scores([one]).quality is None for one in members)
    assert bpy.ops.refine.apply() == {"FINISHED"}

    apart = np.setxor1d(read(addon, halves, "row"), np.flatnonzero(expected.keep))
    assert len(apart) <= (2 if cloud else 0)
    if not cloud:
        left = group.gather([addon.mesh.layout.check(obj) for obj in halves], whole=True)
        np.testing.assert_allclose(left.means, expected.splats.means, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(left.sh_rest, expected.splats.sh_rest, rtol=1e-5, atol=1e-5)


def test_marks_and_sentence_are_those_of_the_selection(addon, halves):
    """Together 4,969 of 9,939 are marked; of the second alone floor(4,939 / 2) = 2,469."""
    settings, plans = bpy.context.scene.refine, addon.ui.plans
    bpy.ops.refine.score()
    assert read(addon, halves, "refine_remove").sum() == 4_969
    assert "of 9,939" in plans.sentence(plans.stored(halves[1], settings))

    halves[0].select_set(False)
    assert plans.stored(halves[1], settings) is None  # of both, not of this one
    plans.refresh(bpy.context)
    assert read(addon, halves[1:], "refine_remove").sum() == 2_469
    assert "of 4,939" in plans.sentence(plans.stored(halves[1], settings))
    halves[0].select_set(True)
    halves[1].select_set(False)
    assert addon.objects.splat_group.chosen(halves[1]) == [halves[1]]


def test_objects_that_cannot_be_scored_together_are_named(halves):
    """The one that is not the active one, scaled to nothing; two that share their data."""
    halves[0].scale.x = 0.0
    with pytest.raises(RuntimeError, match="object 'a': the transform is flat"):
        bpy.ops.refine.score()
    halves[0].scale.x = 1.0
    linked("twin", halves[0].data).select_set(True)
    with pytest.raises(RuntimeError, match="objects 'a' and 'twin' share their data"):
        bpy.ops.refine.score()


def test_where_one_cannot_be_changed_none_is(addon, halves, unchanged, monkeypatch):
    """Shape keys hold every vertex again; Blender fails at the second one."""
    delete, calls = addon.mesh.edit.delete_vertices, []

    def fails_once(obj, remove):
        calls.append(obj.name)
        if len(calls) == 2:
            raise addon.core.RefineError("no second time")
        delete(obj, remove)

    bpy.ops.refine.score()
    monkeypatch.setattr(addon.mesh.edit, "delete_vertices", fails_once)
    for words in ("no second time", "object 'b': has shape keys"):
        unchanged.start()
        with pytest.raises(RuntimeError, match=words):
            bpy.ops.refine.apply()
        assert calls == ["a", "b"]
        unchanged()
        halves[1].shape_key_add(name="key")


def test_scores_of_each_and_an_object_that_would_be_empty_are_refused(halves, unchanged):
    """Scores of each are two orders; far above all cameras 5,000 splats are the lowest half."""
    halves[0].location.z = -30.0
    bpy.context.scene.refine.ratio = 0.6
    bpy.ops.refine.score()
    unchanged.start()
    with pytest.raises(RuntimeError, match="no splat of object 'a' would be left"):
        bpy.ops.refine.apply()
    unchanged()

    halves[0].location.z = 0.0
    for obj, other in (halves, halves[::-1]):
        obj.select_set(True)
        other.select_set(False)
        bpy.context.view_layer.objects.active = obj
        bpy.ops.refine.score()
    halves[0].select_set(True)
    unchanged.start()
    with pytest.raises(RuntimeError, match="the 2 selected objects were not scored together"):
        bpy.ops.refine.apply()
    unchanged()


def test_a_group_that_one_object_has_protects_there(halves):
    """All of the first object is protected: its 5,000 stay, and 40 % of both go of the other."""
    halves[0].vertex_groups.new(name="keep").add(range(FIRST), 1.0, "REPLACE")
    settings = bpy.context.scene.refine
    bpy.ops.refine.score()
    settings.protect, settings.ratio = "keep", 0.4
    bpy.ops.refine.apply()
    assert [len(obj.data.vertices) for obj in halves] == [FIRST, COUNT - FIRST - 3_975]
    settings.protect = "none"
    with pytest.raises(RuntimeError, match="nothing to protect is named 'none'"):
        bpy.ops.refine.score()
