"""The panel draws in every state, and computes nothing while it does; what a budget costs."""

import re
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix

from tests.e2e.inside.clouds import as_cloud

from .conftest import linked, read, splats_of


class Layout:
    """Stands in for Blender's layout: notes what is drawn, in order."""

    def __init__(self, drawn):
        self.__dict__["drawn"] = drawn

    def __setattr__(self, name, value):
        """Take any setting."""

    def row(self, **_options):
        return self

    column = grid_flow = row

    def panel(self, _name, **_options):
        return self, self

    def operator(self, name, property="rna_type", **_options):
        room, _, operator = name.partition(".")
        assert property in getattr(getattr(bpy.ops, room), operator).get_rna_type().properties
        self.drawn.append(name)
        return SimpleNamespace()

    operator_menu_enum = operator

    def prop(self, data, name, **_options):
        assert name in data.bl_rna.properties
        self.drawn.append(name)

    def prop_enum(self, data, name, value, *, text="", **_options):
        assert value in data.bl_rna.properties[name].enum_items
        self.drawn += [name, text]

    def label(self, *, text="", **_options):
        self.drawn.append(text)

    progress = label

    def template_icon(self, icon_value, **_options):
        self.drawn.append("chart")


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


def test_an_empty_scene_says_what_to_do_first(draw, empty_scene):
    """All six steps are there from the start, and each choice of cameras: 25 of 250 frames."""
    drawn = draw()

    buttons = ["import_ply", "import_cameras", "score", "view", "render", "apply", "export_ply"]
    assert [b for b in buttons if f"refine.{b}" in drawn] == buttons
    assert "Select an object that holds splats" in drawn
    for source in ("VISIBLE", "ACTIVE", "SELECTED", "COLLECTION", "FRAMES"):
        empty_scene.refine.source = source
        drawn = draw()
        assert ("25 frames" in drawn) == (source == "FRAMES")
        assert ("collection" in drawn) == (source == "COLLECTION")


def test_each_step_shows_what_came_of_it(addon, draw, few, room_cameras):
    """3976 splats of 248 bytes, of which half go; a point cloud of the same shows the same.
    A plan of another budget, changed while nothing was active, is not shown: a timer makes one."""
    settings, layer = bpy.context.scene.refine, bpy.context.view_layer
    imported = draw()
    bpy.ops.refine.score()
    scored = draw()
    cloud = as_cloud(addon, few)
    addon.ui.plans.refresh(bpy.context)
    of_cloud = draw()
    layer.objects.active, settings.ratio = None, 0.9
    layer.objects.active = cloud
    unplanned = draw()
    settings.ratio = 0.5
    bpy.ops.refine.apply()
    applied = draw()
    for camera in list(room_cameras.objects)[1:]:
        room_cameras.objects.unlink(camera)
    layer.update()

    assert "room: 3,976 splats, SH degree 3, 1.0 MB" in " ".join(imported)
    assert {"72 cameras", "Merge · what goes is merged"} <= set(imported)
    assert "Keeps 1,988 of 3,976, 0.5 of 1.0 MB, by 64 of 72 views" in " ".join(scored)
    assert of_cloud == scored
    assert "Keeps" not in " ".join(unplanned)
    assert "room: 1,988 splats, SH degree 3" in " ".join(applied)
    assert not [text for text in applied if text.startswith(("Keeps", "chart"))]
    assert "Splats were deleted: score again" in applied
    assert "1 camera" in draw()


def test_of_several_objects_it_says_which_buttons_take_all(draw, few):
    assert "take all" not in " ".join(draw())
    linked("other", few.data).select_set(True)
    assert "Score, Apply, Compare and Mend take all; other buttons 'room' alone" in " ".join(draw())


def test_floaters_and_what_cameras_and_curve_say_are_drawn(addon, draw, few):
    """How many float, for what reasons, and how sure that is; scores without an estimate."""
    settings, scores = bpy.context.scene.refine, addon.mesh.scores
    bpy.ops.refine.score()
    settings.budget = "psnr"
    assert "score again with a PSNR as budget" in " ".join(draw())
    bpy.ops.refine.score()
    bpy.ops.refine.find_floaters()
    drawn, found = draw(), scores.floaters(few.data)
    total = sum(found[name][0] for name in settings.to_reasons())
    words = f"{total:,} of 3,976 float: {found['front'][0]:,} in front of surfaces"
    assert re.search(words + r" \(\d+ % sure\), ", " ".join(drawn))
    assert "chart" in drawn
    assert any(re.match(r"\d+: [\d,]+, about \d+ dB", text) for text in drawn)


def test_scores_older_than_a_change_ask_to_be_made_again(draw, few):
    bpy.ops.refine.score()
    fresh = draw()
    few.location.x = 1.0
    bpy.context.scene.refine.views = 8
    bpy.context.view_layer.update()
    old = draw()
    bpy.ops.refine.score()

    # An object that stands elsewhere can be baked besides.
    added = [text for text in old if text not in (*fresh, "refine.bake_transform")]
    assert " ".join(added) == "Score again: object moved, settings changed"
    assert not [text for text in draw() if text.startswith("Score again")]


