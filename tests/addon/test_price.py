"""The price of a budget: the chart, the sentence under it, and what a slider does at once."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import bpy
import numpy as np
import pytest

INK = (1.0, 1.0, 1.0)


@pytest.fixture
def chart(addon):
    """Give the module that draws."""
    return addon.ui.chart


@pytest.fixture
def curve(addon):
    """Give a straight curve: 50 dB with 20 % removed, 30 with 80 %; merging gains 6 dB."""
    shares, psnr = np.array([0.2, 0.5, 0.8]), np.array([50.0, 40.0, 30.0])
    return addon.core.quality.curve.Quality(shares, psnr, psnr + 6.0)


def pixel(picture, x, y):
    """Return the colour at a place from the upper left; the lowest row of a picture is first."""
    return picture[::-1][int(y), int(x)]


def test_a_letter_is_drawn_as_its_shape(addon):
    """A 1 is a stem of 7 pixels with a flag of one, on 9 rows; two of them have a gap."""
    drawn = addon.ui.pixel_font.drawn

    assert drawn("1").sum() == 7 + 1
    assert drawn("1").shape == (9, 2)
    assert drawn("11").shape == (9, 5)
    assert np.array_equal(drawn("11")[:, 3:], drawn("1"))


def test_every_word_of_the_chart_can_be_written(chart, curve):
    """For scores from 1e-38 to 1e38; a letter without a shape would raise `KeyError`."""
    values = np.array([1e-38, 1.0, 1e38], np.float32)
    for histogram in (chart.by_score(values), chart.by_views(np.arange(3, dtype=np.int32), 3)):
        picture = chart.Chart(chart.Look(212, INK), curve, histogram).picture(None)

        assert picture.shape == (212, 212, 4)


@pytest.mark.parametrize("size", [212, 454])
def test_the_curve_goes_where_the_estimate_is(chart, curve, size):
    """At 20, 50 and 80 % removed the pixels at 50, 40 and 30 dB have the colour of deleting."""
    look = chart.Look(size, INK)
    made = chart.Chart(look, curve, chart.by_views(np.zeros(4, np.int32), 4))
    picture = made.picture(None)
    blue = np.array(look.colors["delete"]) * 255.0

    for share, psnr in ((0.2, 50.0), (0.5, 40.0), (0.79, 30.3)):
        assert np.abs(pixel(picture, *made.at(share, psnr))[:3] - blue).max() < 8


def test_the_budget_is_a_dot_on_the_curve_that_holds_and_a_line_through_both(chart, curve):
    """A dot 4 pixels wide around the estimate: of deleting, or of merging where that is asked."""
    look = chart.Look(212, INK)
    made = chart.Chart(look, curve, chart.by_views(np.zeros(4, np.int32), 4))
    for way, psnr in (("delete", 40.0), ("merge", 46.0)):
        picture = made.picture(chart.Place(0.5, way))
        x, y = made.at(0.5, psnr)

        for aside in (-3, 0, 2):
            color = np.array(look.colors[way]) * 255.0
            assert np.abs(pixel(picture, x + aside, y)[:3] - color).max() < 8
        assert pixel(picture, x, made.at(0.5, 33.0)[1])[3] > 150


def test_moving_the_budget_draws_what_drawing_all_anew_does(chart, curve):
    """Only a strip is painted again, and the old place is gone."""
    kinds = chart.by_views(np.arange(100, dtype=np.int32) % 5, 4)
    going = kinds.going(np.arange(100) % 3 == 0)
    moved = chart.Chart(chart.Look(300, INK), curve, kinds)
    for share in (0.0, 0.3, 0.999):
        moved.picture(chart.Place(share), going)
    anew = chart.Chart(chart.Look(300, INK), curve, kinds)

    assert np.array_equal(
        moved.picture(chart.Place(0.7, "merge")),
        anew.picture(chart.Place(0.7, "merge"), going),
    )


def test_bars_are_as_high_as_there_are_splats_and_as_red_as_go(chart):
    """Of 4 views: 30 splats lie in none, 10 in all; of the 30, 20 go: two thirds of that bar."""
    seen = np.repeat([0, 4], [30, 10]).astype(np.int32)
    kinds = chart.by_views(seen, 4)
    keep = np.arange(40) >= 20
    look = chart.Look(212, INK)
    picture = chart.Chart(look, None, kinds).picture(None, kinds.going(keep))
    red, grey = (np.array(look.colors[name]) * 255.0 for name in ("goes", "stays"))

    def count(column, color):
        return (np.abs(picture[:, column, :3] - color).max(axis=-1) < 8).sum()

    assert kinds.total.tolist() == [30, 0, 0, 0, 10]
    assert count(30, red) == pytest.approx(2 * count(30, grey), abs=2)
    assert count(190, grey) == pytest.approx(count(30, red) / 2, abs=2)
    assert count(190, red) == 0


def test_scores_are_sorted_into_bars_by_their_logarithm(chart):
    """From .01 to 100 by four decades in 40 bars: 10 a decade; what scores 0 is in the first."""
    values = np.array([0.0, 0.01, 0.1, 1.5, 99.0], np.float32)
    histogram = chart.by_score(values)

    assert histogram.bins[[0, 1]].tolist() == [0, 0]
    assert histogram.bins[2] in (9, 10)  # 0.1 of float32 lies a little above
    assert histogram.bins[3:].tolist() == [21, 39]
    assert [text for _, text in histogram.ticks] == ["1e-2", "1e-1", "1e0", "1e1", "1e2"]


@pytest.mark.parametrize("values", [[0.0, 0.0], [1.0, 1.0], [3e-45, 3e38], [0.0]])
def test_scores_of_any_size_have_a_histogram(chart, values):
    """All are counted, whatever they are; NumPy's warnings are errors here."""
    assert chart.by_score(np.array(values, np.float32)).total.sum() == len(values)


