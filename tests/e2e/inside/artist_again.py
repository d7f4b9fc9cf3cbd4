"""Look at the scene that an artist saved, in a process that knows no more, and export it."""

from __future__ import annotations

from collections.abc import Generator
from typing import Any

import bpy
import extension
from artist import Walk


def main(pictures: str, asset: str) -> Generator[float, None, dict[str, Any]]:
    """Do it; return what there is.

    Parameters
    ----------
    pictures
        Folder for a picture of the whole screen.
    asset
        Where to export the splats.

    Yields
    ------
    float
        Seconds to wait.
    """
    yield 1.0
    walk = Walk(pictures)
    walk.found["enabled"] = extension.is_enabled()  # by the preferences of the window before
    yield from walk.seen("20-reopened")
    yield from walk.hand.open_tab()
    yield from walk.look("21-panel")
    walk.found["numbers"] = walk.show.numbers()
    walk.show.call(bpy.ops.refine.export_ply, filepath=asset)
    return walk.found
