"""What operators select, hide, mark, delete and part; tools are tested in windows."""

import bpy
import numpy as np
import pytest

from tests.e2e.inside.clouds import as_cloud

from .conftest import choose

COUNT = 9_939


def chosen(addon, obj):
    return np.flatnonzero(addon.mesh.selection.selected(obj)).tolist()


def test_the_selection_is_blenders_own_and_grows_by_neighbours(addon, quarter):
    """What is selected here is selected in edit mode, and the other way round."""
    assert addon.mesh.selection.count(quarter) == 0
    choose(addon, quarter, [3, 5])
    bpy.ops.object.mode_set(mode="EDIT")
    assert (chosen(addon, quarter), quarter.data.total_vert_sel) == ([3, 5], 2)
    assert not bpy.ops.refine.protect.poll()
    choose(addon, quarter, [7])
    bpy.ops.object.mode_set(mode="OBJECT")
    assert chosen(addon, quarter) == [7]

    x = addon.mesh.attributes.read_attribute(quarter.data, "position")[:, 0]
    left = np.flatnonzero(x < np.median(x)).tolist()
    choose(addon, quarter, left)
    bpy.ops.refine.grow_selection(shrink=False)
    grown = set(chosen(addon, quarter))
    bpy.ops.refine.grow_selection(shrink=True)
    assert set(left) < grown
    assert set(left) <= set(chosen(addon, quarter)) < grown


@pytest.mark.parametrize("kind", ["MESH", "POINTCLOUD"])
def test_splats_are_selected_hidden_and_taken_by_what_they_are(addon, quarter, kind):
    """Less opaque than .25 by the logistic function; longer than the median of all sizes."""
    obj = as_cloud(addon, quarter) if kind == "POINTCLOUD" else quarter

    def after(action):
        bpy.ops.refine.select(action=action)
        return chosen(addon, obj)

    assert len(after("ALL")) == COUNT
    assert after("NONE") == []
    choose(addon, obj, [0, 9])
    assert len(after("INVERT")) == COUNT - 2

    choose(addon, obj, range(10))
    assert after("HIDE") == []
    assert after("ALL") == list(range(10, COUNT))
    choose(addon, obj, range(20, 25))
    assert after("ISOLATE") == list(range(20, 25))
    assert np.flatnonzero(~addon.mesh.selection.hidden(obj)).tolist() == list(range(20, 25))
    assert len(after("REVEAL")) == COUNT
    assert ".hide_vert" not in obj.data.attributes

    splats = addon.mesh.attributes.splats_from_object(addon.mesh.layout.check(obj))
    logits, logs = splats.opacity_logits.astype(np.float64), splats.log_scales.max(axis=1)
    settings = bpy.context.scene.refine
    settings.select_opacity, settings.select_size = 0.25, np.exp(np.median(logs))
    bpy.ops.refine.select_by(what="FAINT")
    faint = chosen(addon, obj)
    bpy.ops.refine.select_by(what="LARGE", mode="INTERSECT")
    both = chosen(addon, obj)
    bpy.ops.refine.select_by(what="FAINT", mode="SUBTRACT")
    assert faint == np.flatnonzero(logits < np.log(0.25 / 0.75)).tolist()
    assert 0 < len(both) < len(faint) < COUNT
    assert set(both) <= set(np.flatnonzero(logs >= np.median(logs)).tolist())
    assert chosen(addon, obj) == []

    bpy.ops.refine.add_volume(role="KEEP", shape="BOX")
    box = settings.volumes[0].object
    box.scale *= 0.5
    bpy.context.view_layer.update()
    bpy.ops.refine.select_by(what="OUTSIDE")
    places = addon.mesh.attributes.read_attribute(obj.data, "position") - np.array(box.location)
    outside = (np.abs(places) > np.array(box.scale)).any(axis=1)
    assert 0 < outside.sum() < COUNT
    assert abs(len(chosen(addon, obj)) - outside.sum()) < 3  # on a face, by rounding


def test_what_cannot_be_is_refused_in_a_sentence(addon, quarter, unchanged):
    """Nothing is selected, scored or searched; of all splats none would be left of the object."""
    operators = bpy.ops.refine
    for operator, options, words in (
        (operators.select, {"action": "HIDE"}, "no splat is selected"),
        (operators.select, {"action": "ISOLATE"}, "no splat is selected"),
        (operators.grow_selection, {}, "no splat is selected"),
        (operators.select_by, {"what": "GOING"}, "score the splats first"),
        (operators.select_by, {"what": "FLOATERS"}, "find floaters first"),
        (operators.separate_selected, {}, "none would be left"),
    ):
        choose(addon, quarter, range(COUNT if "separate" in operator.idname() else 0))
        unchanged.start()
        with pytest.raises(RuntimeError, match=words):
            operator(**options)
        unchanged()


def test_the_selected_splats_are_deleted_but_for_protected_ones_or_parted(addon, quarter):
    """Of 100 selected, 10 are marked to stay: 90 go; every other one of the rest is parted."""
    choose(addon, quarter, range(10))
    bpy.ops.refine.protect(mark="STAY")
    choose(addon, quarter, range(100))
    bpy.ops.refine.delete(what="SELECTED")
    assert addon.mesh.layout.splat_count(quarter.data) == COUNT - 90
    assert chosen(addon, quarter) == list(range(10))

    read = addon.mesh.attributes.read_attribute
    opacities = read(quarter.data, "opacity")
    quarter.location = (1.0, 2.0, 3.0)
    choose(addon, quarter, np.arange(0, COUNT, 2))
    bpy.ops.refine.separate_selected()
    apart = bpy.data.objects["room.001"]
    assert np.array_equal(read(apart.data, "opacity"), opacities[::2])
    assert np.array_equal(read(quarter.data, "opacity"), opacities[1::2])
    assert apart.location == quarter.location
    assert chosen(addon, apart) == chosen(addon, quarter) == []
    assert (bpy.context.object, bpy.context.selected_objects) == (quarter, [quarter])


def test_x_and_del_delete_splats_with_a_tool_and_not_the_object():
    """In object mode Blender's own X would delete the object."""
    name = "3D View Tool: Object, Select Splats: Brush"
    keys = bpy.context.window_manager.keyconfigs.addon.keymaps[name].keymap_items
    assert {key.type for key in keys if key.idname == "refine.delete"} == {"X", "DEL"}


def test_what_is_marked_to_go_goes_before_all_others(addon, quarter, room_cameras):
    """Of 4,969 that go the 100 best are marked; a mark to stay takes the place of one to go."""
    read, facts = addon.mesh.attributes.read_attribute, addon.objects.demands.record
    bpy.ops.refine.score()
    best = np.argsort(-read(quarter.data, "refine_score"), kind="stable")[:100]
    choose(addon, quarter, best)
    bpy.ops.refine.protect(mark="GO")
    assert addon.ui.plans.stale(quarter) == ["what must go changed"]
    bpy.ops.refine.score()
    assert addon.ui.plans.stale(quarter) == []
    bpy.ops.refine.select_by(what="GOING")
    going = np.flatnonzero(read(quarter.data, "refine_remove")).tolist()
    assert chosen(addon, quarter) == going
    assert set(best.tolist()) < set(going)
    assert len(going) == 4_969

    choose(addon, quarter, best[:40])
    bpy.ops.refine.protect(mark="STAY")
    found = facts(quarter.data)
    assert (found["protected"], found["removed_by_user"]) == (40, 60)
    bpy.ops.refine.delete(what="VOLUMES")
    assert addon.mesh.layout.splat_count(quarter.data) == COUNT - 60
