"""How long a prune takes from file to file, and what memory it needs.

    python -m benchmarks.speed.file_to_file [--splats 3000000] [--runs 5]
    python -m benchmarks.speed.file_to_file --method merge --splats 1900000 --runs 3
    python -m benchmarks.speed.file_to_file --method merge refit --splats 160000 --runs 1

The first deletes by the closed form, against copying the file; the others are against
splat-transform's decimation to the same number of splats, where that is installed.

The input is the committed room's rows, repeated, each copy a little elsewhere and so much smaller
that the surfaces stay as covered as they were: 744 MB for 3 million splats of degree 3. All
commands are processes of their own, interpreter start included; they run in turn, one not counted,
with the input in the page cache and nothing at the output's place. Seconds of the processor, of all
cores together, tell what a busy machine hides.

Memory is sampled from ``/proc``: the pages that belong to the process alone (RssAnon), and to those
that it starts. What it maps of the input is the page cache's, which the system takes back when
others need it.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from refine_addon.core import Budget, read_ply
from refine_addon.core.formats.ply import with_count

from ..baselines import splat_transform

ROOT = Path(__file__).parents[2]
ROOM = ROOT / "tests/data/room_small"

TARGET_RATIO = {"copy": 3.0, "decimate": 1.0}
"""A prune takes at most this many times as long as what it is compared with."""

TARGET_MEMORY = {"copy": 400.0, "decimate": 2000.0}
"""Megabytes that a prune may hold beyond the page cache, by what it is compared with."""


def make_input(path: Path, count: int) -> None:
    """Write a file of `count` splats: the room's again and again, moved by 2 cm of noise."""
    file = read_ply(ROOM / "point_cloud.ply")
    random = np.random.default_rng(0)
    smaller = math.log(max(count / len(file), 1.0)) / 2
    with path.open("wb") as stream:
        stream.write(with_count(file.header, count))
        for start in range(0, count, len(file)):
            rows = file.rows[: count - start].copy()
            for axis in "xyz":
                rows[axis] += random.normal(scale=0.02, size=len(rows)).astype(np.float32)
            for axis in range(3):
                rows[f"scale_{axis}"] -= np.float32(smaller)
            stream.write(rows.data)


def run(command: Sequence[str | Path]) -> tuple[float, float, float]:
    """Run a command from the checkout; return its seconds, the processor's, and peak megabytes.

    Raises
    ------
    subprocess.CalledProcessError
        If it fails.
    """
    peak = 0.0
    before = splat_transform.processor_seconds(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            peak = max(peak, (splat_transform.memory("RssAnon", process.pid) or 0) / 1e6)
            time.sleep(0.002)
        seconds = time.perf_counter() - start
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, list(map(str, command)))
    busy = splat_transform.processor_seconds(resource.RUSAGE_CHILDREN) - before
    return seconds, busy, peak


def main(arguments: Sequence[str] | None = None) -> None:
    """Print medians, their ratio, the peak of memory and where the time goes."""
    parser = argparse.ArgumentParser(description="Time a prune against a copy or a decimation.")
    parser.add_argument("--splats", type=int, default=3_000_000)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--ratio", default="0.5")
    parser.add_argument(
        "--method", nargs="+", choices=("merge", "refit"), default=[],
        help="one prune each, against a decimation by merging",
    )  # fmt: skip
    parser.add_argument("--folder", type=Path, help="on the disk to measure; default the system's")
    options = parser.parse_args(arguments)
    other = "decimate" if options.method else "copy"
    with tempfile.TemporaryDirectory(dir=options.folder) as made:
        source, output, report = (
            Path(made) / name for name in ("in.ply", "out.ply", "report.json")
        )
        make_input(source, options.splats)
        print(f"{options.splats:,} splats, {source.stat().st_size / 1e6:.0f} MB, {made}")
        prune = [sys.executable, "-m", "refine_addon", "prune", source, "-o", output, "--ratio"]
        prune += [options.ratio, "--cameras", ROOM / "cameras.json", "--report", report]
        commands = {"start": [sys.executable, "-m", "refine_addon", "--version"]}
        methods = options.method or ["closed-form"]
        commands |= {name: [*prune, "--method", name] for name in methods}
        if not options.method:
            commands["copy"] = ["cp", source, output]
        elif splat_transform.find():
            left = options.splats - Budget(ratio=float(options.ratio)).removals(options.splats)
            flag = splat_transform.FLAGS[0]
            commands["decimate"] = splat_transform.command(source, output, flag, left)
        else:
            print(splat_transform.MISSING)
        seconds: dict[str, list[float]] = {name: [] for name in commands}
        busy: dict[str, list[float]] = {name: [] for name in commands}
        peaks: dict[str, float] = dict.fromkeys(commands, 0.0)
        parts: dict[str, list[dict[str, float]]] = {name: [] for name in methods}
        for turn in range(options.runs + 1):
            for name, command in commands.items():
                took, worked, peak = run(command)
                if turn:
                    seconds[name].append(took)
                    busy[name].append(worked)
                    peaks[name] = max(peaks[name], peak)
                output.unlink(missing_ok=True)
                if name in parts:
                    parts[name].append(json.loads(report.read_text())["results"][0]["timings"])
                    report.unlink()
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    for name, values in seconds.items():
        every = " ".join(f"{value:.2f}" for value in values)
        print(
            f"{name:11} {medians[name]:6.2f} s ({every}), {statistics.median(busy[name]):.2f} s of "
            f"the processor, peak {peaks[name]:.0f} MB of its own"
        )
    for name, of_runs in parts.items():
        tell(name, of_runs[1:], medians[name], medians.get(other), other)
        print(f"{name}: memory {peaks[name]:.0f} MB, target at most {TARGET_MEMORY[other]:g}")


def tell(
    name: str, runs: Sequence[dict[str, float]], seconds: float, others: float | None, other: str
) -> None:
    """Print the medians of a prune's steps, and its time against that of another command.

    Parameters
    ----------
    name, other : str
        Of the two.
    runs : sequence of dict
        Seconds of each step.
    seconds, others : float or None
        Of both; None if the other was not run.
    """
    for step in runs[0]:
        print(f"    {name:11} {step:9} {statistics.median(run[step] for run in runs):6.2f}")
    if others is not None:
        print(f"{name} / {other}: {seconds / others:.2f}, target at most {TARGET_RATIO[other]:g}")


if __name__ == "__main__":
    main()
