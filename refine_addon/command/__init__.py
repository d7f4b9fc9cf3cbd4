"""The command: ``blender -b [scene.blend] --command refine ...``, ``python -m refine_addon ...``.

Both parse the same arguments and run the same pipeline. Only ``--object``, and the cameras of an
open scene (`scene_cameras`), need Blender; they are imported where they are used.

In the order in which they work: `signals` listens for Ctrl-C, `flow` goes from arguments to exit
code, `options` parses, `checks` refuses what cannot go together, `runs` calls the module of the
subcommand, such as `prune`. That goes from input to input by `run`; `report` writes down what was
done. `terminal` is all that prints, in `words` where several subcommands say the same.
"""

from __future__ import annotations

from collections.abc import Sequence

from .signals import Listener, exit_code, reason  # and nothing that loads NumPy, see `Listener`


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
    with Listener(last=last) as listener:
        try:
            # Loads all of core, and with it NumPy: a signal waits until that is there.
            from ..core.execute import share_heap
            from . import flow

            if last:
                share_heap()
            listener.interrupt()
            code = flow.run(arguments, scene=scene)
            listener.wait()
        except KeyboardInterrupt as stop:
            listener.wait()
            from .terminal import complain

            told = "".join(f" {note};" for note in getattr(stop, "__notes__", ()))
            complain(f"{reason(stop)};{told} nothing was left half-written")
            return exit_code(stop)
    return code
