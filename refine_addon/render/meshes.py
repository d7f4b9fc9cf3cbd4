"""What is not splats: rendered by the scene's own engine, with the depth of each pixel."""

from __future__ import annotations

import sys
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import NamedTuple

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.execute import Cancelled
from ..mesh import native
from ..mesh.layout import looks_like_splats
from . import copies, see_through
from .out_of_sight import out_of_sight
from .passes import Rendered

_RENDERED = {
    *("MESH", "CURVE", "SURFACE", "FONT", "META", "VOLUME", "CURVES", "POINTCLOUD", "GREASEPENCIL"),
    *("GPENCIL", "EMPTY"),  # an empty may stand for a collection
}

_TILE = 128
"""Pixels along each side of a tile that the processor renders, at most."""

_WORLD_SAMPLES = 16
"""Rays a pixel of the world alone, at most."""

_FARTHEST = 0.999
"""Share of the camera's range beyond which a depth is that of nothing: EEVEE of 4.3 says so."""

_INFINITE = 1e9
"""Depth beyond which there is nothing: Cycles says 1e10."""

_PIXELS = 1 << 18
"""Pixels that the view transform is applied to at a time."""


def drawn_by_us(obj: bpy.types.Object) -> bool:
    """Tell whether an object holds splats that Blender does not draw itself."""
    return looks_like_splats(obj) and not (
        obj.type == "POINTCLOUD" and getattr(obj.data, "type", "") == native.TYPE
    )


class _Apart(NamedTuple):
    """Objects that are rendered together."""

    others: list[bpy.types.Object]
    blended: bool = False


def _divided(scene: bpy.types.Scene, objects: list[bpy.types.Object]) -> list[_Apart]:
    """Return which objects of a copy are rendered together, the opaque ones last."""
    eevee = scene.render.engine.startswith("BLENDER_EEVEE")
    glass = scene.render.engine == "CYCLES" and scene.cycles.film_transparent_glass
    opaque, apart = see_through.groups(objects, glass=glass)
    parts = [_Apart([obj for obj in objects if obj not in group], eevee) for group in apart]
    if opaque:
        parts.append(_Apart([obj for obj in objects if obj not in opaque]))
    return parts


class Meshes:
    """What a scene shows besides splats, rendered frame by frame.

    What lets light through is rendered apart, object by object, so that splats between it and what
    stands behind it are seen.

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
        self._meshes = self._depths = self._world = ""  # names of copies
        self._hidden: list[bpy.types.Object] = []
        self._apart: list[_Apart] = [_Apart([])]
        self.engine = ""
        layer = next((layer for layer in scene.view_layers if layer.use), scene.view_layers[0])
        objects = [obj for obj in layer.objects if obj.type in _RENDERED and not obj.hide_render]
        shown = [obj for obj in objects if not drawn_by_us(obj)]
        if shown:
            meshes = self._copy(scene, "REFINE meshes", transparent=True)
            self._meshes = meshes.name
            # Older Blenders show the points of point clouds as balls.
            self._hidden = [o for o in objects if drawn_by_us(o) and o.type == "POINTCLOUD"]
            self._apart = _divided(meshes, shown)
            if any(part.blended for part in self._apart) and hasattr(meshes, "cycles"):
                depths = self._copy(scene, "REFINE depths", transparent=True)
                depths.render.engine = "CYCLES"
                depths.cycles.samples, depths.cycles.use_denoising = 1, False
                depths.cycles.device = "CPU"  # whose kernels are there already
                self._depths = depths.name
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

    def steps(self, frame: int) -> Generator[str, None, Rendered]:
        """Give the names of the scenes to be rendered for a frame, one after another.

        The next is asked for when one is rendered; afterwards it returns what was.
        """
        camera = bpy.data.scenes[self._meshes or self._world].camera.data if self.engine else None
        far = min(_FARTHEST * camera.clip_end, _INFINITE) if camera else _INFINITE
        rendered = Rendered(far)
        for number, part in enumerate(self._apart if self._meshes else ()):
            with out_of_sight([*self._hidden, *part.others]):
                yield self._meshes
                colors = depths = self._kept(self._meshes, frame, f"colors_{number}")
                if part.blended and self._depths:
                    yield self._depths
                    depths = self._kept(self._depths, frame, f"depths_{number}")
            rendered.parts.append((colors, depths))
        if self._world:
            yield self._world
            rendered.world = self._kept(self._world, frame, "world")
        return rendered

    def _kept(self, name: str, frame: int, label: str) -> Path:
        """Return the file that was just written, under another name.

        Blender takes Esc for itself, and writes nothing of what it has not finished.
        """
        try:
            written = Path(bpy.data.scenes[name].render.frame_path(frame=frame))
            return written.replace(self._folder / f"{label}.exr")
        except FileNotFoundError:
            raise Cancelled from None

    def _copy(self, scene: bpy.types.Scene, name: str, *, transparent: bool) -> bpy.types.Scene:
        copy = copies.copied(scene, name)
        copy.render.film_transparent = transparent
        for layer in copy.view_layers:
            layer.use_pass_combined = layer.use_pass_z = True
            # Cycles: the depth of what is nearest, seen through or not.
            layer.pass_alpha_threshold = 0.0
        if copy.render.engine.startswith("BLENDER_EEVEE") and not _has_card():
            copy.render.engine = "CYCLES"
            copy.cycles.samples = copy.eevee.taa_render_samples
            copy.cycles.use_denoising = False
        _small_tiles(copy)
        copies.write_exr(copy, self._folder / f"{name.rsplit(maxsplit=1)[-1]}_######")
        return copy

    def shown(
        self, pictures: Sequence[NDArray[np.float32]]
    ) -> Generator[None, None, list[NDArray[np.float32]]]:
        """Return linear colours, (3, H, W) each, as the view transform of the scene shows them.

        Only Blender knows the transform, and applies it where it saves an image. So much is done
        between two yields that Blender stands still for a tenth of a second.
        """
        if not pictures:
            return []
        tall = np.concatenate(pictures, axis=1)
        rows = max(_PIXELS // tall.shape[2], 1)
        bands = []
        for start in range(0, tall.shape[1], rows):
            yield
            bands.append(self._band_shown(tall[:, start : start + rows]))
        return np.split(np.concatenate(bands, axis=1), len(pictures), axis=1)

    def _band_shown(self, band: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return some rows of linear colours, (3, R, W), as they are shown."""
        scene = bpy.data.scenes[self._meshes or self._world]
        path = self._folder / "shown.png"
        height, width = band.shape[1:]
        pixels = np.ones((height, width, 4), np.float32)
        pixels[..., :3] = np.moveaxis(band, 0, -1)
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
        return np.moveaxis(pixels[..., :3], -1, 0)


def _small_tiles(scene: bpy.types.Scene) -> None:
    """Have Cycles look for Esc often where the processor renders: it does so between tiles."""
    cycles = getattr(scene, "cycles", None)
    if cycles is not None and cycles.device == "CPU":
        cycles.tile_size = min(cycles.tile_size, _TILE) if cycles.use_auto_tile else _TILE
        cycles.use_auto_tile = True


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
