"""Writing tiles: each into the folder of the job, and then all into their places."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..formats.ply_columns import ChangedColumns, splats_from_columns
from ..formats.ply_header import with_count, with_model
from ..formats.ply_write import write_rows
from ..operation.run import Runtime
from ..urls import Url
from ..whole_file import refuse_one_file
from . import storage
from .folder import Folder, Interrupted
from .units import Piece, Tile, bytes_of, header_of, rows_of, unpacked

RENAMED = "renamed"
"""Name of the note of all tiles, made before the first is renamed: bytes and times, (tiles, 2)."""


@dataclass(frozen=True)
class WriteTile:
    """Writes what stays of a tile into the folder of the job."""

    number: int
    tile: Tile
    pieces: list[Piece]  # all of its rows, in their order
    kept: int  # how many of its splats stay
    changed: bool  # whether some of them absorbed others
    url: Url | None  # where to copy the file

    def run(self, folder: Folder, _runtime: Runtime) -> int:
        """Write the file, unless it is there; return its bytes."""
        waiting_file, name = folder.tiles / self.tile.name, f"{self.number:06d}.written"
        done, size = folder.noted(name)
        if not (done and waiting_file.exists()):
            size = self._write(folder, waiting_file)
            folder.note(name, np.array(size))
        if self.url is not None:
            storage.upload(waiting_file, self.url)
        return int(size)

    def _write(self, folder: Folder, waiting_file: Path) -> int:
        tile = self.tile
        with folder.writing(waiting_file) as stream:
            header = with_count(header_of(tile), self.kept)
            stream.write(with_model(header, tile.model) if tile.model_can_change else header)
            for beside in bytes_of(tile, tile.header, tile.begin):
                stream.write(beside.data)
            for piece in self.pieces:
                keep, rows = folder.map(piece.unit, "keep")[piece.place], rows_of(piece.part)
                columns = self._columns(folder, rows, piece) if self.changed else {}
                write_rows(stream, rows, keep, columns)
            for beside in bytes_of(tile, tile.end, tile.size):
                stream.write(beside.data)
            return stream.tell()

    def _columns(self, folder: Folder, rows: NDArray[Any], piece: Piece) -> ChangedColumns:
        """Return the columns of rows, with what those became that absorbed others."""
        changed = folder.map(piece.unit, "changed")
        here = slice(*np.searchsorted(changed, (piece.place.start, piece.place.stop)).tolist())
        splats = unpacked(folder.map(piece.unit, "became")[here])
        degree = splats_from_columns(rows[:1]).sh_rest.shape[1]
        splats = replace(splats, sh_rest=splats.sh_rest[:, :degree])
        return ChangedColumns(rows, changed[here] - piece.place.start, splats)


@dataclass(frozen=True)
class Outputs:
    """Where the tiles of a job go."""

    job: Folder
    targets: Sequence[Path | Url]  # the names that all tiles get in the end
    waiting: Sequence[Path | Url]  # where each waits, in the same storage, until all are written
    overwrite: bool  # whether files may be replaced

    @classmethod
    def of(
        cls, job: Folder, tiles: Sequence[Tile], folder: Path | Url, *, overwrite: bool
    ) -> Outputs:
        """Return where tiles go that end in a folder, which is there.

        Raises
        ------
        RefineError
            If two tiles have one name, or a file could not be made, or may not be replaced.
        """
        targets = {folder / tile.name: tile for tile in tiles}
        if len(targets) < len(tiles):
            name = next(tile.name for tile in tiles if targets[folder / tile.name] is not tile)
            raise RefineError(f"{targets[folder / name].path}: another tile is called {name} too")
        waiting: list[Path | Url] = [
            folder / f"{job.path.name}-{number:06d}"
            if isinstance(folder, Url)
            else job.tiles / tile.name
            for number, tile in enumerate(tiles)
        ]
        refuse_one_file(target for target in targets if isinstance(target, Path))
        outputs = cls(job, [*targets], waiting, overwrite)
        read = {storage.identity(tile.place) for tile in tiles}
        for target in targets:
            if storage.identity(target) in read:
                raise RefineError(
                    f"{target}: is read until all tiles are written; write to another folder"
                )
        outputs.refuse_existing()
        return outputs

    @property
    def urls(self) -> list[Url | None]:
        """Where to copy each tile; None on a disk, where it is written at once."""
        return [None if isinstance(place, Path) else place for place in self.waiting]

    def in_place(self) -> dict[int, int]:
        """Return the bytes of the tiles, by number, that an interrupted run renamed already."""
        noted, states = self.job.noted(RENAMED)
        if not noted:
            return {}
        return {
            number: size
            for number, (size, changed) in enumerate(states.tolist())
            if self._is_renamed(number, size, changed)
        }

    def refuse_existing(self) -> None:
        """Raise `RefineError` if a tile that is not in its place could not get there."""
        there = self.in_place()
        for number, target in enumerate(self.targets):
            if number not in there:
                storage.refuse_existing(target, overwrite=self.overwrite)
                _refuse_other_disk(target)

    def publish(self) -> None:
        """Rename all tiles that are not in their places yet.

        Raises
        ------
        Interrupted
            If one cannot be renamed, or another file is in its place; if that is so from the
            beginning, none is renamed.
        """
        there = self.in_place()
        try:
            self.refuse_existing()
            _, noted = self.job.noted(RENAMED)
            states = [
                noted[number] if number in there else _state(waiting)
                for number, waiting in enumerate(self.waiting)
            ]
            self.job.note(RENAMED, np.array(states, np.int64))
            for number, (waiting, target) in enumerate(
                zip(self.waiting, self.targets, strict=True)
            ):
                if number not in there:
                    storage.publish(waiting, target, overwrite=self.overwrite)
        except RefineError as error:
            raise Interrupted(str(error)) from error

    def discard(self) -> None:
        """Remove what waits behind URLs."""
        for url in self.urls:
            if url is not None:
                storage.discard(url)

    def _is_renamed(self, number: int, size: int, changed: int) -> bool:
        """Return whether a tile is in its place, given its bytes and the time of its last change.

        Storages behind URLs give a file another time when they rename it.
        """
        target = self.targets[number]
        if isinstance(target, Path):
            return target.is_file() and _state(target) == (size, changed)
        waiting = self.waiting[number]
        return storage.size_of(waiting) is None and storage.size_of(target) == size


def _refuse_other_disk(target: Path | Url) -> None:
    """Raise `RefineError` if a target is a link to another disk: nothing is renamed there."""
    if isinstance(target, Path):
        behind = Path(os.path.realpath(target)).parent
        if behind.stat().st_dev != target.parent.stat().st_dev:
            raise RefineError(f"{target}: is a link to another disk, {behind}; remove the link")


def _state(path: Path | Url) -> tuple[int, int]:
    """Return the bytes of a file, and on a disk the time of its last change, ns."""
    if isinstance(path, Path):
        status = path.stat()
        return status.st_size, status.st_mtime_ns
    return storage.size_of(path) or 0, 0
