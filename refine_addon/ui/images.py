"""Pictures as images of the .blend, for the Image Editor."""

from __future__ import annotations

from typing import Any

import bpy
import numpy as np
from numpy.typing import NDArray

_OURS = "refine_image"  # Custom property of our images: the name. Images without it are the user's.


def put(name: str, pixels: NDArray[Any]) -> bpy.types.Image:
    """The .blend's image of that name, replaced by pixels, (H, W, 3 or 4).
    Display-referred, 0..1, alpha not multiplied, top row first."""
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
