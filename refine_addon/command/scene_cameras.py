"""Which cameras of the open scene decide, and how that is said. Needs Blender."""

from __future__ import annotations

import argparse
from typing import Any

import bpy

from ..cameras.sets import CameraChoice
from ..core import RefineError, ViewSet
from ..objects import splat_object


def chosen(options: argparse.Namespace) -> tuple[ViewSet, dict[str, Any]]:
    """Return the views that decide, and what the report says of them.

    On an object: those of --source and --frames, else those chosen in the panel, as the scene keeps
    it. On files: all visible ones.

    Raises
    ------
    RefineError
        If there is no such object, collection or camera, or no frame; see `CameraChoice.views`.
    """
    name = getattr(options, "object", None)
    if not name:
        choice = CameraChoice("VISIBLE")
        return choice.views(bpy.context, None), _facts(choice, "of the open scene")
    obj = splat_object.find(name)
    if options.source or options.frames:
        choice, why = _given(options), "as the command line says"
    else:
        choice, why = CameraChoice.of_scene(bpy.context.scene), "as chosen in the panel"
    return choice.views(bpy.context, obj), _facts(choice, why)


def _given(options: argparse.Namespace) -> CameraChoice:
    """Return the choice of --source and --frames; frames are the panel's where none are given."""
    kind, name = options.source or ("FRAMES", "")
    frames = options.frames or CameraChoice.of_scene(bpy.context.scene).frames
    collection = bpy.data.collections.get(name)
    if kind == "COLLECTION" and collection is None:
        names = ", ".join(sorted(each.name for each in bpy.data.collections)) or "none"
        raise RefineError(f"no collection '{name}' in the open .blend (collections: {names})")
    return CameraChoice(kind, collection, frames)


def _facts(choice: CameraChoice, why: str) -> dict[str, Any]:
    """Return what there is to know of a choice, as plain JSON values."""
    facts: dict[str, Any] = {"source": choice.source.lower()}
    if choice.source == "COLLECTION":
        facts["collection"] = choice.collection.name
        words = f"those in collection '{choice.collection.name}'"
    elif choice.source == "FRAMES":
        frames = choice.frames
        facts["frames"] = {"first": frames[0], "last": frames[-1], "step": frames.step}
        every = f", every {frames.step}" if frames.step > 1 else ""
        words = f"the active one at frames {frames[0]} to {frames[-1]}{every}"
    else:
        words = {
            "VISIBLE": "all visible ones",
            "ACTIVE": "the active one",
            "SELECTED": "the selected ones",
        }[choice.source]
    return facts | {"words": f"{words}, {why}"}
