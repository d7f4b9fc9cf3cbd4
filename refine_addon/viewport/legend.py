"""What the colours of the heat map mean, drawn in the corner of the view."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import blf
import gpu
from gpu_extras.batch import batch_for_shader

from ..mesh.heat_map import ramp

if TYPE_CHECKING:
    import bpy

WORDS = {
    "HEAT": "goes first                    goes last",
    "STAYS": "What stays",
    "GOES": "What goes",
}
"""What is written in a view, by mode."""

_WIDE, _HIGH, _EDGE, _FONT = 220, 10, 16, 12  # pixels at scale 1


def draw(context: bpy.types.Context, mode: str) -> None:
    """Draw the legend of a mode into a view."""
    if mode not in WORDS:
        return
    scale = context.preferences.system.ui_scale
    tools = sum(
        r.width for r in context.area.regions if r.type == "TOOLS" and r.x <= context.region.x
    )
    x, y = tools + _EDGE * scale, _EDGE * scale
    blf.size(0, _FONT * scale)
    blf.color(0, 1.0, 1.0, 1.0, 1.0)
    blf.enable(0, blf.SHADOW)
    blf.shadow(0, 5, 0.0, 0.0, 0.0, 1.0)
    words = ("goes first", "goes last") if mode == "HEAT" else (WORDS[mode],)
    above = y + (_HIGH + 6) * scale if mode == "HEAT" else y
    for place, text in enumerate(words):
        wide = blf.dimensions(0, text)[0]
        blf.position(0, x + place * (_WIDE * scale - wide), above, 0.0)
        blf.draw(0, text)
    blf.disable(0, blf.SHADOW)
    if mode == "HEAT":
        _bar(x, y, scale)


def _bar(x: float, y: float, scale: float) -> None:
    colors = _steps()
    places, painted = [], []
    for index, color in enumerate(colors):
        across = x + _WIDE * scale * index / (len(colors) - 1)
        places += [(across, y), (across, y + _HIGH * scale)]
        painted += [color, color]
    program = gpu.shader.from_builtin("SMOOTH_COLOR")
    batch_for_shader(program, "TRI_STRIP", {"pos": places, "color": painted}).draw(program)


@cache
def _steps() -> list[tuple[float, float, float, float]]:
    return [(*color, 1.0) for color in ramp()[::8].tolist()]
