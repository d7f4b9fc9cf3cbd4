"""Blender's open scene: its path, its deciding cameras, its render."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from typing import Any

import bpy

from ..cameras import CameraChoice
from ..core import RefineError, ViewSet
from ..core.execute import Cancelled
from ..objects import splat_group
from ..render import engine


def opened(words: Sequence[str]) -> str:
    """Path of the open .blend, "" if never saved; `words`: Blender's command line.
    `RefineError` if they name a .blend that is not open: Blender runs the command all the same."""
    starts = (place for place, word in enumerate(words) if word in ("-c", "--command"))
    named = [word for word in words[1 : next(starts, 0)] if word.lower().endswith(".blend")]
    if named and not bpy.data.filepath:
        raise RefineError(f"{named[-1]}: Blender could not open it; its own message is above")
    return str(bpy.data.filepath)


def views(options: argparse.Namespace) -> tuple[ViewSet, dict[str, Any]]:
    """Views of the deciding cameras, and their entry in the report: those of --source, else of the
    panel's choice for --object, else all visible cameras."""
    obj = splat_group.find(options.object) if options.object else None
    choice, why = CameraChoice("VISIBLE"), "of the open scene"
    if obj or options.source:
        choice, why = CameraChoice.of_scene(bpy.context.scene), "as chosen in the panel"
    if options.source:
        kind, value = options.source
        collection = bpy.data.collections.get(value) if kind == "COLLECTION" else None
        if kind == "COLLECTION" and collection is None:
            names = ", ".join(sorted(each.name for each in bpy.data.collections)) or "none"
            raise RefineError(f"no collection '{value}' in the open .blend (collections: {names})")
        frames = value if isinstance(value, range) else choice.frames
        choice, why = CameraChoice(kind, collection, frames), "as the command line says"
    chosen = choice.views(bpy.context, obj)  # refuses a choice without cameras
    entry: dict[str, Any] = {"source": choice.source.lower()}
    words = {"VISIBLE": "all visible ones", "ACTIVE": "the active one"}
    words["SELECTED"] = "the selected ones"
    if choice.source == "COLLECTION":
        entry["collection"] = choice.collection.name
        words["COLLECTION"] = f"those in collection '{choice.collection.name}'"
    elif choice.source == "FRAMES":
        first, last, step = choice.frames[0], choice.frames[-1], choice.frames.step
        entry["frames"] = {"first": first, "last": last, "step": step}
        every = f", every {step}" if step > 1 else ""
        words["FRAMES"] = f"the active one at frames {first} to {last}{every}"
    return chosen, entry | {"words": f"{words[choice.source]}, {why}"}


def render(options: argparse.Namespace, say: Callable[..., None]) -> None:
    """Render frames of the open scene to its output path; `say` prints lines."""
    scene, shared = bpy.context.scene, engine.Shared()
    chosen: Any = range(scene.frame_current, scene.frame_current + 1)
    if options.source:
        every = range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
        chosen = options.source[1] or every
    try:
        for step in filter(None, engine.steps(scene, chosen, shared, write=True)):
            bpy.ops.render.render(scene=step.scene, animation=step.animation)
    except Cancelled:
        raise RefineError("a render was stopped") from None
    except RuntimeError as error:  # an error that Blender reports
        raise RefineError(str(error).strip()) from error
    drawn = set(shared.frames)
    for frame in chosen:
        path = scene.render.frame_path(frame=frame)
        kept = f"  note: {path}: exists and stays; the scene's Overwrite is off"
        say(f"frame {frame}: {path}" if frame in drawn else kept)
    if drawn:
        among = f" among what {shared.engine} rendered" if shared.engine else ""
        say(f"  {shared.splats:,} splats{among}")
        say(*(f"  note: {note}" for note in engine.left_out(scene)))
    if shared.engine and shared.engine != scene.render.engine:
        engines = f"{shared.engine}, not {scene.render.engine}, rendered all but the splats"
        say(f"  note: {engines}: there is no graphics card, or only the world to render")
