"""Origin of scores, and what changed since: transforms, cameras, settings, not edits of splats.
Cheap, as the panel asks at each draw."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np

from ..cameras.objects import SOURCE, WEIGHT, render_size
from ..cameras.sets import CameraChoice
from ..mesh import attributes as mesh_attributes
from ..mesh import edit as mesh_edit
from ..mesh import scores as mesh_scores

_NOISE = 1e-6  # Relative to the largest number beside it: difference that another machine may make

_FITS = ("AUTO", "HORIZONTAL", "VERTICAL")

_WORDS = {
    "matrix": "object moved",
    "cameras": "cameras changed",
    "must_go": "what must go changed",
    "settings": "settings changed",
}


def origin(context: bpy.types.Context, obj: bpy.types.Object) -> dict[str, Any]:
    """An object's transform, the panel's cameras, and the settings that decide: JSON."""
    method = context.scene.refine.to_method()
    return {
        "matrix": np.array(obj.matrix_world).tolist(),
        "frame": context.scene.frame_current,
        "cameras": _cameras(context),
        "must_go": _marked(obj, 2),
        # All methods but the closed form score by occlusion.
        "settings": [method.name == "closed-form", method.views],
    }


def changes(context: bpy.types.Context, *objects: bpy.types.Object) -> list[str]:
    """Changes since any object was scored, in few words; none without an origin."""
    found: dict[str, None] = {}
    for obj in objects:
        record = mesh_scores.record(obj.data) or {}
        now = origin(context, obj)
        try:
            then = {name: record["origin"][name] for name in now}
            source, others = then["cameras"][0], now["cameras"]
        except (IndexError, KeyError, TypeError):  # whoever wrote there, it was not `origin`
            continue
        if source == "FRAMES" and then["frame"] != now["frame"]:
            then["matrix"] = now["matrix"]  # the views of a shot follow the object, which moves
        if source == "SELECTED" and others[:2] == ["SELECTED", 0]:
            then["cameras"] = others  # selecting the splats deselected them
        found |= {_WORDS[name]: None for name in _WORDS if not _same(then[name], now[name])}
        if record.get("quality") and record.get("protected") != _marked(obj, 1):
            found["what is protected changed"] = None
    return list(found)


def _same(one: Any, other: Any, scale: float = 0.0) -> bool:
    """Whether JSON values are equal up to noise in lists of numbers."""
    if isinstance(one, list) and isinstance(other, list):
        scale = max((abs(each) for each in one if isinstance(each, float)), default=0.0)
        pairs = zip(one, other, strict=False)
        return len(one) == len(other) and all(_same(*pair, scale) for pair in pairs)
    if isinstance(one, float) and isinstance(other, float):
        return abs(one - other) <= _NOISE * scale
    return bool(one == other)


def _marked(obj: bpy.types.Object, kind: int) -> list[int]:
    if mesh_edit.FORCE not in obj.data.attributes:
        return mesh_scores.digest(None)
    return mesh_scores.digest(mesh_attributes.read_attribute(obj.data, mesh_edit.FORCE) == kind)


def _cameras(context: bpy.types.Context) -> list[Any]:
    scene, settings = context.scene, context.scene.refine
    if settings.source == "FRAMES":
        frames = settings.to_frames(scene)
        name = scene.camera.name if scene.camera else ""
        return ["FRAMES", frames.start, frames.stop, frames.step, name]
    cameras = CameraChoice(settings.source, settings.collection).cameras(context)
    chosen = ["SELECTED" if settings.source == "SELECTED" else "OTHERS", len(cameras)]
    if not cameras:
        return chosen
    (width, height), aspect = render_size(scene)
    numbers = np.array([_numbers(camera, (width, height, aspect)) for camera in cameras])
    # In any order, and short however many there are: (2, C).
    means = np.array([numbers.mean(axis=0), np.sqrt((numbers**2).mean(axis=0))])
    axes, place, rest = np.split(means, (9, 12), axis=1)
    return [*chosen, axes.ravel().tolist(), place.ravel().tolist(), *rest.T.tolist()]


def _numbers(camera: bpy.types.Object, frame: tuple[int, int, float]) -> tuple[float, ...]:
    matrix, data = np.array(camera.matrix_world), camera.data
    weight = camera.get(WEIGHT, 1.0)
    return (
        *(*matrix[:3, :3].ravel(), *matrix[:3, 3]),
        *(data.lens, data.sensor_width, data.sensor_height, data.shift_x, data.shift_y),
        *(data.clip_start, data.clip_end, _FITS.index(data.sensor_fit)),
        *((0, 0, 0) if SOURCE in camera else frame),  # imported ones keep the size of their file
        weight if isinstance(weight, (int, float)) else -1.0,
    )
