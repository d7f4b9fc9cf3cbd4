"""What a tool selects from the press of the button to its release, while a thread looks.

What the view shows is computed on a thread when the button is pressed, and kept: the next stroke
from the same place finds it there. Until it is known the way of the mouse is recorded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import bpy
import numpy as np
from numpy.typing import NDArray

from ..cameras.objects import world_matrix
from ..core import picking
from ..core.affine import transformed
from ..core.execute import Progress
from ..core.picking import Mode, Prepared, Sight, Surface
from ..core.splats import Splats
from ..core.views import pinhole
from ..mesh import attributes as mesh_attributes
from ..mesh import edit as mesh_edit
from ..mesh import selection
from ..mesh.edit_mode import readable
from ..mesh.layout import SplatObject
from ..viewport import draw as viewport_draw
from .worker import Worker

LEAST_SIDE = 2
"""Pixels: a box or a lasso that is narrower was a click, which takes nothing."""


@dataclass(frozen=True)
class How:
    """How a stroke takes splats.

    Attributes
    ----------
    shape : {"BRUSH", "LASSO", "BOX", "SPHERE", "COLOR"}
    mode : str
        See `picking.Mode`.
    hidden : bool
        Whether it takes what other splats hide too.
    radius : float
        Of the brush, pixels.
    tolerance : float
        Of the colour, 0 to 1.
    """

    shape: str
    mode: Mode
    hidden: bool
    radius: float
    tolerance: float


class _Kept(NamedTuple):
    """What a stroke saw, and of what: splats are prepared once, and looked at once a view."""

    splats: object
    prepared: Prepared
    view: object
    sight: Sight


_kept: list[_Kept] = []
"""Of the last stroke."""


def forget() -> None:
    """Let go of what the last stroke saw."""
    _kept.clear()


@dataclass(frozen=True, eq=False)
class _Job:
    """What a thread needs to look."""

    splats: object
    view: object
    selected: NDArray[np.bool_]
    source: Splats | Prepared | Sight
    matrix: NDArray[np.float64]
    camera: tuple[NDArray[np.float64], NDArray[np.float64], tuple[int, int]]

    def __call__(self, _progress: Progress) -> _Kept:
        """Return what the view shows."""
        source = self.source
        if isinstance(source, Splats):
            world = transformed(source, self.matrix, rotate_sh=False)
            source = picking.prepare(world, pinhole(*self.camera, world.means))
        if isinstance(source, Prepared):
            view = pinhole(*self.camera, source.splats.means)
            source = picking.look(source, view)
        return _Kept(self.splats, source.prepared, self.view, source)


def _job(context: bpy.types.Context) -> _Job:
    """Read the active object and the view."""
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
        kept = _kept[0] if _kept else None
        source: Splats | Prepared | Sight
        if kept is not None and kept.splats == splats:
            source = kept.sight if kept.view == view else kept.prepared
        else:
            _kept.clear()
            source = _drawn(checked, away)
    return _Job(splats, view, selected, source, matrix, camera)


def _drawn(checked: SplatObject, away: NDArray[np.bool_]) -> Splats:
    """Return the splats of an object, those that views do not show, (N,), without opacity."""
    splats = mesh_attributes.splats_from_object(checked, sh_rest=False)
    logits = np.where(away, np.float32(-np.inf), splats.opacity_logits)
    return replace(splats, opacity_logits=logits)


def _not_drawn(checked: SplatObject) -> NDArray[np.bool_]:
    """Return which splats the views do not show, (N,): hidden ones, and those of no such mode."""
    away, mode = selection.hidden(checked.obj), viewport_draw.mode()
    if mode in {"STAYS", "GOES"} and mesh_edit.REMOVE in checked.mesh.attributes:
        going = mesh_attributes.read_attribute(checked.mesh, mesh_edit.REMOVE) > 0
        away |= going if mode == "STAYS" else ~going
    return away


@dataclass(eq=False)
class Stroke:
    """One stroke of a tool over a view.

    Attributes
    ----------
    obj : bpy.types.Object
    how : How
    path : list of (float, float)
        Where the mouse was: column and row of the region from its upper left, pixels.
    before : (N,) bool
        What was selected.
    selected : (N,) bool or None
        What is to be, as far as it is known.
    """

    obj: bpy.types.Object
    how: How
    path: list[tuple[float, float]]
    before: NDArray[np.bool_]
    size: tuple[int, int]
    worker: Worker
    released: bool = False
    selected: NDArray[np.bool_] | None = None
    _sight: Sight | None = None
    _surface: Surface | None = None
    _area: NDArray[np.bool_] | None = None
    _painted: int = 0

    @classmethod
    def begin(cls, context: bpy.types.Context, how: How, at: tuple[float, float]) -> Stroke:
        """Begin where the button was pressed.

        Raises
        ------
        RefineError
            See `_job`.
        """
        job, obj = _job(context), context.object
        return cls(obj, how, [at], job.selected, job.camera[2], Worker(job))

    @property
    def known(self) -> bool:
        """Whether it is known what the view shows."""
        return self._sight is not None

    def follow(self) -> bool:
        """Take what the stroke covers by now; tell whether that is known.

        Raises
        ------
        RefineError
            What the thread raised.
        """
        if self._sight is None:
            if self.worker.running():
                return False
            _kept[:] = [self.worker.result()]
            self._sight = _kept[0].sight
        taken = self._taken(self._sight)
        self.selected = picking.combined(self.before, taken, self.how.mode)
        viewport_draw.select(self.obj.data.session_uid, self.selected)
        return True

    def sentence(self) -> str:
        """Return how many splats are to be selected."""
        chosen = self.before if self.selected is None else self.selected
        return f"{int(np.count_nonzero(chosen)):,} of {len(chosen):,} splats selected"

    def radius(self) -> float:
        """Return how far the mouse is from where it was pressed, pixels."""
        (x, y), (u, v) = self.path[0], self.path[-1]
        return float(np.hypot(u - x, v - y))

    def outline(self) -> list[tuple[float, float]]:
        """Return the corners of what is drawn over the view, closed; columns and rows."""
        (x, y), (u, v) = self.path[0], self.path[-1]
        if self.how.shape == "LASSO":
            return [*self.path, self.path[0]]
        if self.how.shape == "BOX":
            return [(x, y), (u, y), (u, v), (x, v), (x, y)]
        if self.how.shape == "COLOR":
            return []
        ball = self.how.shape == "SPHERE"
        radius = self.radius() if ball else self.how.radius
        turns = np.linspace(0.0, 2.0 * np.pi, 49)
        middle = self.path[0] if ball else self.path[-1]
        circle = np.stack([np.cos(turns), np.sin(turns)], axis=1) * radius + middle
        return [(float(a), float(b)) for a, b in circle]

    def _taken(self, seen: Sight) -> NDArray[np.bool_]:
        """Return which splats the stroke covers, (N,)."""
        hidden, shape = self.how.hidden, self.how.shape
        if shape in {"SPHERE", "COLOR"}:
            return self._from_surface(seen)
        width, height = self.size
        if shape == "BRUSH":
            if self._area is None:
                self._area = np.zeros((height, width), np.bool_)
            for place in range(self._painted, len(self.path)):
                ends = self.path[max(place - 1, 0)], self.path[place]
                picking.paint(self._area, *ends, self.how.radius)
            self._painted = len(self.path)
            return seen.in_area(self._area, hidden=hidden)
        corners = self.outline()[:-1]
        if np.ptp(corners, axis=0).max() < LEAST_SIDE:
            return np.zeros(len(self.before), np.bool_)
        return seen.in_area(picking.polygon(corners, width, height), hidden=hidden)

    def _from_surface(self, seen: Sight) -> NDArray[np.bool_]:
        """Return which splats lie around what was pressed, or have its colour, (N,)."""
        column, row = (int(number) for number in self.path[0])
        self._surface = self._surface or seen.surface(column, row)
        if self._surface is None:
            return np.zeros(len(self.before), np.bool_)
        if self.how.shape == "COLOR":
            return seen.of_color(self._surface.color, self.how.tolerance, hidden=self.how.hidden)
        radius = self.radius() / self._surface.scale
        return seen.in_ball(self._surface.place, radius, hidden=self.how.hidden)


def stop(stroke: Stroke) -> None:
    """Show the selection as it was before a stroke."""
    stroke.worker.cancel()
    viewport_draw.select(stroke.obj.data.session_uid, stroke.before)


def keep(stroke: Stroke) -> None:
    """Select what a stroke covers, which is known."""
    if stroke.selected is not None:
        selection.change(stroke.obj, stroke.before, stroke.selected)
    if viewport_draw.mode() == "OFF" and stroke.obj.mode != "EDIT":
        viewport_draw.show("SCENE")  # or nobody would see it
