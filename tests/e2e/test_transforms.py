"""What artists do to objects leaves splats as they look, or is said and mended by one click."""

from __future__ import annotations

from pathlib import Path

from blenders import Binary
from compared import fewer, psnr, view_in

KEPT = {
    *("apply mended", "undo", "redo", "baked", "duplicate", "linked duplicate", "parent"),
    *("append", "link", "parted for join", "join mended", "reopened"),
}
RUINED = {"ruined by apply", "ruined by join", "ruined and reopened"}
"""Steps after which the picture is, and is not, what it was at the start."""


def test_splats_look_as_before_whatever_is_done_to_their_object(
    binary: Binary, cloud: Path, cameras: Path
):
    """At least 45 dB between the window before and after, 8 bits each; nothing is said then.

    What Blender's own operators ruin is below 35 dB, and the panel says so until it is mended.
    """
    told = binary.window_step(
        "transforms", size=(900, 600), cloud=fewer(cloud, binary.work), cameras=cameras,
        pictures=binary.work, blend=binary.work / "saved.blend",
    )  # fmt: skip

    assert told["failure"] == ""
    assert {name for name in KEPT if told[name]} == set()
    assert {name for name in RUINED if not told[name]} == set()
    shown = {
        name: view_in(told["region"], binary.work / f"transforms-{name}.png")
        for name in KEPT | RUINED | {"start"}
    }
    close = {name: psnr(shown["start"], shown[name]) for name in KEPT | RUINED}
    assert {name: db for name, db in close.items() if name in KEPT and db < 45.0} == {}
    assert max(close[name] for name in RUINED) < 35.0
