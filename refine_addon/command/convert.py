"""What ``convert`` does and says."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..core import ConvertRequest, file_to_file
from .words import sizes, written

if TYPE_CHECKING:
    from pathlib import Path

    from .run import Run


def convert(run: Run) -> None:
    """Convert the input."""
    source = run.options.inputs[0]
    run.attempt(str(source), lambda: _convert(run, source))


def _convert(run: Run, source: Path) -> dict[str, Any]:
    output = run.options.output
    request = ConvertRequest(run.options.overwrite, run.options.model)
    done = file_to_file(source, output, request).report
    splats, files = done["splats"], done["files"]
    size = sizes(files["input_bytes"], files["output_bytes"])
    run.terminal.say(f"{source}: {splats['before']:,} splats{written(splats)}, {size} -> {output}")
    run.terminal.notes(done["notes"])
    return done
