"""The command: ``blender -b [scene.blend] --command refine ...``, ``python -m refine_addon ...``.
Both run the same pipeline; only ``--object`` and `scene` need Blender. In order: `signals` listens
for Ctrl-C, `flow` goes from arguments to exit code, `options` parses, `checks` refuses,
`subcommands` works input by input with `run`, `report` records, `terminal` prints."""

from __future__ import annotations

from collections.abc import Sequence

from .signals import listening, reason_and_code  # and nothing that loads NumPy, see `listening`


def main(arguments: Sequence[str], *, scene: bool = False, last: bool = False) -> int:
    """Run the command on the words after ``refine``; exit code 0, 1 failed on an input, 2 usage.
    A signal gives 128 and its number. `scene`: whether an open Blender scene has objects and
    cameras. `last`: the process ends afterwards, so late signals are ignored."""
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
