"""Edges of the volumes that the panel lists, drawn over the splats that would cover them."""

from __future__ import annotations

from itertools import product

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from numpy.typing import NDArray

from .arrays import GOES, MARKS, STAYS

_COLORS = {"PROTECT": MARKS[STAYS], "REMOVE": MARKS[GOES], "KEEP": MARKS[GOES]}
"""By the role of a volume."""

_TURN = np.linspace(0.0, 2.0 * np.pi, 49)


def draw(context: bpy.types.Context) -> None:
    """Draw the edges of the boxes and spheres that are visible, before the view's matrices."""
    for item in context.scene.refine.volumes:
        obj = item.object
        if obj is not None and obj.type == "EMPTY" and obj.visible_get(viewport=context.space_data):
            lines = _sphere() if obj.empty_display_type == "SPHERE" else _cube()
            _draw(lines * obj.empty_display_size, obj, _COLORS[item.role])


def _cube() -> NDArray[np.float64]:
    """Return the ends of 12 edges, (24, 3)."""
    corners = np.array(list(product((-1.0, 1.0), repeat=3)))
    ends = [
        (one, other)
        for one, other in product(corners, corners)
        if np.count_nonzero(one != other) == 1 and one.sum() < other.sum()
    ]
    return np.array(ends).reshape(-1, 3)


def _sphere() -> NDArray[np.float64]:
    """Return the ends of the pieces of three circles, (288, 3)."""
    circle = np.stack([np.cos(_TURN), np.sin(_TURN), np.zeros_like(_TURN)], axis=1)
    pieces = np.stack([circle[:-1], circle[1:]], axis=1).reshape(-1, 3)
    return np.concatenate([np.roll(pieces, turn, axis=1) for turn in range(3)])


def _draw(
    lines: NDArray[np.float64], obj: bpy.types.Object, color: tuple[float, float, float]
) -> None:
    program = gpu.shader.from_builtin("UNIFORM_COLOR")
    gpu.state.depth_test_set("NONE")
    with gpu.matrix.push_pop():
        gpu.matrix.multiply_matrix(obj.matrix_world)
        program.uniform_float("color", (*color, 1.0))
        batch_for_shader(program, "LINES", {"pos": lines.astype(np.float32)}).draw(program)
