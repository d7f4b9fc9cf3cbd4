"""The result of a prune: which splats stay, what they became, and how it is written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .affine import transformed
from .errors import RefineError
from .execute import Cancelled
from .formats.format import new_file
from .formats.ply import Origin as FileOrigin
from .formats.ply import SplatFile
from .formats.ply_columns import ChangedColumns
from .formats.registry import write_splats
from .merging.merge import Merged
from .scores import Scores
from .splats import ARRAYS, Splats, among_all
from .visibility.cast import RaySample


@dataclass(frozen=True, eq=False)
class Origin:
    """What splats were before an earlier prune merged and refitted them.

    Attributes
    ----------
    splats : Splats
        As they were.
    ray_sample, between : RaySample or None
        What the views, and views between these, saw of them: the estimated PSNR is against that.
    psnr : float or None
        The estimated PSNR that is left, dB.
    """

    splats: Splats
    ray_sample: RaySample | None
    between: RaySample | None
    psnr: float | None


@dataclass(frozen=True, eq=False, repr=False)
class Result:
    """What was decided of N splats.

    Attributes
    ----------
    keep : (N,) bool
        Which splats stay: K of them.
    report : dict
        Counts, settings, what decided, times and versions, ready for JSON.
    scores : Scores or None
        Those that decided; of those that stay they may tell less, see `Scores.settled`.
    merged : Merged or None
        The kept splats as they became; None if all are what they were.
    stopped : Cancelled or KeyboardInterrupt or None
        What ended refitting before it was done: the result is what it had reached by then.
    source : SplatFile or Splats or None
        What was decided on.
    columns : dict of str to (N,)
        Properties that are written otherwise than they are stored.
    matrix : (4, 4) float64 or None
        From the frame of the file to that of the views, where these differ.
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
        """The kept splats as they became, in the frame of the views."""
        if self.merged is not None:
            return self.merged.splats
        return self.all_splats().take(self.keep)

    def all_splats(self) -> Splats:
        """All splats as they were; raises `RefineError` if only their scores were known."""
        if self.source is None:
            raise RefineError("only scores were known: there are no splats to return")
        return self.source.splats() if isinstance(self.source, SplatFile) else self.source

    def for_all(self, rest: NDArray[np.bool_]) -> Result:
        """The result for what was left of N splats, (N,) bool, as one for them all."""
        keep = among_all(self.keep, rest)
        total, kept = len(keep), int(np.count_nonzero(keep))
        self.report["splats"] |= {"before": total, "kept": kept, "removed": total - kept}
        return replace(
            self,
            keep=keep,
            scores=None if self.scores is None else self.scores.for_all(rest),
            merged=None if self.merged is None else replace(self.merged, keep=keep),
        )

    def write(
        self, path: Path | str, *, overwrite: bool = False, threads: int | None = None
    ) -> None:
        """Write the kept splats in the format that the suffix of `path` names.

        Rows that did not change are equal to those of the source file, to the bit where the format
        holds them so.

        Raises
        ------
        RefineError
            If the file cannot be written, or exists and may not be replaced; nothing is left then.
        """
        file = self.source
        if not isinstance(file, SplatFile):
            file = file_of(self.all_splats())
        columns = self.changed(file.rows)
        write_splats(path, file, self.keep, columns=columns, overwrite=overwrite, threads=threads)

    def changed(self, stored: Any) -> Mapping[str, NDArray[Any]]:
        """Stored columns with what kept splats became; none if nothing changed.

        Parameters
        ----------
        stored : mapping of str to (N,), or structured array
            All properties of the N splats, such as `SplatFile.rows`; not changed.

        Returns
        -------
        mapping of str to (N,)
            The properties that make a splat, each in its stored type, rounded once. Rows of all
            other splats are equal to the stored ones to the bit.
        """
        merged = self.merged
        if merged is None:
            return self.columns
        changed = np.flatnonzero(merged.changed)
        splats = merged.splats.take(changed)
        if self.matrix is not None and not np.array_equal(self.matrix, np.eye(4)):
            splats = transformed(splats, np.linalg.inv(self.matrix))
        return ChangedColumns(stored, np.flatnonzero(merged.keep)[changed], splats)


def file_of(splats: Splats, path: Path = Path("splats.ply"), stored_bytes: int = 0) -> SplatFile:
    """A file in memory that holds splats which came from none, or from several."""
    file, copied = new_file(
        path, FileOrigin("arranged", stored_bytes), len(splats), splats.sh_degree, splats.model
    )
    with np.errstate(over="ignore", under="ignore", invalid="ignore"):  # doubles to float32
        for name in ARRAYS:
            getattr(copied, name)[:] = getattr(splats, name)
    return file.without_third_scale()
