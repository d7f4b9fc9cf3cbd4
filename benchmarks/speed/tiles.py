"""How long tiles take that are pruned together, and what memory the process needs.

    python -m benchmarks.speed.tiles [--splats 10000000] [--tiles 10] [--workers 0 1 2]
    python -m benchmarks.speed.tiles --method merge

The tiles are the committed room's rows without harmonics above the constant one, 56 bytes each, a
room beside the other along a street. The room's cameras stand in all rooms, in each as many, so a
tile is seen by its own and by those that look along the street; with ``--one-room`` all of them
stand in the middle one. They are compared with reading and writing the same bytes: `cat` of all
tiles into one file.

Memory is VmRSS, what is mapped included, of the process and those that it starts, each for itself.
Seconds of the processor, of all of them and of the busiest one, tell what a busy machine hides:
where no core waits for another, a run takes as long as its busiest process.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from refine_addon.core import METHODS, read_ply
from refine_addon.core.formats.ply import new_header
from refine_addon.core.formats.ply_columns import REQUIRED

from ..baselines import splat_transform

ROOT = Path(__file__).parents[2]
ROOM = ROOT / "tests/data/room_small"

ASIDE = 12.0
"""How far a room is from the next, world units."""


def make_tiles(folder: Path, splats: int, tiles: int) -> list[Path]:
    """Write so many tiles with so many splats altogether."""
    room = read_ply(ROOM / "point_cloud.ply").rows
    random = np.random.default_rng(0)
    kind = np.dtype([(name, "<f4") for name in REQUIRED])
    paths = []
    for tile in range(tiles):
        count = splats // tiles
        path = folder / f"tile_{tile:03d}.ply"
        with path.open("wb") as stream:
            stream.write(new_header(np.dtype([(name, "<f4") for name in REQUIRED]), count))
            for start in range(0, count, len(room)):
                some = room[: count - start]
                rows = np.empty(len(some), kind)
                for name in REQUIRED:
                    rows[name] = some[name]
                for axis in "xyz":
                    rows[axis] += random.normal(scale=0.02, size=len(rows)).astype(np.float32)
                rows["x"] += np.float32(ASIDE * (tile - tiles // 2))
                stream.write(rows.data)
        paths.append(path)
    return paths


def make_cameras(path: Path, tiles: int) -> None:
    """Write the room's cameras, spread over the rooms of `make_tiles`."""
    cameras = json.loads((ROOM / "cameras.json").read_text())
    shuffled = np.random.default_rng(0).permutation(len(cameras))
    for camera, place in zip(cameras, shuffled.tolist(), strict=True):
        camera["position"][0] += ASIDE * (place * tiles // len(cameras) - tiles // 2)
    path.write_text(json.dumps(cameras))


class Cost(NamedTuple):
    """What a command takes.

    Attributes
    ----------
    seconds : float
    busy, busiest : float
        Seconds of the processor, of all processes, and of the one that took most.
    peak : float
        The most megabytes of a process.
    """

    seconds: float
    busy: float
    busiest: float
    peak: float


def run(command: Sequence[str | Path]) -> Cost:
    """Run a command; return what it took.

    Raises
    ------
    subprocess.CalledProcessError
        If it fails.
    """
    peak, each = 0.0, {}
    before = splat_transform.processor_seconds(resource.RUSAGE_CHILDREN)
    start = time.perf_counter()
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            for member in _family(process.pid):
                peak = max(peak, _resident(member))
                each[member] = max(each.get(member, 0.0), _processor(member))
            time.sleep(0.02)
        seconds = time.perf_counter() - start
    if process.returncode:
        raise subprocess.CalledProcessError(process.returncode, list(map(str, command)))
    busy = splat_transform.processor_seconds(resource.RUSAGE_CHILDREN) - before
    return Cost(seconds, busy, max(each.values(), default=0.0), peak)


def _family(process: int) -> list[int]:
    """Return a process and all that it started."""
    found = [process]
    for each in found:
        for thread in Path(f"/proc/{each}/task").glob("*/children"):
            with contextlib.suppress(OSError):  # it ended
                found += map(int, thread.read_text().split())
    return found


def _processor(process: int) -> float:
    """Return the seconds of the processor that a process has had."""
    try:
        words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def _resident(process: int) -> float:
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return 0.0
    return sum(int(line.split()[1]) / 1000 for line in lines if line.startswith("VmRSS:"))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print what each way takes."""
    parser = argparse.ArgumentParser(description="Time tiles that are pruned together.")
    parser.add_argument("--splats", type=int, default=10_000_000)
    parser.add_argument("--tiles", type=int, default=10)
    parser.add_argument(
        "--workers", type=int, nargs="*", default=[0], help="0: none of Dask's; any again"
    )
    parser.add_argument("--method", choices=METHODS, default="closed-form")
    parser.add_argument("--one-room", action="store_true", help="all cameras in the middle room")
    parser.add_argument("--folder", type=Path, help="on the disk to measure; default the system's")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(dir=options.folder) as made:
        folder = Path(made)
        paths = make_tiles(folder, options.splats, options.tiles)
        size = sum(path.stat().st_size for path in paths)
        print(f"{options.splats:,} splats, {options.tiles} tiles, {size / 1e6:.0f} MB")
        print(f"load average {os.getloadavg()[0]:.1f}, {os.cpu_count()} cores")
        cameras = folder / "cameras.json"
        make_cameras(cameras, 1 if options.one_room else options.tiles)
        copy = ["sh", "-c", 'cat "$@" > "$0"', folder / "copy", *paths]
        prune = [sys.executable, "-m", "refine_addon", "prune", *paths, "--together", "--ratio"]
        prune += ["0.5", "--cameras", cameras, "--method", options.method]
        output = folder / "out"
        commands = [("copy", copy)]
        for workers in options.workers:
            more = ["--workers", str(workers)] if workers else []
            commands.append((f"{workers} workers", [*prune, "-o", output, *more]))
        for name, command in commands:
            cost = run(command)
            shutil.rmtree(output, ignore_errors=True)
            print(
                f"{name:10} {cost.seconds:7.1f} s, processor {cost.busy:7.1f} s, busiest process "
                f"{cost.busiest:7.1f} s, {cost.peak:6.0f} MB",
                flush=True,
            )


if __name__ == "__main__":
    main()
