"""One 3D view: the order of its splats, their colours from its eye, its picture.
While it moves, the most important splats are sorted at once; at rest a thread sorts and colours
all."""

from __future__ import annotations

import time
from concurrent.futures import Future
from typing import Any, NamedTuple

import bpy
import gpu
import numpy as np
from numpy.typing import NDArray

from . import shader
from .arrays import MOST, Eye, Marks, as_texture, colored, farthest_first, first_of_each, in_front
from .content import Content, Places, Slot

REST = 0.2  # Seconds without a change after which a view counts as resting
STYLES = {"ELLIPSES": 1, "CENTERS": 2}  # The shader's style in a mode, in others 0: splats

BY_CARD, BY_PROCESSOR = (300_000, 1), (20_000, 3)
"""Splats drawn at most while a view moves, and side of a drawn pixel in pixels of the view."""


class Camera(NamedTuple):
    """`view`: world to camera, (4, 4), x right, y up, z back; `projection`: (4, 4) as in OpenGL;
    `size`: width and height, pixels."""

    view: NDArray[np.float64]
    projection: NDArray[np.float64]
    size: tuple[int, int]

    @classmethod
    def of(cls, context: bpy.types.Context) -> Camera:
        """Camera of the context's 3D view."""
        region, eye = context.region, context.region_data
        matrices = (np.array(each, np.float64) for each in (eye.view_matrix, eye.window_matrix))
        return cls(*matrices, (region.width, region.height))

    @property
    def perspective(self) -> bool:
        """Whether the view is in perspective, not orthographic."""
        return bool(self.projection[3, 3] == 0.0)

    @property
    def near(self) -> float:
        """Depth of the near plane, in units of the world."""
        p = self.projection
        return float(p[2, 3] / (p[2, 2] - 1.0) if self.perspective else (p[2, 3] + 1.0) / p[2, 2])

    def key(self) -> bytes:
        """Cache key."""
        return self.view.tobytes() + self.projection.tobytes() + bytes(str(self.size), "ascii")


class _Part(NamedTuple):
    slot: Slot
    marks: Marks
    important: NDArray[np.int32]
    eye: Eye


