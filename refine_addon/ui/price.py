"""The chart of `chart` as an icon that the panel looks up: made when something changes, not drawn.

There is one, for the object that was looked at last.
"""

from __future__ import annotations

from dataclasses import dataclass

import bpy
import bpy.utils.previews
import numpy as np
from numpy.typing import NDArray

from ..core.scores import Scores
from .chart import Chart, Histogram, Look, Place, by_score, by_views

WIDTH = 11
"""Edge of the chart in units of the interface, about as wide as the sidebar is by default."""

_BORDER = 4  # pixels that Blender leaves free around an icon
_NAME = "price"


@dataclass
class _Shown:
    """The chart as it is, and whose."""

    mesh: int
    chart: Chart


_previews: list[bpy.utils.previews.ImagePreviewCollection] = []
_shown: list[_Shown] = []


def register() -> None:
    """Make a place for the icon."""
    _previews.append(bpy.utils.previews.new())


def unregister() -> None:
    """Free the icon."""
    _shown.clear()
    bpy.utils.previews.remove(_previews.pop())


def histogram(scores: Scores) -> Histogram:
    """Return what kinds of splats there are.

    Scores by occlusion are places in an order, each once: how often a splat is seen tells more.
    """
    if scores.method == "closed-form" or not scores.method:
        return by_score(scores.values)
    return by_views(scores.seen, scores.views_used)


def show(
    mesh: bpy.types.Mesh, scores: Scores, kinds: Histogram, place: Place | None,
    keep: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Make the chart of a mesh anew.

    Parameters
    ----------
    mesh : bpy.types.Mesh
    scores : Scores
        Those on the mesh.
    kinds : Histogram
        See `histogram`.
    place : Place or None
        Where the budget lies.
    keep : (N,) bool
        What stays.
    """
    look = look_of(bpy.context.preferences)
    old = _shown[0].chart if _shown else None
    same = old is not None and (old.look, old.histogram) == (look, kinds)
    chart = old if old is not None and same else Chart(look, scores.quality, kinds)
    _shown[:] = [_Shown(mesh.session_uid, chart)]
    upload(chart.picture(place, kinds.going(keep)))


def move(mesh: bpy.types.Mesh, place: Place | None) -> None:
    """Move the budget's place on the chart, if it is that of this mesh."""
    if shows(mesh):
        upload(_shown[0].chart.picture(place))


def shows(mesh: bpy.types.Mesh) -> bool:
    """Tell whether the chart is that of a mesh."""
    return bool(_shown) and _shown[0].mesh == mesh.session_uid


def fits(preferences: bpy.types.Preferences) -> bool:
    """Tell whether the chart has the size and the colours of the screen."""
    return bool(_shown) and _shown[0].chart.look == look_of(preferences)


def icon(name: str = _NAME) -> int:
    """Return the number of an icon, for `UILayout.template_icon`."""
    return _previews[0][name].icon_id if _previews and name in _previews[0] else 0


def look_of(preferences: bpy.types.Preferences) -> Look:
    """Return the size and the colour of text that the preferences ask for."""
    system = preferences.system
    # A unit of the interface has so many pixels; without a screen the scale is 0.
    unit = round(18 * (system.ui_scale or 1.0)) + 2 * max(int(system.pixel_size), 1)
    size = WIDTH * unit - 2 * _BORDER
    ink = tuple(preferences.themes[0].user_interface.wcol_box.text)
    return Look(size, (ink[0], ink[1], ink[2]))


def upload(picture: NDArray[np.uint8], name: str = _NAME) -> None:
    """Put a picture, (H, W, 4), lowest row first, into an icon."""
    previews = _previews[0]
    preview = previews[name] if name in previews else previews.new(name)
    preview.image_size = picture.shape[1], picture.shape[0]
    preview.image_pixels.foreach_set(np.ascontiguousarray(picture).view(np.int32).ravel())
