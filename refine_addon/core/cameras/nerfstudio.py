"""``transforms.json`` of nerfstudio, instant-ngp and the NeRF synthetic scenes.

``transform_matrix`` is camera to world in OpenGL axes (x right, y up, z back). Poses are used as
stored. nerfstudio's ``applied_transform`` and ``applied_scale`` describe what was done to them
before; instant-ngp's ``scale``, ``offset`` and ``aabb*`` what it does internally. So the views are
in the world of a splat file that a trainer without a transform of its own makes of this file.

nerfstudio's own training rotates, centres and scales the poses, and ``ns-export`` writes splats in
that frame. The run records the change in ``dataparser_transforms.json``; if that file lies beside
the ``transforms.json``, it is applied here.

Principal points are measured from the image's upper left corner, and pixel centres are at k + 0.5.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..views import ORTHONORMAL, View, ViewSet
from .image_size import image_size
from .lenses import FISHEYE624, MODELS_BY_NAME, PANORAMAS, Model, counted, lens_note
from .place import CameraPlace, is_file, is_folder, read_json

DATAPARSER_FILE = "dataparser_transforms.json"

OPENGL_TO_OPENCV = np.array([1.0, -1.0, -1.0])
"""Factors on a camera's axes: y up becomes y down, z back becomes z forward."""

LEAST_SCALE, LARGEST_SCALE = 1e-6, 1e6
"""Range of uniform scales that are removed from a ``transform_matrix``."""

DISTORTIONS = ("k1", "k2", "k3", "k4", "p1", "p2")
PANORAMA_KEYS = ("equirectangular", "latlong")
"""Keys that mark a panorama for instant-ngp."""

LENSES = {**MODELS_BY_NAME, "FISHEYE624": FISHEYE624}
IMAGE_SUFFIXES = ("", ".png", ".jpg", ".jpeg")
"""Suffixes tried when the size is read from the image; names of NeRF synthetic scenes have none."""

LEGACY_TRANSFORM = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""What nerfstudio assumes for older COLMAP projects, which have no ``applied_transform``."""


@dataclass(frozen=True, eq=False)
class _Similarity:
    """``p -> scale * (rotation @ p + offset)``: from the world of the file to the splats'."""

    rotation: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    offset: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    scale: float = 1.0


def read_transforms(path: Path, data: object) -> ViewSet:
    """Return the views of a ``transforms.json``, in the order of its frames.

    Parameters
    ----------
    path : Path
        The file. If ``w`` and ``h`` are missing, images are looked for beside it.
    data : object
        Its content.

    Raises
    ------
    RefineError
        If a key is missing or wrong, with the frame and the key.
    """
    place = CameraPlace(path)
    shared = place.members(data, ("frames",))
    frames = place.at("'frames'").items(shared["frames"])
    if not frames:
        place.at("'frames'").fail("the list is empty, expected at least one frame")
    world, notes = _splat_world(place, shared)
    lenses: Counter[Model] = Counter()
    poses: Counter[str] = Counter()
    views = []
    for index, item in enumerate(frames):
        entry = _Entry(place.at(f"frame {index}"), shared, item, index)
        views.append(entry.view(world))
        lenses.update(entry.lens())
        poses.update(entry.remarks)
    notes += [f"{text} of {counted(count, 'frame')}" for text, count in poses.items()]
    return ViewSet(tuple(views), "; ".join(filter(None, (lens_note(lenses, "frame"), *notes))))


