"""What ``convert`` does and says."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..core import convert_files
from .options import arrangement
from .run import Run
from .words import sizes, written


def convert(run: Run) -> None:
    """Convert the inputs to one file."""
    sources = run.options.inputs
    name = " + ".join(map(str, sources))
    run.attempt(str(sources[0]), lambda: _convert(run, sources, name))


def _convert(run: Run, sources: Sequence[Path], source: str) -> dict[str, Any]:
    output = run.options.output
    done = convert_files(
        sources, output, **arrangement(run.options),
        model=run.options.model, overwrite=run.options.overwrite,
    ).report  # fmt: skip
    splats, files = done["splats"], done["files"]
    size = sizes(files["input_bytes"], files["output_bytes"])
    run.terminal.say(f"{source}: {splats['before']:,} splats{written(splats)}, {size} -> {output}")
    run.terminal.notes(done["notes"])
    return done
