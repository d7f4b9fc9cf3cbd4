"""*Render with Splats*: what the camera sees, among meshes, and a scene that stays as it was."""

from __future__ import annotations

import math
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from mathutils import Matrix, Vector

from benchmarks.renderer.rasterizer import render
from tests.e2e.inside.clouds import as_cloud

IMAGE = "Render with Splats"


@pytest.fixture
def shot(quarter, room_views):
    """Give a scene with splats and a camera, 60 x 40 px, on transparent film, by Cycles."""
    scene = bpy.context.scene
    view = room_views[20]
    data = bpy.data.cameras.new("camera")
    data.sensor_fit, data.clip_start = "HORIZONTAL", 0.1
    data.lens = view.fx / view.width * data.sensor_width
    scene.camera = bpy.data.objects.new("camera", data)
    axes = (np.array([1.0, -1.0, -1.0])[:, None] * view.rotation).T
    scene.camera.matrix_world = Matrix.Translation(view.center) @ Matrix(axes.tolist()).to_4x4()
    scene.collection.objects.link(scene.camera)
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


def drawn(addon, scene, obj, **changes):
    """Return what core draws of an object in the scene's camera, alpha not multiplied."""
    view = addon.cameras.view_from_camera(
        scene.camera, scene, bpy.context.evaluated_depsgraph_get()
    )
    splats = addon.objects.splat_group.gather([addon.mesh.layout.check(obj)], whole=True)
    picture = addon.core.pictures.draw(splats, addon.render.engine.replace(view, **changes))
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
    """To the rounding of 8 bits where there is something, whatever the view transform is."""
    shot.view_settings.view_transform, shot.view_settings.exposure = "AgX", 2.0
    before = settings(shot)

    picture, expected = rendered(), drawn(addon, shot, quarter)

    seen = expected[..., 3] > 0.1
    assert picture.shape == (40, 60, 4)
    assert np.abs(picture - expected)[seen].max() < 3.0 / 255.0
    assert seen.mean() > 0.9
    assert settings(shot) == before


def test_without_transparent_film_the_world_is_behind(shot):
    """A splat object that is far away shows a world of linear .5: sRGB 188 of 255, opaque."""
    bpy.context.object.location.x += 1e4
    shot.render.film_transparent = False
    shot.view_settings.view_transform = "Standard"
    shot.world = bpy.data.worlds.new("world")
    shot.world.use_nodes = True
    shot.world.node_tree.nodes["Background"].inputs[0].default_value = (0.5, 0.5, 0.5, 1.0)

    picture = rendered()

    assert np.abs(picture - [*[188 / 255] * 3, 1.0]).max() < 2.0 / 255.0


def test_meshes_hide_splats_by_depth_and_alpha(shot):
    """A plane of 30 % white, .2 m away, mixes: .7 of the picture without it, over black, and .3.

    A black one behind all, 50 m away, changes nothing.
    """
    shot.view_settings.view_transform = "Standard"
    shot.render.film_transparent = False
    plain = rendered()
    near = plane(shot, 0.2, (1.0, 1.0, 1.0), 1.0)
    hidden = rendered()
    near.data.materials[0].node_tree.nodes["Mix Shader"].inputs[0].default_value = 0.3
    mixed = rendered()
    near.matrix_world = shot.camera.matrix_world @ Matrix.Translation((0.0, 0.0, -50.0))
    near.scale *= 50.0
    near.data.materials[0].node_tree.nodes["Emission"].inputs[0].default_value = (0, 0, 0, 1)
    behind = rendered()

    apart = mixed[..., :3] - (0.7 * plain[..., :3] + 0.3)
    assert plain[..., :3].mean() > 0.1
    assert (hidden > 0.99).all()
    assert np.abs(apart).mean() < 0.05  # 16 rays a pixel
    assert abs(apart.mean()) < 0.01
    assert np.abs(behind - plain).max() < 0.01


