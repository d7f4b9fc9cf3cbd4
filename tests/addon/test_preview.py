"""The preview shows splats, and leaves the mesh as it was."""

from __future__ import annotations

import bpy
import numpy as np
import pytest

from tests.strategies import ply_of


def _evaluated(obj):
    """Return the points that a preview draws."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    return [
        instance.object.data
        for instance in depsgraph.object_instances
        if instance.parent == obj.evaluated_get(depsgraph) or instance.object.original == obj
    ]


def test_turning_it_off_leaves_nothing_behind(addon, room, unchanged):
    """No modifier, no attribute, no node group, no material."""
    unchanged.start()
    bpy.ops.refine.preview(mode="COLOR")
    shown = addon.ui.preview.shown(room)
    bpy.ops.refine.preview(mode="OFF")

    assert shown == "COLOR"
    unchanged()


def test_a_heat_map_needs_scores(room, unchanged):  # noqa: ARG001
    """The message says what to do first."""
    unchanged.start()
    with pytest.raises(RuntimeError, match="score it first"):
        bpy.ops.refine.preview(mode="HEAT")
    unchanged()


def test_two_objects_share_one_preview_and_lose_it_one_by_one(addon, room):
    """The node group goes with its last user."""
    other = bpy.data.objects.new("other", room.data.copy())
    bpy.context.scene.collection.objects.link(other)
    for obj in (room, other):
        addon.ui.preview.show(obj, "COLOR")
    groups = [len(bpy.data.node_groups)]
    addon.ui.preview.hide(room)
    groups.append(len(bpy.data.node_groups))
    addon.ui.preview.hide(other)
    groups.append(len(bpy.data.node_groups))

    assert groups == [1, 1, 0]


def test_the_preview_outlives_an_apply(addon, room, room_cameras):  # noqa: ARG001
    """What is left is shown: an instance for each of 19,878 splats."""
    bpy.ops.refine.score()
    bpy.ops.refine.preview(mode="HEAT")
    bpy.ops.refine.apply()
    instances = bpy.context.evaluated_depsgraph_get().object_instances

    assert addon.ui.preview.shown(room) == "HEAT"
    assert sum(instance.is_instance for instance in instances) == len(room.data.vertices) == 19878


def test_a_preview_of_another_version_is_made_anew(addon, room):
    """As in an old .blend: emptied trees without a version, or of another, show splats again.

    An object that shows them already follows, as node group and material stay the same ones.
    """
    modifier = addon.ui.preview.show(room, "COLOR")
    tree, material = modifier.node_group, bpy.data.materials["REFINE color splats"]
    nodes, drawn = (len(tree.nodes), len(material.node_tree.nodes)), len(_evaluated(room))
    for version in (None, "0.0.1"):
        for made in (tree, material):
            del made["refine_version"]
            if version:
                made["refine_version"] = version
        tree.nodes.clear()
        tree.interface.clear()
        material.node_tree.nodes.clear()
        again = addon.ui.preview.show(room, "COLOR")

        assert again.node_group == modifier.node_group == tree
        assert (len(tree.nodes), len(material.node_tree.nodes)) == nodes
        assert len(_evaluated(room)) == drawn > 0
    assert [group.name for group in bpy.data.node_groups] == [tree.name]


def test_what_was_changed_by_hand_in_a_preview_stays(addon, room):
    """Shown once more by the same version, the node group is as it was left."""
    tree = addon.ui.preview.show(room, "COLOR").node_group
    tree.nodes.new("GeometryNodeTransform").name = "mine"
    addon.ui.preview.show(room, "COLOR")

    assert "mine" in tree.nodes


def _render(path):
    scene = bpy.context.scene
    scene.render.filepath = str(path)
    bpy.ops.render.render(write_still=True)
    image = bpy.data.images.load(str(path))
    image.colorspace_settings.name = "Non-Color"  # the file's own numbers, 0..1
    pixels = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(pixels)
    return pixels.reshape(image.size[1], image.size[0], 4)[::-1]


def test_a_rendered_splat_is_a_gaussian(addon, core, tmp_path):
    """One round white splat of standard deviation .5 at 4 m before a 240 px camera of f 333.3.

    A ray ``p`` pixels off the axis passes the centre at ``4 sin(atan(p / 333.3))`` metres. Opacity
    is .8 in the middle, at 42 px (.5 m, one standard deviation) .8 exp(-.5) = .485, and in the
    corner, at 140 px (1.55 m, 3.1 of them), .8 exp(-4.8) = .0066: as white light on black and in
    sRGB 231, 185 and 20 of 255.
    """
    rest = {name: np.zeros(1, np.float32) for name in ("x", "y", "rot_1", "rot_2", "rot_3")}
    columns = {
        **rest,
        "z": np.full(1, -4.0, np.float32),
        **{f"f_dc_{i}": np.full(1, 0.5 / core.splats.SH_C0, np.float32) for i in range(3)},
        "opacity": np.full(1, np.log(4.0), np.float32),
        **{f"scale_{i}": np.full(1, np.log(0.5), np.float32) for i in range(3)},
        "rot_0": np.ones(1, np.float32),
    }
    (tmp_path / "one.ply").write_bytes(ply_of(columns))
    bpy.ops.refine.import_ply(filepath=str(tmp_path / "one.ply"))
    scene = bpy.context.scene
    scene.camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(scene.camera)
    addon.ui.preview.show(bpy.context.object, "COLOR")
    addon.ui.preview.set_up_render(scene)
    image = _render(tmp_path / "one.png")

    assert abs(image[80, 120, 0] - 231 / 255) < 0.02
    assert abs(image[80, 120 + 42, 0] - 185 / 255) < 0.03
    assert abs(image[80 - 42, 120, 0] - 185 / 255) < 0.03
    assert abs(image[2, 2, 0] - 20 / 255) < 0.02


def test_the_button_for_renders_sets_up_splats_and_scene(room):
    """The style of true Gaussians, Cycles, and colours as they are; *Off* takes the first back."""
    bpy.ops.refine.preview(mode="COLOR")
    scene = bpy.context.scene
    shown = room.modifiers["REFINE preview"].node_group.name
    bpy.ops.refine.preview(mode="OFF")

    assert shown == "REFINE color splats"
    assert (scene.render.engine, scene.view_settings.view_transform) == ("CYCLES", "Standard")
    assert not room.modifiers
