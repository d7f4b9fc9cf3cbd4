"""What operators select, hide, mark, delete and part; tools are tested in windows."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from tests.e2e.inside.clouds import as_cloud

COUNT = 9_939


@pytest.fixture
def chosen(addon):
    """Return functions that select rows of an object, and tell which are selected."""

    def choose(obj, rows):
        count = addon.mesh.layout.splat_count(obj.data)
        addon.mesh.selection.select(obj, np.isin(np.arange(count), rows))

    def read(obj):
        return np.flatnonzero(addon.mesh.selection.selected(obj)).tolist()

    choose.read = read
    return choose


def test_the_selection_is_blenders_own(addon, chosen, quarter):
    """Blender selects the vertices that are added to a mesh; an import selects none.

    What is selected here is selected in edit mode, and the other way round.
    """
    assert addon.mesh.selection.count(quarter) == 0
    chosen(quarter, [3, 5])
    bpy.ops.object.mode_set(mode="EDIT")
    assert (chosen.read(quarter), quarter.data.total_vert_sel) == ([3, 5], 2)
    chosen(quarter, [7])
    bpy.ops.object.mode_set(mode="OBJECT")
    assert chosen.read(quarter) == [7]


@pytest.mark.parametrize("kind", ["MESH", "POINTCLOUD"])
def test_splats_are_selected_hidden_and_taken_by_what_they_are(addon, chosen, quarter, kind):
    """All but two when two are inverted; what is hidden is not selected.

    Less opaque than .25 by the logistic function; longer than the median of all sizes.
    """
    obj = as_cloud(addon, quarter) if kind == "POINTCLOUD" else quarter

    def after(action):
        bpy.ops.refine.select(action=action)
        return chosen.read(obj)

    assert len(after("ALL")) == COUNT
    assert after("NONE") == []
    chosen(obj, [0, 9])
    assert len(after("INVERT")) == COUNT - 2

    chosen(obj, range(10))
    assert after("HIDE") == []
    assert after("ALL") == list(range(10, COUNT))
    chosen(obj, range(20, 25))
    assert after("ISOLATE") == list(range(20, 25))
    assert np.flatnonzero(~addon.mesh.selection.hidden(obj)).tolist() == list(range(20, 25))
    assert len(after("REVEAL")) == COUNT
    assert ".hide_vert" not in obj.data.attributes

    columns = addon.mesh.attributes.stored_columns(addon.mesh.layout.check(obj))
    logits = np.asarray(columns["opacity"], np.float64)
    logs = np.max([columns[f"scale_{axis}"] for axis in range(3)], axis=0)
    settings = bpy.context.scene.refine
    settings.select_opacity, settings.select_size = 0.25, np.exp(np.median(logs))
    bpy.ops.refine.select_by(what="FAINT")
    faint = chosen.read(obj)
    bpy.ops.refine.select_by(what="LARGE", mode="INTERSECT")
    both = chosen.read(obj)
    bpy.ops.refine.select_by(what="FAINT", mode="SUBTRACT")
    assert faint == np.flatnonzero(logits < np.log(0.25 / 0.75)).tolist()
    assert 0 < len(both) < len(faint) < COUNT
    assert set(both) <= set(np.flatnonzero(logs >= np.median(logs)).tolist())
    assert chosen.read(obj) == []


def test_what_cannot_be_is_refused_in_a_sentence(chosen, quarter, unchanged):
    """Nothing is selected, scored or searched; of all splats none would be left of the object."""
    operators = bpy.ops.refine
    for operator, options, words in (
        (operators.select, {"action": "HIDE"}, "no splat is selected"),
        (operators.select, {"action": "ISOLATE"}, "no splat is selected"),
        (operators.grow_selection, {}, "no splat is selected"),
        (operators.select_by, {"what": "GOING"}, "score the splats first"),
        (operators.select_by, {"what": "FLOATERS"}, "look for floaters first"),
        (operators.separate_selected, {}, "none would be left"),
    ):
        chosen(quarter, range(COUNT if "separate" in operator.idname() else 0))
        unchanged.start()
        with pytest.raises(RuntimeError, match=words):
            operator(**options)
        unchanged()


@pytest.mark.usefixtures("room_cameras")
def test_plans_and_demands_take_splats(addon, chosen, quarter):
    """What the attribute and the volumes say of the splats."""
    read = addon.mesh.attributes.read_attribute
    bpy.ops.refine.score()
    bpy.ops.refine.select_by(what="GOING")
    assert chosen.read(quarter) == np.flatnonzero(read(quarter.data, "refine_remove")).tolist()
    bpy.ops.refine.add_volume(role="KEEP", shape="BOX")
    box = bpy.context.scene.refine.volumes[0].object
    box.scale *= 0.5
    bpy.context.view_layer.update()
    bpy.context.view_layer.objects.active = quarter
    bpy.ops.refine.select_by(what="OUTSIDE")
    places = read(quarter.data, "position") - np.array(box.location)
    outside = (np.abs(places) > np.array(box.scale)).any(axis=1)
    assert 0 < outside.sum() < COUNT
    assert abs(len(chosen.read(quarter)) - outside.sum()) < 3  # on a face, by rounding


def test_the_selection_grows_and_shrinks(addon, chosen, quarter):
    """By neighbours: more than was, and of the inner ones not fewer than were."""
    x = addon.mesh.attributes.read_attribute(quarter.data, "position")[:, 0]
    left = np.flatnonzero(x < np.median(x)).tolist()
    chosen(quarter, left)
    bpy.ops.refine.grow_selection(shrink=False)
    grown = chosen.read(quarter)
    bpy.ops.refine.grow_selection(shrink=True)

    assert set(left) < set(grown)
    assert set(left) <= set(chosen.read(quarter)) < set(grown)


def test_the_selected_splats_are_deleted_but_for_protected_ones_or_parted(addon, chosen, quarter):
    """Of 100 selected, 10 are marked to stay: 90 go, and the 10 are selected.

    Every other one of the rest becomes an object, with the columns of its rows, at the same place.
    """
    chosen(quarter, range(10))
    bpy.ops.refine.protect(mark="STAY")
    chosen(quarter, range(100))
    bpy.ops.refine.delete(what="SELECTED")
    assert addon.mesh.layout.splat_count(quarter.data) == COUNT - 90
    assert chosen.read(quarter) == list(range(10))

    read = addon.mesh.attributes.read_attribute
    opacities = read(quarter.data, "opacity")
    quarter.location = (1.0, 2.0, 3.0)
    chosen(quarter, np.arange(0, COUNT, 2))
    bpy.ops.refine.separate_selected()
    apart = bpy.data.objects["room.001"]
    assert np.array_equal(read(apart.data, "opacity"), opacities[::2])
    assert np.array_equal(read(quarter.data, "opacity"), opacities[1::2])
    assert apart.location == quarter.location
    assert chosen.read(apart) == chosen.read(quarter) == []
    assert apart.select_get()


@pytest.mark.usefixtures("room_cameras")
def test_what_is_marked_to_go_goes_before_all_others(addon, chosen, quarter):
    """The 100 best of 9,939 are marked; of those that 4,969 remove they are 100.

    A mark to stay takes the place of one to go. What was marked after scoring asks for new scores.
    """
    bpy.ops.refine.score()
    scores = addon.mesh.attributes.read_attribute(quarter.data, "refine_score")
    best = np.argsort(-scores, kind="stable")[:100]
    chosen(quarter, best)
    bpy.ops.refine.protect(mark="GO")
    assert "what must go changed" in addon.ui.plans.stale(bpy.context, quarter)
    assert addon.objects.demands.facts(quarter.data)["removed_by_user"] == 100
    bpy.ops.refine.score()
    assert addon.ui.plans.stale(bpy.context, quarter) == []
    going = addon.mesh.attributes.read_attribute(quarter.data, "refine_remove")
    assert going[best].all()
    assert going.sum() == 4_969
    chosen(quarter, best[:40])
    bpy.ops.refine.protect(mark="STAY")
    facts = addon.objects.demands.facts(quarter.data)

    assert (facts["protected"], facts["removed_by_user"]) == (40, 60)
    bpy.ops.refine.delete(what="VOLUMES")
    assert addon.mesh.layout.splat_count(quarter.data) == COUNT - 60
