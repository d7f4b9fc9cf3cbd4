"""The drawn data: splats of meshes, packed once, and their textures."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import bpy
import gpu
import numpy as np
from numpy.typing import NDArray

from ..core.errors import RefineError
from ..core.splats import MODELS
from ..mesh import attributes as mesh_attributes
from ..mesh import edit as mesh_edit
from ..mesh import scores as mesh_scores
from ..mesh import selection as mesh_selection
from ..mesh.edit_mode import readable
from ..mesh.layout import SplatObject, check, sh_degree
from . import shader
from .arrays import MARKS, MOST, Packed, as_texture, first_of_each, most_important_first, pack, same
from .placing import Placing, is_edited


class Marks(NamedTuple):
    """Marks of a mesh's splats, each one value for each splat, or None."""

    ranks: NDArray[Any] | None = None
    going: NDArray[Any] | None = None
    forced: NDArray[Any] | None = None
    selected: NDArray[Any] | None = None
    hidden: NDArray[Any] | None = None


@dataclass(eq=False)
class MeshSplats:
    """The splats of a mesh, its N vertices packed to M drawable ones.
    `signature`: what was packed; `future`, while packing; `read`: marks of the N; `marks`: of the
    M; `important`: (M,), most important first; `scored`, `marked`: counters of changes."""

    signature: tuple[Any, ...] = ()
    future: Future[Packed] | None = None
    packed: Packed | None = None
    read: Marks = field(default_factory=Marks)
    marks: Marks = field(default_factory=Marks)
    important: NDArray[np.int32] | None = None
    degree: int = 0
    scored: int = 0
    marked: int = 0
    kinds: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Slot:
    """Place of an object in the textures: rows ``start`` to ``start + count``."""

    held: MeshSplats
    packed: Packed
    number: int
    start: int
    count: int

    @property
    def rows(self) -> slice:
        """Rows of the textures."""
        return slice(self.start, self.start + self.count)


@dataclass(frozen=True, eq=False)
class Atlas:
    """Splats of several objects in shared textures, so that they blend as one.
    `slots`: by keys of `Placing`. Texels: `means`: place and slot; `covariances`: xx, xy, xz, yy;
    `more_covariances`: yz, zz, model, 0."""

    slots: dict[tuple[int, int], Slot]
    means: gpu.types.GPUTexture | None
    covariances: gpu.types.GPUTexture | None
    more_covariances: gpu.types.GPUTexture | None

    @property
    def rows(self) -> int:
        """Number of splats."""
        return sum(slot.count for slot in self.slots.values())


