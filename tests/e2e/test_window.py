"""The panel in a real window, used with mouse and keyboard."""

from __future__ import annotations

import math
import shutil
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from blenders import Binary
from view_pictures import psnr, reference, view_in

from benchmarks.tables.models import version
from refine_addon.core.formats.ply import new_header, read_ply, with_model
from refine_addon.core.formats.ply_columns import values_by_name
from refine_addon.core.splats import Model


def test_score_apply_and_undo_by_hand(binary: Binary, blend: Path):
    """39,755 splats; *Apply* leaves 19,878 of them, Ctrl+Z all.

    Sentence and marks follow when the slider rests. The chart is no image of the file.

    Pictures of the stages stay in build/e2e, for a person to look at.
    """
    found = binary.window_step("window", blend, name="Splats", pictures=binary.work)

    assert found["opened"] == {"vertices": 39_755, "scored": False}
    assert found["scored"] == {"vertices": 39_755, "scored": True}
    priced, slid = found["priced"], found["slid"]
    assert priced["sentence"] == "Keeps 19,878 of 39,755, 4.9 of 9.9 MB"
    assert priced["percent"] == 50.0
    assert priced["chart"]
    assert priced["images"] == 0
    assert slid["percent"] > 55.0
    assert priced["marked"] == 19_877
    assert slid["marked"] == math.floor(Fraction(str(slid["ratio"])) * 39_755)
    assert f"Keeps {39_755 - slid['marked']:,} of" in slid["sentence"]
    assert found["applied"] == {"vertices": 19_878, "scored": True}
    assert found["undone"] == found["scored"]


def test_the_viewport_shows_splats_as_the_reference_renderer(
    binary: Binary, cloud: Path, cameras: Path
):
    """At least 28 dB between the picture of the window and the renderer, on black, in Solid.

    Of 39,755 splats those before the camera are drawn. With a plan, what stays and what goes are
    these; half go. A linked duplicate doubles them, and hidden adds none. Nothing is stored: the
    saved object is shown as before, and without the extension it is so again, with its handler
    gone.
    """
    found = binary.window_step(
        "view",
        size=(800, 500),
        cloud=cloud,
        cameras=cameras,
        picture=binary.work / "view-{}.png",
        blend=binary.work / "saved.blend",
    )

    shown = view_in(found["camera"], binary.work / "view-SCENE.png")
    expected = reference(found["camera"], cloud)

    assert found["after import"] == found["still on"] == "SCENE"
    assert found["failure"] == ""
    assert psnr(shown, expected) > 28.0
    assert found["HEAT"] == found["SCENE"] == found["STAYS"] + found["GOES"] <= 39_755
    assert 0 < found["GOES"] <= 39_755 // 2
    assert found["two"] == 2 * found["one hidden"]
    assert found["undone"] == found["one hidden"]
    assert found["stored"] == found["shown as"] == "TEXTURED"
    assert found["handlers"] == [1, 0]


@pytest.mark.parametrize("model", ["antialiased", "2dgs"])
def test_the_viewport_shows_every_model_as_the_reference_renderer(
    same_binary: Binary, cloud: Path, cameras: Path, tmp_path: Path, model: Model
):
    """At least 28 dB, as for ordinary splats."""
    splats = version(read_ply(cloud).splats(), model)
    columns = {name: values.astype(np.float32) for name, values in values_by_name(splats).items()}
    header = new_header(np.dtype([(name, "<f4") for name in columns]), len(splats))
    tagged = tmp_path / "point_cloud.ply"
    rows = np.column_stack([*columns.values()])
    tagged.write_bytes(with_model(header, model) + rows.tobytes())
    found = same_binary.window_step(
        "view",
        size=(800, 500),
        cloud=tagged,
        cameras=cameras,
        picture=same_binary.work / f"{model}-view-{{}}.png",
        blend=same_binary.work / "saved.blend",
    )
    shown = view_in(found["camera"], same_binary.work / f"{model}-view-SCENE.png")

    assert found["failure"] == ""
    assert psnr(shown, reference(found["camera"], tagged)) > 28.0


