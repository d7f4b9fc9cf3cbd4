"""Several selected splat objects: one scene to the cameras, one budget, one undo step."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
import pytest

from tests.e2e.inside.clouds import as_cloud

ROOM = Path(__file__).parents[1] / "data" / "room_small"
COUNT = 39_755


@pytest.fixture
def halves(addon, room_cameras):
    """Return the room as two selected objects: its first 20,000 splats, and the rest."""
    file = addon.core.read_ply(ROOM / "point_cloud.ply")
    made = []
    for name, first in (("a", True), ("b", False)):
        keep = (np.arange(COUNT) < 20_000) == first
        path = Path(bpy.app.tempdir) / f"{name}.ply"
        file.write(path, keep, overwrite=True)
        mesh = addon.mesh.attributes.mesh_from_file(addon.core.read_ply(path))
        obj = bpy.data.objects.new(name, mesh)
        bpy.context.scene.collection.objects.link(obj)
        obj.data.attributes.new("row", "INT", "POINT")
        obj.data.attributes["row"].data.foreach_set("value", np.flatnonzero(keep).astype(np.int32))
        obj.select_set(True)
        made.append(obj)
    bpy.context.view_layer.objects.active = made[1]
    return made


def rows(addon, objects):
    """Return which splats of the file the objects hold."""
    found = [addon.mesh.attributes.read_attribute(obj.data, "row") for obj in objects]
    return np.sort(np.concatenate(found))


def test_the_object_that_cannot_be_scored_is_named(halves):
    """The one that is not the active one, scaled to nothing."""
    halves[0].scale = (0.0, 0.0, 0.0)

    with pytest.raises(RuntimeError, match="object 'a': the transform is flat"):
        bpy.ops.refine.score()


@pytest.mark.parametrize(
    "method",
    [
        "closed-form",
        pytest.param("occlusion", marks=pytest.mark.slow),
        pytest.param("merge", marks=pytest.mark.slow),
    ],
)
def test_both_halves_keep_what_the_whole_room_keeps(addon, halves, room_views, method):
    """70 % of 39,755 are 27,828 by one order of removal; 11,927 stay, unevenly in both objects."""
    settings = bpy.context.scene.refine
    settings.method, settings.views, settings.ratio = method, 16, 0.7
    core = addon.core
    expected = core.prune(
        core.read_ply(ROOM / "point_cloud.ply").splats(),
        room_views,
        core.Budget(ratio=0.7),
        core.METHODS[method](16),
    )

    assert bpy.ops.refine.score() == {"FINISHED"}
    plan = addon.ui.plans.stored(halves[1], settings)
    assert bpy.ops.refine.apply() == {"FINISHED"}

    assert (plan["splats"], plan["kept"]) == (COUNT, COUNT - 27_828)
    np.testing.assert_array_equal(rows(addon, halves), np.flatnonzero(expected.keep))
    check, gather = addon.mesh.layout.check, addon.objects.splat_group.gather
    left = [gather([check(obj)], whole=True) for obj in halves]
    wanted = expected.splats
    np.testing.assert_allclose(
        np.concatenate([part.means for part in left]), wanted.means, rtol=1e-6, atol=1e-6
    )
    np.testing.assert_allclose(
        np.concatenate([part.sh_rest for part in left]), wanted.sh_rest, rtol=1e-5, atol=1e-5
    )


def test_a_mesh_and_a_point_cloud_share_a_budget(addon, halves, room_views):
    """The second becomes a point cloud of Blender's own splats; 50 % of both together go."""
    clouds = [halves[0], as_cloud(addon, halves[1])]
    halves[0].select_set(True)
    bpy.ops.refine.score()
    bpy.ops.refine.apply()
    core = addon.core
    expected = core.prune(
        core.read_ply(ROOM / "point_cloud.ply").splats(),
        room_views,
        core.Budget(ratio=0.5),
        addon.core.ClosedForm(),
    ).keep

    assert [obj.type for obj in clouds] == ["MESH", "POINTCLOUD"]
    assert len(np.setxor1d(rows(addon, clouds), np.flatnonzero(expected))) <= 4  # activated


def test_marks_and_sentence_are_those_of_the_selection(addon, halves):
    """Together 19,877 of 39,755 are marked; of the second alone floor(19,755 / 2) = 9,877."""
    settings, plans = bpy.context.scene.refine, addon.ui.plans
    bpy.ops.refine.score()

    def marked():
        return [
            int(addon.mesh.attributes.read_attribute(obj.data, "refine_remove").sum())
            for obj in halves
        ]

    assert sum(marked()) == 19_877
    assert "of 39,755" in plans.sentence(plans.stored(halves[1], settings))

    halves[0].select_set(False)
    assert plans.stored(halves[1], settings) is None  # of both, not of this one
    plans.refresh(bpy.context)

    assert marked()[1] == 9_877
    assert "of 19,755" in plans.sentence(plans.stored(halves[1], settings))


