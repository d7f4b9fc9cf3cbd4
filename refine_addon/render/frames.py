"""From a scene to rendered frames: which copies are rendered, one after another."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple, TypeVar

import bpy

from ..core.errors import RefineError
from ..core.execute import Cancelled
from . import copies, engine
from .engine import Shared
from .meshes import Meshes, drawn_by_us
from .passes import Rendered

Answer = TypeVar("Answer")

_MOMENT = 0.01
"""Seconds that Blender may stand still."""


class Step(NamedTuple):
    """A render to be done by Blender.

    Attributes
    ----------
    scene : str
        Name of the scene to be rendered.
    animation : bool
        Whether as an animation, which writes files.
    what : str
        What is rendered, in a few words.
    """

    scene: str
    animation: bool
    what: str


def refuse(scene: bpy.types.Scene) -> None:
    """Raise `RefineError` for what cannot be rendered."""
    label = f"scene '{scene.name}'"
    if scene.camera is None:
        raise RefineError(f"{label}: has no camera; add one, or make one the active camera")
    instanced = {obj.instance_collection for obj in bpy.data.objects} - {None}
    members = [member for collection in instanced for member in collection.all_objects]
    if not any(drawn_by_us(obj) for obj in (*scene.objects, *members)):
        raise RefineError(f"{label}: has no splats to draw; import some, or use Render Image")
    if scene.render.use_multiview:
        raise RefineError(f"{label}: splats are not drawn in stereo; switch off Stereoscopy")


def left_out(scene: bpy.types.Scene) -> list[str]:
    """Return what the scene asks for and a render with splats does without, in sentences."""
    render, told = scene.render, []
    blurred = [
        name
        for name, asked in (
            ("depth of field", scene.camera.data.dof.use_dof),
            ("motion blur", render.use_motion_blur),
        )
        if asked
    ]
    if blurred:
        told.append(f"Splats are drawn without {' and '.join(blurred)}")
    if hasattr(scene, "compositing_node_group"):  # since 5.0
        nodes = scene.compositing_node_group
    else:
        nodes = scene.use_nodes and scene.node_tree
    if render.use_compositing and nodes:
        told.append("Compositing nodes are left out")
    if sum(layer.use for layer in scene.view_layers) > 1:
        told.append("Of several view layers the first is rendered")
    return told


def steps(
    scene: bpy.types.Scene, frames: Sequence[int], shared: Shared, *, write: bool
) -> Generator[Step | None, None, None]:
    """Yield what Blender has to render for some frames, one after another.

    Whoever renders them asks for the next when one is over. Where None is yielded there is nothing
    to render, and Blender may do something else meanwhile. All that is made for them is removed
    when the last is over, or the generator is closed.

    Parameters
    ----------
    scene : bpy.types.Scene
        Is not changed.
    frames : sequence of int
    shared : Shared
        What becomes known of the render.
    write : bool
        Whether pictures are written where the scene's output settings say.

    Raises
    ------
    RefineError
        See `refuse`; also if a step has failed.
    Cancelled
        If a step was stopped.
    """
    refuse(scene)
    with _made(shared) as folder:
        meshes = Meshes(scene, folder)
        whole = _whole(scene, "REFINE whole")
        shared.engine, shared.transparent = meshes.engine, scene.render.film_transparent
        movie = write and scene.render.is_movie_format
        kept = not scene.render.use_overwrite, scene.render.use_placeholder
        if movie:  # it is written as one, when all frames are drawn
            written = _whole(scene, "REFINE movie")
            copies.write_exr(_scene(whole), folder / "whole_######")
        for frame in frames:
            if write and not movie and _is_there(whole, frame, *kept):
                continue
            rendered = yield from _one_by_one(meshes, frame)
            light = yield from _on_thread(rendered.read)
            shown = yield from meshes.shown(light.pictures)
            shared.layers = partial(light.layers, shown)
            _set_frames(whole, [frame])
            yield Step(whole, animation=write, what="splats")
            _check(shared, frame)
            if movie and shared.picture is not None:
                engine.save(folder, frame, shared.picture)
        if movie:
            shared.finished = folder
            _set_frames(written, frames)
            yield Step(written, animation=True, what="movie")
            _check(shared, frames[-1])


def _one_by_one(meshes: Meshes, frame: int) -> Generator[Step, None, Rendered]:
    """Yield what has to be rendered besides splats; return what was."""
    names = meshes.steps(frame)
    try:
        while True:
            name = next(names)
            _set_frames(name, [frame])
            yield Step(name, animation=True, what="meshes")
    except StopIteration as end:
        rendered: Rendered = end.value
        return rendered
    finally:
        names.close()


def _on_thread(work: Callable[[], Answer]) -> Generator[None, None, Answer]:
    """Return what work returns that touches nothing of Blender's; yield until it is done."""
    with ThreadPoolExecutor(1, "refine-render") as pool:
        future = pool.submit(work)
        while not wait([future], _MOMENT).done:
            yield
        return future.result()


def _whole(scene: bpy.types.Scene, name: str) -> str:
    """Make a copy that our engine renders."""
    copy = copies.copied(scene, name)
    copy.render.engine = engine.REFINE_engine.bl_idname
    copy.render.use_overwrite, copy.render.use_placeholder = True, False  # see `_is_there`
    copies.show_as_stored(copy)
    return str(copy.name)


def _check(shared: Shared, frame: int) -> None:
    """Raise why a frame was not drawn, if it was not."""
    if shared.error is not None:
        raise shared.error
    if shared.frames[-1:] != [frame]:
        raise Cancelled


def _is_there(name: str, frame: int, stays: bool, placeholder: bool) -> bool:
    """Tell whether the file of a frame is there and stays; else make one in its place if wanted."""
    path = Path(bpy.path.abspath(_scene(name).render.frame_path(frame=frame)))
    if stays and path.exists():
        return True
    if placeholder and not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return False


def _set_frames(name: str, frames: Sequence[int]) -> None:
    scene = _scene(name)
    scene.frame_start, scene.frame_end = frames[0], frames[-1]
    scene.frame_step = frames[1] - frames[0] if frames[1:] else 1
    if scene.frame_current != frames[0]:
        scene.frame_set(frames[0])


def _scene(name: str) -> bpy.types.Scene:
    """Return a copy, which an undo may have removed."""
    scene = bpy.data.scenes.get(name)
    if scene is None:
        raise Cancelled
    return scene


@contextmanager
def _made(shared: Shared) -> Iterator[Path]:
    """Yield a folder; afterwards remove it, and all else that a render made."""
    folder = Path(tempfile.mkdtemp(prefix="refine-"))
    copies.remove_all()
    bpy.utils.register_class(engine.REFINE_engine)
    engine.begin(shared)
    try:
        yield folder
    finally:
        engine.end()
        copies.remove_all()
        bpy.utils.unregister_class(engine.REFINE_engine)
        shutil.rmtree(folder, ignore_errors=True)
