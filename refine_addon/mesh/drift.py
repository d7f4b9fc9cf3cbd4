"""Drift: positions moved while scales, rotations and harmonics stayed.
Blender's *Apply*, *Join*, mirror modifiers and transforms in edit mode cause it. Each splat notes
where it was when its scales, rotation and harmonics were written. The notes are point attributes,
which Blender keeps with their vertices, also in files."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from typing import NamedTuple

import bpy
import numpy as np
from numpy.typing import NDArray

from ..core import RefineError
from ..core.affine import Move, affine_moves
from . import attributes
from .layout import ROTATION, SCALE, Data, check, has, is_native, sh_degree

HOME = "refine_home"
"""Point vector: the splat's position when its scales, rotation and harmonics were written."""

SHAPE = "refine_shape"
"""Point integer, 0 without a note. From the lowest bit: 3 bits SH degree of the splat's object,
13 bits its object (checksum of positions), 16 bits checksum of the splat's scales and rotation."""

_DEGREE, _OBJECT, _ORIGIN, _CHECKSUM = 0x7, 0xFFF8, 0xFFFF, 16
"""Masks of `SHAPE`: degree, object, both; and the shift of the checksum."""

_MIX = np.uint32(0x9E3779B1)
"""Odd number near 2^32 over the golden ratio, for multiplicative hashing."""

_FEW, _FEW_SHARE = 100, 0.01  # Splats moved singly without a warning: number, share of all
_SAMPLE = 1 << 15  # Splats looked at for the panel's text, spread evenly
known: dict[int, Drift | None] = {}  # By the data's `session_uid`, until the caller drops it


class Drift(NamedTuple):
    """Sentences on drift, and whether Mend Splats repairs it."""

    sentences: list[str]
    mendable: bool


def stamp(mesh: Data) -> None:
    """Note the present state of all splats as free of drift."""
    position = attributes.read_attribute(mesh, "position")
    attributes.write_attribute(mesh, HOME, "FLOAT_VECTOR", position)
    number = (zlib.crc32(position.data) << 3 & _OBJECT) or 1 << 3
    codes = _checksums(_shapes(mesh)) << _CHECKSUM | np.uint32(number | sh_degree(mesh))
    attributes.write_attribute(mesh, SHAPE, "INT", codes.view(np.int32))


def is_stamped(mesh: Data) -> bool:
    """Whether a mesh has notes."""
    return has(mesh, HOME, "FLOAT_VECTOR") and has(mesh, SHAPE, "INT")


