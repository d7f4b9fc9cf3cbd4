"""What ``score`` does and says."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..core import ViewSet, score_file
from . import zones
from .options import method
from .run import Run
from .words import by_method


def score(run: Run) -> None:
    """Score the input, or an object."""
    options = run.options
    if options.object:
        run.attempt(options.object, lambda: _score_object(run))
        return
    views, source = run.views(), options.inputs[0]
    run.attempt(str(source), lambda: _score_file(run, source, views))


def _score_file(run: Run, source: Path, views: ViewSet) -> dict[str, Any]:
    options = run.options
    done = score_file(
        source, options.output, views, method(options), zones=zones.of_files(options),
        model=options.model, overwrite=options.overwrite, progress=run.progress(source.name),
    ).report  # fmt: skip
    return _said(run, str(source), done)


def _score_object(run: Run) -> dict[str, Any]:
    from ..objects.operation import score_object

    options, name = run.options, run.options.object
    done = score_object(
        name, run.views(), method(options), zones.of_object(options),
        output=options.output, overwrite=options.overwrite, progress=run.progress(name),
    )  # fmt: skip
    return _said(run, name, done)


def _said(run: Run, label: str, done: dict[str, Any]) -> dict[str, Any]:
    """Say what was done, and return the report of it."""
    run.terminal.clear()
    splats = done["splats"]
    run.terminal.say(
        f"{label}: scored {splats['before']:,} splats by {done['views']['used']} views "
        f"-> {run.options.output}"
    )
    run.say_what_decided(done)
    for price in done["prices"]:
        ways = by_method(price)
        run.terminal.say(f"  {price['removed']:.0%} removed: {ways}")
    run.terminal.notes(done["notes"])
    return done
