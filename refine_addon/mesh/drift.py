"""What others did to splats: Blender moves vertices, and knows nothing of what else makes a splat.

*Apply*, *Join*, a mirror modifier and transforms in edit mode change positions, and leave scales,
rotations and harmonics as they were. So each splat notes where it was when these were written; the
note goes with its vertex wherever Blender takes it, and into the file.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from typing import NamedTuple

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core.affine import Move, affine_moves
from ..core.formats.ply_columns import THIRD_SCALE
from . import attributes as mesh_attributes
from . import native
from .layout import sh_degree

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


class Drift(NamedTuple):
    """What was found that others did to splats: sentences, and whether Mend Splats is of use."""

    told: list[str]
    mendable: bool


class Mending(NamedTuple):
    """What it takes to have splats follow what others did to them.

    Attributes
    ----------
    moves : list of Move
        By what maps which splats were moved that did not follow, but in their positions.
    regrouped : (N,) int
        Of each splat whose harmonics stand under the names of another degree, that degree; else 0.
    """

    moves: list[Move]
    regrouped: NDArray[np.int64]


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
    """What others did to the splats of a mesh, None if nothing, or nothing was noted.

    Quick where nothing was done: 10 ms at a million splats. Else counts are estimated by some.
    """
    if not is_stamped(mesh) or (notes := _Notes(mesh)).undisturbed:
        return None
    moves, looked, loose = notes.moves(max(1, len(notes.codes) // _SHOWN))
    share = len(notes.codes) / max(looked, 1)
    turned, bent = (round(share * n) for n in (sum(len(move.rows) for move in moves), loose))
    strangers = int(np.count_nonzero(notes.codes == 0))
    regrouped = int(np.count_nonzero(notes.regrouped()))
    told = []
    if turned:
        mirrored = any(np.linalg.det(move.matrix[:3, :3]) < 0.0 for move in moves)
        joined = len(notes.objects()) > 1
        how = "joined" if joined else "mirrored" if mirrored else "transformed"
        told.append(
            f"{turned:,} splats were {how} without their sizes, rotations and colours, "
            "as Blender's own tools do"
        )
    if regrouped:
        told.append(
            f"{regrouped:,} splats were joined with others of another SH degree: their "
            "colours are mixed up"
        )
    if bent > max(_FEW, _FEW_SHARE * len(notes.codes)):
        told.append(
            f"{bent:,} splats were moved each by itself, as by a modifier, without their "
            "sizes and rotations: undo that, or Mend Splats takes it as it is"
        )
    mendable = bool(told)
    if strangers:
        told.append(
            f"{strangers:,} vertices that are no splats, or of an object never seen here, "
            "were joined: undo that"
        )
    return Drift(told, mendable) if told else None


def mending(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> Callable[[], Mending] | None:
    """Read what was noted of a mesh; what finds out on any thread what it takes to mend it.

    None where nothing was done to it.
    """
    if not is_stamped(mesh) or (notes := _Notes(mesh)).undisturbed:
        return None
    return lambda: Mending(notes.moves()[0], notes.regrouped())


def renew(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> None:
    """Note anew the splats whose scales and rotations were just written, as by merging."""
    if not is_stamped(mesh):
        return
    notes, checksums = _Notes(mesh), _checksums(_shapes(mesh))
    rows = notes.codes >> _CHECKSUM != checksums
    notes.home[rows] = notes.position[rows]
    codes = np.where(rows, checksums << _CHECKSUM | notes.codes & _ORIGIN, notes.codes)
    mesh_attributes.write_attribute(mesh, HOME, "FLOAT_VECTOR", notes.home)
    mesh_attributes.write_attribute(mesh, SHAPE, "INT", codes.view(np.int32))


class _Notes:
    """What was noted of a mesh, beside what is, for any thread."""

    def __init__(self, mesh: bpy.types.Mesh | bpy.types.PointCloud) -> None:
        self.home, self.position, codes = (
            mesh_attributes.read_attribute(mesh, name) for name in (HOME, "position", SHAPE)
        )
        self.codes = codes.view(np.uint32)
        # Names of harmonics in Blender's own splats do not depend on the degree.
        self.degree = None if native.is_native(mesh) else sh_degree(mesh)
        origins = self.codes & _ORIGIN
        self.undisturbed = bool(
            np.array_equal(self.home.view(np.uint32), self.position.view(np.uint32))
            and (origins == origins[0]).all()
            and self.degree in (None, origins[0] & _DEGREE)
        )
        self.shapes = [] if self.undisturbed else _shapes(mesh)

    def objects(self) -> list[int]:
        """The numbers of the objects that the splats came from."""
        return [int(number) for number in np.unique(self.codes & _OBJECT) if number]

    def moves(self, step: int = 1) -> tuple[list[Move], int, int]:
        """The maps that splats did not follow; how many were looked at, and moved by themselves.

        One splat of `step` is looked at. What was moved by itself goes with most of its object.
        """
        rows = np.arange(0, len(self.codes), step)
        looked, codes = len(rows), self.codes[rows]
        rows = rows[(codes >> _CHECKSUM == _checksums(self.shapes, step)) & (codes != 0)]
        found, lost = [], 0
        for number in self.objects():
            own = rows[self.codes[rows] & _OBJECT == number]
            home, position = self.home[own], self.position[own]
            moves = affine_moves(home, position)
            finite = np.isfinite(home + position).all(axis=1)
            lost += int(np.count_nonzero(finite)) - sum(len(move.rows) for move in moves)
            most = np.argmax([len(move.rows) for move in moves]) if moves else 0
            labels = np.full(len(own), most)
            for label, move in enumerate(moves):
                labels[move.rows] = label
            found += [Move(own[labels == label], m.matrix) for label, m in enumerate(moves)]
        still = np.eye(3)  # or shifted alike
        return [m for m in found if not np.array_equal(m.matrix[:3, :3], still)], looked, lost

    def regrouped(self) -> NDArray[np.int64]:
        """Of each splat whose harmonics stand under names of another degree that degree, else 0."""
        degrees = np.asarray(self.codes & _DEGREE, np.int64)
        degrees[degrees == self.degree] = 0
        return degrees if self.degree is not None else np.zeros_like(degrees)


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
