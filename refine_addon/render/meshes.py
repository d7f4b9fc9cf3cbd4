"""All but splats: rendered with depths by the scene's own engine, in copies of the scene, whose
settings so stay untouched; and the rendered passes, read from files and made layers.
Layers blend as splats do, in display-referred colours, so after Blender's view transform."""

from __future__ import annotations

import sys
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import bpy
import numpy as np
from numpy.typing import NDArray

from .. import main_thread
from ..cameras import active_camera
from ..core.execute import Cancelled, chunks
from ..core.images import read_exr
from ..core.pictures import Layers, in_order
from ..mesh import layout

COPY_OF = "refine_render"  # Custom property of a copy: its original scene

_HIDDEN_BY = "refine_out_of_sight"
"""Custom property of a hidden object: the name of the property that hides it."""

_BY_RAYS = {"MESH", "CURVE", "SURFACE", "FONT", "META", "VOLUME", "CURVES"}
"""Types that can be hidden from cameras; EEVEE ignores that for instances."""

_RENDERED = _BY_RAYS | {"POINTCLOUD", "GREASEPENCIL", "GPENCIL", "EMPTY"}
"""Types that are rendered; an empty may stand for a collection."""

_TILE = 128  # Largest side of a tile that Cycles renders on the processor, pixels
_WORLD_SAMPLES = 16  # Samples for a pixel of the world, at most
_FARTHEST = 0.999  # Share of the clip end from which on depths mean nothing (EEVEE of 4.3)
_INFINITE = 1e9  # Depth from which on depths mean nothing: Cycles stores 1e10
_PIXELS = 1 << 18  # Pixels for each call of the view transform
_ROUNDS = 2  # Pixels by which depths spread into edges without one
_MOMENT = 0.01  # Seconds to wait for the thread before Blender may do other things


class Step(NamedTuple):
    """A render for Blender: name of its scene, whether it is an animation (these write files), and
    a label for the progress."""

    scene: str
    animation: bool
    what: str


Steps = Generator[Step | None, None, Callable[[], Layers] | None]


def drawn_by_us(obj: bpy.types.Object) -> bool:
    """Whether an object holds splats that Blender does not draw as such."""
    return layout.looks_like_splats(obj) and not (
        obj.type == "POINTCLOUD" and getattr(obj.data, "type", "") == layout.NATIVE
    )


