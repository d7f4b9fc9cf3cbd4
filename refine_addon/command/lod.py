"""What ``lod`` does and says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..core import ViewSet, lod_file
from ..core.formats.registry import SUFFIXES
from ..core.quality.curve import in_words
from ..core.report import size_in_words
from .options import levels, method
from .run import Run
from .words import by
from .zones import of_files


def lod(run: Run) -> None:
    """Make levels of detail of the input."""
    views, source = run.views(), run.options.inputs[0]
    run.attempt(str(source), lambda: _make_levels(run, source, views))


def _make_levels(run: Run, source: Path, views: ViewSet) -> dict[str, Any]:
    options, terminal = run.options, run.terminal
    done = lod_file(
        source, options.output_dir, views, levels(options), method(options),
        zones=of_files(options), suffix=options.format or SUFFIXES[0], model=options.model,
        overwrite=options.overwrite, progress=run.progress(source.name),
    )  # fmt: skip
    terminal.clear()
    count, number = done["splats"]["before"], len(done["levels"])
    terminal.say(
        f"{source}: {number} level{'s' if number > 1 else ''} of {count:,} splats, "
        f"{by(done['views'])}, {done['timings']['total_s']:.2f} s -> {options.output_dir}"
    )
    run.say_what_decided(done)
    for entry in done["levels"]:
        terminal.say(f"  {_in_words(entry)}")
    terminal.notes(done["notes"])
    return done


def _in_words(entry: dict[str, Any]) -> str:
    """Return what there is to know of a level, on one line."""
    parts = [f"{entry['splats']:,} splats", size_in_words(entry["bytes"])]
    if entry["psnr"] is not None:
        parts.append(in_words(entry["psnr"]))
    return f"{entry['file']}: {', '.join(parts)}"
