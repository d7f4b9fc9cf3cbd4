"""Whether Blender opened the .blend of its command line. Needs Blender."""

from __future__ import annotations

import sys
from collections.abc import Sequence

import bpy

from ..core import RefineError

_COMMAND = ("-c", "--command")


def check(words: Sequence[str] | None = None) -> None:
    """Refuse to go on without the file: Blender does, with an empty scene.

    Parameters
    ----------
    words : sequence of str, optional
        Blender's command line, by default that of this process.

    Raises
    ------
    RefineError
        If a .blend was named before the command and is not open.
    """
    words = sys.argv if words is None else words
    starts = (place for place, word in enumerate(words) if word in _COMMAND)
    named = [word for word in words[1 : next(starts, 0)] if word.lower().endswith(".blend")]
    if named and not bpy.data.filepath:
        raise RefineError(f"{named[-1]}: Blender could not open it, and says why above")
