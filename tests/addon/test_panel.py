"""The panel draws in every state, and computes nothing while it does."""

from __future__ import annotations

import json
import re
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from tests.e2e.inside.clouds import as_cloud


class Layout:
    """Stands in for Blender's layout: notes what is drawn, in order."""

    def __init__(self, drawn):
        self.__dict__["drawn"] = drawn

    def __setattr__(self, name, value):
        """Take any setting."""

    def row(self, **_options):
        """Return itself, as a part of the layout."""
        return self

    column = row

    def grid_flow(self, **_options):
        """Return itself."""
        return self

    def panel(self, _name, **_options):
        """Return itself as the header and the body of a part that is open."""
        return self, self

    def operator(self, name, **_options):
        """Note a button, and return something to set its properties on."""
        room, _, operator = name.partition(".")
        assert getattr(getattr(bpy.ops, room), operator).get_rna_type()
        self.drawn.append(name)
        return SimpleNamespace()

    def operator_menu_enum(self, name, property, **_options):
        """Note a menu, and return something to set its properties on."""
        assert property in bpy.ops.refine.__getattr__(name.split(".")[1]).get_rna_type().properties
        self.drawn.append(name)
        return SimpleNamespace()

    def prop(self, data, name, **_options):
        """Note a property; it must exist."""
        assert name in data.bl_rna.properties
        self.drawn.append(name)

    def prop_enum(self, data, name, value, *, text="", **_options):
        """Note one value of a property, and its text; it must exist."""
        assert value in data.bl_rna.properties[name].enum_items
        self.drawn += [name, text]

    def label(self, *, text="", **_options):
        """Note a text."""
        self.drawn.append(text)

    def template_icon(self, icon_value, **_options):
        """Note the chart."""
        self.drawn.append("chart")

    def progress(self, *, text, **_options):
        """Note a bar."""
        self.drawn.append(text)


@pytest.fixture
def draw(addon, monkeypatch):
    """Return a function that draws all panels and returns what they draw."""

    def never(*_arguments, **_options):
        raise AssertionError("computed while drawing")

    def draw():
        drawn = []
        with monkeypatch.context() as patch:
            patch.setattr(addon.mesh.scores, "stored_scores", never)
            for name in ("members", "stored_arguments", "mark_removed", "gather", "apply"):
                patch.setattr(addon.objects.splat_group, name, never)
            patch.setattr(addon.mesh.attributes, "read_attribute", never)
            patch.setattr(addon.mesh.attributes, "write_attribute", never)
            for cls in addon.registration.CLASSES:
                panel = issubclass(cls, bpy.types.Panel)
                if panel and getattr(cls, "poll", lambda _context: True)(bpy.context):
                    cls.draw(SimpleNamespace(layout=Layout(drawn)), bpy.context)
        return drawn

    return draw


def test_an_empty_scene_says_what_to_do_first(draw):
    """All six steps are there from the start."""
    drawn = draw()

    buttons = ["import_ply", "import_cameras", "score", "view", "render", "apply", "export_ply"]
    assert [b for b in buttons if f"refine.{b}" in drawn] == buttons
    assert "Select an object that holds splats" in drawn


def test_each_step_shows_what_came_of_it(draw, room, room_cameras):
    """Counts and sizes of the room: 39755 splats of 248 bytes, 9.9 MB; half go."""
    imported = draw()
    bpy.ops.refine.score()
    scored = draw()
    bpy.ops.refine.apply()
    applied = draw()

    assert "room: 39,755 splats, SH degree 3, 9.9 MB" in " ".join(imported)
    assert "72 cameras" in imported
    assert "Keeps 19,878 of 39,755, 4.9 of 9.9 MB, by 64 of 72 views" in " ".join(scored)
    assert "room: 19,878 splats, SH degree 3" in " ".join(applied)
    assert not [text for text in applied if text.startswith(("Keeps", "chart"))]
    assert "Splats were deleted: score again" in applied


def test_what_floats_is_told_with_how_sure_that_is(draw, addon, room, room_cameras):
    """More by a higher strength; per cent are the mean over what goes."""
    splats = addon.objects.splat_group.gather([addon.mesh.layout.check(room)])
    views = addon.ui.operators.chosen_views(bpy.context)
    expected = addon.core.clean(splats, views, addon.core.Cleaning())
    counts, sure, told = expected.counts(), expected.surety(), []

    bpy.ops.refine.find_floaters()
    for strength in ("CAREFUL", "USUAL", "STRONG"):
        bpy.context.scene.refine.strength = strength
        told += [text for text in draw() if " of 39,755 float" in text]

    careful = counts["front"] + counts["isolated"]
    known = sum(counts[name] * (sure[name] or 0.0) for name in ("front", "isolated"))
    assert told[0] == f"{careful:,} of 39,755 float, {100.0 * known / careful:.0f} % sure"
    totals = [int(text.split()[0].replace(",", "")) for text in told]
    assert 0 < totals[0] <= totals[1] == sum(counts.values()) <= totals[2]


