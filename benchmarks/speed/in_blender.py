"""What Blender adds: import against its own importer, and deleting half of many splats.

    python -m benchmarks.speed.in_blender [--runs 5]

In Blender as a module. Importers take turns on the same file in one process, each time into an
empty scene; Blender's own stores the same attributes, so the work is the same.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import tempfile
import time
from pathlib import Path

import numpy as np

# Before bpy is imported, so that nobody's own Blender settings are read or written.
os.environ["BLENDER_USER_RESOURCES"] = tempfile.mkdtemp(prefix="refine-bench-")

from collections.abc import Callable, Sequence

import bpy

import refine_addon
from refine_addon.core import read_ply
from refine_addon.mesh import attributes as mesh_attributes
from refine_addon.mesh import edit as mesh_edit

from .file_to_file import make_input

IMPORTED = 1_000_000
DELETED = 3_000_000


def seconds(work: Callable[[], object]) -> float:
    """Return how long `work` takes in an empty scene."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def compare_imports(path: Path, runs: int) -> None:
    """Print medians of both importers, run in turn, one of each not counted."""
    importers = {
        "refine.import_ply": lambda: bpy.ops.refine.import_ply(filepath=str(path)),
        "wm.ply_import": lambda: bpy.ops.wm.ply_import(filepath=str(path), import_attributes=True),
    }
    times: dict[str, list[float]] = {name: [] for name in importers}
    for _ in range(runs + 1):
        for name, work in importers.items():
            times[name].append(seconds(work))
    for name, values in times.items():
        print(f"  {name:18} {statistics.median(values[1:]):6.2f} s")


def delete_half(path: Path) -> float:
    """Return the seconds that deleting every second splat takes; reading it does not count."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    mesh = mesh_attributes.mesh_from_file(read_ply(path))
    obj = bpy.data.objects.new("splats", mesh)
    bpy.context.collection.objects.link(obj)
    remove = np.zeros(len(mesh.vertices), np.bool_)
    remove[::2] = True
    start = time.perf_counter()
    mesh_edit.delete_vertices(obj, remove)
    return time.perf_counter() - start


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the measurements."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=5)
    runs = parser.parse_args(arguments).runs
    refine_addon.register()
    print(f"Blender {bpy.app.version_string}, medians of {runs} runs")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "splats.ply"
        make_input(path, IMPORTED)
        print(f"\nimport of {IMPORTED:,} splats, degree 3")
        compare_imports(path, runs)
        make_input(path, DELETED)
        print(f"\ndeleting half of {DELETED:,} splats with all attributes")
        print(f"  {statistics.median(delete_half(path) for _ in range(runs)):6.2f} s")
    refine_addon.unregister()
    shutil.rmtree(os.environ["BLENDER_USER_RESOURCES"], ignore_errors=True)


if __name__ == "__main__":
    main()
