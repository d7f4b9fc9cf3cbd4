"""Blender's own Gaussian splats: a point cloud with activated values under names of its own.

Blender 5.3 imports 3DGS files as point clouds of type ``GAUSSIAN_SPLAT``. What its importers write
is in docs/conventions.md; the attributes alone decide here, so that such a point cloud is known in
older versions too, and one that geometry nodes made.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import bpy
from numpy.typing import NDArray

from ..core.errors import RefineError
from ..core.splats import opacity, scales, single_log_scales, single_logits

BASE, SCALE, ROTATION, HARMONIC = "radiance:base", "scale", "rotation", "radiance:sh_"

TYPE = "GAUSSIAN_SPLAT"
"""Of point clouds that Blender draws as splats, since 5.3."""

NAMES = f"{BASE}, {SCALE}, {ROTATION}"
"""For messages."""

FOUR_FLOATS = ("FLOAT4", "FLOAT_COLOR")
"""Types of `BASE`: that of 5.3, and what holds the same four numbers in 5.0 and older, which have
no ``FLOAT4``."""

_MOST = 24
"""Harmonics of degree 4, beyond the constant."""


class Coding(NamedTuple):
    """How values of a file become those of an attribute, and back, in float64."""

    to_file: Callable[[NDArray[Any]], NDArray[Any]]
    to_attribute: Callable[[NDArray[Any]], NDArray[Any]]


LOG = Coding(single_log_scales, scales)
LOGIT = Coding(single_logits, opacity)


class Place(NamedTuple):
    """Where a mesh or point cloud holds a property of the file.

    Attributes
    ----------
    attribute : str
        Name of the attribute.
    component : int
        Which number of a vector; 0 for plain attributes.
    kinds : tuple of str
        Types that the attribute may have; the first is the one to make.
    coding : Coding, optional
        Where it is not held as it stands in the file.
    """

    attribute: str
    component: int
    kinds: tuple[str, ...]
    coding: Coding | None = None


def is_native(data: bpy.types.ID) -> bool:
    """Tell whether an object's data is a point cloud with the attributes of Blender's splats."""
    attributes = getattr(data, "attributes", ())
    return hasattr(data, "points") and BASE in attributes and SCALE in attributes


def harmonics(cloud: bpy.types.PointCloud) -> int:
    """Return how many attributes a point cloud has for harmonics beyond the constant."""
    return sum(f"{HARMONIC}{index}" in cloud.attributes for index in range(_MOST))


def places(count: int) -> dict[str, Place]:
    """Return where a point cloud with `count` harmonics holds the properties of a splat.

    The number in the name of a harmonic counts as in the file, without the constant: ``sh_10``
    comes after ``sh_9``. Each holds red, green and blue, where a file has all of red first.
    """
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
    """Tell whether an object is what an older Blender leaves of 5.3's splats: all but `BASE`."""
    if obj.type != "POINTCLOUD":
        return False
    attributes = obj.data.attributes
    rest = SCALE in attributes and ROTATION in attributes and "f_dc_0" not in attributes
    return rest and BASE not in attributes


def refuse_lost_base(obj: bpy.types.Object) -> None:
    """Raise `RefineError` for what is left of Blender's splats where their colours were lost."""
    if lost_base(obj):
        raise RefineError(
            f"object '{obj.name}': has no attribute {BASE}, which holds colour and opacity: "
            "Blender 5.0 and older drop it where they open a file of 5.3; use 5.2 or later"
        )
