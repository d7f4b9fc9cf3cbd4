"""The panel's operators of the installed zip, one after the other, in every Blender."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from blenders import Blender
from splat_rows import rows, rows_in


def test_import_score_apply_export(blender: Blender, cloud: Path, cameras: Path, pruned: Path):
    """39,755 - floor(39,755 / 2) = 19,878 rows of the file stay, bit for bit and in their order.

    They are those that the command keeps, but for ties: Blender's cameras are float32.
    """
    output = blender.work / "pruned.ply"

    found = blender.step("prune", cloud=cloud, cameras=cameras, output=output)

    assert found == {"imported": 39_755, "cameras": 72, "scored": True, "kept": 19_878}
    before, after = rows(cloud), rows(output)
    assert after.dtype == before.dtype
    assert after.tobytes() == before[rows_in(after, before)].tobytes()
    assert np.count_nonzero(rows_in(after, rows(pruned))) >= 0.999 * len(after)


def test_views_are_measured_in_processes_of_blenders_python(
    blender: Blender, cloud: Path, cameras: Path
):
    """Two were asked for. They find the extension under its name, and are not Blender itself."""
    found = blender.step("processes", cloud=cloud, cameras=cameras)

    assert found["processes"] == 2, found


def test_a_point_cloud_is_pruned_and_saved(blender: Blender, cloud: Path, cameras: Path):
    """19,878 rows stay; the export has the means of as many rows of the file, bit for bit."""
    out = blender.work / "output.ply"

    found = blender.step(
        "native", cloud=cloud, cameras=cameras, blend=blender.work / "native.blend", output=out
    )

    counts = {"points": 39_755, "kept": 19_878}
    assert found == {"type": "POINTCLOUD", **counts}
    before, output = rows(cloud), rows(out)
    places = [np.stack([table[axis] for axis in "xyz"], axis=1) for table in (before, output)]
    means = {row.tobytes() for row in places[0]}
    assert output.dtype == before.dtype
    assert all(row.tobytes() in means for row in places[1])
