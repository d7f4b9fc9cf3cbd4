"""Splats of a render drawn on the graphics card, by the shader of the 3D views.

On Blender's main thread, where the 3D views draw, too; core's renderer (`core.pictures`) does the
same where there is no card.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import bpy
import gpu
import numpy as np
from numpy.typing import NDArray

from ..core.pictures import Layers
from ..core.splats import MODELS, Splats
from ..core.views import View
from ..viewport import shader
from ..viewport.arrays import Eye, as_texture, colors, farthest_first, in_front, pack

_FARTHEST = 1e6
"""Far plane over the near plane, where a view has none nearer."""


def available() -> bool:
    """Tell whether there is a card that Blender draws on; to be asked on the main thread."""
    return not bpy.app.background and gpu.platform.device_type_get() != "SOFTWARE"


@dataclass(frozen=True, eq=False)
class Sheet:
    """What a card is given to draw splats in a view.

    Attributes
    ----------
    textures : dict of str to (values, channels, kind)
        See `shader.texture`.
    limits : list of (H, W) float32
        Depths in the window that part the splats: of each layer, the lowest row first.
    count : int
        Splats that are drawn.
    numbers : (24,) float32
        What the shader knows of the view, ``ViewData``.
    size : (int, int)
        Pixels across and down.
    """

    textures: dict[str, tuple[NDArray[np.float32], int, str]]
    limits: list[NDArray[np.float32]]
    count: int
    numbers: NDArray[np.float32]
    size: tuple[int, int]


def prepare(splats: Splats, view: View, layers: Layers | None) -> Sheet:
    """Sort and pack splats for a view with perspective; on any thread.

    Parameters
    ----------
    splats, view, layers
        As `core.pictures.draw` takes them; the splats look the same from all directions.
    """
    matrix = np.empty((3, 4))  # world to camera: x right, y up, z back
    matrix[:, :3] = np.array([1.0, -1.0, -1.0])[:, None] * view.rotation
    matrix[:, 3] = -matrix[:, :3] @ view.center
    projection = _projection(view)
    packed = pack(splats)
    rest = np.zeros((len(packed), 4), np.float32)  # as `Atlas` has it
    rest[:, :2], rest[:, 2] = packed.covariances[:, 4:], MODELS.index(packed.model)
    eye = Eye(-matrix[2], view.center, perspective=True)
    rows, depths = in_front(packed.means, eye, view.near)
    rows = rows[depths < view.far]
    order = rows[farthest_first(depths[depths < view.far], perspective=True)]
    means = np.zeros((len(packed), 4), np.float32)
    means[:, :3] = packed.means
    limits = []
    for depth in () if layers is None else layers.depths:
        away = np.maximum(depth[::-1], view.near)
        ndc = (projection[2, 2] * -away + projection[2, 3]) / away
        limits.append((0.5 * ndc + 0.5).astype(np.float32))
    numbers = np.zeros(24, np.float32)
    numbers[:16] = projection.T.reshape(-1)
    numbers[16:21] = (view.width, view.height, view.near, 1.0, 1.0)
    nothing = np.ones((1, 4), np.float32)
    textures = {
        "order": (as_texture(order), 1, "R32F"),
        "means": (as_texture(means), 4, "RGBA32F"),
        "covariances": (as_texture(packed.covariances[:, :4]), 4, "RGBA32F"),
        "more_covariances": (as_texture(rest), 4, "RGBA32F"),
        "colors": (as_texture(colors(packed)), 4, "RGBA16F"),
        "selection": (as_texture(np.zeros(len(packed), np.float32)), 1, "R32F"),
        "matrices": (matrix.astype(np.float32).reshape(1, 12), 4, "RGBA32F"),
        "depths": (np.ones((1, 1), np.float32), 1, "R32F"),
        "veils": (nothing, 4, "RGBA16F"),  # what the 3D view sees through
        "veil_depths": (nothing, 4, "RGBA16F"),
    }
    return Sheet(textures, limits, len(order), numbers, (view.width, view.height))


def paint(sheet: Sheet, layers: Layers | None) -> NDArray[np.float64]:
    """Draw splats on the card; return what `core.pictures.draw` does. On the main thread."""
    textures = {name: shader.texture(*given) for name, given in sheet.textures.items()}
    if layers is None:
        return _drawn(sheet, textures)
    limits = [shader.texture(limit, 1, "R32F") for limit in sheet.limits]
    left, passed = layers.left(), np.ones(sheet.size[::-1])
    image = np.zeros((4, *passed.shape))
    for number, share in enumerate(left):  # the splats before each layer, and behind the last
        if (share > 0.0).any():
            between = {"veil_depths": limits[number - 1]} if number else {}
            if limits[number:]:
                between["depths"] = limits[number]
            drawn = _drawn(sheet, textures, between)
            image[:3] += share * passed * drawn[:3]
            passed *= np.where(share > 0.0, 1.0 - drawn[3], 1.0)
        if limits[number:]:
            image[:3] += share * passed * layers.colors[number]
    if layers.background is not None:
        image[:3] += passed * layers.background
    image[3] = 1.0 - passed * left[-1]
    return image.clip(0.0, 1.0)


def _drawn(
    sheet: Sheet, textures: dict[str, Any], between: dict[str, Any] | None = None
) -> NDArray[np.float64]:
    """Return splats between some depths, (4, H, W), colours times alpha, the top row first."""
    width, height = sheet.size
    between = between or {}
    numbers = sheet.numbers.copy()
    numbers[21], numbers[23] = "depths" in between, "veil_depths" in between
    picture = gpu.types.GPUTexture(sheet.size, format="RGBA32F")
    frame = gpu.types.GPUFrameBuffer(color_slots=picture)
    shader.blend(frame, {**textures, **between}, numbers, sheet.count)
    values = gpu.types.Buffer("FLOAT", width * height * 4)
    frame.read_color(0, 0, width, height, 4, 0, "FLOAT", data=values)
    pixels = np.frombuffer(memoryview(values), np.float32).reshape(height, width, 4)
    return np.moveaxis(pixels[::-1], -1, 0).astype(np.float64)


def _projection(view: View) -> NDArray[np.float64]:
    """Return the projection matrix of a view, (4, 4), as OpenGL has it."""
    near = view.near
    far = min(view.far, _FARTHEST * near)
    p = np.zeros((4, 4))
    p[0, 0], p[0, 2] = 2.0 * view.fx / view.width, 1.0 - 2.0 * view.cx / view.width
    p[1, 1], p[1, 2] = 2.0 * view.fy / view.height, 2.0 * view.cy / view.height - 1.0
    p[2, 2], p[2, 3] = -(far + near) / (far - near), -2.0 * far * near / (far - near)
    p[3, 2] = -1.0
    return p
