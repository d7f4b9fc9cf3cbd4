"""The splats of a source in memory, with what they are rows of."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..formats.format import Format
from ..formats.ply import SplatFile
from ..formats.ply_columns import Columns
from ..formats.registry import row_sizes
from ..merging.merge import Merged
from ..splats import Splats
from ..survivors import survivor_columns
from ..volumes import Forced


@dataclass(frozen=True, eq=False)
class RowSizes:
    """How many bytes splats take in a file.

    Attributes
    ----------
    row : float
        Of one splat.
    fixed : int
        Of everything else in the file.
    """

    row: float
    fixed: int

    @classmethod
    def of(cls, file: SplatFile, form: Format | None) -> RowSizes:
        """Return those of a file's splats in a format; None is plain PLY."""
        return cls(*row_sizes(file, form))


@dataclass(frozen=True, eq=False)
class Loaded:
    """Splats of a source.

    Attributes
    ----------
    name : str
        What the report calls the source.
    bytes : int
        Its size.
    splats : Splats
        The N splats, in the frame of the views.
    forced : Forced
        Which of them must stay, and which must go.
    sizes : RowSizes
        In the format of the output.
    stored : mapping of str to (N,), or structured array
        The properties of the splats, in the frame of the source.
    file : callable
        Returns the source as the file that is written, in the frame of the source.
    matrix : (4, 4) float64
        From that frame to that of the views.
    notes : tuple of str
        What the user should know about the source, in sentences.
    reusable : bool
        Whether the scores are kept for other budgets; see `Task`.
    """

    name: str
    bytes: int
    splats: Splats
    forced: Forced
    sizes: RowSizes
    stored: Columns | NDArray[Any]
    file: Callable[[], SplatFile]
    matrix: NDArray[np.float64]
    notes: tuple[str, ...] = ()
    reusable: bool = False

    @property
    def volumes(self) -> list[dict[str, Any]]:
        """What the report says of the volumes that force splats to stay and go."""
        return list(self.forced.facts)

    def take(self, rows: NDArray[np.bool_]) -> Loaded:
        """Return what decides on some of the splats, (N,) bool; `stored` and `file` stay whole."""
        return replace(self, splats=self.splats.take(rows), forced=self.forced.of(rows))

    def columns(self, absorbed: Merged | None) -> Mapping[str, NDArray[Any]]:
        """Return the stored properties with what survivors became; none if they did not change."""
        return survivor_columns(self.stored, absorbed, np.linalg.inv(self.matrix))
