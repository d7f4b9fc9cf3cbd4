"""Levels of detail as streamed SOG: chunks by space, their rows in SOG folders, and the index.

The tree follows the finest level; the splats of every other level go where they lie in it. As
splat-transform has it, consecutive chunks share a folder until it holds `UNIT` splats, and rows of
a chunk are sorted along a curve. Viewers choose a level for each chunk by its size in the image, so
a chunk is no wider than the distance from which the cameras saw the scene.
"""

from __future__ import annotations

import contextlib
import json
import re
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError, reason_of
from ..execute import checkpoint
from ..place import Place
from ..splats import Splats, rotation_matrices, scales
from ..whole_file import mode_of, new_folder, refuse_existing, whole_file
from .format import near_ones_together, pieces
from .sog_write import GENERATOR, IMAGES, META, contents
from .streamed_sog import INDEX, VERSION

UNIT = 1 << 19
"""A folder is closed once it holds more splats than this; a chunk of the finest level has at most
as many. The default of splat-transform."""

LEAST = 1 << 13
"""A chunk with fewer splats of the finest level is not split for its width, as in splat-transform:
chunks cost the viewer the same, however little they hold."""

_OURS = re.compile(r"\d+_\d+")
"""Names of folders, as splat-transform has them: of the level, and counted."""

_FOLDER = re.compile(f"({_OURS.pattern})/{re.escape(META)}")


@dataclass(frozen=True, eq=False)
class _Split:
    """A plane across an axis: what lies below `value` belongs to `below`."""

    axis: int
    value: float
    below: _Split | int
    above: _Split | int


