"""Measure all views of a scene in a Blender, and tell where that happened."""

from __future__ import annotations

import importlib
import sys

from extension import MODULE, enable


def main(cloud: str, cameras: str) -> dict[str, object]:
    """Score by occlusion; return how many processes did it, and Blender's Python."""
    enable()
    core = importlib.import_module(f"{MODULE}.core")
    processes = importlib.import_module(f"{MODULE}.core.execute")
    core.score(
        core.read_ply(cloud).splats(),
        core.read_cameras(cameras),
        core.Occlusion(),
        threads=2,
    )
    found = len(processes._idle)
    processes.end_idle()
    return {"processes": found, "python": sys.executable}
