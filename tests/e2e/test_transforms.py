"""What artists do to objects leaves splats as they look, or is said and mended by one click."""

from __future__ import annotations

from pathlib import Path

from blenders import Binary, Blender
from view_pictures import fewer, psnr, view_in

KEPT = {
    *("apply mended", "undo", "redo", "baked", "duplicate", "linked duplicate", "single user"),
    *("parent", "parent inverse", "mirror mended", "append", "link", "parted for join"),
    *("join mended", "edit mode", "reopened"),
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
    few = fewer(cloud, binary.work)
    told = binary.window_step(
        "transforms",
        size=(900, 600),
        cloud=few,
        cameras=cameras,
        picture=binary.work / "transforms-{}.png",
        blend=binary.work / "saved.blend",
    )

    assert told["failure"] == ""
    assert {name for name in KEPT if told[name]} == set()
    assert {name for name in RUINED | {"turned", "turned back"} if not told[name]} == set()
    assert told["foreign"][0].startswith("9,939 splats were transformed")
    assert told["foreign undone"] == []
    shown = {
        name: view_in(told["region"], binary.work / f"transforms-{name}.png")
        for name in KEPT | RUINED | {"start"}
    }
    close = {name: psnr(shown["start"], shown[name]) for name in KEPT | RUINED}
    assert {name: db for name, db in close.items() if (db < 45.0) == (name in KEPT)} == {}
    assert max(close[name] for name in RUINED) < 35.0


def test_what_blender_applied_or_joined_is_mended_in_every_version(blender: Blender, cloud: Path):
    """Means, covariances and harmonics come back within rounding, of meshes and point clouds."""
    few = fewer(cloud, blender.work)

    found = blender.step("mend", cloud=few)

    steps = {"MESH blenders_apply", "MESH blenders_join", "POINTCLOUD blenders_apply"}
    assert found.keys() == steps
    for step, (said, apart) in found.items():
        assert apart < 1e-5, step
        assert said
        assert not any(sentence.startswith("still") for sentence in said)
