"""Files in the panel: every format that core knows, and how their splats are drawn."""

from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from tests.e2e.inside.clouds import as_cloud
from tests.strategies import ply_of

from .conftest import ROOM, applied, export, read, splats_of


def test_every_format_is_exported_and_imported(addon, few, few_file, tmp_path):
    """Blender writes what core writes of the same splats, and holds what core reads of it."""
    core = addon.core
    for suffix in core.formats.registry.SUFFIXES:
        bpy.context.view_layer.objects.active = few
        made, expected = tmp_path / f"panel{suffix}", tmp_path / f"core{suffix}"
        bpy.ops.refine.export_ply(filepath=str(made))
        core.write_splats(expected, core.read_ply(few_file))
        bpy.ops.refine.import_ply(filepath=str(made))

        read = core.read_splats(made)
        layout = addon.mesh.layout.check(bpy.context.object)
        stored = dict(addon.mesh.attributes.read_columns(layout, read.rows.dtype.names))
        assert made.read_bytes() == expected.read_bytes()
        assert len(read) == len(layout) == 3976
        for name in read.rows.dtype.names:
            assert np.array_equal(stored[name], read.rows[name]), name


def test_an_spz_is_turned_as_asked_or_by_cameras_beside_it_and_turned_back(addon, room, tmp_path):
    """Half a turn about x. Without either it stands, and how the cameras fit is not known."""
    made, again = tmp_path / "a.spz", tmp_path / "b.spz"
    (tmp_path / "cameras.json").symlink_to(ROOM / "cameras.json")
    bpy.ops.refine.export_ply(filepath=str(made), spz_y_up=True)
    for asked, signs in ({"cameras": True}, 1), ({"spz_y_up": True}, 1), ({}, [1, -1, -1]):
        bpy.ops.refine.import_ply(filepath=str(made), **asked)
        obj = bpy.context.object
        bpy.ops.refine.export_ply(filepath=str(again), overwrite=True)
        views = addon.cameras.CameraChoice.of_scene(bpy.context.scene).views(bpy.context, obj)
        means = addon.core.read_splats(made, axes="rub").splats().means

        assert np.array_equal(read(addon, obj, "position"), means * signs)
        assert np.array_equal(addon.core.read_splats(again, axes="rub").splats().means, means)
        assert views.turn == (0 if asked else None)


def test_all_formats_can_be_dropped_and_picked(addon):
    """The file handlers and browsers know every ending."""
    module, registry = addon.ui.import_operators, addon.core.formats.registry
    shown = {
        name: getattr(bpy.ops.refine, name).get_rna_type().properties["filter_glob"].default
        for name in ("import_ply", "export_ply", "import_cameras")
    }
    handled = set(module.REFINE_FH_ply.bl_file_extensions.split(";"))

    assert shown["import_ply"] == ";".join(f"*{end}" for end in registry.READ_SUFFIXES)
    assert shown["export_ply"] == ";".join(f"*{end}" for end in registry.SUFFIXES)
    assert handled == {Path(f"a{end}").suffix for end in registry.READ_SUFFIXES} - {".json"}
    assert module.REFINE_FH_cameras.bl_file_extensions == shown["import_cameras"].replace("*", "")


@pytest.mark.parametrize(
    ("typed", "name"), [("a", "a.ply"), ("a.SPZ", "a.spz"), ("a.ksplat", "a.ply")]
)
def test_a_typed_suffix_chooses_the_format_if_it_is_written(addon, typed, name):
    """*Format* has no entry for one that is only read."""
    browser = SimpleNamespace(filepath=typed, suffix=".ply", settled=".ply")
    addon.ui.export_operators.REFINE_OT_export_ply.check(browser, bpy.context)
    assert (browser.filepath, browser.suffix) == (name, name[1:])


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
    module, called = addon.ui.import_operators, []
    operators = SimpleNamespace(import_ply=lambda *given, **named: called.append((given, named)))
    monkeypatch.setattr(module.bpy.ops, "refine", operators, raising=False)
    properties = SimpleNamespace(filepath=name, is_property_set=lambda _: True)
    operator = SimpleNamespace(
        properties=properties, invoke_popup=lambda _: {"ASKED"}, upright=False
    )
    answer = module.REFINE_OT_import_cameras.invoke(operator, bpy.context, None)

    expected = [(("INVOKE_DEFAULT",), {"filepath": name})] if "transf" not in name else []
    assert called == expected
    assert (answer == {"ASKED"}) == (not expected)


