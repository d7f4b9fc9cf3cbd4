"""A Blender camera as a view, and a view as a Blender camera; the one place with the axis flip.

Blender's camera looks along -z with y up, a view along +z with y down.
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.affine import QUARTER, QUARTERS, quaternion
from ..core.errors import RefineError
from ..core.views import View

WEIGHT = "refine_weight"
"""Custom property of a camera object: how much its view counts, 1 without it."""

SOURCE = "refine_view"
"""Custom property of an imported camera: the view of the file in full precision, as JSON."""

UPRIGHT = np.eye(4)
UPRIGHT[:3, :3] = QUARTER
"""A quarter turn about x: the y-down world of COLMAP to the z-up world of Blender."""

SENSOR = 36.0
"""Sensor width given to imported cameras, millimetres."""

FLIP = np.array([1.0, -1.0, -1.0])

_RESIDUE = 3e-7
"""What float32 leaves of the zeros and ones of a quarter turn."""

SHEAR = 1e-4
"""How far from orthonormal the axes of a camera may be."""

_SIZES = ("fx", "fy", "cx", "cy", "width", "height")
_NOTED = (*_SIZES, *["rotation", "center", "near", "far", "matrix", "lens", "clip", "upright"])
"""What is noted of an imported camera."""

_DEFAULT_NEAR, _DEFAULT_FAR = 0.01, 1000.0


def view_from_camera(
    obj: bpy.types.Object, scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph
) -> View:
    """Return what a camera object sees.

    The frame is the one that Blender renders: lens, sensor fit, shift, the scene's resolution with
    its percentage and pixel aspect. An imported camera keeps the image size of its file, and as
    long as it is neither moved nor changed the file's own numbers.

    Parameters
    ----------
    obj : bpy.types.Object
    scene : bpy.types.Scene
        For the render size.
    depsgraph : bpy.types.Depsgraph
        For animation, constraints, drivers and parents.

    Returns
    -------
    View
        Named after the object.

    Raises
    ------
    RefineError
        If the object is no camera or not a perspective one, is sheared or flat, or if its
        ``refine_weight`` is no number >= 0.
    """
    if obj.type != "CAMERA":
        raise RefineError(f"object '{obj.name}': is of type {obj.type}, expected a camera")
    evaluated = obj.evaluated_get(depsgraph)
    data = evaluated.data if evaluated.is_evaluated else obj.data
    if data.type != "PERSP":
        kind = {"ORTHO": "orthographic", "PANO": "panoramic"}.get(data.type, data.type.lower())
        raise RefineError(
            f"camera '{obj.name}' is {kind}, expected a perspective one; change its lens type, or "
            "choose cameras without it"
        )
    matrix = world_matrix(obj, depsgraph)
    source = _source(obj)
    size, aspect = render_size(scene)
    if source:
        size, aspect = (source["width"], source["height"]), 1.0
    rotation, center = pose(obj.name, matrix)
    view = View(
        rotation=rotation,
        center=center,
        **_intrinsics(data, size, aspect),
        near=data.clip_start,
        far=data.clip_end,
        weight=_weight(obj),
        name=obj.name,
    )
    return _restored(view, source, matrix, data) if source else view


def render_size(scene: bpy.types.Scene) -> tuple[tuple[int, int], float]:
    """Return the rendered size in pixels, and the height of a pixel over its width."""
    render = scene.render
    width = max(render.resolution_x * render.resolution_percentage // 100, 1)
    height = max(render.resolution_y * render.resolution_percentage // 100, 1)
    return (width, height), render.pixel_aspect_y / render.pixel_aspect_x


def world_matrix(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> NDArray[np.float64]:
    """Return an object's matrix to the world, (4, 4).

    Quarter turns come out exact: Blender's float32 leaves 4e-8 where a zero belongs.

    Raises
    ------
    RefineError
        If the object is not evaluated, being disabled in viewports or excluded, and has
        animation or constraints that only an evaluation can follow.
    """
    evaluated = obj.evaluated_get(depsgraph)
    if evaluated.is_evaluated:
        return snapped(np.array(evaluated.matrix_world, np.float64))
    moving = obj.animation_data and (obj.animation_data.action or obj.animation_data.drivers)
    if moving or obj.constraints or (obj.parent and obj.parent_type != "OBJECT"):
        raise RefineError(
            f"object '{obj.name}': is disabled in viewports or excluded from the view layer, where "
            "Blender evaluates no animation or constraint; enable it first"
        )
    matrix = np.array(obj.matrix_basis, np.float64)
    if obj.parent:
        inverse = np.array(obj.matrix_parent_inverse, np.float64)
        matrix = world_matrix(obj.parent, depsgraph) @ inverse @ matrix
    return snapped(matrix)


def camera_from_view(view: View, *, upright: bool = False) -> bpy.types.Object:
    """Make a camera object that sees what a view sees.

    It does where the render size has the aspect of the view; of pixels that are not square, the
    horizontal focal length counts. The view itself is noted on the object, for `view_from_camera`.

    Parameters
    ----------
    view : View
    upright : bool
        Whether to turn it by `UPRIGHT`, like splats imported with that option.

    Returns
    -------
    bpy.types.Object
        In no collection yet.
    """
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
    _place(obj, view)
    if view.weight != 1.0:
        obj[WEIGHT] = view.weight
    # The view, and what Blender's float32 made of it, to tell if it is touched.
    noted = {name: getattr(view, name) for name in ("near", *_SIZES)}
    noted |= {"rotation": view.rotation.tolist(), "center": view.center.tolist()}
    noted["far"] = view.far if math.isfinite(view.far) else None
    noted["matrix"] = snapped(np.array(obj.matrix_basis, np.float64)).tolist()
    noted |= {"lens": _lens(data), "clip": [data.clip_start, data.clip_end], "upright": upright}
    obj[SOURCE] = json.dumps(noted)
    return obj


def quarter_turn(obj: bpy.types.Object, view: View, axes: NDArray[np.float64]) -> int | None:
    """Return by how many quarters about x a camera is to be turned to stand as in its file.

    Parameters
    ----------
    obj : bpy.types.Object
        The camera.
    view : View
        What it sees now.
    axes : (3, 3) float64
        Rotation to the world of an object that holds splats as their file does.

    Returns
    -------
    {0, 1, -1} or None
        By `QUARTER` or its inverse; None where it was not imported, or stands otherwise.
    """
    source = _source(obj)
    if not source:
        return None
    in_file = np.array(source["rotation"]) @ (QUARTER if source["upright"] else np.eye(3))
    turn = axes @ in_file.T @ view.rotation  # from where the camera looks to where its file says
    for number, quarter in QUARTERS.items():
        if np.abs(turn - quarter).max() < SHEAR:
            return number
    return None


def _intrinsics(data: bpy.types.Camera, size: tuple[int, int], aspect: float) -> dict[str, Any]:
    """Return focal lengths and principal point in pixels, as Blender frames its renders."""
    width, height = size
    fit = data.sensor_fit
    if fit == "AUTO":
        fit = "HORIZONTAL" if width >= height * aspect else "VERTICAL"
    # AUTO always means the sensor's width, laid along the image's longer side.
    sensor = data.sensor_height if data.sensor_fit == "VERTICAL" else data.sensor_width
    fitted = width if fit == "HORIZONTAL" else height * aspect
    focal = data.lens / sensor * fitted
    return {
        "fx": focal,
        "fy": focal / aspect,
        "cx": width / 2 - data.shift_x * fitted,
        "cy": height / 2 + data.shift_y * fitted / aspect,
        "width": width,
        "height": height,
    }


def pose(name: str, matrix: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the world-to-camera rotation and the centre; a camera's scale means nothing.

    Parameters
    ----------
    name : str
        Of the camera, for messages.
    matrix : (4, 4) float64
        From the camera, as Blender has its axes, to the world.

    Raises
    ------
    RefineError
        If the camera is sheared or flat.
    """
    lengths = np.linalg.norm(matrix[:3, :3], axis=0)
    axes = matrix[:3, :3] / np.where(lengths > 0.0, lengths, 1.0)
    if lengths.min() <= 0.0 or np.abs(axes.T @ axes - np.eye(3)).max() > SHEAR:
        raise RefineError(
            f"camera '{name}' is sheared or flat, as under a parent that is scaled unevenly; apply "
            "the parent's scale first"
        )
    return FLIP[:, None] * axes.T, matrix[:3, 3]


