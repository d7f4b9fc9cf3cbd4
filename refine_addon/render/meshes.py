"""What is not splats: rendered by the scene's own engine, with the depth of each pixel."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import bpy
import numpy as np

from ..core.drawing import Layer
from ..core.exr import read_exr
from ..mesh import native
from ..mesh.layout import looks_like_splats
from . import copies

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

_RENDERED = {
    *("MESH", "CURVE", "SURFACE", "FONT", "META", "VOLUME", "CURVES", "POINTCLOUD", "GREASEPENCIL"),
    *("GPENCIL", "EMPTY"),  # an empty may stand for a collection
}

_WORLD_SAMPLES = 16
"""Rays a pixel of the world alone, at most."""

_FARTHEST = 0.999
"""Share of the camera's range beyond which a depth is that of nothing: EEVEE of 4.3 says so."""

_ROUNDS = 2
"""Pixels by which known depths are spread to pixels at edges without one."""


def drawn_by_us(obj: bpy.types.Object) -> bool:
    """Tell whether an object holds splats that Blender does not draw itself."""
    return looks_like_splats(obj) and not (
        obj.type == "POINTCLOUD" and getattr(obj.data, "type", "") == native.TYPE
    )


class Meshes:
    """What a scene shows besides splats, rendered frame by frame.

    Parameters
    ----------
    scene : bpy.types.Scene
    folder : Path
        For files between the steps.

    Attributes
    ----------
    engine : str
        What renders them, "" where there is nothing to render.
    """

    def __init__(self, scene: bpy.types.Scene, folder: Path) -> None:
        self._folder = folder
        self._meshes = self._world = ""  # names of copies
        self._hidden: list[bpy.types.Object] = []
        self.engine = ""
        layer = next((layer for layer in scene.view_layers if layer.use), scene.view_layers[0])
        objects = [obj for obj in layer.objects if obj.type in _RENDERED and not obj.hide_render]
        if any(not drawn_by_us(obj) for obj in objects):
            self._meshes = self._copy(scene, "REFINE meshes", transparent=True).name
            # Older Blenders show the points of point clouds as balls.
            self._hidden = [o for o in objects if drawn_by_us(o) and o.type == "POINTCLOUD"]
        if not scene.render.film_transparent and scene.world is not None:
            world = self._copy(scene, "REFINE world", transparent=False)
            for linked in (world.collection.children, world.collection.objects):
                for item in [*linked]:
                    linked.unlink(item)
            if not self._meshes and hasattr(bpy.types.Scene, "cycles"):
                world.render.engine = "CYCLES"  # quicker to begin, and needs no graphics card
            _limit_samples(world)
            self._world = world.name
        if self._meshes or self._world:
            self.engine = bpy.data.scenes[self._meshes or self._world].render.engine

    def steps(self) -> Iterator[str]:
        """Give the names of the scenes to be rendered for a frame, one after another."""
        if self._meshes:
            for obj in self._hidden:
                obj.hide_render = True
            try:
                yield self._meshes
            finally:
                for obj in self._hidden:
                    obj.hide_render = False
        if self._world:
            yield self._world

    def layer(self, frame: int) -> Layer | None:
        """Return what was rendered for a frame, None if there is nothing to render."""
        meshes, world = (
            self._passes(name, frame) if name else None for name in (self._meshes, self._world)
        )
        if meshes is None:
            if world is None:
                return None
            background = world["Combined"][:3]
            height, width = background.shape[1:]
            nothing = np.zeros((height, width), np.float32)
            (shown,) = self._shown(self._world, [background])
            return Layer(np.zeros_like(shown), nothing, nothing, shown)
        colors, alphas = meshes["Combined"][:3], meshes["Combined"][3].clip(0.0, 1.0)
        depths = _known(meshes["Depth"][0], alphas, bpy.data.scenes[self._meshes].camera.data)
        opaque = colors / np.maximum(alphas, 1e-6)
        if world is None:
            (shown,) = self._shown(self._meshes, [opaque])
            return Layer(alphas * shown, alphas, depths)
        over = colors + (1.0 - alphas) * world["Combined"][:3]  # as without splats
        shown, whole = self._shown(self._meshes, [opaque, over])
        return Layer(alphas * shown, alphas, depths, whole - alphas * shown)

    def _copy(self, scene: bpy.types.Scene, name: str, *, transparent: bool) -> bpy.types.Scene:
        copy = copies.copied(scene, name)
        copy.render.film_transparent = transparent
        for layer in copy.view_layers:
            layer.use_pass_combined = layer.use_pass_z = True
            layer.pass_alpha_threshold = (
                0.0  # Cycles: the depth of what is nearest, seen through or not
            )
        if copy.render.engine.startswith("BLENDER_EEVEE") and not _has_card():
            copy.render.engine = "CYCLES"
            copy.cycles.samples = copy.eevee.taa_render_samples
            copy.cycles.use_denoising = False
        copies.write_exr(copy, self._folder / f"{name.rsplit(maxsplit=1)[-1]}_######")
        return copy

    def _passes(self, name: str, frame: int) -> dict[str, NDArray[np.float32]]:
        """Return the passes that were written, (channels, H, W) each, and remove the file."""
        path = Path(bpy.data.scenes[name].render.frame_path(frame=frame))
        channels = read_exr(path)
        path.unlink()
        found: dict[str, NDArray[np.float32]] = {}
        for kind, letters in (("Combined", "RGBA"), ("Depth", "ZV")):
            rows = [
                values
                for letter in letters
                for channel, values in channels.items()
                if channel.endswith(f".{kind}.{letter}")
            ]
            found[kind] = np.stack(rows) if rows else np.empty((0, 0, 0), np.float32)
        return found

    def _shown(self, name: str, pictures: list[NDArray[np.float32]]) -> list[NDArray[np.float32]]:
        """Return linear colours, (3, H, W) each, as the view transform of a scene shows them.

        Only Blender knows the transform, and applies it where it saves an image.
        """
        scene, path = bpy.data.scenes[name], self._folder / "shown.png"
        tall = np.concatenate(pictures, axis=1)
        height, width = tall.shape[1:]
        pixels = np.ones((height, width, 4), np.float32)
        pixels[..., :3] = np.moveaxis(tall, 0, -1)
        linear = bpy.data.images.new("REFINE", width, height, float_buffer=True)
        try:
            linear.pixels.foreach_set(pixels.ravel())
            copies.write_png(scene)
            linear.save_render(str(path), scene=scene)
        finally:
            bpy.data.images.remove(linear)
            copies.write_exr(scene, Path(scene.render.filepath))
        shown = bpy.data.images.load(str(path))
        try:
            shown.colorspace_settings.name = "Non-Color"
            shown.alpha_mode = "CHANNEL_PACKED"
            shown.pixels.foreach_get(pixels.ravel())
        finally:
            bpy.data.images.remove(shown)
            path.unlink()
        return np.split(np.moveaxis(pixels[..., :3], -1, 0), len(pictures), axis=1)


