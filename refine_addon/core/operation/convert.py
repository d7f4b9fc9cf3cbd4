"""Writing the splats of a file in another format."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..whole_file import expanded
from .files import FileSink, FileSource, Kept
from .run import Request, run

if TYPE_CHECKING:
    from pathlib import Path

    from .loaded import Loaded
    from .run import Runtime


@dataclass(frozen=True)
class ConvertRequest(Request["Loaded", Kept]):
    """That all splats stay."""

    def decide(self, loaded: Loaded, _runtime: Runtime) -> Kept:
        """Return all splats."""
        count = len(loaded.splats)
        return Kept(np.ones(count, np.bool_), {"splats": {"before": count}, "notes": []})


def convert_file(source: Path | str, output: Path | str, *, overwrite: bool = False) -> Kept:
    """Write the splats of a file in the format that the suffix of another names.

    Parameters
    ----------
    source, output : path-like
    overwrite : bool
        Whether a file may be replaced.

    Raises
    ------
    RefineError
        See `run`.
    """
    sink = FileSink(expanded(output), source=expanded(source), overwrite=overwrite)
    return run(FileSource(source), ConvertRequest(), sink)
