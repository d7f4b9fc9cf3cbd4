"""What the command asks of the open scene: that it is open, and its cameras. Needs Blender."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import bpy

from ..cameras.sets import CameraChoice
from ..core import RefineError, ViewSet
from ..objects import splat_group


def refuse_unopened(words: Sequence[str] | None = None) -> None:
    """Refuse to go on without the .blend that was named; Blender does, with an empty scene.

    Parameters
    ----------
    words : sequence of str, optional
        Blender's command line, by default that of this process.

    Raises
    ------
    RefineError
        If a .blend was named before the command and is not open.
    """
    words = sys.argv if words is None else words
    starts = (place for place, word in enumerate(words) if word in ("-c", "--command"))
    named = [word for word in words[1 : next(starts, 0)] if word.lower().endswith(".blend")]
    if named and not bpy.data.filepath:
        raise RefineError(f"{named[-1]}: Blender could not open it, and says why above")


def views(options: argparse.Namespace) -> tuple[ViewSet, dict[str, Any]]:
    """Return the views that decide, and what the report says of them.

    Those of --source; else on an object those chosen in the panel, as the scene keeps it, and on
    files all visible ones.

    Raises
    ------
    RefineError
        If there is no such object, collection or camera, or no frame; see `CameraChoice.views`.
    """
    obj = splat_group.find(options.object) if options.object else None
    chosen = CameraChoice.of_scene(bpy.context.scene)
    if options.source:
        kind, value = options.source
        collection = bpy.data.collections.get(value) if kind == "COLLECTION" else None
        if kind == "COLLECTION" and collection is None:
            names = ", ".join(sorted(each.name for each in bpy.data.collections)) or "none"
            raise RefineError(f"no collection '{value}' in the open .blend (collections: {names})")
        frames = value if isinstance(value, range) else chosen.frames
        choice, why = CameraChoice(kind, collection, frames), "as the command line says"
    elif obj:
        choice, why = chosen, "as chosen in the panel"
    else:
        choice, why = CameraChoice("VISIBLE"), "of the open scene"
    facts: dict[str, Any] = {"source": choice.source.lower()}
    words = {
        "VISIBLE": "all visible ones",
        "ACTIVE": "the active one",
        "SELECTED": "the selected ones",
    }.get(choice.source, "")
    found = choice.views(bpy.context, obj)  # refuses a choice without cameras
    if choice.source == "COLLECTION":
        facts["collection"] = choice.collection.name
        words = f"those in collection '{choice.collection.name}'"
    elif choice.source == "FRAMES":
        first, last, step = choice.frames[0], choice.frames[-1], choice.frames.step
        facts["frames"] = {"first": first, "last": last, "step": step}
        every = f", every {step}" if step > 1 else ""
        words = f"the active one at frames {first} to {last}{every}"
    return found, facts | {"words": f"{words}, {why}"}