def test_a_view_more_is_a_bar_more_as_far_as_there_are_bars(chart):
    """Of 1000 views: who lies in none has a bar alone, who lies in all is in the last."""
    histogram = chart.by_views(np.array([0, 1, 1000], np.int32), 1000)

    assert histogram.bins.tolist() == [0, 1, 39]


BUDGETS = [
    ("ratio", 0.25),
    ("keep", 1000),
    ("max_mb", 2.5),
    ("threshold", 0.05),
    ("min_seen", 12.5),
    ("psnr", 35.0),
]


@pytest.mark.parametrize("protect", ["", "group"])
def test_a_slider_says_at_once_what_the_plan_says_later(
    addon,
    room,
    room_cameras,
    monkeypatch,
    protect,
):
    """For every budget, with protected splats or none; it marks nothing and reads no attribute."""
    settings, plans = bpy.context.scene.refine, addon.ui.plans
    group = room.vertex_groups.new(name="group")
    group.add(list(range(30000)), 1.0, "REPLACE")
    settings.budget, settings.views = "psnr", 8  # or the closed form estimates nothing
    bpy.ops.refine.score()
    settings.protect = protect
    for kind, value in BUDGETS:
        settings.budget = kind
        with monkeypatch.context() as patch:
            patch.setattr(plans, "refresh", lambda context: plans.at_once(context.scene, room))
            patch.setattr(addon.mesh.attributes, "read_attribute", None)
            patch.setattr(addon.mesh.attributes, "write_attribute", None)
            setattr(settings, kind, value)
            soon = dict(plans.stored(room, settings))
        plans.refresh(bpy.context)
        later = dict(plans.stored(room, settings))

        assert soon.pop("marked") is False
        assert later.pop("unseen_gone") > 0
        assert soon == later
        marked = addon.mesh.attributes.read_attribute(room.data, "refine_remove")
        assert marked.sum() == later["removed"] > 0


def test_what_is_known_of_other_scores_is_not_used(addon, room, room_cameras, monkeypatch):
    """Scored again with fewer views by a script: nothing is said until the plan is made."""
    settings, plans = bpy.context.scene.refine, addon.ui.plans
    bpy.ops.refine.score()
    noted = room.data["refine_scores"]
    room.data["refine_scores"] = noted.replace('"views_used": 64', '"views_used": 63')
    monkeypatch.setattr(plans, "refresh", lambda context: plans.at_once(context.scene, room))
    settings.ratio = 0.9

    assert noted != room.data["refine_scores"]
    assert plans.stored(room, settings) is None


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
    price = addon.ui.price
    before = price.shows(room.data)
    bpy.ops.refine.score()
    preview = price._previews[0]["price"]
    first = np.array(preview.image_pixels[:])
    bpy.context.scene.refine.ratio = 0.9
    second = np.array(preview.image_pixels[:])

    assert (before, price.shows(room.data)) == (False, True)
    assert price.fits(bpy.context.preferences)
    assert len(first) == preview.image_size[0] ** 2
    assert not np.array_equal(first, second)
    assert not bpy.data.images


