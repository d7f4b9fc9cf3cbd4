"""*Render with Splats*: what the camera sees, among meshes, and a scene that stays as it was."""

import math

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector

from tests.e2e.inside.clouds import as_cloud, scatter

from .conftest import linked, splats_of
from .test_instances import instanced

IMAGE = "Render with Splats"


@pytest.fixture
def shot(quarter, room_views):
    """Give a scene with splats and a camera, 60 x 40 px, on transparent film, by Cycles."""
    scene = bpy.context.scene
    view = room_views[20]
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.clip_start = "HORIZONTAL", 0.1
    data.lens = view.fx / view.width * data.sensor_width
    scene.camera = linked("camera", data)
    axes = (np.array([1.0, -1.0, -1.0])[:, None] * view.rotation).T
    scene.camera.matrix_world = Matrix.Translation(view.center) @ Matrix(axes.tolist()).to_4x4()
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = 120, 80, 50
    render.engine, render.film_transparent = "CYCLES", True
    scene.cycles.samples, scene.cycles.use_denoising = 16, False
    bpy.context.view_layer.update()
    return scene


def rendered():
    """Return the picture, (H, W, 4), the top row first."""
    bpy.ops.refine.render()
    image = bpy.data.images[IMAGE]
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)[::-1]


def drawn(addon, scene, obj):
    """Return what core draws of an object in the scene's camera, alpha not multiplied."""
    view = addon.cameras.view_from_camera(scene.camera)
    picture = addon.core.pictures.draw(splats_of(addon, obj), view)
    picture[:3] /= np.maximum(picture[3], 1e-6)
    return np.moveaxis(picture, 0, -1).clip(0.0, 1.0)


def plane(scene, depth, color, alpha=None, *, width=9.0):
    """Put a plane that shines in a colour before the camera, opaque by default; return it."""
    matrix = scene.camera.matrix_world @ Matrix.Translation((0.0, 0.0, -depth))
    bpy.ops.mesh.primitive_plane_add(size=width)
    obj = bpy.context.object
    obj.matrix_world = matrix
    material = bpy.data.materials.new("plane")
    material.use_nodes = True
    tree = material.node_tree
    tree.nodes.clear()
    light, clear, mix, end = (
        tree.nodes.new(f"ShaderNode{kind}")
        for kind in ("Emission", "BsdfTransparent", "MixShader", "OutputMaterial")
    )
    light.inputs[0].default_value = (*color, 1.0)
    mix.inputs[0].default_value = alpha or 0.0
    for number, node in ((1, clear), (2, light)):
        tree.links.new(node.outputs[0], mix.inputs[number])
    tree.links.new((light if alpha is None else mix).outputs[0], end.inputs[0])
    if alpha is None:
        tree.nodes.remove(clear)
    obj.data.materials.append(material)
    return obj


def settings(scene):
    """Return what a render must leave as it was."""
    groups = (scene, scene.render, scene.render.image_settings, scene.view_settings, scene.cycles)
    told = [
        (group.bl_rna.identifier, name, repr(getattr(group, name)))
        for group in (*groups, *scene.view_layers)
        for name, kind in group.bl_rna.properties.items()
        if kind.type in {"BOOLEAN", "INT", "FLOAT", "STRING", "ENUM"} and not kind.is_readonly
    ]
    hidden = [(obj.name, obj.hide_render, obj.visible_camera) for obj in bpy.data.objects]
    hidden += [[*obj.keys()] for obj in bpy.data.objects]
    hidden.append([*bpy.data.materials.keys()])
    names = [scene.name for scene in bpy.data.scenes] + [world.name for world in bpy.data.worlds]
    names += [image.name for image in bpy.data.images if image.type != "RENDER_RESULT"]
    return told, hidden, [name for name in names if name != IMAGE]


def test_a_render_is_what_core_draws(addon, shot, quarter):
    """To the rounding of 8 bits where there is something, whatever the view transform is.
    Without transparent film a world of linear .5 is behind: sRGB 188 of 255, opaque."""
    shot.view_settings.view_transform, shot.view_settings.exposure = "AgX", 2.0
    before = settings(shot)
    picture, expected = rendered(), drawn(addon, shot, quarter)

    seen = expected[..., 3] > 0.1
    assert picture.shape == (40, 60, 4)
    assert np.abs(picture - expected)[seen].max() < 3.0 / 255.0
    assert seen.mean() > 0.9
    assert settings(shot) == before
    quarter.location.x += 1e4
    shot.render.film_transparent = False
    shot.view_settings.view_transform, shot.view_settings.exposure = "Standard", 0.0
    world = shot.world = bpy.data.worlds.new("world")
    world.use_nodes = True
    world.node_tree.nodes["Background"].inputs[0].default_value = (0.5, 0.5, 0.5, 1.0)
    assert np.abs(rendered() - [*[188 / 255] * 3, 1.0]).max() < 2.0 / 255.0


