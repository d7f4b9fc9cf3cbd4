"""What ``clean`` does and says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..core import ViewSet, clean_file
from . import zones
from .options import cleaning
from .run import Run
from .words import by, written


def clean(run: Run) -> None:
    """Clean each input."""
    run.each(_clean)


def _clean(run: Run, source: Path, output: Path | None, views: ViewSet) -> dict[str, Any]:
    options = run.options
    done = clean_file(
        source, output, views, cleaning(options), zones=zones.of_files(options),
        model=options.model, overwrite=options.overwrite, progress=run.progress(source.name),
    ).report  # fmt: skip
    run.terminal.clear()
    splats, to = done["splats"], f" -> {output}" if output else "; nothing is written without -o"
    run.terminal.say(
        f"{run.named(str(source))}: {done['cleaned']['words']}; {splats['kept']:,} of "
        f"{splats['before']:,} splats stay{written(splats)}, {by(done['views'])}{to}"
    )
    run.say_what_decided(done)
    run.terminal.notes(done["notes"])
    return done