class View:
    """One region of a 3D view. `complete`: all splats are shown, in full; `count`: splats shown;
    `depths`: (H, W) that Blender drew, None where nothing hides splats."""

    def __init__(self) -> None:
        self._picture: gpu.types.GPUTexture | None = None
        self._drawn: object = None
        self.depths: NDArray[np.float32] | None = None
        self._order: gpu.types.GPUTexture | None = None
        self._order_key: tuple[Any, ...] = (None,)  # first the atlas
        self._ordered = 0
        self._colors: gpu.types.GPUTexture | None = None
        self._colors_key: object = None
        self._job: tuple[tuple[Any, ...], object, Future[Any]] | None = None
        self._camera_key = b""
        self._changed = 0.0
        self.complete = False
        self.count = 0

    def due(self) -> bool:
        """Whether drawing again would show more."""
        if self._job:
            return self._job[2].done()
        return not self.complete and time.monotonic() - self._changed >= REST

    def draw(
        self, content: Content, places: Places, camera: Camera, mode: str, *, solid: bool
    ) -> None:
        """Draw splats into the view, in one of `draw.MODES`. `places`: from `Content.update`;
        `solid`: whether other objects hide splats behind them."""
        atlas = content.atlas
        if not places:
            self.complete, self.count = not content.pending(), 0
            return
        shown = [(atlas.slots[key], camera.view @ matrix) for key, matrix in places.items()]
        matrices = b"".join(matrix.tobytes() for _, matrix in shown)
        key = camera.key() + matrices
        if key != self._camera_key:  # the view or an object in it moved
            self._changed = time.monotonic() if self._camera_key else 0.0
            self._camera_key = key
        moving = time.monotonic() - self._changed < REST
        full = (atlas, content.changes, mode, matrices, camera.perspective, camera.near)
        if self._job and self._job[2].done():
            (order_key, colors_key, future), self._job = self._job, None
            order, count, painted = future.result()
            self._keep(order_key, order, count)
            if painted is not None:
                self._colors_key, self._colors = colors_key, shader.texture(painted, 4, "RGBA16F")
        few, wide = BY_PROCESSOR if gpu.platform.device_type_get() == "SOFTWARE" else BY_CARD
        if self._order_key[0] is not atlas:
            self._order, self._order_key, self._colors = None, (None,), None
        if moving and self._order_key != (*full, few):
            self._keep((*full, few), *_order(_parts(shown, camera), camera.near, mode, few))
        elif not moving and self._job is None and self._order_key != full:
            self._start(content.pool, full, _parts(shown, camera), camera.near, mode, few)
        self.complete = not moving and self._order_key == full
        if self._order is None or self._colors is None:
            return
        self.count = self._ordered
        style = STYLES.get(mode, 0)
        self._paint(content, shown, camera, 1 if self.complete else wide, solid, style)
        _put(self._picture)

    def _start(self, pool, key, parts, near, mode, few):
        """Start the thread that sorts all splats, and colours them if colours changed.
        For the first picture only the most important ones, in constant colours."""
        objects = [(p.slot.number, p.slot.held.marked) for p in parts]
        colors_key: tuple[Any, ...] = (key[0], mode, objects)
        if mode != "HEAT":
            varying = (p for p in parts if p.slot.packed.harmonics.shape[1] > 1)
            colors_key += tuple(p.eye.place.tobytes() for p in varying)
        rows = None if colors_key == self._colors_key else key[0].rows
        if self._colors is None and key[0].rows > few:
            key, colors_key = (*key, few), None
        else:
            few = None
        self._job = key, colors_key, pool.submit(_sort_and_color, parts, near, mode, rows, few)

    def _keep(self, key, order, count):
        """Draw this order, a texture of so many splats, from now on."""
        self._order_key, self._ordered, self._order = key, count, shader.texture(order, 1, "R32F")

    def _paint(self, content, shown, camera, pixels, solid, style):
        """Draw the splats into the picture, unless it is up to date."""
        depths = _depths(camera.size) if solid else None
        size = (max(1, camera.size[0] // pixels), max(1, camera.size[1] // pixels))
        look = (self._order_key, self._colors_key, self._camera_key, style)
        wanted = (*look, size, content.selections)
        if self._picture and wanted == self._drawn and np.array_equal(depths, self.depths):
            return
        self._drawn, self.depths = wanted, depths
        if not self._picture or (self._picture.width, self._picture.height) != size:
            self._picture = gpu.types.GPUTexture(size, format="RGBA16F")
        rows = np.zeros((1 + max(slot.number for slot, _ in shown), 12), np.float32)
        for slot, matrix in shown:
            rows[slot.number] = matrix[:3].reshape(-1)
        textures = {
            **content.atlas.textures,
            "order": self._order,
            "colors": self._colors,
            "selection": content.selection(),
            "matrices": shader.texture(rows, 4, "RGBA32F"),
        }  # referenced until drawn, which the shader does not do
        if depths is not None:
            textures["depths"] = shader.texture(depths, 1, "R32F")
        shader.blend(self._picture, textures, camera.projection, camera.near, self.count, style)


def _parts(shown: list[tuple[Slot, NDArray[Any]]], camera: Camera) -> list[_Part]:
    parts = []
    for slot, matrix in shown:
        back = np.linalg.pinv(matrix)[:3]
        place = back[:, 3] if camera.perspective else back[:, :3] @ (0.0, 0.0, -1.0)
        eye = Eye(-matrix[2], place, camera.perspective)
        parts.append(_Part(slot, slot.held.marks, slot.held.important, eye))
    return parts


def _sort_and_color(parts, near, mode, rows, few):
    """Sort splats and, if `rows` is given, colour them in a texture for that many; on the thread.
    With `few`, at most so many, in constant colours. Gives the order as a texture, its number of
    splats, and the colours as a texture or None."""
    order, count = _order(parts, near, mode, few or MOST)
    if rows is None:
        return order, count, None
    painted = np.zeros((rows, 4), np.float32)
    for part in parts:
        rgba = colored(part.slot.packed, None if few else part.eye, mode, part.marks)
        painted[part.slot.rows] = rgba[: part.slot.count]
    return order, count, as_texture(painted)


def _order(parts, near, mode, most):
    """Rows of the most important splats, the farthest first, as a texture, and their number."""
    counts = first_of_each([part.slot.count for part in parts], most)
    found = [_in_view(*pair, near, mode) for pair in zip(parts, counts, strict=True)]
    rows, depths = map(np.concatenate, zip(*found, strict=True))
    order = rows[farthest_first(depths, perspective=parts[0].eye.perspective)]
    return as_texture(order), len(order)


def _in_view(part, count, near, mode):
    """Rows of an object's `count` most important splats that the view draws, and their depths."""
    slot, important = part.slot, part.important
    if count == slot.count:
        shown, depths = in_front(slot.packed.means[:count], part.eye, near)
    else:
        chosen = important[important < slot.count][:count]
        places, depths = in_front(slot.packed.means[chosen], part.eye, near)
        shown = chosen[places].astype(np.int64)
    going, hidden = part.marks.going, part.marks.hidden
    wanted = np.full(len(shown), mode != "GOES")  # without a preview all stay
    if mode in {"STAYS", "GOES"} and going is not None:
        wanted = going[shown] == (mode == "GOES")
    if hidden is not None:
        wanted &= ~hidden[shown]
    return shown[wanted] + slot.rows.start, depths[wanted]


def _depths(size: tuple[int, int]) -> NDArray[np.float32] | None:
    """Depths that Blender drew in the view, (H, W); None if it kept none, as EEVEE of 4.3 without
    overlays."""
    width, height = size
    buffer = gpu.types.Buffer("FLOAT", width * height)
    gpu.state.active_framebuffer_get().read_depth(0, 0, width, height, data=buffer)
    depths = np.frombuffer(memoryview(buffer), np.float32).reshape(height, width)
    return depths if depths.any() else None


def _put(picture: gpu.types.GPUTexture) -> None:
    """Draw a picture of splats into the view."""
    program, quad = shader.program("picture")
    gpu.state.blend_set("ALPHA_PREMULT")
    gpu.state.depth_test_set("NONE")
    gpu.state.depth_mask_set(False)
    program.bind()
    program.uniform_sampler("picture", picture)
    quad.draw(program)
    gpu.state.blend_set("NONE")
