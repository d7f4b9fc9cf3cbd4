"""Blender's own Gaussian splats: a point cloud with activated values, named differently.
Blender 5.3 imports 3DGS files as point clouds of type ``GAUSSIAN_SPLAT`` (docs/conventions.md).
Attributes alone decide here, so older versions and geometry nodes work too."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import bpy
from numpy.typing import NDArray

from ..core.errors import RefineError
from ..core.splats import opacity, scales, single_log_scales, single_logits

BASE, SCALE, ROTATION, HARMONIC = "radiance:base", "scale", "rotation", "radiance:sh_"

TYPE = "GAUSSIAN_SPLAT"  # Type of point clouds that Blender draws as splats, since 5.3

NAMES = f"{BASE}, {SCALE}, {ROTATION}"

FOUR_FLOATS = ("FLOAT4", "FLOAT_COLOR")  # Types of `BASE`: 5.3's, and that of 5.0 without it

_MOST = 24  # Harmonics of degree 4, without the constant


class Coding(NamedTuple):
    """Conversion of a file's values to those of an attribute and back, float64."""

    to_file: Callable[[NDArray[Any]], NDArray[Any]]
    to_attribute: Callable[[NDArray[Any]], NDArray[Any]]


LOG = Coding(single_log_scales, scales)
LOGIT = Coding(single_logits, opacity)


class Place(NamedTuple):
    """Attribute, vector component (0 for plain ones), allowed types (the first is made), and coding
    (None where stored as in the file) of a property."""

    attribute: str
    component: int
    kinds: tuple[str, ...]
    coding: Coding | None = None


def is_native(data: bpy.types.ID) -> bool:
    """Whether an object's data is a point cloud with the attributes of Blender's splats."""
    attributes = getattr(data, "attributes", ())
    return hasattr(data, "points") and BASE in attributes and SCALE in attributes


def harmonics(cloud: bpy.types.PointCloud) -> int:
    """Attributes of a point cloud for harmonics, without the constant."""
    return sum(f"{HARMONIC}{index}" in cloud.attributes for index in range(_MOST))


def places(count: int) -> dict[str, Place]:
    """Places of a splat's properties in a point cloud with `count` harmonics.
    ``sh_10`` follows ``sh_9``; each holds RGB, where a file has all of red first."""
    by_name = {f"f_dc_{channel}": Place(BASE, channel, FOUR_FLOATS) for channel in range(3)}
    for channel in range(3):
        for index in range(count):
            place = Place(f"{HARMONIC}{index}", channel, ("FLOAT_VECTOR",))
            by_name[f"f_rest_{channel * count + index}"] = place
    by_name["opacity"] = Place(BASE, 3, FOUR_FLOATS, LOGIT)
    for axis in range(3):
        by_name[f"scale_{axis}"] = Place(SCALE, axis, ("FLOAT_VECTOR",), LOG)
    for index in range(4):
        by_name[f"rot_{index}"] = Place(ROTATION, index, ("QUATERNION",))
    return by_name


def lost_base(obj: bpy.types.Object) -> bool:
    """Whether an object is what an older Blender leaves of 5.3's splats: all but `BASE`."""
    if obj.type != "POINTCLOUD":
        return False
    attributes = obj.data.attributes
    rest = SCALE in attributes and ROTATION in attributes and "f_dc_0" not in attributes
    return rest and BASE not in attributes


def refuse_lost_base(obj: bpy.types.Object) -> None:
    """Raise `RefineError` for Blender's splats that lost their colours (`lost_base`)."""
    if lost_base(obj):
        raise RefineError(
            f"object '{obj.name}': has no attribute {BASE}, which holds colour and opacity: "
            "Blender 5.0 and older drop it where they open a file of 5.3; use 5.2 or later"
        )
