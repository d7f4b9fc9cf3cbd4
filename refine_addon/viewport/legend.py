"""What the colours of the heat map mean, drawn in the corner of the view."""

from __future__ import annotations

from collections.abc import Collection
from functools import cache

import blf
import bpy
import gpu
from gpu_extras.batch import batch_for_shader

from ..mesh.heat_map import ramp
from .arrays import GOES, MARKS, STAYS

WORDS = {"HEAT": ("goes first", "goes last"), "STAYS": ("What stays",), "GOES": ("What goes",)}
"""What is written in a view, by mode; of the heat map at both ends of its bar."""

MARKED = {STAYS: "Protected", GOES: "Must go"}
"""What is written beside the tint of what stays and goes in any case."""

_REDUNDANT = {(STAYS, "GOES"), (GOES, "STAYS")}
"""Marks that no splat has in a mode."""

_WIDE, _HIGH, _EDGE, _FONT = 220, 10, 16, 12  # pixels at scale 1
_GAP = 6  # between the bar and the words above it

_WHITE, _BLACK = (1.0, 1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 1.0)
_WARNING = (1.0, 0.8, 0.2, 1.0)
_BLUR = 5  # of the shadow: 0, 3 or 5


def draw(
    context: bpy.types.Context,
    mode: str,
    marks: Collection[int] = (),
    warnings: Collection[str] = (),
) -> None:
    """Draw the legend of a mode, and of marks that splats have (`MARKED`), into a view.

    Warnings stand above it, a line each.
    """
    if mode not in WORDS and not marks and not warnings:
        return
    scale = context.preferences.system.ui_scale
    x, y = _beside_tools(context) + _EDGE * scale, _EDGE * scale
    blf.size(0, _FONT * scale)
    blf.color(0, *_WHITE)
    blf.enable(0, blf.SHADOW)
    blf.shadow(0, _BLUR, *_BLACK)
    line = y
    if mode == "HEAT":
        _bar(x, y, scale)
        line += (_HIGH + _GAP) * scale
    if mode in WORDS:
        _words(WORDS[mode], x, line, scale)
        line += 2 * _HIGH * scale
    for mark, text in MARKED.items():
        if mark in marks and (mark, mode) not in _REDUNDANT:
            blf.position(0, x + 2 * _HIGH * scale, line, 0.0)
            blf.draw(0, text)
            _swatch(x, line, scale, MARKS[mark])
            line += 2 * _HIGH * scale
    blf.color(0, *_WARNING)
    for text in warnings:
        blf.position(0, x, line, 0.0)
        blf.draw(0, text)
        line += 2 * _HIGH * scale
    blf.disable(0, blf.SHADOW)


def _beside_tools(context: bpy.types.Context) -> int:
    """Return how many pixels the toolbar covers of a view."""
    regions = (region for region in context.area.regions if region.type == "TOOLS")
    return sum(region.width for region in regions if region.x <= context.region.x)


def _words(words: tuple[str, ...], x: float, y: float, scale: float) -> None:
    """Write the first words to the left, and the last, if there are two, to the end of the bar."""
    for index, text in enumerate(words):
        width = blf.dimensions(0, text)[0]
        blf.position(0, x + index * (_WIDE * scale - width), y, 0.0)
        blf.draw(0, text)


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
