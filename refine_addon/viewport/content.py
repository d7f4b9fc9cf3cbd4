"""The drawn data: splats of meshes, packed once, and their textures.
Blender draws the points of a mesh without faces, and has no switch for that. So the evaluated copy
of the object, which files, undo and scripts do not see, gets the display type *Bounds*."""

from __future__ import annotations

from collections.abc import Container, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import bpy
import gpu
import numpy as np
from numpy.typing import NDArray

from ..core import RefineError
from ..mesh import attributes, edit, scores, selection
from ..mesh.layout import SplatObject, check, looks_like_splats, rows_of, sh_degree
from ..objects.instances import Key, Placing, placings
from . import shader
from .arrays import MARKS, Marks, Packed, as_texture, first_of_each, most_important_first, pack

Places = dict[Key, NDArray[np.float64]]  # World matrices of splats, (4, 4)


@dataclass(eq=False)
class MeshSplats:
    """The splats of a mesh, its N vertices packed to M drawable ones. `signature`: of the packed
    values; `future`: while packing; `read`: marks of the N; `marks`: of the M; `important`: (M,),
    most important first; `marked`: counts changes of marks that are drawn in colours; `kinds`:
    `MARKS` among them."""

    signature: tuple[Any, ...] = ()
    future: Future[Packed] | None = None
    packed: Packed | None = None
    read: Marks = field(default_factory=Marks)
    marks: Marks = field(default_factory=Marks)
    important: NDArray[np.int32] | None = None
    marked: int = 0
    kinds: tuple[int, ...] = ()


class Slot(NamedTuple):
    """An object's splats in the textures: `count` in `rows`."""

    held: MeshSplats
    packed: Packed
    number: int
    rows: slice
    count: int


@dataclass(frozen=True, eq=False)
class Atlas:
    """Splats of several objects in shared textures, so that they are sorted and blended together.
    Texels of `textures`: "means": mean and slot number; "covariances": xx, xy, xz, yy;
    "more_covariances": yz, zz, model, 0."""

    slots: dict[Key, Slot]
    textures: dict[str, gpu.types.GPUTexture]
    rows: int  # number of splats


