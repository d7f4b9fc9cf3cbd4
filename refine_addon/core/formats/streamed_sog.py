"""Streamed SOG by PlayCanvas: levels of detail of a scene in chunks, as viewers load them.

``lod-meta.json`` holds a tree over space. A leaf, a *chunk*, says for each level which rows of
which SOG have its splats: folders below of ``meta.json`` and images. A level is read, 0 being the
finest, with the environment, which viewers always show.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..place import Place, described
from ..splats import ARRAYS, Splats
from .format import Reader, new_file
from .ply import Origin, SplatFile
from .sog import Bundle, beside, bundle_beside, read_bundle

NAME, VERSION = "streamed SOG", 1
INDEX = "lod-meta.json"

_MOST_LEVELS = 1 << 10


class _Span(NamedTuple):
    """Rows of a SOG."""

    start: int
    end: int


@dataclass(frozen=True, eq=False)
class _Unit:
    """A SOG, and which of its rows are read."""

    bundle: Bundle
    spans: list[_Span]

    @property
    def count(self) -> int:
        """How many splats are read."""
        return sum(span.end - span.start for span in self.spans)

    def fill(self, splats: Splats) -> None:
        """Set splats, (count,), to those of the rows."""
        stored, at = read_bundle(self.bundle).splats(), 0
        for span in self.spans:
            rows = slice(at, at + span.end - span.start)
            for name in ARRAYS:
                values = getattr(stored, name)[span.start : span.end]
                if name == "sh_rest":
                    splats.sh_rest[rows, : values.shape[1]] = values
                    splats.sh_rest[rows, values.shape[1] :] = 0.0
                else:
                    getattr(splats, name)[rows] = values
            at = rows.stop


def matches(path: Path, head: bytes) -> bool:
    """Return whether a file is one: by its name, which all readers go by."""
    return path.name.lower().endswith(INDEX) and head.lstrip().startswith(b"{")


def read(path: Path, data: NDArray[np.uint8], level: int = 0) -> SplatFile:
    """Read a level of a streamed SOG, with the environment.

    Parameters
    ----------
    path : Path
    data : (M,) uint8
        What the file holds.
    level : int
        0 is the finest.

    Raises
    ------
    RefineError
        If it is damaged or of another version, has no such level, or names a file that lies
        elsewhere; see also `sog.read`.
    """
    place = Place(path)
    meta = place.members(place.parsed(data.tobytes()))
    version = meta.get("version", VERSION)
    if version != VERSION:
        place.at("version").fail(f"expected {VERSION}, got {described(version)}")
    levels = place.at("lodLevels").whole(meta.get("lodLevels"), 1, _MOST_LEVELS)
    if not 0 <= level < levels:
        place.fail(f"no level {level}, expected 0 to {levels - 1}")
    units = list(_units(place, meta, level))
    if not units:
        place.fail(f"no splats in level {level}")
    first = units[0].bundle
    for unit in units:
        if unit.bundle.model != first.model:
            unit.bundle.place.fail(f"model {unit.bundle.model}, others have {first.model}")
    size = len(data) + sum(unit.bundle.size for unit in units)
    count, degree = sum(unit.count for unit in units), max(unit.bundle.degree for unit in units)
    file, splats = new_file(
        path, Origin(f"{NAME}, level {level}", size), count, degree, first.model
    )
    start = 0
    for unit in units:
        unit.fill(splats.take(slice(start, start + unit.count)))
        start += unit.count
    return file


def _units(place: Place, meta: dict[str, Any], level: int) -> Iterator[_Unit]:
    """Yield what of which SOG is of a level, and the environment."""
    names = place.at("filenames").items(meta.get("filenames"))
    spans = _spans(place.at("tree"), meta.get("tree"), level, len(names))
    opened: set[Path] = set()

    def bundle(where: Place, name: Any) -> Bundle:
        path = beside(where, where.text(name)).resolve()
        if path in opened:
            where.fail(f"{described(name)} is named twice")
        opened.add(path)
        return bundle_beside(path)

    for file in sorted(spans):
        where = place.at(f"filenames [{file}]")
        unit = _Unit(bundle(where, names[file]), sorted(spans[file]))
        count = unit.bundle.count
        if unit.spans[-1].end > count:
            where.fail(f"holds {count} splats, the tree takes those up to {unit.spans[-1].end}")
        if any(before.end > after.start for before, after in pairwise(unit.spans)):
            where.fail("the tree takes a splat twice")
        yield unit
    if spans and meta.get("environment") is not None:
        around = bundle(place.at("environment"), meta["environment"])
        yield _Unit(around, [_Span(0, around.count)])


def _spans(place: Place, tree: Any, level: int, files: int) -> dict[int, list[_Span]]:
    """Return the rows of a level by the number of their file; those without splats do not count."""
    spans: dict[int, list[_Span]] = {}
    left, number = [tree], 0
    while left:
        node = place.members(left.pop())
        left += place.at("children").items(node.get("children", []))
        where = place.at(f"chunk {number} level {level}")
        lods = where.members(node.get("lods", {}))
        number += bool(lods)
        if str(level) not in lods:
            continue
        held = where.members(lods[str(level)])
        file = where.at("file").whole(held.get("file"), 0, files - 1)
        start = where.at("offset").whole(held.get("offset"))
        count = where.at("count").whole(held.get("count"))
        if count:
            spans.setdefault(file, []).append(_Span(start, start + count))
    return spans


READER = Reader(name=NAME, suffix=INDEX, matches=matches, read=read)
