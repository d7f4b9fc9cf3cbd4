"""What one 3D view shows: its order of the splats, their colours from its eye, its picture.

While a view moves, the splats that matter most are sorted at once and drawn; once it rests, all of
them are sorted and coloured on the thread, and drawn when that is done.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, NamedTuple

import gpu
import numpy as np
from numpy.typing import NDArray

from ..mesh.heat_map import ramp
from . import background, shader
from .arrays import (
    GOES,
    Eye,
    as_texture,
    colors,
    farthest_first,
    first_of_each,
    heat,
    in_front,
    marked,
    same,
    tinted,
)
from .content import Atlas, Content, Slot

REST = 0.2
"""Seconds without a change after which a view rests."""

TINT, TINT_SHARE = (1.0, 0.15, 0.0), 0.55
"""What goes is shown in this colour, by that share."""


class Moving(NamedTuple):
    """What is drawn while a view moves: at most so many splats, each so many pixels wide."""

    splats: int
    pixels: int


BY_CARD, BY_PROCESSOR = Moving(300_000, 1), Moving(20_000, 3)


class Camera(NamedTuple):
    """Where a view looks from and how.

    Attributes
    ----------
    view : (4, 4) float64
        World to camera: x right, y up, z back.
    projection : (4, 4) float64
    size : (int, int)
        Pixels across and up.
    """

    view: NDArray[np.float64]
    projection: NDArray[np.float64]
    size: tuple[int, int]

    @property
    def perspective(self) -> bool:
        """Whether farther things look smaller."""
        return bool(self.projection[3, 3] == 0.0)

    @property
    def near(self) -> float:
        """Depth of the near plane."""
        p = self.projection
        return float(p[2, 3] / (p[2, 2] - 1.0) if self.perspective else (p[2, 3] + 1.0) / p[2, 2])

    def key(self) -> bytes:
        """Return what tells it from another."""
        return self.view.tobytes() + self.projection.tobytes() + bytes(str(self.size), "ascii")


class Shown(NamedTuple):
    """An object in a view: its place in the textures and its matrix to the camera, (4, 4)."""

    slot: Slot
    matrix: NDArray[np.float64]


class _Part(NamedTuple):
    """What the thread needs of one object."""

    slot: Slot
    going: NDArray[np.bool_] | None
    hidden: NDArray[np.bool_] | None
    ranks: NDArray[Any] | None
    forced: NDArray[np.int32] | None
    important: NDArray[np.int32] | None
    eye: Eye


class _Sorted(NamedTuple):
    """What the thread computed."""

    order: NDArray[np.float32]
    drawn: int
    colors: NDArray[np.float32] | None


@dataclass(eq=False)
class _Order:
    """The splats that are drawn, back to front, on the graphics card."""

    texture: gpu.types.GPUTexture
    count: int
    key: object


class View:
    """One region of a 3D view."""

    def __init__(self) -> None:
        self._picture: gpu.types.GPUTexture | None = None
        self._drawn: object = None
        self._depths: NDArray[np.float32] | None = None
        self._order: _Order | None = None
        self._colors: gpu.types.GPUTexture | None = None
        self._colors_key: object = None
        self._colored: Atlas | None = None
        self._job: tuple[object, object, Future[_Sorted]] | None = None
        self._camera_key = b""
        self._changed = 0.0
        self.complete = False
        self.count = 0

    def waits(self) -> bool:
        """Tell whether this is not yet all that is to be seen."""
        return not self.complete

    def due(self) -> bool:
        """Tell whether drawing again would show more."""
        if self._job:
            return self._job[2].done()
        return not self.complete and time.monotonic() - self._changed >= REST

    def draw(
        self,
        content: Content,
        places: dict[tuple[int, int], NDArray[np.float64]],
        camera: Camera,
        mode: str,
        *,
        solid: bool,
    ) -> None:
        """Draw some objects into the framebuffer of the view.

        Parameters
        ----------
        content : Content
        places : mapping of (int, int) to (4, 4) float64
            See `Content.update`.
        camera : Camera
        mode : str
            One of `draw.MODES`.
        solid : bool
            Whether anything but splats is in the view that hides what is behind it.
        """
        atlas = content.atlas
        if atlas is None or not places:
            self.complete, self.count = not content.pending(), 0
            return
        shown = [Shown(atlas.slots[key], camera.view @ matrix) for key, matrix in places.items()]
        matrices = b"".join(s.matrix.tobytes() for s in shown)
        moving = self._moves(camera.key() + matrices)
        full = (atlas, content.changes, mode, matrices, camera.perspective, camera.near)
        self._take()
        least = BY_PROCESSOR if gpu.platform.device_type_get() == "SOFTWARE" else BY_CARD
        if self._colored is not atlas:
            self._order, self._colors = None, None
        if moving:
            self._sort(full, shown, camera, mode, least.splats)
        elif self._job is None and (self._order is None or self._order.key != full):
            self._start(full, shown, camera, mode, least.splats)
        self.complete = not moving and self._order is not None and self._order.key == full
        if self._order is None or self._colors is None:
            return
        self.count = self._order.count
        pixels = 1 if self.complete else least.pixels
        self._paint(content, shown, camera, pixels, solid=solid)
        _put(self._picture)

    def _moves(self, key: bytes) -> bool:
        """Tell whether the view, or an object in it, has moved in the last moments."""
        now = time.monotonic()
        if key != self._camera_key:
            self._changed = now if self._camera_key else 0.0
            self._camera_key = key
        return now - self._changed < REST

    def _take(self) -> None:
        """Take what the thread has computed."""
        if self._job is None or not self._job[2].done():
            return
        order_key, colors_key, future = self._job
        self._job = None
        result = future.result()
        self._order = _Order(shader.texture(result.order, 1, "R32F"), result.drawn, order_key)
        if result.colors is not None:
            self._colors = shader.texture(result.colors, 4, "RGBA16F")
            self._colors_key, self._colored = colors_key, order_key[0]

    def _start(
        self, key: tuple[Any, ...], shown: list[Shown], camera: Camera, mode: str, few: int
    ) -> None:
        """Have all splats sorted, and coloured if they look otherwise from here.

        Where nothing is seen yet, only those that matter most, in their constant colours.
        """
        parts = _parts(shown, camera)
        objects = [(p.slot.number, p.slot.held.marked) for p in parts]
        colors_key: tuple[Any, ...] = (key[0], mode, objects)
        if mode == "HEAT":
            colors_key += tuple(p.slot.held.scored for p in parts)
        else:
            colors_key += tuple(p.eye.place.tobytes() for p in parts if p.slot.held.degree)
        rows = None if colors_key == self._colors_key else key[0].rows
        if self._colors is None and key[0].rows > few:
            first = background.start(_sort_and_color, parts, camera.near, mode, rows, few)
            self._job = ((*key, few), None, first)
        else:
            work = background.start(_sort_and_color, parts, camera.near, mode, rows)
            self._job = (key, colors_key, work)

    def _sort(
        self, key: tuple[Any, ...], shown: list[Shown], camera: Camera, mode: str, most: int
    ) -> None:
        """Sort the splats that matter most, at once."""
        key = (*key, most)
        if self._order is None or self._order.key != key:
            order = _order(_parts(shown, camera), camera.near, mode, most)
            self._order = _Order(shader.texture(as_texture(order), 1, "R32F"), len(order), key)

    def _paint(
        self,
        content: Content,
        shown: list[Shown],
        camera: Camera,
        pixels: int,
        *,
        solid: bool,
    ) -> None:
        """Draw the splats into the picture, unless it shows them already."""
        depths = _depths(camera.size) if solid else None
        size = (max(1, camera.size[0] // pixels), max(1, camera.size[1] // pixels))
        look = (self._order.key, self._colors_key, self._camera_key, size)
        wanted = (*look, content.selections)
        if self._picture and wanted == self._drawn and same(depths, self._depths):
            return
        self._drawn, self._depths = wanted, depths
        if not self._picture or (self._picture.width, self._picture.height) != size:
            self._picture = gpu.types.GPUTexture(size, format="RGBA16F")
        atlas = content.atlas
        occluders = np.ones((1, 1), np.float32) if depths is None else depths
        textures = {
            "order": self._order.texture,
            "means": atlas.means,
            "covariances": atlas.covariances,
            "more_covariances": atlas.more_covariances,
            "colors": self._colors,
            "selection": content.selection(),
            "matrices": shader.texture(_matrix_rows(shown), 4, "RGBA32F"),
            "depths": (farthest := shader.texture(occluders, 1, "R32F")),
            "near_depths": farthest,
        }  # held until they are drawn: the shader does not keep what it is given
        numbers = _view_data(camera, size, solid=depths is not None)
        frame = gpu.types.GPUFrameBuffer(color_slots=self._picture)
        shader.blend(frame, textures, numbers, self._order.count)


def _matrix_rows(shown: list[Shown]) -> NDArray[np.float32]:
    """Return the upper three rows of each object's matrix, by the number of its slot, (S, 12)."""
    rows = np.zeros((1 + max(each.slot.number for each in shown), 12), np.float32)
    for each in shown:
        rows[each.slot.number] = each.matrix[:3].reshape(-1)
    return rows


