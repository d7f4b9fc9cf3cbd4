"""How long Blender's window stands still for what an artist clicks: the main thread's part.

    python -m benchmarks.speed.main_thread [--splats 1000000] [--runs 3] [--blender trixie]

Builds the extension, installs it in a real Blender without a window, makes a scene that looks like
a capture (`capture`), of degree 3, and runs all operators on it (tests/e2e/inside/main_thread.py).
Told are, for each and each run, in seconds of the processor, since the clock of a busy machine says
little: the longest stretch of the main thread; the same with what threads did that it may have
waited for, which is the most that the window stands still on a quiet machine, and is what is
compared with the goal; and the sum of all stretches of the main thread. Drawing is not part of it.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from ..tables.million import write_cameras, write_ply
from . import capture

PROJECT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(PROJECT / "tests" / "e2e"), str(PROJECT / ".ci")]

from blenders import BINARIES, Binary, provide

SPLATS = 160_000
GOALS = {160_000: 0.3, 1_000_000: 1.0}
"""Seconds that a stretch may take at most, of up to so many splats."""

PATIENCE = 3600
"""Seconds that a run may take."""

VIEWS = 24
"""Views that score: they take time on the thread alone."""


def goal(splats: int) -> float:
    """Return how long a stretch may take, seconds."""
    return next((goal for count, goal in GOALS.items() if splats <= count), max(GOALS.values()))


def installed(name: str, work: Path) -> Binary:
    """Return one of `BINARIES` with the extension of this checkout, its files in a folder."""
    root, reason = provide(name)
    if root is None:
        raise SystemExit(reason)
    build = [sys.executable, PROJECT / ".ci" / "build_extension.py"]
    archive = Path(subprocess.run(build, capture_output=True, text=True, check=True).stdout.strip())
    resources = work / "resources"
    resources.mkdir()
    blender = Binary(name, root, work, resources, PATIENCE)
    (work / archive.name).write_bytes(archive.read_bytes())
    blender.step("install", archive=work / archive.name)
    return blender


def table(runs: Sequence[dict[str, list[list[float]]]], most: float) -> list[str]:
    """Return the lines of a table: each operator's longest stretch, by turns, and the sum."""
    lines = ["| operator | longest stretch | of all threads | sum | |", "|---|---:|---:|---:|---|"]
    for name in runs[0]:
        stretches = [run[name] for run in runs if run.get(name)]
        longest = [max(own for own, _ in run) for run in stretches]
        waited = [max(whole for _, whole in run) for run in stretches]
        total = [sum(own for own, _ in run) for run in stretches]
        cells = (", ".join(f"{each:.2f}" for each in cell) for cell in (longest, waited, total))
        missed = f"over {most:g} s" if max(waited, default=0.0) > most else ""
        lines.append(f"| {name} | {' | '.join(cells)} | {missed} |")
    return lines


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Time what blocks the window of Blender.")
    parser.add_argument("--splats", type=int, default=SPLATS)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--blender", choices=BINARIES, default=BINARIES[0])
    parser.add_argument("--no-refit", action="store_true", help="minutes less at a million splats")
    options = parser.parse_args(arguments)
    runs = []
    with tempfile.TemporaryDirectory() as made:
        work = Path(made)
        write_ply(work / "capture.ply", capture.make(options.splats))
        write_cameras(work / "cameras.json", capture.cameras())
        blender = installed(options.blender, work)
        for number in range(options.runs):
            refit = not options.no_refit and number == 0
            runs.append(
                blender.step(
                    "main_thread", cloud=work / "capture.ply", folder=work, views=VIEWS, refit=refit
                )
            )
    print(f"{options.splats:,} splats, Blender of {options.blender}, {options.runs} runs")
    print(*table(runs, goal(options.splats)), sep="\n")


if __name__ == "__main__":
    main()
