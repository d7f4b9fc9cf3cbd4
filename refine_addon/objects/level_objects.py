"""Levels of detail as objects beside the one that they were made of."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

import bpy

from ..core.levels.files import GOAL
from ..mesh.layout import SplatObject, check
from . import splat_object

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from ..core.levels.lod import Level

FACTS = "refine_lod"
"""Custom property of the object of a level: what is known of it, as in the manifest of files."""


def add_levels(checked: SplatObject, levels: Sequence[Level]) -> bpy.types.Collection:
    """Make an object of each level, in a new collection of the scene; the original stays.

    The objects are copies of the original in all but the splats. They are named after it with
    ``_lod1`` and so on, and hidden, in renders too: all stand where the original does.

    Parameters
    ----------
    checked : SplatObject
        The original.
    levels : sequence of Level
        Of its splats as they stand in the world.

    Raises
    ------
    RefineError
        See `splat_object.apply_object`; nothing is left of the levels then.
    """
    name = checked.obj.name
    collection = bpy.data.collections.new(f"{name} levels")
    with _nothing_left(collection):
        bpy.context.scene.collection.children.link(collection)
        for level in levels:
            copy = checked.obj.copy()
            collection.objects.link(copy)
            copy.data = checked.obj.data.copy()
            copy.name = copy.data.name = f"{name}_lod{level.number}"
            bpy.context.view_layer.update()  # its place in the world
            splat_object.apply_object(check(copy), level)
            facts = level.facts(GOAL)
            copy[FACTS] = {key: value for key, value in facts.items() if value is not None}
            copy.select_set(False)
        for obj in collection.objects:  # all stand in one place
            obj.hide_set(True)
            obj.hide_render = True
    return collection


@contextmanager
def _nothing_left(collection: bpy.types.Collection) -> Iterator[None]:
    """Remove a new collection with its objects and their data if the block fails."""
    try:
        yield
    except BaseException:
        data = [obj.data for obj in collection.objects]
        for obj in list(collection.objects):
            bpy.data.objects.remove(obj)
        bpy.data.batch_remove(data)
        bpy.data.collections.remove(collection)
        raise
