"""One step with one unit or one tile: what a worker does.

A step reads the files and the folder of the job and writes into the folder. What it returns is
small. It does nothing that could not be done again: where its result is noted, that is returned.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from .. import radix
from ..errors import RefineError
from ..formats.ply_columns import splats_from_columns
from ..formats.ply_header import with_count
from ..formats.ply_write import write_rows
from ..scoring.closed_form_block import STEPS, RowBlock
from ..selection import lowest
from ..survivors import columns_with
from ..whole_file import whole_file
from ..work import Progress, silent
from . import storage
from .absorbing import unpacked
from .units import bytes_of, header_of, rows_of

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from ..scoring.closed_form_settings import ClosedForm
    from ..urls import Url
    from ..views import ViewSet
    from .absorbing import Region
    from .folder import Folder
    from .units import Tile, Unit

_REPEATED = ("count",)
"""Steps of `STEPS` that are done with several arguments: their results are not noted."""


SURVIVORS = ("survivors", "places", "changed")
"""Names of what is noted of survivors: their rows among all splats, ascending; where each is among
those of all regions; and whether it changed."""


class Shared(NamedTuple):
    """An argument that lies in the folder, since it is large.

    Attributes
    ----------
    name : str
    """

    name: str


class Rule(NamedTuple):
    """Which splats go.

    Attributes
    ----------
    threshold : float or None
        Those with lower scores, in float32.
    least_seen : int or None
        Or those in fewer views.
    edge : int
        Or those whose scores have a lower key, and of those at it some of the first; see
        `selection.lowest`.
    left : tuple of int
        How many of those, or of their bytes, in each unit.
    by_bytes : bool
        Whether each splat counts as many bytes as it takes in its file.
    """

    threshold: float | None = None
    least_seen: int | None = None
    edge: int = 0
    left: tuple[int, ...] = ()
    by_bytes: bool = False


@dataclass(frozen=True)
class Job:
    """What all steps of a job need.

    Attributes
    ----------
    folder : Folder
    views : ViewSet
        Those that are used.
    settings : ClosedForm
    middle : (3,) float64, float
        Of the views, as `ViewSet.middle` returns it.
    """

    folder: Folder
    views: ViewSet
    settings: ClosedForm
    middle: tuple[NDArray[np.float64], float]

    def score(
        self,
        unit: Unit,
        step: str,
        arguments: tuple[Any, ...],
        *,
        progress: Progress = silent,
        threads: int | None = 1,
    ) -> Any:  # noqa: ANN401 - of each step its own
        """Do a step of `STEPS` with a unit."""
        if step in _REPEATED:
            return self._scored(unit, step, arguments, progress, threads)
        name = f"{unit.index:06d}.{step}"
        result = self.folder.once(
            name, lambda: self._scored(unit, step, arguments, progress, threads)
        )
        self.folder.drop(unit.index, STEPS[step][2])
        return result

    def _scored(
        self,
        unit: Unit,
        step: str,
        arguments: tuple[Any, ...],
        progress: Progress,
        threads: int | None,
    ) -> Any:  # noqa: ANN401 - of each step its own
        needed, made, _ = STEPS[step]
        arrays = self.folder.load(unit.index, needed)
        # From a disk a unit is read chunk by chunk; behind a URL each chunk would be a request.
        splats = unit.splats() if step == "read" and unit.remote else unit
        block = RowBlock(
            splats, self.views, self.settings, self.middle, threads=threads, arrays=arrays
        )
        del splats
        block.progress = progress
        result = getattr(block, step)(*map(self._whole, arguments))
        self.folder.save(unit.index, {array: getattr(block, array) for array in made})
        return result

    def rank(self, unit: Unit, prefixes: list[int], shift: int, *, by_bytes: bool) -> radix.Sparse:
        """Return `radix.counts` of the scores of a unit."""
        keys, weights = self._keys(unit), _bytes(unit) if by_bytes else None
        return radix.Sparse.of(radix.counts(keys, prefixes, shift, weights))

    def tied(self, unit: Unit, edge: int, *, by_bytes: bool) -> int:
        """Return how many splats of a unit score as much as the last that goes, or their bytes."""
        ties = self._keys(unit) == edge
        return int(_bytes(unit)[ties].sum() if by_bytes else np.count_nonzero(ties))

    def choose(self, unit: Unit, rule: Rule) -> NDArray[np.int64]:
        """Decide which splats of a unit stay.

        Returns
        -------
        (parts, 2) int64
            Of each part, how many splats stay, and how many lie in no view.
        """
        found = self.folder.load(unit.index, ["values", "seen"])
        if rule.threshold is not None:
            gone = found["values"] < np.float32(rule.threshold)
        elif rule.least_seen is not None:
            gone = found["seen"] < rule.least_seen
        else:
            weights = _bytes(unit) if rule.by_bytes else None
            keys = radix.keys_of(found["values"])
            gone = lowest(keys, rule.edge, rule.left[unit.index], weights)
        return self._kept(unit, ~gone)

    def settle(
        self, unit: Unit, begins: NDArray[np.int64], regions: Sequence[Region]
    ) -> NDArray[np.int64]:
        """Note which splats of a unit survive absorbing, and what those became that changed.

        Parameters
        ----------
        unit : Unit
        begins : (units + 1,) int64
            How many splats lie before each unit, and all.
        regions : sequence of Region
            Where the survivors are.

        Returns
        -------
        (parts, 2) int64
            See `choose`.
        """
        begin, end = begins[unit.index : unit.index + 2].tolist()
        origin, place, changed = (self.folder.mapped(name) for name in SURVIVORS)
        some = slice(*np.searchsorted(origin, (begin, end)).tolist())
        rows, mine = origin[some] - begin, changed[some]
        keep = np.zeros(len(unit), np.bool_)
        keep[rows] = True
        starts = np.cumsum([0, *map(len, regions)])
        at = place[some][mine]
        which = np.searchsorted(starts, at, side="right") - 1
        values = np.empty((len(at), regions[0].table().shape[1] if regions else 0))
        for index in np.unique(which).tolist():
            here = which == index
            values[here] = regions[index].table()[at[here] - starts[index]]
        self.folder.save(unit.index, {"changed": rows[mine], "became": values})
        return self._kept(unit, keep)

    def _kept(self, unit: Unit, keep: NDArray[np.bool_]) -> NDArray[np.int64]:
        """Note which splats of a unit stay; return what `choose` returns."""
        self.folder.save(unit.index, {"keep": keep})
        unseen = self.folder.load(unit.index, ["seen"])["seen"] == 0
        return np.array(
            [
                [np.count_nonzero(keep[piece]), np.count_nonzero(unseen[piece])]
                for piece in unit.slices()
            ]
        )

    def write(
        self, tile: Tile, units: list[Unit], kept: int, *, absorbed: bool, url: Url | None = None
    ) -> int:
        """Write what stays of a tile into the folder of the job, and return its bytes.

        Parameters
        ----------
        tile : Tile
        units : list of Unit
            Those in which it lies.
        kept : int
            How many of its splats stay.
        absorbed : bool
            Whether some of them changed.
        url : Url, optional
            Where to copy the file.
        """
        made = self.folder.tiles / tile.name
        size = self._written(tile, units, kept, made, absorbed=absorbed)
        if url is not None:
            storage.upload(made, url)
        return size

    def _written(
        self, tile: Tile, units: list[Unit], kept: int, made: Path, *, absorbed: bool
    ) -> int:
        """Write a file, see `write`."""
        name = f"{tile.name}.written"
        done, result = self.folder.noted(name)
        if done and made.exists():  # it may have been renamed, just before a kill
            return int(result)
        with whole_file(made, overwrite=True) as stream:
            stream.write(with_count(header_of(tile), kept))
            for beside in bytes_of(tile, tile.header, tile.begin):
                stream.write(beside.data)
            for unit in units:
                keep = self.folder.load(unit.index, ["keep"])["keep"]
                for part, piece in zip(unit.parts, unit.slices(), strict=True):
                    if part.tile == tile:
                        rows = rows_of(part)
                        changed = self._changed(unit, rows, piece) if absorbed else {}
                        write_rows(stream, rows, keep[piece], changed)
            for beside in bytes_of(tile, tile.end, tile.size):
                stream.write(beside.data)
            size = stream.tell()
        self.folder.note(name, np.array(size))
        return size

    def _changed(self, unit: Unit, rows: NDArray[Any], piece: slice) -> dict[str, NDArray[Any]]:
        """Return the columns of rows, a slice of a unit, with what some of them became."""
        changed, became = self.folder.load(unit.index, ("changed", "became")).values()
        some = slice(*np.searchsorted(changed, (piece.start, piece.stop)).tolist())
        splats = unpacked(became[some])
        degree = splats_from_columns(rows[:1]).sh_rest.shape[1]
        splats = replace(splats, sh_rest=splats.sh_rest[:, :degree])
        return columns_with(rows, changed[some] - piece.start, splats)

    def _keys(self, unit: Unit) -> NDArray[np.unsignedinteger[Any]]:
        return radix.keys_of(self.folder.load(unit.index, ["values"])["values"])

    def _whole(self, argument: Any) -> Any:  # noqa: ANN401 - as given
        if not isinstance(argument, Shared):
            return argument
        return self.folder.noted(argument.name)[1]


def unseen_files(job: Job, tiles: list[Tile]) -> str:
    """Return what this process cannot see of a job's files, in a sentence; "" if all is there."""
    if not job.folder.noted("begun")[0]:
        return f"{job.folder.path} is not there"
    for tile in tiles:
        with contextlib.suppress(RefineError, OSError):
            header_of(tile)
            continue
        return f"{tile.path} is not there, or another file"
    return ""


def _bytes(unit: Unit) -> NDArray[np.int64]:
    """Return how many bytes each splat of a unit takes in its file, (n,)."""
    return np.repeat(
        [part.tile.row_bytes for part in unit.parts], [part.rows for part in unit.parts]
    )