def _planted(means: NDArray[np.float64], width: float) -> tuple[_Split | int, int]:
    """Return a tree over positions (N, 3) whose leaves are numbers of chunks, and how many.

    A chunk is halved across its longest side at the median of its splats while it has more than
    `UNIT` of them, or is wider than `width` and has more than `LEAST`.
    """
    count = 0

    def grown(rows: NDArray[np.intp]) -> _Split | int:
        nonlocal count
        here = means[rows]
        low, high = here.min(axis=0), here.max(axis=0)
        axis = int(np.argmax(high - low))
        longest = high[axis] - low[axis]
        if (len(rows) <= UNIT and (len(rows) <= LEAST or longest <= width)) or not longest:
            count += 1
            return count - 1
        along = here[:, axis]
        value = np.partition(along, len(along) // 2)[len(along) // 2]
        if value == low[axis]:  # more than half of them lie there
            value = along[along > value].min()
        below = along < value
        return _Split(axis, float(value), grown(rows[below]), grown(rows[~below]))

    return grown(np.arange(len(means))), count


def _chunk_of(tree: _Split | int, means: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return in which chunk each position (N, 3) lies, (N,)."""
    chunk = np.empty(len(means), np.intp)
    left: list[tuple[_Split | int, NDArray[np.intp]]] = [(tree, np.arange(len(means)))]
    while left:
        node, rows = left.pop()
        if isinstance(node, int):
            chunk[rows] = node
            continue
        below = means[rows, node.axis] < node.value
        left += [(node.below, rows[below]), (node.above, rows[~below])]
    return chunk


@dataclass
class _Chunk:
    """A leaf: the box around its splats of all levels, and where those of each level are."""

    low: NDArray[np.float64] = field(default_factory=lambda: np.full(3, np.inf))
    high: NDArray[np.float64] = field(default_factory=lambda: np.full(3, -np.inf))
    levels: dict[str, dict[str, int]] = field(default_factory=dict)


class StreamedSog:
    """A streamed SOG that is written level by level.

    Parameters
    ----------
    finest : (N, 3) floating
        Positions of the finest level, which the chunks follow.
    width : float
        Of a chunk, at most, where it holds many splats.
    folder : Path
        Where SOG folders are made until they are published; see `folder_for`.
    """

    def __init__(self, finest: NDArray[Any], width: float, folder: Path) -> None:
        self._tree, count = _planted(np.asarray(finest, np.float64), width)
        self._chunks = [_Chunk() for _ in range(count)]
        self._folder = folder
        self._names: list[str] = []
        self._counts: list[int] = []

    def add(self, splats: Splats) -> int:
        """Write the next level, the finest first; return the bytes of its files.

        Raises
        ------
        RefineError
            If a file cannot be written, or there is no library for images.
        """
        level, size = len(self._counts), 0
        self._counts.append(len(splats))
        chunk = _chunk_of(self._tree, np.asarray(splats.means, np.float64))
        order = np.argsort(chunk, kind="stable")
        starts = np.searchsorted(chunk[order], np.arange(len(self._chunks) + 1))
        unit: list[NDArray[np.intp]] = []
        for number, held in enumerate(self._chunks):
            rows = order[starts[number] : starts[number + 1]]
            if len(rows):
                rows = rows[near_ones_together(splats.means[rows])]
                held.levels[str(level)] = {
                    "file": len(self._names),
                    "offset": sum(map(len, unit)),
                    "count": len(rows),
                }
                _widen(held, splats, rows)
                unit.append(rows)
            if sum(map(len, unit)) > UNIT or (unit and number == len(self._chunks) - 1):
                size += self._write_unit(level, splats.take(np.concatenate(unit)))
                unit = []
        return size

    def _write_unit(self, level: int, splats: Splats) -> int:
        number = sum(name.startswith(f"{level}_") for name in self._names)
        name, size = f"{level}_{number}", 0
        self._names.append(f"{name}/{META}")
        try:
            (self._folder / name).mkdir()
            for file, data in contents(self._folder / INDEX, splats):
                (self._folder / name / file).write_bytes(data)
                size += len(data)
        except OSError as error:
            raise RefineError(
                f"{self._folder / name}: cannot be written ({reason_of(error)})"
            ) from error
        return size

    def publish(self, path: Path, *, overwrite: bool) -> None:
        """Move the folders beside `path` and write the index there, last.

        What the index that is replaced names goes first, so that no index names what is not there.

        Raises
        ------
        RefineError
            If the index may not be replaced, or the system cannot write it.
        Cancelled
            See `execute.checkpoint`; all is as it was.
        """
        checkpoint()
        refuse_existing(path, overwrite=overwrite)
        try:
            _remove_old(path)
            for name in self._names:
                there = path.parent / Path(name).parent
                there.mkdir(exist_ok=True)
                for file in (self._folder / name).parent.iterdir():
                    file.replace(there / file.name)
        except OSError as error:
            raise RefineError(f"{path}: cannot be written ({reason_of(error)})") from error
        with whole_file(path, overwrite=overwrite) as stream:
            stream.write(json.dumps(self._index(), allow_nan=False).encode() + b"\n")

    def _index(self) -> dict[str, Any]:
        """Return what ``lod-meta.json`` says."""
        return {
            "version": VERSION,
            "asset": {"generator": GENERATOR},
            "count": sum(self._counts),
            "counts": self._counts,
            "lodLevels": len(self._counts),
            "lodErrors": False,
            "filenames": self._names,
            "tree": self._told(self._tree),
        }

    def _told(self, node: _Split | int) -> dict[str, Any]:
        if isinstance(node, int):
            chunk = self._chunks[node]
            bound = {"min": chunk.low.tolist(), "max": chunk.high.tolist()}
            return {"bound": bound, "lods": chunk.levels}
        children = [self._told(node.below), self._told(node.above)]
        ends = [[child["bound"][end] for child in children] for end in ("min", "max")]
        low, high = np.min(ends[0], axis=0), np.max(ends[1], axis=0)
        return {"bound": {"min": low.tolist(), "max": high.tolist()}, "children": children}


def _widen(chunk: _Chunk, splats: Splats, rows: NDArray[np.intp]) -> None:
    """Let the box of a chunk hold splats: boxes around their ellipsoids of one deviation."""
    for piece in pieces(len(rows)):
        batch = splats.take(rows[piece])
        turns = np.abs(rotation_matrices(batch.quaternions))
        half = np.einsum("nij,nj->ni", turns, scales(batch.log_scales))
        means = np.asarray(batch.means, np.float64)
        chunk.low = np.minimum(chunk.low, (means - half).min(axis=0))
        chunk.high = np.maximum(chunk.high, (means + half).max(axis=0))


@contextlib.contextmanager
def folder_for(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """Yield an empty folder in which to make a `StreamedSog`; remove what is left of it.

    Parameters
    ----------
    path : Path
        The index to make, ``lod-meta.json``; its folder is made if it is not there.
    overwrite : bool
        Whether an index there, and the folders that it names, may be replaced.

    Raises
    ------
    RefineError
        If something is there that may not be replaced, or the system cannot write there.
    """
    with new_folder(path.parent):
        refuse_existing(path, overwrite=overwrite)
        old = {path.parent / name for name in _folders_of(path)}
        for entry in path.parent.iterdir():
            if _OURS.fullmatch(entry.name) and entry not in old:
                raise RefineError(f"{entry}: exists already; write to another folder")
        try:
            with tempfile.TemporaryDirectory(prefix=".refine-", dir=path.parent) as made:
                yield Path(made)
        except OSError as error:
            raise RefineError(f"{path}: cannot be written ({reason_of(error)})") from error


def _folders_of(path: Path) -> list[str]:
    """Return the names of the folders beside an index that it names; none if it is not there."""
    if not mode_of(path):
        return []
    place = Place(path)
    try:
        meta = place.members(place.parsed(path.read_bytes()), ("lodLevels",))
        names = place.at("filenames").items(meta.get("filenames"))
    except RefineError as error:
        error.add_note("it is no index of levels: write to another folder")
        raise
    found = (_FOLDER.fullmatch(name) for name in names if isinstance(name, str))
    return [name[1] for name in found if name]


def _remove_old(path: Path) -> None:
    """Remove an index, then the files that its folders hold as SOG, and folders left empty."""
    names = _folders_of(path)
    path.unlink(missing_ok=True)
    for name in names:
        for file in (META, *IMAGES):
            with contextlib.suppress(OSError):
                (path.parent / name / file).unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # it holds something else
            (path.parent / name).rmdir()
