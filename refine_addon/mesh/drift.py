"""What others did to splats: Blender moves vertices, and knows nothing of what else makes a splat.

*Apply*, *Join*, a mirror modifier and transforms in edit mode change positions, and leave scales,
rotations and harmonics as they were. So each splat notes where it was when these were written; the
note goes with its vertex wherever Blender takes it, and into the file.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.affine import Move, affine_moves
from ..core.formats.ply_columns import THIRD_SCALE
from . import attributes as mesh_attributes
from . import native
from .layout import sh_degree, unlisted

HOME = "refine_home"
"""Vector on points: where the splat was when its scales, rotation and harmonics were written."""

SHAPE = "refine_shape"
"""Integer on points, by its bits from the lowest: 3, the degree of the object's harmonics then; 13,
a number for the object (a checksum of its positions); 16, a checksum of the splat's scales and
rotation, by which it is seen that somebody changed these too. 0 where nothing was noted."""

_DEGREE, _OBJECT, _ORIGIN, _CHECKSUM = 0x7, 0xFFF8, 0xFFFF, 16
"""Bits of `SHAPE`: degree, object, both, and by how many the checksum is shifted."""

_MIX = np.uint32(0x9E3779B1)
"""An odd number near 2^32 over the golden ratio, as multiplicative hashing takes it."""

_FEW, _FEW_SHARE = 100, 0.01
"""Splats that may have been moved each by itself without a word: so many, or this share of all."""

_SHOWN = 1 << 15
"""Splats that are looked at, evenly spread, for what the panel says."""


@dataclass(frozen=True)
class Drift:
    """What was found that others did to splats.

    Attributes
    ----------
    turned : int
        Splats that were turned, scaled or mirrored without their scales, rotations and harmonics.
    mirrored : bool
        Whether some of them were mirrored.
    sources : int
        Objects that the splats came from; more than one after *Join*.
    regrouped : int
        Splats whose harmonics stand under the names of another degree.
    unlisted : tuple of str
        Properties of joined splats that an export would leave out.
    bent : int
        Splats that were moved each by itself, as by a modifier; 0 for a few, moved by hand.
    strangers : int
        Vertices of which nothing was noted, among others of which it was.
    """

    turned: int
    mirrored: bool
    sources: int
    regrouped: int
    unlisted: tuple[str, ...]
    bent: int
    strangers: int

    @property
    def mendable(self) -> bool:
        """Whether anything can be put right, or has to be taken as it is."""
        return bool(self.turned or self.regrouped or self.unlisted or self.bent)

    def sentences(self) -> list[str]:
        """Return what was done, each in a sentence."""
        told = []
        if self.turned:
            how = "joined" if self.sources > 1 else "mirrored" if self.mirrored else "transformed"
            told.append(
                f"{self.turned:,} splats were {how} without their sizes, rotations and colours, "
                "as Blender's own tools do"
            )
        if self.regrouped:
            told.append(
                f"{self.regrouped:,} splats were joined with others of another SH degree: their "
                "colours are mixed up"
            )
        if self.unlisted:
            names = ", ".join(self.unlisted)
            told.append(f"Joined splats have properties that an export leaves out: {names}")
        if self.bent:
            told.append(
                f"{self.bent:,} splats were moved each by itself, as by a modifier, without their "
                "sizes and rotations: undo that, or Mend Splats takes it as it is"
            )
        if self.strangers:
            told.append(
                f"{self.strangers:,} vertices that are no splats, or of an object never seen here, "
                "were joined: undo that"
            )
        return told


def stamp(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> None:
    """Note of all splats of a mesh that they are as they should be."""
    position = mesh_attributes.read_attribute(mesh, "position")
    mesh_attributes.write_attribute(mesh, HOME, "FLOAT_VECTOR", position)
    number = (zlib.crc32(position.data) << 3 & _OBJECT) or 1 << 3
    codes = _checksums(_shapes(mesh)) << _CHECKSUM | np.uint32(number | sh_degree(mesh))
    mesh_attributes.write_attribute(mesh, SHAPE, "INT", codes.view(np.int32))


def is_stamped(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> bool:
    """Tell whether it was noted of a mesh where its splats were."""
    kinds = {HOME: "FLOAT_VECTOR", SHAPE: "INT"}
    attributes = ((mesh.attributes.get(name), kind) for name, kind in kinds.items())
    return all(a and (a.data_type, a.domain) == (kind, "POINT") for a, kind in attributes)


def found(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> Drift | None:
    """Return what others did to the splats of a mesh, None if nothing, or nothing was noted.

    Quick where nothing was done: 10 ms at a million splats. Else counts are estimated by some.
    """
    if not is_stamped(mesh):
        return None
    notes = _Notes(mesh)
    if notes.undisturbed():
        return None
    step = max(1, len(notes.codes) // _SHOWN)
    return notes.drift(*notes.moves(step), step)


class Mending(NamedTuple):
    """What it takes to have splats follow what others did to them.

    Attributes
    ----------
    moves : list of Move
        By what maps which splats were moved that did not follow, but in their positions.
    regrouped : list of (int, (M,) int64)
        Which splats have their harmonics under the names of which other degree.
    """

    moves: list[Move]
    regrouped: list[tuple[int, NDArray[np.int64]]]


def mending(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> Callable[[], Mending | None]:
    """Read what was noted of a mesh; return what finds out what it takes to mend it.

    That may run on any thread. None comes of it if nothing was found that others did to the mesh.
    """
    if not is_stamped(mesh):
        return lambda: None
    return _Notes(mesh).held().mending


def renew(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> None:
    """Note anew the splats whose scales and rotations were just written, as by merging."""
    if not is_stamped(mesh):
        return
    notes = _Notes(mesh)
    checksums = _checksums(_shapes(mesh))
    rows = notes.codes >> _CHECKSUM != checksums
    notes.home[rows] = notes.position[rows]
    codes = np.where(rows, checksums << _CHECKSUM | notes.codes & _ORIGIN, notes.codes)
    mesh_attributes.write_attribute(mesh, HOME, "FLOAT_VECTOR", notes.home)
    mesh_attributes.write_attribute(mesh, SHAPE, "INT", codes.view(np.int32))


class _Notes:
    """What was noted of a mesh, beside what is."""

    def __init__(self, mesh: bpy.types.Mesh | bpy.types.PointCloud) -> None:
        self.mesh = mesh
        self.home: NDArray[np.float32] = mesh_attributes.read_attribute(mesh, HOME)
        self.position: NDArray[np.float32] = mesh_attributes.read_attribute(mesh, "position")
        self.codes = mesh_attributes.read_attribute(mesh, SHAPE).view(np.uint32)
        self.native, self.degree = native.is_native(mesh), sh_degree(mesh)
        self.unlisted = tuple(unlisted(mesh))
        self._shapes: list[NDArray[np.float32]] | None = None

    def held(self) -> _Notes:
        """Read the rest, so that any thread can go on; return self."""
        self._shapes = _shapes(self.mesh)
        return self

    def mending(self) -> Mending | None:
        """Return what `mending` says."""
        if self.undisturbed():
            return None
        moves, loose = self.moves()
        if self.drift(moves, loose) is None:
            return None
        rows = self.regrouped()
        degrees = self.codes[rows] & _DEGREE
        regrouped = [(int(degree), rows[degrees == degree]) for degree in np.unique(degrees)]
        return Mending(moves, regrouped)

    def undisturbed(self) -> bool:
        """Tell whether all splats are where they were, of one object of that degree."""
        origins = self.codes & _ORIGIN
        return bool(
            np.array_equal(self.home.view(np.uint32), self.position.view(np.uint32))
            and (origins == origins[0]).all()
            and (self.native or origins[0] & _DEGREE == self.degree)
        )

    def drift(self, moves: list[Move], loose: int, step: int = 1) -> Drift | None:
        """Return what `found` does, of what `moves` has found."""
        bent, objects = step * loose, self.objects()
        drift = Drift(
            turned=min(step * sum(len(move.rows) for move in moves), len(self.codes)),
            bent=bent if bent > max(_FEW, _FEW_SHARE * len(self.codes)) else 0,
            mirrored=any(np.linalg.det(move.matrix[:3, :3]) < 0.0 for move in moves),
            sources=len(objects),
            regrouped=len(self.regrouped()),
            unlisted=self.unlisted if len(objects) > 1 else (),
            strangers=int(np.count_nonzero(self.codes == 0)),
        )
        return drift if drift.mendable or drift.strangers else None

    def objects(self) -> list[int]:
        """Return the numbers of the objects that the splats came from."""
        return [int(number) for number in np.unique(self.codes & _OBJECT) if number]

    def moves(self, step: int = 1) -> tuple[list[Move], int]:
        """Return the maps that splats did not follow, and how many were moved each by itself.

        One splat of `step` is looked at.
        """
        rows = np.arange(0, len(self.codes), step)
        codes = self.codes[rows]
        shapes = _shapes(self.mesh) if self._shapes is None else self._shapes
        rows = rows[(codes >> _CHECKSUM == _checksums(shapes, step)) & (codes != 0)]
        moves, loose = [], 0
        for number in self.objects():
            own = rows[self.codes[rows] & _OBJECT == number]
            home, position = self.home[own], self.position[own]
            of_object = affine_moves(home, position)
            finite = np.isfinite(home + position).all(axis=1)
            loose += int(np.count_nonzero(finite)) - sum(len(move.rows) for move in of_object)
            moves += _followed(own, of_object)
        still = np.eye(3)  # or shifted alike
        return [m for m in moves if not np.array_equal(m.matrix[:3, :3], still)], loose

    def regrouped(self) -> NDArray[np.int64]:
        """Return the splats whose harmonics stand under the names of another degree."""
        if self.native:  # names of harmonics do not depend on the degree
            return np.empty(0, np.int64)
        degrees = self.codes & _DEGREE
        other = (self.codes != 0) & (degrees != self.degree) & (degrees != 0)
        return np.flatnonzero(other)


def _followed(rows: NDArray[np.int64], moves: list[Move]) -> list[Move]:
    """Return maps of some rows as maps of the mesh's rows.

    What was moved by itself besides went with most others.
    """
    if not moves:
        return []
    loose = np.ones(len(rows), np.bool_)
    for move in moves:
        loose[move.rows] = False
    most = max(moves, key=lambda move: len(move.rows))
    return [
        Move(rows[np.concatenate([move.rows, np.flatnonzero(loose)])], move.matrix)
        if move is most
        else Move(rows[move.rows], move.matrix)
        for move in moves
    ]


def _shapes(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> list[NDArray[np.float32]]:
    """Return the attributes that hold scales and rotations, (N,) or (N, width) each."""
    names = [*(f"scale_{axis}" for axis in range(3)), *(f"rot_{index}" for index in range(4))]
    if THIRD_SCALE not in mesh.attributes:  # discs
        names.remove(THIRD_SCALE)
    if native.is_native(mesh):
        names = [native.SCALE, native.ROTATION]
    return [mesh_attributes.read_attribute(mesh, name) for name in names]


def _checksums(shapes: Sequence[NDArray[np.float32]], step: int = 1) -> NDArray[np.uint32]:
    """Return a checksum of 16 bits of the scales and the rotation of one splat of `step`."""
    total = np.zeros(len(range(0, len(shapes[0]), step)), np.uint32)
    for values in shapes:
        for plane in values[::step].reshape(len(total), -1).T:
            total ^= np.ascontiguousarray(plane).view(np.uint32)
            total *= _MIX
            total ^= total >> np.uint32(15)
    return total >> np.uint32(_CHECKSUM)
