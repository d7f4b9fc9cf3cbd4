"""The report: what was done, as JSON, for programs."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ..core import RefineError
from ..core.errors import reason_of
from ..core.whole_file import refuse_existing, whole_file
from ..version import VERSION


def check(path: Path, *, overwrite: bool) -> None:
    """Refuse a report that could not be written, before the work."""
    refuse_existing(path, overwrite=overwrite)
    try:
        # A link stays one: what it points to is written.
        with tempfile.TemporaryFile(dir=os.path.dirname(os.path.realpath(path))):
            pass
    except OSError as error:
        raise RefineError(
            f"{path}: cannot be written ({reason_of(error)}); nothing was changed"
        ) from error


def write(path: Path, results: list[Any], seconds: float, overwrite: bool, splats: bool) -> None:
    """Write the report of all results; an error says whether `splats` were written."""
    content = {
        "refine": VERSION,  # first: by this a report is known, see `is_report`
        "python": sys.version.split()[0],
        "numpy": np.__version__,
        "seconds": seconds,
        "results": results,
    }
    try:
        with whole_file(path, overwrite=overwrite) as stream:
            stream.write(json.dumps(content, indent=2, allow_nan=False).encode() + b"\n")
    except RefineError as error:
        # What `whole_file` says of "nothing" holds for its own file alone.
        cause = error.__cause__
        why = reason_of(cause if isinstance(cause, OSError) else error).removeprefix(f"{path}: ")
        done = "; the splats were" if splats else ""
        raise RefineError(f"{path}: the report was not written ({why}){done}") from error


def is_report(beginning: bytes) -> bool:
    """Whether a file that begins like this is a report, or empty: safe to replace."""
    words = beginning.split()
    return not words or b"".join(words).startswith(b'{"refine":')
