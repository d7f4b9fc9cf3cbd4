"""What ``render`` does and says. Needs Blender."""

from __future__ import annotations

import bpy

from ..core import RefineError
from ..core.execute import Cancelled
from ..render import frames
from ..render.engine import Shared
from .run import Run


def render(run: Run) -> None:
    """Render frames of the open scene, each written where its output settings say."""
    scene, options, shared = bpy.context.scene, run.options, Shared()
    chosen = range(scene.frame_current, scene.frame_current + 1)
    if options.source:
        whole = range(scene.frame_start, scene.frame_end + 1, scene.frame_step)
        chosen = options.source[1] or whole
    try:
        for step in filter(None, frames.steps(scene, chosen, shared, write=True)):
            bpy.ops.render.render(scene=step.scene, animation=step.animation)
    except Cancelled:
        raise RefineError("a render was stopped") from None
    except RuntimeError as error:  # what Blender reports
        raise RefineError(str(error).strip()) from error
    drawn = set(shared.frames)
    for frame in chosen:
        path = scene.render.frame_path(frame=frame)
        if frame in drawn:
            run.terminal.say(f"frame {frame}: {path}")
        else:
            run.terminal.say(f"  note: {path}: exists and stays; the scene's Overwrite is off")
    if not drawn:
        return
    among = f" among what {shared.engine} rendered" if shared.engine else ""
    run.terminal.say(f"  {shared.splats:,} splats{among}")
    notes = [*frames.left_out(scene)]
    if shared.engine and shared.engine != scene.render.engine:
        engines = f"all but splats is by {shared.engine}, not {scene.render.engine}"
        notes.append(f"{engines}: there is no graphics card, or only the world to render")
    for note in notes:
        run.terminal.say(f"  note: {note}")
