"""The panel imports and exports every format that core knows."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

ROOM = Path(__file__).parents[1] / "data/room_small"


@pytest.fixture
def small(addon, tmp_path):
    """Return the path of 500 splats of the room, with harmonics of degree 3."""
    file = addon.core.read_ply(ROOM / "point_cloud.ply")
    file.write(tmp_path / "small.ply", np.arange(len(file)) < 500)
    return tmp_path / "small.ply"


def suffixes(addon):
    """Return the endings of all formats that are written."""
    return addon.core.formats.registry.SUFFIXES


def test_every_format_is_exported_and_imported(addon, small, tmp_path):
    """Blender writes what core writes of the same splats, and holds what core reads of it."""
    bpy.ops.refine.import_ply(filepath=str(small))
    source = bpy.context.object
    core = addon.core
    for suffix in suffixes(addon):
        bpy.context.view_layer.objects.active = source
        made, expected = tmp_path / f"panel{suffix}", tmp_path / f"core{suffix}"
        bpy.ops.refine.export_ply(filepath=str(made))
        core.write_splats(expected, core.read_ply(small))

        bpy.ops.refine.import_ply(filepath=str(made))

        read = core.read_splats(made)
        layout = addon.mesh.layout.check(bpy.context.object)
        stored = addon.mesh.attributes.stored_columns(layout)
        assert made.read_bytes() == expected.read_bytes()
        assert len(read) == len(layout) == 500
        for name in read.rows.dtype.names:
            assert np.array_equal(stored[name], read.rows[name]), name


def test_the_file_name_follows_the_format_that_is_chosen(addon):
    """The suffix of another format is replaced, also one with two dots; one that is typed chooses.

    `check` is what the file browser calls when an option or the name changes.
    """

    class Browser:
        check = addon.ui.export_operators.REFINE_OT_export_ply.check

    browser = Browser()
    browser.filepath, browser.suffix, browser.settled = "a.compressed.ply", ".spz", ".ply"
    changed = browser.check(None), browser.filepath, browser.check(None)
    browser.suffix = ".compressed.ply"
    browser.check(None)
    chosen = browser.filepath
    browser.filepath = "b.SPLAT"
    typed = browser.check(None), browser.filepath, browser.suffix
    browser.filepath = "c"
    browser.check(None)

    assert changed == (True, "a.spz", False)
    assert chosen == "a.compressed.ply"
    assert typed == (True, "b.splat", ".splat")
    assert browser.filepath == "c.splat"


def test_all_formats_can_be_dropped_and_picked(addon):
    """The file handler and both file browsers know every ending."""
    handler = addon.ui.import_operators.REFINE_FH_ply.bl_file_extensions.split(";")
    globs = [
        operator.get_rna_type().properties["filter_glob"].default.split(";")
        for operator in (bpy.ops.refine.import_ply, bpy.ops.refine.export_ply)
    ]

    read = addon.core.formats.registry.READ_SUFFIXES
    assert set(handler) == {Path(f"a{suffix}").suffix for suffix in read} - {".json"}
    assert globs == [[f"*{end}" for end in read], [f"*{end}" for end in suffixes(addon)]]


@pytest.mark.usefixtures("addon")
def test_a_level_of_a_streamed_sog_is_imported():
    """76 of 151 splats and 15 of the environment, in an object of its folder's name."""
    path = ROOM.parent / "other_tools/streamed/lod-meta.json"

    bpy.ops.refine.import_ply(filepath=str(path), level=1)

    assert len(bpy.context.object.data.vertices) == 76 + 15
    assert bpy.context.object.name == "streamed"


@pytest.mark.parametrize("name", ["a/lod-meta.json", "META.JSON", "a/transforms.json"])
def test_a_json_file_that_is_dropped_is_one_of_splats_by_its_name(addon, monkeypatch, name):
    """The handler of .json is that of cameras, which hands over an index of splats."""
    cls, called = addon.ui.import_operators.REFINE_OT_import_cameras, []
    operators = SimpleNamespace(import_ply=lambda *given, **named: called.append((given, named)))
    monkeypatch.setattr(addon.ui.import_operators.bpy.ops, "refine", operators, raising=False)
    properties = SimpleNamespace(filepath=name, is_property_set=lambda _: True)
    operator = SimpleNamespace(
        properties=properties, invoke_popup=lambda _: {"ASKED"}, upright=False
    )

    answer = cls.invoke(operator, bpy.context, None)

    expected = [(("INVOKE_DEFAULT",), {"filepath": name})] if "transf" not in name else []
    assert called == expected
    assert (answer == {"ASKED"}) == (not expected)


def test_an_object_is_pruned_to_a_size_in_another_format(addon, small, tmp_path):
    """3,200 bytes hold 100 splats of a .splat; the size of a .spz does not follow from them."""
    bpy.ops.refine.import_ply(filepath=str(small))
    core, views = addon.core, addon.core.read_cameras(ROOM / "cameras.json")
    prune, name = addon.objects.splat_group.prune_object, bpy.context.object.name

    report = prune(name, views, core.Budget(max_mb=0.0032), output=tmp_path / "a.splat")

    assert len(core.read_splats(tmp_path / "a.splat")) == report["splats"]["kept"] == 100
    assert report["files"]["output_bytes"] == 3200
    with pytest.raises(core.RefineError, match=r"a size cannot be kept to in \.spz"):
        prune(name, views, core.Budget(max_mb=1.0), output=tmp_path / "a.spz")


def test_the_images_of_blender_are_those_of_pillow(addon):
    """What one writes the other reads, to the bit: any bytes, where alpha is not 0."""
    random = np.random.default_rng(0)
    pixels = random.integers(0, 256, (12, 20, 4), np.uint8)
    pixels[..., 3] |= 1
    pillow, blender = addon.core.images._Pillow(), addon.main_thread.BlenderImages()
    before = len(bpy.data.images)

    for writer in (pillow, blender):
        data = writer.encode(pixels)
        for reader in (pillow, blender):
            assert reader.size(data) == (20, 12)
            assert np.array_equal(reader.decode(data), pixels)

    assert len(bpy.data.images) == before
    for reader in (pillow, blender):
        for broken in (b"", b"RIFF1234WEBPVP8L", data[:40]):
            with pytest.raises(ValueError, match=r"."):
                reader.decode(broken)
