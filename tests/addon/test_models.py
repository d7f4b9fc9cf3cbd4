"""How the splats of objects are drawn: from import to export, and by the box of the panel."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from tests.e2e.inside.clouds import as_cloud
from tests.strategies import ply_of

from .conftest import applied, export


@pytest.fixture
def discs(addon, make_splats, tmp_path):
    """Import splats without a third scale; return the object and its file."""
    columns = make_splats(40, degree=1)
    del columns["scale_2"]
    path = tmp_path / "discs.ply"
    path.write_bytes(ply_of(columns))
    bpy.ops.refine.import_ply(filepath=str(path))
    return bpy.context.object, path


def imported(columns, path, *comments):
    """Import a file with these comments; return the object."""
    path.write_bytes(ply_of(columns, comments=comments))
    bpy.ops.refine.import_ply(filepath=str(path))
    return bpy.context.object


@pytest.mark.parametrize("comment", ["SplatRenderMode: mip", "antialiased 1"])
def test_the_tag_of_a_file_goes_with_the_object_to_the_file(addon, make_splats, tmp_path, comment):
    obj = imported(make_splats(20), tmp_path / "in.ply", comment)
    checked = addon.mesh.layout.check(obj)

    export(addon, checked, tmp_path / "out.ply")

    assert bpy.context.scene.refine.model == "antialiased"
    assert addon.objects.splat_group.gather([checked]).model == "antialiased"
    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()


def test_discs_go_through_an_object_as_they_are(addon, discs, tmp_path):
    """Without a third scale, in a mesh and in a point cloud of Blender's own splats."""
    obj, path = discs
    expected = addon.core.read_ply(path).splats()

    export(addon, addon.mesh.layout.check(obj), tmp_path / "out.ply")
    cloud = as_cloud(addon, obj)
    checked = addon.mesh.layout.check(cloud)
    export(addon, checked, tmp_path / "cloud.ply")

    assert (tmp_path / "out.ply").read_bytes() == path.read_bytes()
    got = addon.core.read_ply(tmp_path / "cloud.ply").splats()
    assert got.model == expected.model == checked.layout.model == "2dgs"
    np.testing.assert_allclose(got.log_scales, expected.log_scales, rtol=1e-6)


def test_discs_are_turned_and_merged(addon, discs, tmp_path, room_views):
    """A turn of the object, baked into the file, and merging leave discs."""
    obj, _ = discs
    obj.rotation_euler = (0.3, 0.2, 0.1)
    bpy.context.view_layer.update()
    checked = addon.mesh.layout.check(obj)
    export(addon, checked, tmp_path / "turned.ply", apply_transform=True)
    turned = addon.core.read_ply(tmp_path / "turned.ply").splats()
    expected = addon.objects.splat_group.gather([checked], whole=True)
    np.testing.assert_allclose(turned.means, expected.means, rtol=1e-5)
    assert turned.model == "2dgs"

    result = addon.core.prune(
        expected, room_views, addon.core.Budget(ratio=0.5), addon.core.Refit(rounds=1)
    )
    assert result.merged is not None
    applied(addon, checked, result)

    left = addon.mesh.layout.check(obj)
    assert (len(left), left.layout.model) == (20, "2dgs")
    assert "scale_2" not in obj.data.attributes


def test_the_box_says_how_an_object_is_drawn_and_its_file_too(addon, make_splats, tmp_path):
    """Where the file said nothing; what looks the same with another word has another digest."""
    obj = imported(make_splats(20), tmp_path / "in.ply")
    before = addon.mesh.attributes.digest(addon.mesh.layout.check(obj))
    assert bpy.context.scene.refine.model == "default"

    bpy.context.scene.refine.model = "antialiased"

    checked = addon.mesh.layout.check(obj)
    assert checked.layout.model == bpy.context.scene.refine.model == "antialiased"
    assert addon.mesh.attributes.digest(checked) != before
    export(addon, checked, tmp_path / "out.ply")
    assert addon.core.read_ply(tmp_path / "out.ply").model == "antialiased"


def test_objects_of_different_models_are_no_scene(addon, make_splats, tmp_path, unchanged):
    one = imported(make_splats(20), tmp_path / "one.ply", "SplatRenderMode: mip")
    other = imported(make_splats(20), tmp_path / "other.ply")
    group = [addon.mesh.layout.check(obj) for obj in (one, other)]
    unchanged.start()

    with pytest.raises(addon.core.RefineError, match="different models"):
        addon.objects.splat_group.gather(group)

    unchanged()
