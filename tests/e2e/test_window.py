"""The panel and the 3D view in a real window, used with mouse and keyboard."""

from __future__ import annotations

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
from blenders import Binary
from compared import fewer, psnr, reference, view_in

from benchmarks.tables.models import version
from refine_addon.core.formats.ply import new_header, read_ply, with_model
from refine_addon.core.formats.ply_columns import values_by_name


def test_score_apply_undo_and_compare_by_hand(binary: Binary, blend: Path):
    """39,755 splats; *Apply* leaves 19,878 of them, Ctrl+Z all.

    Sentence and marks follow when the slider rests; the chart is no image of the file. One click on
    *Compare*: three thirds of a window; the next, at 90 % removed, changes them in place. Images
    are 240 x 160, the render size, and nothing asks to be saved on leaving.
    """
    found = binary.window_step("panel", blend, name="Splats", pictures=binary.work)

    assert found["opened"] == {"vertices": 39_755, "scored": False}
    assert found["scored"] == found["undone"] == {"vertices": 39_755, "scored": True}
    assert found["applied"] == {"vertices": 19_878, "scored": True}
    priced, slid = found["priced"], found["slid"]
    assert priced["sentence"] == "Keeps 19,878 of 39,755, 4.9 of 9.9 MB"
    assert priced["chart"]
    assert priced["images"] == 0
    assert priced["marked"] == 19_877
    assert slid["marked"] == math.floor(Fraction(str(slid["ratio"])) * 39_755) == 23_853
    assert f"Keeps {39_755 - slid['marked']:,} of" in slid["sentence"]
    names = [f"Compare: {what}" for what in ("before", "after", "difference")]
    for shown in (found["first"], found["again"]):
        assert shown["areas"] == names
        assert shown["images"] == sorted(names)
        assert shown["windows"] == 2
        assert shown["size"] == [240, 160]
        assert shown["unsaved"] == []
        assert max(shown["widths"]) - min(shown["widths"]) <= 8
    assert found["larger"]


def test_the_viewport_shows_splats_as_the_reference_renderer(
    binary: Binary, cloud: Path, cameras: Path
):
    """At least 28 dB between the picture of the window and the renderer, on black, in Solid.

    So do splats to be drawn otherwise. Of 39,755 those before the camera are drawn. Unscored, *What
    Goes* shows what a moved box removes. With a plan, what stays and what goes are all; half go. A
    linked duplicate doubles them, and hidden adds none. Nothing is stored: the saved file is shown
    as before, and without the extension its object is so again, with the handler gone.
    """
    models = {model: binary.work / f"{model}.ply" for model in ("antialiased", "2dgs")}
    for model, path in models.items():
        splats = version(read_ply(cloud).splats(), model)
        columns = {name: column.astype("f4") for name, column in values_by_name(splats).items()}
        header = new_header(np.dtype([(name, "<f4") for name in columns]), len(splats))
        path.write_bytes(with_model(header, model) + np.column_stack([*columns.values()]).tobytes())

    found = binary.window_step(
        "view", size=(800, 500), cloud=cloud, cameras=cameras, models=models,
        pictures=binary.work, blend=binary.work / "saved.blend",
    )  # fmt: skip

    assert found["failure"] == ""
    for name, path in {"SCENE": cloud, **models}.items():
        shown = view_in(found["camera"], binary.work / f"view-{name}.png")
        assert psnr(shown, reference(found["camera"], path)) > 28.0, name
    assert (found["after import"], found["still on"]) == ("SCENE", "HEAT")
    assert 0 < found["unscored GOES"] <= found["must go"] < 39_755
    assert found["ELLIPSES"] == found["CENTERS"] == found["SCENE"]
    assert found["HEAT"] == found["SCENE"] == found["STAYS"] + found["GOES"] <= 39_755
    assert 0 < found["GOES"] <= 39_755 // 2
    assert found["two"] == 2 * found["one hidden"]
    assert found["undone"] == found["one hidden"]
    assert [found["stored"], *found["shown as"]] == ["TEXTURED", "BOUNDS", "TEXTURED"]
    assert found["handlers"] == [1, 0]


