"""Images in the .blend; the panel's chart of dB over the share removed."""

from __future__ import annotations

from typing import Any

import bpy
import bpy.utils.previews
import numpy as np
from numpy.typing import NDArray

from ..core.quality.curve import UNSEEN, WAYS, Quality, Way

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


Color = tuple[float, float, float]  # sRGB, 0..1
WIDTH = 11  # Edge of the chart in interface units, about the sidebar's default width
NAMES: dict[Way, str] = {"delete": "Occlusion", "merge": "Merge", "refit": "Refit"}
_BORDER, _SWATCH, _STEP = 4, 8, 10  # Pixels of Blender's border, of a patch; dB between two lines

_ON_DARK: dict[Way, Color] = {
    "delete": (0.34, 0.71, 0.91), "merge": (0.90, 0.62, 0.0), "refit": (0.18, 0.75, 0.56),
}  # fmt: skip
_ON_LIGHT: dict[Way, Color] = {
    "delete": (0.0, 0.35, 0.61), "merge": (0.66, 0.33, 0.0), "refit": (0.0, 0.44, 0.31),
}  # fmt: skip

_previews: list[bpy.utils.previews.ImagePreviewCollection] = []


def register() -> None:
    """Make a collection of icons."""
    _previews.append(bpy.utils.previews.new())


def unregister() -> None:
    """Free the icons."""
    bpy.utils.previews.remove(_previews.pop())


def look(preferences: bpy.types.Preferences) -> tuple[int, Color]:
    """Edge in pixels and text colour, from the preferences."""
    system, theme = preferences.system, preferences.themes[0].user_interface
    # A unit of the interface has so many pixels; without a screen the scale is 0.
    unit = round(18 * (system.ui_scale or 1.0)) + 2 * max(int(system.pixel_size), 1)
    red, green, blue = theme.wcol_box.text[:3]
    return WIDTH * unit - 2 * _BORDER, (red, green, blue)


def ways(quality: Quality) -> tuple[Way, ...]:
    """Methods on the curve, from instant to best."""
    return WAYS if quality.foretold else WAYS[:1]


def lowest(quality: Quality) -> int:
    """The dB at the lower edge; `UNSEEN` is at the upper one."""
    least = min(float(quality.psnr[-1]), UNSEEN - 2 * _STEP)
    return max(int(least // _STEP) * _STEP, 0)


def picture(quality: Quality, share: float, size: int, ink: Color) -> NDArray[np.uint8]:
    """The chart, (size, size, 4) uint8, lowest row first, RGB times alpha.
    `share`: of splats removed, 0 to 1; `ink`: colour of lines; light ink means a dark ground."""
    canvas = np.zeros((size, size, 4), np.float32)
    rows, columns = np.arange(size)[:, None] + 0.5, np.arange(size) + 0.5
    shares, low, unit = columns / size, lowest(quality), size / 212  # 212: `look` at scale 1
    colors = _ON_DARK if sum(ink) > 1.5 else _ON_LIGHT

    def paint(distance, width, color, strength=1.0):
        alpha = strength * (0.5 * width + 0.5 - distance).clip(0.0, 1.0)
        alpha = np.broadcast_to(alpha, (size, size))[..., None]
        canvas[:] = canvas * (1.0 - alpha) + alpha * np.array([*color, 1.0])

    def height(psnr):
        return (min(psnr, UNSEEN) - low) / (UNSEEN - low) * (size - 1) + 0.5

    for psnr in range(low, int(UNSEEN) + 1, _STEP):
        paint(np.abs(rows - height(psnr)), 1.0, ink, 0.15)
    paint(np.abs(columns - share * size), unit, ink, 0.8)
    for way in reversed(ways(quality)):
        heights = np.array([height(quality.at(each, way)) for each in shares.tolist()])
        distance = np.abs(rows - heights) / np.hypot(1.0, np.gradient(heights))
        paint(np.where(shares <= quality.shares[-1], distance, np.inf), 2.0 * unit, colors[way])
        dot = np.hypot(columns - share * size, rows - height(quality.at(share, way)))
        paint(dot, 7.0 * unit, colors[way])
    return (canvas * 255.0 + 0.5).astype(np.uint8)


def show_chart(quality: Quality, share: float) -> None:
    """Update the picture and the colour patches of its curves."""
    size, ink = look(bpy.context.preferences)
    _upload("chart", picture(quality, share, size, ink))
    for way, color in (_ON_DARK if sum(ink) > 1.5 else _ON_LIGHT).items():
        patch = np.array([*color, 1.0]) * 255.0
        _upload(way, np.full((_SWATCH, _SWATCH, 4), patch).astype(np.uint8))


def draw_chart(layout: bpy.types.UILayout, quality: Quality) -> None:
    """Draw the picture with names and numbers; folded at first."""
    header, body = layout.panel("REFINE_price", default_closed=True)
    header.label(text="Price")
    if not body:
        return
    row = body.row()
    for way in ways(quality):
        row.label(text=NAMES[way], icon_value=icon(way))
    row = body.row()
    row.alignment = "CENTER"
    row.template_icon(icon_value=icon("chart"), scale=WIDTH)
    body.label(text=f"Up: {lowest(quality)} to {UNSEEN:.0f} dB, right: 0 to 100 % removed")


def icon(name: str) -> int:
    """Number of an icon; 0 without."""
    return _previews[0][name].icon_id if _previews and name in _previews[0] else 0


def _upload(name: str, pixels: NDArray[Any]) -> None:
    previews = _previews[0]
    preview = previews[name] if name in previews else previews.new(name)
    preview.image_size = pixels.shape[1], pixels.shape[0]
    preview.image_pixels.foreach_set(np.ascontiguousarray(pixels).view(np.int32).ravel())
