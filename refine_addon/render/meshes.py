"""What is not splats: rendered by the scene's own engine, with the depth of each pixel."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.execute import Cancelled
from ..core.pictures import Layers
from ..mesh import native
from ..mesh.layout import looks_like_splats
from . import copies, passes
from .copies import Step
from .out_of_sight import out_of_sight
from .see_through import lets_through

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

_MOMENT = 0.01
"""Seconds that Blender may stand still."""


def drawn_by_us(obj: bpy.types.Object) -> bool:
    """Tell whether an object holds splats that Blender does not draw itself."""
    return looks_like_splats(obj) and not (
        obj.type == "POINTCLOUD" and getattr(obj.data, "type", "") == native.TYPE
    )


class Meshes:
    """What a scene shows besides splats, rendered frame by frame.

    What lets light through is rendered apart, so that splats between it and what stands behind it
    are seen.

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
        layer = next((layer for layer in scene.view_layers if layer.use), scene.view_layers[0])
        objects = [obj for obj in layer.objects if obj.type in _RENDERED and not obj.hide_render]
        shown = [obj for obj in objects if not drawn_by_us(obj)]
        # Older Blenders show the points of point clouds as balls.
        self._hidden = [o for o in objects if drawn_by_us(o) and o.type == "POINTCLOUD"]
        self._clear = self._opaque = []
        if shown:
            self._meshes = self._copy(scene, "meshes").name
            meshes = bpy.data.scenes[self._meshes]
            engine = meshes.render.engine
            glass = engine == "CYCLES" and meshes.cycles.film_transparent_glass
            self._clear = [obj for obj in shown if lets_through(obj, glass=glass)]
            self._opaque = [obj for obj in shown if obj not in self._clear]
            if self._clear and engine != "CYCLES" and hasattr(meshes, "cycles"):
                # EEVEE knows no depth of what it blends.
                self._depths = self._copy(scene, "depths", cycles=True, samples=1).name
        if not scene.render.film_transparent and scene.world is not None:
            # Cycles is quicker to begin, and needs no graphics card.
            world = self._copy(scene, "world", cycles=not shown, samples=_WORLD_SAMPLES)
            world.render.film_transparent, self._world = False, world.name
            for linked in (world.collection.children, world.collection.objects):
                for item in [*linked]:
                    linked.unlink(item)
        self._any = self._meshes or self._world
        self.engine = bpy.data.scenes[self._any].render.engine if self._any else ""

    def layers(
        self, frame: int
    ) -> Generator[Step | None, None, Callable[[], Layers | None] | None]:
        """Yield what has to be rendered of a frame; return what gives it as layers, on any thread.

        Where None is yielded Blender may do something else.
        """
        if not self._any:
            return None
        files = []
        if self._clear:
            with out_of_sight([*self._hidden, *self._opaque]):
                colors = depths = yield from self._rendered(self._meshes, frame, "clear")
                if self._depths:
                    depths = yield from self._rendered(self._depths, frame, "depths")
            files.append((colors, depths))
        if self._opaque:
            with out_of_sight([*self._hidden, *self._clear]):
                opaque = yield from self._rendered(self._meshes, frame, "opaque")
            files.append((opaque, opaque))
        world = (yield from self._rendered(self._world, frame, "world")) if self._world else None
        far = min(_FARTHEST * copies.existing(self._any).camera.data.clip_end, _INFINITE)
        with ThreadPoolExecutor(1, "refine-render") as pool:
            future = pool.submit(passes.read, files, world, far)
            while not wait([future], _MOMENT).done:
                yield None
        light = future.result()
        shown = yield from self._shown(light.pictures)
        return partial(light.layers, shown)

    def _rendered(self, name: str, frame: int, label: str) -> Generator[Step, None, Path]:
        """Render a frame of a copy; return the file, under another name.

        Blender takes Esc for itself, and writes nothing of what it has not finished.
        """
        copies.set_frames(name, [frame])
        yield Step(name, animation=True, what="meshes")
        try:
            written = Path(bpy.data.scenes[name].render.frame_path(frame=frame))
            return written.replace(self._folder / f"{label}.exr")
        except FileNotFoundError:
            raise Cancelled from None

    def _copy(
        self, scene: bpy.types.Scene, what: str, *, cycles: bool = False, samples: int = 0
    ) -> bpy.types.Scene:
        """Make a copy; by Cycles if there is no other way, or told so; with few rays if told so."""
        copy = copies.copied(scene, what)
        copies.write_exr(copy, self._folder / f"{what}_######")
        copy.render.film_transparent = True
        for layer in copy.view_layers:
            layer.use_pass_combined = layer.use_pass_z = True
            # Cycles: the depth of what is nearest, seen through or not.
            layer.pass_alpha_threshold = 0.0
        eevee = copy.render.engine.startswith("BLENDER_EEVEE")
        few = min(samples or copy.eevee.taa_render_samples, copy.eevee.taa_render_samples)
        copy.eevee.taa_render_samples = few
        settings = getattr(copy, "cycles", None)
        if settings is None:
            return copy
        if eevee and not _has_card():
            copy.render.engine, settings.samples, settings.use_denoising = "CYCLES", few, False
        if cycles:
            copy.render.engine = "CYCLES"
        if samples:
            settings.samples, settings.use_denoising = min(settings.samples, samples), False
        if samples == 1:
            settings.device = "CPU"  # whose kernels are there already
        if settings.device == "CPU":  # Cycles looks for Esc between tiles
            tile = settings.tile_size if settings.use_auto_tile else _TILE
            settings.use_auto_tile, settings.tile_size = True, min(tile, _TILE)
        return copy

    def _shown(
        self, pictures: Sequence[NDArray[np.float32]]
    ) -> Generator[None, None, list[NDArray[np.float32]]]:
        """Linear colours, (3, H, W) each, as the view transform of the scene shows them.

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
        """Some rows of linear colours, (3, R, W), as they are shown."""
        scene = copies.existing(self._any)
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


def _has_card() -> bool:
    """Tell whether EEVEE has a graphics card to render on; without one it takes minutes."""
    if not bpy.app.background or not sys.platform.startswith("linux"):
        return True
    return Path("/dev/dri").exists() or Path("/dev/nvidia0").exists()
