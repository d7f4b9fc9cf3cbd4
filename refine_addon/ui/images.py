"""Pictures as images of the file, which the Image Editor shows."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

_OURS = "refine_image"
"""Custom property of these images: the name. An image without it is the user's."""


def put(name: str, pixels: NDArray[Any]) -> bpy.types.Image:
    """Return an image of the file that holds pixels, in place of the one before of that name.

    Parameters
    ----------
    name : str
    pixels : (H, W, 3) or (H, W, 4) floating
        Display-referred, 0..1, with alpha not multiplied; the top row first.
    """
    height, width, channels = pixels.shape
    ours = (each for each in bpy.data.images if not each.library and each.get(_OURS) == name)
    old = next(ours, None)
    image = bpy.data.images.new(name, width, height, alpha=True)
    image[_OURS] = name
    rgba = np.ones((height, width, 4), np.float32)
    rgba[..., :channels] = pixels[::-1]  # Blender's first row is the lowest
    image.pixels.foreach_set(rgba.ravel())
    image.pack()  # or Blender asks on leaving whether to save it
    if old is not None:
        old.user_remap(image)
        name = old.name
        bpy.data.images.remove(old)
        image.name = name
    return image