def test_splats_between_glass_and_a_wall_are_seen(addon, shot, quarter):
    """A black pane of 30 % at .2 m, and a black wall before half of the splats.

    It leaves .7 of the picture without the pane, and all of it where its alpha is 0.
    """
    shot.view_settings.view_transform = "Standard"
    shot.cycles.samples = 64
    depths = addon.objects.splat_group.gather([addon.mesh.layout.check(quarter)], whole=True).means
    view = addon.cameras.view_from_camera(shot.camera, shot, bpy.context.evaluated_depsgraph_get())
    depths = (depths - view.center) @ view.rotation[2]
    far = float(np.median(depths[depths > 0.2]))
    plane(shot, far, (0.0, 0.0, 0.0), width=90.0).name = "wall"
    plain = rendered()
    pane = plane(shot, 0.2, (0.0, 0.0, 0.0), 0.3)
    before = settings(shot)
    mixed = rendered()
    pane.data.materials[0].node_tree.nodes["Mix Shader"].inputs[0].default_value = 0.0
    clear = rendered()

    apart = mixed[..., :3] - 0.7 * plain[..., :3]
    assert plain[..., :3].mean() > 0.05
    assert np.abs(apart).mean() < 0.03
    assert abs(apart.mean()) < 0.01
    assert np.abs(clear - plain).max() < 2.0 / 255.0
    assert settings(shot) == before


@pytest.mark.slow
def test_splats_among_glass_and_walls_are_those_of_the_reference_renderer(addon, shot, quarter):
    """At least 40 dB: green glass, a red wall amid the splats, a blue one behind most of them.

    By hand, front to back: the splats before each, seen through what is in front, then its colour.
    Where splats let all through, it is what the three make as light.
    """
    shot.render.resolution_percentage, shot.cycles.samples = 100, 64
    shot.view_settings.view_transform = "Standard"
    view = addon.cameras.view_from_camera(shot.camera, shot, bpy.context.evaluated_depsgraph_get())
    splats = addon.objects.splat_group.gather([addon.mesh.layout.check(quarter)], whole=True)
    depths = (splats.means - view.center) @ view.rotation[2]
    expected, light = np.zeros((2, 80, 120, 3))
    left, passed, near = np.ones((80, 120, 1)), np.ones((80, 120, 1)), 0.0
    compared = np.ones((80, 120), np.bool_)
    for share, alpha, color, (columns, rows) in (
        (0.1, 0.4, (0.0, 1.0, 0.0), ((0, 60), (0, 80))),
        (0.3, None, (1.0, 0.0, 0.0), ((40, 100), (30, 50))),
        (0.8, None, (0.0, 0.0, 1.0), ((-60, 180), (-40, 120))),
    ):
        far = float(np.quantile(depths[depths > 0.2], share))
        obj = plane(shot, far, color, alpha, width=1.0)
        edges = np.array([columns, rows]) - [[view.cx], [view.cy]]
        (x, y), (wide, high) = edges.mean(axis=1) / view.fx, np.ptp(edges, axis=1) / view.fx
        obj.matrix_world @= Matrix.Translation((x * far, -y * far, 0.0))
        obj.matrix_world @= Matrix.Diagonal((wide * far, high * far, 1.0, 1.0))
        mask = np.zeros((80, 120, 1))
        mask[max(rows[0], 0) : rows[1], max(columns[0], 0) : columns[1]] = alpha or 1.0
        for column, row in zip(columns, rows, strict=True):
            compared[:, max(column - 3, 0) : max(column + 3, 0)] = False
            compared[max(row - 3, 0) : max(row + 3, 0)] = False
        some = splats.take((depths >= near) & (depths < far))
        black, white = (render(some, view, near=0.1, background=(b,) * 3) for b in (0.0, 1.0))
        expected += left * passed * black
        passed = passed * np.where(left > 0.0, (white - black).mean(axis=2, keepdims=True), 1.0)
        expected += left * passed * mask * color
        light += left * mask * color
        left, near = left * (1.0 - mask), far
    shown = np.where(light > 0.0, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055, 0.0)
    expected += passed * (shown - light)

    apart = (rendered()[..., :3] - expected.clip(0.0, 1.0))[compared]

    assert compared.mean() > 0.5
    assert -10.0 * np.log10(np.mean(apart**2)) > 40.0


def test_what_an_undo_brings_back_of_a_render_is_put_right(addon, shot):
    """A step that was noted while a mesh was left out, or a file saved then."""
    shown, gone = (plane(shot, 1.0, (1.0, 1.0, 1.0), 1.0) for _ in range(2))
    gone.visible_camera = False
    before = settings(shot)
    hide = addon.render.meshes.out_of_sight([shown, gone])
    hide.__enter__()
    meanwhile = shown.visible_camera
    addon.ui.render_operators._returned()

    assert not meanwhile
    assert settings(shot) == before


