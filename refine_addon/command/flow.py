"""From the arguments to the exit code."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from ..core import RefineError
from . import checks, runs
from .options import make_parser
from .terminal import complain, described, flush

DONE, FAILED, USAGE = 0, 1, 2
"""Exit codes: done, failed on an input, wrong usage."""


def run(arguments: Sequence[str], *, scene: bool) -> int:
    """Parse the arguments, check them, do what they say.

    Parameters
    ----------
    arguments, scene
        See `refine_addon.command.main`.

    Returns
    -------
    int
        Exit code: `DONE`, `FAILED` or `USAGE`.
    """
    parser = make_parser()
    try:
        options = parser.parse_args(list(arguments), argparse.Namespace(scene=scene))
        if scene:
            from . import open_blend

            open_blend.check()
        checks.check(parser, options)
        return DONE if runs.execute(options) else FAILED
    except SystemExit as leaving:  # argparse leaves the process; Blender wants a number
        flush()
        return int(leaving.code or DONE)
    except RefineError as error:
        complain(str(error))
    except (OSError, MemoryError) as error:
        complain(described(error))
    return FAILED