class Content:
    """Data shared by all views. `pool`: one thread for array work longer than a frame.
    `refused`: meshes that only looked like splats; `changes`, `selections`: counters of changes."""

    def __init__(self) -> None:
        self.pool = ThreadPoolExecutor(1, "refine-view")
        self.atlas = Atlas({}, None, None, None)
        self.changes = self.selections = 0
        self._selection: tuple[object, gpu.types.GPUTexture] | None = None
        self._held: dict[int, MeshSplats] = {}
        self._stale: set[int] = set()
        self.refused: set[int] = set()

    def has_changed(self, mesh: int | None = None) -> None:
        """Look at a mesh again before it is drawn, by default at all."""
        self._stale.update(self._held if mesh is None else [mesh])
        self.refused.difference_update(list(self.refused) if mesh is None else [mesh])

    def marks(self) -> set[int]:
        """The `arrays.MARKS` among drawn splats."""
        return {mark for slot in self.atlas.slots.values() for mark in slot.held.kinds}

    def select(self, mesh: int, chosen: NDArray[np.bool_]) -> None:
        """Show splats of a mesh, (N,), as selected until it changes."""
        held = self._held.get(mesh)
        if held is not None and held.packed is not None and held.signature[0] == len(chosen):
            held.read = held.read._replace(selected=chosen)
            held.marks = held.marks._replace(selected=chosen[held.packed.vertices])
            self.selections += 1

    def selection(self) -> gpu.types.GPUTexture:
        """A texel for each row of the atlas: 1 if selected, else 0."""
        key = (self.atlas, self.selections)
        if self._selection is None or self._selection[0] != key:
            flags = np.zeros(self.atlas.rows, np.float32)
            for slot in self.atlas.slots.values():
                if slot.held.marks.selected is not None:
                    flags[slot.rows] = slot.held.marks.selected[: slot.count]
            self._selection = key, shader.texture(as_texture(flags), 1, "R8")
        return self._selection[1]

    def pending(self) -> bool:
        """Whether splats are being packed."""
        return any(held.future for held in self._held.values())

    def ready(self) -> bool:
        """Whether packed splats wait for a view."""
        return any(held.future and held.future.done() for held in self._held.values())

    def update(
        self, places: Iterable[Placing], existing: Callable[[], set[tuple[int, int]]]
    ) -> dict[tuple[int, int], NDArray[np.float64]]:
        """Prepare splats; (4, 4) world matrices of those ready, by key. In edit mode as last read.
        `existing` gives keys of all splats of the file."""
        for held in self._held.values():  # also of meshes that have gone since it began
            if held.future and held.future.done():
                held.packed, held.future, held.important = held.future.result(), None, None
                self._mark(held)
        wanted = {}
        for key, obj, matrix in places:
            mesh = key[1]
            if mesh in self.refused:
                continue
            if is_edited(obj):
                if mesh not in self._held:
                    continue  # `read_edited` is to come
            elif mesh not in self._held or mesh in self._stale:
                self._stale.discard(mesh)
                try:
                    self._read(check(obj), mesh)
                except RefineError:
                    self.refused.add(mesh)
                    continue
            if self._held[mesh].packed is not None:
                wanted[key] = matrix
        self._place(set(wanted), existing)
        return wanted

    def read_edited(self, obj: bpy.types.Object) -> None:
        """Read an object in edit mode; not while Blender draws, as it updates the mesh."""
        self._stale.discard(obj.data.session_uid)
        with readable(obj) as checked:
            self._read(checked, obj.data.session_uid)

    def _read(self, checked: SplatObject, uid: int) -> None:
        """Read a mesh's changes; `uid` identifies the drawn mesh."""
        mesh = checked.mesh
        held = self._held.setdefault(uid, MeshSplats())
        held.degree = sh_degree(mesh)
        held.read = Marks(
            _attribute(mesh, mesh_scores.RANK, "FLOAT"),
            _attribute(mesh, mesh_edit.REMOVE, "BOOLEAN"),
            _attribute(mesh, mesh_edit.FORCE, "INT"),
            _attribute(mesh, mesh_selection.name_of(mesh), "BOOLEAN"),
            _attribute(mesh, mesh_selection.HIDDEN, "BOOLEAN"),
        )
        signature = (len(checked), held.degree, mesh_attributes.digest(checked))
        if signature != held.signature:
            held.signature = signature
            held.future = self.pool.submit(pack, mesh_attributes.splats_from_object(checked))
        elif held.future is None:
            self._mark(held)

    def _mark(self, held: MeshSplats) -> None:
        packed, before = held.packed, held.marks
        if packed is None:
            return
        held.marks = marks = Marks(
            *(None if values is None else values[packed.vertices] for values in held.read)
        )
        self.selections += not same(before.selected, marks.selected)
        if not same(before.forced, marks.forced):
            held.marked += 1
            held.kinds = tuple(k for k in MARKS if marks.forced is not None and k in marks.forced)
        if not same(before.ranks, marks.ranks):
            held.scored += 1
            held.important = None
        if held.important is None:
            held.important = most_important_first(packed, marks.ranks)
        self.changes += 1

    def _place(
        self, wanted: set[tuple[int, int]], existing: Callable[[], set[tuple[int, int]]]
    ) -> None:
        slots = self.atlas.slots
        fresh = {
            key for key in wanted if key in slots and slots[key].packed is self._held[key[1]].packed
        }
        if fresh == wanted:
            return
        keys = sorted(wanted | (slots.keys() & existing()))
        keys = [key for key in keys if self._held[key[1]].packed is not None]
        meshes = {mesh for _, mesh in keys}
        self._held = {
            mesh: held for mesh, held in self._held.items() if mesh in meshes or held.future
        }
        self.atlas = _atlas(keys, self._held)


def _atlas(keys: list[tuple[int, int]], held: dict[int, MeshSplats]) -> Atlas:
    packs = [held[mesh].packed for _, mesh in keys]
    counts = first_of_each([len(packed) for packed in packs], MOST)
    means = np.empty((sum(counts), 4), np.float32)
    covariances = np.zeros((sum(counts), 8), np.float32)
    slots, start = {}, 0
    for number, (key, packed, count) in enumerate(zip(keys, packs, counts, strict=True)):
        slots[key] = slot = Slot(held[key[1]], packed, number, start, count)
        means[slot.rows, :3], means[slot.rows, 3] = packed.means[:count], number
        covariances[slot.rows, :6] = packed.covariances[:count]
        covariances[slot.rows, 6] = MODELS.index(packed.model)
        start += count
    return Atlas(
        slots,
        shader.texture(as_texture(means), 4, "RGBA32F"),
        shader.texture(as_texture(covariances[:, :4]), 4, "RGBA32F"),
        shader.texture(as_texture(covariances[:, 4:]), 4, "RGBA32F"),
    )


def _attribute(mesh: bpy.types.Mesh, name: str, kind: str) -> NDArray[Any] | None:
    attribute = mesh.attributes.get(name)
    if not attribute or (attribute.data_type, attribute.domain) != (kind, "POINT"):
        return None
    return mesh_attributes.read_attribute(mesh, name)