def _view_data(camera: Camera, size: tuple[int, int], *, solid: bool) -> NDArray[np.float32]:
    """Return what the shader knows of a view as ``ViewData``, for a picture of this size."""
    numbers = np.zeros(24, np.float32)
    numbers[:16] = camera.projection.T.reshape(-1)
    numbers[16:20] = (*size, camera.near, camera.size[0] / size[0])
    numbers[20:22] = (camera.perspective, solid)
    return numbers


def _parts(shown: Iterable[Shown], camera: Camera) -> list[_Part]:
    parts = []
    for slot, matrix in shown:
        if camera.perspective:
            place = np.linalg.pinv(matrix)[:3, 3]
        else:
            place = np.linalg.pinv(matrix)[:3, :3] @ (0.0, 0.0, -1.0)
        held = slot.held
        eye = Eye(-matrix[2], place, camera.perspective)
        parts.append(
            _Part(slot, held.going, held.hidden, held.ranks, held.forced, held.important, eye)
        )
    return parts


def _sort_and_color(
    parts: list[_Part], near: float, mode: str, rows: int | None, few: int | None = None
) -> _Sorted:
    """Sort splats and, in textures of so many rows, colour them; on the thread.

    With `few`, only so many are sorted, and colours are constant.
    """
    order = _order(parts, near, mode, few)
    if rows is None:
        return _Sorted(as_texture(order), len(order), None)
    painted = np.zeros((rows, 4), np.float32)
    for part in parts:
        slot = part.slot
        rgba = _colored(part, mode, constant=few is not None)
        painted[slot.start : slot.start + slot.count] = rgba[: slot.count]
    return _Sorted(as_texture(order), len(order), as_texture(painted))