def test_meshes_hide_splats_by_depth_and_alpha(addon, shot, quarter):
    """A black pane at .2 m, before a black wall amid the splats that are seen through it.
    An alpha of .3 leaves .7 of the picture without the pane, of 1 nothing, of 0 all."""
    shot.view_settings.view_transform = "Standard"
    shot.cycles.samples = 64
    open_ = rendered()
    view = addon.cameras.view_from_camera(shot.camera)
    depths = (splats_of(addon, quarter).means - view.center) @ view.rotation[2]
    plane(shot, float(np.median(depths[depths > 0.2])), (0.0, 0.0, 0.0), width=90.0)
    plain = rendered()
    pane = plane(shot, 0.2, (0.0, 0.0, 0.0), 1.0)
    before = settings(shot)

    def through(alpha):
        pane.data.materials[0].node_tree.nodes["Mix Shader"].inputs[0].default_value = alpha
        return rendered()[..., :3]

    apart = through(0.3) - 0.7 * plain[..., :3]
    assert 0.05 < plain[..., :3].mean() < 0.9 * open_[..., :3].mean()
    assert np.abs(apart).mean() < 0.03
    assert abs(apart.mean()) < 0.01
    assert np.abs(through(0.0) - plain[..., :3]).max() < 2.0 / 255.0
    assert through(1.0).max() < 0.01
    assert settings(shot) == before


def test_instances_are_drawn_and_what_renders_hide_is_not(addon, shot, quarter):
    """An empty that stands for the collection of the hidden object shows it elsewhere, and so does
    a point on which nodes instance its geometry. Splats scaled to nothing, as where an animation
    ends one object, do not show."""
    whole = drawn(addon, shot, quarter)
    empty, gone, shown = instanced(quarter), linked("gone", quarter.data), []
    shot.collection.objects.unlink(quarter)
    for flat in ((0.0, 0.0, 0.0), (1.0, 1.0, 0.0), (math.nan, 1.0, 1.0)):
        gone.matrix_world = Matrix.Diagonal((*flat, 1.0))
        shown.append(rendered())
    empty.hide_render = True
    point = linked("point", bpy.data.meshes.new("point"))
    point.data.vertices.add(1)
    scatter(point, quarter, as_instance=False)
    shown.append(rendered())
    point.hide_render = True

    seen = whole[..., 3] > 0.1
    assert np.abs(np.array(shown) - whole)[:, seen].max() < 3.0 / 255.0
    assert not rendered()[..., 3].any()


@pytest.mark.parametrize("share", [0.5, 0.7, 0.55, 0.9, 0.3])
def test_a_border_is_cut_out_at_the_column_at_which_blender_cuts(shot, share):
    """.7 is a little less in 32 bits, and .7 times 60 columns 42 again, rounded to these."""
    whole, render = rendered(), shot.render
    render.use_border = render.use_crop_to_border = True
    render.border_max_x = render.border_max_y = share
    plane(shot, 50.0, (0.0, 0.0, 0.0), 1.0, width=200.0)
    cut = rendered()

    whole = whole[40 - round(40 * share) :, : round(60 * share)]
    assert cut.shape == whole.shape
    solid = whole[..., 3] > 0.995
    assert solid.any()
    assert np.abs(cut - whole)[solid].max() < 0.02


def test_an_orthographic_camera_sees_splats_at_one_scale(shot):
    """A round splat of deviation .1 in an image 4 m wide, 60 px: 1.5 px wherever it is.
    At the middle alpha is .9; 2 px aside, with the low-pass of .3 px^2, .9 exp(-2 / 2.55)."""
    shot.camera.data.type, shot.camera.data.ortho_scale = "ORTHO", 4.0
    mesh = bpy.context.object.data
    values = np.zeros((len(mesh.vertices), 3), np.float32)
    back = shot.camera.matrix_world.to_3x3() @ Vector((0.0, 0.0, -1.0))
    values[:] = np.array(shot.camera.matrix_world.translation + 3.0 * back)
    mesh.attributes["position"].data.foreach_set("vector", values.ravel())
    for axis in range(3):
        column = np.full(len(values), math.log(0.1), np.float32)
        mesh.attributes[f"scale_{axis}"].data.foreach_set("value", column)
    column = np.full(len(values), -20.0, np.float32)
    column[0] = math.log(9.0)
    mesh.attributes["opacity"].data.foreach_set("value", column)
    shot.render.resolution_x, shot.render.resolution_y = 122, 82  # 61 x 41: a pixel in the middle
    shot.camera.data.ortho_scale = 4.0 * 61 / 60
    alphas = rendered()[..., 3]

    assert abs(alphas[20, 30] - 0.9) < 0.01
    assert abs(alphas[20, 32] - 0.9 * math.exp(-2.0 / 2.55)) < 0.01
    assert abs(alphas[18, 30] - 0.9 * math.exp(-2.0 / 2.55)) < 0.01