def test_compare_shows_before_after_and_difference_in_a_window_of_their_own(
    binary: Binary, blend: Path
):
    """One click: three thirds of a window; the next click, at 90 % removed, changes them in place.

    The images are 240 x 160, the render size. Nothing asks to be saved on leaving.
    """
    found = binary.window_step("compare", blend, pictures=binary.work)

    names = ["Compare: before", "Compare: after", "Compare: difference"]
    for shown in (found["first"], found["again"]):
        assert shown["areas"] == names
        assert shown["images"] == sorted(names)
        assert shown["windows"] == 2
        assert shown["size"] == [240, 160]
        assert shown["unsaved"] == []
        assert max(shown["widths"]) - min(shown["widths"]) <= 8
    assert found["larger"]


def test_what_must_stay_and_go_is_shown_in_every_mode(binary: Binary, cloud: Path, cameras: Path):
    """Before scoring *What Goes* shows what volumes say must go; a volume that moves is followed.

    All modes draw the same splats, and those that stay or go are parted between two of them. What
    is marked in edit mode is counted when that is left.
    """
    found = binary.window_step(
        "volumes", cloud=cloud, cameras=cameras, picture=binary.work / "volumes-{}.png"
    )

    unscored = found["unscored"]
    assert 1000 < unscored["protected"] < 30_000
    assert 0 < found["unscored GOES"] <= unscored["removed_by_user"] < 39_755
    assert found["unscored SCENE"] == found["SCENE"] == found["HEAT"]
    assert found["SCENE"] == found["STAYS"] + found["GOES"]
    assert found["GOES"] > found["unscored GOES"]
    assert found["moved"] != 0
    assert found["failure"] == ""


def test_the_window_lives_while_splats_are_scored(binary: Binary, blend: Path, cloud: Path):
    """The view orbits and zooms, and is not drawn for the bar; undo, redo and save work.

    Esc keeps the scores of before, and one Ctrl+Z takes those back. Deleting the object, loading a
    file, closing the window, switching the extension off and quitting end the thread; a file is
    imported by a thread that a dialog starts.
    """
    found = binary.window_step(
        "alive", blend, size=(1200, 900), blend=blend, cloud=cloud, pictures=binary.work
    )

    assert found["before"] is None
    assert found["scored"] == found["stopped"] == "occlusion"
    assert found["drawn"]["view"] == 0 < found["drawn"]["panel"]
    assert found["orbited"] > 0.1
    assert found["zoomed"] < 0.95
    assert [found[what] for what in ("saved", "apply", "still")] == [True, False, True]
    assert found["undone"] == [None, "occlusion"]
    assert found["esc_s"] < 10.0  # at once, on a machine that may be busy
    assert found["deleted"] == [True, True]
    assert found["ended by"] == {how: [True, 0] for how in ("load", "close_window", "disable")}
    assert found["imported"] == 39_755


def test_the_first_minutes_hold_no_trap(binary: Binary, cloud: Path, cameras: Path):
    """Dropped splats bring the 72 cameras beside them to Blender's own one, and their image size.

    Ticking *Upright* in the box of the last operation turns both and loses neither. Dropped cameras
    are the last operation then: adjusting the splats would undo them.
    After undo all 39,755 are drawn, without an event. The file is shown as it was saved, its plain
    points hidden.
    """
    for path in (cloud, cameras):
        shutil.copy(path, binary.work)
    found = binary.window_step(
        "first_minutes",
        cloud=binary.work / cloud.name,
        cameras=binary.work / cameras.name,
        pictures=binary.work,
        blend=binary.work / "saved.blend",
        asset=binary.work / "asset.spz",
    )

    imported, dropped = found["imported"], found["dropped"]
    assert (imported["splats"], imported["cameras"]) == (39_755, 1 + 72)
    assert imported["size"] == [240, 160]
    assert found["upright True"] == {**imported, "turned": True}
    assert found["upright False"] == imported
    assert (dropped["cameras"], dropped["last"]) == (1 + 2 * 72, "REFINE_OT_import_cameras")
    assert found["adjusted"] == dropped
    assert found["applied"]["splats"] == 19_878
    assert found["drawn"] == [19_878, 39_755]
    assert found["undone"]["splats"] == 39_755
    assert found["reopened"] == ["HEAT", 39_755, "BOUNDS"]
    assert found["exported"] < 39_755 * 30


