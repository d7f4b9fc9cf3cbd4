"""Sets of cameras: the view sets that a user can choose, and camera files as objects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.errors import RefineError
from ..core.views import View, ViewSet
from ..mesh.layout import LAYOUT
from ..mesh.native import is_native
from .objects import SHEAR, camera_from_view, quarter_turn, view_from_camera, world_matrix

_FEW = 16
"""So many cameras at most are looked at to tell whether all are to be turned."""


@dataclass(frozen=True)
class CameraChoice:
    """Which cameras decide: what the panel and the command name, and a .blend keeps.

    Attributes
    ----------
    source : {"ACTIVE", "SELECTED", "VISIBLE", "COLLECTION", "FRAMES"}
    collection : bpy.types.Collection, optional
        For COLLECTION: its cameras and those of the collections in it, hidden or not.
    frames : range, optional
        For FRAMES.
    """

    source: str
    collection: bpy.types.Collection | None = None
    frames: range = range(0)

    @classmethod
    def of_scene(cls, scene: bpy.types.Scene) -> CameraChoice:
        """Return what is chosen in the panel, as the scene keeps it."""
        settings = scene.refine
        return cls(settings.source, settings.collection, settings.to_frames(scene))

    def cameras(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        """Return the cameras, of any type; of FRAMES all of the scene. Quick enough for drawing."""
        layer = context.view_layer
        if self.source == "ACTIVE":
            objects = [context.scene.camera]
        elif self.source == "COLLECTION":
            objects = self.collection.all_objects if self.collection else []
        else:
            objects = layer.objects
        cameras = [obj for obj in objects if obj and obj.type == "CAMERA"]
        if self.source == "SELECTED":
            return [camera for camera in cameras if camera.select_get(view_layer=layer)]
        if self.source == "VISIBLE":
            return [camera for camera in cameras if camera.visible_get(view_layer=layer)]
        return cameras

    def views(self, context: bpy.types.Context, splats: bpy.types.Object | None = None) -> ViewSet:
        """Return the views of these cameras.

        Parameters
        ----------
        context : bpy.types.Context
        splats : bpy.types.Object, optional
            See `views_from_frames`.

        Raises
        ------
        RefineError
            If there is no such camera; and see `view_from_camera`.
        """
        scene = context.scene
        if self.source == "FRAMES":
            return views_from_frames(context, self.frames, splats)
        if self.source == "COLLECTION" and self.collection is None:
            raise RefineError("no cameras: choose the collection that holds them")
        context.view_layer.update()  # or the list of objects holds gaps where some were removed
        cameras = [_active_camera(scene)] if self.source == "ACTIVE" else self.cameras(context)
        if not cameras:
            where = {"SELECTED": "selected", "VISIBLE": f"visible in scene '{scene.name}'"}
            if self.collection:
                where["COLLECTION"] = f"in collection '{self.collection.name}'"
            raise RefineError(
                f"no cameras: none is {where[self.source]}; scoring needs at least one"
            )
        depsgraph = context.evaluated_depsgraph_get()
        views = tuple(view_from_camera(camera, scene, depsgraph) for camera in cameras)
        return ViewSet(views, turn=_turn(cameras, views, splats, depsgraph))


def known_turn(context: bpy.types.Context, splats: bpy.types.Object) -> int:
    """Return by how many quarters about x the cameras that decide are to be turned.

    Known from how splats and cameras were imported, before anything is scored.

    Parameters
    ----------
    context : bpy.types.Context
        Evaluated: matrices are read as they stand. The choice of cameras is that of its scene.
    splats : bpy.types.Object

    Returns
    -------
    {0, 1, -1}
        See `ViewSet.turn`; 0 where it is not known, or a shot decides.
    """
    choice = CameraChoice.of_scene(context.scene)
    if choice.source == "FRAMES":
        return 0
    cameras = choice.cameras(context)
    cameras = cameras[:: len(cameras) // _FEW + 1]
    depsgraph = context.evaluated_depsgraph_get()
    try:
        views = [view_from_camera(camera, context.scene, depsgraph) for camera in cameras]
        return (_turn(cameras, views, splats, depsgraph) if cameras else None) or 0
    except RefineError:  # which scoring reports
        return 0


def create_cameras(
    views: ViewSet, collection: bpy.types.Collection, *, upright: bool = False
) -> list[bpy.types.Object]:
    """Make a camera object of each view.

    Parameters
    ----------
    views : ViewSet
    collection : bpy.types.Collection
        Where to link them.
    upright : bool
        See `camera_from_view`.

    Returns
    -------
    list of bpy.types.Object
        In the order of the views.
    """
    spread = float(np.sqrt(np.mean(np.var(views.centers, axis=0))))
    cameras = [camera_from_view(view, upright=upright) for view in views]
    for camera in cameras:
        # Small enough to tell neighbours apart; a millimetre at least, to be seen at all.
        camera.data.display_size = min(max(0.1 * spread, 1e-3), 1.0) if len(views) > 1 else 0.25
        collection.objects.link(camera)
    return cameras


def views_from_frames(
    context: bpy.types.Context,
    frames: range,
    splats: bpy.types.Object | None = None,
) -> ViewSet:
    """Return the active camera's view at each frame; an animated shot is a view set.

    Cameras bound to timeline markers take over as they do when the shot is rendered. The frame and
    the active camera are put back.

    Parameters
    ----------
    context : bpy.types.Context
    frames : range
    splats : bpy.types.Object, optional
        Object to be scored: where it moves itself (a turntable), the views move against it, so
        that all see it where it is now.

    Raises
    ------
    RefineError
        If there is no frame, no active camera at one, or the object's scale is animated; and see
        `view_from_camera`.
    """
    scene = context.scene
    if not len(frames):
        raise RefineError(
            f"no frames: the range starts at {frames.start} and ends at {frames.stop - 1}"
        )
    now = world_matrix(splats, context.evaluated_depsgraph_get()) if splats else None
    before = (scene.frame_current, scene.frame_subframe, scene.camera)
    views = []
    try:
        for frame in frames:
            scene.frame_set(frame)
            depsgraph = context.evaluated_depsgraph_get()
            view = view_from_camera(_active_camera(scene), scene, depsgraph)
            if now is not None:
                view = _against(view, splats, now, world_matrix(splats, depsgraph))
            views.append(replace(view, name=f"{view.name}, frame {frame}"))
    finally:
        scene.frame_set(before[0], subframe=before[1])
        scene.camera = before[2]
    return ViewSet(tuple(views))


def _turn(
    cameras: Sequence[bpy.types.Object],
    views: Sequence[View],
    splats: bpy.types.Object | None,
    depsgraph: bpy.types.Depsgraph,
) -> int | None:
    """Return by how many quarters about x cameras are to be turned; see `ViewSet`.

    None where that is not known: unless splats and at least half of the cameras were imported, and
    all of these cameras are turned alike.
    """
    data = None if splats is None else splats.data
    if splats is None or data is None or not (LAYOUT in data or is_native(data)):
        return None
    linear = world_matrix(splats, depsgraph)[:3, :3]
    scale = np.cbrt(np.linalg.det(linear))
    axes = linear / scale if scale else linear
    if np.abs(axes @ axes.T - np.eye(3)).max() > SHEAR:
        return None
    pairs = zip(cameras, views, strict=True)
    turns = [t for camera, view in pairs if (t := quarter_turn(camera, view, axes)) is not None]
    alike = len(set(turns)) == 1 and 2 * len(turns) >= len(cameras)
    return turns[0] if alike else None


def _active_camera(scene: bpy.types.Scene) -> bpy.types.Object:
    if scene.camera is None:
        raise RefineError(
            f"no cameras: scene '{scene.name}' has no active camera at frame "
            f"{scene.frame_current}; set one, or choose other cameras"
        )
    return scene.camera


def _against(
    view: View, obj: bpy.types.Object, now: NDArray[np.float64], then: NDArray[np.float64]
) -> View:
    """Return a view of another frame moved so that it sees the object where that is now."""
    if np.array_equal(now, then):
        return view
    motion = now @ np.linalg.inv(then)
    if np.abs(motion[:3, :3].T @ motion[:3, :3] - np.eye(3)).max() > SHEAR:
        raise RefineError(
            f"object '{obj.name}': its scale is animated; the views of different frames then "
            "see different splats: choose one frame"
        )
    return view.turned(motion[:3, :3], motion[:3, 3])