class Meshes:
    """A scene without its splats, rendered frame by frame into files in `folder`.
    See-through objects are rendered apart, so that splats show behind them. `engine`: the renderer,
    "" if there is nothing to render; `renders`: Blender's renders for each frame."""

    def __init__(self, scene: bpy.types.Scene, folder: Path) -> None:
        self._folder = folder
        self._meshes = self._depths = self._world = ""  # names of copies
        layer = next((layer for layer in scene.view_layers if layer.use), scene.view_layers[0])
        objects = [obj for obj in layer.objects if obj.type in _RENDERED and not obj.hide_render]
        shown = [obj for obj in objects if not drawn_by_us(obj)]
        # Blender renders the points of point clouds as balls.
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
                # EEVEE gives no depth of see-through surfaces.
                self._depths = self._copy(scene, "depths", cycles=True, samples=1).name
        if not scene.render.film_transparent and scene.world is not None:
            # Without other objects by Cycles, which starts faster and needs no graphics card.
            world = self._copy(scene, "world", cycles=not shown, samples=_WORLD_SAMPLES)
            world.render.film_transparent, self._world = False, world.name
            for linked in (world.collection.children, world.collection.objects):
                for item in [*linked]:
                    linked.unlink(item)
        renders = (self._clear, self._opaque, self._depths, self._world)
        self.renders, self._any = sum(map(bool, renders)), self._meshes or self._world
        self.engine = bpy.data.scenes[self._any].render.engine if self._any else ""

    def layers(self, frame: int) -> Steps:
        """Yield a frame's renders, or None where Blender may do other things. Returns a thread-safe
        function that gives the frame's layers, None if there are none."""
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
        far = min(_FARTHEST * active_camera(existing(self._any)).data.clip_end, _INFINITE)
        with ThreadPoolExecutor(1, "refine-render") as pool:
            future = pool.submit(_layers_of, files, world, far)
            while not wait([future], _MOMENT).done:
                yield None
        pictures, blended = future.result()
        return partial(blended, (yield from self._shown(pictures)))

    def _rendered(self, name, frame, label):
        """Render a frame of a copy; path of the file, renamed.
        `Cancelled` if there is none: after Esc Blender writes no file."""
        set_frames(name, [frame])
        yield Step(name, animation=True, what="meshes")
        try:
            written = Path(bpy.data.scenes[name].render.frame_path(frame=frame))
            return written.replace(self._folder / f"{label}.exr")
        except FileNotFoundError:
            raise Cancelled from None

    def _copy(self, scene, what, *, cycles=False, samples=0):
        """Make a copy that writes EXR files, by Cycles if `cycles` or if EEVEE has no card, with at
        most `samples` if not 0."""
        copy = copied(scene, what)
        write_exr(copy, self._folder / f"{what}_######")
        copy.render.film_transparent = True
        for layer in copy.view_layers:
            layer.use_pass_combined = layer.use_pass_z = True
            # Cycles: depths of the nearest surface, however see-through.
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
            settings.device = "CPU"  # whose kernels need no compiling
        if settings.device == "CPU":  # Cycles looks for Esc between tiles
            tile = settings.tile_size if settings.use_auto_tile else _TILE
            settings.use_auto_tile, settings.tile_size = True, min(tile, _TILE)
        return copy

    def _shown(self, pictures):
        """Linear colours, (3, H, W) each, after the scene's view transform.
        Blender applies it only where it saves an image. Each band of rows takes it 0.1 s."""
        tall = np.concatenate(pictures, axis=1)
        for band in chunks(tall.shape[1], max(_PIXELS // tall.shape[2], 1)):
            yield
            tall[:, band] = self._band_shown(tall[:, band])
        return np.split(tall, len(pictures), axis=1)

    def _band_shown(self, band):
        """A band, (3, h, W), after the view transform: by a 16-bit PNG, as fast as possible."""
        scene, path = existing(self._any), self._folder / "shown.png"
        settings = scene.render.image_settings
        height, width = band.shape[1:]
        pixels = np.ones((height, width, 4), np.float32)
        pixels[..., :3] = np.moveaxis(band, 0, -1)
        image = bpy.data.images.new("REFINE", width, height, float_buffer=True)
        try:
            image.pixels.foreach_set(pixels.ravel())
            _set_format(settings, "IMAGE", "PNG")
            settings.color_mode, settings.color_depth, settings.compression = "RGB", "16", 0
            image.save_render(str(path), scene=scene)
        finally:
            bpy.data.images.remove(image)
            write_exr(scene, Path(scene.render.filepath))
        return np.moveaxis(main_thread.stored(path)[..., :3], -1, 0)


def _has_card() -> bool:
    """Whether there is a graphics card for EEVEE, which takes minutes without."""
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
    def differs(name: str, opaque: float) -> bool:
        socket = node.inputs.get(name)
        return socket is not None and (socket.is_linked or socket.default_value != opaque)

    if node.type in {"BSDF_TRANSPARENT", "HOLDOUT"}:
        return True
    if node.type == "BSDF_PRINCIPLED":
        return differs("Alpha", 1.0) or (glass and differs("Transmission Weight", 0.0))
    if node.type == "EEVEE_SPECULAR":
        return differs("Transparency", 0.0)
    return glass and node.type in {"BSDF_GLASS", "BSDF_REFRACTION"}


@contextmanager
def out_of_sight(objects: Iterable[bpy.types.Object]) -> Iterator[None]:
    """Hide objects from cameras in the block; shadows and light stay.
    Hidden objects are marked, so that `restore` finds those that an undo or a file brings back."""
    for obj in objects:
        seen_by_rays = obj.type in _BY_RAYS and obj.instance_type == "NONE"
        name = "visible_camera" if seen_by_rays else "hide_render"
        if getattr(obj, name) == seen_by_rays:  # else it is hidden already
            obj[_HIDDEN_BY] = name
            setattr(obj, name, not seen_by_rays)
    try:
        yield
    finally:
        restore()


def restore() -> None:
    """Show again all objects that `out_of_sight` hid."""
    for obj in bpy.data.objects:
        name = obj.get(_HIDDEN_BY)
        if name is not None:
            setattr(obj, name, name == "visible_camera")
            with suppress(KeyError):
                del obj[_HIDDEN_BY]


def copied(scene: bpy.types.Scene, what: str) -> bpy.types.Scene:
    """Copy of a scene with one view layer rendered, without compositor and sequencer.
    Its name begins with a dot, which hides it in menus."""
    copy = scene.copy()
    copy.name = f".REFINE {what}"
    copy[COPY_OF] = scene
    render = copy.render
    render.use_compositing = render.use_sequencer = render.use_multiview = False
    rendered = next((layer for layer in copy.view_layers if layer.use), copy.view_layers[0])
    for layer in copy.view_layers:
        layer.use = layer == rendered
    return copy


def existing(name: str) -> bpy.types.Scene:
    """Copy of a scene by its name; `Cancelled` if an undo has removed it."""
    scene = bpy.data.scenes.get(name)
    if scene is None:
        raise Cancelled
    return scene


def set_frames(name: str, frames: Sequence[int]) -> None:
    """Make a copied scene render evenly spaced frames, and go to the first."""
    scene = existing(name)
    scene.frame_start, scene.frame_end = frames[0], frames[-1]
    scene.frame_step = frames[1] - frames[0] if frames[1:] else 1
    if scene.frame_current != frames[0]:
        scene.frame_set(frames[0])


def remove_all() -> None:
    """Remove all copied scenes; windows that show one show the original again."""
    for window in bpy.context.window_manager.windows:
        if COPY_OF in window.scene:
            window.scene = window.scene[COPY_OF]
    copies = [scene for scene in bpy.data.scenes if COPY_OF in scene]
    if bpy.context.window is None:  # as in a command: `remove` of 4.3 crashes without a window
        bpy.data.batch_remove(copies)
        copies = []
    for scene in copies:
        bpy.data.scenes.remove(scene)


def write_exr(scene: bpy.types.Scene, path: Path) -> None:
    """Make a copied scene write images with all passes, as `core.images` reads them."""
    render, settings = scene.render, scene.render.image_settings
    _set_format(settings, "MULTI_LAYER_IMAGE", "OPEN_EXR_MULTILAYER")
    settings.color_depth, settings.exr_codec = "32", "NONE"
    if hasattr(settings, "use_exr_interleave"):  # since 5.0
        settings.use_exr_interleave = True
    render.filepath = str(path)
    render.use_file_extension = render.use_overwrite = True
    render.use_placeholder = render.use_stamp = False
    render.use_crop_to_border = True


def _set_format(settings: bpy.types.ImageFormatSettings, media_type: str, file_format: str) -> None:
    if hasattr(settings, "media_type"):  # since 5.0
        settings.media_type = media_type
    settings.file_format = file_format
    settings.color_management = "FOLLOW_SCENE"


class Pass(NamedTuple):
    """One render: colours times alpha, (3, H, W), alphas and depths, (H, W)."""

    colors: NDArray[np.float32]
    alphas: NDArray[np.float32]
    depths: NDArray[np.float32]


def _layers_of(files, world, far):
    """Read and remove files: of each pass those with colours and with depths, and of the world.
    Gives the pictures, (3, H, W) float32, for the view transform, of each pass as if opaque and of
    all blended, and a callable that makes layers of the transformed ones. Depths from `far` on
    count as empty."""
    passes = []
    for colors, depths in files:
        one = _read(colors)
        away = one.depths if depths == colors else _read(depths).depths
        passes.append(one._replace(depths=_filled(away, one.alphas, far)))
    sky = _read(world).colors if world else None
    nothing = np.zeros_like(passes[0].colors if passes else sky)
    seen = [each for each in passes if each.alphas.any()]
    passes = seen or [Pass(nothing, nothing[0], nothing[0])]
    stacked = in_order(passes)
    over, left = stacked.over_nothing(), stacked.left()[-1]
    share = np.ones_like(left) if world else 1.0 - left
    over = over + left * sky if world else over / np.maximum(share, 1e-6)

    def layers(shown: Sequence[NDArray[np.float32]]) -> Layers:
        """Layers that without splats give Blender's picture, by a correction in the background."""
        pairs = zip(seen, shown, strict=False)
        opaque = [each._replace(colors=each.alphas * colors) for each, colors in pairs]
        layers = in_order(opaque or passes)
        return replace(layers, background=share * shown[-1] - layers.over_nothing())

    straight = [each.colors / np.maximum(each.alphas, 1e-6) for each in seen]
    return [*straight, over.astype(np.float32)], layers


def _read(path: Path) -> Pass:
    channels = {name.split(".", 1)[-1]: values for name, values in read_exr(path).items()}
    path.unlink()
    colors = np.stack([channels[f"Combined.{letter}"] for letter in "RGB"])
    depths = channels["Depth.Z"] if "Depth.Z" in channels else channels["Depth.V"]
    return Pass(colors, channels["Combined.A"].clip(0.0, 1.0), depths)


def _filled(depths, alphas, far):
    """Depth of each pixel, (H, W), 0 where empty.
    An engine's depth is of one ray, which may miss what the pixel shows: such edges take the
    nearest depth around, or without any 0, which is in front of all splats."""
    filled = np.where(depths >= far, np.float32(np.inf), depths)
    for _ in range(_ROUNDS):
        padded = np.pad(filled, 1, constant_values=np.inf)
        around = np.lib.stride_tricks.sliding_window_view(padded, (3, 3)).min(axis=(2, 3))
        filled = np.where(np.isinf(filled), around, filled)
    return np.where(np.isinf(filled) | (alphas <= 0.0), np.float32(0.0), filled)
