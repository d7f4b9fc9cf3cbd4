"""Camera models that files can name, and notes about models that are not pinholes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Model:
    """A camera model. Its parameters are the focal lengths, cx, cy, then those of distortion.

    Attributes
    ----------
    name : str
        As in ``cameras.txt``.
    focals : int
        Number of focal lengths: 2, 1 if fx = fy, or 0 for a panorama.
    count : int
        Number of parameters.
    fisheye : bool
        Whether the distance from the centre grows with the angle, not with its tangent.
    """

    name: str
    focals: int
    count: int
    fisheye: bool = False


MODELS = {
    0: Model("SIMPLE_PINHOLE", 1, 3),
    1: Model("PINHOLE", 2, 4),
    2: Model("SIMPLE_RADIAL", 1, 4),
    3: Model("RADIAL", 1, 5),
    4: Model("OPENCV", 2, 8),
    5: Model("OPENCV_FISHEYE", 2, 8, fisheye=True),
    6: Model("FULL_OPENCV", 2, 12),
    7: Model("FOV", 2, 5),
    8: Model("SIMPLE_RADIAL_FISHEYE", 1, 4, fisheye=True),
    9: Model("RADIAL_FISHEYE", 1, 5, fisheye=True),
    10: Model("THIN_PRISM_FISHEYE", 2, 12, fisheye=True),
    11: Model("RAD_TAN_THIN_PRISM_FISHEYE", 2, 16, fisheye=True),
    12: Model("SIMPLE_DIVISION", 1, 4),
    13: Model("DIVISION", 2, 5),
    14: Model("SIMPLE_FISHEYE", 1, 3, fisheye=True),
    15: Model("FISHEYE", 2, 4, fisheye=True),
    16: Model("EUCM", 2, 6),
    17: Model("EQUIRECTANGULAR", 0, 2),
}
"""COLMAP's camera models by their number in ``cameras.bin``."""

MODELS_BY_NAME = {model.name: model for model in MODELS.values()}


FISHEYE624 = Model("FISHEYE624", 1, 15, fisheye=True)
"""nerfstudio's model of Project Aria's lenses; COLMAP has no number for it."""

PANORAMAS = {
    *("EQUIRECTANGULAR", "OMNIDIRECTIONALSTEREO_L", "OMNIDIRECTIONALSTEREO_R"),
    *("VR180_L", "VR180_R", "ORTHOPHOTO"),
}
"""Models of nerfstudio and COLMAP that a pinhole cannot approximate."""


def counted(count: int, thing: str) -> str:
    """A count and a noun, with a plural s if the count is not 1."""
    return f"{count} {thing}" if count == 1 else f"{count} {thing}s"


def lens_note(counts: Mapping[Model, int], thing: str) -> str:
    """Note about lenses that are not pinholes, or "" if there are none.

    Parameters
    ----------
    counts : mapping of Model to int
        How many things have each model.
    thing : str
        What is counted, in the singular: "camera" or "frame".
    """
    ways = {
        True: "{} (fisheye, {}) taken as pinhole: wrong away from the centre",
        False: "distortion of {} ignored (model {})",
    }
    return "; ".join(
        ways[model.fisheye].format(counted(count, thing), model.name)
        for model, count in counts.items()
    )
