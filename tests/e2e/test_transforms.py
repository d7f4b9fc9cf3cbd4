"""What artists do to objects leaves splats as they look, or is said and mended by one click."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

import numpy as np
from blenders import PROJECT
from PIL import Image

from refine_addon.core.formats.ply import read_ply

if TYPE_CHECKING:
    from pathlib import Path

    from blenders import Binary, Blender

PICTURES = PROJECT / "build" / "e2e"
KEPT = {
    *("apply mended", "undo", "redo", "baked", "duplicate", "linked duplicate", "single user"),
    *("parent", "parent inverse", "mirror mended", "append", "link", "parted for join"),
    *("parted for join mended", "join mended", "join", "edit mode", "reopened"),
}
"""Steps after which the picture is what it was at the start."""

RUINED = {"ruined by apply", "ruined by mirror", "ruined by join", "ruined and reopened"}
"""Steps after which it is not."""


def test_splats_look_as_before_whatever_is_done_to_their_object(
    binary: Binary, cloud: Path, cameras: Path
):
    """At least 45 dB between the window before and after, 8 bits each; nothing is said then.

    What Blender's own operators ruin is below 35 dB, and the panel says so until it is mended; also
    of splats that Blender's own importer brought.
    """
    few = _fewer(cloud, binary.work)
    try:
        told = binary.window_step(
            "transforms",
            size=(900, 600),
            cloud=few,
            cameras=cameras,
            picture=binary.work / "transforms-{}.png",
            blend=binary.work / "saved.blend",
        )
    finally:
        PICTURES.mkdir(parents=True, exist_ok=True)
        for picture in binary.work.glob("*.png"):
            shutil.copy(picture, PICTURES / f"{binary.name}-{picture.name}")

    assert told["failure"] == ""
    assert {name for name in KEPT if told[name]} == set()
    assert {name for name in RUINED | {"turned", "turned back"} if not told[name]} == set()
    assert told["foreign"][0].startswith("9,939 splats were transformed")
    assert told["foreign undone"] == []
    start = _picture(binary.work, "start", told["region"])
    close = {
        name: _psnr(start, _picture(binary.work, name, told["region"])) for name in KEPT | RUINED
    }
    assert {name: db for name, db in close.items() if (db < 45.0) == (name in KEPT)} == {}
    assert max(close[name] for name in RUINED) < 35.0


def _fewer(cloud: Path, folder: Path) -> Path:
    """Write every fourth splat of a file to another."""
    file = read_ply(cloud)
    file.write(folder / "few.ply", np.arange(len(file)) % 4 == 0)
    return folder / "few.ply"


def _picture(folder: Path, name: str, region: dict) -> np.ndarray:
    """Return what the view shows in a picture of the screen, 0..1."""
    (width, height), left, top = region["size"], region["left"], region["top"]
    with Image.open(folder / f"transforms-{name}.png") as picture:
        screen = np.asarray(picture.convert("RGB")) / 255.0
    return screen[top : top + height, left : left + width]


def _psnr(one: np.ndarray, other: np.ndarray) -> float:
    """Return how close pictures are, dB; 99 if they are the same."""
    error = np.mean((one - other) ** 2)
    return float(-10.0 * np.log10(error)) if error else 99.0


def test_what_blender_applied_or_joined_is_mended_in_every_version(blender: Blender, cloud: Path):
    """Means, covariances and harmonics come back within rounding, of meshes and point clouds.

    All 2 x 9,939 splats are named; where Blender cannot join point clouds, ours does.
    """
    few = _fewer(cloud, blender.work)

    found = blender.step("mend", cloud=few)

    kinds = {"MESH", "POINTCLOUD"}
    assert found.keys() >= {
        f"{kind} {step}" for kind in kinds for step in ("blenders_apply", "ours")
    }
    assert "MESH blenders_join" in found
    for step, (said, apart) in found.items():
        assert apart < 1e-5, step
        assert (said == []) == step.endswith("ours")
        assert not any(sentence.startswith("still") for sentence in said)
