"""Streamed SOG by PlayCanvas: levels of detail of a scene in chunks, as viewers load them.

``lod-meta.json`` holds a tree over space. Each leaf, a chunk, has for each level a range of rows in
a folder, which is a SOG. As in splat-transform, consecutive chunks share a folder until it has more
than `UNIT` splats. Viewers choose a chunk's level by its size in the image, so no chunk is wider
than its distance from the cameras.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RefineError
from ..place import Place, described, named_json
from ..splats import Splats, rotation_matrices, scales
from ..visibility.scene import nearby_order
from ..whole_file import explained, mode_of, new_folder, refuse_existing, whole_file
from .format import Format, new_file, pieces
from .ply import SplatFile
from .sog import GENERATOR, IMAGES, META, Bundle, bundle_beside, contents

NAME, VERSION = "streamed SOG", 1
INDEX = "lod-meta.json"

UNIT = 1 << 19
"""Most splats of a chunk in the finest level, and number above which a folder is closed, as in
splat-transform."""

LEAST = 1 << 13
"""Smaller chunks are not split for width, as in splat-transform: viewers take as long for each."""

_MOST_LEVELS = 1 << 10
_FOLDER = re.compile(rf"(\d+_\d+)/{re.escape(META)}")  # LEVEL_NUMBER, as in splat-transform


def read(path: Path, data: NDArray[np.uint8], level: int = 0) -> SplatFile:
    """Read a level of a streamed SOG, 0 is the finest, with the environment, by its index."""
    place = Place(path)
    meta = place.members(place.parsed(data.tobytes()))
    if meta.get("version", VERSION) != VERSION:
        place.at("version").expected(str(VERSION), meta["version"])
    levels = place.at("lodLevels").whole(meta.get("lodLevels"), 1, _MOST_LEVELS)
    if not 0 <= level < levels:
        place.fail(f"no level {level}, expected 0 to {levels - 1}")
    units = list(_units(place, meta, level))
    if not units:
        place.fail(f"no splats in level {level}")
    model, files = units[0][0].model, {path: len(data)}
    for bundle, _ in units:
        files |= bundle.files
        if bundle.model != model:
            bundle.place.fail(f"model {bundle.model}, others have {model}")
    size, count = sum(files.values()), sum(len(rows) for _, spans in units for rows in spans)
    if count > size:  # many may share their images
        place.fail(f"{count} splats, expected at most {size}, the bytes of all files together")
    degree = max(bundle.degree for bundle, _ in units)
    return new_file(path, (f"{NAME}, level {level}", size), count, degree, _parts(units), model)


def _parts(units):
    for bundle, spans in units:
        stored = bundle.read().splats()
        yield from (stored.take(slice(rows.start, rows.stop)) for rows in spans)


def _units(place: Place, meta: dict[str, Any], level: int) -> Iterator[tuple[Bundle, list[range]]]:
    """Yield each SOG of a level with its rows, then the environment."""
    names = place.at("filenames").items(meta.get("filenames"))
    spans = _spans(place.at("tree"), meta.get("tree"), level, len(names))
    opened: set[Path] = set()

    def bundle(where: Place, name: Any) -> Bundle:
        path = where.beside(where.text(name)).resolve()
        if path in opened:
            where.fail(f"{described(name)} is named twice")
        opened.add(path)
        return bundle_beside(path)

    for file in sorted(spans):
        where = place.at(f"filenames [{file}]")
        unit, rows = bundle(where, names[file]), sorted(spans[file], key=lambda span: span.start)
        if rows[-1].stop > unit.count:
            where.fail(f"holds {unit.count} splats, the tree takes those up to {rows[-1].stop}")
        if any(before.stop > after.start for before, after in itertools.pairwise(rows)):
            where.fail("the tree takes a splat twice")
        yield unit, rows
    if spans and meta.get("environment") is not None:
        around = bundle(place.at("environment"), meta["environment"])
        yield around, [range(around.count)]


def _spans(place: Place, tree: Any, level: int, files: int) -> dict[int, list[range]]:
    """Ranges of rows of a level by the number of their file, without empty ones."""
    spans: dict[int, list[range]] = {}
    left, number = [tree], 0
    while left:
        node = place.members(left.pop())
        left += place.at("children").items(node.get("children", []))
        where = place.at(f"chunk {number} level {level}")
        lods = where.members(node.get("lods", {}))
        number += bool(lods)
        if str(level) in lods:
            held = where.members(lods[str(level)])
            file = where.at("file").whole(held.get("file"), 0, files - 1)
            start, count = (where.at(key).whole(held.get(key)) for key in ("offset", "count"))
            if count:
                spans.setdefault(file, []).append(range(start, start + count))
    return spans


def _tree_over(means: NDArray[np.float64], width: float) -> Any:
    """Tree over positions, (N, 3). A leaf is a chunk as in the index, still without rows.

    A branch is an axis, a value, the subtree below and that of the rest. Chunks of more than `UNIT`
    splats, or of `LEAST` and wider than `width`, are halved at the median of the longest side.
    """
    low, high = means.min(axis=0), means.max(axis=0)
    axis = int(np.argmax(high - low))
    longest = high[axis] - low[axis]
    if (len(means) <= UNIT and (len(means) <= LEAST or longest <= width)) or not longest:
        return {"bound": {"min": np.full(3, np.inf), "max": np.full(3, -np.inf)}, "lods": {}}
    along = means[:, axis]
    value = np.partition(along, len(along) // 2)[len(along) // 2]
    if value == low[axis]:  # more than half of them lie there
        value = along[along > value].min()
    below = along < value
    return axis, float(value), _tree_over(means[below], width), _tree_over(means[~below], width)


class StreamedSog:
    """A streamed SOG, written level by level into a folder of `folder_for`, then published.

    Chunks are those of the `finest` positions, (N, 3), most of them at most `width` wide.
    """

    def __init__(self, finest: NDArray[Any], width: float, folder: Path) -> None:
        self._tree = _tree_over(np.asarray(finest, np.float64), width)
        self._folder = folder
        self._levels: list[int] = []  # that of each folder
        self._counts: list[int] = []  # splats of each level

    def add(self, splats: Splats) -> int:
        """Write the next level, the finest first; returns the bytes of its files."""
        level, size = len(self._counts), 0
        self._counts.append(len(splats))
        means, unit = np.asarray(splats.means, np.float64), np.empty(0, np.intp)
        left = [(self._tree, np.arange(len(means)))]
        while left:
            node, rows = left.pop()
            if not isinstance(node, dict):
                axis, value, *sides = node
                below = means[rows, axis] < value
                left += [(sides[1], rows[~below]), (sides[0], rows[below])]
            elif len(rows):
                rows, bound = rows[nearby_order(splats.means[rows])], node["bound"]
                for piece in pieces(len(rows)):  # box around ellipsoids of one standard deviation
                    batch = splats.take(rows[piece])
                    turns = np.abs(rotation_matrices(batch.quaternions))
                    half = np.einsum("nij,nj->ni", turns, scales(batch.log_scales))
                    low, high = (means[rows[piece]] + side * half for side in (-1.0, 1.0))
                    bound["min"] = np.minimum(bound["min"], low.min(axis=0))
                    bound["max"] = np.maximum(bound["max"], high.max(axis=0))
                place = {"file": len(self._levels), "offset": len(unit), "count": len(rows)}
                node["lods"][str(level)] = place
                unit = np.concatenate([unit, rows])
            if len(unit) > (UNIT if left else 0):
                folder = self._folder / str(len(self._levels))
                self._levels.append(level)
                folder.mkdir()
                files = contents(self._folder / INDEX, splats.take(unit))
                size += sum((folder / file).write_bytes(data) for file, data in files)
                unit = unit[:0]
        return size

    def publish(self, path: Path, *, overwrite: bool) -> None:
        """Move the folders beside `path`, under free names, and write the index to `path`.

        An index that is replaced stays whole, with its folders, until the new one is in place.
        """
        old, text = _folders_of(path), b""
        moved: list[Path] = []
        try:
            for number, level in enumerate(self._levels):
                free = (path.parent / f"{level}_{index}" for index in itertools.count())
                moved.append(next(there for there in free if not there.exists()))
                (self._folder / str(number)).rename(moved[-1])
            index = {
                "version": VERSION,
                "asset": {"generator": GENERATOR},
                "count": sum(self._counts),
                "counts": self._counts,
                "lodLevels": len(self._counts),
                "lodErrors": False,
                "filenames": [f"{there.name}/{META}" for there in moved],
                "tree": _indexed(self._tree),
            }
            text = json.dumps(index, allow_nan=False, default=np.ndarray.tolist).encode() + b"\n"
            with whole_file(path, overwrite=overwrite) as stream:
                stream.write(text)
        except BaseException:
            in_place = False
            with contextlib.suppress(OSError):
                in_place = bool(text) and path.read_bytes() == text
            for there in () if in_place else moved:
                shutil.rmtree(there, ignore_errors=True)
            raise
        for folder in (path.parent / name for name in old):
            # What a link leads to is not the index's.
            with contextlib.suppress(OSError):  # it is not there, or holds something else
                for file in () if folder.is_symlink() else (META, *IMAGES):
                    (folder / file).unlink(missing_ok=True)
                folder.rmdir()


def _indexed(node: Any) -> dict[str, Any]:
    """A subtree as in the index."""
    if isinstance(node, dict):
        return node
    children = [_indexed(side) for side in node[2:]]
    low, high = ([child["bound"][end] for child in children] for end in ("min", "max"))
    bound = {"min": np.min(low, axis=0), "max": np.max(high, axis=0)}
    return {"bound": bound, "children": children}


@contextlib.contextmanager
def folder_for(path: Path, *, overwrite: bool) -> Iterator[Path]:
    """Yield a new folder beside `path`, removed afterwards; `RefineError` if it is no index."""
    with new_folder(path.parent):
        if path.is_symlink():
            raise RefineError(f"{path}: is a link, expected the index itself, beside its folders")
        refuse_existing(path, overwrite=overwrite)
        _folders_of(path)
        with (
            explained(path, "cannot be written"),
            tempfile.TemporaryDirectory(prefix=".refine-", dir=path.parent) as folder,
        ):
            yield Path(folder)


def _folders_of(path: Path) -> list[str]:
    """Names of the folders beside an index that it names; none if it is not there."""
    if not mode_of(path):
        return []
    place = Place(path)
    try:
        meta = place.members(place.parsed(path.read_bytes()), ("lodLevels",))
        names = place.at("filenames").items(meta.get("filenames"))
    except RefineError as error:
        error.add_note("it is no index of levels: write to another folder")
        raise
    matches = (_FOLDER.fullmatch(name) for name in names if isinstance(name, str))
    return [match[1] for match in matches if match]


READER = Format(NAME, INDEX, named_json(INDEX), read)
