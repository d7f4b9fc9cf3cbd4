"""Panel, command and Python of the installed zip keep the same splats, in every Blender."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from blenders import MANIFEST, Blender
from compared import fewer, rows, rows_in


def test_all_that_needs_no_window_works_in_every_version(
    blender: Blender, cloud: Path, cameras: Path, pruned: Path
):
    """39,755 - floor(39,755 / 2) = 19,878 rows of the file stay, bit for bit and in their order.

    The command writes the file that it writes without Blender: other Pythons and NumPys must not
    tell. Operators keep those rows, but for ties: Blender's cameras are float32. Views are measured
    in two processes, as asked for. What Ctrl+A and Ctrl+J ruin is mended within rounding.
    """
    work = blender.work
    found = blender.step(
        "every_version", cloud=cloud, few=fewer(cloud, work), cameras=cameras, folder=work
    )

    # Neither the checkout nor a plyfile of the machine is what is tested.
    assert all(Path(place).is_relative_to(blender.resources) for place in found["places"])
    assert f"./wheels/plyfile-{found['plyfile']}-py3-none-any.whl" in MANIFEST["wheels"]
    assert found["code"] == 0
    assert (work / "command.ply").read_bytes() == pruned.read_bytes()
    assert found["processes"] == 2

    before, mesh = rows(cloud), rows(work / "MESH.ply")
    native = rows(work / "POINTCLOUD.ply")
    for form in ("MESH", "POINTCLOUD"):
        assert found[form] == [form, 39_755, 72, 19_878]
    assert mesh.dtype == native.dtype == before.dtype
    assert mesh.tobytes() == before[rows_in(mesh, before)].tobytes()
    assert np.count_nonzero(rows_in(mesh, rows(pruned))) >= 0.999 * len(mesh)
    means, kept = (np.stack([table[axis] for axis in "xyz"], axis=1) for table in (before, native))
    assert {row.tobytes() for row in kept} <= {row.tobytes() for row in means}

    assert found["mended"].keys() == {"MESH apply", "MESH join", "POINTCLOUD apply"}
    for step, (said, still, apart) in found["mended"].items():
        assert said, step
        assert still == [], step
        assert apart < 1e-5, step
