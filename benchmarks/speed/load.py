"""Much at once: ten million splats, two thousand files, five hundred cameras.

    python -m benchmarks.speed.load

Prints seconds and peak memory of each; `file_to_file` does the same for one file of usual size.
"""

from __future__ import annotations

import json
import shutil
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from refine_addon.command import main as refine

from .file_to_file import ROOM, make_input, run

LARGE = 10_000_000
FILES = 2_000
CAMERAS = 500


def large(folder: Path) -> None:
    """Prune ten million splats of degree 3, file to file, in a process of its own."""
    source, output = folder / "in.ply", folder / "out.ply"
    make_input(source, LARGE)
    command = [sys.executable, "-m", "refine_addon", "prune", source, "-o", output]
    command += ["--method", "closed-form"]
    took, busy, peak = run([*command, "--cameras", ROOM / "cameras.json"])
    size = source.stat().st_size / 1e9
    print(f"{LARGE:,} splats, {size:.2f} GB: {took:.1f} s ({busy:.1f} of the processor), ", end="")
    print(f"peak {peak / 1000:.2f} GB beyond the page cache; target at most 3")


def batch(folder: Path) -> None:
    """Prune two thousand files in one process; memory and open files must not grow."""
    source = folder / "source.ply"
    make_input(source, 500)
    inputs = [folder / f"{index:04}.ply" for index in range(FILES)]
    for path in inputs:
        shutil.copyfile(source, path)
    common = ["--method", "closed-form", "--cameras", str(ROOM / "cameras.json")]
    common += ["--overwrite", "--quiet"]
    used = []
    start = time.perf_counter()
    for part in (inputs[:100], inputs):  # the first hundred fill what stays
        names = [str(path) for path in part]
        assert refine(["prune", *names, "-o", str(folder / "out"), *common]) == 0
        used.append((_resident(), len(list(Path("/proc/self/fd").iterdir()))))
    seconds = time.perf_counter() - start
    (before, open_before), (after, open_after) = used
    print(
        f"{FILES:,} files in one batch: {seconds:.1f} s, memory {before:.0f} -> {after:.0f} MB, ",
        end="",
    )
    print(f"open files {open_before} -> {open_after}")


def _resident() -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return sum(int(line.split()[1]) / 1000 for line in lines if line.startswith("RssAnon:"))


def cameras(folder: Path) -> None:
    """Score a million splats by five hundred cameras, all of them."""
    source, path = folder / "in.ply", folder / "cameras.json"
    make_input(source, 1_000_000)
    given = json.loads((ROOM / "cameras.json").read_text())
    random = np.random.default_rng(0)
    many = []
    for index in range(CAMERAS):
        camera = dict(given[index % len(given)], id=index, img_name=str(index))
        camera["position"] = (np.array(camera["position"]) + random.normal(0, 0.1, 3)).tolist()
        many.append(camera)
    path.write_text(json.dumps(many))
    command = [sys.executable, "-m", "refine_addon", "prune", source, "--dry-run", "--views", "0"]
    command += ["--method", "closed-form"]
    took, busy, peak = run([*command, "--cameras", path])
    print(
        f"1,000,000 splats by {CAMERAS} cameras: {took:.1f} s ({busy:.1f} of the processor), ",
        end="",
    )
    print(f"peak {peak:.0f} MB beyond the page cache")


def main() -> None:
    """Print the measurements."""
    for measure in (large, batch, cameras):
        with tempfile.TemporaryDirectory() as folder:
            measure(Path(folder))


if __name__ == "__main__":
    main()
