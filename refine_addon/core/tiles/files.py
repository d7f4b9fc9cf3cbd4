"""Tiles: files as they were when the job began, read as splats, and written all or none.

Each is written into the folder of the job, then all are renamed to their final names.
"""

from __future__ import annotations

import os
from bisect import bisect_left
from collections.abc import Collection, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..execute import Progress, chunks, run, run_all, seconds
from ..formats import ply
from ..formats.ply_columns import THIRD_SCALE, Changed, Changes, splats_from_columns, values_by_name
from ..mapped import Interrupted, Mapped, note, noted, on_disk, whole
from ..splats import Model, Splats, joined
from ..whole_file import Url, alike, refuse_one_file
from . import storage

ROWS = 1 << 16  # of a tile, read together: 15 MB at degree 3
_PIECE = 1 << 24  # bytes beside the rows that are copied at a time

RENAMED = "renamed"
"""Stage in which tiles are renamed. Its result, noted before the first is, has their `_state`."""


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
    drawn = ply.model_drawn(place, header.raw, dtype, model)
    return Tile(
        place if isinstance(place, Url) else place.absolute(), header.counts[vertex], dtype,
        drawn, len(header.raw), len(header.raw) + begin, size, changed,
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
        wanted = f"expected the {count * dtype.itemsize} from {begin} on"
        raise RefineError(f"{tile.path}: {sent.nbytes} bytes were sent, {wanted}")
    return sent


def copied(tiles: Sequence[Tile], folder: Path, progress: Progress) -> Splats:
    """Copy tiles to files of a new folder, of their widest types and highest degree, else 0."""
    dtypes = dict.fromkeys(tile.dtype for tile in tiles if tile.splats)
    kinds = [splats_from_columns(np.empty(0, each), tiles[0].model) for each in dtypes]
    pieces = [(tile, part.start, part.stop) for tile in tiles for part in chunks(tile.splats, ROWS)]

    def read(piece: tuple[Tile, int, int]) -> Splats:
        return joined([*kinds, splats_from_columns(rows_of(*piece), tiles[0].model)])

    return on_disk(folder, run(read, pieces, progress=progress, what="reading"))


# Writing.


def waiting_in(job: Path) -> Path:
    """Folder in which finished tiles of a job wait for the others."""
    return job / "tiles"


class Kept(NamedTuple):
    """Kept splats of all N, in files of the job."""

    keep: Mapped  # (N,)
    changed: Mapped  # rows of the kept splats with new values, ascending
    became: Splats | None  # these values

    def columns(self, rows: NDArray[Any], begin: int) -> Changes:
        """New values of rows of a tile, which are those of the scene from `begin` on."""
        if self.became is None:
            return None
        first, end = (bisect_left(self.changed, row) for row in (begin, begin + len(rows)))
        splats, changed = self.became.take(slice(first, end)), self.changed[first:end] - begin
        degree = splats_from_columns(rows[:1]).sh_degree
        return Changed(changed, values_by_name(splats.up_to_degree(degree)))


def header_of(tile: Tile, kept: int) -> bytes:
    """Header of the output of a tile that keeps `kept` splats."""
    header = ply.with_count(b"".join(map(bytes, bytes_of(tile, 0, tile.header))), kept)
    return ply.with_model(header, tile.model) if THIRD_SCALE in (tile.dtype.names or ()) else header


class Outputs:
    """Outputs of a job by tile; `RefineError` if two are one file, a tile, or not replaceable."""

    def __init__(
        self, job: Path, tiles: Sequence[Tile], folder: Path | Url, overwrite: bool
    ) -> None:
        self._job, self._tiles, self._overwrite = job, tiles, overwrite
        self.targets: list[Path | Url] = [folder / tile.path.name for tile in tiles]
        # Files in the same storage in which finished tiles wait until all are written.
        self._waiting: list[Path | Url] = [waiting_in(job) / tile.path.name for tile in tiles]
        if isinstance(folder, Url):
            self._waiting = [folder / f"{job.name}-{number:06d}" for number in range(len(tiles))]
        for _, tile in alike(tiles, lambda tile: tile.path.name):
            raise RefineError(f"{tile.path}: another tile is called {tile.path.name} too")
        refuse_one_file(target for target in self.targets if isinstance(target, Path))
        paths = [*(tile.path for tile in tiles), *self.targets]
        for _, target in alike(paths, storage.identity):
            problem = "is read until all tiles are written; write to another folder"
            raise RefineError(f"{target}: {problem}")
        self._refuse_existing(self.in_place())

    def in_place(self) -> dict[int, tuple[int, int | str]]:
        """`_state` of the tiles, by number, that an interrupted run has renamed."""
        states = (noted(self._job, RENAMED)[1] or {}).items()
        return {number: state for number, state in states if self._is_renamed(number, *state)}

    def write(self, kept: Kept, progress: Progress) -> list[int]:
        """Write all tiles to waiting files, then rename these; returns bytes of each.

        What is in place stays. If a file is in the way, none is renamed, and `Interrupted` raised.
        """
        there = self.in_place()
        numbers = [number for number in range(len(self._tiles)) if number not in there]
        work = partial(_write_tile, self._job, self._tiles, kept, self._waiting)
        cost = seconds("write", sum(self._tiles[number].splats for number in numbers))
        run_all(work, numbers, progress=progress, what="writing", cost=cost)
        there = self.in_place()
        try:
            self._refuse_existing(there)
            pairs = enumerate(zip(self._waiting, self.targets, strict=True))
            left = {number: pair for number, pair in pairs if number not in there}
            states = there | {number: _state(waiting) for number, (waiting, _) in left.items()}
            note(self._job, RENAMED, states)
            for pair in left.values():
                storage.publish(*pair, overwrite=self._overwrite)
        except RefineError as error:
            raise Interrupted(str(error)) from error
        return [states[number][0] for number in range(len(self._tiles))]

    def discard(self) -> None:
        """Remove waiting files behind URLs."""
        for place in self._waiting:
            if isinstance(place, Url):
                storage.discard(place)

    def _refuse_existing(self, there: Collection[int]) -> None:
        """Raise `RefineError` if a tile that is not in place could not be renamed to its target."""
        for number, target in enumerate(self.targets):
            if number in there:
                continue
            storage.refuse_existing(target, overwrite=self._overwrite)
            if isinstance(target, Path):  # a link to another disk: nothing is renamed there
                behind = Path(os.path.realpath(target)).parent
                if behind.stat().st_dev != target.parent.stat().st_dev:
                    problem = f"is a link to another disk, {behind}; remove the link"
                    raise RefineError(f"{target}: {problem}")

    def _is_renamed(self, number: int, size: int, changed: int | str) -> bool:
        """Whether a tile is in place; behind URLs by its size, as renaming changes times there."""
        target, waiting = self.targets[number], self._waiting[number]
        if isinstance(target, Path):
            return target.is_file() and _state(target) == (size, changed)
        return storage.size_of(Url(waiting)) is None and storage.size_of(target) == size


def _write_tile(job, tiles, kept, places, number):
    """Write a tile's kept rows, unless an earlier run has, and upload it."""
    tile, begin = tiles[number], sum(tile.splats for tile in tiles[:number])
    waiting = waiting_in(job) / tile.path.name
    if not waiting.exists():
        with whole(waiting) as stream:
            count = int(np.count_nonzero(kept.keep[begin : begin + tile.splats]))
            stream.write(header_of(tile, count))
            for beside in bytes_of(tile, tile.header, tile.begin):
                stream.write(beside.data)
            for start in range(0, tile.splats, ROWS):
                rows, first = rows_of(tile, start, min(start + ROWS, tile.splats)), begin + start
                stays = kept.keep[first : first + len(rows)]
                ply.write_rows(stream, rows, stays, kept.columns(rows, first))
            for beside in bytes_of(tile, tile.end, tile.size):
                stream.write(beside.data)
    if isinstance(places[number], Url):
        storage.upload(waiting, places[number])
        if not waiting.exists():  # others have ended the job meanwhile: nobody will rename this
            storage.discard(places[number])


def _state(path: Path | Url) -> tuple[int, int | str]:
    """Bytes of a file, and on a disk the time of its last change, ns."""
    return storage.state(path) if isinstance(path, Path) else (storage.size_of(path) or 0, 0)