def test_instances_are_drawn_and_what_renders_hide_is_not(addon, shot, quarter):
    """An empty that stands for the collection of the hidden object shows it elsewhere."""
    whole = drawn(addon, shot, quarter)
    collection = bpy.data.collections.new("splats")
    collection.objects.link(quarter)
    shot.collection.objects.unlink(quarter)
    empty = bpy.data.objects.new("empty", None)
    empty.instance_type, empty.instance_collection = "COLLECTION", collection
    shot.collection.objects.link(empty)
    shown = rendered()
    empty.hide_render = True
    hidden = rendered()

    seen = whole[..., 3] > 0.1
    assert np.abs(shown - whole)[seen].max() < 3.0 / 255.0
    assert not hidden[..., 3].any()


@pytest.mark.parametrize("flat", [(0.0, 0.0, 0.0), (1.0, 1.0, 0.0), (math.nan, 1.0, 1.0)])
def test_splats_that_are_scaled_to_nothing_do_not_show(shot, flat):
    """As where an animation ends one object and begins another; the others are drawn."""
    whole = rendered()
    gone = bpy.data.objects.new("gone", bpy.data.objects["room"].data)
    gone.matrix_world = Matrix.Diagonal((*flat, 1.0))
    shot.collection.objects.link(gone)

    np.testing.assert_array_equal(rendered(), whole)


def test_a_border_is_cut_out_of_the_picture(shot):
    """The left half of the upper half: columns 0 to 30 and rows 0 to 20 of 60 x 40."""
    whole = rendered()
    render = shot.render
    render.use_border = render.use_crop_to_border = True
    render.border_min_x, render.border_max_x = 0.0, 0.5
    render.border_min_y, render.border_max_y = 0.5, 1.0
    plane(shot, 50.0, (0.0, 0.0, 0.0), 1.0, width=200.0)

    cut = rendered()

    assert cut.shape == (20, 30, 4)
    solid = whole[:20, :30, 3] > 0.995
    assert np.abs(cut[..., :3] - whole[:20, :30, :3])[solid].max() < 0.02


@pytest.mark.parametrize("share", [0.7, 0.55, 0.9, 0.3])
def test_a_border_ends_at_the_column_that_blender_ends_it_at(shot, share):
    """.7 is a little less in 32 bits, and .7 times 60 columns 42 again, rounded to these."""
    render = shot.render
    render.use_border = render.use_crop_to_border = True
    render.border_max_x = render.border_max_y = share
    plane(shot, 50.0, (0.0, 0.0, 0.0), 1.0, width=200.0)

    assert rendered().shape == (round(40 * share), round(60 * share), 4)


def test_an_orthographic_camera_sees_splats_at_one_scale(shot):
    """A round splat of deviation .1 in an image 4 m wide, 60 px: 1.5 px wherever it is.

    At the middle alpha is .9; 2 px aside, with the low-pass of .3 px^2, .9 exp(-2 / 2.55).
    """
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


def test_an_animation_is_written_where_the_output_settings_say(shot, tmp_path):
    """Frames 2 and 4 of 2 to 5 in steps of 2; one that is there stays unless it may be replaced."""
    shot.frame_start, shot.frame_end, shot.frame_step = 2, 5, 2
    shot.render.filepath = str(tmp_path / "f_###")
    shot.render.use_overwrite = False
    (tmp_path / "f_002.png").write_bytes(b"precious")
    before = settings(shot)
    bpy.ops.refine.render(animation=True)
    assert settings(shot) == before

    assert sorted(path.name for path in tmp_path.iterdir()) == ["f_002.png", "f_004.png"]
    assert (tmp_path / "f_002.png").read_bytes() == b"precious"
    image = bpy.data.images.load(str(tmp_path / "f_004.png"))
    assert tuple(image.size) == (60, 40)


@pytest.mark.slow
def test_a_movie_is_written_as_one_file(shot, tmp_path):
    """Two frames, drawn one after another and then written by Blender."""
    shot.frame_start, shot.frame_end = 1, 2
    render = shot.render
    if hasattr(render.image_settings, "media_type"):
        render.image_settings.media_type = "VIDEO"
    render.image_settings.file_format = "FFMPEG"
    render.filepath = str(tmp_path / "movie.mkv")
    render.use_file_extension = False
    bpy.ops.refine.render(animation=True)

    (movie,) = tmp_path.iterdir()
    assert bpy.data.movieclips.load(str(movie)).frame_duration == 2