@pytest.mark.slow
def test_a_movie_is_written_as_one_file(shot, tmp_path):
    """Two frames, drawn one after another and then written by Blender."""
    shot.frame_start, shot.frame_end, render = 1, 2, shot.render
    if hasattr(render.image_settings, "media_type"):
        render.image_settings.media_type = "VIDEO"
    render.image_settings.file_format, render.use_file_extension = "FFMPEG", False
    render.filepath = str(tmp_path / "movie.mkv")
    before = settings(shot)
    bpy.ops.refine.render(animation=True)

    assert settings(shot) == before
    assert bpy.data.movieclips.load(str(tmp_path / "movie.mkv")).frame_duration == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda scene: setattr(scene, "camera", None), "no active camera at frame 1"),
        (lambda scene: setattr(scene, "camera", bpy.data.objects["room"]), "no active camera"),
        (lambda scene: setattr(scene.camera.data, "type", "PANO"), "is a panorama"),
        (lambda scene: setattr(scene.camera, "scale", (0.0, 0.0, 0.0)), "is sheared or flat"),
        (lambda scene: setattr(scene.render, "use_multiview", True), "not drawn in stereo"),
        (lambda _scene: bpy.data.objects.remove(bpy.data.objects["room"]), "has no splats to draw"),
    ],
)
def test_what_cannot_be_rendered_is_said_and_nothing_is_left(shot, change, message):
    change(shot)
    before = settings(shot)
    with pytest.raises(RuntimeError, match=message):
        bpy.ops.refine.render()
    assert settings(shot) == before
    assert not hasattr(bpy.types, "REFINE_engine")


def test_a_camera_that_goes_as_a_render_ends_is_no_error(shot):
    def drop(*_):
        shot.camera = None

    bpy.app.handlers.render_complete.append(drop)
    try:
        assert bpy.ops.refine.render() == {"FINISHED"}
    finally:
        bpy.app.handlers.render_complete.remove(drop)
    assert shot.camera is None


def test_a_render_that_is_stopped_leaves_nothing(addon, shot, monkeypatch):
    """The engine hears amid drawing of an Esc that Blender forgot, and ends without a picture."""
    plane(shot, 50.0, (1.0, 1.0, 1.0), 1.0)
    before, draw, asked = settings(shot), addon.render.engine.draw, []

    def stopped(*arguments, progress, **named):
        addon.render.engine.REFINE_engine.shared.stopped = True

        def noted(fraction, what):
            asked.append(progress(fraction, what))
            return asked[-1]

        return draw(*arguments, progress=noted, **named)

    monkeypatch.setattr(addon.render.engine, "draw", stopped)

    assert bpy.ops.refine.render() == {"CANCELLED"}
    assert asked == [False]
    assert settings(shot) == before
    assert IMAGE not in bpy.data.images


def test_f12_says_that_splats_are_not_in_it(addon, shot, quarter, monkeypatch, capfd):
    """On stderr where there is no window; not where renders hide the splats.
    Nor of those that Blender 5.3 draws, point clouds of a type of their own, for which all others
    stand in here."""

    def says():
        bpy.ops.render.render()
        return addon.ui.render_operators.IN_BACKGROUND in capfd.readouterr().err

    assert says()
    quarter.hide_render = True
    assert not says()
    quarter.hide_render = False
    cloud = as_cloud(addon, quarter)
    monkeypatch.setattr(addon.mesh.layout, "NATIVE", getattr(cloud.data, "type", ""))
    assert not says()
    assert not addon.render.meshes.drawn_by_us(cloud)


def test_the_command_writes_the_frames_it_is_told(addon, shot, tmp_path, capsys):
    """By default the current frame; files are named by the frame, as Blender's own ``-f`` does.
    With *Overwrite* off a file that is there stays, and it is named. What is left out is said."""

    def main(*words):
        return addon.command.main(["render", *words], scene=True), capsys.readouterr()

    there = tmp_path / "f_03.png"
    there.write_bytes(b"precious")
    shot.render.filepath, shot.render.use_overwrite = str(tmp_path / "f_##"), False
    code, told = main("--source", "frames:3:5:2")
    assert code == 0
    note = f"  note: {there}: exists and stays; the scene's Overwrite is off\n"
    assert told.out.count(note) == told.out.count(" splats") == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["f_03.png", "f_05.png"]
    assert there.read_bytes() == b"precious"

    shot.frame_set(7)
    shot.camera.data.dof.use_dof = shot.render.use_motion_blur = True
    code, told = main()
    assert code == 0
    assert f"frame 7: {tmp_path / 'f_07.png'}" in told.out
    assert "note: Splats are drawn without depth of field and motion blur" in told.out
    shot.camera = None
    code, told = main("--source", "frames")
    assert code == 1
    assert "no active camera" in told.err
