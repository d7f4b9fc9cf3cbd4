"""The price of a budget: the chart, the price of each method, and what is said beside it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import bpy
import numpy as np
import pytest

INK = (1.0, 1.0, 1.0)


@pytest.fixture
def curve(addon):
    """Give a straight curve: 50 dB with 20 % removed, 30 with 80 %; merging gains 6 dB."""
    shares, psnr = np.array([0.2, 0.5, 0.8]), np.array([50.0, 40.0, 30.0])
    return addon.core.quality.curve.Quality(shares, psnr, psnr + 6.0)


@pytest.mark.parametrize("size", [212, 454])
def test_the_curve_goes_where_the_estimate_is(addon, curve, size):
    """At 20, 50 and 79 % removed the pixels at 50, 40 and 30.3 dB have the colour of deleting."""
    chart = addon.ui.images
    picture = chart.picture(curve, 0.95, size, INK)
    low, blue = chart.lowest(curve), np.array(chart._ON_DARK["delete"]) * 255.0

    for share, psnr in ((0.2, 50.0), (0.5, 40.0), (0.79, 30.3)):
        row = round((psnr - low) / (60.0 - low) * (size - 1))
        near = picture[row - 1 : row + 2, int(share * size), :3]
        assert np.abs(near - blue).max(axis=1).min() < 8
    assert not picture[:, int(0.9 * size), :3].max(axis=1)[round(0.5 * size) :].all()


def test_the_budget_is_a_line_with_a_dot_on_each_curve(addon, curve):
    """Of few splats, of which merging is not foretold, on one curve alone."""
    chart = addon.ui.images
    few = replace(curve, foretold=False)
    low, dots = chart.lowest(curve), []
    for each in (curve, few):
        picture = chart.picture(each, 0.5, 212, INK)
        assert (picture[:, 105:107, 3] > 100).all()
        for way, psnr in (("delete", 40.0), ("merge", 46.0)):
            row = round((psnr - low) / (60.0 - low) * 211)
            color = np.array(chart._ON_DARK[way]) * 255.0
            dots.append(np.abs(picture[row, 104:109, :3] - color).max() < 8)

    assert dots == [True, True, True, False]


@pytest.mark.parametrize(
    ("kind", "value"), [("ratio", 0.25), ("keep", 1000), ("max_mb", 2.5), ("psnr", 35.0)]
)
@pytest.mark.parametrize("method", ["occlusion", "merge"])
def test_what_a_plan_keeps_is_what_is_marked(addon, room, room_cameras, kind, value, method):
    """For every budget; also where merging is foretold to need more."""
    settings, plans = bpy.context.scene.refine, addon.ui.plans
    settings.method, settings.views = method, 8
    bpy.ops.refine.score()
    settings.budget = kind
    setattr(settings, kind, value)
    plan = plans.stored(room, settings)

    marked = addon.mesh.attributes.read_attribute(room.data, "refine_remove")
    assert marked.sum() == plan["removed"] == 39755 - plan["kept"] > 0
    assert plan["about"] == (kind == "psnr" and method == "merge")


def test_a_plan_of_other_scores_is_none(addon, room, room_cameras):
    """Scored again with fewer views by a script: nothing is said until the plan is made."""
    settings, plans = bpy.context.scene.refine, addon.ui.plans
    bpy.ops.refine.score()
    before = plans.stored(room, settings)
    noted = room.data["refine_scores"]
    room.data["refine_scores"] = noted.replace('"views_used": 64', '"views_used": 63')

    assert before is not None
    assert plans.stored(room, settings) is plans.shown(room, settings) is None


def test_what_is_protected_is_read_again(addon, room, room_cameras):
    """All but 5000 splats are protected after the plan was made: only those can go."""
    settings, plans = bpy.context.scene.refine, addon.ui.plans
    mask = room.data.attributes.new("mask", "BOOLEAN", "POINT")
    settings.protect = "mask"
    bpy.ops.refine.score()
    before = plans.stored(room, settings)["removed"]
    mask = room.data.attributes["mask"]
    mask.data.foreach_set("value", np.arange(39755) >= 5000)
    plans.refresh(bpy.context)

    assert (before, plans.stored(room, settings)["removed"]) == (19877, 5000)


def test_the_chart_is_made_with_the_plan_and_is_no_data_of_the_file(addon, room, room_cameras):
    """An icon with as many pixels as its edge squared; the file holds no image."""
    chart, settings = addon.ui.images, bpy.context.scene.refine
    settings.method, settings.views = "occlusion", 8
    bpy.ops.refine.score()
    preview = chart._previews[0]["chart"]
    first = np.array(preview.image_pixels[:])
    settings.ratio = 0.9
    second = np.array(preview.image_pixels[:])

    assert len(first) == preview.image_size[0] ** 2
    assert not np.array_equal(first, second)
    assert not bpy.data.images


def test_an_addon_that_is_off_keeps_no_picture(addon):
    """Its previews are freed, and made anew when it is on again."""
    chart = addon.ui.images
    addon.unregister()
    gone = len(chart._previews), chart.icon("chart")
    addon.register()

    assert gone == (0, 0)
    assert len(chart._previews) == 1


@pytest.mark.parametrize(
    ("percent", "ratio"), [(29.0, 0.29), (33.3, 0.333), (0.0, 0.0), (99.99, 0.9999), (12.5, 0.125)]
)
def test_a_share_is_set_in_per_cent_and_kept_as_a_share(percent, ratio):
    """The budget gets the decimal that was typed, and the panel shows it again."""
    settings = bpy.context.scene.refine
    settings.percent = percent

    assert settings.to_budget().ratio == ratio
    assert settings.percent == np.float32(percent)


def test_a_share_that_a_script_sets_is_shown_in_per_cent(room, addon, room_cameras):
    """Half by default; setting per cent makes the plan anew."""
    settings = bpy.context.scene.refine
    bpy.ops.refine.score()
    before = settings.percent
    settings.ratio = 0.75
    shown = settings.percent
    settings.percent = 10.0

    assert (before, shown) == (50.0, 75.0)
    assert addon.ui.plans.stored(room, settings)["removed"] == 3975


def test_each_method_has_its_price(addon, curve):
    """Estimates above 60 dB are all the same; without an estimate there is no price."""
    price = addon.ui.plans.price
    between = replace(curve, between=curve.psnr - 2.0)
    seconds = {"delete": 0.0, "merge": 17.0, "refit": 60.0}
    plan = {"quality": between, "share": 0.5, "closed": False, "seconds": seconds}
    few = plan | {"quality": replace(curve, foretold=False)}
    seen = plan | {"quality": replace(curve, psnr=np.full(3, 70.0)), "seconds": {}}

    assert price(plan, "closed-form") == price(None, "merge") == price({"error": ""}, "merge") == ""
    assert price(plan, "occlusion") == "about 40 dB, 38 between"
    assert price(plan, "merge").startswith("about 46 dB, 44 between · 17 s")
    assert price(few, "occlusion") == "about 40 dB"
    assert price(few, "merge") == price(few, "refit") == ""
    assert price(seen, "occlusion") == "more than 60 dB"
    assert price(plan | {"closed": True}, "closed-form") == "about 40 dB, 38 between"


def test_a_quality_out_of_reach_is_said(addon, room, room_cameras):
    """Beyond 95 % nothing is estimated; above what removing one splat leaves, none can go."""
    settings, plans = bpy.context.scene.refine, addon.ui.plans
    settings.budget, settings.psnr = "psnr", 1.0
    bpy.ops.refine.score()
    low = plans.stored(room, settings)
    settings.psnr = 99.0
    high = plans.stored(room, settings)
    settings.psnr = 35.0
    middle = plans.stored(room, settings)

    assert "ends at 95% removed" in low["remark"]
    assert low["removed"] == int(0.95 * 39755)
    assert high["remark"] == "By the estimate nothing can go at 99 dB"
    assert high["removed"] == 0
    assert middle["remark"] == ""
    assert middle["quality"].at(middle["share"]) == pytest.approx(35.0, abs=0.01)


def test_a_quality_counts_on_what_merging_reaches(addon, room, room_cameras):
    """More goes than by deleting, and merging is expected to reach the quality asked for."""
    settings, plans = bpy.context.scene.refine, addon.ui.plans
    settings.budget, settings.psnr, settings.views = "psnr", 35.0, 8
    settings.method = "occlusion"
    bpy.ops.refine.score()
    deleted = plans.stored(room, settings)
    settings.method = "merge"
    merged = plans.stored(room, settings)

    assert merged["removed"] > 1.2 * deleted["removed"]
    expected = merged["quality"].at(merged["share"], "merge")
    assert expected == pytest.approx(35.0, abs=0.01)
    assert plans.sentence(merged).startswith("Keeps about ")


def test_scores_without_an_estimate_say_how_to_get_one(addon, room, room_cameras):
    """The closed form makes none unless Quality was the budget."""
    settings, plans = bpy.context.scene.refine, addon.ui.plans
    bpy.ops.refine.score()
    plan = plans.stored(room, settings)

    assert plan["remark"] == "Score by another method, or with Quality as the budget, to see dB"
    assert "dB" not in plans.sentence(plan) + plans.price(plan, "closed-form")


def test_what_the_cameras_do_not_know_is_said_beside_apply(addon, room, room_cameras):
    """By one camera most splats lie in no view, and nobody else has a say; by 72 few do."""
    settings, plans, scores = bpy.context.scene.refine, addon.ui.plans, addon.mesh.scores
    bpy.ops.refine.score()
    of_all = plans.warnings(plans.stored(room, settings), scores.record(room.data))
    for camera in list(room_cameras.objects)[1:]:
        room_cameras.objects.unlink(camera)
    bpy.ops.refine.score()
    of_one = plans.warnings(plans.stored(room, settings), scores.record(room.data))
    unseen = addon.mesh.attributes.read_attribute(room.data, "refine_seen") == 0
    goes = addon.mesh.attributes.read_attribute(room.data, "refine_remove")

    assert of_all == []
    assert of_one == [
        "One camera decides: add others if the splats are seen from elsewhere too",
        f"{unseen.mean():.0%} of the splats lie in no view; {goes[unseen].mean():.0%} of these go",
    ]


@pytest.mark.parametrize("method", ["closed-form", "merge"])
def test_success_is_no_warning(room, room_cameras, capfd, method):
    """Blender prints what operators report, each with its kind in front."""
    settings = bpy.context.scene.refine
    settings.views, settings.method = 4, method
    bpy.ops.refine.score()
    bpy.ops.refine.apply()
    said = capfd.readouterr().out

    assert "Info: Kept 19,878 splats" in said
    assert ("splats were merged into" in said) == (method == "merge")
    assert "Warning" not in said


def test_an_export_suggests_a_name_that_no_file_has(addon, room, room_cameras, tmp_path):
    """Beside the .blend; "pruned" once splats were removed, else a copy."""
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    name = addon.ui.export_operators.REFINE_OT_export_ply.new_name
    room = bpy.data.objects["room"]
    before = name(room)
    bpy.ops.refine.score()
    scored = name(room)
    bpy.ops.refine.apply()
    (tmp_path / "room_pruned.ply").touch()
    (tmp_path / "room_pruned_2.ply").touch()

    assert (before, scored) == ("room_copy.ply", "room_copy.ply")
    assert name(room) == "room_pruned_3.ply"


def test_a_sentence_is_broken_where_the_panel_ends(addon):
    """No line is wider, none could take the next word too, and no word is lost."""
    import blf

    text = "Keeps 19,878 of 39,755, 4.9 of 9.9 MB, about 38 dB in these views (Merge: about 46)"
    lines = addon.ui.wrapped.lines(text, 230, 11.0)
    blf.size(0, 11.0)

    assert " ".join(lines) == text
    assert max(blf.dimensions(0, line)[0] for line in lines) <= 230
    for line, following in pairwise(lines):
        assert blf.dimensions(0, f"{line} {following.split()[0]}")[0] > 230
    assert addon.ui.wrapped.lines("Donaudampfschifffahrt", 5, 11.0) == ("Donaudampfschifffahrt",)
