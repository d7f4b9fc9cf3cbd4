"""The views that decide: of a camera file, or of the open scene."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..core import read_cameras

if TYPE_CHECKING:
    import argparse

    from ..core import ViewSet


def deciding(options: argparse.Namespace) -> tuple[ViewSet, dict[str, Any]]:
    """Return the views that decide, and what the report says of them.

    Raises
    ------
    RefineError
        If they cannot be read; and see `scene_cameras.chosen`.
    """
    path = options.cameras
    if path is not None:
        return read_cameras(path), {"source": "file", "file": str(path)}
    from . import scene_cameras  # noqa: PLC0415 - needs Blender

    return scene_cameras.chosen(options)
