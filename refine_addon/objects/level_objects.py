"""Levels of detail as objects beside their original."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import bpy

from ..core.errors import RefineError
from ..core.lod import Level
from ..mesh.layout import SplatObject, check
from . import splat_group

FACTS = "refine_lod"  # Custom property of a level object: its stats, as in the report of files

LEVEL_OF = "refine_level_of"  # Custom property of a level object: its original


def add_levels(
    checked: SplatObject, levels: Sequence[Level], distance: float
) -> bpy.types.Collection:
    """Copy the original as an object for each level, ``_lod1`` and so on, in a new collection.
    Hidden, as all stand in one place; nothing is left on an error. `distance`: views to scene."""
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
            group = [check(copy)]
            frames = splat_group.frames_of(group)
            splat_group.apply(group, splat_group.changes(frames, level.result))
            facts = {**level.facts(), "distance": distance}
            copy[LEVEL_OF] = checked.obj
            copy[FACTS] = {key: value for key, value in facts.items() if value is not None}
            copy.select_set(False)
        for obj in collection.objects:  # all stand in one place
            obj.hide_set(True)
            obj.hide_render = True
    return collection


def has_levels(obj: bpy.types.Object | None) -> bool:
    """Whether an object is a level, or has some."""
    if obj is None:
        return False
    return LEVEL_OF in obj or any(each.get(LEVEL_OF) == obj for each in bpy.data.objects)


def levels_of(obj: bpy.types.Object) -> list[bpy.types.Object]:
    """An object and its levels, finest first, from any of them; `RefineError` without levels."""
    original = obj.get(LEVEL_OF) or obj
    levels = [each for each in bpy.data.objects if each.get(LEVEL_OF) == original]
    if not levels:
        raise RefineError(f"object '{obj.name}': has no levels; make them first")
    return [original, *sorted(levels, key=lambda each: each[FACTS]["level"])]


@contextmanager
def _nothing_left(collection: bpy.types.Collection) -> Iterator[None]:
    try:
        yield
    except BaseException:
        data = [obj.data for obj in collection.objects]
        for obj in list(collection.objects):
            bpy.data.objects.remove(obj)
        bpy.data.batch_remove(data)
        bpy.data.collections.remove(collection)
        raise
