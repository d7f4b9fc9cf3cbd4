"""Everything but splats: rendered by the scene's own engine, with depths."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import bpy
import numpy as np

from ..core.execute import Cancelled
from ..core.pictures import Layers
from ..mesh import native
from ..mesh.layout import looks_like_splats
from . import copies, passes

_RENDERED = {
    *("MESH", "CURVE", "SURFACE", "FONT", "META", "VOLUME", "CURVES", "POINTCLOUD", "GREASEPENCIL"),
    *("GPENCIL", "EMPTY"),  # an empty may stand for a collection
}

_MARK = "refine_out_of_sight"  # Custom property of a hidden object: the property that was changed

_BY_RAYS = {"MESH", "CURVE", "SURFACE", "FONT", "META", "VOLUME", "CURVES"}
"""Types that can be hidden from cameras; EEVEE ignores that for instances."""

_TILE = 128  # Largest tile side rendered by the processor, pixels

_WORLD_SAMPLES = 16  # Rays in each pixel of the world, at most

_FARTHEST = 0.999  # Share of the range beyond which there is nothing: EEVEE of 4.3 says so

_INFINITE = 1e9  # Depth beyond which there is nothing: Cycles reports 1e10

_PIXELS = 1 << 18  # Pixels per call of the view transform

_MOMENT = 0.01  # Seconds that Blender may stand still


Steps = Generator[copies.Step | None, None, Callable[[], Layers] | None]


def drawn_by_us(obj: bpy.types.Object) -> bool:
    """Whether an object holds splats that Blender does not draw itself."""
    return looks_like_splats(obj) and not (
        obj.type == "POINTCLOUD" and getattr(obj.data, "type", "") == native.TYPE
    )


class Meshes:
    """A scene without its splats, rendered frame by frame through files in `folder`.
    See-through objects are rendered apart, so that splats behind them are seen. `engine`: what
    renders them, "" if there is nothing; `renders`: Blender's renders for each frame."""

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
            self._clear = [obj for obj in shown if _lets_through(obj, glass)]
            self._opaque = [obj for obj in shown if obj not in self._clear]
            if self._clear and engine.startswith("BLENDER_EEVEE") and hasattr(meshes, "cycles"):
                # It knows no depth of what it blends.
                self._depths = self._copy(scene, "depths", cycles=True, samples=1).name
        if not scene.render.film_transparent and scene.world is not None:
            # Cycles is quicker to begin, and needs no graphics card.
            world = self._copy(scene, "world", cycles=not shown, samples=_WORLD_SAMPLES)
            world.render.film_transparent, self._world = False, world.name
            for linked in (world.collection.children, world.collection.objects):
                for item in [*linked]:
                    linked.unlink(item)
        renders = (self._clear, self._opaque, self._depths, self._world)
        self.renders, self._any = sum(map(bool, renders)), self._meshes or self._world
        self.engine = bpy.data.scenes[self._any].render.engine if self._any else ""

    def layers(self, frame: int) -> Steps:
        """Yield a frame's renders (None: Blender may work); a thread-safe reader of its layers."""
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
        pictures, blended = future.result()
        return partial(blended, (yield from self._shown(pictures)))

    def _rendered(self, name, frame, label):
        """Render a frame of a copy; the renamed file.
        Blender handles Esc itself, and writes no unfinished file."""
        copies.set_frames(name, [frame])
        yield copies.Step(name, animation=True, what="meshes")
        try:
            written = Path(bpy.data.scenes[name].render.frame_path(frame=frame))
            return written.replace(self._folder / f"{label}.exr")
        except FileNotFoundError:
            raise Cancelled from None

    def _copy(self, scene, what, *, cycles=False, samples=0):
        """Make a copy: by Cycles if needed or asked for, with few rays if asked for."""
        copy = copies.copied(scene, what)
        copies.write_exr(copy, self._folder / f"{what}_######")
        copy.render.film_transparent = True
        for layer in copy.view_layers:
            layer.use_pass_combined = layer.use_pass_z = True
            # Cycles: the depth of what is nearest, seen through or not.
            layer.pass_alpha_threshold = 0.0
        settings, most = getattr(copy, "cycles", None), copy.eevee.taa_render_samples
        copy.eevee.taa_render_samples = few = min(samples or most, most)
        if settings is None:
            return copy
        instead = copy.render.engine.startswith("BLENDER_EEVEE") and not _has_card()
        if cycles or instead:
            copy.render.engine = "CYCLES"
        if samples or instead:
            settings.samples = few if instead else min(settings.samples, samples)
            settings.use_denoising = False
        if samples == 1:
            settings.device = "CPU"  # whose kernels are there already
        if settings.device == "CPU":  # Cycles looks for Esc between tiles
            tile = settings.tile_size if settings.use_auto_tile else _TILE
            settings.use_auto_tile, settings.tile_size = True, min(tile, _TILE)
        return copy

    def _shown(self, pictures):
        """Linear colours, (3, H, W) each, after the scene's view transform.
        Only Blender knows it, for saved images; each stretch stops it for 0.1 s."""
        tall = np.concatenate(pictures, axis=1)
        rows = max(_PIXELS // tall.shape[2], 1)
        bands = []
        for start in range(0, tall.shape[1], rows):
            yield
            bands.append(self._band_shown(tall[:, start : start + rows]))
        return np.split(np.concatenate(bands, axis=1), len(pictures), axis=1)

    def _band_shown(self, band):
        scene, path = copies.existing(self._any), str(self._folder / "shown.png")
        height, width = band.shape[1:]
        pixels = np.ones((height, width, 4), np.float32)
        pixels[..., :3] = np.moveaxis(band, 0, -1)
        images = [bpy.data.images.new("REFINE", width, height, float_buffer=True)]
        try:
            images[0].pixels.foreach_set(pixels.ravel())
            copies.write_png(scene)
            images[0].save_render(path, scene=scene)
            images.append(bpy.data.images.load(path))
            images[1].colorspace_settings.name = "Non-Color"
            images[1].alpha_mode = "CHANNEL_PACKED"
            images[1].pixels.foreach_get(pixels.ravel())
        finally:
            bpy.data.batch_remove(images)
            copies.write_exr(scene, Path(scene.render.filepath))
        return np.moveaxis(pixels[..., :3], -1, 0)


def _has_card() -> bool:
    """Whether EEVEE has a graphics card; without one it takes minutes."""
    if not bpy.app.background or not sys.platform.startswith("linux"):
        return True
    return Path("/dev/dri").exists() or Path("/dev/nvidia0").exists()


def _lets_through(obj: bpy.types.Object, glass: bool) -> bool:
    """Whether a material may be see-through; with `glass` (Cycles) also glass."""
    trees = {slot.material.node_tree for slot in obj.material_slots if slot.material} - {None}
    return any(_is_clear(node, glass) for tree in trees for node in _nodes(tree))


def _nodes(tree):
    for node in tree.nodes:
        yield node
        if getattr(node, "node_tree", None) is not None:
            yield from _nodes(node.node_tree)


def _is_clear(node: bpy.types.Node, glass: bool) -> bool:
    def between(name: str, opaque: float) -> bool:
        socket = node.inputs.get(name)
        return socket is not None and (socket.is_linked or socket.default_value != opaque)

    if node.type in {"BSDF_TRANSPARENT", "HOLDOUT"}:
        return True
    if node.type == "BSDF_PRINCIPLED":
        return between("Alpha", 1.0) or (glass and between("Transmission Weight", 0.0))
    if node.type == "EEVEE_SPECULAR":
        return between("Transparency", 0.0)
    return glass and node.type in {"BSDF_GLASS", "BSDF_REFRACTION"}


@contextmanager
def out_of_sight(objects: Iterable[bpy.types.Object]) -> Iterator[None]:
    """Hide objects from cameras in the block; shadows and light stay.
    Each is marked until restored: an undo or a file may bring it back hidden."""
    for obj in objects:
        seen_by_rays = obj.type in _BY_RAYS and obj.instance_type == "NONE"
        name = "visible_camera" if seen_by_rays else "hide_render"
        if getattr(obj, name) == seen_by_rays:  # else the scene leaves it out already
            obj[_MARK] = name
            setattr(obj, name, not seen_by_rays)
    try:
        yield
    finally:
        restore()


def restore() -> None:
    """Show all hidden objects again."""
    for obj in bpy.data.objects:
        name = obj.get(_MARK)
        if name is not None:
            setattr(obj, name, name == "visible_camera")
            with suppress(KeyError):
                del obj[_MARK]