def test_the_curve_is_that_of_all_and_of_no_part(addon, halves):
    """The pictures' quality was estimated for both: one alone has no curve of its own."""
    settings = bpy.context.scene.refine
    settings.method, settings.views = "occlusion", 8
    bpy.ops.refine.score()
    group, scores = addon.objects.splat_group, addon.mesh.scores
    members = group.members(bpy.context.view_layer, addon.mesh.layout.check(halves[1]))

    found = group.forced(bpy.context.scene, members)
    arguments = group.stored_arguments(members, settings.to_budget(), found, settings.to_method())

    assert arguments["scores"].quality is not None
    assert all(scores.stored_scores([member]).quality is None for member in members)
    ranks = [addon.mesh.attributes.read_attribute(obj.data, "refine_rank") for obj in halves]
    np.testing.assert_allclose(np.sort(np.concatenate(ranks)), np.linspace(0, 1, COUNT), atol=1e-6)


def test_objects_that_were_not_scored_together_are_refused(halves, unchanged):
    """Each was scored by itself: their scores are places in two orders."""
    for obj, other in (halves, halves[::-1]):
        obj.select_set(True)
        other.select_set(False)
        bpy.context.view_layer.objects.active = obj
        bpy.ops.refine.score()
    halves[0].select_set(True)
    halves[1].select_set(True)
    unchanged.start()

    with pytest.raises(RuntimeError, match="the 2 selected objects were not scored together"):
        bpy.ops.refine.apply()

    unchanged()


def test_where_one_cannot_be_changed_none_is(halves, unchanged):
    """Shape keys hold every vertex again; the other object stays whole as well."""
    bpy.ops.refine.score()
    halves[0].shape_key_add(name="key")
    unchanged.start()

    with pytest.raises(RuntimeError, match="object 'a': has shape keys"):
        bpy.ops.refine.apply()

    unchanged()


@pytest.mark.usefixtures("halves")
def test_where_blender_fails_at_the_second_the_first_is_whole_again(addon, unchanged, monkeypatch):
    bpy.ops.refine.score()
    unchanged.start()
    delete, calls = addon.mesh.edit.delete_vertices, []

    def fails_once(obj, remove):
        calls.append(obj.name)
        if len(calls) == 2:
            raise addon.core.RefineError("no second time")
        delete(obj, remove)

    monkeypatch.setattr(addon.mesh.edit, "delete_vertices", fails_once)
    with pytest.raises(RuntimeError, match="no second time"):
        bpy.ops.refine.apply()

    assert calls == ["a", "b"]
    unchanged()


def test_an_object_of_which_nothing_would_be_left_is_refused(halves, unchanged):
    """The first object is far above all cameras: its 20,000 splats are the lowest half."""
    halves[0].location.z = -30.0
    bpy.context.scene.refine.ratio = 0.6
    bpy.ops.refine.score()
    unchanged.start()

    with pytest.raises(RuntimeError, match="no splat of object 'a' would be left"):
        bpy.ops.refine.apply()

    unchanged()


def test_objects_that_share_their_data_are_refused(halves):
    twin = halves[0].copy()
    bpy.context.scene.collection.objects.link(twin)
    twin.select_set(True)

    with pytest.raises(RuntimeError, match=r"objects 'a' and 'a\.001' share their data"):
        bpy.ops.refine.score()


def test_a_group_that_one_object_has_protects_there(halves):
    """All of the first object is protected: its 20,000 stay, and 19,755 - 19,877 < 0 go: none."""
    group = halves[0].vertex_groups.new(name="keep")
    group.add(range(20_000), 1.0, "REPLACE")
    settings = bpy.context.scene.refine
    bpy.ops.refine.score()
    settings.protect, settings.ratio = "keep", 0.4
    bpy.ops.refine.apply()

    assert len(halves[0].data.vertices) == 20_000
    assert len(halves[1].data.vertices) == 19_755 - 15_902
    settings.protect = "none"
    with pytest.raises(RuntimeError, match="nothing to protect is named 'none'"):
        bpy.ops.refine.score()


def test_one_active_object_beside_a_selection_is_worked_on_alone(addon, halves):
    """As everywhere: an active object that is not selected is the only one that is meant."""
    halves[1].select_set(False)

    found = addon.objects.splat_group.chosen(bpy.context.view_layer, halves[1])

    assert found == [halves[1]]
