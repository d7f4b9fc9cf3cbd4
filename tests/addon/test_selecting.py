"""What operators select, hide, mark, delete and part; tools are tested in windows."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from tests.e2e.inside.clouds import as_cloud

COUNT = 39_755


@pytest.fixture
def chosen(addon):
    """Return functions that select rows of an object, and tell which are selected."""

    def choose(obj, rows):
        flags = np.zeros(addon.mesh.layout.splat_count(obj.data), np.bool_)
        flags[rows] = True
        addon.mesh.selection.select(obj, flags)

    def read(obj):
        return np.flatnonzero(addon.mesh.selection.selected(obj)).tolist()

    choose.read = read
    return choose


@pytest.fixture(params=["MESH", "POINTCLOUD"])
def either(request, addon, room):
    """Give the room as a mesh, and as a point cloud."""
    return as_cloud(addon, room) if request.param == "POINTCLOUD" else room


def test_an_import_selects_nothing(addon, room):
    """Blender selects the vertices that are added to a mesh."""
    assert addon.mesh.selection.count(room) == 0


def test_the_selection_is_blenders_own(chosen, room):
    """What is selected here is selected in edit mode, and the other way round."""
    chosen(room, [3, 5])
    bpy.ops.object.mode_set(mode="EDIT")
    assert (chosen.read(room), room.data.total_vert_sel) == ([3, 5], 2)
    chosen(room, [7])
    bpy.ops.object.mode_set(mode="OBJECT")

    assert chosen.read(room) == [7]


def test_all_none_and_the_others(chosen, either):
    """39,755 in all; all but two when two are inverted."""
    for action, count in (("ALL", COUNT), ("NONE", 0)):
        bpy.ops.refine.select(action=action)
        assert len(chosen.read(either)) == count
    chosen(either, [0, 9])
    bpy.ops.refine.select(action="INVERT")

    assert len(chosen.read(either)) == COUNT - 2


def test_what_is_hidden_is_not_selected(addon, chosen, either):
    """Ten hidden, then all: 39,745; all but five of these hidden, then revealed: all again."""
    chosen(either, list(range(10)))
    bpy.ops.refine.select(action="HIDE")
    assert chosen.read(either) == []
    bpy.ops.refine.select(action="ALL")
    assert chosen.read(either) == list(range(10, COUNT))
    chosen(either, [20, 21, 22, 23, 24])
    bpy.ops.refine.select(action="ISOLATE")
    assert np.flatnonzero(~addon.mesh.selection.hidden(either)).tolist() == [20, 21, 22, 23, 24]
    assert chosen.read(either) == [20, 21, 22, 23, 24]
    bpy.ops.refine.select(action="REVEAL")

    assert len(chosen.read(either)) == COUNT
    assert ".hide_vert" not in either.data.attributes


@pytest.mark.parametrize(
    ("action", "words"), [("HIDE", "no splat is selected"), ("ISOLATE", "no splat is selected")]
)
def test_nothing_is_hidden_where_nothing_is_selected(room, unchanged, action, words):
    """In one sentence."""
    unchanged.start()
    with pytest.raises(RuntimeError, match=words):
        bpy.ops.refine.select(action=action)
    unchanged()


def test_faint_and_large_splats_are_taken(addon, chosen, either):
    """Less opaque than .25 by the logistic function; longer than the median of all sizes."""
    columns = addon.mesh.attributes.stored_columns(addon.mesh.layout.check(either))
    logits = np.asarray(columns["opacity"], np.float64)
    logs = np.max([columns[f"scale_{axis}"] for axis in range(3)], axis=0)
    settings = bpy.context.scene.refine
    settings.select_opacity, settings.select_size = 0.25, np.exp(np.median(logs))

    bpy.ops.refine.select_by(what="FAINT")
    faint = chosen.read(either)
    bpy.ops.refine.select_by(what="LARGE", mode="INTERSECT")
    both = chosen.read(either)
    bpy.ops.refine.select_by(what="FAINT", mode="SUBTRACT")

    assert faint == np.flatnonzero(logits < np.log(0.25 / 0.75)).tolist()
    assert 0 < len(both) < len(faint) < COUNT
    assert set(both) <= set(np.flatnonzero(logs >= np.median(logs)).tolist())
    assert chosen.read(either) == []


@pytest.mark.usefixtures("room_cameras")
def test_plans_floaters_and_demands_take_splats(addon, chosen, room):
    """Each is what the attribute, the search and the volumes say of the splats."""
    with pytest.raises(RuntimeError, match="score the splats first"):
        bpy.ops.refine.select_by(what="GOING")
    with pytest.raises(RuntimeError, match="look for floaters first"):
        bpy.ops.refine.select_by(what="FLOATERS")
    bpy.ops.refine.score()
    bpy.ops.refine.select_by(what="GOING")
    read = addon.mesh.attributes.read_attribute
    assert chosen.read(room) == np.flatnonzero(read(room.data, "refine_remove")).tolist()
    bpy.ops.refine.add_volume(role="KEEP", shape="BOX")
    box = bpy.context.scene.refine.volumes[0].object
    box.scale = [0.5 * size for size in box.scale]
    bpy.context.view_layer.update()
    bpy.context.view_layer.objects.active = room
    bpy.ops.refine.select_by(what="OUTSIDE")
    places = read(room.data, "position") - np.array(box.location)
    outside = (np.abs(places) > np.array(box.scale)).any(axis=1)

    assert 0 < outside.sum() < COUNT
    assert abs(len(chosen.read(room)) - outside.sum()) < 3  # on a face, by rounding


def test_the_selection_grows_and_shrinks(chosen, quarter):
    """By neighbours: more than was, and of the inner ones not fewer than were."""
    place = np.empty(3 * len(quarter.data.vertices), np.float32)
    quarter.data.vertices.foreach_get("co", place)
    left = np.flatnonzero(place.reshape(-1, 3)[:, 0] < np.median(place.reshape(-1, 3)[:, 0]))
    chosen(quarter, left)
    bpy.ops.refine.grow_selection(shrink=False)
    grown = chosen.read(quarter)
    bpy.ops.refine.grow_selection(shrink=True)
    shrunk = chosen.read(quarter)

    assert set(left.tolist()) < set(grown)
    assert set(left.tolist()) <= set(shrunk) < set(grown)
    chosen(quarter, [])
    with pytest.raises(RuntimeError, match="no splat is selected"):
        bpy.ops.refine.grow_selection()


def test_the_selected_splats_are_deleted_but_for_protected_ones(addon, chosen, room):
    """Of 100 selected, 10 are marked to stay: 39,665 are left, and 10 of them selected."""
    chosen(room, list(range(10)))
    bpy.ops.refine.protect(mark="STAY")
    chosen(room, list(range(100)))
    bpy.ops.refine.delete(what="SELECTED")

    assert addon.mesh.layout.splat_count(room.data) == COUNT - 90
    assert chosen.read(room) == list(range(10))


def test_the_selected_splats_become_an_object(addon, chosen, room):
    """Every other one: 19,878 and 19,877, with the columns of their rows, at the same place."""
    opacities = addon.mesh.attributes.read_attribute(room.data, "opacity")
    room.location = (1.0, 2.0, 3.0)
    chosen(room, np.arange(0, COUNT, 2))
    bpy.ops.refine.separate_selected()
    apart = bpy.data.objects["room.001"]
    read = addon.mesh.attributes.read_attribute

    assert np.array_equal(read(apart.data, "opacity"), opacities[::2])
    assert np.array_equal(read(room.data, "opacity"), opacities[1::2])
    assert apart.location == room.location
    assert chosen.read(apart) == chosen.read(room) == []
    assert apart.select_get()


def test_all_splats_are_not_parted_from_none(chosen, room, unchanged):
    """Nothing would be left of the object."""
    chosen(room, list(range(COUNT)))
    unchanged.start()
    with pytest.raises(RuntimeError, match="none would be left"):
        bpy.ops.refine.separate_selected()
    unchanged()


@pytest.mark.usefixtures("room_cameras")
def test_what_is_marked_to_go_goes_before_all_others(addon, chosen, room):
    """The 100 best of 39,755 are marked; of those that 19,877 remove they are 100.

    A mark to stay takes the place of one to go. What was marked after scoring asks for new scores.
    """
    bpy.ops.refine.score()
    scores = addon.mesh.attributes.read_attribute(room.data, "refine_score")
    best = np.argsort(-scores, kind="stable")[:100]
    chosen(room, best)
    bpy.ops.refine.protect(mark="GO")
    assert "what must go changed" in addon.ui.plans.stale(bpy.context, room)
    assert addon.objects.demands.facts(room.data)["removed_by_user"] == 100
    bpy.ops.refine.score()
    assert addon.ui.plans.stale(bpy.context, room) == []
    going = addon.mesh.attributes.read_attribute(room.data, "refine_remove")
    assert going[best].all()
    assert going.sum() == 19_877
    chosen(room, best[:40])
    bpy.ops.refine.protect(mark="STAY")
    facts = addon.objects.demands.facts(room.data)

    assert (facts["protected"], facts["removed_by_user"]) == (40, 60)
    bpy.ops.refine.delete(what="VOLUMES")
    assert addon.mesh.layout.splat_count(room.data) == COUNT - 60


def test_the_selection_is_undone_and_in_the_file(chosen, room, tmp_path):
    """One step back: what was selected before; saved and opened: what is selected."""
    chosen(room, [1, 2])
    bpy.ops.ed.undo_push(message="two")
    bpy.ops.refine.select(action="ALL")
    bpy.ops.ed.undo_push(message="all")
    bpy.ops.ed.undo()
    assert chosen.read(bpy.data.objects["room"]) == [1, 2]
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "selected.blend"))
    bpy.ops.wm.open_mainfile(filepath=bpy.data.filepath)

    assert chosen.read(bpy.data.objects["room"]) == [1, 2]


def test_tools_are_in_the_toolbar_of_both_modes(addon):
    """Five in object mode, five in edit mode of meshes."""
    from bl_ui.space_toolsystem_toolbar import VIEW3D_PT_tools_active

    for mode in ("OBJECT", "EDIT_MESH"):
        tools = VIEW3D_PT_tools_active.tools_from_context(bpy.context, mode)
        names = [tool.idname for tool in VIEW3D_PT_tools_active._tools_flatten(tools) if tool]
        ours = [name for name in names if name.startswith("refine.")]
        shapes = ("brush", "lasso", "box", "sphere", "color")
        assert ours == [f"refine.select_{shape}" for shape in shapes]