def test_each_method_is_drawn_with_its_price(draw, room, room_cameras):
    """Before there are scores with what it means; then dB, in between too, and seconds."""
    settings = bpy.context.scene.refine
    settings.method, settings.views = "occlusion", 8
    before = draw()
    bpy.ops.refine.score()
    prices = [text for text in draw() if " · " in text]

    assert "Merge · what goes is merged" in before
    assert prices[0] == "Closed Form · rows stay as they were"
    assert re.fullmatch(r"Occlusion · about \d\d dB(, \d\d between)?", prices[1])
    assert re.fullmatch(r"Merge · about \d\d dB(, \d\d between)? · \d+ .*", prices[2])
    assert re.fullmatch(r"Refit · about \d\d dB.* · \d+ .*", prices[3])
    assert "chart" in draw()


def test_after_deletion_by_hand_the_panel_asks_for_scores_and_says_why(
    addon,
    room,
    room_cameras,
):
    """Nothing was applied, and the panel does not say so."""
    bpy.ops.refine.score()
    rows = np.arange(len(room.data.vertices))
    addon.mesh.selection.select(room, rows < 100)
    bpy.ops.refine.delete(what="SELECTED")

    drawn = []
    panel = addon.ui.panel.REFINE_PT_prune
    panel.draw(SimpleNamespace(layout=Layout(drawn)), bpy.context)

    assert "Splats were deleted: score again" in " ".join(drawn)
    assert "Applied" not in " ".join(drawn)


def test_a_tool_says_in_the_header_how_many_splats_it_has_selected(addon, room):
    """The box *Select* may be closed, as it is at first; without splats nothing is counted."""
    drawn = []
    tools = addon.ui.select_tools
    addon.mesh.selection.select(room, np.arange(len(room.data.vertices)) < 1234)
    tool = SimpleNamespace(idname="refine.select_box")

    tools._draw_settings(bpy.context, Layout(drawn), tool)
    bpy.context.view_layer.objects.active = None
    tools._draw_settings(bpy.context, Layout(drawn), tool)

    assert drawn == ["select_hidden", "1,234 selected", "select_hidden"]


def test_a_point_cloud_is_drawn_as_a_mesh_is(addon, draw, room, room_cameras):
    """Scored as a mesh before: the same lines, and the size of its file, 248 bytes a row."""
    bpy.ops.refine.score()
    mesh = draw()
    as_cloud(addon, room)
    addon.ui.plans.refresh(bpy.context)

    assert draw() == mesh
    assert "room: 39,755 splats, SH degree 3" in " ".join(mesh)
    assert "Keeps 19,878 of 39,755, 4.9 of 9.9 MB" in " ".join(mesh)


def test_what_an_old_blender_left_of_splats_is_not_just_nothing(draw, empty_scene):
    """A point cloud of 5.3 without its colours, which Blender 5.0 and older drop."""
    cloud = bpy.data.pointclouds.new("left")
    cloud.attributes.new("scale", "FLOAT_VECTOR", "POINT")
    cloud.attributes.new("rotation", "QUATERNION", "POINT")
    obj = bpy.data.objects.new("left", cloud)
    empty_scene.collection.objects.link(obj)
    bpy.context.view_layer.objects.active = obj

    assert "Colours were lost: open it in Blender 5.2" in " ".join(draw())


def test_a_plan_that_no_longer_holds_is_not_drawn(draw, room, room_cameras):
    """The budget changed while another object was active; in a window a timer makes another."""
    bpy.ops.refine.score()
    bpy.context.view_layer.objects.active = None
    bpy.context.scene.refine.ratio = 0.9
    bpy.context.view_layer.objects.active = room

    assert "Keeps" not in " ".join(draw())


def test_scores_older_than_a_change_ask_to_be_made_again(draw, room, room_cameras):
    """In one line."""
    bpy.ops.refine.score()
    fresh = draw()
    room.location.x = 1.0
    bpy.context.scene.refine.views = 8
    bpy.context.view_layer.update()
    old = draw()
    bpy.ops.refine.score()

    # An object that stands elsewhere can be baked besides.
    added = [text for text in old if text not in (*fresh, "refine.bake_transform")]
    assert " ".join(added) == "Score again: object moved, settings changed"
    assert not [text for text in draw() if text.startswith("Score again")]


def test_nothing_is_asked_of_the_scene_twice_until_it_changes(
    draw,
    addon,
    room,
    room_cameras,
    monkeypatch,
):
    """Cameras, sizes and changes are asked once; a lens or a setting that changes asks anew."""
    asked = []

    def counting(name, ask):
        def counted(*arguments):
            asked.append(name)
            return ask(*arguments)

        return counted

    bpy.ops.refine.score()
    panel = addon.ui.panel
    monkeypatch.setattr(panel, "_cameras", counting("cameras", panel._cameras))
    for module, name in ((panel.plans, "stale"), (panel.mesh_layout, "export_bytes")):
        monkeypatch.setattr(module, name, counting(name, getattr(module, name)))
    bpy.context.view_layer.update()
    draw()
    first = sorted(asked)
    draw()
    again = sorted(asked)
    room_cameras.objects[0].data.lens = 99.0
    bpy.context.view_layer.update()
    draw()
    lens = sorted(asked)
    bpy.context.scene.refine.source = "VISIBLE"
    draw()

    assert first == again == ["cameras", "export_bytes", "stale"]
    assert lens == sorted(2 * first)
    assert sorted(asked) == sorted(3 * first)