def test_an_addon_that_is_off_keeps_no_picture(addon):
    """Its previews are freed, and made anew when it is on again."""
    price = addon.ui.price
    addon.unregister()
    gone = len(price._previews), len(price._shown), price.icon()
    addon.register()

    assert gone == (0, 0, 0)
    assert len(price._previews) == 1


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


def test_the_sentence_tells_all_three_ways(addon):
    """The one that Apply would take first; estimates above 60 dB are all the same."""
    plan = {"splats": 39755, "kept": 19878, "bytes_before": 9.86e6, "bytes_after": 4.93e6}
    sentence = addon.ui.plans.sentence
    known = plan | {"psnr": 37.8, "psnr_merged": 46.4, "psnr_refitted": 49.2}
    seen = dict.fromkeys(("psnr", "psnr_merged", "psnr_refitted"), 70.0)
    start = "Keeps 19,878 of 39,755, 4.9 of 9.9 MB"

    assert sentence(plan | {"becomes": "merge"}) == start
    for way, words in (
        ("delete", "about 38 dB in these views (Merge: about 46, Refit: about 49)"),
        ("merge", "about 46 dB in these views (Occlusion: about 38, Refit: about 49)"),
        ("refit", "about 49 dB in these views (Occlusion: about 38, Merge: about 46)"),
    ):
        assert sentence(known | {"becomes": way}) == f"{start}, {words}"
    assert sentence(plan | seen | {"becomes": "delete"}).endswith(
        "more than 60 dB in these views (Merge: more than 60, Refit: more than 60)"
    )


def test_what_merging_reaches_of_few_splats_is_neither_told_nor_drawn(addon, chart, curve):
    """There the estimate of it is far off; the curve and the sentence of deleting stay."""
    plan = {"splats": 900, "kept": 450, "bytes_before": 9.86e6, "bytes_after": 4.93e6, "psnr": 37.8}
    start, sentence = "Keeps 450 of 900, 4.9 of 9.9 MB", addon.ui.plans.sentence
    look, few = chart.Look(212, INK), replace(curve, foretold=False)
    kinds, place = chart.by_views(np.zeros(4, np.int32), 4), chart.Place(0.5, "delete")
    orange = np.array(look.colors["merge"]) * 255.0

    drawn = [
        (
            np.abs(chart.Chart(look, some, kinds).picture(place)[..., :3] - orange).max(axis=2) < 8
        ).any()
        for some in (curve, few)
    ]

    assert drawn == [True, False]
    assert sentence(plan | {"becomes": "delete"}) == f"{start}, about 38 dB in these views"
    by_deleting = "about 38 dB in these views by deleting"
    assert sentence(plan | {"becomes": "merge"}) == f"{start}, {by_deleting}"


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

    assert "ends at 95% removed" in plans.remark(low, {})
    assert low["removed"] == int(0.95 * 39755)
    assert plans.remark(high, {}) == "By the estimate nothing can go at 99 dB"
    assert high["removed"] == 0
    assert plans.remark(middle, {}) == ""
    assert middle["psnr"] == pytest.approx(35.0, abs=0.01)


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
    assert merged["psnr_merged"] == pytest.approx(35.0, abs=0.01)
    assert plans.sentence(merged).startswith("Keeps about ")


def test_scores_without_an_estimate_say_how_to_get_one(addon, room, room_cameras):
    """The closed form makes none unless Quality was the budget."""
    settings, plans = bpy.context.scene.refine, addon.ui.plans
    bpy.ops.refine.score()
    record = addon.mesh.scores.record(room.data)
    plan = plans.stored(room, settings)

    remark = "Score by another method, or with Quality as the budget, to see dB"
    assert plans.remark(plan, record) == remark
    assert "dB" not in plans.sentence(plan)


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
    assert [warned.text for warned in of_one] == [
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