def test_the_window_lives_while_splats_are_scored(binary: Binary, blend: Path):
    """The view orbits and zooms; undo, redo and save work. Esc keeps the scores of before.

    Deleting the object, loading a file, closing the window, switching the extension off and
    quitting end the thread.
    """
    found = binary.window_step("alive", blend, size=(1200, 900), blend=blend, pictures=binary.work)

    assert found["before"] is None
    assert found["scored"] == found["stopped"] == "occlusion"
    assert found["orbited"] > 0.1
    assert found["zoomed"] < 0.95
    assert [found[what] for what in ("saved", "apply", "still")] == [True, False, True]
    assert found["undone"] == [None, "occlusion"]
    assert found["esc_s"] < 10.0  # at once, on a machine that may be busy
    hows = ("delete", "load", "close_window", "disable")
    assert found["ended by"] == {how: [True, 0] for how in hows}


def test_splats_are_selected_as_they_are_seen(binary: Binary, cloud: Path, cameras: Path):
    """Tools take what is visible, and all if told so; Shift adds, Ctrl subtracts, both intersect.

    A lasso along the edges of the box takes what the box takes, but for a pixel at its edges. The
    selection is undone, and it is in the file.
    """
    found = binary.window_step(
        "selecting", size=(800, 500), cloud=fewer(cloud, binary.work), cameras=cameras,
        blend=binary.work / "saved.blend", pictures=binary.work,
    )  # fmt: skip

    assert found["imported"] == found["undone"] == found["none"] == 0
    assert 0 < found["box"] < found["through"]
    assert found["box is part"]
    assert found["lasso is box"] < 0.05 * found["box"]
    assert found["combined"] == [True] * 3
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
    lies behind them in every version. Instances look as the splats themselves; one is made real.
    """
    found = binary.window_step(
        "among", size=(800, 500), cloud=fewer(cloud, binary.work), pictures=binary.work
    )

    def shown(name: str) -> np.ndarray:
        return view_in(found, binary.work / f"among-{name}.png")

    plain = shown("plain")
    center = tuple(slice(size // 2 - 7, size // 2 + 7) for size in plain.shape[:2])
    assert found["failure"] == ""
    for name in ("xray-front", "xray-behind", "blended-front"):
        green = (shown(name) - plain)[center].mean(axis=(0, 1))
        assert green[1] > green[0] + 0.1
        assert green[1] > green[2] + 0.1
    grid = (shown("grid") - plain)[center].mean(axis=(0, 1))
    assert np.abs(grid).max() < 0.01  # splats are not quite opaque
    edges = np.abs(shown("crop") - (0.0, 0.9, 0.8)).max(axis=2) < 0.1
    assert edges.sum() > 100
    assert min(psnr(shown(name), plain) for name in ("scatter", "instance")) > 46.0
    assert (found["real"], found["undone"]) == (9_939, "instance")


def test_blender_lives_on_where_an_operator_that_waits_refuses(binary: Binary, blend: Path):
    """Of those that wait all but the one that watches for Esc refuse something; none waits then."""
    found = binary.window_step("refused", blend, size=(1200, 1400), pictures=binary.work)

    assert found.pop("not tried") == ["refine.watch_render"]
    said = {what: text for what, (text, _) in found.items()}
    assert "no active camera" in said.pop("render: no camera")
    assert "has no splats" in said.pop("render: no splats")
    assert "in stereo" in said.pop("render: stereo")
    assert "got 2 files" in said.pop("import_cameras")
    assert "a.ply" in said.pop("import_ply")
    assert all("scale_0" in text for text in said.values())
    assert {waiting for _, waiting in found.values()} == {0}
