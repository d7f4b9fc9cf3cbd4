"""Tiles, and the runs of rows that they are worked through in."""

from __future__ import annotations

import io
import itertools
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..formats.ply import splat_header, stated_model
from ..formats.ply_body import check_counts, has_lists, vertex_range
from ..formats.ply_columns import THIRD_SCALE, splats_from_columns
from ..formats.ply_header import HEADER_LIMIT, TEXT, format_of
from ..formats.registry import read_splats
from ..rendering import MODELS, Model
from ..scoring.closed_form import ROWS
from ..splats import Splats, joined, with_model
from ..urls import Url
from . import storage

_HEADER = 1 << 16
"""Bytes that are fetched of a tile behind a URL for its header, which hardly ever has more."""

_PIECE = 1 << 24  # bytes beside the rows that are copied at a time


class Source(Protocol):
    """A run of rows of all splats, in whatever form they are stored."""

    @property
    def index(self) -> int:
        """Which one of all."""
        ...

    def __len__(self) -> int:
        """Return the number of rows."""
        ...

    def splats(self) -> Splats:
        """Return its splats."""
        ...


class Tile(NamedTuple):
    """A file of splats, as it was when the job began."""

    path: str  # absolute, or a URL
    splats: int  # how many it holds
    dtype: np.dtype[Any]  # of a row
    model: Model  # how they are drawn
    header: int  # bytes of the header
    begin: int  # bytes before the first row
    size: int  # bytes of the file
    changed: int | str  # see `storage.state`

    @property
    def model_can_change(self) -> bool:
        """Whether its splats may be drawn otherwise: those without a third scale are discs."""
        return THIRD_SCALE in (self.dtype.names or ())

    @property
    def place(self) -> Path | Url:
        """Where it is."""
        return storage.located(self.path)

    @property
    def name(self) -> str:
        """The name of the file."""
        return self.place.name

    @property
    def end(self) -> int:
        """Bytes up to the end of the last row."""
        return self.begin + self.splats * self.row_bytes

    @property
    def fixed_bytes(self) -> int:
        """Bytes of everything but the rows."""
        return self.size - self.end + self.begin

    @property
    def row_bytes(self) -> int:
        """Bytes of one splat."""
        return self.dtype.itemsize


class Part(NamedTuple):
    """Rows ``start`` to ``stop`` of a tile."""

    tile: Tile
    start: int
    stop: int

    @property
    def rows(self) -> int:
        """How many."""
        return self.stop - self.start


@dataclass(frozen=True)
class Unit:
    """A run of the rows of all tiles together, which may begin in one tile and end in another."""

    index: int
    parts: tuple[Part, ...]  # of the tiles that it lies in, in their order; none is empty

    def __len__(self) -> int:
        """Return the number of rows."""
        return sum(part.rows for part in self.parts)

    @property
    def remote(self) -> bool:
        """Whether any of it is behind a URL."""
        return any(isinstance(part.tile.place, Url) for part in self.parts)

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
        splats = joined([splats_from_columns(rows_of(part)) for part in chosen])
        return with_model(splats, self.parts[0].tile.model)

    def slices(self) -> list[slice]:
        """Return where in the unit each part lies."""
        ends = np.cumsum([0, *(part.rows for part in self.parts)]).tolist()
        return [slice(*pair) for pair in itertools.pairwise(ends)]

    def row_bytes(self) -> NDArray[np.int64]:
        """Return how many bytes each splat takes in its file, (n,)."""
        return np.repeat(
            [part.tile.row_bytes for part in self.parts], [part.rows for part in self.parts]
        )


class Piece(NamedTuple):
    """Rows of a tile that lie in one unit: which of the unit, `place`, and of the tile, `part`."""

    unit: int  # its index
    place: slice
    part: Part


def tiles_at(paths: Sequence[Path | str], model: Model | None = None) -> list[Tile]:
    """Look at the files of a scene.

    Parameters
    ----------
    paths : sequence of path-like
    model : {"default", "antialiased", "2dgs"}, optional
        How their splats are drawn, where they do not say or are wrong.

    Raises
    ------
    RefineError
        See `tile_at`; also if a file is given twice, since its splats would count twice, if they
        are of different models, or none has a splat.
    """
    tiles: list[Tile] = []
    given: dict[Hashable, Tile] = {}
    for tile in (_drawn_as(tile_at(path), model) for path in paths):
        first = given.setdefault(storage.file_key(tile.place), tile)
        if first is not tile:
            msg = f"{tile.path}: is given twice"
            raise RefineError(msg if first.path == tile.path else f"{msg}, also as {first.path}")
        tiles.append(tile)
        if tile.model != tiles[0].model:
            raise RefineError(
                f"{tile.path}: its splats are {tile.model}, those of {tiles[0].path} "
                f"{tiles[0].model}; expected one model in all tiles"
            )
    if not any(tile.splats for tile in tiles):
        raise RefineError(f"none of {len(tiles)} tiles has a splat: there is nothing to prune")
    return tiles


def _drawn_as(tile: Tile, model: Model | None) -> Tile:
    """Return a tile with splats of another model; None leaves it as it is."""
    if model is None or model == tile.model:
        return tile
    if not tile.model_can_change:
        raise RefineError(
            f"{tile.path}: splats without {THIRD_SCALE} are drawn as 2dgs, got {model}"
        )
    return tile._replace(model=model)


