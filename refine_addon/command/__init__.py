"""The command: ``blender -b [scene.blend] --command refine ...``, ``python -m refine_addon ...``.

Both parse the same arguments and run the same pipeline. Only ``--object`` and the open scene
(`scene`) need Blender; they are imported where they are used.

In the order in which they work: `signals` listens for Ctrl-C, `flow` goes from arguments to exit
code, `options` parses, `checks` refuses what cannot go together, `subcommands` does the rest. That
goes from input to input by `run`; `report` writes down what was done. `terminal` prints.
"""

from __future__ import annotations

from collections.abc import Sequence

from .signals import listening, reason_and_code  # and nothing that loads NumPy, see `listening`


def main(arguments: Sequence[str], *, scene: bool = False, last: bool = False) -> int:
    """Run the command.

    Parameters
    ----------
    arguments : sequence of str
        What stands behind ``refine`` on the command line.
    scene : bool
        Whether this runs in Blender, whose open scene has objects and cameras.
    last : bool
        Whether the process ends after this: signals come too late then, and are ignored.

    Returns
    -------
    int
        Exit code: 0 done, 1 failed on an input, 2 wrong usage; 128 and the signal's number where
        one stopped it, 130 for Ctrl-C.
    """
    with listening(last=last) as raise_now:
        try:
            # Loads all of core, and with it NumPy: a signal waits until that is there.
            from ..core.execute import share_heap
            from . import flow

            if last:
                share_heap()
            raise_now()
            return flow.run(arguments, scene=scene)
        except KeyboardInterrupt as stop:
            from .terminal import complain

            reason, code = reason_and_code(stop)
            told = "".join(f" {note};" for note in getattr(stop, "__notes__", ()))
            complain(f"{reason};{told} nothing was left half-written")
            return code
