"""Blender cameras to views and back, and the sets of cameras that a user can choose.
Axes are flipped here only: Blender's camera looks along -z with y up, a view along +z with y
down."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import bpy
import numpy as np
from numpy.typing import NDArray

from .core import RefineError, View, ViewSet
from .core.affine import QUARTER, QUARTERS, UNKNOWN_AXES, quaternion
from .core.formats.ply import HEADER_LIMIT, raw_header
from .mesh.layout import AXES, LAYOUT, VERTICAL_AXIS, is_native

WEIGHT = "refine_weight"  # Custom property of a camera object: the weight of its view, 1 without it
SOURCE = "refine_view"  # Custom property of an imported camera: its view in the file, exact, JSON
SENSOR = 36.0
"""Sensor width given to imported cameras, millimetres."""

FLIP = np.array([1.0, -1.0, -1.0])  # Axes of Blender's camera to those of a view, and back
_RESIDUE = 3e-7  # Largest error of float32 in the zeros and ones of a quarter turn
SHEAR = 1e-4  # Largest deviation of a camera's axes from orthonormal
_SHOWN = {
    "matrix": ("rotation", "center"),
    "lens": ("fx", "fy", "cx", "cy"),
    "clip": ("near", "far"),
}
"""What `_shown` returns of an imported camera -> what is as in the file while that is unchanged."""

_FIELDS = (*_SHOWN, *sum(_SHOWN.values(), ()), "width", "height", "upright")
_DEFAULT_NEAR, _DEFAULT_FAR = 0.01, 1000.0
_FEW = 16  # Cameras looked at, at most, to know whether all must be turned


def view_from_camera(obj: bpy.types.Object) -> View:
    """View of a camera object as Blender renders it, at the scene's size, named after the object.
    Of an imported camera the image size and all unchanged numbers are those of the file."""
    data = _evaluated(obj).data
    if data.type != "PERSP":
        kind = {"ORTHO": "orthographic", "PANO": "panoramic"}.get(data.type, data.type.lower())
        advice = "change its lens type, or choose cameras without it"
        raise RefineError(f"camera '{obj.name}' is {kind}, expected a perspective one; {advice}")
    matrix = world_matrix(obj)
    source = _source(obj)
    frame = (source["width"], source["height"], 1.0) if source else render_size(bpy.context.scene)
    lens, shown = _intrinsics(data, *frame), _shown(data, matrix)
    view = View(*pose(obj.name, matrix), *lens, *shown["clip"], _weight(obj), obj.name)
    same = [n for key, names in _SHOWN.items() if shown[key] == source.get(key) for n in names]
    return replace(view, **{name: source[name] for name in same})


def render_size(scene: bpy.types.Scene) -> tuple[int, int, float]:
    """Width and height of renders, pixels, and a pixel's height over its width."""
    render = scene.render
    width = max(render.resolution_x * render.resolution_percentage // 100, 1)
    height = max(render.resolution_y * render.resolution_percentage // 100, 1)
    return width, height, render.pixel_aspect_y / render.pixel_aspect_x


def world_matrix(obj: bpy.types.Object) -> NDArray[np.float64]:
    """An object's matrix to the world, (4, 4), with quarter turns made exact.
    `RefineError` if Blender does not evaluate it (disabled, excluded) though it is animated or
    constrained."""
    evaluated = _evaluated(obj)
    if evaluated.is_evaluated:
        return snapped(np.array(evaluated.matrix_world, np.float64))
    moving = obj.animation_data and (obj.animation_data.action or obj.animation_data.drivers)
    if moving or obj.constraints or (obj.parent and obj.parent_type != "OBJECT"):
        problem = "is disabled in viewports or excluded from the view layer"
        why = "where Blender evaluates no animation or constraint"
        raise RefineError(f"object '{obj.name}': {problem}, {why}; enable it first")
    matrix = np.array(obj.matrix_basis, np.float64)
    if obj.parent:
        inverse = np.array(obj.matrix_parent_inverse, np.float64)
        matrix = world_matrix(obj.parent) @ inverse @ matrix
    return snapped(matrix)


def _evaluated(obj: bpy.types.Object) -> bpy.types.Object:
    return obj.evaluated_get(bpy.context.evaluated_depsgraph_get())


def camera_from_view(view: View, *, upright: bool = False) -> bpy.types.Object:
    """New camera object of a view, in no collection; `upright`: turned by `QUARTER`.
    Frames the view's image if the render size has its aspect; uses fx where fy differs."""
    view = view.turned(QUARTER) if upright else view
    name = PurePosixPath(view.name).name or "view"
    data = bpy.data.cameras.new(name)
    data.sensor_fit = "HORIZONTAL"
    data.sensor_width = SENSOR
    data.lens = view.fx * SENSOR / view.width
    data.shift_x = (view.width / 2 - view.cx) / view.width
    data.shift_y = (view.cy - view.height / 2) / view.width
    data.clip_start = view.near or _DEFAULT_NEAR
    data.clip_end = min(view.far, max(_DEFAULT_FAR, 1e5 * view.near))
    obj = bpy.data.objects.new(name, data)
    axes = (FLIP[:, None] * view.rotation).T
    if np.linalg.det(axes) < 0.0:  # mirrored
        axes = axes * np.array([-1.0, 1.0, 1.0])
        obj.scale = (-1.0, 1.0, 1.0)
    obj.rotation_mode = "QUATERNION"
    obj.rotation_quaternion = quaternion(axes)
    obj.location = view.center
    if view.weight != 1.0:
        obj[WEIGHT] = view.weight
    # The view, and Blender's float32 values of it, by which changes are noticed.
    source = vars(view) | _shown(data, snapped(np.array(obj.matrix_basis, np.float64)))
    source |= {"rotation": view.rotation.tolist(), "center": view.center.tolist()}
    source |= {"far": view.far if math.isfinite(view.far) else None, "upright": upright}
    obj[SOURCE] = json.dumps({name: source[name] for name in _FIELDS})
    return obj


def _intrinsics(data: bpy.types.Camera, width: int, height: int, aspect: float) -> tuple[Any, ...]:
    """Focal lengths, principal point and size in pixels, as Blender frames its renders."""
    fit = data.sensor_fit
    if fit == "AUTO":
        fit = "HORIZONTAL" if width >= height * aspect else "VERTICAL"
    # AUTO uses the sensor's width along the image's longer side.
    sensor = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
    fitted = width if fit == "HORIZONTAL" else height * aspect
    focal = data.lens / sensor * fitted
    cx, cy = width / 2 - data.shift_x * fitted, height / 2 + data.shift_y * fitted / aspect
    return focal, focal / aspect, cx, cy, width, height


def pose(name: str, matrix: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """World-to-camera rotation, (3, 3), and centre, (3,), of a (4, 4) camera-to-world matrix with
    Blender's axes. Its scale is ignored; `RefineError` if it is sheared or flat."""
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    axes = matrix[:3, :3] / np.where(lengths > 0.0, lengths, 1.0)
    if lengths.min() <= 0.0 or np.abs(axes.T @ axes - np.eye(3)).max() > SHEAR:
        problem = "is sheared or flat, as under a parent that is scaled unevenly"
        raise RefineError(f"camera '{name}' {problem}; apply the parent's scale first")
    return FLIP[:, None] * axes.T, matrix[:3, 3]


def _weight(obj: bpy.types.Object) -> float:
    weight = obj.get(WEIGHT, 1.0)
    number = isinstance(weight, (int, float)) and not isinstance(weight, bool)
    if not number or not 0.0 <= weight < math.inf:
        wanted = "expected a number of at least 0"
        raise RefineError(f"camera '{obj.name}': custom property {WEIGHT} is {weight!r}, {wanted}")
    return float(weight)


def snapped(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """A (4, 4) matrix, its linear part made exact if it is quarter turns times a scale."""
    linear = matrix[:3, :3]
    scale = np.abs(linear).max()
    signs = np.round(linear / (scale or 1.0))
    if np.abs(linear - scale * signs).max() > _RESIDUE * scale:
        return matrix
    snapped = matrix.copy()
    snapped[:3, :3] = scale * signs if abs(scale - 1.0) > _RESIDUE else signs
    return snapped


def _shown(data: bpy.types.Camera, matrix: NDArray[np.float64]) -> dict[str, list[Any]]:
    """What Blender shows of a camera, by the keys of `_SHOWN`."""
    lens = [data.lens, data.sensor_fit, data.sensor_width, data.shift_x, data.shift_y]
    return {"matrix": matrix.tolist(), "lens": lens, "clip": [data.clip_start, data.clip_end]}


def _source(obj: bpy.types.Object) -> dict[str, Any]:
    """The view that a camera was imported from, by `_FIELDS`; empty if it was not imported."""
    if SOURCE not in obj:
        return {}
    try:
        source = json.loads(obj[SOURCE])
        far = math.inf if source["far"] is None else source["far"]
        return {name: source[name] for name in _FIELDS} | {"far": far}
    except (TypeError, ValueError, KeyError):
        problem = f"custom property {SOURCE} is damaged"
        advice = "delete it to use the camera as Blender shows it"
        raise RefineError(f"camera '{obj.name}': {problem}; {advice}") from None


class CameraChoice(NamedTuple):
    """Which cameras of a scene decide; `source`: VISIBLE, ACTIVE, SELECTED, COLLECTION or FRAMES.
    COLLECTION uses `collection` with its children, hidden or not; FRAMES uses `frames`."""

    source: str
    collection: bpy.types.Collection | None = None
    frames: range = range(0)

    @classmethod
    def of_scene(cls, scene: bpy.types.Scene) -> CameraChoice:
        """The panel's choice, stored in the scene."""
        settings = scene.refine
        return cls(settings.source, settings.collection, settings.to_frames(scene))

    def cameras(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        """The cameras, of any lens type; for FRAMES all of the scene. Cheap enough to draw."""
        layer, collection = context.view_layer, self.collection
        objects = {
            "ACTIVE": [context.scene.camera],
            "SELECTED": layer.objects.selected,
            "COLLECTION": collection.all_objects if collection else [],
        }.get(self.source, layer.objects)
        cameras = [obj for obj in objects if obj and obj.type == "CAMERA"]
        if self.source == "VISIBLE":
            return [camera for camera in cameras if camera.visible_get(view_layer=layer)]
        return cameras

    def views(self, context: bpy.types.Context, splats: bpy.types.Object | None = None) -> ViewSet:
        """Views of these cameras, at least one; `splats` as in `views_from_frames`."""
        scene = context.scene
        if self.source == "FRAMES":
            return views_from_frames(context, self.frames, splats)
        if self.source == "COLLECTION" and self.collection is None:
            raise RefineError("no cameras: choose the collection that holds them")
        context.view_layer.update()  # else the list of objects may hold None for removed ones
        cameras = [active_camera(scene)] if self.source == "ACTIVE" else self.cameras(context)
        if not cameras:
            where = {"SELECTED": "selected", "VISIBLE": f"visible in scene '{scene.name}'"}
            if self.collection:
                where["COLLECTION"] = f"in collection '{self.collection.name}'"
            none = f"none is {where[self.source]}"
            raise RefineError(f"no cameras: {none}; scoring needs at least one")
        views = tuple(map(view_from_camera, cameras))
        return ViewSet(views, turn=_turn(cameras, views, splats))


def known_turn(context: bpy.types.Context, splats: bpy.types.Object) -> int:
    """Quarter turns about x that the deciding cameras need to fit the splats (`ViewSet.turn`), from
    how both were imported; 0 if unknown or for FRAMES. The context must be evaluated."""
    choice = CameraChoice.of_scene(context.scene)
    cameras = [] if choice.source == "FRAMES" else choice.cameras(context)
    cameras = cameras[:: len(cameras) // _FEW + 1]
    try:
        return _turn(cameras, [*map(view_from_camera, cameras)], splats) or 0
    except RefineError:  # scoring reports it
        return 0


def create_cameras(
    views: ViewSet, collection: bpy.types.Collection, *, upright: bool = False
) -> list[bpy.types.Object]:
    """A camera object for each view, in order, linked to `collection`; see `camera_from_view`."""
    spread = float(np.sqrt(np.mean(np.var(views.centers, axis=0))))
    cameras = [camera_from_view(view, upright=upright) for view in views]
    for camera in cameras:
        # Smaller than the distance of neighbours, but at least 1 mm.
        camera.data.display_size = min(max(0.1 * spread, 1e-3), 1.0) if len(views) > 1 else 0.25
        collection.objects.link(camera)
    return cameras


def views_from_frames(
    context: bpy.types.Context, frames: range, splats: bpy.types.Object | None = None
) -> ViewSet:
    """Views of the active camera at each frame; markers switch cameras as in a render.
    Where the object `splats` moves (a turntable), the views move instead. Frame and active camera
    are restored. `RefineError` without frames or a camera, or if the object's scale is animated."""
    scene = context.scene
    if not len(frames):
        ends = f"starts at {frames.start} and ends at {frames.stop - 1}"
        raise RefineError(f"no frames: the range {ends}")
    now = world_matrix(splats) if splats else None
    before = (scene.frame_current, scene.frame_subframe, scene.camera)
    views = []
    try:
        for frame in frames:
            scene.frame_set(frame)
            view = view_from_camera(active_camera(scene))
            if now is not None and not np.array_equal(then := world_matrix(splats), now):
                motion = now @ np.linalg.inv(then)  # that puts the splats where they are now
                if np.abs(motion[:3, :3].T @ motion[:3, :3] - np.eye(3)).max() > SHEAR:
                    animated = f"object '{splats.name}': its scale is animated"
                    why = "the views of different frames then see different splats"
                    raise RefineError(f"{animated}; {why}: choose one frame")
                view = view.turned(motion[:3, :3], motion[:3, 3])
            views.append(replace(view, name=f"{view.name}, frame {frame}"))
    finally:
        scene.frame_set(before[0], subframe=before[1])
        scene.camera = before[2]
    return ViewSet(tuple(views), exact=True)


def _turn(
    cameras: Sequence[bpy.types.Object], views: Sequence[View], splats: bpy.types.Object | None
) -> int | None:
    """Quarter turns about x that these cameras need, the same for all; None if unknown: the splats
    or more than half of the cameras were not imported, cameras differ, or nobody named the axes of
    an SPZ."""
    data = splats and splats.data
    if not data or not (LAYOUT in data or is_native(data)) or data.get(AXES) == UNKNOWN_AXES:
        return None
    linear = world_matrix(splats)[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    axes = linear / scale if scale else linear
    if np.abs(axes @ axes.T - np.eye(3)).max() > SHEAR:
        return None
    turns = []
    for camera, view in zip(cameras, views, strict=True):
        if source := _source(camera):
            in_file = np.array(source["rotation"]) @ (QUARTER if source["upright"] else np.eye(3))
            turn = axes @ in_file.T @ view.rotation  # from where it looks to where its file says
            turns += [n for n, quarter in QUARTERS.items() if np.abs(turn - quarter).max() < SHEAR]
    alike = len(set(turns)) == 1 and 2 * len(turns) >= len(cameras)
    return turns[0] if alike else None


def y_down(path: Path) -> bool | None:
    """Whether a PLY names y as its vertical axis, pointing down; None if it names none.
    Brush writes ``y`` for that, or the direction upward, its z negated; nerfstudio ``z``."""
    letters = {"x": "1 0 0", "y": "0 -1 0", "z": "0 0 1"}
    try:
        with path.open("rb") as stream:
            header = raw_header(stream.read(HEADER_LIMIT)) or b""
        *_, axis = VERTICAL_AXIS.findall(header.decode("latin-1"))
        x, y, z = map(float, letters.get(axis.strip().lower(), axis).split())
    except (OSError, ValueError):
        return None
    return -y > max(abs(x), abs(z))


def active_camera(scene: bpy.types.Scene) -> bpy.types.Object:
    """The active camera. `RefineError` without one; Blender lets any object be it."""
    if scene.camera is None or scene.camera.type != "CAMERA":
        problem = f"no active camera at frame {scene.frame_current}"
        raise RefineError(f"{problem}: make a camera the active one")
    return scene.camera
