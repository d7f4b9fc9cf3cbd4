"""A tool's stroke, from press to release, while a thread computes what the view shows.
This is kept for further strokes from the same place; until it is known the mouse is recorded."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from bpy.types import Context
from numpy.typing import NDArray

from ..cameras.objects import world_matrix
from ..core import picking
from ..core.affine import transformed
from ..core.execute import Progress
from ..core.picking import Prepared, Sight, Surface
from ..core.splats import Splats
from ..core.views import pinhole
from ..mesh import attributes as mesh_attributes
from ..mesh import edit as mesh_edit
from ..mesh import selection
from ..mesh.edit_mode import readable
from ..mesh.layout import SplatObject
from ..viewport import draw as viewport_draw
from .worker import Worker

LEAST_SIDE = 2  # Pixels: a narrower box or lasso was a click, which selects nothing


_kept: dict[object, Prepared | Sight] = {}  # The last stroke's splats, and what each view shows


def forget() -> None:
    """Free what the last stroke saw."""
    _kept.clear()


def _read(context: Context) -> tuple[NDArray[np.bool_], Callable[[Progress], dict]]:
    """Selected splats, (N,), and what a thread calls to fill `_kept`."""
    obj, region, eye = context.object, context.region, context.region_data
    matrix = world_matrix(obj, context.evaluated_depsgraph_get())
    camera = (
        np.array(eye.view_matrix, np.float64),
        np.array(eye.window_matrix, np.float64),
        (region.width, region.height),
    )
    with readable(obj) as checked:
        away, selected = _not_drawn(checked), selection.selected(checked.obj)
        digest = mesh_attributes.digest(checked)
        splats = (obj.data.session_uid, digest, matrix.tobytes(), away.tobytes())
        view = (splats, camera[0].tobytes(), camera[1].tobytes(), camera[2])
        source = _kept.get(view) or _kept.get(splats) or _drawn(checked, away)

    def look(_progress: Progress) -> dict[object, Prepared | Sight]:
        seen = source
        if isinstance(seen, Splats):
            world = transformed(seen, matrix, rotate_sh=False)
            seen = picking.prepare(world, pinhole(*camera, world.means))
        if isinstance(seen, Prepared):
            seen = picking.look(seen, pinhole(*camera, seen.splats.means))
        return {splats: seen.prepared, view: seen}

    return selected, look


def _drawn(checked: SplatObject, away: NDArray[np.bool_]) -> Splats:
    """An object's splats; those that views do not show, (N,), get no opacity."""
    splats = mesh_attributes.splats_from_object(checked, sh_rest=False)
    logits = np.where(away, np.float32(-np.inf), splats.opacity_logits)
    return replace(splats, opacity_logits=logits)


def _not_drawn(checked: SplatObject) -> NDArray[np.bool_]:
    """Splats that views do not show, (N,): hidden ones, and those of other display modes."""
    away, mode = selection.hidden(checked.obj), viewport_draw.mode()
    if mode in {"STAYS", "GOES"} and mesh_edit.REMOVE in checked.mesh.attributes:
        going = mesh_attributes.read_attribute(checked.mesh, mesh_edit.REMOVE) > 0
        away |= going if mode == "STAYS" else ~going
    return away


class Stroke:
    """A tool's stroke over a view, from the press of the button to its release.
    `shape`, `mode`: see `select_tools.SHAPES`, `picking.Mode`; `path`: columns and rows from the
    region's upper left, pixels; `before`, `selected`: (N,), the latter as far as known."""

    def __init__(
        self, context: Context, shape: str, mode: picking.Mode, at: tuple[float, float]
    ) -> None:
        settings, region = context.scene.refine, context.region
        self.obj, self.shape, self.mode, self.path = context.object, shape, mode, [at]
        self._hidden, self._tolerance = settings.select_hidden, settings.select_tolerance
        self._connected, self._brush = settings.select_connected, settings.select_radius
        self._painted = 0
        self._area = np.zeros((region.height, region.width), np.bool_)
        self.released, self.selected = False, None
        self._sight: Sight | None = None
        self._surface: Surface | None = None
        self.before, look = _read(context)
        self._worker = Worker(look)

    def follow(self) -> bool:
        """Select what the stroke covers by now; whether that is known. Raises a thread's error."""
        if self._sight is None:
            if self._worker.running():
                return False
            _kept.clear()
            _kept.update(self._worker.result())
            self._sight = list(_kept.values())[-1]
        if self.selected is None or self.shape != "COLOR":
            self.selected = picking.combined(self.before, self._taken(self._sight), self.mode)
        viewport_draw.select(self.obj.data.session_uid, self.selected)
        return True

    def sentence(self) -> str:
        """How many splats will be selected."""
        chosen = self.before if self.selected is None else self.selected
        return f"{int(np.count_nonzero(chosen)):,} of {len(chosen):,} splats selected"

    def outline(self) -> list[tuple[float, float]]:
        """Closed outline over the view; columns and rows."""
        (x, y), (u, v) = self.path[0], self.path[-1]
        if self.shape == "SPHERE":
            return circle((x, y), math.hypot(u - x, v - y))
        if self.shape == "BRUSH":
            return circle((u, v), self._brush)
        if self.shape == "LASSO":
            return [*self.path, (x, y)]
        return [(x, y), (u, y), (u, v), (x, v), (x, y)] if self.shape == "BOX" else []

    def end(self, *, kept: bool) -> None:
        """Select what the stroke covers, or restore the former selection."""
        if not kept or self.selected is None:
            self._worker.cancel()
            viewport_draw.select(self.obj.data.session_uid, self.before)
            return
        selection.select(self.obj, self.selected)
        if viewport_draw.mode() == "OFF" and self.obj.mode != "EDIT":
            viewport_draw.show("SCENE")  # or nobody would see it

    def _taken(self, seen: Sight) -> NDArray[np.bool_]:
        (x, y), (u, v) = self.path[0], self.path[-1]
        if self.shape == "BRUSH":
            for place in range(self._painted, len(self.path)):
                ends = self.path[max(place - 1, 0)], self.path[place]
                picking.paint(self._area, *ends, self._brush)
            self._painted = len(self.path)
            return seen.in_area(self._area, hidden=self._hidden)
        if self.shape in {"LASSO", "BOX"}:
            corners = self.outline()[:-1]
            if np.ptp(corners, axis=0).max() < LEAST_SIDE:
                return np.zeros(len(self.before), np.bool_)
            area = picking.polygon(corners, *self._area.shape[::-1])
            return seen.in_area(area, hidden=self._hidden)
        surface = self._surface = self._surface or seen.surface(int(x), int(y))
        if surface is None:
            return np.zeros(len(self.before), np.bool_)
        if self.shape == "COLOR":
            taken = seen.of_color(surface.color, self._tolerance, hidden=self._hidden)
            return seen.piece(taken, surface.place) if self._connected else taken
        radius = math.hypot(u - x, v - y) / surface.scale
        return seen.in_ball(surface.place, radius, hidden=self._hidden)


def circle(middle: tuple[float, float], radius: float) -> list[tuple[float, float]]:
    """Points of a circle, closed."""
    turns = np.linspace(0.0, 2.0 * np.pi, 49)
    return (np.stack([np.cos(turns), np.sin(turns)], axis=1) * radius + middle).tolist()
