"""The guide's walk from a raw capture to a clean asset, and its pictures."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import numpy as np
from blenders import PROJECT
from PIL import Image

from benchmarks.tables.floaters import floaters
from benchmarks.tables.million import write_ply
from refine_addon.core.cameras.read import read_cameras
from refine_addon.core.formats.ply import read_ply
from refine_addon.core.splats import joined

if TYPE_CHECKING:
    from pathlib import Path

    from blenders import Binary

PICTURES = PROJECT / "docs" / "walk"
TAKEN = PROJECT / "build" / "e2e"

# Of the brightness of a pixel, and of the pixels that may differ by more: panels that are worded
# otherwise differ in more of them, two runs in fewer.
LIKE, UNLIKE = 40, 0.01


def test_the_guides_walk_and_its_pictures(same_binary: Binary, cloud: Path, cameras: Path):
    """Floaters in the room: most are found, 70 % of what is left goes, the asset is written.

    The pictures of docs/walk show the same; REFINE_PICTURES=1 takes them anew.
    """
    raw, asset = same_binary.work / "capture.ply", same_binary.work / "asset.spz"
    room = read_ply(cloud).splats()
    made, kinds = floaters(room, read_cameras(cameras), seed=1)
    few = made.take(kinds < 2)  # a hundred veils would leave nothing to see
    write_ply(raw, joined([room, few]))

    found = same_binary.window_step(
        "walk",
        size=(1280, 800),
        cloud=raw,
        cameras=cameras,
        output=asset,
        picture=same_binary.work / "{}.png",
    )

    assert found["imported"] == len(room) + len(few)
    assert len(room) - 100 < found["cleaned"] < len(room) + 400
    assert found["applied"] == found["cleaned"] - int(0.7 * found["cleaned"])
    assert asset.stat().st_size < 0.1 * raw.stat().st_size
    taken = sorted(same_binary.work.glob("*.png"))
    assert len(taken) == 5
    if os.environ.get("REFINE_PICTURES"):
        _keep(taken)
    TAKEN.mkdir(parents=True, exist_ok=True)
    for path in taken:
        path.rename(TAKEN / f"walk-{path.name}")
    unlike = {path.stem: _unlike(TAKEN / f"walk-{path.name}") for path in taken}
    assert max(unlike.values()) < UNLIKE, f"{unlike}: take the guide's pictures anew"


def _keep(taken: list[Path]) -> None:
    PICTURES.mkdir(exist_ok=True)
    for path in taken:
        with Image.open(path) as picture:
            picture.convert("RGB").save(PICTURES / f"{path.stem}.jpg", quality=85)


def _unlike(path: Path) -> float:
    """Return the share of pixels in which a picture differs from that of the guide."""
    stem = path.stem.removeprefix("walk-")
    with Image.open(path) as taken, Image.open(PICTURES / f"{stem}.jpg") as shown:
        pair = [np.asarray(image.convert("RGB"), np.int16) for image in (taken, shown)]
    return float(np.mean(np.abs(pair[0] - pair[1]).max(axis=2) > LIKE))
