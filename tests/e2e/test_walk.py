"""The guide's walk from a raw capture to a clean asset with its pictures, and an artist's."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from blenders import BINARIES, PROJECT, Binary
from compared import fewer, psnr, reference, view_in
from PIL import Image

from benchmarks.tables.floaters import floaters
from benchmarks.tables.million import write_ply
from refine_addon.core.cameras.read import read_cameras
from refine_addon.core.formats.ply import read_ply
from refine_addon.core.splats import joined

PICTURES = PROJECT / "docs" / "walk"

# Of the brightness of a pixel, and of the pixels that may differ by more: panels that are worded
# otherwise differ in more of them, two runs in fewer.
LIKE, UNLIKE = 40, 0.01


@pytest.mark.parametrize("binary", BINARIES[:1], indirect=True)  # that stays the same
def test_the_guides_walk_and_its_pictures(binary: Binary, cloud: Path, cameras: Path):
    """Floaters in the room: most are found, 70 % of what is left goes, the asset is written.

    The pictures of docs/walk show the same; REFINE_PICTURES=1 takes them anew.
    """
    raw, asset = binary.work / "capture.ply", binary.work / "asset.spz"
    room = read_ply(cloud).splats()
    made, kinds = floaters(room, read_cameras(cameras), seed=1)
    few = made.take(kinds < 2)  # a hundred veils would leave nothing to see
    write_ply(raw, joined([room, few]))

    found = binary.window_step(
        "walk", size=(1280, 800), cloud=raw, cameras=cameras, output=asset, pictures=binary.work
    )

    assert found["imported"] == len(room) + len(few)
    assert len(room) - 100 < found["cleaned"] < len(room) + 400
    assert found["applied"] == found["cleaned"] - int(0.7 * found["cleaned"])
    assert asset.stat().st_size < 0.1 * raw.stat().st_size
    unlike = {}
    for path in sorted(binary.work.glob("*.png")):
        guides = PICTURES / f"{path.stem}.jpg"
        with Image.open(path) as screen:
            taken = screen.convert("RGB")
        if os.environ.get("REFINE_PICTURES"):
            taken.save(guides, quality=85)
        with Image.open(guides) as shown:
            pair = [np.asarray(image.convert("RGB"), np.int16) for image in (taken, shown)]
        unlike[path.stem] = float(np.mean(np.abs(pair[0] - pair[1]).max(axis=2) > LIKE))
    assert len(unlike) == 5
    assert max(unlike.values()) < UNLIKE, f"{unlike}: take the guide's pictures anew"


def test_an_artist_walks_from_the_zip_to_an_asset(
    fresh_binary: Binary, extension_zip: Path, cloud: Path, cameras: Path
):
    """Zip, splats and cameras are dropped as the window manager tells Blender.

    Splats bring the 72 cameras beside them to Blender's own one, and their image size. Ticking
    *Upright* in the box of the last operation turns both and loses neither; dropped cameras are the
    last operation then. On with mouse and keys: look, score, price, lasso, delete, undo, crop,
    score, apply, undo, redo, save. Another process opens the file with the preferences that
    the first left. Of 9,939 splats half of what the crop leaves go, and each picture is what it was
    where nothing changed.
    """
    work = fresh_binary.work
    few = fewer(cloud, work).rename(work / "point_cloud.ply")
    for path in (cameras, extension_zip):
        shutil.copy(path, work)
    blend, asset = work / "saved.blend", work / "asset.ply"
    look = {"size": (1100, 750), "factory": False, "pictures": work}

    walk = fresh_binary.window_step(
        "artist", **look, archive=work / extension_zip.name, cloud=few,
        cameras=work / cameras.name, blend=blend,
    )  # fmt: skip
    again = fresh_binary.window_step("artist", blend, **look, asset=asset)

    shown = {
        path.stem[8:]: _center(view_in(walk["numbers"], path)) for path in work.glob("only-*.png")
    }
    imported, (dropped, last) = walk["imported"], walk["dropped"]
    expected = {"splats": 9_939, "cameras": 72 + 1, "turned": False, "size": [240, 160]}
    assert imported == walk["upright False"] == walk["05-camera"] == walk["12-back"] == expected
    assert walk["upright True"] == {**imported, "turned": True}
    assert (dropped["cameras"], last) == (1 + 2 * 72, "REFINE_OT_import_cameras")
    assert not walk["cube"]
    assert psnr(shown["camera"], _center(reference(walk["numbers"], few))) > 30.0
    assert walk["priced"]["sentence"].startswith("Keeps 4,970 of 9,939, ")
    assert 0 < walk["lasso"] == walk["selected again"]
    assert walk["11-deleted"]["splats"] == 9_939 - walk["lasso"]
    assert psnr(shown["deleted"], shown["camera"]) < 35.0
    cropped = walk["15-cropped"]["splats"]
    assert 1_000 < cropped < 9_000
    assert walk["17-applied"]["splats"] == walk["19-redone"]["splats"] == cropped - cropped // 2
    assert psnr(shown["applied"], shown["cropped"]) > 25.0
    for one, other in (
        *(("scored", "camera"), ("back", "camera"), ("undone", "cropped"), ("redone", "applied")),
        ("reopened", "redone"),
    ):
        assert psnr(shown[one], shown[other]) > 45.0, one

    assert again["enabled"]
    assert again["20-reopened"] == walk["19-redone"]
    assert len(read_ply(asset)) == cropped - cropped // 2
    assert psnr(shown["reopened"], _center(reference(again["numbers"], asset))) > 30.0


def _center(picture: np.ndarray) -> np.ndarray:
    """Return the middle of a picture of a view, beside panels."""
    height, width = picture.shape[:2]
    return picture[height // 4 : 3 * height // 4, width // 4 : 3 * width // 5]