def test_the_cameras_that_say_most_are_listed(draw, addon, few, room_cameras, room_views):
    """First one that sees nothing, and one 860 m behind, which is said; then what sees least."""
    camera, view = room_cameras.objects[7], room_views[0]
    camera.location.z += 1000.0
    far = room_cameras.objects[9]
    far.matrix_world = far.matrix_world @ Matrix.Translation((0.0, 0.0, 860.0))
    bpy.context.view_layer.update()
    bpy.ops.refine.score()
    drawn = draw()
    lines = [text for text in drawn if re.match(r"\d+: ", text)]
    counts = dict(addon.mesh.scores.record(few.data)["cameras"])
    local = view.rotation @ (splats_of(addon, few).means - view.center).T
    pixels = np.array([view.fx, view.fy])[:, None] * local[:2] / local[2]
    pixels += [[view.cx], [view.cy]]
    inside = (pixels >= 0) & (pixels <= [[view.width], [view.height]])

    assert counts[view.name] == ((local[2] > 0) & inside.all(axis=0)).sum()
    least = sorted(counts.items(), key=lambda pair: pair[1])[1:7]
    least = [f"{name}: {seen:,}" for name, seen in least]
    assert lines[0] == f"{camera.name}: nothing"
    assert lines[1].startswith(f"{far.name}: ")
    assert lines[2:] == least
    assert "and 64 that change less" in drawn
    assert " ".join(drawn).count("No splat lies in the view of 1 camera") == 1
    assert " ".join(drawn).count("1 camera sees the splats from so far away") == 1


@pytest.mark.parametrize("method", ["closed-form", "occlusion", "merge"])
def test_what_a_plan_keeps_is_what_is_marked_and_what_apply_leaves(
    addon, few, few_file, room_views, method, capfd
):
    """For every budget, of files of 248 bytes a row; also where merging is foretold to need more.
    Deleting leaves what core leaves: Blender stores 0.29 as 0.28999999165534973, yet floor(.29 *
    3976) go. A success is said without a warning."""
    settings, plans, core = bpy.context.scene.refine, addon.ui.plans, addon.core
    file, way = core.read_ply(few_file), core.METHODS[method](8)
    settings.method, settings.views, settings.budget = method, 8, "psnr"
    bpy.ops.refine.score()
    for kind, value in {"ratio": 0.29, "keep": 1000, "max_mb": 0.25, "psnr": 35.0}.items():
        settings.budget = kind
        setattr(settings, kind, value)
        plan = plans.stored(few, settings)
        marked = read(addon, few, "refine_remove")
        assert marked.sum() == plan["removed"] == 3976 - plan["kept"] > 0
        assert plan["about"] == (kind == "psnr" and method == "merge")
        if method != "merge":
            expected = core.prune(file, room_views, core.Budget(**{kind: value}), way).keep
            np.testing.assert_array_equal(marked, ~expected, kind)
    how = {"merge": "merge"}.get(method, "delete")
    assert plan["quality"].at(plan["share"], how) == pytest.approx(35.0, abs=0.03)
    settings.budget, settings.ratio = "ratio", 0.75
    plan = plans.stored(few, settings)
    assert plan["removed"] == 2982
    bpy.ops.refine.apply()

    assert len(few.data.vertices) == plan["kept"]
    file = addon.mesh.attributes.read_for_file(addon.mesh.layout.check(few))()
    assert plan["bytes_after"] == file.size()
    said = capfd.readouterr().out
    assert "Info: Kept 994 splats" in said
    assert "Warning" not in said


def test_a_share_is_set_in_per_cent_and_kept_as_a_share(addon, few):
    """The budget gets the decimal that was typed; what a script sets is shown in per cent."""
    settings = bpy.context.scene.refine
    bpy.ops.refine.score()
    for percent, ratio in {29.0: 0.29, 33.3: 0.333, 0.0: 0.0, 99.99: 0.9999, 12.5: 0.125}.items():
        settings.percent = percent
        assert settings.to_budget().ratio == ratio
        assert settings.percent == np.float32(percent)
    settings.ratio = 0.75
    assert settings.percent == 75.0
    settings.percent = 10.0
    assert addon.ui.plans.stored(few, settings)["removed"] == 397


