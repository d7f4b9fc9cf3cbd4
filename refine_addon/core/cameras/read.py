"""Cameras from files: Inria ``cameras.json``, ``transforms.json`` and COLMAP models.

Values are checked and used as stored: nothing that would move a camera is guessed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from ..views import View, ViewSet
from ..whole_file import expanded
from .colmap import MODEL_FILES, SUFFIXES, find_colmap, read_colmap
from .nerfstudio import read_transforms
from .place import CameraPlace, is_file, is_folder, kind_of, read_json

INRIA_KEYS = ("position", "rotation", "fx", "fy", "width", "height")  # required

JSON_NAMES = ("cameras.json", "transforms.json", "transforms_train.json")
"""Names of camera files in the order in which a folder is searched; a COLMAP model comes last."""


def read_cameras(path: Path | str) -> ViewSet:
    """Read the cameras of a scene, in the order of the file; COLMAP's sorted by name.

    Parameters
    ----------
    path : path-like
        A ``cameras.json`` of the reference 3DGS implementation, a ``transforms.json`` of nerfstudio
        or instant-ngp, any file of a COLMAP model, or a folder, searched for these in this order
        (models in itself, ``sparse/0``, ``sparse``, ``colmap/sparse/0``). ``~`` is the home folder.

    Returns
    -------
    ViewSet : its note names distortion, which is ignored, and other cameras in the folder

    Raises
    ------
    RefineError : if the file is missing or wrong; with the place in the file
    """
    path = expanded(path)
    if is_folder(path):
        return _read_folder(path)
    if not is_file(path):
        problem = "is neither a file nor a folder" if kind_of(path) else "no such file or folder"
        CameraPlace(path).fail(f"{problem}, expected cameras")
    if path.suffix in SUFFIXES and path.stem in MODEL_FILES:
        return read_colmap(path.parent, path.suffix)
    return _read_json_cameras(path)


def cameras_in(folder: Path) -> list[Path]:
    """JSON files and the COLMAP model in a folder; `read_cameras` reads the first of them."""
    files = [folder / name for name in JSON_NAMES if is_file(folder / name)]
    colmap = find_colmap(folder)
    return [*files, colmap[0]] if colmap else files


def _read_folder(folder: Path) -> ViewSet:
    sources, colmap = cameras_in(folder), find_colmap(folder)
    if not sources:
        CameraPlace(folder).fail(
            f"no cameras in this folder, expected {', '.join(JSON_NAMES)}, or a COLMAP model "
            "(cameras and images, both .bin or both .txt) in it, sparse/0 or sparse"
        )
    views = read_colmap(*colmap) if colmap and not sources[1:] else _read_json_cameras(sources[0])
    others = [
        f"COLMAP model in {each.relative_to(folder).as_posix()}" if is_folder(each) else each.name
        for each in sources[1:]
    ]
    unused = f"read {sources[0].name}, not {', '.join(others)}" if others else ""
    return replace(views, note="; ".join(filter(None, (views.note, unused))))


def _read_json_cameras(path: Path) -> ViewSet:
    data, place = read_json(path), CameraPlace(path)
    if isinstance(data, list):
        if not data:
            place.fail("the list of cameras is empty, expected at least one")
        return ViewSet(tuple(_inria_view(place, index, item) for index, item in enumerate(data)))
    if not isinstance(data, dict) or "frames" not in data:
        place.expected(
            "a list of cameras (cameras.json) or an object with 'frames' (transforms.json)", data
        )
    return read_transforms(path, data)


def _inria_view(file: CameraPlace, index: int, item: object) -> View:
    """View of a reference 3DGS camera; ``rotation`` is camera to world, ``cx`` is optional."""
    place = file.at(f"camera {index}")
    camera = place.members(item)
    if "transform" in camera and "position" not in camera:
        place.fail(
            "poses of `ns-export cameras` have no focal length; read transforms.json instead"
        )
    place.members(item, INRIA_KEYS)
    at = place.at("'rotation'")
    axes = at.rotation(at.matrix(camera["rotation"], (3,), 3))
    if np.linalg.det(axes) < 0:
        at.fail("expected a rotation, got a reflection (determinant -1)")
    size = [place.at(repr(key)).side(camera[key]) for key in ("width", "height")]
    focal = [place.at(repr(key)).focal(camera[key]) for key in ("fx", "fy")]
    center = np.array(place.at("'position'").numbers(camera["position"], 3))
    name = place.at("'img_name'").text(camera.get("img_name", str(index)))
    return place.view(name, (axes.T, center), [*focal, *place.principal(camera, size), *size])
