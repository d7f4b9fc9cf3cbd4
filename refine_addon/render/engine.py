"""From a scene to rendered frames: the sequence of Blender's renders, and the render engine that
draws splats among the layers of `meshes`. The engine renders copies of scenes only; Blender calls
it on a thread of its own, with the data evaluated for that render."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Generator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import bpy
import numpy as np
from numpy.typing import NDArray

from .. import main_thread
from ..cameras import active_camera, pose
from ..core import RefineError
from ..core.affine import is_flat, transformed
from ..core.execute import Cancelled, checkpoint, report, within
from ..core.images import linear_of
from ..core.pictures import Layers, draw, seen_from
from ..core.splats import Splats, drawable, joined
from ..core.views import View, ViewSet, view_through
from ..core.visibility.scene import scene_of
from ..mesh import attributes
from ..mesh.layout import SplatObject, check
from ..objects.instances import placings
from . import card, meshes

_FAR = 1e4
"""Distance of the pinhole that replaces an orthographic camera, in units of its scale: the error is
below 0.1 pixels of 1000."""


@dataclass(eq=False)
class Shared:
    """State shared with the engine. Settings: `layers` reads the frame's layers of other objects;
    `card`: draw on the graphics card, by `main_thread.serve`; `finished`: folder of pictures drawn
    before. Results: `splats` and `picture`, (4, H, W), of the last frame; `frames` drawn;
    `renders`: Blender's renders for each frame; `engine` of other objects, or "". `stopped`: by
    Esc, which Blender forgets where a render begins."""

    layers: Callable[[], Layers | None] | None = None
    card: bool = False
    finished: Path | None = None
    splats: int = 0
    frames: list[int] = field(default_factory=list)
    renders: int = 1
    engine: str = ""
    picture: NDArray[np.float64] | None = None
    error: BaseException | None = None
    stopped: bool = False


class REFINE_engine(bpy.types.RenderEngine):  # type: ignore[misc]
    """Draws splats."""

    bl_idname = "REFINE_SPLATS"
    bl_label = "Splats"
    shared = Shared(stopped=True)  # between renders

    def render(self, depsgraph: bpy.types.Depsgraph) -> None:
        """Draw a frame. Blender calls this."""
        shared = self.shared
        try:
            frame = depsgraph.scene.frame_current
            before = shared.finished and np.load(shared.finished / f"{frame}.npy") / 65535.0
            picture = self._picture(depsgraph, shared) if before is None else before
            result = self.begin_result(0, 0, *picture.shape[:0:-1])
            result.layers[0].passes["Combined"].rect.foreach_set(_linear(picture).ravel())
            self.end_result(result)
            shared.picture = picture
            shared.frames.append(frame)
        except Cancelled:
            pass
        except BaseException as error:
            shared.error = error
            self.error_set(str(error))

    def _picture(self, depsgraph: bpy.types.Depsgraph, shared: Shared) -> NDArray[np.float64]:
        scene, size = depsgraph.scene, (self.resolution_x, self.resolution_y)
        view, away = _place(depsgraph, active_camera(scene), size)
        splats = _splats(depsgraph, view.center)
        camera = ViewSet((replace(view, center=view.center + away * view.rotation[2]),))
        view = _cropped(view, scene.render)
        layers = shared.layers() if shared.layers else None
        if layers is not None and away:
            depths = np.where(layers.depths > 0.0, layers.depths + away, 0.0)
            layers = replace(layers, depths=depths)
        shared.splats = len(splats)
        if shared.card and not away and len(splats):
            paint = card.painter(splats, view, layers)
            with within(check=partial(report, self._progress, 0.5, "drawing")):
                picture = main_thread.call(paint)
        else:
            frame = scene_of(splats.means, drawable(splats), camera)
            picture = draw(splats, view, layers, frame, progress=self._progress)
        if not scene.render.film_transparent:
            picture[3] = 1.0
        return picture

    def _progress(self, fraction: float, what: str) -> bool:
        self.update_progress(fraction)
        self.update_stats("", f"Splats: {what}")
        return not (self.test_break() or self.shared.stopped)


def _place(depsgraph, camera, size):
    """View of a camera, and how far it was moved back, 0 in perspective.
    A view is a pinhole: for an orthographic camera one that is far away."""
    data, render = camera.data, depsgraph.scene.render
    if data.type not in {"PERSP", "ORTHO"}:
        raise RefineError(
            f"camera '{camera.name}' is a panorama (lens type {data.type}): splats can be drawn in "
            "perspective and orthographic cameras; change its lens type"
        )
    pixel = {"scale_x": render.pixel_aspect_x, "scale_y": render.pixel_aspect_y}
    projection = camera.calc_matrix_camera(depsgraph, x=size[0], y=size[1], **pixel)
    looking = pose(camera.name, np.array(camera.matrix_world, np.float64))
    away = _FAR * data.ortho_scale if data.type == "ORTHO" else 0.0
    view = view_through(np.array(projection, np.float64), looking, size, (0.0, away))
    near, far = away + data.clip_start, away + data.clip_end
    return replace(view, near=near, far=far, name=camera.name), away


def _cropped(view: View, render: bpy.types.RenderSettings) -> View:
    if not render.use_border:
        return view
    # In float32 like Blender: 0.7 of 240 columns are 168 there, and 167 in float64.
    across = np.array([render.border_min_x, render.border_max_x], np.float32)
    left, right = (across * np.float32(view.width)).astype(int).tolist()
    up = np.array([render.border_max_y, render.border_min_y], np.float32)
    top, bottom = (view.height - (up * np.float32(view.height)).astype(int)).tolist()
    cx, cy = view.cx - left, view.cy - top
    return replace(view, cx=cx, cy=cy, width=right - left, height=bottom - top)


def _splats(depsgraph: bpy.types.Depsgraph, eye: NDArray[np.float64]) -> Splats:
    """All splats of a render in the world, instances too, in their colours seen from `eye`.
    Modifiers are ignored, as in the 3D views."""
    parts = []
    for _, obj, matrix, _ in placings(depsgraph):
        if not meshes.drawn_by_us(obj):
            continue
        checkpoint()
        if not np.isfinite(matrix).all() or is_flat(matrix):  # such meshes show nothing either
            continue
        evaluated = SimpleNamespace(data=obj.data.evaluated_get(depsgraph))
        checked = SplatObject(evaluated, check(obj).layout)
        splats = attributes.splats_from_object(checked)
        local = np.linalg.inv(matrix)
        splats = seen_from(splats, local[:3, :3] @ eye + local[:3, 3])
        parts.append(transformed(splats, matrix, rotate_sh=False))
    return joined(parts or [Splats(*map(np.empty, ((0, 3), (0, 3), (0, 4), 0, (0, 3), (0, 0, 3))))])


def _linear(picture: NDArray[np.float64]) -> NDArray[np.float32]:
    """A display-referred picture, (4, H, W), as linear pixels, (H * W, 4), lowest row first.
    The view transform of the copied scene encodes them again."""
    colors, alphas = picture[:3], picture[3]
    straight = (colors / np.maximum(alphas, 1e-6)).clip(0.0, 1.0)
    pixels = np.concatenate([alphas * linear_of(straight), picture[3:]]).astype(np.float32)
    return np.moveaxis(pixels, 0, -1)[::-1].reshape(-1, 4)


def left_out(scene: bpy.types.Scene) -> list[str]:
    """Sentences on settings of a rendered scene that splats ignore."""
    render, sentences = scene.render, []
    dof = getattr(scene.camera and scene.camera.data, "dof", None)  # the camera may be gone by now
    blurs = {"depth of field": dof and dof.use_dof, "motion blur": render.use_motion_blur}
    if blurred := [name for name, is_on in blurs.items() if is_on]:
        sentences.append(f"Splats are drawn without {' and '.join(blurred)}")
    new = hasattr(scene, "compositing_node_group")  # since 5.0
    nodes = scene.compositing_node_group if new else scene.use_nodes and scene.node_tree
    if render.use_compositing and nodes:
        sentences.append("Compositing nodes are left out")
    if sum(layer.use for layer in scene.view_layers) > 1:
        sentences.append("Of several view layers only the first is rendered")
    return sentences


def steps(
    scene: bpy.types.Scene, frames: Sequence[int], shared: Shared, *, write: bool
) -> Generator[meshes.Step | None, None, None]:
    """Yield Blender's renders for some frames; the caller runs each before it takes the next.
    None: Blender may do other things first. Cleans up at the end or when closed. `write`: pictures
    go to the scene's output. `RefineError` if the scene cannot be rendered or a step failed,
    `Cancelled` if one was stopped."""
    label = f"scene '{scene.name}'"
    active_camera(scene)
    if not any(map(meshes.drawn_by_us, bpy.data.objects)):  # instanced ones may be in no scene
        raise RefineError(f"{label}: has no splats to draw; import some, or use Render Image")
    if scene.render.use_multiview:
        raise RefineError(f"{label}: splats are not drawn in stereo; switch off Stereoscopy")
    with ExitStack() as stack:  # which first drops the engine's state, then copies and files
        folder = tempfile.TemporaryDirectory(prefix="refine-", ignore_cleanup_errors=True)
        folder = Path(stack.enter_context(folder))
        meshes.remove_all()
        bpy.utils.register_class(REFINE_engine)
        stack.callback(bpy.utils.unregister_class, REFINE_engine)
        stack.callback(meshes.remove_all)
        REFINE_engine.shared = shared
        stack.callback(setattr, REFINE_engine, "shared", Shared(stopped=True))
        others, whole = meshes.Meshes(scene, folder), _whole(scene, "whole")
        shared.engine, shared.renders = others.engine, others.renders + 1
        movie = write and scene.render.is_movie_format
        kept = not scene.render.use_overwrite, scene.render.use_placeholder
        if movie:  # written by one render, after all frames are drawn
            written = _whole(scene, "movie")
            meshes.write_exr(meshes.existing(whole), folder / "whole_######")
        for frame in frames:
            if write and not movie and _is_there(whole, frame, *kept):
                continue
            shared.layers = yield from others.layers(frame)
            yield from _drawn(shared, whole, [frame], "splats", animation=write)
            if movie:
                picture = np.rint(shared.picture * 65535.0).astype(np.uint16)
                np.save(folder / f"{frame}.npy", picture)
        if movie:
            shared.finished = folder
            yield from _drawn(shared, written, frames, "movie", animation=True)


def _whole(scene: bpy.types.Scene, what: str) -> str:
    """Name of a new copy of the scene that the engine renders."""
    copy = meshes.copied(scene, what)
    copy.render.engine = REFINE_engine.bl_idname
    copy.render.use_overwrite, copy.render.use_placeholder = True, False  # see `_is_there`
    view = copy.view_settings  # a view transform that only encodes colours as sRGB
    view.view_transform, view.look = "Standard", "None"
    view.exposure, view.gamma, view.use_curve_mapping = 0.0, 1.0, False
    if hasattr(view, "use_white_balance"):  # since 4.3
        view.use_white_balance = False
    copy.render.image_settings.color_management = "FOLLOW_SCENE"
    return str(copy.name)


def _drawn(shared, name, frames, what, *, animation):
    """Have the engine draw frames of a copy; raises what stopped it."""
    meshes.set_frames(name, frames)
    yield meshes.Step(name, animation, what)
    if shared.error is not None or shared.frames[-1:] != [frames[-1]]:
        raise shared.error or Cancelled


def _is_there(name: str, frame: int, stays: bool, placeholder: bool) -> bool:
    """Whether a frame's file exists and is to stay; else make a placeholder if wanted."""
    path = Path(bpy.path.abspath(meshes.existing(name).render.frame_path(frame=frame)))
    there = path.exists()
    if placeholder and not there:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return stays and there