@pytest.mark.parametrize(
    ("asked", "used"),
    [
        (("CPU", True, 2048), 128),
        (("CPU", True, 64), 64),
        (("CPU", False, 64), 128),
        (("GPU", True, 2048), 2048),
    ],
)
def test_the_processor_renders_small_tiles_between_which_esc_is_heard(
    addon, shot, tmp_path, asked, used
):
    """Smaller ones that were asked for stay, and so does the scene."""
    shot.render.engine = "CYCLES"
    bpy.ops.mesh.primitive_cube_add()
    cycles = shot.cycles
    cycles.device, cycles.use_auto_tile, cycles.tile_size = asked

    addon.render.meshes.Meshes(shot, tmp_path)

    copy = bpy.data.scenes[".REFINE meshes"].cycles
    assert (copy.use_auto_tile, copy.tile_size) == (True, used)
    assert (cycles.device, cycles.use_auto_tile, cycles.tile_size) == asked
    addon.render.meshes.remove_all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda scene: setattr(scene, "camera", None), "has no camera"),
        (lambda scene: setattr(scene.camera.data, "type", "PANO"), "is a panorama"),
        (lambda scene: setattr(scene.camera, "scale", (0.0, 0.0, 0.0)), "is sheared or flat"),
        (lambda scene: setattr(scene.render, "use_multiview", True), "not drawn in stereo"),
        (lambda _scene: bpy.data.objects.remove(bpy.data.objects["room"]), "has no splats"),
    ],
    ids=["no camera", "panorama", "flat camera", "stereo", "no splats"],
)
def test_what_cannot_be_rendered_is_said_and_nothing_is_left(shot, change, message):
    change(shot)
    before = settings(shot)
    with pytest.raises(RuntimeError, match=message):
        bpy.ops.refine.render()

    assert settings(shot) == before
    assert not hasattr(bpy.types, "REFINE_engine")


def test_a_render_that_is_stopped_leaves_nothing(addon, shot, monkeypatch):
    """As by Esc: the engine ends without a picture."""
    plane(shot, 1.0, (1.0, 1.0, 1.0), 1.0)
    before = settings(shot)

    def stopped(*_, **__):
        raise addon.core.execute.Cancelled

    monkeypatch.setattr(addon.render.engine, "draw", stopped)

    assert bpy.ops.refine.render() == {"CANCELLED"}
    assert settings(shot) == before
    assert IMAGE not in bpy.data.images


def test_an_esc_that_blender_forgets_ends_the_drawing_of_splats(addon, shot, monkeypatch):
    """`Shared.stopped` alone tells the engine, amid drawing."""
    before, draw, asked = settings(shot), addon.render.engine.draw, []

    def pressed(*arguments, progress, **named):
        addon.render.engine.REFINE_engine.shared.stopped = True

        def noted(fraction, what):
            asked.append(progress(fraction, what))
            return asked[-1]

        return draw(*arguments, progress=noted, **named)

    monkeypatch.setattr(addon.render.engine, "draw", pressed)

    assert bpy.ops.refine.render() == {"CANCELLED"}
    assert asked == [False]
    assert settings(shot) == before


def test_an_esc_that_waits_behind_a_timer_is_heard_before_the_next_render(addon):
    """Blender's renders forget it when they begin, and would run on to their end."""
    operators, begun = addon.ui.render_operators, []
    watch = operators.REFINE_OT_watch_render
    escape = SimpleNamespace(type="ESC", value="PRESS")
    step = addon.render.meshes.Step(bpy.context.scene.name, animation=False, what="meshes")
    waiting = SimpleNamespace(
        _steps=iter([step, step]),
        _next=None,
        _shared=SimpleNamespace(stopped=False),
        _show=lambda: None,
        _render=lambda _context, step: begun.append(step),
        _stopped=lambda _context, _error: {"CANCELLED"},
        _go_on=lambda context: operators.REFINE_OT_render._go_on(waiting, context),
    )
    timer = SimpleNamespace(type="TIMER")

    def event():
        return operators.REFINE_OT_render.modal(waiting, bpy.context, timer)

    assert [event(), event(), len(begun)] == [{"RUNNING_MODAL"}, {"RUNNING_MODAL"}, 1]
    assert event() == {"RUNNING_MODAL"}
    watched = SimpleNamespace(_watched=[waiting._shared])
    assert watch.modal(watched, bpy.context, escape) == {"PASS_THROUGH"}
    assert event() == {"CANCELLED"}
    assert len(begun) == 1


