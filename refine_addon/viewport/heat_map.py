"""A colour a rank, from dark blue (goes first) to yellow (goes last), even to the eye."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_STEPS = 256
_KNEE = 0.0031308
_OKLAB_TO_LMS = np.array(
    [
        [1.0, 0.3963377774, 0.2158037573],
        [1.0, -0.1055613458, -0.0638541728],
        [1.0, -0.0894841775, -1.2914855480],
    ]
)
_LMS_TO_RGB = np.array(
    [
        [4.0767416621, -3.3077115913, 0.2309699292],
        [-1.2684380046, 2.6097574011, -0.3413193965],
        [-0.0041960863, -0.7034186147, 1.7076147010],
    ]
)


def ramp() -> NDArray[np.float64]:
    """Return the colours of the heat map, (256, 3) sRGB in 0..1.

    Lightness rises evenly in OKLab (Ottosson 2020) from .25 to .93 while the hue goes from blue
    by magenta and orange to yellow: who sees no hue still sees the order.
    """
    t = np.linspace(0.0, 1.0, _STEPS)
    lightness = 0.25 + 0.68 * t
    hue = np.radians(265.0 + 200.0 * t)
    chroma = 0.11 + 0.07 * np.sin(np.pi * t)
    lab = np.stack([lightness, chroma * np.cos(hue), chroma * np.sin(hue)], axis=-1)
    linear = np.clip((lab @ _OKLAB_TO_LMS.T) ** 3 @ _LMS_TO_RGB.T, 0.0, 1.0)
    # The curve of sRGB (IEC 61966-2-1).
    return np.where(linear > _KNEE, 1.055 * linear ** (1 / 2.4) - 0.055, 12.92 * linear)