def _known(
    depths: NDArray[np.float32], alphas: NDArray[np.float32], camera: bpy.types.Camera
) -> NDArray[np.float32]:
    """Return the depth of what is seen in each pixel, (H, W), 0 where it has none.

    Engines write that of one ray a pixel, which may miss what others hit: at an edge the nearest
    depth beside it is taken. What is seen and has no depth anywhere near, as what EEVEE blends, is
    taken to be in front.
    """
    nothing = depths >= min(_FARTHEST * camera.clip_end, 1e9)
    known = np.where(nothing, np.float32(np.inf), depths)
    for _ in range(_ROUNDS):
        padded = np.pad(known, 1, constant_values=np.inf)
        height, width = known.shape
        around = [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)]
        known = np.where(np.isinf(known), np.minimum.reduce(around), known)
    return np.where(np.isinf(known) | (alphas <= 0.0), np.float32(0.0), known)


def _limit_samples(scene: bpy.types.Scene) -> None:
    """Render a world with few samples: there is little to be sampled."""
    scene.eevee.taa_render_samples = min(scene.eevee.taa_render_samples, _WORLD_SAMPLES)
    if hasattr(scene, "cycles"):
        scene.cycles.samples = min(scene.cycles.samples, _WORLD_SAMPLES)
        scene.cycles.use_denoising = False


def _has_card() -> bool:
    """Tell whether EEVEE has a graphics card to render on; without one it takes minutes."""
    if not bpy.app.background or not sys.platform.startswith("linux"):
        return True
    return Path("/dev/dri").exists() or Path("/dev/nvidia0").exists()