def test_f12_says_that_splats_are_not_in_it(addon, shot, quarter, capfd):
    """On stderr where there is no window; not where renders hide the splats."""
    bpy.ops.render.render()
    said = capfd.readouterr().err
    quarter.hide_render = True
    bpy.ops.render.render()

    assert addon.ui.render_operators.IN_BACKGROUND in said
    assert addon.ui.render_operators.IN_BACKGROUND not in capfd.readouterr().err
    assert shot.name in bpy.data.scenes


def test_splats_that_blender_draws_are_left_to_it(
    addon, shot, quarter, monkeypatch, capfd, tmp_path
):
    """In 5.3 point clouds of a type of their own; where there is none, all others stand in.

    F12 shows them and says nothing, and among others they are rendered with the meshes.
    """
    other = bpy.data.objects.new("other", quarter.data.copy())
    cloud = as_cloud(addon, quarter)
    monkeypatch.setattr(addon.mesh.layout, "NATIVE", getattr(cloud.data, "type", ""))
    bpy.ops.render.render()
    said = capfd.readouterr().err
    with pytest.raises(RuntimeError, match="has no splats to draw; import some, or use Render Im"):
        bpy.ops.refine.render()
    shot.collection.objects.link(other)
    meshes = addon.render.meshes.Meshes(shot, tmp_path)
    addon.render.meshes.remove_all()

    assert addon.ui.render_operators.IN_BACKGROUND not in said
    assert meshes.engine == "CYCLES"
    assert cloud not in meshes._hidden


def test_the_command_writes_the_frames_it_is_told(addon, shot, tmp_path, capsys):
    """By default the current frame; files are named by the frame, as Blender's own ``-f`` does."""
    shot.render.filepath = str(tmp_path / "f_##")
    shot.frame_set(7)

    codes = [addon.command.main(["render"], scene=True)]
    codes.append(addon.command.main(["render", "--source", "frames:3:5:2"], scene=True))
    shot.camera = None
    codes.append(addon.command.main(["render", "--source", "frames"], scene=True))

    assert codes == [0, 0, 1]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["f_03.png", "f_05.png", "f_07.png"]
    told = capsys.readouterr()
    assert f"frame 7: {tmp_path / 'f_07.png'}" in told.out
    assert "has no camera" in told.err


def test_what_splats_are_rendered_without_is_said(addon, shot, tmp_path, capsys):
    """A camera with depth of field, a scene with motion blur and compositing nodes."""
    shot.render.filepath = str(tmp_path / "f_##")
    quiet = addon.render.engine.left_out(shot)
    shot.camera.data.dof.use_dof = shot.render.use_motion_blur = True
    if not hasattr(shot, "compositing_node_group"):
        shot.use_nodes = True
    else:
        shot.compositing_node_group = bpy.data.node_groups.new("nodes", "CompositorNodeTree")

    assert quiet == []
    assert addon.command.main(["render"], scene=True) == 0
    said = capsys.readouterr().out
    assert "note: Splats are drawn without depth of field and motion blur" in said
    assert "note: Compositing nodes are left out" in said


def test_the_command_names_the_frames_that_it_leaves(addon, shot, tmp_path, capsys):
    """With *Overwrite* off a file that is there stays, and nothing is said to be rendered."""
    shot.render.filepath = str(tmp_path / "f_##")
    shot.render.use_overwrite = False
    (tmp_path / "f_03.png").touch()

    codes = [
        addon.command.main(["render", "--source", f"frames:{frames}"], scene=True)
        for frames in ("3:3", "3:4")
    ]

    assert codes == [0, 0]
    there = f"  note: {tmp_path / 'f_03.png'}: exists and stays; the scene's Overwrite is off\n"
    said = capsys.readouterr().out
    assert said.startswith(there)
    assert said.count(there) == 2
    assert said.count(" splats") == 1
