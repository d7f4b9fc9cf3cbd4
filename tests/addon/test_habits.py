"""What a user sets once, and where file browsers open."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import bpy
import pytest

ROOM = Path(__file__).parents[1] / "data" / "room_small"


@pytest.fixture
def preferred(addon):
    """Return the extension's preferences; unset again afterwards."""
    preferences = bpy.context.preferences.addons[addon.__name__].preferences
    yield preferences
    for name in (*addon.ui.properties.DEFAULTS, "upright"):
        preferences.property_unset(name)


def test_preferences_are_the_defaults_of_what_a_scene_has_not_set(addon, preferred):
    """The scene has chosen its number of views; the method it takes over."""
    settings = bpy.context.scene.refine
    preferred.method, preferred.views = "closed-form", 16
    settings.views = 32

    addon.ui.properties.fill(settings, bpy.context, *addon.ui.properties.DEFAULTS)

    assert (settings.method, settings.views) == ("closed-form", 32)


def test_scripts_get_what_they_ask_for(preferred):
    """In the background preferences change nothing."""
    preferred.method, preferred.upright = "refit", True

    bpy.ops.refine.import_ply(filepath=str(ROOM / "point_cloud.ply"))

    assert not bpy.context.scene.refine.is_property_set("method")
    assert bpy.context.object.matrix_world.is_identity


def test_a_dialogue_starts_from_the_preferences(addon, preferred):
    """Upright is preferred; where it was given, it stays."""
    preferred.upright = True
    for given, expected in ((False, True), (True, False)):
        options = SimpleNamespace(upright=False, is_property_set=lambda _name, g=given: g)

        addon.ui.properties.fill(options, bpy.context, "upright")

        assert options.upright is expected


@pytest.mark.parametrize(
    ("cameras", "expected"),
    [
        ("cameras.json", "."),
        ("point_cloud/iteration_7/cameras.json", "point_cloud/iteration_7"),
        ("nowhere.txt", "point_cloud/iteration_7"),
    ],
    ids=["above", "beside", "none"],
)
def test_cameras_are_looked_for_where_the_splats_came_from(addon, tmp_path, cameras, expected):
    """Training leaves splats in point_cloud/iteration_7, two folders below cameras.json."""
    place = tmp_path / "point_cloud" / "iteration_7"
    place.mkdir(parents=True)
    shutil.copy(ROOM / "point_cloud.ply", place)
    (tmp_path / cameras).write_text("[]")
    bpy.ops.refine.import_ply(filepath=str(place / "point_cloud.ply"))
    find = addon.ui.import_operators.capture_folder

    assert find(bpy.context.object) == tmp_path / expected
    bpy.context.object["refine_folder"] = str(tmp_path / "gone")
    assert find(bpy.context.object) is None
    assert find(None) is None


@pytest.mark.parametrize("name", ["import_ply", "import_cameras", "export_ply"])
def test_files_have_presets(addon, name):
    kinds = {getattr(cls, "bl_idname", ""): cls for cls in addon.registration.CLASSES}

    assert "PRESET" in kinds[f"refine.{name}"].bl_options
