"""Tiles: files as they were when the job began, and their rows as splats."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..execute import Progress, chunks, run
from ..formats import ply
from ..formats.ply_columns import THIRD_SCALE, splats_from_columns
from ..mapped import on_disk
from ..splats import Model, Splats, joined
from ..whole_file import Url, alike
from . import storage

ROWS = 1 << 16  # of a tile, read together: 15 MB at degree 3
_PIECE = 1 << 24  # bytes beside the rows that are copied at a time


class Tile(NamedTuple):
    """A file of splats, as it was when the job began."""

    path: Path | Url  # a path is absolute
    splats: int  # how many it holds
    dtype: np.dtype[Any]  # of a row
    model: Model  # how they are drawn
    header: int  # bytes of the header
    begin: int  # bytes before the first row
    size: int  # bytes of the file
    changed: int | str  # see `storage.state`

    @property
    def end(self) -> int:
        """Bytes up to the end of the last row."""
        return self.begin + self.splats * self.dtype.itemsize


def tiles_at(paths: Sequence[Path | str], model: Model | None = None) -> list[Tile]:
    """Tiles of a scene (`tile_at`); `RefineError` also for a file twice, other models, no splat."""
    tiles = [tile_at(path, model) for path in paths]
    for first, tile in alike(tiles, lambda tile: storage.identity(tile.path)):
        also = "" if first.path == tile.path else f", also as {first.path}"
        raise RefineError(f"{tile.path}: is given twice{also}")
    ply.refuse_other_models(tiles)
    if not any(tile.splats for tile in tiles):
        raise RefineError(f"none of {len(tiles)} tiles has a splat: there is nothing to prune")
    return tiles


def tile_at(path: Path | str, model: Model | None = None) -> Tile:
    """Tile of a plain binary PLY by its header, by default drawn by `model`; or `RefineError`."""
    place = storage.located(path)
    size, changed = storage.state(place)
    if place.name in ("", ".", ".."):
        raise RefineError(f"{place}: names no file")
    header, vertex = ply.splat_header(place, storage.beginning(place, ply.HEADER_LIMIT, size))
    if header.order == ply.TEXT:
        raise RefineError(
            f"{place}: is {ply.FORMATS[header.order]}, expected a plain binary PLY as a tile, "
            "which 'refine convert IN OUT.ply' makes of other formats"
        )
    begin = ply.row_ranges(header, size - len(header.raw))[vertex].start
    dtype = header.elements[vertex].dtype(header.order)
    stated = ply.stated_model(header.raw, dtype) or "default"
    if model not in (None, stated) and THIRD_SCALE not in (dtype.names or ()):
        raise RefineError(f"{place}: splats without {THIRD_SCALE} are drawn as 2dgs, got {model}")
    return Tile(
        place if isinstance(place, Url) else place.absolute(), header.counts[vertex], dtype,
        model or stated, len(header.raw), len(header.raw) + begin, size, changed,
    )  # fmt: skip


def rows_of(tile: Tile, start: int, stop: int) -> NDArray[Any]:
    """Rows of a tile, read, as mapped pages would stay in memory; `RefineError` if it changed."""
    return _read(tile, tile.dtype, stop - start, tile.begin + start * tile.dtype.itemsize)


def bytes_of(tile: Tile, start: int, stop: int) -> Iterator[NDArray[np.uint8]]:
    """Yield the bytes of a tile from `start` to `stop`, some at a time; errors as in `rows_of`."""
    for begin in range(start, stop, _PIECE):
        yield _read(tile, np.dtype(np.uint8), min(_PIECE, stop - begin), begin)


def _read(tile: Tile, dtype: np.dtype[Any], count: int, begin: int) -> NDArray[Any]:
    sent = storage.array(tile.path, dtype, count, begin)
    if storage.state(tile.path) != (tile.size, tile.changed):
        raise RefineError(f"{tile.path}: was changed while it was worked on; nothing was written")
    if len(sent) != count:
        raise RefineError(
            f"{tile.path}: {sent.nbytes} bytes were sent, expected the {count * dtype.itemsize} "
            f"from {begin} on"
        )
    return sent


def copied(tiles: Sequence[Tile], folder: Path, progress: Progress, threads: int | None) -> Splats:
    """Copy tiles to files of a new folder, of their widest types and highest degree, else 0."""
    dtypes = dict.fromkeys(tile.dtype for tile in tiles if tile.splats)
    kinds = [splats_from_columns(np.empty(0, each), tiles[0].model) for each in dtypes]
    pieces = [(tile, part.start, part.stop) for tile in tiles for part in chunks(tile.splats, ROWS)]

    def read(piece: tuple[Tile, int, int]) -> Splats:
        return joined([*kinds, splats_from_columns(rows_of(*piece), tiles[0].model)])

    return on_disk(folder, run(read, pieces, progress=progress, what="reading", threads=threads))