def test_each_method_has_its_price(addon):
    """A straight curve, 50 dB with 20 % removed, 30 with 80 %, of which merging gains 6 dB.
    Estimates above 60 dB are all the same; without an estimate there is no price."""
    price, psnr = addon.ui.plans.price, np.array([50.0, 40.0, 30.0])
    curve = addon.core.quality.curve.Quality(np.array([0.2, 0.5, 0.8]), psnr, psnr + 6.0)
    between = curve._replace(between=curve.psnr - 2.0)
    seconds = {"delete": 0.0, "merge": 17.0, "refit": 60.0}
    plan = {"quality": between, "share": 0.5, "closed": False, "seconds": seconds}
    few = plan | {"quality": curve._replace(foretold=False)}
    seen = plan | {"quality": curve._replace(psnr=np.full(3, 70.0)), "seconds": {}}

    assert price(plan, "closed-form") == price(None, "merge") == price({"error": ""}, "merge") == ""
    assert price(plan, "occlusion") == "about 40 dB, 38 between"
    assert price(plan, "merge").startswith("about 46 dB, 44 between · 17 s")
    assert price(few, "occlusion") == "about 40 dB"
    assert price(few, "merge") == price(few, "refit") == ""
    assert price(seen, "occlusion") == "more than 60 dB"
    assert price(plan | {"closed": True}, "closed-form") == "about 40 dB, 38 between"


def test_a_quality_out_of_reach_is_said(addon, few):
    """Beyond 95 % nothing is estimated; above what removing one splat leaves, none can go.
    The closed form makes no estimate unless Quality was the budget."""
    settings, plans = bpy.context.scene.refine, addon.ui.plans
    bpy.ops.refine.score()
    none = plans.stored(few, settings)
    assert none["remark"] == "Score by another method, or with Quality as the budget, to see dB"
    assert "dB" not in plans.sentence(none) + plans.price(none, "closed-form")
    settings.budget = "psnr"
    bpy.ops.refine.score()
    for psnr, remark in {
        1.0: "ends at 95% removed",
        99.0: "By the estimate nothing can go at 99 dB", 35.0: "",
    }.items():  # fmt: skip
        settings.psnr = psnr
        plan = plans.stored(few, settings)
        assert remark in plan["remark"]


PICTURES = ["Compare: before", "Compare: after", "Compare: difference"]


def pixels(name):
    """Return an image in 8 bits, (H, W, 3), the top row first."""
    image = bpy.data.images[name]
    width, height = image.size
    values = np.empty(width * height * 4, np.float32)
    image.pixels.foreach_get(values)
    return np.rint(values.reshape(height, width, 4)[::-1, :, :3] * 255.0).astype(np.uint8)


@pytest.mark.parametrize("method", ["closed-form", "merge"])
def test_the_pictures_are_those_of_what_apply_leaves(addon, few, room_cameras, method):
    """Before: the splats as they are; after: once *Apply* was clicked; by the same camera."""
    scene = bpy.context.scene
    scene.refine.method, scene.refine.views = method, 16
    assert not bpy.ops.refine.compare.poll()
    bpy.ops.refine.score()
    with pytest.raises(RuntimeError, match="no active camera"):
        bpy.ops.refine.compare()
    scene.camera, measured = room_cameras.objects[24], addon.ui.operators.measured
    before, told = splats_of(addon, few), measured(few, scene.refine)
    mine = bpy.data.images.new(PICTURES[0], 4, 4)
    for ratio in (0.3, 0.7):  # the second one replaces the first, of which nothing is told then
        scene.refine.ratio = ratio
        assert measured(few, scene.refine) == told == ""
        assert bpy.ops.refine.compare() == {"FINISHED"}
    told = measured(few, scene.refine)
    assert re.fullmatch(rf"Measured in '{scene.camera.name}': \d\d\.\d dB", told)

    assert len(few.data.vertices) == 3976
    bpy.ops.refine.apply()
    after = splats_of(addon, few)
    assert len(after) == 3976 - 2783  # floor(.7 * 3976)
    views = addon.cameras.CameraChoice("ACTIVE").views(bpy.context, few)
    (expected,) = addon.core.pictures.compare(before, after, views)
    assert (expected.view.width, expected.view.height) == (240, 160)
    made = [
        f"{PICTURES[0]}.001",
        *PICTURES[1:],
    ]  # an image of the user stays
    assert sorted(image.name for image in bpy.data.images) == sorted([PICTURES[0], *made])
    assert (bpy.data.images[PICTURES[0]], *mine.size) == (mine, 4, 4)
    for name, wanted in zip(made, ("before", "after", "difference"), strict=True):
        apart = np.abs(pixels(name).astype(int) - getattr(expected, wanted))
        assert apart.max() <= (8 if wanted == "difference" else 1)  # what is merged is float32 then


def test_a_comparison_counts_for_the_budget_that_it_drew(addon, few, room_cameras, monkeypatch):
    """Meanwhile the budget changes, and another object becomes the active one."""
    scene, layer, compare = bpy.context.scene, bpy.context.view_layer, addon.ui.operators.compare
    scene.camera = room_cameras.objects[24]
    active = [few, scene.camera]

    def meanwhile(*arguments, **options):
        scene.refine.ratio += 0.1
        layer.objects.active = active.pop(0)
        return compare(*arguments, **options)

    bpy.ops.refine.score()
    monkeypatch.setattr(addon.ui.operators, "compare", meanwhile)
    for _ in range(2):
        assert bpy.ops.refine.compare() == {"FINISHED"}
        assert addon.ui.operators.measured(few, scene.refine) == ""
