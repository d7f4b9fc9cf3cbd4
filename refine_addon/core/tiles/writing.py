"""Writing tiles: each into the folder of the job, then all renamed to their final names."""

from __future__ import annotations

import os
from bisect import bisect_left
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..execute import Progress, run_all, seconds
from ..formats.ply import with_count, with_model, write_rows
from ..formats.ply_columns import THIRD_SCALE, ChangedColumns, splats_from_columns
from ..mapped import Interrupted, Mapped, note, noted, whole
from ..splats import Splats
from ..whole_file import Url, alike, refuse_one_file
from . import storage
from .source import ROWS, Tile, bytes_of, rows_of

RENAMED = "renamed"
"""Stage in which tiles are renamed. Its result, noted before the first is, has their `_state`."""


def waiting_in(job: Path) -> Path:
    """Folder in which finished tiles of a job wait for the others."""
    return job / "tiles"


@dataclass(frozen=True)
class Kept:
    """Kept splats of all N, in files of the job."""

    keep: Mapped  # (N,)
    changed: Mapped  # rows of the kept splats with new values, ascending
    became: Splats | None  # these values

    def columns(self, rows: NDArray[Any], begin: int) -> Mapping[str, NDArray[Any]]:
        """New values of rows of a tile, which are those of the scene from `begin` on."""
        if self.became is None:
            return {}
        first, end = (bisect_left(self.changed, row) for row in (begin, begin + len(rows)))
        splats, changed = self.became.take(slice(first, end)), self.changed[first:end] - begin
        degree = splats_from_columns(rows[:1]).sh_rest.shape[1]
        return ChangedColumns(rows, changed, replace(splats, sh_rest=splats.sh_rest[:, :degree]))


def header_of(tile: Tile, kept: int) -> bytes:
    """Header of the output of a tile that keeps `kept` splats."""
    header = with_count(b"".join(map(bytes, bytes_of(tile, 0, tile.header))), kept)
    return with_model(header, tile.model) if THIRD_SCALE in (tile.dtype.names or ()) else header


@dataclass(frozen=True)
class Outputs:
    """Outputs of a job by tile; `RefineError` if two are one file, a tile, or not replaceable."""

    job: Path
    tiles: Sequence[Tile]
    folder: Path | Url
    overwrite: bool

    def __post_init__(self) -> None:
        for _, tile in alike(self.tiles, lambda tile: tile.path.name):
            raise RefineError(f"{tile.path}: another tile is called {tile.path.name} too")
        refuse_one_file(target for target in self.targets if isinstance(target, Path))
        paths = [*(tile.path for tile in self.tiles), *self.targets]
        for _, target in alike(paths, storage.identity):
            raise RefineError(
                f"{target}: is read until all tiles are written; write to another folder"
            )
        self._refuse_existing(self.in_place())

    @property
    def targets(self) -> list[Path | Url]:
        """Final names of the tiles."""
        return [self.folder / tile.path.name for tile in self.tiles]

    @property
    def waiting(self) -> list[Path | Url]:
        """Files in the same storage in which finished tiles wait until all are written."""
        if isinstance(self.folder, Url):
            name = self.job.name
            return [self.folder / f"{name}-{number:06d}" for number in range(len(self.tiles))]
        return [waiting_in(self.job) / tile.path.name for tile in self.tiles]

    def in_place(self) -> dict[int, tuple[int, int | str]]:
        """`_state` of the tiles, by number, that an interrupted run has renamed."""
        states = (noted(self.job, RENAMED)[1] or {}).items()
        return {number: state for number, state in states if self._is_renamed(number, *state)}

    def write(self, kept: Kept, progress: Progress, threads: int | None) -> list[int]:
        """Write all tiles to waiting files, then rename these; returns bytes of each.

        What is in place stays. If a file is in the way, none is renamed, and `Interrupted` raised.
        """
        there = self.in_place()
        numbers = [number for number in range(len(self.tiles)) if number not in there]
        work = partial(_write_tile, self.job, self.tiles, kept, self.waiting)
        cost = seconds("write", sum(self.tiles[number].splats for number in numbers))
        run_all(work, numbers, progress=progress, what="writing", threads=threads, cost=cost)
        there = self.in_place()
        try:
            self._refuse_existing(there)
            pairs = enumerate(zip(self.waiting, self.targets, strict=True))
            left = {number: pair for number, pair in pairs if number not in there}
            states = there | {number: _state(waiting) for number, (waiting, _) in left.items()}
            note(self.job, RENAMED, states)
            for pair in left.values():
                storage.publish(*pair, overwrite=self.overwrite)
        except RefineError as error:
            raise Interrupted(str(error)) from error
        return [states[number][0] for number in range(len(self.tiles))]

    def discard(self) -> None:
        """Remove waiting files behind URLs."""
        for place in self.waiting:
            if isinstance(place, Url):
                storage.discard(place)

    def _refuse_existing(self, there: Collection[int]) -> None:
        """Raise `RefineError` if a tile that is not in place could not be renamed to its target."""
        for number, target in enumerate(self.targets):
            if number in there:
                continue
            storage.refuse_existing(target, overwrite=self.overwrite)
            if isinstance(target, Path):  # a link to another disk: nothing is renamed there
                behind = Path(os.path.realpath(target)).parent
                if behind.stat().st_dev != target.parent.stat().st_dev:
                    raise RefineError(
                        f"{target}: is a link to another disk, {behind}; remove the link"
                    )

    def _is_renamed(self, number: int, size: int, changed: int | str) -> bool:
        """Whether a tile is in place; behind URLs by its size, as renaming changes times there."""
        target, waiting = self.targets[number], self.waiting[number]
        if isinstance(target, Path):
            return target.is_file() and _state(target) == (size, changed)
        return storage.size_of(Url(waiting)) is None and storage.size_of(target) == size


def _write_tile(job, tiles, kept, places, number):
    """Write a tile's kept rows, unless an earlier run has, and upload it."""
    waiting = waiting_in(job) / tiles[number].path.name
    if not waiting.exists():
        with whole(waiting) as stream:
            _write_rows(tiles, kept, number, stream)
    if isinstance(places[number], Url):
        storage.upload(waiting, places[number])
        if not waiting.exists():  # others have ended the job meanwhile: nobody will rename this
            storage.discard(places[number])


def _write_rows(tiles, kept, number, stream):
    tile, begin = tiles[number], sum(tile.splats for tile in tiles[:number])
    header = header_of(tile, int(np.count_nonzero(kept.keep[begin : begin + tile.splats])))
    stream.write(header)
    for beside in bytes_of(tile, tile.header, tile.begin):
        stream.write(beside.data)
    for start in range(0, tile.splats, ROWS):
        rows, first = rows_of(tile, start, min(start + ROWS, tile.splats)), begin + start
        stays = kept.keep[first : first + len(rows)]
        write_rows(stream, rows, stays, kept.columns(rows, first))
    for beside in bytes_of(tile, tile.end, tile.size):
        stream.write(beside.data)


def _state(path: Path | Url) -> tuple[int, int | str]:
    """Bytes of a file, and on a disk the time of its last change, ns."""
    return storage.state(path) if isinstance(path, Path) else (storage.size_of(path) or 0, 0)
