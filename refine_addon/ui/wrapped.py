"""Common parts of panels: their tab; sentences wrapped to its width, which Blender would cut."""

from __future__ import annotations

from functools import lru_cache

import blf
import bpy

_TAKEN = 52  # Pixels of a sidebar at scale 1 without text: margins, tabs, scroll bar
_ICON = 30  # Pixels of an icon and its gaps at scale 1
_USUAL = 280  # Pixels of the sidebar if unknown: its default at scale 1


class InSidebar:
    """A panel of the tab REFINE."""

    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "REFINE"


def named_column(layout: bpy.types.UILayout) -> bpy.types.UILayout:
    """A column with the names of settings before them."""
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    return column


def label(layout: bpy.types.UILayout, text: str, icon: str = "NONE") -> None:
    """Draw a sentence in as many lines as it takes, with the icon at the first."""
    preferences, region = bpy.context.preferences, bpy.context.region
    scale = preferences.system.ui_scale or 1.0  # there is none without a screen
    room = (region.width if region else _USUAL * scale) - _TAKEN * scale
    if icon != "NONE":
        room -= _ICON * scale
    points = preferences.ui_styles[0].widget.points * scale
    column = layout.column(align=True)
    column.scale_y = 0.8  # the lines of one sentence stand closer together than buttons
    for line in lines(text, int(room), points):
        column.label(text=line, icon=icon, translate=False)
        icon = "BLANK1" if icon != "NONE" else icon


def counted(number: int, what: str) -> str:
    """A number of things in words.

    >>> counted(1, "camera"), counted(1200, "view")
    ('1 camera', '1,200 views')
    """
    return f"{number:,} {what}" if number == 1 else f"{number:,} {what}s"


@lru_cache(maxsize=64)
def lines(text: str, width: int, points: float) -> tuple[str, ...]:
    """A text in lines of at most `width` pixels; words stay whole."""
    blf.size(0, points)
    broken: list[str] = []
    for word in text.split():
        longer = f"{broken[-1]} {word}" if broken else word
        if broken and blf.dimensions(0, longer)[0] <= width:
            broken[-1] = longer
        else:
            broken.append(word)
    return tuple(broken)
