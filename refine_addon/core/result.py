"""The result of a prune: kept splats, their new values, and how it is written."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .affine import transformed
from .errors import RefineError
from .execute import Cancelled
from .formats.format import new_file
from .formats.ply import SplatFile
from .formats.ply_columns import Changed, Changes, values_by_name
from .formats.registry import write_splats
from .merging.merge import Merged
from .report import kept_and_removed
from .scores import Scores
from .splats import Splats, among_all


class Origin(NamedTuple):
    """Splats as they were before an earlier prune, which merged them."""

    splats: Splats
    scores: Scores  # of them, with the rays by which results are compared
    psnr: float | None = None  # estimated PSNR of the earlier result, dB


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """Which of N splats are kept, and their new values.

    Attributes
    ----------
    keep : (N,) bool, which splats are kept
    report : dict, ready for JSON; see docs/report.md
    scores : Scores, optional; those that decided; of kept splats they may not be in final order
    merged : Merged, optional; kept splats with their new values, None if none changed
    stopped : Cancelled or KeyboardInterrupt, optional; it ended refitting after some rounds
    source : SplatFile or Splats, optional; all splats
    columns : dict of str to (N,), values of properties that are written in place of stored ones
    matrix : (4, 4) float64, optional; from the frame of the file to that of the views
    """

    keep: NDArray[np.bool_]
    report: dict[str, Any]
    scores: Scores | None = None
    merged: Merged | None = None
    stopped: Cancelled | KeyboardInterrupt | None = None
    source: SplatFile | Splats | None = None
    columns: dict[str, NDArray[Any]] = field(default_factory=dict)
    matrix: NDArray[np.float64] | None = None

    def __repr__(self) -> str:
        kept, psnr = int(np.count_nonzero(self.keep)), self.report.get("estimated_psnr")
        done = self.report["method"]["done"] if "method" in self.report else "kept"
        close = "" if psnr is None else f", {psnr:.1f} dB"
        return f"<Result: {kept:,} of {len(self.keep):,} splats kept, {done}{close}>"

    @property
    def splats(self) -> Splats:
        """The kept splats with their new values, in the frame of the views."""
        return self.all_splats().take(self.keep) if self.merged is None else self.merged.splats

    def all_splats(self) -> Splats:
        """All splats as they were; `RefineError` if only scores were given."""
        if self.source is None:
            raise RefineError("only scores were given: there are no splats to return")
        return self.source.splats() if isinstance(self.source, SplatFile) else self.source

    def for_all(self, rest: NDArray[np.bool_]) -> Result:
        """Result for all N splats, from this for those in `rest`, (N,) bool; others are removed."""
        keep = among_all(self.keep, rest)
        self.report["splats"] |= kept_and_removed(keep)
        return replace(
            self,
            keep=keep,
            scores=None if self.scores is None else self.scores.for_all(rest),
            merged=None if self.merged is None else replace(self.merged, keep=keep),
        )

    def write(
        self, path: Path | str, *, overwrite: bool = False, threads: int | None = None
    ) -> None:
        """Write the kept splats in the format that the suffix of `path` names, whole or not at all.

        Unchanged rows equal those of the source file, to the bit if the format can hold them.
        `RefineError`: see `write_splats`.
        """
        file = self.source
        if not isinstance(file, SplatFile):
            file = file_of(self.all_splats())
        columns = self.changed()
        write_splats(path, file, self.keep, columns=columns, overwrite=overwrite, threads=threads)

    def changed(self) -> Changes:
        """Properties with new values, in the frame of the file; all other rows stay to the bit."""
        merged = self.merged
        if merged is None:
            return self.columns
        changed = np.flatnonzero(merged.changed)
        splats = merged.splats.take(changed)
        if self.matrix is not None and not np.array_equal(self.matrix, np.eye(4)):
            splats = transformed(splats, np.linalg.inv(self.matrix))
        return Changed(np.flatnonzero(merged.keep)[changed], values_by_name(splats))


def file_of(splats: Splats, path: Path = Path("splats.ply"), stored_bytes: int = 0) -> SplatFile:
    """A plain PLY in memory, with `path` as its name, of splats that are not of one file."""
    read, degree = ("arranged", stored_bytes), splats.sh_degree
    file = new_file(path, read, len(splats), degree, [splats], splats.model)
    return file.without_third_scale()
