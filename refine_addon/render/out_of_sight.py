"""Objects that a render leaves out for a while, each marked until it is as it was.

Lights go on to shine on them, and they to cast shadows. What an undo or a file brings back of a
render that is over is found by the mark.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress

import bpy

_MARK = "refine_out_of_sight"
"""Custom property of such an object: the property that was changed."""

_BY_RAYS = {"MESH", "CURVE", "SURFACE", "FONT", "META", "VOLUME", "CURVES"}
"""Objects that cameras can be told not to see; EEVEE does not look at that for instances."""


@contextmanager
def out_of_sight(objects: Iterable[bpy.types.Object]) -> Iterator[None]:
    """Leave objects out of renders within the block."""
    for obj in objects:
        seen_by_rays = obj.type in _BY_RAYS and obj.instance_type == "NONE"
        name = "visible_camera" if seen_by_rays else "hide_render"
        if getattr(obj, name) == seen_by_rays:  # else the scene leaves it out already
            obj[_MARK] = name
            setattr(obj, name, not seen_by_rays)
    try:
        yield
    finally:
        restore()


def restore() -> None:
    """Show all objects again that are left out."""
    for obj in bpy.data.objects:
        name = obj.get(_MARK)
        if name is not None:
            setattr(obj, name, name == "visible_camera")
            with suppress(KeyError):
                del obj[_MARK]
