"""What the file of an object holds, compared with what the cameras see of the object."""

from __future__ import annotations

import bpy
import numpy as np
import pytest
from mathutils import Euler, Matrix


def test_the_file_of_a_moved_object_is_compared_where_the_object_stands(
    addon, room, room_cameras, room_views, tmp_path  # noqa: ARG001
):  # fmt: skip
    """Glb keeps single precision, so its file is as close as the splats kept; object moved."""
    core = addon.core
    addon.mesh.edit.delete_vertices(room, np.arange(len(room.data.vertices)) % 10 != 0)
    move = Matrix.Translation((1, 2, 3)) @ Euler((0.3, 0.2, 0.1)).to_matrix().to_4x4()
    for obj in (room, *(o for o in bpy.data.objects if o.type == "CAMERA")):
        obj.matrix_world = move @ obj.matrix_world
    bpy.context.view_layer.update()
    views = addon.cameras.sets.Choice("VISIBLE").views(bpy.context, None).take(range(0, 72, 6))

    report = addon.splat_object.prune_object(
        "room", views, core.Budget(ratio=0.3), core.Settings("occlusion"),
        output=tmp_path / "a.glb",
    )  # fmt: skip

    assert report["written_psnr"] == pytest.approx(report["estimated_psnr"], abs=0.05)