class Content:
    """Data shared by all views. `pool`: a thread for array work that takes longer than a frame.
    `refused`: meshes that looked like splats and are none; `changes`, `selections`: counters."""

    def __init__(self) -> None:
        self.pool = ThreadPoolExecutor(1, "refine-view")
        self.atlas = Atlas({}, {}, 0)
        self.changes = self.selections = 0
        self._untinted = -1  # `selections` at the last `untint`
        self._selection: tuple[object, gpu.types.GPUTexture] | None = None
        self._held: dict[int, MeshSplats] = {}
        self._stale: set[int] = set()
        self.refused: set[int] = set()

    def has_changed(self, mesh: int | None = None) -> None:
        """Read a mesh, or all, again before it is drawn."""
        self._stale.update(self._held if mesh is None else [mesh])
        self.refused.difference_update(list(self.refused) if mesh is None else [mesh])

    def marks(self) -> set[int]:
        """Keys of `arrays.MARKS` that drawn splats have."""
        return {mark for slot in self.atlas.slots.values() for mark in slot.held.kinds}

    def select(self, mesh: int, chosen: NDArray[np.bool_]) -> None:
        """Show splats of a mesh, (N,) bool, as selected until it changes."""
        held = self._held.get(mesh)
        if held is not None and held.packed is not None and held.signature[0] == len(chosen):
            held.read = held.read._replace(selected=chosen)
            held.marks = held.marks._replace(selected=chosen[held.packed.vertices])
            self.selections += 1

    def untint(self) -> None:
        """Show selected splats in their own colours until the selection changes."""
        self.selections += 1
        self._untinted = self.selections

    def selection(self) -> gpu.types.GPUTexture:
        """Texture with a texel for each row of the atlas: 1 if tinted as selected, else 0."""
        key = (self.atlas, self.selections)
        if self._selection is None or self._selection[0] != key:
            flags = np.zeros(self.atlas.rows, np.float32)
            for slot in self.atlas.slots.values() if self.selections != self._untinted else ():
                if slot.held.marks.selected is not None:
                    flags[slot.rows] = slot.held.marks.selected[: slot.count]
            self._selection = key, shader.texture(as_texture(flags), 1, "R8")
        return self._selection[1]

    def pending(self) -> bool:
        """Whether splats are being packed."""
        return any(held.future for held in self._held.values())

    def ready(self) -> bool:
        """Whether splats were packed that no view has drawn yet."""
        return any(held.future and held.future.done() for held in self._held.values())

    def update(self, places: Iterable[Placing]) -> Places:
        """Prepare placed splats; the matrices of those that are ready.
        Splats in edit mode are those of the last `read_edited`."""
        for held in self._held.values():  # of deleted meshes, too
            if held.future and held.future.done():
                held.packed, held.future, held.important = held.future.result(), None, None
                self._mark(held)
        wanted = {}
        for key, obj, matrix, _ in places:
            mesh = key[1]
            if mesh in self.refused:
                continue
            if not is_edited(obj) and (mesh not in self._held or mesh in self._stale):
                self._stale.discard(mesh)
                try:
                    self._read(check(obj), mesh)
                except RefineError:
                    self.refused.add(mesh)
                    continue
            held = self._held.get(mesh)  # none in edit mode until `read_edited`
            if held and held.packed is not None:
                wanted[key] = matrix
        self._place(set(wanted))
        return wanted

    def read_edited(self, obj: bpy.types.Object) -> None:
        """Read an object in edit mode; not while Blender draws, as this updates the mesh."""
        self._stale.discard(obj.data.session_uid)
        with selection.readable(obj) as checked:
            self._read(checked, obj.data.session_uid)

    def _read(self, checked: SplatObject, uid: int) -> None:
        """Read a mesh, and pack it anew if its splats changed; `uid` identifies the drawn mesh."""
        mesh = checked.mesh
        held = self._held.setdefault(uid, MeshSplats())
        held.read = Marks(
            attributes.attribute_if_any(mesh, scores.RANK, "FLOAT"),
            attributes.attribute_if_any(mesh, edit.REMOVE, "BOOLEAN"),
            attributes.attribute_if_any(mesh, edit.FORCE, "INT"),
            attributes.attribute_if_any(mesh, selection.name_of(mesh), "BOOLEAN"),
            attributes.attribute_if_any(mesh, selection.HIDDEN, "BOOLEAN"),
        )
        signature = (len(checked), sh_degree(mesh), attributes.digest(checked))
        if signature != held.signature:
            equal = [one for one in self._held.values() if one.signature == signature]
            if packed := next((one.packed for one in equal if not one.future), None):
                held.packed, held.future, held.important = packed, None, None
            else:
                held.future = self.pool.submit(pack, attributes.splats_from_object(checked))
            held.signature = signature
        if held.future is None:
            self._mark(held)

    def _mark(self, held: MeshSplats) -> None:
        packed, before = held.packed, held.marks
        held.marks = marks = Marks(
            *(None if values is None else values[packed.vertices] for values in held.read)
        )
        # Two `None` are equal for `np.array_equal`, too.
        if not np.array_equal(before.selected, marks.selected):
            self.selections += 1
        if not np.array_equal(before.forced, marks.forced):
            held.marked += 1
            held.kinds = tuple(k for k in MARKS if marks.forced is not None and k in marks.forced)
        if not np.array_equal(before.ranks, marks.ranks):
            held.marked += 1
            held.important = None
        if held.important is None:
            held.important = most_important_first(packed, marks.ranks)
        self.changes += 1

    def _place(self, wanted: set[Key]) -> None:
        """Have these splats in the textures; those that are there stay while the file has them."""
        drawn = {key: slot.packed for key, slot in self.atlas.slots.items()}
        if all(drawn.get(key) is self._held[key[1]].packed for key in wanted):
            return
        splats = filter(looks_like_splats, bpy.data.objects)
        existing = {((obj.session_uid,), obj.data.session_uid) for obj in splats}
        for window in bpy.context.window_manager.windows:  # instances, too
            existing.update(place.key for place in placings(window.view_layer.depsgraph))
        keys = sorted(wanted | (drawn.keys() & existing))
        meshes = {mesh for _, mesh in keys}
        self._held = {
            mesh: held for mesh, held in self._held.items() if mesh in meshes or held.future
        }
        self.atlas = _atlas(keys, self._held)


def _atlas(keys: list[Key], held: dict[int, MeshSplats]) -> Atlas:
    packs = [held[mesh].packed for _, mesh in keys]
    counts = first_of_each([len(packed) for packed in packs])
    means = np.empty((sum(counts), 4), np.float32)
    shapes = np.empty((sum(counts), 8), np.float32)
    slots, each = {}, zip(keys, packs, rows_of(counts), counts, strict=True)
    for number, (key, packed, rows, count) in enumerate(each):
        slots[key] = Slot(held[key[1]], packed, number, rows, count)
        means[rows, :3], means[rows, 3] = packed.means[:count], number
        shapes[rows] = packed.covariances[:count]
    values = {"means": means, "covariances": shapes[:, :4], "more_covariances": shapes[:, 4:]}
    textures = {n: shader.texture(as_texture(v), 4, "RGBA32F") for n, v in values.items()}
    return Atlas(slots, textures, len(means))


def hide_points(depsgraph: bpy.types.Depsgraph | None, refused: Container[int] | None) -> None:
    """Show a view layer's splats as bounding boxes, except `refused` meshes; if None, as points.
    Not if the object whose nodes instance them has faces, which would be hidden, too."""
    if depsgraph is None or depsgraph.mode != "VIEWPORT":
        return
    for place in placings(depsgraph):
        obj = place.obj.original
        evaluated = obj.evaluated_get(depsgraph)
        faces = obj != place.obj and getattr(evaluated.data, "polygons", ())
        hidden = refused is not None and place.key[1] not in refused and not faces
        wanted = "BOUNDS" if hidden and not is_edited(obj) else obj.display_type
        if evaluated.display_type != wanted:
            evaluated.display_type = wanted


def is_edited(obj: bpy.types.Object) -> bool:
    """Whether splats are in edit mode, in this object or another with the same data."""
    return obj.mode == "EDIT" or getattr(obj.data, "is_editmode", False)