def found(mesh: Data) -> Drift | None:
    """Drift of a mesh; None without drift or notes. Counts are estimates from a sample.
    Takes 10 ms per million splats if nothing changed."""
    if (notes := disturbed(mesh)) is None:
        return None
    moves, sampled, single = notes.moves(max(1, len(notes.codes) // _SAMPLE))
    share = len(notes.codes) / max(sampled, 1)
    moved, bent = (round(share * n) for n in (sum(len(move.rows) for move in moves), single))
    strangers = int(np.count_nonzero(notes.codes == 0))
    regrouped = int(np.count_nonzero(notes.regrouped()))
    sentences = []
    if moved:
        sentences.append(
            f"{moved:,} splats were transformed without their sizes, rotations and colours, "
            "as by Blender's own Apply, Join, Mirror or edit mode"
        )
    if regrouped:
        sentences.append(
            f"{regrouped:,} splats were joined with others of another SH degree: their "
            "colours are mixed up"
        )
    if bent > max(_FEW, _FEW_SHARE * len(notes.codes)):
        sentences.append(
            f"{bent:,} splats were moved one by one, as by a modifier, without their sizes "
            "and rotations: undo that, or accept it by Mend Splats"
        )
    mendable = bool(sentences)
    if strangers:
        sentences.append(
            f"{strangers:,} vertices were joined that are no splats, or of an object that "
            "REFINE never saw: undo that"
        )
    return Drift(sentences, mendable) if sentences else None


def of(obj: bpy.types.Object) -> Drift | None:
    """Drift of an object, None without or in edit mode; computed once for each change."""
    if obj.mode == "EDIT":
        return None
    key = obj.data.session_uid
    if key not in known:
        try:
            known[key] = found(check(obj).mesh)
        except RefineError:
            known[key] = None
    return known[key]


def disturbed(mesh: Data) -> Notes | None:
    """Notes of a mesh, from which drift is repaired; None without notes or if nothing changed."""
    notes = Notes(mesh) if is_stamped(mesh) else None
    return None if notes is None or notes.undisturbed else notes


class Notes:
    """Notes and present values of a mesh, read once, usable on any thread."""

    def __init__(self, mesh: Data) -> None:
        self.home, self.position, codes = (
            attributes.read_attribute(mesh, name) for name in (HOME, "position", SHAPE)
        )
        self.codes = codes.view(np.uint32)
        # In Blender's own splats the attribute names of harmonics do not depend on the degree.
        self.degree = None if is_native(mesh) else sh_degree(mesh)
        origins = self.codes & _ORIGIN
        self.undisturbed = bool(
            np.array_equal(self.home.view(np.uint32), self.position.view(np.uint32))
            and (origins == origins[0]).all()
            and self.degree in (None, origins[0] & _DEGREE)
        )
        self.shapes = [] if self.undisturbed else _shapes(mesh)

    def moves(self, step: int = 1) -> tuple[list[Move], int, int]:
        """Maps that positions alone followed, from every `step`-th splat; number of these splats,
        and of those moved singly, which are put to the map of most splats of their object."""
        rows = np.arange(0, len(self.codes), step)
        sampled, codes = len(rows), self.codes[rows]
        rows = rows[(codes >> _CHECKSUM == _checksums(self.shapes, step)) & (codes != 0)]
        all_moves, single = [], 0
        objects = self.codes[rows] & _OBJECT
        for number in np.unique(objects):
            own = rows[objects == number]
            home, position = self.home[own], self.position[own]
            moves = affine_moves(home, position)
            finite = np.isfinite(home + position).all(axis=1)
            single += int(np.count_nonzero(finite)) - sum(len(move.rows) for move in moves)
            most = np.argmax([len(move.rows) for move in moves]) if moves else 0
            labels = np.full(len(own), most)
            for label, move in enumerate(moves):
                labels[move.rows] = label
            all_moves += [Move(own[labels == label], m.matrix) for label, m in enumerate(moves)]
        no_turn = np.eye(3)  # shifts need no repair
        turns = [move for move in all_moves if not np.array_equal(move.matrix[:3, :3], no_turn)]
        return turns, sampled, single

    def regrouped(self) -> NDArray[np.int64]:
        """SH degree under whose attribute names each splat's harmonics are, (N,), 0 if right."""
        degrees = np.asarray(self.codes & _DEGREE, np.int64)
        degrees[degrees == self.degree] = 0
        return degrees if self.degree is not None else np.zeros_like(degrees)


def _shapes(mesh: Data) -> list[NDArray[np.float32]]:
    """Attributes that hold scales and rotations, (N,) or (N, width) each."""
    names = [*(f"scale_{axis}" for axis in range(3)), *(f"rot_{index}" for index in range(4))]
    names = [SCALE, ROTATION] if is_native(mesh) else names
    there = (name for name in names if name in mesh.attributes)  # discs have no third scale
    return [attributes.read_attribute(mesh, name) for name in there]


def _checksums(shapes: Sequence[NDArray[np.float32]], step: int = 1) -> NDArray[np.uint32]:
    """16-bit checksums of the scales and rotation of every `step`-th splat."""
    total = np.zeros(len(range(0, len(shapes[0]), step)), np.uint32)
    for values in shapes:
        for plane in values[::step].reshape(len(total), -1).T:
            total ^= np.ascontiguousarray(plane).view(np.uint32)
            total *= _MIX
            total ^= total >> np.uint32(15)
    return total >> np.uint32(_CHECKSUM)
