"""Drift: Blender moved positions, but not scales, rotations and harmonics.
*Apply*, *Join*, mirror modifiers and transforms in edit mode do so. Each splat notes where it was
when these were written; the note stays with its vertex in Blender and in files."""

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
from .layout import ROTATION, SCALE, has, is_native, sh_degree

HOME = "refine_home"  # Point vector: position when scales, rotation and harmonics were written

SHAPE = "refine_shape"
"""Point integer by bits, 0 without a note: 3 degree of the object's harmonics; 13 the object
(checksum of positions); 16 checksum of the splat's scales and rotation, to see them change."""

_DEGREE, _OBJECT, _ORIGIN, _CHECKSUM = 0x7, 0xFFF8, 0xFFFF, 16
"""Bits of `SHAPE`: degree, object, both; and the checksum's shift."""

_MIX = np.uint32(0x9E3779B1)
"""Odd number near 2^32 over the golden ratio, for multiplicative hashing."""

_FEW, _FEW_SHARE = 100, 0.01  # Splats that may each move without a warning: number, share of all

_SHOWN = 1 << 15  # Splats sampled evenly for the panel's text


class Drift(NamedTuple):
    """Sentences on what others did to splats; whether Mend Splats helps."""

    told: list[str]
    mendable: bool


class Mending(NamedTuple):
    """Repair: `moves`, the maps that only positions followed, with their splats; `regrouped`, (N,),
    the degree under whose names a splat's harmonics stand, 0 where it is right."""

    moves: list[Move]
    regrouped: NDArray[np.int64]


def stamp(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> None:
    """Note that all splats of a mesh are as they should be."""
    position = mesh_attributes.read_attribute(mesh, "position")
    mesh_attributes.write_attribute(mesh, HOME, "FLOAT_VECTOR", position)
    number = (zlib.crc32(position.data) << 3 & _OBJECT) or 1 << 3
    codes = _checksums(_shapes(mesh)) << _CHECKSUM | np.uint32(number | sh_degree(mesh))
    mesh_attributes.write_attribute(mesh, SHAPE, "INT", codes.view(np.int32))


def is_stamped(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> bool:
    """Whether a mesh has notes of its splats' positions."""
    return has(mesh, HOME, "FLOAT_VECTOR") and has(mesh, SHAPE, "INT")


def found(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> Drift | None:
    """Drift of a mesh; None without changes or notes.
    10 ms per million splats if nothing changed; else counts are estimates from a sample."""
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
    """Read the notes now; a thread-safe callable computes the repair. None if nothing changed."""
    if not is_stamped(mesh) or (notes := _Notes(mesh)).undisturbed:
        return None
    return lambda: Mending(notes.moves()[0], notes.regrouped())


def renew(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> None:
    """Renew the notes of splats whose scales and rotations were just written, as by merging."""
    if not is_stamped(mesh):
        return
    notes, checksums = _Notes(mesh), _checksums(_shapes(mesh))
    rows = notes.codes >> _CHECKSUM != checksums
    notes.home[rows] = notes.position[rows]
    codes = np.where(rows, checksums << _CHECKSUM | notes.codes & _ORIGIN, notes.codes)
    mesh_attributes.write_attribute(mesh, HOME, "FLOAT_VECTOR", notes.home)
    mesh_attributes.write_attribute(mesh, SHAPE, "INT", codes.view(np.int32))


class _Notes:
    """Notes of a mesh and its present values, for any thread."""

    def __init__(self, mesh: bpy.types.Mesh | bpy.types.PointCloud) -> None:
        self.home, self.position, codes = (
            mesh_attributes.read_attribute(mesh, name) for name in (HOME, "position", SHAPE)
        )
        self.codes = codes.view(np.uint32)
        # Names of harmonics in Blender's own splats do not depend on the degree.
        self.degree = None if is_native(mesh) else sh_degree(mesh)
        origins = self.codes & _ORIGIN
        self.undisturbed = bool(
            np.array_equal(self.home.view(np.uint32), self.position.view(np.uint32))
            and (origins == origins[0]).all()
            and self.degree in (None, origins[0] & _DEGREE)
        )
        self.shapes = [] if self.undisturbed else _shapes(mesh)

    def objects(self) -> list[int]:
        """Numbers of the objects that the splats came from."""
        return [int(number) for number in np.unique(self.codes & _OBJECT) if number]

    def moves(self, step: int = 1) -> tuple[list[Move], int, int]:
        """Maps that splats did not follow, from one of `step`; numbers looked at and moved alone.
        These go with most of their object."""
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
        """The degree under whose names each splat's harmonics stand, 0 where it is right."""
        degrees = np.asarray(self.codes & _DEGREE, np.int64)
        degrees[degrees == self.degree] = 0
        return degrees if self.degree is not None else np.zeros_like(degrees)


def _shapes(mesh: bpy.types.Mesh | bpy.types.PointCloud) -> list[NDArray[np.float32]]:
    """Attributes with scales and rotations, (N,) or (N, width) each."""
    names = [*(f"scale_{axis}" for axis in range(3)), *(f"rot_{index}" for index in range(4))]
    if THIRD_SCALE not in mesh.attributes:  # discs
        names.remove(THIRD_SCALE)
    if is_native(mesh):
        names = [SCALE, ROTATION]
    return [mesh_attributes.read_attribute(mesh, name) for name in names]


def _checksums(shapes: Sequence[NDArray[np.float32]], step: int = 1) -> NDArray[np.uint32]:
    """16-bit checksums of scales and rotation of one splat of `step`."""
    total = np.zeros(len(range(0, len(shapes[0]), step)), np.uint32)
    for values in shapes:
        for plane in values[::step].reshape(len(total), -1).T:
            total ^= np.ascontiguousarray(plane).view(np.uint32)
            total *= _MIX
            total ^= total >> np.uint32(15)
    return total >> np.uint32(_CHECKSUM)