def tile_at(path: Path | str) -> Tile:
    """Look at a file of splats.

    Parameters
    ----------
    path : path-like
        Or a URL, of which only the header is fetched.

    Raises
    ------
    RefineError
        See `read_splats` and `storage.state`; also if it is no plain binary PLY.
    """
    place = storage.located(path)
    if isinstance(place, Url):
        return _tile_behind(place)
    file = read_splats(place)
    if file.origin is not None or file.lines is not None:
        raise _no_tile(place, file.format)
    size, changed = storage.state(place)
    header = len(file.header)
    return Tile(
        str(place.absolute()), len(file), file.rows.dtype, file.model, header,
        header + len(file.before), size, changed,
    )  # fmt: skip


def _tile_behind(url: Url) -> Tile:
    """Look at a file of splats behind a URL."""
    size, changed = storage.state(url)
    if url.name in ("", ".", ".."):
        raise RefineError(f"{url}: names no file")
    head = storage.beginning(url, _HEADER, size)
    if b"end_header" not in head:
        head = storage.beginning(url, HEADER_LIMIT, size)
    header, vertex = splat_header(url, io.BytesIO(head))
    if header.order == TEXT:
        raise _no_tile(url, format_of(header.raw))
    before = zip(header.elements[:vertex], header.counts, strict=False)
    if any(count and has_lists(element) for element, count in before):
        raise RefineError(
            f"{url}: has lists before the splats, expected none in a tile behind a URL"
        )
    body = np.broadcast_to(np.uint8(0), size - len(header.raw))  # only its length matters
    check_counts(header, len(body))
    start, _ = vertex_range(header, vertex, body)
    begin = len(header.raw) + start
    dtype = header.elements[vertex].dtype(header.order)
    model = stated_model(header.raw, dtype) or "default"
    return Tile(
        str(url), header.counts[vertex], dtype, model, len(header.raw), begin, size, changed
    )


def _no_tile(path: Path | Url, form: str) -> RefineError:
    return RefineError(
        f"{path}: is {form}, expected a plain binary PLY as a tile, which 'refine convert IN "
        "OUT.ply' makes of other formats"
    )


def rows_of(part: Part) -> NDArray[Any]:
    """Read the rows of a part.

    They are read rather than mapped: pages that are mapped stay in memory as long as the map.

    Raises
    ------
    RefineError
        If the tile cannot be read, or is another file than it was.
    """
    tile = part.tile
    return _read(tile, tile.dtype, part.rows, tile.begin + part.start * tile.row_bytes)


def header_of(tile: Tile) -> bytes:
    """Read the header of a tile; see `rows_of` for errors."""
    return _read(tile, np.dtype(np.uint8), tile.header, 0).tobytes()


def bytes_of(tile: Tile, start: int, stop: int) -> Iterator[NDArray[np.uint8]]:
    """Read bytes of a tile, some at a time; see `rows_of` for errors."""
    for begin in range(start, stop, _PIECE):
        yield _read(tile, np.dtype(np.uint8), min(_PIECE, stop - begin), begin)


def _read(tile: Tile, dtype: np.dtype[Any], count: int, begin: int) -> NDArray[Any]:
    """Read an array from a tile; see `storage.array`."""
    sent = storage.array(tile.place, dtype, count, begin)
    if storage.state(tile.place) != (tile.size, tile.changed):
        raise RefineError(f"{tile.path}: was changed while it was worked on; nothing was written")
    if len(sent) != count:
        raise RefineError(
            f"{tile.path}: {sent.nbytes} bytes were sent, expected the {count * dtype.itemsize} "
            f"from {begin} on"
        )
    return sent


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


def pieces_of(tiles: Sequence[Tile], units: Sequence[Unit]) -> list[list[Piece]]:
    """Return the pieces of each tile, in the order of its rows; an empty one has none."""
    numbers = {tile: number for number, tile in enumerate(tiles)}
    pieces: list[list[Piece]] = [[] for _ in tiles]
    for unit in units:
        for part, place in zip(unit.parts, unit.slices(), strict=True):
            pieces[numbers[part.tile]].append(Piece(unit.index, place, part))
    return pieces


def packed(splats: Splats) -> NDArray[np.float64]:
    """Return splats as one table, (n, 14 + 3 K), for harmonics of K coefficients a channel.

    Unless they are of the default model, there is a last column with the number of their model.
    """
    harmonics = splats.sh_rest.reshape(len(splats), 3 * splats.sh_rest.shape[1])
    columns = [splats.means, splats.log_scales, splats.quaternions]
    columns += [splats.opacity_logits[:, None], splats.sh_dc, harmonics]
    if splats.model != MODELS[0]:
        columns += [np.full((len(splats), 1), MODELS.index(splats.model))]
    with np.errstate(invalid="ignore"):  # signalling NaN
        return np.concatenate([np.asarray(values, np.float64) for values in columns], axis=1)


def unpacked(table: NDArray[np.float64]) -> Splats:
    """Return the splats of a table, in float64."""
    means, scales, quaternions, logits, constant, rest = np.split(table, [3, 6, 10, 11, 14], axis=1)
    of_model = rest.shape[1] % 3
    harmonics = rest[:, : rest.shape[1] - of_model].reshape(len(table), rest.shape[1] // 3, 3)
    model = MODELS[int(rest[0, -1])] if of_model and len(table) else MODELS[0]
    return Splats(means, scales, quaternions, logits[:, 0], constant, harmonics, model)
