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

_FEW = 16  # Cameras looked at, at most, to tell whether all are to be turned


@dataclass(frozen=True)
class CameraChoice:
    """The cameras that decide, as panel and command name them and a .blend keeps them.
    COLLECTION uses `collection` with its children, hidden or not; FRAMES uses `frames`."""

    source: str
    collection: bpy.types.Collection | None = None
    frames: range = range(0)

    @classmethod
    def of_scene(cls, scene: bpy.types.Scene) -> CameraChoice:
        """The panel's choice, stored in the scene."""
        settings = scene.refine
        return cls(settings.source, settings.collection, settings.to_frames(scene))

    def cameras(self, context: bpy.types.Context) -> list[bpy.types.Object]:
        """The cameras, of any type; for FRAMES all of the scene. Quick enough to draw."""
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
        """Views of these cameras, one at least; `splats` as in `views_from_frames`."""
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
    """Quarters about x that deciding cameras must turn (`ViewSet.turn`); 0 if unknown or a shot.
    Known from how splats and cameras were imported; the context must be evaluated."""
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
    """A camera object for each view, in order, linked to `collection`; see `camera_from_view`."""
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
    """Views of the active camera at each frame; markers switch cameras as in a render.
    Where `splats` moves (a turntable), views move against it. Frame and active camera are put back.
    `RefineError` without frames or a camera, or if the object's scale is animated."""
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
    """Quarters about x that these cameras need; None if unknown: unless splats and at least half of
    the cameras were imported, and all are turned alike."""
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
    """A view of another frame, moved to see the object where it stands now."""
    if np.array_equal(now, then):
        return view
    motion = now @ np.linalg.inv(then)
    if np.abs(motion[:3, :3].T @ motion[:3, :3] - np.eye(3)).max() > SHEAR:
        raise RefineError(
            f"object '{obj.name}': its scale is animated; the views of different frames then "
            "see different splats: choose one frame"
        )
    return view.turned(motion[:3, :3], motion[:3, 3])
