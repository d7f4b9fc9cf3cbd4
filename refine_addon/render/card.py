"""The splats of a render drawn on the graphics card, on Blender's main thread.
`core.pictures` does the same on the processor."""

from __future__ import annotations

from collections.abc import Callable

import bpy
import gpu
import numpy as np
from numpy.typing import NDArray

from ..core import Splats, View
from ..core.pictures import Layers
from ..viewport import shader
from ..viewport.arrays import Eye, as_texture, colors, farthest_first, in_front, pack

_FARTHEST = 1e6  # Largest ratio of the far plane to the near plane


def available() -> bool:
    """Whether Blender draws on a graphics card; main thread only."""
    return not bpy.app.background and gpu.platform.device_type_get() != "SOFTWARE"


def painter(splats: Splats, view: View, layers: Layers | None) -> Callable[[], NDArray[np.float64]]:
    """A function that draws like `core.pictures.draw`, to be called on the main thread.
    Splats are sorted and packed now, on any thread. Perspective and constant colours only."""
    matrix = np.empty((3, 4))  # world to camera: x right, y up, z back
    matrix[:, :3] = np.array([1.0, -1.0, -1.0])[:, None] * view.rotation
    matrix[:, 3] = -matrix[:, :3] @ view.center
    near, far = view.near, min(view.far, _FARTHEST * view.near)
    projection = np.zeros((4, 4))  # as OpenGL has it
    projection[0, [0, 2]] = 2.0 * view.fx / view.width, 1.0 - 2.0 * view.cx / view.width
    projection[1, [1, 2]] = 2.0 * view.fy / view.height, 2.0 * view.cy / view.height - 1.0
    projection[2, 2:] = -(far + near) / (far - near), -2.0 * far * near / (far - near)
    projection[3, 2] = -1.0
    packed, size = pack(splats), (view.height, view.width)
    means = np.pad(packed.means, ((0, 0), (0, 1)))  # as `Atlas` has them
    eye = Eye(-matrix[2], view.center, perspective=True)
    rows, depths = in_front(packed.means, eye, near)
    rows = rows[depths < view.far]
    order = rows[farthest_first(depths[depths < view.far], perspective=True)]
    limits = []  # window depths of the layers between which splats are drawn, lowest row first
    for depth in () if layers is None else layers.depths:
        away = np.maximum(depth[::-1], near)
        ndc = (projection[2, 2] * -away + projection[2, 3]) / away
        limits.append((0.5 * ndc + 0.5).astype(np.float32))
    textures = {
        "order": (as_texture(order), 1, "R32F"),
        "means": (as_texture(means), 4, "RGBA32F"),
        "covariances": (as_texture(packed.covariances[:, :4]), 4, "RGBA32F"),
        "more_covariances": (as_texture(packed.covariances[:, 4:]), 4, "RGBA32F"),
        "colors": (as_texture(colors(packed)), 4, "RGBA16F"),
        "selection": (as_texture(np.zeros(len(packed), np.float32)), 1, "R32F"),
        "matrices": (matrix.astype(np.float32).reshape(1, 12), 4, "RGBA32F"),
    }

    def paint() -> NDArray[np.float64]:
        shared = {name: shader.texture(*values) for name, values in textures.items()}
        walls = [shader.texture(limit, 1, "R32F") for limit in limits]

        def between(number: int) -> NDArray[np.float64]:
            """Splats before a wall and behind the one before it, (4, H, W), premultiplied."""
            ends = {"near_depths": walls[number - 1]} if number else {}
            ends |= {"depths": walls[number]} if walls[number:] else {}
            picture = gpu.types.GPUTexture((view.width, view.height), format="RGBA32F")
            frame = shader.blend(picture, {**shared, **ends}, projection, near, len(order))
            values = gpu.types.Buffer("FLOAT", view.width * view.height * 4)
            frame.read_color(0, 0, view.width, view.height, 4, 0, "FLOAT", data=values)
            pixels = np.frombuffer(memoryview(values), np.float32).reshape(*size, 4)
            return np.moveaxis(pixels[::-1], -1, 0).astype(np.float64)

        if layers is None:
            return between(0).clip(0.0, 1.0)
        image, passed, left = np.zeros((4, *size)), 1.0, layers.left()
        for number, share in enumerate(left):  # the splats before each layer, and behind the last
            if (share > 0.0).any():
                drawn = between(number)
                image[:3] += share * passed * drawn[:3]
                passed *= np.where(share > 0.0, 1.0 - drawn[3], 1.0)
            if walls[number:]:
                image[:3] += share * passed * layers.colors[number]
        if layers.background is not None:
            image[:3] += passed * layers.background
        image[3] = 1.0 - passed * left[-1]
        return image.clip(0.0, 1.0)

    return paint
