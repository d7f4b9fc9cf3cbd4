"""How long files of other formats take to write and to read, beside splat-transform.

    python -m benchmarks.speed.formats [--splats 1000000] [--runs 3] [--formats .splat .spz]

The input is that of `file_to_file`, of degree 3. Written is from that PLY to the format, read is
from our file of the format to a PLY. All are processes of their own, interpreter start included,
which take turns, with the input in the page cache. Seconds of the processor, of all cores together,
tell what a busy machine hides. splat-transform reads no GLB, and writes .sog with harmonics for
many minutes: --degree 0 leaves them out.
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from refine_addon.core.formats.registry import FORMATS

from ..baselines import splat_transform
from .file_to_file import make_input

ROOT = Path(__file__).parents[2]
TARGET = 1.5
"""Ours takes at most this many times as long as splat-transform."""


def timed(order: list[str]) -> tuple[float, float]:
    """Run a command; return its seconds by the clock and of the processor."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    subprocess.run(order, check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
    wall = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime - before.ru_utime + after.ru_stime - before.ru_stime
    return wall, spent


def compare(source: Path, target: Path, theirs: list[str] | None, runs: int) -> str:
    """Return a row of the table: seconds of each, and their ratio of the processor's seconds."""
    ours = [sys.executable, "-m", "refine_addon", "convert", "--quiet", "--overwrite"]
    spent: tuple[list[tuple[float, float]], ...] = ([], [])
    for _ in range(runs):
        if theirs is not None:  # theirs first, so that ours is what stays
            spent[1].append(timed([*theirs, "-g", "cpu", "-q", "-w", str(source), str(target)]))
        spent[0].append(timed([*ours, str(source), str(target)]))
    wall, cpu = (statistics.median(run[part] for run in spent[0]) for part in (0, 1))
    row = f"{wall:7.2f} s {cpu:7.2f} s"
    if theirs is None:
        return row
    other_wall, other = (statistics.median(run[part] for run in spent[1]) for part in (0, 1))
    word = "met" if wall <= TARGET * other_wall else "MISSED"
    return (
        f"{row} {other_wall:7.2f} s {other:7.2f} s   {wall / other_wall:5.2f} {cpu / other:5.2f}  "
        f"{word} (at most {TARGET})"
    )


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Time files of other formats.")
    parser.add_argument("--splats", type=int, default=1_000_000)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--formats", nargs="+", default=[form.suffix for form in FORMATS])
    parser.add_argument("--degree", type=int, default=3, choices=range(4), help="of the input")
    options = parser.parse_args()
    theirs = splat_transform.find()
    print(f"splat-transform {splat_transform.version() or 'is not installed'}")
    print("                        ours: clock, processor   theirs: the same    ratios")
    with tempfile.TemporaryDirectory() as folder:
        plain, back = Path(folder) / "in.ply", Path(folder) / "back.ply"
        make_input(plain, options.splats)
        if options.degree < 3:
            whole, plain = plain, Path(folder) / "short.ply"
            if theirs is None:
                parser.error(f"--degree needs splat-transform: {splat_transform.MISSING}")
            order = [*theirs, "-q", "-w", str(whole), "-H", str(options.degree), str(plain)]
            subprocess.run(order, check=True)
        for suffix in options.formats:
            made = Path(folder) / f"made{suffix}"
            print(f"{suffix:18} write {compare(plain, made, theirs, options.runs)}", flush=True)
            reader = None if suffix == ".glb" else theirs
            print(f"{suffix:18} read  {compare(made, back, reader, options.runs)}", flush=True)
            print(f"{suffix:18} {made.stat().st_size / 1e6:.1f} MB")
            made.unlink()
    return 0


if __name__ == "__main__":
    sys.exit(main())