def _weight(obj: bpy.types.Object) -> float:
    weight = obj.get(WEIGHT, 1.0)
    number = isinstance(weight, (int, float)) and not isinstance(weight, bool)
    if not number or not 0.0 <= weight < math.inf:
        raise RefineError(
            f"camera '{obj.name}': custom property {WEIGHT} is {weight!r}, expected a number "
            "of at least 0"
        )
    return float(weight)


def snapped(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a (4, 4) matrix with an exact linear part if that is but quarter turns and a scale."""
    linear = matrix[:3, :3]
    scale = np.abs(linear).max()
    signs = np.round(linear / (scale or 1.0))
    if np.abs(linear - scale * signs).max() > _RESIDUE * scale:
        return matrix
    snapped = matrix.copy()
    snapped[:3, :3] = scale * signs if abs(scale - 1.0) > _RESIDUE else signs
    return snapped


def _place(obj: bpy.types.Object, view: View) -> None:
    axes = (FLIP[:, None] * view.rotation).T
    mirrored = np.linalg.det(axes) < 0.0
    if mirrored:
        axes = axes * np.array([-1.0, 1.0, 1.0])
        obj.scale = (-1.0, 1.0, 1.0)
    obj.rotation_mode = "QUATERNION"
    obj.rotation_quaternion = quaternion(axes)
    obj.location = view.center


def _lens(data: bpy.types.Camera) -> list[Any]:
    return [data.lens, data.sensor_fit, data.sensor_width, data.shift_x, data.shift_y]


def _source(obj: bpy.types.Object) -> dict[str, Any] | None:
    if SOURCE not in obj:
        return None
    try:
        source = json.loads(obj[SOURCE])
        return {name: source[name] for name in _NOTED}
    except (TypeError, ValueError, KeyError):
        raise RefineError(
            f"camera '{obj.name}': custom property {SOURCE} is damaged; delete it, and the camera "
            "is used as Blender shows it"
        ) from None


def _restored(
    view: View,
    source: dict[str, Any],
    matrix: NDArray[np.float64],
    data: bpy.types.Camera,
) -> View:
    """Return the view with the file's own numbers for whatever nobody touched."""
    changes: dict[str, Any] = {}
    if np.array_equal(matrix, np.array(source["matrix"])):
        changes.update(rotation=np.array(source["rotation"]), center=np.array(source["center"]))
    if _lens(data) == source["lens"]:
        changes.update({name: source[name] for name in _SIZES[:4]})
    if [data.clip_start, data.clip_end] == source["clip"]:
        changes["near"] = source["near"]
        changes["far"] = math.inf if source["far"] is None else source["far"]
    return replace(view, **changes)