def test_the_cameras_that_say_most_are_listed(draw, addon, room, room_cameras, room_views):
    """First one that is turned away, and sees nothing, which is said too; then what sees least."""
    camera = room_cameras.objects[7]
    camera.location.z += 1000.0
    bpy.context.view_layer.update()
    before = draw()
    bpy.ops.refine.score()
    drawn = draw()
    lines = [text for text in drawn if re.match(r"\d+: ", text)]
    counts = dict(addon.mesh.scores.record(room.data)["cameras"])
    means = addon.objects.splat_group.gather([addon.mesh.layout.check(room)]).means
    local = room_views[0].rotation @ (means - room_views[0].center).T
    x = room_views[0].fx * local[0] / local[2] + room_views[0].cx
    y = room_views[0].fy * local[1] / local[2] + room_views[0].cy
    there = (local[2] > 0) & (x >= 0) & (x <= room_views[0].width) & (y >= 0)
    sees = int((there & (y <= room_views[0].height)).sum())

    assert not [text for text in before if re.match(r"\d+: ", text)]
    assert counts[room_views[0].name] == sees
    least = sorted(counts.items(), key=lambda pair: pair[1])[1:8]
    assert lines == [f"{camera.name}: nothing", *(f"{name}: {seen:,}" for name, seen in least)]
    assert "and 64 that change less" in drawn
    assert " ".join(drawn).count("No splat lies in the view of 1 camera") == 1


def test_one_is_not_counted_as_many(draw, room, room_cameras):
    """A scene with one camera has "1 camera", not "1 cameras"."""
    for camera in list(room_cameras.objects)[1:]:
        room_cameras.objects.unlink(camera)
    bpy.context.view_layer.update()

    assert "1 camera" in draw()


@pytest.fixture
def at_work(addon):
    """Return a function that lets the panel believe that an operator works."""
    running = addon.ui.operator_bases

    def at_work(operator, doing):
        worker = SimpleNamespace(fraction=0.43, what="looking")
        now = running.Running.__new__(running.Running)
        now.operator, now.doing, now.waits, now._offers = operator, doing, "", ""
        now.worker, now._left = worker, running.TimeLeft()
        running._now[:] = [now]

    yield at_work
    running._now.clear()


@pytest.mark.parametrize("name", ["score", "find_floaters", "apply", "levels"])
@pytest.mark.usefixtures("room")
def test_one_bar_is_drawn_in_the_box_of_the_button_that_was_clicked(draw, at_work, name):
    """It says what is done and how to cancel; the buttons stay where they are."""
    before = draw()
    at_work(f"refine.{name}", "Working")
    drawn = draw()

    buttons = {text for text in before if text.startswith("refine.")}
    assert drawn.count("43%") == 1
    assert drawn.count("Working (looking); Esc cancels") == 1
    assert f"refine.{name}" in buttons <= set(drawn)


@pytest.mark.parametrize("source", ["VISIBLE", "ACTIVE", "SELECTED", "COLLECTION", "FRAMES"])
def test_every_source_of_cameras_is_drawn(draw, source):
    """A shot of 250 frames, every tenth: 25."""
    bpy.context.scene.refine.source = source
    drawn = draw()

    assert ("25 frames" in drawn) == (source == "FRAMES")
    assert ("collection" in drawn) == (source == "COLLECTION")


def test_the_quality_of_the_pictures_is_a_budget(draw, addon, room, room_cameras):
    """Its own number is drawn; scores made without an estimate say what to do."""
    settings = bpy.context.scene.refine
    bpy.ops.refine.score()
    settings.budget = "psnr"

    assert "psnr" in draw()
    assert "score again with a PSNR as budget" in " ".join(draw())

    bpy.ops.refine.score()
    stored = addon.mesh.scores.stored_scores([addon.mesh.layout.check(room)])
    assert stored.quality is not None
    assert any(text.startswith("Keeps ") for text in draw())


def test_a_curve_of_more_splats_than_are_left_is_not_used(addon, room, room_cameras):
    """Where some were deleted by hand since, a share of the rest is another."""
    bpy.context.scene.refine.budget = "psnr"
    bpy.ops.refine.score()
    scores = addon.mesh.scores
    noted = json.loads(room.data[scores.RECORD])
    room.data[scores.RECORD] = json.dumps(noted | {"splats": noted["splats"] + 5})

    stored = scores.stored_scores([addon.mesh.layout.check(room)])

    assert stored.quality is None