def test_splats_are_selected_as_they_are_seen(binary: Binary, cloud: Path, cameras: Path):
    """Tools take what is visible, and all if told so; Shift adds, Ctrl subtracts, both intersect.

    A lasso along the edges of the box takes what the box takes, but for a pixel at its edges. The
    selection is undone, and it is in the file.
    """
    found = binary.window_step(
        "selecting",
        size=(800, 500),
        cloud=cloud,
        cameras=cameras,
        blend=binary.work / "saved.blend",
        pictures=binary.work,
    )

    assert found["imported"] == found["undone"] == found["none"] == 0
    assert 0 < found["box"] < found["through"]
    assert found["box is part"]
    assert found["lasso is box"] < 0.05 * found["box"]
    assert all(
        found[f"{what} is {how}"]
        for what, how in (("added", "both"), ("subtracted", "rest"), ("intersected", "both"))
    )
    assert 0 < found["brush"] < found["box"]
    assert found["sphere"] > 0
    assert 0 < found["piece"] < found["color"]
    assert found["radii"] == [48.0, 40.0]
    assert found["all"] == 9_939
    assert found["inverted"] == 9_939 - found["box"]
    assert found["isolated"] == found["box"] < found["drawn"]
    assert found["edit box"] == found["after edit"] == found["box"] == found["reopened"]
    assert found["failure"] == ""


def test_splats_stand_among_other_objects(binary: Binary, cloud: Path):
    """A green ball that one sees through is mixed over all splats, also where it lies behind them.

    X-ray has an opacity of .5 by default. The edges of a volume are drawn over splats; the grid
    lies behind them in every version. An instance of a collection looks as the splats themselves,
    linked or not, and is made real to be scored.
    """
    found = binary.window_step(
        "among",
        size=(800, 500),
        cloud=cloud,
        blend=binary.work / "set.blend",
        picture=binary.work / "among-{}.png",
    )
    plain = view_in(found, binary.work / "among-plain.png")
    shown = {
        name: view_in(found, binary.work / f"among-{name}.png")
        for name in (
            "grid",
            "xray-front",
            "xray-behind",
            "blended-front",
            "crop",
            "instance",
            "linked",
        )
    }
    rows, columns = (slice(size // 2 - 7, size // 2 + 7) for size in plain.shape[:2])
    center = rows, columns

    assert found["failure"] == ""
    for name in ("xray-front", "xray-behind", "blended-front"):
        green = (shown[name] - plain)[center].mean(axis=(0, 1))
        assert green[1] > green[0] + 0.1
        assert green[1] > green[2] + 0.1
    grid = (shown["grid"] - plain)[center].mean(axis=(0, 1))
    assert np.abs(grid).max() < 0.01  # splats are not quite opaque
    edges = np.abs(shown["crop"] - (0.0, 0.9, 0.8)).max(axis=2) < 0.1
    assert edges.sum() > 100
    for name in ("instance", "linked"):
        assert np.sqrt(np.mean((shown[name] - plain) ** 2)) < 0.005  # 46 dB
    assert found["real"] == 9_939


def test_blender_lives_on_where_an_operator_that_waits_refuses(binary: Binary, blend: Path):
    """Of those that wait all but the one that watches for Esc refuse something; none waits then."""
    found = binary.window_step("refused", blend, size=(1200, 1400), folder=binary.work)

    assert found.pop("not tried") == ["refine.watch_render"]
    said = {what: text for what, (text, _) in found.items()}
    assert "has no camera" in said.pop("render: no camera")
    assert "has no splats" in said.pop("render: no splats")
    assert "in stereo" in said.pop("render: stereo")
    assert "got 2 files" in said.pop("import_cameras")
    assert "a.ply" in said.pop("import_ply")
    assert all("scale_0" in text for text in said.values())
    assert {waiting for _, waiting in found.values()} == {0}
