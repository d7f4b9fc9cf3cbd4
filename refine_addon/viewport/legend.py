"""What the colours of the heat map mean, drawn in the corner of the view."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import blf
import gpu
from gpu_extras.batch import batch_for_shader

from ..mesh.heat_map import ramp
from .arrays import GOES, MARKS, STAYS

if TYPE_CHECKING:
    from collections.abc import Collection

    import bpy

WORDS = {
    "HEAT": "goes first                    goes last",
    "STAYS": "What stays",
    "GOES": "What goes",
}
"""What is written in a view, by mode."""

MARKED = {STAYS: "Protected", GOES: "Goes by a volume"}
"""What is written beside the tint of what stays and goes in any case."""

_WIDE, _HIGH, _EDGE, _FONT = 220, 10, 16, 12  # pixels at scale 1


def draw(context: bpy.types.Context, mode: str, marks: Collection[int] = ()) -> None:
    """Draw the legend of a mode, and of marks that splats have (`MARKED`), into a view."""
    if mode not in WORDS and not marks:
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
    words = ("goes first", "goes last") if mode == "HEAT" else (WORDS.get(mode, ""),)
    above = y + (_HIGH + 6) * scale if mode == "HEAT" else y
    for place, text in enumerate(words):
        wide = blf.dimensions(0, text)[0]
        blf.position(0, x + place * (_WIDE * scale - wide), above, 0.0)
        blf.draw(0, text)
    shown = [mark for mark in MARKED if mark in marks]
    shown = [mark for mark in shown if (mark, mode) not in {(STAYS, "GOES"), (GOES, "STAYS")}]
    for place, mark in enumerate(shown, start=1 if mode in WORDS else 0):
        line = (above if mode in WORDS else y) + place * 2 * _HIGH * scale
        blf.position(0, x + 2 * _HIGH * scale, line, 0.0)
        blf.draw(0, MARKED[mark])
        _swatch(x, line, scale, MARKS[mark])
    blf.disable(0, blf.SHADOW)
    if mode == "HEAT":
        _bar(x, y, scale)


def _swatch(x: float, y: float, scale: float, color: tuple[float, float, float]) -> None:
    size = _HIGH * scale
    corners = [(x, y), (x + size, y), (x, y + size), (x + size, y + size)]
    program = gpu.shader.from_builtin("UNIFORM_COLOR")
    program.uniform_float("color", (*color, 1.0))
    batch_for_shader(program, "TRI_STRIP", {"pos": corners}).draw(program)


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