class _Entry:
    """One item of ``frames``; its own keys override those of the whole file."""

    def __init__(
        self, place: CameraPlace, shared: Mapping[str, Any], item: object, index: int
    ) -> None:
        self.place = place
        self.shared = shared
        self.frame = place.members(item, ("transform_matrix",))
        self.name = place.at("'file_path'").text(self.frame.get("file_path", str(index)))
        self.remarks: list[str] = []

    def has(self, key: str) -> bool:
        return key in self.frame or key in self.shared

    def get(self, key: str) -> object:
        return self.frame[key] if key in self.frame else self.shared[key]

    def at(self, key: str) -> CameraPlace:
        return self.place.at(repr(key))

    def view(self, world: _Similarity) -> View:
        axes, center = self.pose()
        width, height = self.size()
        fx, fy = self.focal(width, height)
        cx, cy = (
            self.at(key).number(self.get(key)) if self.has(key) else side / 2
            for key, side in (("cx", width), ("cy", height))
        )
        rotation = (world.rotation @ axes).T
        center = world.scale * (world.rotation @ center + world.offset)
        return self.place.view(self.name, rotation, center, (fx, fy), (cx, cy), (width, height))

    def pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the camera's axes (x right, y down, z forward) as columns, and its centre.

        A uniform scale only moves points along rays through the centre, which does not change the
        picture, so it is removed.
        """
        place = self.at("transform_matrix")
        matrix = place.matrix(self.frame["transform_matrix"], (3, 4), 4)
        if len(matrix) > 3 and np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
            place.at("row 3").fail(f"expected [0, 0, 0, 1], got {matrix[3].tolist()}")
        axes, scale = _without_scale(place, matrix[:3, :3])
        if abs(scale - 1) > ORTHONORMAL:
            self.remarks.append("uniform scale taken out")
        if np.linalg.det(axes) < 0:
            self.remarks.append("mirrored pose (determinant -1)")
        return axes * OPENGL_TO_OPENCV, matrix[:3, 3]

    def size(self) -> tuple[int, int]:
        """Return width and height from their keys, or from the image if a key is missing."""
        if self.has("w") and self.has("h"):
            width, height = (self.at(key).side(self.get(key)) for key in ("w", "h"))
            return width, height
        place = self.at("file_path")
        base = place.path.parent / self.name.replace("\\", "/")
        sizes = (image_size(Path(f"{base}{suffix}")) for suffix in IMAGE_SUFFIXES)
        size = next(filter(None, sizes), None)
        if size is None:
            missing = "w" if not self.has("w") else "h"
            self.place.fail(
                f"missing {missing!r}, expected w and h (pixels), or a PNG or JPEG image at "
                f"{self.name[:80]!r}"
            )
        return place.side(size[0]), place.side(size[1])

    def focal(self, width: int, height: int) -> tuple[float, float]:
        """Return fx and fy; if only one of them is given, both are the same."""
        fx, fy = self.axis_focal("x", width), self.axis_focal("y", height)
        if fx is None and fy is None:
            self.place.fail("missing 'fl_x', expected fl_x, fl_y, camera_angle_x or camera_angle_y")
        return fx or fy or 0.0, fy or fx or 0.0

    def axis_focal(self, axis: str, side: int) -> float | None:
        """Return the focal length along an axis by the first key that exists, or None."""
        for keys in (self.frame, self.shared):
            key = f"fl_{axis}"
            if key in keys:
                return self.at(key).focal(keys[key])
            for key, unit in ((f"camera_angle_{axis}", 1.0), (f"{axis}_fov", math.pi / 180)):
                if key in keys:
                    angle = self.at(key).number(keys[key]) * unit
                    if not 0 < angle < math.pi:
                        self.at(key).fail(f"expected a field of view below 180°, got {keys[key]}")
                    return self.at(key).focal(side / 2 / math.tan(angle / 2))
        return None

    def lens(self) -> list[Model]:
        """Return the camera model in a list, which is empty for a pinhole; refuse panoramas."""
        distorted = any(self.has(key) and self.get(key) for key in DISTORTIONS)
        name = "OPENCV"
        if self.has("camera_model"):
            name = self.at("camera_model").text(self.get("camera_model"))
        elif self.has("ftheta_p0") or (
            distorted and self.has("is_fisheye") and self.get("is_fisheye")
        ):
            name = "OPENCV_FISHEYE"
        panoramas = [key for key in PANORAMA_KEYS if self.has(key)]
        if name in PANORAMAS or panoramas:
            what = repr(name if name in PANORAMAS else panoramas[0])
            self.place.fail(f"{what} cameras are not pinholes, expected a perspective camera")
        if name not in LENSES:
            known = ", ".join(model for model in LENSES if model not in PANORAMAS)
            self.at("camera_model").fail(f"unknown model {name[:40]!r}, expected one of {known}")
        model = LENSES[name]
        return [model] if model.fisheye or distorted else []


def _without_scale(
    place: CameraPlace, matrix: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Return a matrix (3, 3) without its uniform scale, orthonormal, and that scale.

    Raise `RefineError` if the scale is not uniform or out of range, or the axes are not at right
    angles.
    """
    if np.abs(matrix).max() <= LARGEST_SCALE:
        scale = float(np.sqrt(np.sum(matrix * matrix) / 3))
        if scale >= LEAST_SCALE:
            return place.rotation(matrix / scale), scale
    return place.rotation(matrix), 1.0


def _splat_world(place: CameraPlace, shared: Mapping[str, Any]) -> tuple[_Similarity, list[str]]:
    """Return the transform from the file's world to the splats', and notes about it."""
    beside = place.path.parent / DATAPARSER_FILE
    if not is_file(beside):
        hint = f"splats of ns-export need {DATAPARSER_FILE} beside it"
        return _Similarity(), [hint] if "applied_transform" in shared else []
    source = CameraPlace(beside)
    parsed = source.members(read_json(beside), ("transform", "scale"))
    at = source.at("'transform'")
    matrix = at.matrix(parsed["transform"], (3,), 4)
    rotation = at.rotation(matrix[:, :3])
    scale = source.at("'scale'").positive(parsed["scale"], "scale")
    # It applies to poses before `applied_transform` and `applied_scale`, so undo these first.
    at = place.at("'applied_transform'")
    applied = np.zeros((3, 4))
    applied[:, :3] = np.eye(3)
    if "applied_transform" in shared:
        applied = at.matrix(shared["applied_transform"], (3, 4), 4)
    elif is_folder(place.path.parent / "colmap" / "sparse" / "0"):
        applied[:, :3] = LEGACY_TRANSFORM
    turned = rotation @ at.rotation(applied[:3, :3]).T
    offset = matrix[:, 3] - turned @ applied[:3, 3]
    scale /= place.at("'applied_scale'").positive(shared.get("applied_scale", 1.0), "scale")
    return _Similarity(turned, offset, scale), [f"{DATAPARSER_FILE} applied"]
