"""What the file of an object holds, compared with what the cameras see of the object."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix


def test_the_file_of_a_moved_object_is_compared_where_the_object_stands(
    addon, room, room_cameras, room_views, tmp_path
):  # fmt: skip
    """Glb keeps single precision, so its file is as close as the splats kept; object moved."""
    core = addon.core
    addon.mesh.edit.delete_vertices(room, np.arange(len(room.data.vertices)) % 10 != 0)
    move = Matrix.Translation((1, 2, 3)) @ Euler((0.3, 0.2, 0.1)).to_matrix().to_4x4()
    for obj in (room, *(o for o in bpy.data.objects if o.type == "CAMERA")):
        obj.matrix_world = move @ obj.matrix_world
    bpy.context.view_layer.update()
    views = addon.cameras.CameraChoice("VISIBLE").views(bpy.context).take(range(0, 72, 6))

    report = addon.objects.splat_group.prune_object(
        "room", views, core.Budget(ratio=0.3), core.Occlusion(), output=tmp_path / "a.glb"
    )

    assert report["written_psnr"] == pytest.approx(report["estimated_psnr"], abs=0.05)


@pytest.mark.parametrize("dry_run", [False, True])
def test_the_report_of_an_object_counts_what_the_file_holds(
    addon, room, room_views, tmp_path, dry_run
):
    """Three splats at NaN stay at a ratio of 0; `.splat` cannot hold them, and the note says so."""
    core, out = addon.core, tmp_path / "a.splat"
    for vertex in room.data.vertices[:3]:
        vertex.co.x = np.nan

    report = addon.objects.splat_group.prune_object(
        "room",
        room_views.take(range(4)),
        core.Budget(ratio=0.0),
        core.ClosedForm(),
        dry_run=dry_run,
        output=out,
    )

    count = len(room.data.vertices)
    assert report["splats"]["left_out"] == 3
    assert report["splats"]["written"] == (None if dry_run else count - 3)
    assert any("3 of the kept splats cannot be drawn" in note for note in report["notes"])
    assert dry_run or len(core.read_splats(out)) == count - 3
