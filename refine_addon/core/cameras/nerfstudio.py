"""``transforms.json`` of nerfstudio, instant-ngp and the NeRF synthetic scenes.

``transform_matrix`` is camera to world in OpenGL axes (x right, y up, z back) and used as stored;
``applied_*``, ``scale``, ``offset`` and ``aabb*`` are ignored. nerfstudio trains and exports in
another frame: a ``dataparser_transforms.json`` beside the file, which leads there, is applied.
Principal points are measured from the upper left corner; pixel centres are at k + 0.5.
"""

from __future__ import annotations

import math
from collections import ChainMap, Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ..images import image_size
from ..views import ORTHONORMAL, ViewSet
from .colmap import MODELS_BY_NAME, Model, counted, lens_note
from .place import CameraPlace, is_file, is_folder, read_json

DATAPARSER_FILE = "dataparser_transforms.json"
OPENGL_TO_OPENCV = np.array([1.0, -1.0, -1.0])  # factors on axes: y up to down, z back to forward
LEAST_SCALE, LARGEST_SCALE = 1e-6, 1e6  # of a ``transform_matrix``; divided out if in between
DISTORTIONS = ("k1", "k2", "k3", "k4", "p1", "p2")
PANORAMA_KEYS = ("equirectangular", "latlong")  # of instant-ngp

LENSES = {**MODELS_BY_NAME, "FISHEYE624": Model("FISHEYE624", 1, 15)}
"""Models by name; that of Project Aria's lenses has no number in COLMAP."""

IMAGE_SUFFIXES = ("", ".png", ".jpg", ".jpeg")  # tried for sizes; NeRF synthetic names lack one

LEGACY_TRANSFORM = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""nerfstudio's assumption for older COLMAP projects, which have no ``applied_transform``."""


def read_transforms(path: Path, data: object) -> ViewSet:
    """Views of a ``transforms.json``, in its order; missing image sizes are those of the images."""
    place = CameraPlace(path)
    shared = place.members(data, ("frames",))
    frames = place.at("'frames'").items(shared["frames"])
    if not frames:
        place.at("'frames'").fail("the list is empty, expected at least one frame")
    world, notes = _splat_world(place, shared)
    lenses: Counter[Model] = Counter()
    remarks: Counter[str] = Counter()
    views = []
    for index, item in enumerate(frames):
        at = place.at(f"frame {index}")
        frame = at.members(item, ("transform_matrix",))
        values = ChainMap(frame, shared)  # a frame's own keys override those of the whole file
        views.append(_view(at, values, str(index), world, remarks))
        lenses.update(_lens(at, values))
    notes += [f"{text} of {counted(count, 'frame')}" for text, count in remarks.items()]
    return ViewSet(tuple(views), "; ".join(filter(None, (lens_note(lenses, "frame"), *notes))))


def _view(place, values, name, world, remarks):
    name = place.at("'file_path'").text(values.maps[0].get("file_path", name))
    axes, center = _pose(place.at("'transform_matrix'"), values["transform_matrix"], remarks)
    size = _size(place, values, name)
    focal = [_focal(place, values.maps, *along) for along in zip("xy", size, strict=True)]
    if not any(focal):
        place.fail("missing 'fl_x', expected fl_x, fl_y, camera_angle_x or camera_angle_y")
    both = [focal[0] or focal[1], focal[1] or focal[0]]
    rotation, offset, scale = world
    pose = (rotation @ axes).T, scale * (rotation @ center + offset)
    return place.view(name, pose, [*both, *place.principal(values, size), *size])


def _pose(place, value, remarks):
    """Camera axes (x right, y down, z forward) as columns, without a scale, and centre."""
    matrix = place.matrix(value, (3, 4), 4)
    if len(matrix) > 3 and np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
        place.at("row 3").fail(f"expected [0, 0, 0, 1], got {matrix[3].tolist()}")
    scale = float(np.sqrt(np.sum(matrix[:3, :3] ** 2) / 3))
    if not LEAST_SCALE <= scale <= LARGEST_SCALE:
        scale = 1.0
    axes = place.rotation(matrix[:3, :3] / scale)
    if abs(scale - 1) > ORTHONORMAL:
        remarks["uniform scale taken out"] += 1
    if np.linalg.det(axes) < 0:
        remarks["mirrored pose (determinant -1)"] += 1
    return axes * OPENGL_TO_OPENCV, matrix[:3, 3]


