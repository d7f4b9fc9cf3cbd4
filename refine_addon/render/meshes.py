"""What is not splats: rendered by the scene's own engine, with the depth of each pixel."""

from __future__ import annotations

import sys
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import bpy
import numpy as np

from ..core.drawing import Layers, in_order
from ..core.exr import read_exr
from ..mesh import native
from ..mesh.layout import looks_like_splats
from . import copies, see_through
from .out_of_sight import out_of_sight

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


class _Apart(NamedTuple):
    """Objects that are rendered together.

    Attributes
    ----------
    others : list of bpy.types.Object
        Those that are left out.
    blended : bool
        Whether the engine tells no depth of them.
    """

    others: list[bpy.types.Object]
    blended: bool = False


class _Pass(NamedTuple):
    """What was rendered of them: colours times alpha, alphas, depths."""

    colors: NDArray[np.float32]
    alphas: NDArray[np.float32]
    depths: NDArray[np.float32]


def _divided(scene: bpy.types.Scene, objects: list[bpy.types.Object]) -> list[_Apart]:
    """Return which objects of a copy are rendered together, the opaque ones last."""
    eevee = scene.render.engine.startswith("BLENDER_EEVEE")
    glass = not eevee and scene.cycles.film_transparent_glass
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
        self._meshes = self._world = ""  # names of copies
        self._hidden: list[bpy.types.Object] = []
        self._apart: list[_Apart] = [_Apart([])]
        self._found: list[_Pass] = []
        self._behind: NDArray[np.float32] | None = None
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

    def steps(self, frame: int) -> Iterator[str]:
        """Give the names of the scenes to be rendered for a frame, one after another.

        The next is asked for when one is rendered.
        """
        self._found, self._behind = [], None
        for part in self._apart if self._meshes else ():
            with out_of_sight([*self._hidden, *part.others]):
                yield self._meshes
                passes = self._passes(self._meshes, frame)
                if part.blended:
                    with self._solid():
                        yield self._meshes
                        passes["Depth"] = self._passes(self._meshes, frame)["Depth"]
            self._found.append(self._pass(passes))
        if self._world:
            yield self._world
            self._behind = self._passes(self._world, frame)["Combined"][:3]

    def layers(self) -> Layers | None:
        """Return what was rendered for the last frame, None if there is nothing to render."""
        name, world = self._meshes or self._world, self._behind
        if not self._found:
            if world is None:
                return None
            (background,) = self._shown(name, [world])
            nothing = np.zeros((1, *background.shape[1:]), np.float32)
            return Layers(np.zeros_like(background)[None], nothing, nothing, background)
        as_light = in_order(self._found)
        over, left = as_light.over_nothing(), as_light.left()[-1]
        if world is None:
            over /= np.maximum(1.0 - left, 1e-6)
        else:
            over += left * world  # as without splats
        opaque = [each.colors / np.maximum(each.alphas, 1e-6) for each in self._found]
        shown = self._shown(name, [*opaque, over.astype(np.float32)])
        whole = shown.pop()
        pairs = zip(shown, self._found, strict=True)
        layers = in_order([each._replace(colors=each.alphas * colors) for colors, each in pairs])
        if world is None and len(self._found) == 1:
            return layers
        if world is None:
            return replace(layers, background=whole * (1.0 - left) - layers.over_nothing())
        return replace(layers, background=whole - layers.over_nothing())

    @contextmanager
    def _solid(self) -> Iterator[None]:
        """Render all in one opaque material and with one sample: its depth is what counts."""
        scene = bpy.data.scenes[self._meshes]
        samples, material = scene.eevee.taa_render_samples, bpy.data.materials.new(scene.name)
        material[copies.MARK] = True
        scene.eevee.taa_render_samples = 1
        for layer in scene.view_layers:
            layer.material_override = material
        try:
            yield
        finally:
            bpy.data.materials.remove(material)
            scene.eevee.taa_render_samples = samples

    def _pass(self, passes: dict[str, NDArray[np.float32]]) -> _Pass:
        """Return what was rendered in one step."""
        colors, alphas = passes["Combined"][:3], passes["Combined"][3].clip(0.0, 1.0)
        camera = bpy.data.scenes[self._meshes].camera.data
        return _Pass(colors, alphas, _known(passes["Depth"][0], alphas, camera))

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
