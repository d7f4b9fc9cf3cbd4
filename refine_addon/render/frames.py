"""From a scene to rendered frames: Blender's renders, one after another."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import bpy

from ..core.errors import RefineError
from ..core.execute import Cancelled
from . import meshes
from .engine import REFINE_engine, Shared


def refuse(scene: bpy.types.Scene) -> None:
    """Raise `RefineError` for scenes that cannot be rendered."""
    label = f"scene '{scene.name}'"
    if scene.camera is None:
        raise RefineError(f"{label}: has no camera; add one, or make one the active camera")
    instanced = {obj.instance_collection for obj in bpy.data.objects} - {None}
    members = [member for collection in instanced for member in collection.all_objects]
    if not any(meshes.drawn_by_us(obj) for obj in (*scene.objects, *members)):
        raise RefineError(f"{label}: has no splats to draw; import some, or use Render Image")
    if scene.render.use_multiview:
        raise RefineError(f"{label}: splats are not drawn in stereo; switch off Stereoscopy")


def left_out(scene: bpy.types.Scene) -> list[str]:
    """Sentences on scene settings that a render with splats ignores."""
    render, told = scene.render, []
    asked = {"depth of field": scene.camera.data.dof.use_dof, "motion blur": render.use_motion_blur}
    if blurred := [name for name, is_asked in asked.items() if is_asked]:
        told.append(f"Splats are drawn without {' and '.join(blurred)}")
    new = hasattr(scene, "compositing_node_group")  # since 5.0
    nodes = scene.compositing_node_group if new else scene.use_nodes and scene.node_tree
    if render.use_compositing and nodes:
        told.append("Compositing nodes are left out")
    if sum(layer.use for layer in scene.view_layers) > 1:
        told.append("Of several view layers the first is rendered")
    return told


def steps(
    scene: bpy.types.Scene, frames: Sequence[int], shared: Shared, *, write: bool
) -> Generator[meshes.Step | None, None, None]:
    """Yield Blender's renders for some frames; the caller renders each before the next.
    At None Blender may do other things. Cleans up at the end or when closed. `write`: pictures go
    to the scene's output. `RefineError` if a step failed, `Cancelled` if one was stopped."""
    refuse(scene)
    with _made(shared) as folder:
        others, whole = meshes.Meshes(scene, folder), _whole(scene, "whole")
        shared.engine, shared.renders = others.engine, others.renders + 1
        shared.transparent = scene.render.film_transparent
        movie = write and scene.render.is_movie_format
        kept = not scene.render.use_overwrite, scene.render.use_placeholder
        if movie:  # it is written as one, when all frames are drawn
            written = _whole(scene, "movie")
            meshes.write_exr(meshes.existing(whole), folder / "whole_######")
        for frame in frames:
            if write and not movie and _is_there(whole, frame, *kept):
                continue
            shared.layers = yield from others.layers(frame)
            meshes.set_frames(whole, [frame])
            yield meshes.Step(whole, animation=write, what="splats")
            _check(shared, frame)
            if movie:
                shared.save(folder, frame)
        if movie:
            shared.finished = folder
            meshes.set_frames(written, frames)
            yield meshes.Step(written, animation=True, what="movie")
            _check(shared, frames[-1])


def _whole(scene: bpy.types.Scene, what: str) -> str:
    copy = meshes.copied(scene, what)
    copy.render.engine = REFINE_engine.bl_idname
    copy.render.use_overwrite, copy.render.use_placeholder = True, False  # see `_is_there`
    meshes.show_as_stored(copy)
    return str(copy.name)


def _check(shared: Shared, frame: int) -> None:
    if shared.error is not None or shared.frames[-1:] != [frame]:
        raise shared.error or Cancelled


def _is_there(name: str, frame: int, stays: bool, placeholder: bool) -> bool:
    """Whether a frame's file exists and stays; else make a placeholder if wanted."""
    path = Path(bpy.path.abspath(meshes.existing(name).render.frame_path(frame=frame)))
    there = path.exists()
    if placeholder and not there:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    return stays and there


@contextmanager
def _made(shared: Shared) -> Iterator[Path]:
    """Yield a folder; afterwards remove it, and all else that a render made."""
    folder = Path(tempfile.mkdtemp(prefix="refine-"))
    meshes.remove_all()
    bpy.utils.register_class(REFINE_engine)
    REFINE_engine.shared = shared
    try:
        yield folder
    finally:
        REFINE_engine.shared = None
        meshes.remove_all()
        bpy.utils.unregister_class(REFINE_engine)
        shutil.rmtree(folder, ignore_errors=True)
