"""Files as one source: merged, moved, with fewer harmonics, in another order."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..affine import transformed
from ..errors import RefineError
from ..formats.format import Format, near_ones_together, new_file
from ..formats.ply import Origin, SplatFile
from ..formats.ply_columns import other_properties
from ..formats.registry import read_splats
from ..formats.streamed_sog import INDEX
from ..rendering import Model
from ..splats import ARRAYS, joined
from ..volumes import FREE
from ..whole_file import expanded
from .files import FileSink, file_to_file
from .loaded import Loaded, RowSizes
from .requests import ConvertRequest, Kept
from .run import run


@dataclass(frozen=True)
class Move:
    """A scale, then turns about x, y and z in this order, then a translation.

    Attributes
    ----------
    translate : tuple of three float
        In the unit of the file.
    rotate : tuple of three float
        Degrees about the axes of the file.
    scale : float

    Raises
    ------
    RefineError
        If a number is not finite, or the scale is not above 0.
    """

    translate: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotate: tuple[float, float, float] = (0.0, 0.0, 0.0)
    scale: float = 1.0

    def __post_init__(self) -> None:
        """Check the values."""
        if not all(map(math.isfinite, (*self.translate, *self.rotate, self.scale))):
            raise RefineError(f"expected finite numbers to move by, got {self}")
        if self.scale <= 0.0:
            raise RefineError(f"scale is {self.scale:g}, expected more than 0")

    @property
    def matrix(self) -> NDArray[np.float64]:
        """What it does to a point, (4, 4).

        Examples
        --------
        >>> quarter = Move((1.0, 0.0, 0.0), (0.0, 0.0, 90.0), 2.0)
        >>> (quarter.matrix @ [1.0, 0.0, 0.0, 1.0]).round(6).tolist()
        [1.0, 2.0, 0.0, 1.0]
        """
        turned = np.eye(3)
        for axis, degrees in enumerate(self.rotate):
            one, other = (axis + 1) % 3, (axis + 2) % 3
            cosine, sine = (f(math.radians(degrees)) for f in (math.cos, math.sin))
            turn = np.eye(3)
            turn[[one, other], [one, other]] = cosine
            turn[one, other], turn[other, one] = -sine, sine
            turned = turn @ turned
        matrix = np.eye(4)
        matrix[:3, :3] = turned * self.scale
        matrix[:3, 3] = self.translate
        return matrix


@dataclass(frozen=True)
class Arrangement:
    """What becomes of the splats of files besides their format.

    Attributes
    ----------
    moves : tuple of Move
        One for each file, or none.
    degree : int or None
        Harmonics above this degree are left out.
    morton : bool
        Whether splats are sorted along a Z-shaped (Morton) curve, so that near ones follow.
    level : int
        Of a streamed SOG, 0 being the finest.
    """

    moves: tuple[Move, ...] = ()
    degree: int | None = None
    morton: bool = False
    level: int = 0


@dataclass(frozen=True)
class ArrangedSource:
    """The splats of files as those of one, in memory.

    Attributes
    ----------
    paths : sequence of path-like
    arrangement : Arrangement
    model : {"default", "antialiased", "2dgs"}, optional
        See `FileSource`.
    """

    paths: Sequence[Path | str]
    arrangement: Arrangement
    model: Model | None = None

    def read(self, form: Format | None) -> Loaded:
        """Read the files; the first is moved first, and comes first.

        Raises
        ------
        RefineError
            See `read_splats` and `affine.transformed`; if the files are of different models, or a
            level is asked of files that have none.
        """
        files = self._files()
        asked = self.arrangement
        moves = asked.moves or (Move(),) * len(files)
        parts = [
            file.splats() if move == Move() else transformed(file.splats(), move.matrix)
            for file, move in zip(files, moves, strict=True)
        ]
        splats = joined(parts)
        if asked.degree is not None:
            splats = splats.up_to_degree(asked.degree)
        if asked.morton:
            splats = splats.take(_curve(splats.means))
        stored_bytes = sum(file.stored_bytes for file in files)
        file, copied = new_file(
            files[0].path, Origin("arranged", stored_bytes), len(splats), splats.sh_degree,
            splats.model,
        )  # fmt: skip
        with np.errstate(over="ignore", under="ignore", invalid="ignore"):  # doubles to float32
            for name in ARRAYS:
                getattr(copied, name)[:] = getattr(splats, name)
        file = file.without_third_scale()
        return Loaded(
            name=" + ".join(str(file.path) for file in files),
            bytes=stored_bytes,
            splats=file.splats(),
            forced=FREE,
            sizes=RowSizes.of(file, form),
            stored=file.rows,
            file=lambda: file,
            matrix=np.eye(4),
            notes=_notes(files),
        )

    def _files(self) -> list[SplatFile]:
        """Return the files."""
        paths = [expanded(path) for path in self.paths]
        streamed = [path.name.lower().endswith(INDEX) for path in paths]
        level = self.arrangement.level
        files = [
            read_splats(path, self.model, level if has_levels or not any(streamed) else 0)
            for path, has_levels in zip(paths, streamed, strict=True)
        ]
        for file in files:
            if file.model != files[0].model:
                raise RefineError(
                    f"{file.path}: its splats are {file.model}, those of {files[0].path} "
                    f"{files[0].model}; expected one model, or say which (--model)"
                )
        return files


def _curve(means: NDArray[Any]) -> NDArray[np.int64]:
    """Return the order of positions (N, 3) along the curve; those that are not finite come last."""
    finite = np.isfinite(means).all(axis=1)
    rows = np.flatnonzero(finite)
    rest = np.flatnonzero(~finite)
    return np.concatenate([rows[near_ones_together(means[rows])], rest]) if len(rows) else rest


def _notes(files: Sequence[SplatFile]) -> tuple[str, ...]:
    """How files were read, and which of their properties go, in sentences."""
    more = {name for file in files for name in other_properties(file.rows.dtype.names or ())}
    names = ", ".join(sorted(more))
    said = [remark for file in files for remark in file.remarks]
    return (*said, *([f"splats are written anew, without {names}"] if more else []))


def convert_files(
    sources: Sequence[Path | str],
    output: Path | str,
    request: ConvertRequest,
    arrangement: Arrangement | None = None,
) -> Kept:
    """Write the splats of files to another, in the format that its suffix names.

    A single file of which nothing else is asked stays what it is, every property of a PLY included.

    Parameters
    ----------
    sources : sequence of path-like
        Of any format (`read_splats`), one at least.
    output : path-like
    request : ConvertRequest
    arrangement : Arrangement, optional
        What becomes of the splats besides; by default all are merged as they are.

    Raises
    ------
    RefineError
        See `ArrangedSource`, `FileSource` and `FileSink`.

    Examples
    --------
    To put a statue into a room, half a unit above::

        moves = (Move(), Move(translate=(0.0, -0.5, 0.0)))
        convert_files(["room.ply", "statue.spz"], "both.sog", ConvertRequest(), Arrangement(moves))
    """
    asked = arrangement or Arrangement()
    target = expanded(output)
    if len(sources) == 1 and asked == Arrangement():
        return file_to_file(sources[0], target, request)
    read = ArrangedSource(tuple(sources), asked, request.model)
    return run(read, request, FileSink(target, overwrite=request.overwrite))
