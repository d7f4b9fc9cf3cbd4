"""What a newcomer does first: one import, cameras that fit, dialogues that know what lies there."""

import importlib
import shutil
from types import SimpleNamespace

import bpy
import pytest

from tests.strategies import ply_of

from .conftest import ROOM


@pytest.fixture
def capture(tmp_path, few_file):
    """Lay out a capture as training does; return its splats, two folders below the cameras."""
    place = tmp_path / "point_cloud" / "iteration_7"
    place.mkdir(parents=True)
    shutil.copy(few_file, place / "point_cloud.ply")
    shutil.copy(ROOM / "cameras.json", tmp_path)
    return place / "point_cloud.ply"


def cameras():
    return [obj for obj in bpy.context.scene.objects if obj.type == "CAMERA"]


@pytest.mark.parametrize("upright", [False, True])
def test_one_import_brings_the_cameras_that_lie_above(addon, capture, upright):
    """The file's 72, which decide from now on and stand as the splats do: no turn is needed.
    Scripts get no cameras, no image size and nothing upright unasked."""
    module, scene = addon.ui.import_operators, bpy.context.scene
    scene.render.resolution_x = 1000
    bpy.ops.refine.import_ply(filepath=str(capture), upright=upright)
    assert cameras() == []
    bpy.context.view_layer.update()
    bpy.context.view_layer.objects.active = None
    # The matrix of an object is float32: a quarter turn has 7.5e-8 for some of its zeros.
    assert module._is_upright(module._splats_in(bpy.context)) is upright
    bpy.ops.refine.import_cameras(filepath=str(capture.parents[2] / "cameras.json"))
    assert (len(cameras()), scene.render.resolution_x) == (72, 1000)

    bpy.ops.wm.read_homefile(use_empty=True)
    bpy.ops.refine.import_ply(
        filepath=str(capture), upright=upright, cameras=True, set_resolution=True
    )
    scene = bpy.context.scene
    assert len(cameras()) == 72
    assert scene.refine.source == "COLLECTION"
    assert scene.refine.collection.name == "Cameras"
    assert (scene.render.resolution_x, scene.render.resolution_y) == (240, 160)
    assert scene.camera.name == "000"
    assert bpy.context.object.name == "point_cloud"
    assert addon.cameras.known_turn(bpy.context, bpy.context.object) == 0


def test_cameras_that_cannot_be_read_leave_the_splats(capture, capfd):
    (capture.parents[2] / "cameras.json").write_text("[]")
    assert bpy.ops.refine.import_ply(filepath=str(capture), cameras=True) == {"FINISHED"}

    assert len(bpy.context.object.data.vertices) == 3976
    assert cameras() == []
    assert "the list of cameras is empty" in capfd.readouterr().out


def test_what_lies_beside_the_splats_is_found_by_its_name(addon, tmp_path):
    """In three folders above; JSON before COLMAP, of which a model needs cameras and images."""
    find, place = addon.ui.import_operators.cameras_beside, tmp_path / "a" / "b" / "c"
    (place / "d").mkdir(parents=True)
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    found = []
    for name in ("cameras.bin", "images.bin", "transforms_train.json", "cameras.json"):
        folder = tmp_path / "sparse" / "0" if name.endswith("bin") else tmp_path
        (folder / name).touch()
        found.append(find(place))

    model = tmp_path / "sparse" / "0"
    assert found == [None, model, tmp_path / "transforms_train.json", tmp_path / "cameras.json"]
    assert find(place / "d") is None


AXES = {"y": True, "0.04 -0.97 0.23": True, "0 -0.2 -0.98": False, "Z ": False, "up": None}


@pytest.mark.parametrize("axis", AXES)
def test_upright_is_as_the_chosen_file_says(addon, make_splats, tmp_path, axis):
    """Brush negates z of the direction upward. The user may change it for the same file.
    Once splats were moved, the file that is written no longer says it."""
    path, upright = tmp_path / "in.ply", AXES[axis]
    check, comment = addon.ui.import_operators.REFINE_OT_import_ply.check, f"vertical Axis: {axis}"
    path.write_bytes(ply_of(make_splats(count=5), [comment]))
    operator = SimpleNamespace(upright=not upright, chosen=None, _paths=lambda: [path])
    assert check(operator, bpy.context) == (upright is not None)
    assert operator.upright == (upright is None or upright)
    assert not check(operator, bpy.context)

    bpy.ops.refine.import_ply(filepath=str(path), upright=True)
    out, said = tmp_path / "out.ply", []
    for move in (False, True, False):  # the last time baked
        bpy.ops.refine.export_ply(filepath=str(out), apply_transform=move, overwrite=True)
        said.append(comment.encode() in out.read_bytes())
        if move:
            bpy.ops.refine.bake_transform()
    assert said == [True, False, False]


def test_the_render_size_is_set_where_nobody_chose_one(addon):
    """Blender's own scene has one camera and 1920 x 1080."""
    for change, untouched in (
        (lambda _scene: None, True),
        (lambda scene: setattr(scene.render, "resolution_percentage", 50), False),
        (lambda scene: setattr(scene.render, "resolution_x", 1000), False),
        (lambda _scene: bpy.ops.object.camera_add(), False),
        (lambda scene: scene.camera.keyframe_insert("location"), False),
    ):
        bpy.ops.wm.read_homefile(use_factory_startup=True, load_ui=False)
        change(bpy.context.scene)
        is_set = SimpleNamespace(is_property_set=lambda _name: False)
        operator = SimpleNamespace(properties=is_set, set_resolution=None)
        addon.ui.import_operators.suggest_resolution(operator, bpy.context)
        assert operator.set_resolution is untouched


def test_a_blend_that_blender_could_not_open_is_named(addon, tmp_path):
    """Blender goes on with an empty scene; words behind the command are its own."""
    check = importlib.import_module(f"{addon.__name__}.command.scene").opened
    words = ["blender", "-b", "gone.blend", "--command", "refine", "prune", "--object", "a"]

    with pytest.raises(addon.core.RefineError, match=r"^gone\.blend: Blender could not open it"):
        check(words)
    check(["blender", "-b", "-c", "refine", "gone.blend"])
    check(["pytest"])
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "is.blend"))
    check(words)


def test_preferences_are_the_defaults_of_what_was_not_set(addon, few_file):
    """Of a scene and of a dialogue; scripts, in the background, get what they ask for alone."""
    settings, properties = bpy.context.scene.refine, addon.ui.properties
    preferred = bpy.context.preferences.addons[addon.__name__].preferences
    preferred.method, preferred.views, preferred.upright = "closed-form", 16, True
    bpy.ops.refine.import_ply(filepath=str(few_file))
    assert not settings.is_property_set("method")
    assert bpy.context.object.matrix_world.is_identity

    settings.views = 32
    properties.fill(settings, bpy.context, *properties.DEFAULTS)
    assert (settings.method, settings.views) == ("closed-form", 32)
    for given in (False, True):
        options = SimpleNamespace(upright=False, is_property_set=lambda _name, g=given: g)
        properties.fill(options, bpy.context, "upright")
        assert options.upright is not given
    for name in (*properties.DEFAULTS, "upright"):
        preferred.property_unset(name)
