"""Protected splats and those removed by the user, from the scene and the command line."""

from __future__ import annotations

import hashlib
import json
import pickle
from collections.abc import Collection, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import bpy
import numpy as np
from numpy.typing import NDArray

from ..cameras import world_matrix
from ..core import RefineError
from ..core.affine import moved
from ..core.volumes import Box, Forced, MovedVolume, Role, Solid, Sphere, Zone, any_of, forced
from ..mesh import attributes, edit, scores
from ..mesh.layout import Data, SplatObject, recorded, splat_count

RECORD = "refine_forced"  # Custom property: numbers of protected and removed splats, or error, JSON
Masks = dict[str, NDArray[np.bool_] | None]  # Splats of all that are ``protected`` and ``removed``
UNFIT = "expected a mesh, or an empty that is shown as a cube or a sphere"
_MOST_MASKS = 16  # Most cached masks; 1 MB each at a million splats
_masks: dict[bytes, NDArray[np.bool_]] = {}  # Points in each volume, by a digest of both


class Demands(NamedTuple):
    """Protected splats and those removed by the user; `zones`: volumes in the world.
    `names`: protecting vertex groups and attributes, besides `PROTECT` of `mesh.edit`."""

    names: tuple[str, ...] = ()
    zones: tuple[Zone, ...] = ()

    @classmethod
    def of_scene(cls, scene: bpy.types.Scene) -> Demands:
        """The panel's lists, stored in the scene."""
        settings = scene.refine
        zones = (zone(item.role.lower(), item.object, idle=True) for item in listed(scene))
        return cls((settings.protect,) if settings.protect else (), tuple(zones))

    def masks(self, group: Sequence[SplatObject]) -> Masks:
        """Protected and removed splats of some objects."""
        return _as_one(self.of_each(group), group)

    def of_each(self, group: Sequence[SplatObject]) -> list[Forced]:
        """The same for each object. A name protects in the objects that have it, at least one."""
        by_name = [edit.named_masks(group, name) for name in self.names]
        return [self._forced(*each) for each in zip(group, *by_name, strict=True)]

    def _forced(self, checked: SplatObject, *named: NDArray[np.bool_] | None) -> Forced:
        stay = attributes.attribute_if_any(checked.mesh, edit.PROTECT, "BOOLEAN")
        out = attributes.attribute_if_any(checked.mesh, edit.MUST_GO, "BOOLEAN")
        means = world_means(checked) if self.zones else np.empty((0, 3))
        try:
            return forced(self.zones, means, any_of(stay, *named), out)
        except RefineError as error:
            raise RefineError(f"object '{checked.obj.name}': {error}") from error


NONE = Demands()


def _as_one(each: Sequence[Forced], group: Sequence[SplatObject]) -> Masks:
    masks: Masks = {}
    for name in ("protected", "removed"):
        pairs = zip((getattr(one, name) for one in each), group, strict=True)
        parts = [np.zeros(len(obj), np.bool_) if mask is None else mask for mask, obj in pairs]
        whole = np.concatenate(parts)
        masks[name] = whole if whole.any() else None
    return masks


def listed(scene: bpy.types.Scene) -> list[bpy.types.PropertyGroup]:
    """Volumes listed and still in the scene: the list keeps deleted objects alive."""
    return [one for one in scene.refine.volumes if one.object and scene in one.object.users_scene]


def world_means(checked: SplatObject) -> NDArray[np.float64]:
    """Centres of an object's splats in the world, (N, 3)."""
    return moved(attributes.read_attribute(checked.mesh, "position"), world_matrix(checked.obj))


def finite_means(checked: SplatObject) -> NDArray[np.float64]:
    """`world_means` that are finite; `RefineError` if none is."""
    means = world_means(checked)
    means = means[np.isfinite(means).all(axis=1)]
    if not len(means):
        raise RefineError(f"object '{checked.obj.name}': has no splat at a finite place")
    return means


def can_be_volume(obj: bpy.types.Object) -> bool:
    """Whether an object may be a volume, at first sight; splat objects have no faces."""
    if obj.type == "MESH":
        return bool(obj.data.polygons or obj.modifiers)
    return _is_shape(obj)


