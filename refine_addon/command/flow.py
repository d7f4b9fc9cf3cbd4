"""From the arguments to the exit code."""

from __future__ import annotations

from collections.abc import Sequence

from ..core import RefineError
from . import checks, options, report
from .run import Run
from .subcommands import run_subcommand
from .terminal import complain, described, flush


def run(arguments: Sequence[str], *, scene: bool) -> int:
    """Parse, check and run; exit code as of `refine_addon.command.main`."""
    parser = options.make_parser()
    try:
        given = parser.parse_args(list(arguments))
        given.scene, given.blend = scene, ""
        if scene:
            from .scene import opened

            given.blend = opened()
        try:
            options.complete(given)
            checks.check(given)
        except RefineError as error:
            parser.error(str(error))
        if given.report is not None:
            report.check(given.report, overwrite=given.overwrite)
        work = Run(given)
        run_subcommand(work)
        return int(work.finish())
    except SystemExit as leaving:  # argparse leaves the process; Blender wants a number
        flush()
        return int(leaving.code or 0)
    except (RefineError, OSError, MemoryError) as error:
        complain(described(error))
    return 1