def _size(place: CameraPlace, values: Mapping[str, Any], name: str) -> list[int]:
    """Width and height from their keys, or from the image if a key is missing."""
    missing = [key for key in ("w", "h") if key not in values]
    if not missing:
        return [place.at(repr(key)).side(values[key]) for key in ("w", "h")]
    base = place.path.parent / name.replace("\\", "/")
    sizes = (image_size(Path(f"{base}{suffix}")) for suffix in IMAGE_SUFFIXES)
    size = next(filter(None, sizes), None)
    if size is None:
        wanted = f"w and h (pixels), or a PNG or JPEG image at {name[:80]!r}"
        place.fail(f"missing {missing[0]!r}, expected {wanted}")
    return [place.at("'file_path'").side(side) for side in size]


def _focal(place, sources, axis, side):
    """Focal length along an axis by the first key that exists, or 0."""
    for keys in sources:
        if f"fl_{axis}" in keys:
            return place.at(f"'fl_{axis}'").focal(keys[f"fl_{axis}"])
        for key, unit in ((f"camera_angle_{axis}", 1.0), (f"{axis}_fov", math.pi / 180)):
            if key in keys:
                at = place.at(repr(key))
                angle = at.number(keys[key]) * unit
                if not 0 < angle < math.pi:
                    at.expected("a field of view below 180°", keys[key])
                return at.focal(side / 2 / math.tan(angle / 2))
    return 0.0


def _lens(place: CameraPlace, values: Mapping[str, Any]) -> list[Model]:
    """The camera model in a list, empty for a pinhole; panoramas are refused."""
    at = place.at("'camera_model'")
    distorted = any(values.get(key) for key in DISTORTIONS)
    fisheye = "ftheta_p0" in values or (distorted and values.get("is_fisheye"))
    name = at.text(values.get("camera_model", "OPENCV_FISHEYE" if fisheye else "OPENCV"))
    panorama = next((key for key in PANORAMA_KEYS if key in values), "")
    model = LENSES.get(name)
    if panorama or (model and not model.focals):
        what = panorama or name
        place.fail(f"{what!r} cameras are not pinholes, expected a perspective camera")
    if model is None:
        models = ", ".join(lens for lens in LENSES if LENSES[lens].focals)
        at.fail(f"unknown model {name[:40]!r}, expected one of {models}")
    return [model] if model.fisheye or distorted else []


def _splat_world(place: CameraPlace, shared: Mapping[str, Any]) -> tuple[Any, list[str]]:
    """Rotation, offset, scale to the splats' world, ``scale * (rotation @ p + offset)``; notes."""
    beside = CameraPlace(place.path.parent / DATAPARSER_FILE)
    if not is_file(beside.path):
        hint = f"splats of ns-export need {DATAPARSER_FILE} beside it"
        return (np.eye(3), np.zeros(3), 1.0), [hint] if "applied_transform" in shared else []
    parsed = beside.members(read_json(beside.path), ("transform", "scale"))
    at = beside.at("'transform'")
    matrix = at.matrix(parsed["transform"], (3,), 4)
    rotation = at.rotation(matrix[:, :3])
    scale = beside.at("'scale'").positive(parsed["scale"], "scale")
    # It applies to poses before `applied_transform` and `applied_scale`, so undo these first.
    at = place.at("'applied_transform'")
    applied = np.eye(3, 4)
    if "applied_transform" in shared:
        applied = at.matrix(shared["applied_transform"], (3, 4), 4)
    elif is_folder(place.path.parent / "colmap" / "sparse" / "0"):
        applied[:, :3] = LEGACY_TRANSFORM
    turned = rotation @ at.rotation(applied[:3, :3]).T
    offset = matrix[:, 3] - turned @ applied[:3, 3]
    scale /= place.at("'applied_scale'").positive(shared.get("applied_scale", 1.0), "scale")
    return (turned, offset, scale), [f"{DATAPARSER_FILE} applied"]