def zone(role: Role, obj: bpy.types.Object, *, idle: bool = False) -> Zone:
    """An object as a volume in the world: a mesh evaluated with modifiers, an empty as drawn.
    Whether a mesh is closed is checked when it is used."""
    label = f"object '{obj.name}'"
    if obj.type == "MESH":
        local, triangles = _surface(obj)
        make = partial(Solid, moved(local, world_matrix(obj)), triangles)
    elif _is_shape(obj):
        kind, size = obj.empty_display_type, obj.empty_display_size
        ball, box = Sphere((0.0, 0.0, 0.0), size), Box((-size,) * 3, (size,) * 3)
        make = partial(MovedVolume, ball if kind == "SPHERE" else box, world_matrix(obj))
    else:
        what = f"of type {obj.type}"
        if obj.type == "EMPTY":
            what = f"an empty shown as {obj.empty_display_type.replace('_', ' ').lower()}"
        raise RefineError(f"{label}: is {what}, {UNFIT}")
    return Zone(role, label, SimpleNamespace(inside=partial(_inside, label, make)), idle)


def _is_shape(obj: bpy.types.Object) -> bool:
    return obj.type == "EMPTY" and obj.empty_display_type in {"CUBE", "SPHERE"}


def _mark(checked: SplatObject, forced: Forced, reasons: Collection[str]) -> None:
    """Mark protected and removed splats for previews, and record their numbers.
    Without scores `REMOVE` marks removed splats and floaters of these reasons; with scores a plan
    sets it."""
    mesh, removed = checked.mesh, forced.removed
    force = np.zeros(len(checked), np.int32)
    for number, mask in ((2, removed), (1, forced.protected)):
        if mask is not None:
            force[mask] = number
    edit.mark(checked.obj, edit.FORCE, force)
    if scores.record(mesh) is None:
        going, searched = force == 2, scores.floaters(mesh) is not None
        if searched:
            going |= (force != 1) & scores.floater_mask(checked, reasons)
        if searched or removed is not None:
            edit.mark(checked.obj, edit.REMOVE, going)
        else:
            attributes.remove_attribute(mesh, edit.REMOVE)
    if forced.facts or forced.protected is not None or removed is not None:
        volumes = [[fact["name"], fact["splats"]] for fact in forced.facts]
        _store(mesh, {**forced.counts(), "volumes": volumes})
    else:
        mesh.pop(RECORD, None)


def refresh(scene: bpy.types.Scene, group: Sequence[SplatObject]) -> Masks:
    """Mark a scene's demands on each object; protected and removed splats."""
    try:
        each = Demands.of_scene(scene).of_each(group)
        for checked, forced in zip(group, each, strict=True):
            _mark(checked, forced, scene.refine.to_reasons())
    except RefineError as error:
        for checked in group:
            _store(checked.mesh, {"error": str(error)})
        raise
    return _as_one(each, group)


def record(mesh: Data) -> dict[str, Any]:
    """``protected``, ``removed_by_user``, ``volumes`` (splats by label), or ``error``, as marked.
    Empty if splats came or went since."""

    def read(noted: Any) -> dict[str, Any]:
        if noted["splats"] != splat_count(mesh):
            return {}
        if "error" in noted:
            return {"error": str(noted["error"])}
        counts = {name: int(noted[name]) for name in ("protected", "removed_by_user")}
        return {**counts, "volumes": dict(noted["volumes"])}

    return recorded(mesh, RECORD, read) or {}


def _store(mesh: bpy.types.Mesh, counts: dict[str, Any]) -> None:
    mesh[RECORD] = json.dumps({"splats": splat_count(mesh), **counts})


def _surface(obj: bpy.types.Object) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices, (V, 3), and triangles, (T, 3), of a mesh with its modifiers."""
    evaluated = obj.evaluated_get(bpy.context.evaluated_depsgraph_get())
    if obj.modifiers and not evaluated.is_evaluated:
        raise RefineError(
            f"object '{obj.name}': is disabled in viewports or excluded from the view layer, "
            "where Blender applies no modifiers; enable it first"
        )
    try:
        return attributes.read_triangles(evaluated.to_mesh())
    finally:
        evaluated.to_mesh_clear()


def _inside(label: str, make: partial[Any], points: NDArray[Any]) -> NDArray[np.bool_]:
    """Which points lie in a volume. Keeps its last answers: sliders repeat the same questions."""
    digest = hashlib.blake2b(pickle.dumps(make), digest_size=16)
    digest.update(np.ascontiguousarray(points))
    key = digest.digest()
    if key not in _masks:
        try:
            _masks[key] = make().inside(points)
        except RefineError as error:
            raise RefineError(f"{label}: {error}") from error
        if len(_masks) > _MOST_MASKS:
            del _masks[next(iter(_masks))]  # the oldest
    return _masks[key]