def _colored(part: _Part, mode: str, *, constant: bool) -> NDArray[np.float32]:
    """Return the colours of an object's splats in a mode, (M, 4)."""
    packed, forced = part.slot.packed, part.forced
    if mode == "HEAT" and part.ranks is not None:
        rgba = heat(packed, part.ranks, ramp())
    else:
        rgba = colors(packed, None if constant else part.eye)
    if mode == "GOES":
        goes = tinted(rgba, TINT, TINT_SHARE)
        rgba = goes if forced is None else np.where((forced == GOES)[:, None], rgba, goes)
    return marked(rgba, forced, mode)


def _order(parts: list[_Part], near: float, mode: str, most: int | None = None) -> NDArray[Any]:
    """Return the rows of the textures that are drawn, the farthest first."""
    counts = [part.slot.count for part in parts]
    counts = counts if most is None else first_of_each(counts, most)
    rows, depths = zip(
        *(_in_view(*pair, near, mode) for pair in zip(parts, counts, strict=True)), strict=True
    )
    perspective = parts[0].eye.perspective
    return np.concatenate(rows)[farthest_first(np.concatenate(depths), perspective=perspective)]


def _in_view(
    part: _Part, count: int, near: float, mode: str
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the rows of an object's most important splats that a view draws, and their depths."""
    slot, important = part.slot, part.important
    if count == slot.count or important is None:
        shown, depths = in_front(slot.packed.means[:count], part.eye, near)
    else:
        chosen = important[important < slot.count][:count]
        places, depths = in_front(slot.packed.means[chosen], part.eye, near)
        shown = chosen[places].astype(np.int64)
    if mode in {"STAYS", "GOES"}:
        wanted = _wanted(part.going, mode, shown)
        shown, depths = shown[wanted], depths[wanted]
    if part.hidden is not None:
        wanted = ~part.hidden[shown]
        shown, depths = shown[wanted], depths[wanted]
    return shown + slot.start, depths


def _wanted(
    going: NDArray[np.bool_] | None, mode: str, rows: NDArray[np.int64]
) -> NDArray[np.bool_]:
    """Return which rows stay, or go; without a plan all stay."""
    if going is None:
        return np.full(len(rows), mode == "STAYS")
    return going[rows] if mode == "GOES" else ~going[rows]


def _depths(size: tuple[int, int]) -> NDArray[np.float32] | None:
    """Return the depths that Blender has drawn in the view, (H, W), None where it kept none.

    EEVEE of 4.3 leaves zeros where overlays are off.
    """
    width, height = size
    buffer = gpu.types.Buffer("FLOAT", width * height)
    gpu.state.active_framebuffer_get().read_depth(0, 0, width, height, data=buffer)
    depths = np.frombuffer(memoryview(buffer), np.float32).reshape(height, width)
    return depths if depths.any() else None


def _put(picture: gpu.types.GPUTexture) -> None:
    """Put a picture into the framebuffer that is bound."""
    program, quad = shader.picture()
    gpu.state.blend_set("ALPHA_PREMULT")
    gpu.state.depth_test_set("NONE")
    gpu.state.depth_mask_set(False)
    program.bind()
    program.uniform_sampler("picture", picture)
    quad.draw(program)
    gpu.state.blend_set("NONE")
