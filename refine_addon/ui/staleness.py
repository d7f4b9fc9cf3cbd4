"""What scores were made with, and what of it has changed since: asked while the panel is drawn.

Only what a few numbers tell is compared: where the object stands, the cameras and their lenses,
the settings. What was done to the splats themselves is not looked for.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

from ..cameras.objects import SOURCE, WEIGHT, render_size
from ..cameras.sets import CameraChoice
from ..mesh import attributes as mesh_attributes
from ..mesh import edit as mesh_edit
from ..mesh import scores as mesh_scores
from ..objects import demands

_NOISE = 1e-6
"""Relative: what another machine or version of Blender may make of the same matrices."""

_NONE = [0, 0]
"""`mesh_scores.digest` of what marks nothing."""

_FITS = ("AUTO", "HORIZONTAL", "VERTICAL")
_AXES, _PLACE = [0, 1, 2, 4, 5, 6, 8, 9, 10], [3, 7, 11]  # in the rows of a matrix


def origin(context: bpy.types.Context, obj: bpy.types.Object) -> dict[str, Any]:
    """Return where an object and the cameras that the panel names are, as values for JSON."""
    return {
        "matrix": np.array(obj.matrix_world).tolist(),
        "frame": context.scene.frame_current,
        "volumes": _volumes(context.scene),
        "must_go": _must_go(obj),
        **_cameras(context),
    }


def changes(
    context: bpy.types.Context,
    obj: bpy.types.Object,
    protected: NDArray[np.bool_] | None = None,
) -> list[str]:
    """Return what changed since an object was scored, in a few words each.

    Parameters
    ----------
    context : bpy.types.Context
        Evaluated: matrices are read as they stand.
    obj : bpy.types.Object
        Without scores, or scored by a script that recorded no origin, it has no changes.
    protected : (N,) bool, optional
        Which of its splats stay in any case; by default those that are marked so for the views.
    """
    record = mesh_scores.record(obj.data) or {}
    try:
        then, settings = record["origin"], record["settings"]
        changed = {
            "object moved": _moved(then, context.scene, obj),
            "cameras changed": _other_cameras(then, _cameras(context)),
            "volumes changed": _other_volumes(then, context.scene),
            "what must go changed": then.get("must_go", _NONE) != _must_go(obj),
            "settings changed": _deciding(settings)
            != _deciding(context.scene.refine.to_method().facts()),
            "what is protected changed": bool(record.get("quality"))
            and record.get("protected", _NONE) != _protected(obj, protected),
        }
    except (KeyError, TypeError, ValueError):  # whoever wrote there, these are no scores of ours
        return []
    return [words for words, so in changed.items() if so]


def changes_of(
    context: bpy.types.Context, objects: Mapping[bpy.types.Object, NDArray[np.bool_] | None]
) -> list[str]:
    """Return what changed since any of several objects was scored; see `changes`.

    Parameters
    ----------
    context : bpy.types.Context
    objects : dict of bpy.types.Object to (N,) bool or None
        With what is protected of each.
    """
    every = (words for obj, mask in objects.items() for words in changes(context, obj, mask))
    return list(dict.fromkeys(every))


def _protected(obj: bpy.types.Object, mask: NDArray[np.bool_] | None) -> list[int]:
    if mask is None and mesh_edit.FORCE in obj.data.attributes:
        mask = mesh_attributes.read_attribute(obj.data, mesh_edit.FORCE) == 1
    return mesh_scores.digest(mask)


def _must_go(obj: bpy.types.Object) -> list[int]:
    return mesh_scores.digest(mesh_edit.marks(obj, mesh_edit.MUST_GO))


def _volumes(scene: bpy.types.Scene) -> list[Any]:
    """Return the volumes that decide what has to go, if any: who, where, and of which shape."""
    listed = demands.listed(scene)
    if all(item.role == "PROTECT" for item in listed):
        return []  # what is protected is scored like the rest; see `_protected`
    volumes, depsgraph = [], bpy.context.evaluated_depsgraph_get()
    for item in listed:
        obj = item.object
        kind = obj.empty_display_type if obj.type == "EMPTY" else obj.type
        size = [obj.empty_display_size] * 3 if obj.type == "EMPTY" else list(obj.dimensions)
        shape = _shape(obj, depsgraph) if obj.type == "MESH" else []
        numbers = [*np.array(obj.matrix_world).ravel().tolist(), *size, *shape]
        volumes.append([item.role, kind, numbers])
    return volumes


def _shape(obj: bpy.types.Object, depsgraph: bpy.types.Depsgraph) -> list[float]:
    """Return numbers that change with the shape of a mesh, modifiers and all.

    A sum over the vertices with fixed uneven weights: any vertex that moves changes it, and noise
    of another machine hardly does.
    """
    mesh = obj.evaluated_get(depsgraph).data
    places = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", places)
    weights = np.cos(np.arange(len(mesh.vertices)))
    return [float(value) for value in weights @ places.reshape(-1, 3)]


def _other_volumes(then: dict[str, Any], scene: bpy.types.Scene) -> bool:
    before, now = then.get("volumes", []), _volumes(scene)
    if [volume[:2] for volume in before] != [volume[:2] for volume in now]:
        return True
    numbers = zip(before, now, strict=True)
    return not all(
        np.allclose(old[2], new[2], rtol=_NOISE, atol=_NOISE * np.abs(old[2]).max())
        for old, new in numbers
    )


def _moved(then: dict[str, Any], scene: bpy.types.Scene, obj: bpy.types.Object) -> bool:
    if "frames" in then and then["frame"] != scene.frame_current:
        return False  # in a shot the views follow the object, which may stand elsewhere by now
    before, now = np.array(then["matrix"]), np.array(obj.matrix_world)
    return bool(np.abs(now - before).max() > _NOISE * np.abs(before).max())


def _deciding(settings: dict[str, Any]) -> dict[str, Any]:
    """What scores depend on: all methods but the closed form score by occlusion."""
    return {"by": settings["method"] == "closed-form", "views": settings["views"]}


def _cameras(context: bpy.types.Context) -> dict[str, Any]:
    """Return numbers that tell the cameras that decide from others; of a shot, its frames."""
    scene, settings = context.scene, context.scene.refine
    if settings.source == "FRAMES":
        frames = settings.to_frames(scene)
        camera = scene.camera.name if scene.camera else ""
        return {"frames": [frames.start, frames.stop, frames.step, camera]}
    cameras = CameraChoice(settings.source, settings.collection).cameras(context)
    (width, height), aspect = render_size(scene)
    frame = (width, height, aspect)
    numbers = np.array([_numbers(camera, frame) for camera in cameras])
    # In any order, and short however many there are.
    sums = [numbers.sum(axis=0).tolist(), (numbers**2).sum(axis=0).tolist()]
    return {"source": settings.source, "cameras": len(cameras), "sums": sums}


def _numbers(camera: bpy.types.Object, frame: tuple[int, int, float]) -> tuple[float, ...]:
    """Return what makes the view of a camera: its matrix row by row, its lens, its weight."""
    matrix, data = camera.matrix_world, camera.data
    weight = camera.get(WEIGHT, 1.0)
    return (
        *(*matrix[0], *matrix[1], *matrix[2]),
        *(data.lens, data.sensor_width, data.sensor_height, data.shift_x, data.shift_y),
        *(data.clip_start, data.clip_end, _FITS.index(data.sensor_fit)),
        *((0, 0, 0) if SOURCE in camera else frame),  # imported ones keep the size of their file
        weight if isinstance(weight, (int, float)) else -1.0,
    )


def _other_cameras(then: dict[str, Any], now: dict[str, Any]) -> bool:
    if "frames" in then or "frames" in now:
        return then.get("frames") != now.get("frames")
    if now["source"] == then["source"] == "SELECTED" and not now["cameras"]:
        return False  # selecting the splats deselects them; those meant are not known
    if now["cameras"] != then["cameras"]:
        return True
    before, after = np.array(then["sums"]), np.array(now["sums"])
    scale = np.array([np.sqrt(then["cameras"] * before[1]), before[1]])  # bounds the sums
    for group in (_AXES, _PLACE):
        scale[:, group] = scale[:, group].max(axis=1, keepdims=True)
    return bool((np.abs(after - before) > _NOISE * scale).any())
