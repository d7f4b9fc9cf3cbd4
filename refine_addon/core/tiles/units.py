"""Tiles, and the runs of rows that they are worked through in."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ..errors import RefineError
from ..formats.ply_columns import splats_from_columns
from ..formats.registry import read_splats
from ..scoring.closed_form_block import ROWS
from ..splats import joined
from ..whole_file import expanded

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import Any

    from numpy.typing import NDArray

    from ..formats.ply import SplatFile
    from ..splats import Splats


class Tile(NamedTuple):
    """A file of splats, as it was when the job began.

    Attributes
    ----------
    path : str
        Absolute.
    splats : int
        How many it holds.
    dtype : structured
        Of a row.
    begin : int
        Bytes before the first row.
    fixed_bytes : int
        Bytes of everything but the rows.
    size, changed : int
        Bytes of the file, and when it was changed last, ns.
    """

    path: str
    splats: int
    dtype: np.dtype[Any]
    begin: int
    fixed_bytes: int
    size: int
    changed: int

    @property
    def row_bytes(self) -> int:
        """Bytes of one splat."""
        return self.dtype.itemsize


class Part(NamedTuple):
    """Rows ``start`` to ``stop`` of a tile.

    Attributes
    ----------
    tile : Tile
    start, stop : int
    """

    tile: Tile
    start: int
    stop: int

    @property
    def rows(self) -> int:
        """How many."""
        return self.stop - self.start


@dataclass(frozen=True)
class Unit:
    """A run of the rows of all tiles together, which may begin in one tile and end in another.

    Attributes
    ----------
    index : int
        Which one of all.
    parts : tuple of Part
        Of the tiles that it lies in, in their order; none is empty.
    """

    index: int
    parts: tuple[Part, ...]

    def __len__(self) -> int:
        """Return the number of rows."""
        return sum(part.rows for part in self.parts)

    def splats(self) -> Splats:
        """Return its splats; see `take`."""
        return self.take(slice(0, len(self)))

    def take(self, piece: slice) -> Splats:
        """Read some of its splats.

        Parameters
        ----------
        piece : slice
            From a row to another, which may be the same.

        Returns
        -------
        Splats
            Of types and a degree that hold the numbers of all parts: coefficients that a part lacks
            are 0.

        Raises
        ------
        RefineError
            See `rows_of`.
        """
        kinds = {part.tile.dtype: part._replace(stop=part.start) for part in self.parts}
        chosen = [*kinds.values()] if len(kinds) > 1 else []
        for part, place in zip(self.parts, self.slices(), strict=True):
            start, stop = max(piece.start, place.start), min(piece.stop, place.stop)
            if start < stop:
                begin = part.start - place.start
                chosen.append(Part(part.tile, begin + start, begin + stop))
        chosen = chosen or [*kinds.values()]
        return joined([splats_from_columns(rows_of(part)) for part in chosen])

    def slices(self) -> list[slice]:
        """Return where in the unit each part lies."""
        ends = np.cumsum([0, *(part.rows for part in self.parts)]).tolist()
        return [slice(*pair) for pair in itertools.pairwise(ends)]


def tile_at(path: Path | str) -> Tile:
    """Look at a file of splats.

    Raises
    ------
    RefineError
        See `read_splats`; also if it is no plain binary PLY.
    """
    path = expanded(path)
    file = read_splats(path)
    if file.origin is not None or file.lines is not None:
        msg = (
            f"{path}: is {file.format}, expected a plain binary PLY as a tile, which 'refine "
            "convert IN OUT.ply' makes of other formats"
        )
        raise RefineError(msg)
    found = path.stat()
    return Tile(
        str(path.absolute()), len(file), file.rows.dtype, len(file.header) + len(file.before),
        file.fixed_bytes, found.st_size, found.st_mtime_ns,
    )  # fmt: skip


def reopened(tile: Tile) -> SplatFile:
    """Open a tile again.

    Raises
    ------
    RefineError
        If it cannot be read, or is another file than it was.
    """
    _refuse_changed(tile)
    return read_splats(tile.path)


def rows_of(part: Part) -> NDArray[Any]:
    """Read the rows of a part.

    They are read rather than mapped: pages that are mapped stay in memory as long as the map.

    Raises
    ------
    RefineError
        See `reopened`.
    """
    tile = part.tile
    _refuse_changed(tile)
    rows = np.fromfile(
        tile.path, tile.dtype, part.rows, offset=tile.begin + part.start * tile.row_bytes
    )
    _refuse_changed(tile)
    return rows


def _refuse_changed(tile: Tile) -> None:
    """Raise `RefineError` if a tile is another file than it was when the job began."""
    try:
        found = Path(tile.path).stat()
    except OSError as error:
        msg = f"{tile.path}: cannot be read ({error.strerror or error})"
        raise RefineError(msg) from error
    if (found.st_size, found.st_mtime_ns) != (tile.size, tile.changed):
        msg = f"{tile.path}: was changed while it was worked on; nothing was written"
        raise RefineError(msg)


def units_of(tiles: Sequence[Tile]) -> list[Unit]:
    """Return the runs of `ROWS` rows of all tiles together; only the last may be shorter."""
    units: list[Unit] = []
    parts: list[Part] = []
    room = ROWS
    for tile in tiles:
        start = 0
        while start < tile.splats:
            stop = min(start + room, tile.splats)
            parts.append(Part(tile, start, stop))
            room -= stop - start
            start = stop
            if not room:
                units.append(Unit(len(units), tuple(parts)))
                parts, room = [], ROWS
    return [*units, Unit(len(units), tuple(parts))] if parts else units