@pytest.mark.parametrize("method", ["occlusion", "merge"])
def test_an_object_is_pruned_to_a_size_in_another_format(addon, few, room_views, tmp_path, method):
    """By the panel and by the command: at most 40 kB and hardly fewer; the plan is near."""
    core, paths, settings = (
        addon.core,
        (tmp_path / "a.spz", tmp_path / "b.spz"),
        bpy.context.scene.refine,
    )
    settings.method, settings.views, settings.budget = method, 4, "max_mb"
    asked = core.Budget(max_mb=0.04), core.METHODS[method](4)
    addon.objects.splat_group.prune_object(few.name, room_views, *asked, output=paths[0])
    bpy.ops.refine.score()
    settings.max_mb, settings.max_mb_in = 0.04, ".spz"
    plan = addon.ui.plans.stored(few, settings)
    bpy.ops.refine.apply()
    bpy.ops.refine.export_ply(filepath=str(paths[1]))
    assert all(39_200 <= path.stat().st_size <= 40_000 for path in paths)
    assert plan["kept"] == pytest.approx(len(few.data.vertices), rel=0.15)


def test_the_images_of_blender_are_those_of_pillow(addon):
    """What one writes the other reads, to the bit: any bytes, where alpha is not 0."""
    pixels = np.random.default_rng(0).integers(0, 256, (12, 20, 4), np.uint8)
    pixels[..., 3] |= 1
    both = addon.core.images._Pillow(), addon.main_thread.BlenderImages()

    for data in [writer.encode(pixels) for writer in both]:
        for reader in both:
            assert reader.size(data) == (20, 12)
            assert np.array_equal(reader.decode(data), pixels)
            for broken in (b"", b"RIFF1234WEBPVP8L", data[:40]):
                with pytest.raises(ValueError, match=r"."):
                    reader.decode(broken)
    assert not bpy.data.images


def imported(columns, path, *comments):
    path.write_bytes(ply_of(columns, comments=comments))
    bpy.ops.refine.import_ply(filepath=str(path))
    return bpy.context.object


def test_the_tag_of_a_file_goes_with_the_object_to_the_file(addon, make_splats, tmp_path):
    """Others than those of such a model are no scene with it."""
    obj = imported(make_splats(20), tmp_path / "in.ply", "antialiased 1")
    checked, gather = addon.mesh.layout.check(obj), addon.objects.splat_group.gather
    export(addon, checked, tmp_path / "out.ply")

    assert bpy.context.scene.refine.model == gather([checked]).model == "antialiased"
    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()
    other = addon.mesh.layout.check(imported(make_splats(20), tmp_path / "other.ply"))
    with pytest.raises(addon.core.RefineError, match="different models"):
        gather([checked, other])


def test_discs_go_through_an_object_as_they_are(addon, make_splats, tmp_path, room_views):
    """Without a third scale, in a mesh and in a point cloud of Blender's own splats.
    A turn of the object, baked into the file, and merging leave discs."""
    columns, core = make_splats(40, degree=1), addon.core
    del columns["scale_2"]
    obj = imported(columns, tmp_path / "in.ply")
    export(addon, addon.mesh.layout.check(obj), tmp_path / "out.ply")
    assert (tmp_path / "out.ply").read_bytes() == (tmp_path / "in.ply").read_bytes()
    obj.rotation_euler = (0.3, 0.2, 0.1)
    bpy.context.view_layer.update()
    splats = splats_of(addon, obj)
    result = core.prune(splats, room_views, core.Budget(ratio=0.5), core.Refit(rounds=1))
    applied(addon, addon.mesh.layout.check(obj), result)

    assert result.merged is not None
    assert addon.mesh.layout.check(obj).layout.model == "2dgs"
    assert "scale_2" not in obj.data.attributes
    left = splats_of(addon, obj)
    cloud = addon.mesh.layout.check(as_cloud(addon, obj))
    export(addon, cloud, tmp_path / "turned.ply", apply_transform=True)
    turned = core.read_ply(tmp_path / "turned.ply").splats()
    assert (len(turned), turned.model) == (20, "2dgs")
    np.testing.assert_allclose(turned.means, left.means, rtol=1e-4)
    np.testing.assert_allclose(turned.log_scales, left.log_scales, rtol=1e-4)


def test_the_box_says_how_an_object_is_drawn_and_its_file_too(addon, make_splats, tmp_path):
    """Where the file said nothing; what looks the same with another word has another digest."""
    obj, settings = imported(make_splats(20), tmp_path / "in.ply"), bpy.context.scene.refine
    before = addon.mesh.attributes.digest(addon.mesh.layout.check(obj))
    assert settings.model == "default"
    settings.model = "antialiased"

    checked = addon.mesh.layout.check(obj)
    assert checked.layout.model == settings.model == "antialiased"
    assert addon.mesh.attributes.digest(checked) != before
    export(addon, checked, tmp_path / "out.ply")
    assert addon.core.read_ply(tmp_path / "out.ply").model == "antialiased"
