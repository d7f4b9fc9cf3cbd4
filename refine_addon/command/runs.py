"""From checked options to what a subcommand does."""

from __future__ import annotations

import argparse

from . import report
from .clean import clean
from .convert import convert
from .info import info
from .lod import lod
from .prune import prune
from .run import Run
from .score import score


def _render(run: Run) -> None:
    from .render import render

    render(run)


SUBCOMMANDS = {
    "prune": prune,
    "score": score,
    "clean": clean,
    "lod": lod,
    "convert": convert,
    "info": info,
    "render": _render,
}


def execute(options: argparse.Namespace) -> bool:
    """Do what the options say; return whether all of it went well.

    Raises
    ------
    RefineError
        If cameras cannot be read, or a folder or the report not be written; what is wrong with one
        input is said, and noted in the report.
    """
    if options.report is not None:
        report.check(options.report, overwrite=options.overwrite)
    run = Run(options)
    SUBCOMMANDS[options.command](run)
    run.finish()
    return not run.failed
